// The outline of the object, drawn and corrected over the reference.
import { effect, signal } from "@preact/signals-core";
import { make, refill } from "../shared/element";
import type { Point } from "../shared/pane";
import { watch } from "../shared/watch";
import type { Store } from "./store";

const HIT_PX = 9; // of the screen
const MOVED_PX = 0.05; // a shorter drag is none
const LEAST = 3; // corners of an outline

const DRAWING =
  "Click the corners in order round the object; click the first one, or press Enter, to close the outline.";
const CORRECTING =
  "Drag a corner; click a side to add one; Del takes the chosen one out, arrows move it by 1 px, with Shift by 10 px.";
const MEANING =
  "What lies outside is not compared and counts as not checked. All cameras of this object have one outline.";

/** Clicks, drags and keys that are of the outline while it is open, and the card that says so. */
export class OutlineTool {
  /** Whether the outline is open for changes. */
  readonly open = signal(false);
  /** Corners that are drawn one after the other; null where the outline is closed. */
  readonly draft = signal<Point[] | null>(null);
  /** The chosen corner, -1 for none. */
  readonly chosen = signal(-1);
  /** The outline as it is dragged or on its way to edits.toml; null where it is as saved. */
  private readonly moving = signal<Point[] | null>(null);
  private held: { row: number; by: Point } | null = null;
  private readonly text = make("div", { "aria-live": "polite" });
  private readonly actions = make("div", { class: "actions" });
  readonly root = make(
    "section",
    { class: "card outline", "aria-labelledby": "outline-head", hidden: true },
    make("h2", { id: "outline-head" }, "Outline of the object"),
    this.text,
    this.actions,
  );

  constructor(private readonly store: Store) {
    watch([store.frame], () => this.close());
    effect(() => {
      this.root.hidden = !this.open.value;
      if (this.open.value) this.describe();
    });
  }

  /** Corners as they are shown, reference px. */
  get corners(): readonly Point[] {
    return this.draft.value ?? this.moving.value ?? this.store.outline.value;
  }

  toggle(): void {
    if (this.open.peek()) this.close();
    else {
      this.store.choose({});
      this.chosen.value = -1;
      this.draft.value = this.store.outline.peek().length ? null : [];
      this.open.value = true;
    }
  }

  private close(): void {
    this.held = null;
    [this.draft.value, this.moving.value, this.chosen.value] = [null, null, -1];
    this.open.value = false;
  }

  /** Take hold of the corner at a place; whether there is one. */
  grab(at: Point, scale: number): boolean {
    const row = cornerAt(this.corners, at, HIT_PX / scale);
    if (row < 0) return false;
    const [x, y] = this.corners[row]!;
    this.held = { row, by: [x - at[0], y - at[1]] };
    return true;
  }

  /** Bring the corner that is held to a place, and let go of it there. */
  drag([x, y]: Point, done: boolean, dragged: boolean): void {
    if (!this.held) return;
    const { row, by } = this.held;
    if (done) this.held = null;
    this.chosen.value = row;
    if (!dragged) return;
    const moved = replaced(this.corners, row, [this.within([x + by[0], y + by[1]])]);
    if (this.draft.peek()) this.draft.value = moved;
    else if (done) void this.save(moved);
    else this.moving.value = moved;
  }

  click(at: Point, scale: number): void {
    const { corners } = this;
    const reach = HIT_PX / scale;
    const row = cornerAt(corners, at, reach);
    if (this.draft.peek()) {
      if (row === 0 && corners.length >= LEAST) this.finish();
      else if (row < 0) this.add(at);
      else this.chosen.value = row;
      return;
    }
    const side = row < 0 ? sideAt(corners, at, reach) : -1;
    if (side >= 0) this.add(at, side);
    else this.chosen.value = row;
  }

  /** Add a corner: the next one of a drawing, or into a side of a closed outline, the nearest unless it is named. */
  add(at: Point, side = sideAt(this.corners, at, Infinity)): void {
    const row = this.draft.peek() ? this.corners.length : side + 1;
    const more = replaced(this.corners, row, [this.within(at)], 0);
    if (this.draft.peek()) this.draft.value = more;
    else void this.save(more);
    this.chosen.value = row;
  }

  /** Take the chosen corner out, or the last one that was drawn. */
  remove(): void {
    const { corners } = this;
    const row =
      this.chosen.peek() < 0 && this.draft.peek() ? corners.length - 1 : this.chosen.peek();
    if (row < 0 || (!this.draft.peek() && corners.length <= LEAST)) return;
    const fewer = replaced(corners, row, []);
    this.chosen.value = -1;
    if (this.draft.peek()) this.draft.value = fewer;
    else void this.save(fewer);
  }

  /** Move the chosen corner by px of the reference; whether there is one. */
  nudge(dx: number, dy: number): boolean {
    const corner = this.corners[this.chosen.peek()];
    if (!corner) return false;
    this.put([corner[0] + dx, corner[1] + dy]);
    return true;
  }

  /** Close what is drawn, and save it. */
  finish(): void {
    const corners = this.draft.peek();
    if (corners && corners.length >= LEAST) void this.save(corners);
  }

  /** Give a drawing up, or end the correction. */
  cancel(): void {
    if (this.draft.peek()?.length && this.store.outline.peek().length) this.draft.value = null;
    else if (this.draft.peek()?.length) this.draft.value = [];
    else this.close();
    this.chosen.value = -1;
  }

  private put(to: Point): void {
    const moved = replaced(this.corners, this.chosen.peek(), [this.within(to)]);
    if (this.draft.peek()) this.draft.value = moved;
    else void this.save(moved);
  }

  /** Save corners; a drawing stays open where they are refused, a correction is taken back. */
  private async save(corners: readonly Point[]): Promise<void> {
    const now = this.store.outline.peek();
    const isSame = corners.length === now.length && corners.every((c, i) => isNear(c, now[i]!));
    if (isSame) {
      [this.draft.value, this.moving.value] = [null, null];
      return;
    }
    if (!this.draft.peek()) this.moving.value = [...corners];
    await this.store.edit({ operation: "outline", corners });
    this.moving.value = null;
    if (!this.store.refused.peek()) this.draft.value = corners.length ? null : [];
  }

  /** The place of the frame that is nearest. */
  private within([x, y]: Point): Point {
    const [width, height] = this.store.frame.peek()!.size;
    const clamp = (at: number, size: number): number => Math.min(size - 0.5, Math.max(-0.5, at));
    return [round(clamp(x, width)), round(clamp(y, height))];
  }

  private describe(): void {
    const [frame, session] = [this.store.frame.value, this.store.session.value];
    if (!frame || !session) return;
    const [draft, chosen, corners] = [this.draft.value, this.chosen.value, this.corners];
    const corner = corners[chosen];
    refill(
      this.text,
      make("p", { id: "outline-state" }, draft ? this.drawn(draft) : this.origin(corners)),
      make("p", { class: "soft" }, draft ? DRAWING : CORRECTING),
      corner && coordinates(corner, (to) => this.put(to)),
      make("p", { class: "soft" }, MEANING),
    );
    const button = (id: string, words: string, title: string, act: () => void): HTMLElement => {
      const made = make("button", { type: "button", id: `outline-${id}`, title }, words);
      made.addEventListener("click", act);
      return made;
    };
    refill(
      this.actions,
      draft &&
        draft.length >= LEAST &&
        button("finish", "Close the outline", "Enter", () => this.finish()),
      !draft &&
        button("anew", "Draw anew", "Click all corners again", () => {
          [this.draft.value, this.chosen.value] = [[], -1];
        }),
      session.outline.length > 0 &&
        button(
          "remove",
          "Remove",
          "As campaign.toml declares it, or as it is found on an even ground",
          () => void this.save([]),
        ),
      button("done", "Done", "Back to the pairs (Esc)", () => this.close()),
    );
  }

  private drawn({ length }: Point[]): string {
    return `${length} ${length === 1 ? "corner" : "corners"} drawn.`;
  }

  private origin({ length }: readonly Point[]): string {
    const [frame, session] = [this.store.frame.value!, this.store.session.value!];
    if (session.outline.length) return `${length} corners, drawn by hand. Saved in edits.toml.`;
    if (frame.declared_outline.length) return `${length} corners, as campaign.toml declares it.`;
    return `${length} corners, as it was found on an even ground.`;
  }
}

/** The corner nearest to a place, at most `reach` px away; -1 where there is none. */
export function cornerAt(corners: readonly Point[], [x, y]: Point, reach: number): number {
  let [best, row] = [reach, -1];
  corners.forEach((corner, i) => {
    const apart = Math.hypot(corner[0] - x, corner[1] - y);
    if (apart < best) [best, row] = [apart, i];
  });
  return row;
}

/** The side nearest to a place, by its first corner, at most `reach` px away; -1 where there is none. */
export function sideAt(corners: readonly Point[], [x, y]: Point, reach: number): number {
  let [best, side] = [reach, -1];
  corners.forEach(([ax, ay], i) => {
    const [bx, by] = corners[(i + 1) % corners.length]!;
    const [dx, dy] = [bx - ax, by - ay];
    const along = ((x - ax) * dx + (y - ay) * dy) / (dx * dx + dy * dy || 1);
    const t = Math.min(1, Math.max(0, along));
    const apart = Math.hypot(ax + t * dx - x, ay + t * dy - y);
    if (apart < best) [best, side] = [apart, i];
  });
  return side;
}

/** Corners with `gone` of them, from `row` on, replaced by others. */
function replaced(corners: readonly Point[], row: number, by: Point[], gone = 1): Point[] {
  return [...corners.slice(0, row), ...by, ...corners.slice(row + gone)];
}

function isNear(a: Point, b: Point): boolean {
  return Math.hypot(a[0] - b[0], a[1] - b[1]) < MOVED_PX;
}

function round(value: number): number {
  return Math.round(100 * value) / 100;
}

/** Two numbers that can be typed over. */
function coordinates(corner: Point, set: (to: Point) => void): HTMLElement {
  const labels = ["x", "y"].map((name, i) => {
    const value = corner[i]!.toFixed(2);
    const input = make("input", { type: "number", step: 1, value, id: `outline-at-${i}` });
    input.addEventListener("change", () => {
      const to: Point = [...corner];
      to[i] = input.valueAsNumber;
      if (Number.isFinite(to[i])) set(to);
      else input.value = value;
    });
    return make("label", {}, make("span", { class: "soft" }, `Corner ${name}`), input);
  });
  const facts = { class: "coordinates", role: "group", "aria-label": "Chosen corner, px" };
  return make("div", facts, ...labels);
}
