// The pictures of a pair of cameras, and what a person does to pairs in them.
import type { Option } from "../shared/controls";
import type { Point } from "../shared/pane";
import { PAN_STEP, Stage, type Mode, type Wanted } from "../shared/stage";
import { make } from "../shared/element";
import { watch } from "../shared/watch";
import { effect, signal } from "@preact/signals-core";
import { layerOf } from "./api";
import { BandPicker } from "./bands";
import { LoupePair, type LoupeScene } from "./loupe";
import { invert, mapOf, turnAndScale, type PlaneMap } from "./maps";
import { paintHandle, paintOutline, paintPairs, paintProposal } from "./marks";
import { OutlineTool } from "./outline";
import { MarkedPane } from "./pane";
import type { Half, Pair } from "./record";
import type { Store } from "./store";
import { HIT_PX, Placing } from "./placing";

export const MODES: Option<Mode>[] = [
  { value: "side", label: "Side by side" },
  { value: "curtain", label: "Curtain" },
  { value: "flicker", label: "Flicker" },
  { value: "difference", label: "Difference" },
  { value: "checker", label: "Checker" },
];
const MOVED_PX = 0.05; // a shorter drag is none
const CLOSE = 3; // screen pixels a pixel at which a pair is looked at
const TURNED_LEAST = 1; // degrees that a new map turns the other picture before that is shown

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
  readonly outline: OutlineTool;
  readonly placing: Placing;
  private drag: Drag | null = null;
  /** By how many degrees the picture to register is turned by itself, of each that has no map yet. */
  private readonly alone = new Map<string, number>();
  /** Whether pairs are drawn over the pictures. */
  readonly marks = signal(true);
  readonly loupes = new LoupePair(() => this.enlarged());

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
    this.outline = new OutlineTool(store);
    this.placing = new Placing(store, this);
    this.left.foot.append(this.bands.left.root);
    this.right.foot.append(this.bands.right.root, this.turnButton());
    this.left.host.append(this.loupes.left.root);
    this.right.host.append(this.loupes.right.root);
    for (const [pane, half] of [
      [this.left, 0],
      [this.right, 2],
    ] as const) {
      pane.paint = (context) => this.paint(context, pane, half);
      pane.onClick = (...at) => void this.placing.click(pane, half, at);
      pane.grab = (at) => this.grab(pane, half, at);
      pane.onDrag = (...how) => {
        if (this.outline.open.peek()) this.outline.drag(...how);
        else this.dragTo(half, how[0], how[1]);
      };
      pane.onPoint = (at) => this.loupes.point(at && { half, at });
      pane.viewer.addHandler("resize", () => requestAnimationFrame(() => this.link(this.left)));
    }
    watch([store.frame], () => this.offerBands());
    watch([store.frame], () => this.turnTo(store.frame.value?.turn ?? 0));
    const { frame, session, map, selected, measured, proposal } = store;
    const bands = [this.bands.left.chosen, this.bands.right.chosen];
    watch([frame, session, map, selected, measured, proposal, ...bands], () => this.update());
    effect(() => {
      const { corners, open, chosen } = this.outline;
      this.left.host.classList.toggle("drawing", open.value);
      if (corners.length + chosen.value > -2) this.left.redraw();
    });
    watch([this.marks, this.loupes.use, store.filter], () => {
      this.left.redraw();
      this.right.redraw();
      this.loupes.redraw();
    });
  }

  private get map(): PlaneMap | null {
    const map = this.store.session.peek()?.map;
    return map ? mapOf(map) : null;
  }

  override setMode(mode: Mode): void {
    super.setMode(mode);
    // In an overlay both pictures are chosen under the one that is there.
    const { foot } = mode === "side" ? this.right : this.left;
    foot.append(this.right.label, this.bands.right.root);
    (mode === "side" ? this.right : this.left).host.append(this.loupes.right.root);
  }

  protected override onView(): void {
    this.loupes.redraw();
  }

  override hold(on: boolean): void {
    if (this.mode.value !== "side") super.hold(on);
    else if (on) this.setMode("flicker");
  }

  /** Whether no map links the two pictures yet. */
  get isLoose(): boolean {
    return !this.map && this.mode.peek() === "side";
  }

  /** The picture with the focus; the reference where none has it. */
  get focused(): MarkedPane {
    const { left, right } = this;
    const there = this.mode.peek() === "side" && right.host.contains(document.activeElement);
    return there ? right : left;
  }

  private get isApart(): boolean {
    return this.isLoose && this.focused === this.right;
  }

  override pan(dx: number, dy: number): void {
    if (!this.isApart) return super.pan(dx, dy);
    const { right } = this;
    const [x, y, scale] = right.aim;
    const by = (PAN_STEP * right.host.clientHeight) / scale;
    const [along, down] = right.along([by * dx, by * dy]);
    right.look(x + along, y + down, scale, this.turnedAlone);
  }

  override zoom(factor: number): void {
    if (this.isApart) this.right.zoom(factor);
    else super.zoom(factor);
  }

  override fit(): void {
    super.fit();
    if (this.isLoose) this.right.fit(true, this.turnedAlone);
  }

  /** Turn both pictures; that with the focus alone where it is to be registered, and has no map yet. */
  turn(by: number): void {
    if (this.isApart) this.turnAlone(by);
    else void this.store.turn(by);
  }

  /** Turn the picture to register by itself. */
  private turnAlone(by: number): void {
    const id = this.store.frame.peek()?.id ?? "";
    this.alone.set(id, (this.alone.get(id) ?? 0) + by);
    this.link(this.left);
  }

  private get turnedAlone(): number {
    return this.turned + (this.alone.get(this.store.frame.peek()?.id ?? "") ?? 0);
  }

  private turnButton(): HTMLElement {
    const title = "Turn this picture alone by 90° (T, while it has the focus)";
    const facts = { type: "button", id: "turn-alone", "aria-label": "Turn this picture by 90°" };
    const button = make("button", { ...facts, title }, "↻");
    button.addEventListener("click", () => this.turnAlone(90));
    watch([this.store.session], () => (button.hidden = this.map !== null));
    return button;
  }

  /** Whether the reference's place of a pair is in view, not only just. */
  sees([x, y]: Pair): boolean {
    const [left, top] = this.left.placeOf(x, y);
    const { clientWidth, clientHeight } = this.left.host;
    const inside = (at: number, size: number): boolean => at > HIT_PX && at < size - HIT_PX;
    return inside(left, clientWidth) && inside(top, clientHeight);
  }

  /** Show a pair in the middle of both pictures. */
  flyTo(pair: Pair): void {
    const { map, right } = this;
    this.look(pair[0], pair[1], Math.max(this.heading[2], CLOSE));
    if (!map) right.look(pair[2], pair[3], Math.max(right.scale, CLOSE), this.turned);
  }

  /** A step on screen as one along the axes of the picture to register, to the nearest quarter turn. */
  toTarget(right: number, down: number): Point {
    const turn = (-Math.round(this.right.viewer.viewport.getRotation(true) / 90) * Math.PI) / 2;
    const [cosine, sine] = [Math.round(Math.cos(turn)), Math.round(Math.sin(turn))];
    return [cosine * right - sine * down, sine * right + cosine * down];
  }

  private offerBands(): void {
    const { bands, band, reference, camera, sensor } = this.store.frame.peek()!;
    this.bands.left.offer(reference.bands, reference.band);
    this.bands.right.offer(bands, band);
    const role = this.store.frame.peek()!.beside.length ? "its neighbour" : "the reference";
    this.left.label.textContent = `${reference.camera}, ${role}`;
    this.right.label.textContent = [camera, sensor].filter(Boolean).join(" · ");
  }

  private update(): void {
    void this.load();
    this.left.redraw();
    this.right.redraw();
    this.loupes.redraw();
    if (!this.map || this.isTurned) this.link(this.left);
  }

  /** Whether a new map turns or scales the other picture otherwise than it is shown. */
  private get isTurned(): boolean {
    const { map, right } = this;
    if (!map || this.drag || this.leader !== this.left) return false;
    const { degrees, mirrored } = turnAndScale(map, ...right.centre);
    const wanted = this.turned + (mirrored ? 0 : degrees);
    const apart = Math.abs(right.viewer.viewport.getRotation(true) - wanted) % 360;
    return Math.min(apart, 360 - apart) > TURNED_LEAST;
  }

  protected wanted(): Wanted | null {
    const [frame, session] = [this.store.frame.peek(), this.store.session.peek()];
    if (!frame || !session) return null;
    const map = this.store.map.peek();
    const version = map === "built" ? `built${frame.builds}` : session.version;
    // What a browser kept of another day's server, at the same port, is not requested again.
    const page = Math.round(performance.timeOrigin);
    const [ours, theirs] = [this.bands.left, this.bands.right].map(
      ({ query }) => `bands=${query}&page=${page}`,
    );
    const tiles = `${this.store.path}/tiles`;
    // A reference of tiles is another picture once they are placed anew.
    const reference = `${tiles}/reference?${ours}&build=${frame.builds}`;
    const left = [layerOf(reference, frame.size)];
    if (this.isOverlay)
      left.push(layerOf(`${tiles}/warped?map=${map}&v=${version}&${theirs}`, frame.size));
    const right = [layerOf(`${tiles}/target?${theirs}`, frame.target_size)];
    return { subject: frame.id, left, right };
  }

  /** What the loupes are to show. */
  private enlarged(): LoupeScene | null {
    const [wanted, proposal] = [this.wanted(), this.store.proposal.peek()];
    if (!wanted) return null;
    const { map, drag, turned } = this;
    return {
      layers: [wanted.left[0]!, wanted.right![0]!],
      pair: drag?.to ?? proposal?.pair ?? this.store.selectedPair(),
      dragged: drag !== null,
      begun: this.mode.peek() === "side" && proposal ? proposal.begun : null,
      map,
      scale: this.left.scale,
      degrees: [turned, map ? turned : this.turnedAlone],
    };
  }

  /** Let the other picture show the same place, turned and scaled alike. */
  protected follow(leader: MarkedPane): void {
    const { map, left, right } = this;
    const frame = this.store.frame.peek();
    if (!map && !right.isTurned(this.turnedAlone)) {
      if (right.isFitted) right.fit(true, this.turnedAlone);
      else right.look(...right.aim, this.turnedAlone);
    }
    if (!map || !frame) return;
    if (leader === left) {
      const [width, height] = frame.target_size;
      const place = invert(map, left.centre, [width / 2, height / 2]);
      const { degrees, scale, mirrored } = turnAndScale(map, ...place);
      if (Number.isFinite(place[0]) && scale > 0)
        right.look(...place, left.scale * scale, this.turned + (mirrored ? 0 : degrees));
    } else {
      const { scale } = turnAndScale(map, ...right.centre);
      if (scale > 0) left.look(...map(...right.centre), right.scale / scale, this.turned);
    }
    left.redraw();
    right.redraw();
  }

  /** Where the target's place of a pair lies in the reference's frame, by the map that is shown. */
  private seenAt(pair: Pair): Point {
    return this.map?.(pair[2], pair[3]) ?? [pair[0], pair[1]];
  }

  /** Add a corner to the outline in the middle of the reference. */
  cornerAtMiddle(): void {
    this.outline.add(this.left.centre);
  }

  private grab(pane: MarkedPane, half: Half, [x, y]: Point): boolean {
    if (this.outline.open.peek()) return half === 0 && this.outline.grab([x, y], pane.scale);
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
      const far = to.some((value, i) => Math.abs(value - from[i]!) > MOVED_PX);
      if (far) void this.store.edit({ operation: "move", pair: from, to }, to);
      else this.update();
      return;
    }
    this.drag = { from, to };
    this.left.redraw();
    this.right.redraw();
    this.loupes.redraw();
  }

  private paint(context: CanvasRenderingContext2D, pane: MarkedPane, half: Half): void {
    const { frame, session, selected, proposal, measured } = this.store;
    if (!session.peek() || !frame.peek()) return;
    const place: PlaneMap = (x, y) => pane.placeOf(x, y);
    const { corners, open, draft, chosen } = this.outline;
    const handles = open.peek() && { closed: !draft.peek(), chosen: chosen.peek() };
    if (half === 0 && (this.marks.peek() || handles))
      paintOutline(context, corners, place, handles || null);
    const draws = this.marks.peek() && !(handles && half === 0); // else only what is being placed
    if (draws && !this.isOverlay)
      paintPairs(context, {
        session: session.peek()!,
        selected: selected.peek(),
        half,
        place,
        map: this.map,
        scale: this.left.scale,
        filter: this.store.filter.peek(),
      });
    else if (draws) {
      const pair = this.drag?.to ?? this.store.selectedPair();
      if (pair) paintHandle(context, place(pair[0], pair[1]), place(...this.seenAt(pair)));
    }
    const { drag } = this;
    const dragged = drag && !this.isOverlay && { pair: drag.to, predicted: drag.from, sure: true };
    const partner = dragged || (proposal.peek() ?? measured.peek());
    if (partner) paintProposal(context, partner, half, place);
  }
}
