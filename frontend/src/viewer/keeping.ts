// Notes that a browser keeps between visits, where it keeps anything for this page.
import { NotesRefused, readNotes, writeNotes, type Ground, type Note } from "./annotations";

/** Keeps the notes of one object of one database. */
export class NoteStore {
  /** Why notes are not kept here; empty where they are. */
  failure = "";
  private readonly key: string;

  constructor(
    database: string,
    object: string,
    private readonly ground: Ground,
    onChange: () => void,
  ) {
    this.key = `levkas-notes:${JSON.stringify([database, object])}`;
    // The same object in another tab.
    addEventListener("storage", (event) => {
      if (event.key === this.key) onChange();
    });
  }

  /** Return what is kept; what cannot be read is set aside, and `failure` says so. */
  read(): Note[] {
    this.failure = "";
    let text: string | null;
    try {
      text = localStorage.getItem(this.key);
    } catch {
      this.refused();
      return [];
    }
    if (text === null) return [];
    try {
      return readNotes(text, this.ground);
    } catch (error) {
      if (!(error instanceof NotesRefused)) throw error;
      this.failure = `The notes stored in this browser cannot be read: ${error.message}. They are set aside.`;
      this.put(`${this.key}:unreadable`, text);
      return [];
    }
  }

  write(notes: Note[]): void {
    this.failure = "";
    this.put(this.key, notes.length ? writeNotes(notes, this.ground) : null);
  }

  private put(key: string, text: string | null): void {
    try {
      if (text === null) localStorage.removeItem(key);
      else localStorage.setItem(key, text);
    } catch {
      this.refused();
    }
  }

  private refused(): void {
    this.failure =
      "This browser stores nothing for this page: export the notes before you close it.";
  }
}
