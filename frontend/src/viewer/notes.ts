// The panel "Notes": what a person writes on places and parts of the painting, and what was published with it.
import { effect } from "@preact/signals-core";
import { make, saveFile } from "../shared/element";
import type { Point } from "../shared/pane";
import {
  LARGEST_FILE,
  LONGEST_AUTHOR,
  LONGEST_TEXT,
  MOST_NOTES,
  newId,
  plainText,
  readNotes,
  readPage,
  writeNotes,
  type Ground,
  type Note,
} from "./annotations";
import type { Drawing } from "./drawing";
import { NoteStore } from "./keeping";
import type { PageRecord } from "./record";
import { boundsOf, KINDS, type Kind } from "./shapes";
import type { State } from "./state";

const MINE = "#5ed3e0";
const PUBLISHED = "#fff";
const SHORT = 24; // letters of a note beside its mark
const WAYS: Record<Kind, string> = {
  rectangle: "Drag over the painting; Esc cancels.",
  circle: "Drag from the middle outwards; Esc cancels.",
  polygon: "Click the corners; a double click or Enter closes the polygon, Esc cancels.",
};

/** What the panel needs of the rest of the page. */
export interface NoteTools {
  drawing: Drawing;
  /** Show a place of the painting. */
  go: (place: Point) => void;
  /** The place that a note without a drawing is on: the pinned one, else the middle of the view. */
  here: () => Point;
}

export class NotePanel {
  private readonly published: Note[];
  private readonly store: NoteStore;
  private readonly ground: Ground;
  private readonly list = make("ol", { class: "pins notes" });
  private readonly kept = make("p", { class: "note-line soft" });
  private readonly message = make("p", { class: "note-line soft", role: "status" });
  private readonly author = make("input", { type: "text", maxlength: LONGEST_AUTHOR });
  private readonly export = button("Export notes (JSON)");
  private readonly back = button("Put the note back");
  private readonly tools: HTMLButtonElement[];
  private readonly file = make("input", {
    type: "file",
    accept: ".json,.jsonld,application/json,application/ld+json",
    class: "visually-hidden",
    "aria-label": "File of notes",
  });
  private removed: Note | null = null;

  constructor(
    host: HTMLElement,
    private readonly record: PageRecord,
    private readonly state: State,
    private readonly around: NoteTools,
  ) {
    const { grid, canvas } = record;
    this.ground = { canvas, size: [grid.width, grid.height] };
    this.published = this.readPublished();
    this.store = new NoteStore(record.database, record.object.name, this.ground, () =>
      this.restore(),
    );
    const here = button("Note here");
    here.title = "On the pinned place, or the middle of the view";
    here.addEventListener("click", () => this.writeHere());
    this.tools = [here, ...KINDS.map((kind) => this.tool(kind))];
    const load = button("Import notes…");
    load.addEventListener("click", () => this.file.click());
    this.file.addEventListener("change", () => void this.load());
    this.export.addEventListener("click", () => this.save());
    this.back.addEventListener("click", () => this.putBack());
    const line = (...parts: HTMLElement[]): HTMLElement =>
      make("div", { class: "pin-tools" }, ...parts);
    const author = make("label", { class: "compared" }, "Your name, on new notes ", this.author);
    host.append(line(...this.tools), this.kept, this.list, this.message, line(this.back));
    host.append(line(author), line(this.export, load, this.file), ...this.listPublished());
    this.restore();
    effect(() => this.show(state.notes.value));
    addEventListener("beforeunload", (event) => {
      if (this.store.failure && state.notes.peek().length) event.preventDefault();
    });
  }

  /** Write a note on the pinned place, or the middle of the view. */
  writeHere(): void {
    this.add("place", [this.around.here()]);
  }

  private readPublished(): Note[] {
    try {
      return readPage({ type: "AnnotationPage", items: this.record.notes }, this.ground);
    } catch (error) {
      this.message.textContent = `The published notes are not shown: ${String(error)}`;
      return [];
    }
  }

  private restore(): void {
    this.state.notes.value = this.store.read();
    this.sayKept();
  }

  private tool(kind: Kind): HTMLButtonElement {
    const made = button(kind[0]!.toUpperCase() + kind.slice(1));
    made.setAttribute("aria-label", `Note on a ${kind}`);
    made.setAttribute("aria-pressed", "false");
    made.addEventListener("click", () => {
      if (made.getAttribute("aria-pressed") === "true") this.around.drawing.cancel();
      else void this.sketch(kind, made);
    });
    return made;
  }

  private async sketch(kind: Kind, tool: HTMLElement): Promise<void> {
    const done = this.around.drawing.begin(kind);
    tool.setAttribute("aria-pressed", "true");
    this.message.textContent = WAYS[kind];
    const points = await done;
    tool.setAttribute("aria-pressed", "false");
    this.message.textContent = "";
    if (points) this.add(kind, points);
  }

  private add(kind: Kind | "place", points: Point[]): void {
    const { notes } = this.state;
    if (notes.value.length >= MOST_NOTES) return;
    const [width, height] = this.ground.size;
    const inside = ([x, y]: Point): Point => [
      Math.min(Math.max(x, -0.5), width - 0.5),
      Math.min(Math.max(y, -0.5), height - 0.5),
    ];
    // Of a circle the place on it gives the radius: it may lie outside.
    const places = points.map((point, i) => (kind === "circle" && i ? point : inside(point)));
    const shape = { kind, points: places };
    const author = plainText(this.author.value).trim().slice(0, LONGEST_AUTHOR);
    const made = new Date().toISOString().slice(0, 19) + "Z";
    this.set([...notes.value, { id: newId(), shape, text: "", author, made }]);
    this.list.querySelector<HTMLElement>("li:last-child textarea")?.focus();
  }

  /** Keep notes in the browser, and show them. */
  private set(notes: Note[]): void {
    this.state.notes.value = notes;
    this.store.write(notes);
    this.sayKept();
  }

  private sayKept(): void {
    this.kept.textContent =
      this.store.failure ||
      "Notes stay in this browser, for this object: export them to share them.";
    this.kept.classList.toggle("doubts", this.store.failure !== "");
  }

  private show(notes: Note[]): void {
    this.export.disabled = !notes.length;
    this.back.hidden = !this.removed;
    for (const tool of this.tools) tool.disabled = notes.length >= MOST_NOTES;
    const held = document.activeElement;
    const typing = held instanceof HTMLTextAreaElement && this.list.contains(held);
    if (!typing || this.list.childElementCount !== notes.length)
      this.list.replaceChildren(...notes.map((note, i) => this.row(note, i)));
    this.around.drawing.show("notes", [
      ...this.published.map(({ shape, text }, i) => ({
        shape,
        colour: PUBLISHED,
        label: `P${i + 1} ${shortened(text)}`,
        dashed: true,
      })),
      ...notes.map(({ shape, text }, i) => ({
        shape,
        colour: MINE,
        label: `N${i + 1} ${shortened(text)}`,
      })),
    ]);
  }

  private row(note: Note, number: number): HTMLElement {
    const name = `note ${number + 1}`;
    const badge = make("span", { class: "pin-number note-badge" }, `N${number + 1}`);
    const text = make("textarea", {
      rows: 2,
      maxlength: LONGEST_TEXT,
      dir: "auto",
      "aria-label": `Text of ${name}`,
    });
    text.value = note.text;
    text.addEventListener("input", () =>
      this.change(number, { ...this.state.notes.value[number]!, text: plainText(text.value) }),
    );
    text.addEventListener("change", () => {
      text.value = plainText(text.value);
    });
    const remove = button("×");
    remove.setAttribute("aria-label", `Remove ${name}`);
    remove.addEventListener("click", () => this.change(number, null));
    const about = make("span", { class: "region-words soft", dir: "auto" }, described(note));
    return make("li", { class: "region-row" }, badge, text, remove, this.placeOf(note), about);
  }

  private placeOf({ shape }: Note): HTMLElement {
    const [x0, y0, x1, y1] = boundsOf(shape);
    const middle: Point = [Math.round((x0 + x1) / 2), Math.round((y0 + y1) / 2)];
    const where = button(middle.join(", "));
    where.title = "Show this place";
    where.classList.add("note-place");
    where.addEventListener("click", () => this.around.go(middle));
    return where;
  }

  private change(number: number, note: Note | null): void {
    const notes = this.state.notes.value;
    if (!note) this.removed = notes[number] ?? null;
    this.set(notes.flatMap((old, i) => (i !== number ? [old] : note ? [note] : [])));
    if (!note) this.back.focus();
  }

  private putBack(): void {
    const { removed } = this;
    this.removed = null;
    if (removed) this.set([...this.state.notes.value, removed]);
  }

  private listPublished(): HTMLElement[] {
    if (!this.published.length) return [];
    const rows = this.published.map((note, i) =>
      make(
        "li",
        { class: "region-row" },
        make("span", { class: "pin-number published" }, `P${i + 1}`),
        make("span", { class: "note-text", dir: "auto" }, note.text),
        this.placeOf(note),
        make("span", { class: "region-words soft", dir: "auto" }, described(note)),
      ),
    );
    return [
      make("h3", { class: "published-head" }, "Published notes"),
      make("ol", { class: "pins notes published-notes" }, ...rows),
    ];
  }

  private save(): void {
    const name = `${this.record.object.name}_notes.json`;
    saveFile(name, writeNotes(this.state.notes.value, this.ground), "application/ld+json");
  }

  /** Add the notes of a file to those that are here; one with the same name takes the place of the older. */
  private async load(): Promise<void> {
    const file = this.file.files?.[0];
    this.file.value = "";
    if (!file) return;
    try {
      // A character takes four bytes at most: a larger file is not read at all.
      if (file.size > 4 * LARGEST_FILE)
        throw new Error(`it is larger than ${LARGEST_FILE / 1e6} MB`);
      const found = readNotes(await file.text(), this.ground);
      const names = new Set(found.map(({ id }) => id));
      const kept = this.state.notes.value.filter(({ id }) => !names.has(id));
      const notes = [...kept, ...new Map(found.map((note) => [note.id, note])).values()];
      if (notes.length > MOST_NOTES)
        throw new Error(`there would be more than ${MOST_NOTES} notes`);
      this.set(notes);
      this.message.textContent = `${names.size} note${names.size === 1 ? "" : "s"} imported from ${file.name}.`;
    } catch (error) {
      const why = error instanceof Error ? error.message : String(error);
      this.message.textContent = `${file.name} was refused: ${why}.`;
    }
  }
}

function button(words: string): HTMLButtonElement {
  return make("button", { type: "button", class: "small" }, words);
}

function shortened(text: string): string {
  const [line = ""] = text.split("\n", 1);
  return line.length > SHORT ? `${line.slice(0, SHORT - 1)}…` : line;
}

function described({ author, made }: Note): string {
  return [author, made.slice(0, 10)].filter(Boolean).join(", ");
}
