// The pictures of a pair of cameras, and what a person does to pairs in them.
import type { Option } from "../shared/controls";
import type { Layer, Point } from "../shared/pane";
import { Stage, type Mode, type Wanted } from "../shared/stage";
import { watch } from "../shared/watch";
import { getJson } from "./api";
import { BandPicker } from "./bands";
import { invert, mapOf, turnAndScale, type PlaneMap } from "./maps";
import { paintHandle, paintPairs, paintProposal } from "./marks";
import { MarkedPane } from "./pane";
import type { Half, Pair, Partner } from "./record";
import type { Store } from "./store";
import { Trial } from "./trial";

export const MODES: Option<Mode>[] = [
  { value: "side", label: "Side by side" },
  { value: "curtain", label: "Curtain" },
  { value: "flicker", label: "Flicker" },
  { value: "difference", label: "Difference" },
  { value: "checker", label: "Checker" },
  { value: "redcyan", label: "Red / cyan" },
];
const TILE = 256;
const HIT_PX = 9; // of the screen
const MOVED_PX = 0.05; // a shorter drag is none
const CLOSE = 3; // screen pixels a pixel at which a pair is looked at

interface MapImage {
  image: HTMLImageElement;
  opacity: number;
}

/** A pair that is being dragged: as it is, and as it would be. */
interface Drag {
  from: Pair;
  to: Pair;
}

export class PairStage extends Stage<MarkedPane> {
  readonly bands = {
    left: new BandPicker("reference picture"),
    right: new BandPicker("picture to register"),
  };
  /** A map in colours over the reference. */
  private mapImage: MapImage | null = null;
  private readonly trial: Trial;
  private drag: Drag | null = null;

  constructor(
    host: HTMLElement,
    private readonly store: Store,
  ) {
    const { size, target_size } = store.frame.peek()!;
    super(
      host,
      new MarkedPane(host, "Reference picture", size),
      new MarkedPane(host, "Picture to register", target_size),
    );
    this.trial = new Trial(store, () => this.load());
    this.left.foot.append(this.bands.left.root);
    this.right.foot.append(this.bands.right.root);
    for (const [pane, half] of [
      [this.left, 0],
      [this.right, 2],
    ] as const) {
      pane.paint = (context) => this.paint(context, pane, half);
      pane.onClick = (...at) => void this.click(pane, half, at);
      pane.grab = (at) => this.grab(pane, half, at);
      pane.onDrag = (at, done) => this.dragTo(half, at, done);
      pane.viewer.addHandler("resize", () => requestAnimationFrame(() => this.link(this.left)));
    }
    watch([store.frame], () => this.offerBands());
    const { frame, session, map, selected, measured, proposal } = store;
    const bands = [this.bands.left.chosen, this.bands.right.chosen];
    watch([frame, session, map, selected, measured, proposal, ...bands], () => this.update());
  }

  private get map(): PlaneMap | null {
    const trace = this.store.session.peek()?.trace;
    return trace ? mapOf(trace, trace.largest.length) : null;
  }

  override setMode(mode: Mode): void {
    super.setMode(mode);
    // In an overlay both pictures are chosen under the one that is there.
    const { foot } = mode === "side" ? this.right : this.left;
    foot.append(this.right.label, this.bands.right.root);
  }

  override hold(on: boolean): void {
    if (this.mode.value !== "side") super.hold(on);
    else if (on) this.setMode("flicker");
  }

  /** Lay a map in colours over the reference, or take it away. */
  lay(map: MapImage | null): void {
    this.mapImage = map;
    this.left.redraw();
  }

  /** Do what a click into the middle of the reference does. */
  pointAtMiddle(): Promise<void> {
    return this.click(this.left, 0, this.left.centre);
  }

  /** Show a pair in the middle of both pictures. */
  flyTo(pair: Pair): void {
    const { map, right } = this;
    this.look(pair[0], pair[1], Math.max(this.heading[2], CLOSE));
    if (!map) right.look(pair[2], pair[3], Math.max(right.scale, CLOSE));
  }

  private offerBands(): void {
    const { bands, band, reference, camera, sensor } = this.store.frame.peek()!;
    this.bands.left.offer(reference.bands, reference.band);
    this.bands.right.offer(bands, band);
    this.left.label.textContent = `${reference.camera}, the reference`;
    this.right.label.textContent = [camera, sensor].filter(Boolean).join(" · ");
  }

  private update(): void {
    const proposed = this.store.proposal.peek()?.pair;
    if (!proposed && !this.drag) this.trial.end();
    else if (proposed && this.mode.peek() !== "side") void this.trial.ask(proposed, null);
    void this.load();
    this.left.redraw();
    this.right.redraw();
  }

  protected wanted(): Wanted | null {
    const [frame, session] = [this.store.frame.peek(), this.store.session.peek()];
    if (!frame || !session) return null;
    const map = this.store.map.peek();
    const version = map === "built" ? `built${frame.builds}` : session.drawn;
    const warped = this.trial.number ? `trial&v=${this.trial.number}` : `${map}&v=${version}`;
    const tint = (colour: string): string =>
      this.mode.peek() === "redcyan" ? `&tint=${colour}` : "";
    // What a browser kept of another day's server, at the same port, is not asked for again.
    const page = Math.round(performance.timeOrigin);
    const [ours, theirs] = [this.bands.left, this.bands.right].map(
      ({ query }) => `bands=${query}&page=${page}`,
    );
    const tiles = `${this.store.path}/tiles`;
    const left = [layerOf(`${tiles}/reference?${ours}${tint("red")}`, frame.size)];
    if (this.isOverlay)
      left.push(layerOf(`${tiles}/warped?map=${warped}&${theirs}${tint("cyan")}`, frame.size));
    const right = [layerOf(`${tiles}/target?${theirs}`, frame.target_size)];
    return { subject: frame.id, left, right };
  }

  /** Let the other picture show the same place, turned and scaled alike. */
  protected follow(leader: MarkedPane): void {
    const { map, left, right } = this;
    const frame = this.store.frame.peek();
    if (!map || !frame) return;
    if (leader === left) {
      const [width, height] = frame.target_size;
      const place = invert(map, left.centre, [width / 2, height / 2]);
      const { degrees, scale, mirrored } = turnAndScale(map, ...place);
      if (Number.isFinite(place[0]) && scale > 0)
        right.look(...place, left.scale * scale, mirrored ? 0 : degrees);
    } else {
      const { scale } = turnAndScale(map, ...right.centre);
      if (scale > 0) left.look(...map(...right.centre), right.scale / scale);
    }
    left.redraw();
    right.redraw();
  }

  /** Where the target's place of a pair lies in the reference's frame, by the map that is shown. */
  private seenAt(pair: Pair): Point {
    return this.map?.(pair[2], pair[3]) ?? [pair[0], pair[1]];
  }

  private grab(pane: MarkedPane, half: Half, [x, y]: Point): boolean {
    const pair = this.store.selectedPair();
    if (!pair) return false;
    const [a, b] = this.isOverlay ? this.seenAt(pair) : [pair[half], pair[half + 1]!];
    if (Math.hypot(a - x, b - y) * pane.scale >= HIT_PX) return false;
    this.drag = { from: pair, to: pair };
    return true;
  }

  private dragTo(half: Half, [x, y]: Point, done: boolean): void {
    if (!this.drag) return;
    const { from } = this.drag;
    const to: Pair = [...from];
    if (!this.isOverlay) [to[half], to[half + 1]] = [x, y];
    else if (this.map) [to[2], to[3]] = invert(this.map, [x, y], [from[2], from[3]]);
    if (done) {
      this.drag = null;
      this.trial.end();
      const far = to.some((value, i) => Math.abs(value - from[i]!) > MOVED_PX);
      if (far) void this.store.edit({ operation: "move", pair: from, to }, to);
      else this.update();
      return;
    }
    if (this.isOverlay) void this.trial.ask(from, to);
    this.drag = { from, to };
    this.left.redraw();
    this.right.redraw();
  }

  private async click(pane: MarkedPane, half: Half, [x, y]: Point): Promise<void> {
    const { store } = this;
    const pairs = store.session.peek()?.pairs ?? [];
    if (!pane.contains([x, y])) return;
    const beside = this.mode.peek() === "side";
    if (beside) {
      let [best, row] = [HIT_PX / pane.scale, -1];
      pairs.forEach((pair, i) => {
        const apart = Math.hypot(pair[half] - x, pair[half + 1]! - y);
        if (apart < best) [best, row] = [apart, i];
      });
      if (row >= 0) {
        store.choose({ row });
        return;
      }
      const proposal = store.proposal.peek();
      if (proposal && proposal.begun !== half) {
        const pair: Pair = [...proposal.pair];
        [pair[half], pair[half + 1]] = [x, y];
        const placed = { ...proposal, pair, predicted: pair, placed: true, sure: true };
        store.choose({ proposal: placed });
        return;
      }
    }
    const query = new URLSearchParams({
      x: x.toFixed(3),
      y: y.toFixed(3),
      from: half === 0 ? "reference" : "target",
      map: store.map.peek(),
      reference: this.bands.left.query,
      target: this.bands.right.query,
    });
    try {
      const partner = await getJson<Partner>(`${store.path}/partner?${query.toString()}`);
      store.refused.value = "";
      store.choose(beside ? { proposal: { ...partner, begun: half } } : { measured: partner });
    } catch (error) {
      store.refuse(error);
    }
  }

  private paint(context: CanvasRenderingContext2D, pane: MarkedPane, half: Half): void {
    const { frame, session, selected, proposal, measured } = this.store;
    if (!session.peek() || !frame.peek()) return;
    if (half === 0 && this.mapImage) this.paintMap(context, pane, frame.peek()!.size);
    const place: PlaneMap = (x, y) => pane.placeOf(x, y);
    if (!this.isOverlay || this.mapImage)
      paintPairs(context, pane.dots, {
        session: session.peek()!,
        selected: selected.peek(),
        half,
        place,
        map: this.map,
        scale: this.left.scale,
      });
    else {
      const pair = this.drag?.to ?? this.store.selectedPair();
      if (pair) paintHandle(context, place(pair[0], pair[1]), place(...this.seenAt(pair)));
    }
    const { drag } = this;
    const dragged = drag && !this.isOverlay && { pair: drag.to, predicted: drag.from, sure: true };
    const partner = dragged || (proposal.peek() ?? measured.peek());
    if (partner) paintProposal(context, partner, half, place);
  }

  private paintMap(context: CanvasRenderingContext2D, pane: MarkedPane, [w, h]: Point): void {
    const { image, opacity } = this.mapImage!;
    const [left, top] = pane.placeOf(-0.5, -0.5);
    const [right, bottom] = pane.placeOf(w - 0.5, h - 0.5);
    context.globalAlpha = opacity;
    context.drawImage(image, left, top, right - left, bottom - top);
    context.globalAlpha = 1;
  }
}

/** A picture by its address: tiles are asked for by level, column and row, level 0 in full size. */
function layerOf(address: string, size: Point): Layer {
  const maxLevel = Math.max(0, Math.ceil(Math.log2(Math.max(...size) / TILE)));
  const [path, query] = address.split("?");
  const getTileUrl = (level: number, x: number, y: number): string =>
    `${path}/${maxLevel - level}/${x}/${y}?${query}`;
  const source = { tileSize: TILE, tileOverlap: 0, minLevel: 0, maxLevel, getTileUrl };
  return { key: address, size, source };
}
