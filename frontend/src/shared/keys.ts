// The keyboard, and the dialog that lists the keys.
import { make } from "./element";

export interface Key {
  /** Names of the keys, as the help lists them. */
  keys: string[];
  words: string;
  match: (event: KeyboardEvent) => boolean;
  act: (event: KeyboardEvent) => unknown;
  /** Called when the key is let go of; such a key does not repeat. */
  release?: () => void;
}

const EDITED = "input:not([type=range]), select, textarea, [contenteditable]";
const PRESSED = "button, a, summary, [role=slider], [role=radio]";
const MOVED = "input, [role=slider], [role=radio], .scroll";

/** Listen for keys anywhere on the page, except where one is typing or a dialog is open. */
export function listenToKeys(keys: Key[]): void {
  addEventListener("keydown", (event) => {
    const target = event.target instanceof Element ? event.target : document.body;
    if (target.closest("dialog") || target.closest(EDITED)) return;
    // Space and Enter press what has the focus; arrows move it.
    if ([" ", "Enter"].includes(event.key) && target.closest(PRESSED)) return;
    if (event.key.startsWith("Arrow") && target.closest(MOVED)) return;
    const found = keys.find((one) => one.match(event));
    if (!found) return;
    event.preventDefault();
    if (!event.repeat || !found.release) found.act(event);
  });
  const release = (event?: KeyboardEvent): void => {
    for (const one of keys) if (!event || one.match(event)) one.release?.();
  };
  addEventListener("keyup", release);
  addEventListener("blur", () => release());
}

/** Match keys by name, letters in either case, without Ctrl, Alt or Meta. */
export function plain(...names: string[]): (event: KeyboardEvent) => boolean {
  return (event) =>
    !isCommand(event) &&
    !event.altKey &&
    names.includes(event.key.length === 1 ? event.key.toLowerCase() : event.key);
}

/** Make a key that does one thing: its name in the help, the keys that match, and what they do. */
export function key(name: string, pressed: string[], words: string, act: Key["act"]): Key {
  return { keys: name.split(" "), words, match: plain(...pressed), act };
}

/** Whether Ctrl, or Meta on a Mac, is held. */
export function isCommand(event: KeyboardEvent): boolean {
  return event.ctrlKey || event.metaKey;
}

export const ARROWS = ["ArrowLeft", "ArrowRight", "ArrowUp", "ArrowDown"];

/** The direction of an arrow key, x to the right and y down. */
export function direction(event: KeyboardEvent): [number, number] {
  const x = Number(event.key === "ArrowRight") - Number(event.key === "ArrowLeft");
  return [x, Number(event.key === "ArrowDown") - Number(event.key === "ArrowUp")];
}

/** Make the dialog that lists the keys, between two paragraphs of words. */
export function helpDialog(keys: Key[], before: string, after: string): HTMLDialogElement {
  const rows = keys.map((one) =>
    make(
      "tr",
      {},
      make("th", { scope: "row" }, ...one.keys.flatMap((name) => [make("kbd", {}, name), " "])),
      make("td", {}, one.words),
    ),
  );
  return openableDialog(
    "help",
    "Keys and help",
    make("p", {}, before),
    make("table", {}, make("tbody", {}, ...rows)),
    make("p", { class: "soft" }, after),
  );
}

/** Make a dialog with a heading and a button that closes it. */
export function openableDialog(
  name: string,
  title: string,
  ...content: HTMLElement[]
): HTMLDialogElement {
  const close = make("button", { type: "button", class: "small", "aria-label": "Close" }, "×");
  const head = make("header", {}, make("h2", { id: `${name}-head` }, title), close);
  const dialog = make(
    "dialog",
    { class: name, "aria-labelledby": `${name}-head` },
    head,
    ...content,
  );
  close.addEventListener("click", () => dialog.close());
  dialog.addEventListener("click", (event) => {
    if (event.target === dialog) dialog.close();
  });
  document.body.append(dialog);
  return dialog;
}
