// What a click or a key in a picture does to pairs: choose one, begin one, place its other end, measure.
import type { Point } from "../shared/pane";
import type { Mode } from "../shared/stage";
import type { Signal } from "@preact/signals-core";
import { getJson } from "./api";
import type { BandPicker } from "./bands";
import { isFound } from "./pair";
import type { MarkedPane } from "./pane";
import type { OutlineTool } from "./outline";
import { isMarked, type Half, type Pair, type Partner } from "./record";
import type { Store } from "./store";

export const HIT_PX = 9; // of the screen

/** What it knows of the stage. */
interface Pictures {
  readonly left: MarkedPane;
  readonly right: MarkedPane;
  readonly focused: MarkedPane;
  readonly isLoose: boolean;
  readonly bands: Record<"left" | "right", BandPicker>;
  readonly outline: OutlineTool;
  readonly marks: Signal<boolean>;
  readonly mode: Signal<Mode>;
}

export class Placing {
  constructor(
    private readonly store: Store,
    private readonly stage: Pictures,
  ) {}

  /** Begin a pair in the middle of the picture with the focus, or put its other end there. */
  async insertAtMiddle(): Promise<void> {
    const { left, right, focused } = this.stage;
    const half = focused === left ? 0 : 2;
    if (this.store.frame.peek()?.is_reference || this.placePartner(half, focused.centre)) return;
    await this.findPartner(half, focused.centre, true);
    if (this.stage.isLoose && this.isSought) (half ? left : right).viewer.canvas.focus();
  }

  /** Without a map the next pair begins in the reference. */
  goOn(): void {
    const { left, right, focused, isLoose } = this.stage;
    if (isLoose && focused === right) left.viewer.canvas.focus();
  }

  /** Whether the other end of the pair that is proposed is still to be placed. */
  get isSought(): boolean {
    const proposal = this.store.proposal.peek();
    return proposal !== null && !isFound(proposal);
  }

  /** Measure how far off the pictures are in the middle of the reference. */
  measureAtMiddle(): Promise<void> {
    return this.findPartner(0, this.stage.left.centre, false);
  }

  async click(pane: MarkedPane, half: Half, at: Point): Promise<void> {
    const { store, stage } = this;
    if (stage.outline.open.peek()) {
      if (half === 0) stage.outline.click(at, pane.scale);
      return;
    }
    if (!store.session.peek() || !pane.contains(at) || store.frame.peek()?.is_reference) return;
    const beside = stage.mode.peek() === "side";
    const row = beside ? this.rowAt(half, at, HIT_PX / pane.scale) : -1;
    if (row >= 0) store.choose({ row });
    else if (!beside || !this.placePartner(half, at)) await this.findPartner(half, at, beside);
  }

  /** The pair whose mark lies nearest within reach; -1 for none. */
  private rowAt(half: Half, [x, y]: Point, reach: number): number {
    if (!this.stage.marks.peek()) return -1;
    let [best, at] = [reach, -1];
    const [session, filter] = [this.store.session.peek()!, this.store.filter.peek()];
    session.pairs.forEach((pair, row) => {
      const apart = Math.hypot(pair[half] - x, pair[half + 1]! - y);
      if (apart < best && isMarked(session, row, filter)) [best, at] = [apart, row];
    });
    return at;
  }

  /** Put the other end of the pair that is proposed; whether there is one. */
  private placePartner(half: Half, [x, y]: Point): boolean {
    const proposal = this.store.proposal.peek();
    if (!proposal || proposal.begun === half) return false;
    const pair: Pair = [...proposal.pair];
    [pair[half], pair[half + 1]] = [x, y];
    const placed = { ...proposal, pair, predicted: pair, placed: true, sure: true };
    this.store.choose({ proposal: placed });
    return true;
  }

  /** Find the partner of a place, and propose the pair or show how far off it is. */
  private async findPartner(half: Half, [x, y]: Point, proposes: boolean): Promise<void> {
    const { store } = this;
    const { left, right } = this.stage.bands;
    const query = new URLSearchParams({
      x: x.toFixed(3),
      y: y.toFixed(3),
      from: half === 0 ? "reference" : "target",
      map: store.map.peek(),
      reference: left.query,
      target: right.query,
    });
    try {
      const partner = await getJson<Partner>(`${store.path}/partner?${query.toString()}`);
      store.refused.value = "";
      store.choose(proposes ? { proposal: { ...partner, begun: half } } : { measured: partner });
    } catch (error) {
      store.refuse(error);
    }
  }
}
