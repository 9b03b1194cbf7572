// The button that copies the address of what is shown.
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
    void copy(address.write()).then((done) => {
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

/** Whether the address was copied: pages over http that are not this computer's have no clipboard. */
async function copy(address: string): Promise<boolean> {
  try {
    await navigator.clipboard.writeText(address);
    return true;
  } catch {
    return false;
  }
}
