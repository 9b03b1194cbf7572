// The pictures: side by side and linked, or laid over one another in the reference's frame.
import OpenSeadragon from "openseadragon";
import { Curtain } from "../viewer/curtain";
import { Flicker } from "../viewer/flicker";
import { get, post } from "./api";
import { invert, mapOf, turnAndScale, type Map2 } from "./maps";
import { BandPicker } from "./bands";
import { Pane, type Layer } from "./pane";
import { paintHandle, paintPairs, paintProposal } from "./marks";
import type { Pair, Partner, Point } from "./record";
import type { Store } from "./store";

export type Mode = "side" | "curtain" | "flicker" | "difference" | "checker" | "redcyan";
export const MODES: [Mode, string][] = [
  ["side", "Side by side"],
  ["curtain", "Curtain"],
  ["flicker", "Flicker"],
  ["difference", "Difference"],
  ["checker", "Checker"],
  ["redcyan", "Red / cyan"],
];
const HIT = 9;
const SQUARES = 12;

interface Drawn {
  image: HTMLImageElement;
  opacity: number;
}

export class Stage {
  mode: Mode = "side";
  readonly left: Pane;
  readonly right: Pane;
  readonly flicker: Flicker;
  readonly curtain: Curtain;
  drawn: Drawn | null = null;
  readonly bands = { left: new BandPicker("reference picture"), right: new BandPicker("picture to register") };
  private shown = "";
  private offered = "";
  private trial = { number: 0, asked: null as [Pair, Pair | null] | null, busy: false };
  /** The picture that a person moved last: the other one goes after it. */
  private leader: Pane;
  private following = false;
  /** What the view turns to once a mode that was asked for is there: what was seen, or where a person went since. */
  private arrival: [number, number, number] | "fit" | null = null;
  private changes = 0;
  private moving: Pair | null = null;
  private dragged: Pair | null = null;

  constructor(private readonly host: HTMLElement, private readonly store: Store) {
    this.left = new Pane("Reference picture", store.frame!.size);
    this.right = new Pane("Picture to register", store.frame!.target_size);
    this.leader = this.left;
    host.append(this.left.host, this.right.host);
    this.flicker = new Flicker((shown) => this.layer?.setOpacity(shown === "b" ? 1 : 0));
    this.curtain = new Curtain(this.left.host, () => this.clip());
    this.left.foot.append(this.bands.left.root);
    this.right.foot.append(this.bands.right.root);
    this.wire();
    store.listen(() => this.update());
  }

  /** The upper layer of the overlay. */
  private get layer(): OpenSeadragon.TiledImage | null {
    return this.mode === "side" ? null : (this.left.layers[1] ?? null);
  }

  private get map(): Map2 | null {
    const trace = this.store.told?.trace;
    return trace ? mapOf(trace, trace.largest.length) : null;
  }

  /** Whether all that is in view has been drawn, in the mode that was asked for. */
  get settled(): boolean {
    return this.arrival === null && this.left.settled && (this.mode !== "side" || this.right.settled);
  }

  setMode(mode: Mode): void {
    const first = this.shown === "" || this.left.isFitted;
    this.arrival ??= first ? "fit" : this.left.aim;
    const mine = ++this.changes;
    this.mode = mode;
    this.host.dataset["mode"] = mode;
    this.right.host.hidden = mode !== "side";
    this.flicker.stop();
    this.curtain.shown = mode === "curtain";
    // In an overlay both pictures are chosen under the one that is there.
    const foot = mode === "side" ? this.right.foot : this.left.foot;
    foot.append(this.right.label, this.bands.right.root);
    void this.load().finally(() => requestAnimationFrame(() => this.arrive(mine)));
  }

  /** Take the view over once the panes know their new sizes, some frames later; but the last mode only. */
  private arrive(change: number, frames = 60): void {
    if (change !== this.changes) return;
    const panes = this.mode === "side" ? [this.left, this.right] : [this.left];
    for (const pane of panes) pane.viewer.forceResize();
    if (frames > 0 && !panes.every((pane) => pane.isSized)) {
      requestAnimationFrame(() => this.arrive(change, frames - 1));
      return;
    }
    if (this.arrival === "fit") this.left.fit();
    else if (this.arrival) this.left.look(...this.arrival);
    this.arrival = null;
    this.follow(this.left);
  }

  /** Where the view goes: place and scale. */
  private get heading(): [number, number, number] {
    return Array.isArray(this.arrival) ? this.arrival : this.left.aim;
  }

  /** Move the view, also while another mode is on its way. */
  private lead(x: number, y: number, scale: number): void {
    this.leader = this.left;
    this.left.look(x, y, scale);
    if (this.arrival) this.arrival = [x, y, scale];
  }

  /** Hold a key to flicker, whatever the mode. */
  hold(on: boolean): void {
    if (this.mode === "side") {
      if (on) this.setMode("flicker");
      return;
    }
    if (on) this.flicker.start();
    else if (this.mode !== "flicker") {
      this.flicker.stop();
      this.blend();
    }
  }

  /** Do what a click into the middle of the reference does. */
  pointAtMiddle(): Promise<void> {
    return this.click(this.left, 0, ...this.left.centre);
  }

  /** Move both pictures by a part of the view. */
  pan(dx: number, dy: number): void {
    const [x, y, scale] = this.heading;
    const by = (0.15 * this.left.host.clientHeight) / scale;
    this.lead(x + by * dx, y + by * dy, scale);
    this.follow(this.left);
  }

  zoom(factor: number): void {
    this.leader = this.left;
    const [x, y, scale] = this.heading;
    if (this.arrival) this.lead(x, y, scale * factor);
    else this.left.zoom(factor);
  }

  fit(): void {
    this.leader = this.left;
    this.left.fit();
    if (this.arrival) this.arrival = "fit";
  }

  /** Show the band before or after in one of the pictures. */
  stepBand(side: "left" | "right", by: number): void {
    this.bands[side].step(by);
  }

  update(): void {
    const { frame, proposal } = this.store;
    if (frame && this.offered !== frame.id) {
      this.offered = frame.id;
      this.bands.left.offer(frame.reference.bands, frame.reference.band);
      this.bands.right.offer(frame.bands, frame.band);
      this.left.name = `${frame.reference.camera}, the reference`;
      this.right.name = [frame.camera, frame.sensor].filter(Boolean).join(" · ");
    }
    if (!proposal && !this.moving) this.trial.number = 0;
    else if (proposal && this.mode !== "side") void this.attempt(proposal.pair, null);
    void this.load();
    this.left.redraw();
    this.right.redraw();
  }

  /** Load what the mode needs; nothing where it is there already. */
  private async load(): Promise<void> {
    const { frame, told, map } = this.store;
    if (!frame || !told) return;
    const tiles = `${this.store.path}/tiles`;
    const { number } = this.trial;
    const warped = number ? `map=trial&v=${number}` : `map=${map}&v=${map === "built" ? `built${frame.builds}` : told.drawn}`;
    const tint = this.mode === "redcyan";
    // What a browser kept of another day's server, at the same port, is not asked for again.
    const [ours, theirs] = [this.bands.left, this.bands.right].map((bands) => `bands=${bands.query}&page=${Math.round(performance.timeOrigin)}`);
    const wanted: Layer[] = [{ address: `${tiles}/reference?${ours}${tint ? "&tint=red" : ""}`, size: frame.size }];
    if (this.mode !== "side") wanted.push({ address: `${tiles}/warped?${warped}&${theirs}${tint ? "&tint=cyan" : ""}`, size: frame.size });
    const target: Layer = { address: `${tiles}/target?${theirs}`, size: frame.target_size };
    const key = JSON.stringify([frame.id, wanted, target]);
    if (this.shown !== key) {
      const fresh = this.shown === "" || !this.shown.includes(frame.id);
      this.shown = key;
      await Promise.all([this.left.show(wanted, !fresh), this.right.show([target], !fresh)]);
      if (fresh) {
        this.right.fit();
        this.left.fit();
        this.follow(this.left);
      }
    }
    this.blend();
  }

  private blend(): void {
    const layer = this.layer;
    if (!layer) return;
    const ways: Partial<Record<Mode, string>> = { difference: "difference", redcyan: "lighter" };
    layer.setCompositeOperation(ways[this.mode] ?? "source-over");
    layer.setOpacity(1);
    this.left.viewer.drawer.canvas.style.filter = this.mode === "difference" ? "brightness(3)" : "";
    if (this.mode === "checker") layer.setCroppingPolygons(this.squares());
    else layer.resetCroppingPolygons();
    this.clip();
    if (this.mode === "flicker") this.flicker.start();
    this.left.viewer.forceRedraw();
  }

  private squares(): OpenSeadragon.Point[][] {
    const [width, height] = this.store.frame!.size;
    const side = Math.max(width, height) / SQUARES;
    const made: OpenSeadragon.Point[][] = [];
    for (let row = 0; row * side < height; row++)
      for (let column = row % 2; column * side < width; column += 2) {
        const [x, y] = [column * side, row * side];
        made.push([[x, y], [x + side, y], [x + side, y + side], [x, y + side]].map(([a, b]) => new OpenSeadragon.Point(Math.min(a!, width), Math.min(b!, height))));
      }
    return made;
  }

  private clip(): void {
    const layer = this.layer;
    if (!layer) return;
    const [width, height] = this.store.frame!.size;
    if (this.mode !== "curtain") {
      if (layer.getClip()) layer.setClip(null);
      return;
    }
    const box = this.left.host.getBoundingClientRect();
    const [x] = this.left.pixelAt(box.left + this.curtain.fraction * box.width, box.top);
    const from = Math.min(Math.max(x + 0.5, 0), width - 1e-3);
    layer.setClip(new OpenSeadragon.Rect(from, 0, width - from, height));
  }

  /** Let the other picture show the same place, turned and scaled alike. */
  private follow(leader: Pane): void {
    const map = this.map;
    if (this.mode !== "side" || this.following || !map || !this.store.frame) return;
    if (!this.left.isSized || !this.right.isSized) return;
    this.following = true;
    const [w, h] = this.store.frame.target_size;
    if (leader === this.left) {
      const place = invert(map, this.left.centre, [w / 2, h / 2]);
      const { degrees, scale, mirrored } = turnAndScale(map, ...place);
      if (Number.isFinite(place[0]) && scale > 0) this.right.look(...place, this.left.scale * scale, mirrored ? 0 : degrees);
    } else {
      const place = this.right.centre;
      const { scale } = turnAndScale(map, ...place);
      if (scale > 0) this.left.look(...map(...place), this.right.scale / scale);
    }
    this.following = false;
    this.left.redraw();
    this.right.redraw();
  }

  /** Show a pair in the middle of both pictures. */
  flyTo(pair: Pair): void {
    this.lead(pair[0], pair[1], Math.max(this.heading[2], 3));
    if (!this.map) this.right.look(pair[2], pair[3], Math.max(this.right.scale, 3));
    this.follow(this.left);
  }

  private wire(): void {
    this.left.onView = () => {
      this.clip();
      if (this.leader === this.left) this.follow(this.left);
    };
    this.right.onView = () => this.leader === this.right && this.follow(this.right);
    for (const pane of [this.left, this.right]) pane.viewer.addHandler("resize", () => requestAnimationFrame(() => this.follow(this.left)));
    for (const picker of [this.bands.left, this.bands.right]) picker.onChange = () => void this.load();
    for (const [pane, part] of [[this.left, 0], [this.right, 2]] as const) {
      pane.onGesture = () => {
        [this.leader, this.arrival] = [pane, null];
      };
      pane.paint = (context) => this.paint(context, pane, part);
      pane.onClick = (x, y) => void this.click(pane, part, x, y);
      pane.grab = (x, y) => {
        const pair = this.store.pair(this.store.selected);
        const at: Point = pair && this.mode !== "side" ? this.seenAt(pair) : [pair?.[part] ?? NaN, pair?.[part + 1] ?? NaN];
        const near = pair !== null && this.isNear(pane, at, [x, y]);
        this.moving = near ? pair : null;
        return near;
      };
      pane.onDrag = (x, y, done) => this.drag(part, x, y, done);
    }
  }

  /** The chosen pair in an overlay: both of its places lie in one picture. */
  private paintChosen(context: CanvasRenderingContext2D, place: (x: number, y: number) => Point): void {
    const pair = this.dragged ?? this.store.pair(this.store.selected);
    if (pair) paintHandle(context, place(pair[0], pair[1]), place(...this.seenAt(pair)));
  }

  private isNear(pane: Pane, a: Point, b: Point): boolean {
    return Math.hypot(a[0] - b[0], a[1] - b[1]) * pane.scale < HIT;
  }

  /** Let the overlay show at once what the map would be if a pair lay there; one question at a time, the newest. */
  private async attempt(pair: Pair, to: Pair | null): Promise<void> {
    this.trial.asked = [pair, to];
    if (this.trial.busy) return;
    this.trial.busy = true;
    try {
      while (this.trial.asked) {
        const [from, there] = this.trial.asked;
        this.trial.asked = null;
        const told = await post<{ trial: number }>(`${this.store.path}/attempt`, { pair: from, to: there });
        if (!this.moving && !this.store.proposal) continue;
        this.trial.number = told.trial;
        await this.load();
      }
    } catch (error) {
      this.store.refuse(error);
    }
    this.trial.busy = false;
  }

  /** Where the target's place of a pair lies in the reference's frame, by the map that is shown. */
  private seenAt(pair: Pair): Point {
    return this.map?.(pair[2], pair[3]) ?? [pair[0], pair[1]];
  }

  private drag(part: 0 | 2, x: number, y: number, done: boolean): void {
    if (!this.moving) return;
    const to = [...this.moving] as Pair;
    if (this.mode === "side") [to[part], to[part + 1]] = [x, y];
    else if (this.map) [to[2], to[3]] = invert(this.map, [x, y], [this.moving[2], this.moving[3]]);
    part = this.mode === "side" ? part : 2;
    const far = Math.max(Math.abs(to[part] - this.moving[part]), Math.abs(to[part + 1]! - this.moving[part + 1]!)) > 0.05;
    if (done) {
      const from = this.moving;
      [this.moving, this.dragged] = [null, null];
      this.trial.number = 0;
      if (far) void this.store.edit({ operation: "move", pair: from, to }, to);
      else this.update();
      return;
    }
    if (this.mode !== "side") void this.attempt(this.moving, to);
    this.dragged = to;
    this.left.redraw();
    this.right.redraw();
  }

  private async click(pane: Pane, part: 0 | 2, x: number, y: number): Promise<void> {
    const { told, frame } = this.store;
    if (!told || !frame) return;
    const size = part === 0 ? frame.size : frame.target_size;
    if (x < -0.5 || y < -0.5 || x > size[0] - 0.5 || y > size[1] - 0.5) return;
    if (this.mode === "side") {
      let [best, row] = [HIT / pane.scale, -1];
      told.pairs.forEach((pair, i) => {
        const apart = Math.hypot(pair[part] - x, pair[part + 1]! - y);
        if (apart < best) [best, row] = [apart, i];
      });
      if (row >= 0) return this.store.select(row);
    }
    const { proposal } = this.store;
    if (this.mode === "side" && proposal && this.store.begun !== part) {
      const pair = [...proposal.pair] as Pair;
      [pair[part], pair[part + 1]] = [x, y];
      this.store.proposal = { ...proposal, pair, predicted: pair, score: -1, sure: true };
      return this.store.changed();
    }
    try {
      const from = part === 0 ? "reference" : "target";
      const bands = `reference=${this.bands.left.query}&target=${this.bands.right.query}`;
      const asked = `${this.store.path}/partner?x=${x.toFixed(3)}&y=${y.toFixed(3)}&from=${from}&map=${this.store.map}&${bands}`;
      const partner = await get<Partner>(asked);
      this.store.refused = "";
      [this.store.proposal, this.store.measured] = this.mode === "side" ? [partner, null] : [null, partner];
      [this.store.selected, this.store.begun] = [-1, part];
      this.store.changed();
    } catch (error) {
      this.store.refuse(error);
    }
  }

  private paint(context: CanvasRenderingContext2D, pane: Pane, part: 0 | 2): void {
    const { told, selected, proposal, measured } = this.store;
    if (!told || !this.store.frame) return;
    if (part === 0 && this.drawn) {
      const [w, h] = this.store.frame.size;
      const [x0, y0] = pane.placeOf(-0.5, -0.5);
      const [x1, y1] = pane.placeOf(w - 0.5, h - 0.5);
      context.globalAlpha = this.drawn.opacity;
      context.drawImage(this.drawn.image, x0, y0, x1 - x0, y1 - y0);
      context.globalAlpha = 1;
    }
    const place = (x: number, y: number): Point => pane.placeOf(x, y);
    if (this.mode === "side" || this.drawn) paintPairs(context, pane.dots, told, selected, part, place, this.map, this.left.scale);
    else if (part === 0) this.paintChosen(context, place);
    const held = this.dragged && this.mode === "side" ? { pair: this.dragged, predicted: this.moving ?? this.dragged, sure: true } : null;
    const partner = held ?? proposal ?? measured;
    if (partner) paintProposal(context, partner, part, place);
  }
}
