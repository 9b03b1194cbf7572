// Builds elements. Text from outside only ever enters through textContent and plain attributes.

type Child = Node | string | null | undefined | false;
type Attributes = Record<string, string | number | boolean | null | undefined>;

const ADDRESSES = new Set(["href", "src"]);

/** Make an element with attributes and children; a string child is text, never markup. */
export function make<K extends keyof HTMLElementTagNameMap>(
  tag: K,
  attributes: Attributes = {},
  ...children: Child[]
): HTMLElementTagNameMap[K] {
  const element = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) {
    if (value === null || value === undefined || value === false) continue;
    if (name.startsWith("on") || name === "style" || name === "srcdoc")
      throw new Error(`${name} is not set by attribute`);
    if (ADDRESSES.has(name) && !isSafeAddress(String(value))) continue;
    element.setAttribute(name, value === true ? "" : String(value));
  }
  append(element, children);
  return element;
}

/** Make an SVG element. */
export function draw<K extends keyof SVGElementTagNameMap>(
  tag: K,
  attributes: Attributes = {},
  ...children: Child[]
): SVGElementTagNameMap[K] {
  const element = document.createElementNS("http://www.w3.org/2000/svg", tag);
  for (const [name, value] of Object.entries(attributes))
    if (value !== null && value !== undefined && value !== false)
      element.setAttribute(name, String(value));
  append(element, children);
  return element;
}

/** Make a small square of a colour, beside the word for it. */
export function swatch(colour: string): HTMLElement {
  const element = make("span", { class: "swatch", "aria-hidden": "true" });
  element.style.background = colour;
  return element;
}

/** Save a file from the page, by a link that is clicked. */
export function saveFile(name: string, content: BlobPart, type: string): void {
  const link = make("a", { download: name });
  link.href = URL.createObjectURL(new Blob([content], { type }));
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 10_000);
}

/** Fill an element anew; what is open in it stays so, and who works with the keyboard stays where they were. */
export function refill(root: HTMLElement, ...children: Child[]): void {
  const held = root.contains(document.activeElement) ? document.activeElement!.id : null;
  const open = [...root.querySelectorAll("details[open]")].map((one) => one.id);
  root.replaceChildren();
  append(root, children);
  for (const id of open) if (id) root.querySelector(`#${CSS.escape(id)}`)?.setAttribute("open", "");
  if (held === null) return;
  const again = held ? root.querySelector<HTMLElement>(`#${CSS.escape(held)}`) : null;
  (again ?? root.querySelector<HTMLElement>("button") ?? root).focus({ preventScroll: true });
}

/** Find an element of the page by its id; its absence is a defect of the page. */
export function find<T extends HTMLElement>(id: string): T {
  const element = document.getElementById(id);
  if (!element) throw new Error(`the page has no #${id}`);
  return element as T;
}

/** Whether a link may be followed: http, https, mailto, or a relative path. */
export function isSafeAddress(address: string): boolean {
  const text = address.replace(/[\0- ]/g, "");
  const scheme = /^([a-z][a-z0-9+.-]*):/i.exec(text);
  return !scheme || ["http", "https", "mailto"].includes(scheme[1]!.toLowerCase());
}

function append(element: Element, children: Child[]): void {
  for (const child of children)
    if (child !== null && child !== undefined && child !== false) element.append(child);
}
