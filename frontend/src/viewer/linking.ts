// The button that copies the address of what is shown.
import { make } from "../shared/element";
import type { Address } from "./address";

const SAID_MS = 6000;

/** Let a button copy the address; `say` gets a sentence on what was done, and an empty one later. */
export function startCopying(
  button: HTMLButtonElement,
  address: Address,
  say: (sentence: string) => void,
): void {
  let speaking = 0;
  button.addEventListener("click", () => {
    void copy(address.write(), button).then((done) => {
      clearTimeout(speaking);
      say(sentence(done));
      speaking = window.setTimeout(() => say(""), SAID_MS);
    });
  });
}

function sentence(done: boolean): string {
  if (!done) return "This browser does not allow copying: take the link from the address bar.";
  return location.protocol === "file:"
    ? "Link copied. It points to files on this computer; it works only where the folder has the same path."
    : "Link copied. It shows what you see now.";
}

async function copy(text: string, beside: HTMLElement): Promise<boolean> {
  try {
    await navigator.clipboard.writeText(text);
    return true;
  } catch {
    return copyOldWay(text, beside); // no clipboard for pages over http
  }
}

function copyOldWay(text: string, beside: HTMLElement): boolean {
  const field = make("textarea", { class: "visually-hidden", "aria-hidden": "true" });
  field.value = text;
  beside.after(field);
  field.select();
  try {
    // eslint-disable-next-line @typescript-eslint/no-deprecated -- the only way over http
    return document.execCommand("copy");
  } finally {
    field.remove();
    beside.focus();
  }
}
