// Light and dark: the system's choice, unless the reader chose; remembered where the browser lets us.

const KEY = "levkas-theme";
type Theme = "light" | "dark";

/** Apply what was chosen before, and let `button` change it. */
export function startTheme(button: HTMLButtonElement): void {
  const root = document.documentElement;
  const chosen = read();
  if (chosen) root.dataset["theme"] = chosen;
  const describe = (): void => {
    const next = current() === "dark" ? "light" : "dark";
    button.textContent = next === "dark" ? "☾" : "☀";
    button.setAttribute("aria-label", `Use ${next} colours`);
    button.title = `Use ${next} colours`;
  };
  button.addEventListener("click", () => {
    const next: Theme = current() === "dark" ? "light" : "dark";
    root.dataset["theme"] = next;
    try {
      localStorage.setItem(KEY, next);
    } catch {
      // A page opened from a file may have no storage: the choice then lasts as long as the page.
    }
    describe();
  });
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", describe);
  describe();
}

const known = new Map<string, string>();
const waiting: (() => void)[] = [];

/** A colour of the page, by its name in the style sheet; read once, as reading lays the page out. */
export function ink(name: string): string {
  if (!waiting.length) onTheme(() => {});
  let colour = known.get(name);
  if (colour === undefined)
    known.set(
      name,
      (colour = getComputedStyle(document.documentElement).getPropertyValue(name).trim()),
    );
  return colour;
}

/** Call whenever colours change. */
export function onTheme(listener: () => void): void {
  if (!waiting.length) {
    const changed = (): void => {
      known.clear();
      for (const one of waiting) one();
    };
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", changed);
    new MutationObserver(changed).observe(document.documentElement, {
      attributes: true,
      attributeFilter: ["data-theme"],
    });
  }
  waiting.push(listener);
}

function current(): Theme {
  const chosen = document.documentElement.dataset["theme"];
  if (chosen === "light" || chosen === "dark") return chosen;
  return matchMedia("(prefers-color-scheme: dark)").matches ? "dark" : "light";
}

function read(): Theme | null {
  try {
    const value = localStorage.getItem(KEY);
    return value === "light" || value === "dark" ? value : null;
  } catch {
    return null;
  }
}
