// Which marks are shown where they are many: the worst of each spot, until one zooms in.
import { make } from "../shared/element";
import { isMarked, type Filter, type SessionState } from "./record";

const CELL_PX = 22; // of the screen, in which one mark is shown

/** Which marks are shown, by row, how many these are, and of how many. */
export interface Thinned {
  shown: Uint8Array;
  count: number;
  all: number;
}

export class Thinning {
  /** Says how many marks are shown of those that there are, where that is not all. */
  readonly label = make("span", {
    class: "label",
    title: "Of many marks in one spot the worst is shown; zoom in for the others",
    hidden: true,
  });
  private last: (Thinned & { session: SessionState; filter: Filter; octave: number }) | null = null;

  /** The marks of a session, at `scale` screen pixels a pixel of the reference. */
  of(session: SessionState, filter: Filter, scale: number): Thinned {
    const [last, octave] = [this.last, Math.round(Math.log2(scale))];
    if (last?.session === session && last.filter === filter && last.octave === octave) return last;
    const found = thinned(session, filter, 2 ** octave);
    this.label.textContent = `${found.count} of ${found.all} marks`;
    this.last = { session, filter, octave, ...found };
    return found;
  }
}

/** Leave marks out where they are many: of those in one spot all but the worst, and none that a person set. */
export function thinned(session: SessionState, filter: Filter, scale: number): Thinned {
  const { pairs, residual, state, hand } = session;
  const shown = new Uint8Array(pairs.length);
  const side = 2 ** Math.round(Math.log2(CELL_PX / scale)); // the same cells wherever one pans
  const worst = new Map<string, number>();
  let [set, all] = [0, 0];
  pairs.forEach(([x, y], row) => {
    if (!isMarked(session, row, filter)) return;
    all++;
    if (state[row] === "check" || hand[row] !== "") {
      shown[row] = 1;
      set++;
      return;
    }
    const cell = `${Math.floor(x / side)},${Math.floor(y / side)}`;
    const other = worst.get(cell);
    if (other === undefined || residual[row]! > residual[other]!) worst.set(cell, row);
  });
  for (const row of worst.values()) shown[row] = 1;
  return { shown, count: set + worst.size, all };
}
