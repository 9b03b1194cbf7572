// The pairs as a table of any length: only the rows in view are made.
import { computed, effect, signal } from "@preact/signals-core";
import { make } from "../shared/element";
import { watch } from "../shared/watch";
import { errorColour, passes, px, type Filter, type Pair, type SessionState } from "./record";
import { sortRows } from "./sorting";
import type { Store } from "./store";

type Key = "row" | "residual" | "leave_one_out" | "weight" | "state" | "reason";

const ROW_PX = 28;
const SPARE = 4; // rows made above and below those in view
const PAGE = 8;
const COLUMNS: [Key, string, string][] = [
  ["row", "Pair", "Permanent number of the pair"],
  ["residual", "Off by", "Residual: distance from the place given by the map, reference px"],
  [
    "leave_one_out",
    "Without it",
    "Error of a map fitted without this pair: large where no other pair supports it",
  ],
  ["weight", "Weight", "Weight of the pair in the map"],
  ["state", "State", "Whether the pair is used for the map"],
  ["reason", "Why", "Why it was removed, or what you did to it"],
];
const FILTERS: [Filter, string][] = [
  ["all", "All"],
  ["kept", "Used"],
  ["removed", "Removed"],
  ["hand", "By hand"],
];
const STATES = { kept: "used", removed: "removed", check: "check" };

export class PairTable {
  readonly root: HTMLElement;
  onPick: (row: number) => void = () => {};
  private readonly body = make("div", { class: "rows", role: "rowgroup" });
  private readonly scroll = make("div", {
    class: "scroll",
    tabindex: 0,
    role: "grid",
    "aria-label": "Pairs of places; arrows choose, Delete removes",
  });
  private readonly sort = signal<{ key: Key; down: boolean }>({ key: "residual", down: true });
  private readonly order = computed(() => this.arrange());
  private readonly lines: Line[] = [];
  /** What is in view, kept as asking for it lays the page out. */
  private view = { top: 0, height: 0 };

  constructor(private readonly store: Store) {
    const count = make("span", { class: "soft" });
    const header = make("header", {}, make("h2", {}, "Pairs"), this.makeFilters(), count);
    this.scroll.append(this.makeHead(), this.body);
    this.root = make("section", { class: "table", "aria-label": "Pairs" }, header, this.scroll);
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
    this.scroll.addEventListener("keydown", (event) => this.move(event));
    effect(() => {
      const shown = this.order.value.length;
      count.textContent = `${shown} of ${store.session.value?.pairs.length ?? 0}`;
      this.body.style.height = `${shown * ROW_PX}px`;
      this.scroll.setAttribute("aria-rowcount", String(shown + 1));
    });
    watch([this.order, store.selected], () => {
      this.render();
      this.scrollTo(this.order.value.indexOf(store.selected.value));
    });
  }

  /** The row with the largest error that is used; -1 where there is none. */
  worst(): number {
    const session = this.store.session.peek();
    let [best, most] = [-1, -Infinity];
    session?.state.forEach((state, row) => {
      const error = session.residual[row] ?? -1;
      if (state === "kept" && error > most) [best, most] = [row, error];
    });
    return best;
  }

  /** The pair that is chosen when the selected one goes: the one below it, or above the last; null without one. */
  following(): Pair | null {
    const order = this.order.peek();
    const at = order.indexOf(this.store.selected.peek());
    const row = order[at + 1] ?? order[at - 1];
    return at < 0 || row === undefined ? null : (this.store.session.peek()?.pairs[row] ?? null);
  }

  pick(row: number): void {
    this.store.choose({ row });
    this.onPick(row);
  }

  private makeHead(): HTMLElement {
    const cells = COLUMNS.map(([key, words, title]) => {
      const button = make("button", { type: "button", title }, words);
      const cell = make("span", { role: "columnheader", class: `c-${key}` }, button);
      button.addEventListener("click", () => {
        const { key: before, down } = this.sort.value;
        this.sort.value = { key, down: before === key ? !down : key !== "row" };
      });
      effect(() => {
        const { key: by, down } = this.sort.value;
        cell.setAttribute("aria-sort", by !== key ? "none" : down ? "descending" : "ascending");
      });
      return cell;
    });
    return make("div", { class: "row head", role: "row" }, ...cells);
  }

  private makeFilters(): HTMLElement {
    const buttons = FILTERS.map(([name, words]) => {
      const button = make("button", { type: "button", class: "small" }, words);
      const { filter } = this.store;
      button.addEventListener("click", () => (filter.value = name));
      effect(() => button.setAttribute("aria-pressed", String(filter.value === name)));
      return button;
    });
    const group = { class: "filters", role: "group", "aria-label": "Which pairs" };
    return make("div", group, ...buttons);
  }

  /** The rows that pass the filter, in their order. */
  private arrange(): number[] {
    const session = this.store.session.value;
    if (!session) return [];
    const { key, down } = this.sort.value;
    const filter = this.store.filter.value;
    const rows = [...session.pairs.keys()].filter((row) => passes(session, row, filter));
    return sortRows(rows, key === "row" ? session.number : session[key], down);
  }

  private move(event: KeyboardEvent): void {
    const steps = { ArrowDown: 1, ArrowUp: -1, PageDown: PAGE, PageUp: -PAGE };
    const by = { ...steps, Home: -Infinity, End: Infinity }[event.key];
    const order = this.order.peek();
    if (by === undefined || !order.length) return;
    event.preventDefault();
    event.stopPropagation();
    const at = order.indexOf(this.store.selected.peek());
    const next = at < 0 && Number.isFinite(by) ? 0 : at + by;
    this.pick(order[Math.max(0, Math.min(order.length - 1, next))]!);
  }

  private scrollTo(at: number): void {
    if (at < 0 || !this.view.height) return;
    const top = at * ROW_PX;
    const most = this.view.top + this.view.height - 2 * ROW_PX;
    if (top < this.view.top) this.scroll.scrollTop = top;
    else if (top > most) this.scroll.scrollTop = this.view.top + top - most;
  }

  private render(): void {
    const [order, session] = [this.order.peek(), this.store.session.peek()];
    const selected = this.store.selected.peek();
    const { top, height } = this.view;
    const first = Math.max(0, Math.floor(top / ROW_PX) - SPARE);
    const last = Math.min(order.length, Math.ceil((top + height) / ROW_PX) + SPARE);
    const count = session ? Math.max(0, last - first) : 0;
    while (this.lines.length > count) this.lines.pop()!.root.remove();
    while (this.lines.length < count) {
      const line = new Line();
      this.lines.push(line);
      this.body.append(line.root);
    }
    this.lines.forEach((line, i) => line.show(session!, order[first + i]!, first + i, selected));
    const active = order.slice(first, first + count).includes(selected) && `pair-${selected}`;
    if (active) this.scroll.setAttribute("aria-activedescendant", active);
    else this.scroll.removeAttribute("aria-activedescendant");
  }
}

/** A row of the table, made once and filled again and again. */
class Line {
  private readonly texts = COLUMNS.map(() => document.createTextNode(""));
  private readonly dot = make("span", { class: "dot", "aria-hidden": "true" });
  private readonly cells = COLUMNS.map(([key], i) =>
    make(
      "span",
      { role: "gridcell", class: `c-${key}` },
      key === "residual" && this.dot,
      this.texts[i],
    ),
  );
  readonly root = make("div", { role: "row" }, ...this.cells);

  show(session: SessionState, row: number, at: number, selected: number): void {
    const [state, reason] = [session.state[row]!, session.reason[row]!];
    const error = session.residual[row];
    set(this.root, {
      class: `row ${state}${row === selected ? " chosen" : ""}`,
      id: `pair-${row}`,
      "data-row": String(row),
      "aria-rowindex": String(at + 2),
      "aria-selected": String(row === selected),
    });
    set(this.cells.at(-1)!, { title: reason });
    const weight = String(Number(session.weight[row]!.toFixed(3)));
    const errors = [px(error), px(session.leave_one_out[row])];
    [String(session.number[row]), ...errors, weight, STATES[state], reason].forEach((text, i) => {
      if (this.texts[i]!.data !== text) this.texts[i]!.data = text;
    });
    this.dot.style.background =
      state === "removed" ? "var(--line)" : errorColour(error, session.stop);
    this.root.style.top = `${at * ROW_PX}px`;
  }
}

/** Set attributes that differ: the others cost nothing. */
function set(element: HTMLElement, attributes: Record<string, string>): void {
  for (const [name, value] of Object.entries(attributes))
    if (element.getAttribute(name) !== value) element.setAttribute(name, value);
}
