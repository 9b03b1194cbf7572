// The pairs as a table of any length: only the rows in view are made.
import { make } from "../element";
import { errorColour, px, type Numbers, type Told } from "./record";
import type { Store } from "./store";

const ROW = 28;
type Key = "row" | "residual" | "leave_one_out" | "weight" | "state" | "reason";
const COLUMNS: [Key, string, string][] = [
  ["row", "Pair", "Number of the pair"],
  ["residual", "Off by", "Distance from where the map puts it, reference px"],
  ["leave_one_out", "Without it", "The same by a map that does not know this pair: large where a pair vouches only for itself"],
  ["weight", "Weight", "How much the map rests on it"],
  ["state", "State", "Whether the map rests on it"],
  ["reason", "Why", "Why it was removed, or what you said of it"],
];
const FILTERS: [string, string, (told: Told, row: number) => boolean][] = [
  ["all", "All", () => true],
  ["kept", "Used", (told, row) => told.state[row] === "kept"],
  ["removed", "Removed", (told, row) => told.state[row] === "removed"],
  ["hand", "By hand", (told, row) => told.reason[row]!.endsWith("by hand") || told.state[row] === "check"],
];
const STATES = { kept: "used", removed: "removed", check: "check" };

export class PairTable {
  readonly root: HTMLElement;
  onPick: (row: number) => void = () => {};
  private readonly body = make("div", { class: "rows", role: "rowgroup" });
  private readonly scroll = make("div", { class: "scroll", tabindex: 0, role: "grid", "aria-label": "Pairs of places; arrows choose, Delete removes" });
  private readonly count = make("span", { class: "soft" });
  private readonly heads = new Map<Key, HTMLButtonElement>();
  private order: number[] = [];
  private sort: { key: Key; down: boolean } = { key: "residual", down: true };
  private filter = "kept";
  private seen: Told | null = null;
  private lines: Line[] = [];
  /** What is in view, kept as asking for it lays the page out. */
  private view = { top: 0, height: 0 };

  constructor(private readonly store: Store) {
    const head = make("div", { class: "row head", role: "row" });
    for (const [key, words, title] of COLUMNS) {
      const button = make("button", { type: "button", title }, words);
      button.addEventListener("click", () => {
        this.sort = { key, down: this.sort.key === key ? !this.sort.down : key !== "row" };
        this.arrange();
      });
      this.heads.set(key, button);
      head.append(make("span", { role: "columnheader", class: `c-${key}` }, button));
    }
    const filters = make("div", { class: "filters", role: "group", "aria-label": "Which pairs" });
    for (const [name, words] of FILTERS) {
      const button = make("button", { type: "button", class: "small", "aria-pressed": name === this.filter ? "true" : "false" }, words);
      button.addEventListener("click", () => {
        this.filter = name;
        for (const other of filters.children) other.setAttribute("aria-pressed", String(other === button));
        this.arrange();
      });
      filters.append(button);
    }
    this.scroll.append(head, this.body);
    this.root = make("section", { class: "table", "aria-label": "Pairs" }, make("header", {}, make("h2", {}, "Pairs"), filters, this.count), this.scroll);
    const look = (): void => {
      this.view = { top: this.scroll.scrollTop, height: this.scroll.clientHeight };
      this.render();
    };
    this.scroll.addEventListener("scroll", look);
    new ResizeObserver(look).observe(this.scroll);
    this.body.addEventListener("click", (event) => {
      const line = (event.target as Element).closest<HTMLElement>("[data-row]");
      if (line) this.pick(Number(line.dataset["row"]));
    });
    this.scroll.addEventListener("keydown", (event) => {
      const by = { ArrowDown: 1, ArrowUp: -1, PageDown: 8, PageUp: -8, Home: -Infinity, End: Infinity }[event.key];
      if (by === undefined || !this.order.length) return;
      event.preventDefault();
      event.stopPropagation();
      const at = this.order.indexOf(this.store.selected);
      const next = at < 0 && Number.isFinite(by) ? 0 : at + by;
      this.pick(this.order[Math.max(0, Math.min(this.order.length - 1, next))]!);
    });
    store.listen(() => this.update());
  }

  /** The row with the largest error that is used. */
  worst(): number {
    const told = this.store.told;
    if (!told) return -1;
    let best = -1;
    told.residual.forEach((value, row) => {
      if (told.state[row] === "kept" && !Number.isNaN(value) && (best < 0 || value > told.residual[best]!)) best = row;
    });
    return best;
  }

  pick(row: number): void {
    this.store.select(row);
    this.onPick(row);
  }

  private update(): void {
    if (this.store.told !== this.seen) {
      this.seen = this.store.told;
      this.arrange();
    } else this.render();
    const at = this.order.indexOf(this.store.selected);
    if (at < 0 || !this.view.height) return;
    const top = at * ROW;
    const most = this.view.top + this.view.height - 2 * ROW;
    if (top < this.view.top) this.scroll.scrollTop = top;
    else if (top > most) this.scroll.scrollTop = this.view.top + top - most;
  }

  private arrange(): void {
    const told = this.store.told;
    const keep = FILTERS.find(([name]) => name === this.filter)![2];
    const { key, down } = this.sort;
    const rows: number[] = [];
    for (let row = 0; told && row < told.pairs.length; row++) if (keep(told, row)) rows.push(row);
    this.order = told ? sorted(rows, key === "row" ? null : told[key], down) : rows;
    for (const [name, button] of this.heads) button.parentElement!.setAttribute("aria-sort", name === key ? (down ? "descending" : "ascending") : "none");
    this.count.textContent = told ? `${this.order.length} of ${told.pairs.length}` : "";
    this.body.style.height = `${this.order.length * ROW}px`;
    this.scroll.setAttribute("aria-rowcount", String(this.order.length + 1));
    this.render();
  }

  private render(): void {
    const told = this.store.told;
    const first = Math.max(0, Math.floor(this.view.top / ROW) - 4);
    const last = told ? Math.min(this.order.length, Math.ceil((this.view.top + this.view.height) / ROW) + 4) : first;
    while (this.lines.length > Math.max(0, last - first)) this.lines.pop()!.root.remove();
    while (this.lines.length < last - first) {
      const line = new Line();
      this.lines.push(line);
      this.body.append(line.root);
    }
    this.lines.forEach((line, i) => line.show(told!, this.order[first + i]!, first + i, this.store.selected));
    if (this.lines.some((line) => line.row === this.store.selected)) this.scroll.setAttribute("aria-activedescendant", `pair-${this.store.selected}`);
    else this.scroll.removeAttribute("aria-activedescendant");
  }
}

/** A row of the table, made once and filled again and again. */
class Line {
  row = -1;
  private readonly texts = COLUMNS.map(() => document.createTextNode(""));
  private readonly dot = make("span", { class: "dot", "aria-hidden": "true" });
  private readonly reason: HTMLElement;
  readonly root: HTMLElement;

  constructor() {
    const cells = COLUMNS.map(([key], i) => make("span", { role: "gridcell", class: `c-${key}` }, key === "residual" ? this.dot : null, this.texts[i]));
    this.reason = cells.at(-1)!;
    this.root = make("div", { role: "row" }, ...cells);
  }

  show(told: Told, row: number, at: number, selected: number): void {
    const chosen = row === selected;
    const state = told.state[row]!;
    const error = told.residual[row];
    this.row = row;
    set(this.root, { class: `row ${state}${chosen ? " chosen" : ""}`, id: `pair-${row}`, "data-row": String(row), "aria-rowindex": String(at + 2), "aria-selected": String(chosen) });
    set(this.reason, { title: told.reason[row]! });
    const words = [String(row + 1), px(error), px(told.leave_one_out[row]), String(Number(told.weight[row]!.toFixed(3))), STATES[state], told.reason[row]!];
    words.forEach((text, i) => {
      if (this.texts[i]!.data !== text) this.texts[i]!.data = text;
    });
    this.dot.style.background = state === "removed" ? "var(--line)" : errorColour(error, told.stop);
    this.root.style.top = `${at * ROW}px`;
  }
}

function set(element: HTMLElement, attributes: Record<string, string>): void {
  for (const [name, value] of Object.entries(attributes)) if (element.getAttribute(name) !== value) element.setAttribute(name, value);
}

/** Rows by their values, none negative; those that are not known last, equal ones by their numbers. */
function sorted(rows: number[], values: Numbers | string[] | null, down: boolean): number[] {
  if (!values) return down ? rows.reverse() : rows;
  const ranks = Array.isArray(values) ? ranked(values) : values;
  const [value, bits] = bitsOfFloat();
  // Numbers alone are sorted ten times as fast as by a function: 32 bits of value, 20 of row.
  const keys = new Float64Array(rows.length);
  for (let i = 0; i < rows.length; i++) {
    value[0] = ranks[rows[i]!]!;
    const place = Number.isNaN(value[0]) ? 2 ** 32 : down ? 2 ** 32 - 1 - bits[0]! : bits[0]!;
    keys[i] = place * 2 ** 20 + rows[i]!;
  }
  keys.sort();
  const made = new Array<number>(rows.length);
  for (let i = 0; i < made.length; i++) made[i] = keys[i]! % 2 ** 20;
  return made;
}

/** A float, and its bits as a whole number: they rise together. */
function bitsOfFloat(): [Float32Array, Uint32Array] {
  const value = new Float32Array(1);
  return [value, new Uint32Array(value.buffer)];
}

/** The place of each word among all that there are. */
function ranked(words: string[]): Numbers {
  const rank = new Map([...new Set(words)].sort().map((word, i) => [word, i]));
  return Float32Array.from(words, (word) => rank.get(word)!);
}
