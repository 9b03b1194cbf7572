// Two pictures: side by side and linked, or laid over one another.
import { signal } from "@preact/signals-core";
import OpenSeadragon from "openseadragon";
import { beyond, Curtain } from "./curtain";
import { Flicker } from "./flicker";
import type { Aim, Layer, Pane } from "./pane";

export type Mode =
  "single" | "side" | "grid" | "curtain" | "opacity" | "flicker" | "difference" | "checker";

export const PAN_STEP = 0.15; // of the height of the view
const SQUARES = 12; // of the checker, along the longer side
const COMPOSITIONS: Partial<Record<Mode, string>> = {
  difference: "difference",
};

/** What the panes have to show; a pane without an entry keeps what it has. */
export interface Wanted {
  /** What the pictures are of: another subject is shown whole. */
  subject: string;
  left: Layer[];
  right?: Layer[];
  /** Of panes beyond these two. */
  others?: Layer[][];
}

/** The left pane holds one picture or both, the right one is there side by side. */
export abstract class Stage<P extends Pane> {
  readonly mode = signal<Mode>("side");
  /** Which picture the flicker shows now. */
  readonly inTurn = signal<"a" | "b">("a");
  readonly flicker = new Flicker((shown) => {
    this.inTurn.value = shown;
    this.showOne(shown);
  });
  readonly curtain: Curtain;
  protected tone = { brightness: 1, contrast: 1, amplify: 3 };
  /** By how many degrees clockwise the pictures are turned, a multiple of 90. */
  protected turned = 0;
  /** The pane that a person moved last: the other one goes after it. */
  protected leader: P;
  /** Where the view turns to once a requested mode is there. */
  private arrival: Aim | "fit" | null = null;
  private subject: string | null = null;
  private shown = "";
  private changes = 0;
  private following = false;

  /** `glides` where the keys move the view smoothly. */
  constructor(
    protected readonly host: HTMLElement,
    readonly left: P,
    readonly right: P,
    private readonly glides = false,
  ) {
    this.leader = left;
    this.curtain = new Curtain(left.host, () => this.clip());
    for (const pane of [left, right]) this.lead(pane);
  }

  /** Let others go after a pane that a person moves. */
  protected lead(pane: P): void {
    pane.onView = () => {
      if (pane === this.left) this.clip();
      if (pane === this.leader) this.link();
      this.onView();
    };
    pane.onGesture = () => {
      [this.leader, this.arrival] = [pane, null];
    };
  }

  /** The panes that show something now, the left one first. */
  protected get panes(): P[] {
    return this.mode.value === "side" ? [this.left, this.right] : [this.left];
  }

  /** Make room for what a mode shows. */
  protected arrange(mode: Mode): void {
    this.right.host.hidden = mode !== "side";
  }

  /** Panes beyond these two. */
  protected get others(): P[] {
    return [];
  }

  /** Show A or B, as the flicker turns. */
  protected showOne(shown: "a" | "b"): void {
    this.upper?.setOpacity(Number(shown === "b"));
  }

  /** Return what the mode needs, or null where nothing is known yet. */
  protected abstract wanted(): Wanted | null;
  /** Let the other pane show what `leader` shows. */
  protected abstract follow(leader: P): void;
  /** Called whenever the view has changed. */
  protected onView(): void {}

  /** Whether one picture lies over the other, be it while a key is held. */
  protected get isOverlay(): boolean {
    return !["single", "side", "grid"].includes(this.mode.value) || this.flicker.running;
  }

  /** The upper layer of the overlay. */
  private get upper(): OpenSeadragon.TiledImage | undefined {
    return this.left.layers[1];
  }

  /** Whether all that is in view has been drawn, in the requested mode. */
  get settled(): boolean {
    return this.arrival === null && this.panes.every((pane) => pane.settled);
  }

  setMode(mode: Mode): void {
    if (mode === "flicker" && mode === this.mode.value && this.flicker.byHand) {
      if (this.flicker.waits.value) this.flicker.wait(false);
      else this.flicker.step();
      return;
    }
    this.flicker.waits.value = false;
    this.arrival ??= !this.left.layers.length || this.left.isFitted ? "fit" : this.left.aim;
    const mine = ++this.changes;
    this.mode.value = mode;
    this.host.dataset["mode"] = mode;
    this.leader = this.left;
    this.arrange(mode);
    this.curtain.shown = mode === "curtain";
    this.flicker.stop();
    void this.load().finally(() => requestAnimationFrame(() => this.arrive(mine)));
  }

  /** Flicker for as long as a key is held, whatever the mode. */
  hold(on: boolean): void {
    if (on && this.mode.value === "flicker" && this.flicker.byHand) this.flicker.step();
    else if (on) this.flicker.start();
    else if (this.mode.value !== "flicker") this.flicker.stop();
    void this.load();
  }

  /** Set brightness and contrast, and by how much differences are brightened. */
  setTone(brightness: number, contrast: number, amplify: number): void {
    this.tone = { brightness, contrast, amplify };
    this.blend();
  }

  /** Show what the mode needs; what is there already is not loaded anew. */
  async load(): Promise<void> {
    const wanted = this.wanted();
    if (!wanted) return;
    const { subject, left, right, others = [] } = wanted;
    const all = [left, right, ...others];
    const keys = JSON.stringify(all.map((layers) => layers?.map(({ key }) => key)));
    if (this.shown !== keys || this.subject !== subject) {
      const fresh = this.subject !== subject;
      [this.shown, this.subject] = [keys, subject];
      const loading = [this.left.show(left, !fresh)];
      if (right) loading.push(this.right.show(right, !fresh));
      others.forEach((layers, i) => loading.push(this.others[i]!.show(layers, !fresh)));
      if (fresh && this.arrival) this.arrival = "fit";
      if (fresh) this.fitBoth();
      await Promise.all(loading);
    }
    this.blend();
  }

  /** Take the view over once the panes know their new sizes, some frames later; but the last mode only. */
  private arrive(change: number, frames = 60): void {
    if (change !== this.changes) return;
    const { panes } = this;
    for (const pane of panes) pane.viewer.forceResize();
    if (frames > 0 && !panes.every((pane) => pane.isSized)) {
      requestAnimationFrame(() => this.arrive(change, frames - 1));
      return;
    }
    if (this.arrival === "fit") this.left.fit(true, this.turned);
    else if (this.arrival) this.left.look(...this.arrival, this.turned);
    this.arrival = null;
    this.link(this.left);
    this.onView();
  }

  /** Where the view goes: place and scale. */
  get heading(): Aim {
    return Array.isArray(this.arrival) ? this.arrival : this.left.aim;
  }

  /** Move the view, also while another mode is on its way. */
  look(x: number, y: number, scale: number, immediately = true): void {
    this.leader = this.left;
    this.left.look(x, y, scale, this.turned, immediately);
    if (this.arrival) this.arrival = [x, y, scale];
    this.link();
  }

  /** Move the pictures by a part of the view. */
  pan(dx: number, dy: number): void {
    const [x, y, scale] = this.heading;
    const by = (PAN_STEP * this.left.host.clientHeight) / scale;
    const turn = (-this.turned * Math.PI) / 180;
    const [cosine, sine] = [Math.round(Math.cos(turn)), Math.round(Math.sin(turn))];
    const [right, down] = [cosine * dx - sine * dy, sine * dx + cosine * dy];
    this.look(x + by * right, y + by * down, scale, !this.glides);
  }

  zoom(factor: number): void {
    this.leader = this.left;
    const [x, y, scale] = this.heading;
    if (this.arrival) this.look(x, y, scale * factor);
    else this.left.zoom(factor);
  }

  fit(): void {
    this.leader = this.left;
    this.left.fit(!this.glides, this.turned);
    if (this.arrival) this.arrival = "fit";
  }

  /** Turn the pictures; what is in the middle stays there. */
  turnTo(degrees: number): void {
    if (degrees === this.turned) return;
    const fitted = this.left.isFitted;
    const [x, y, scale] = this.heading;
    this.turned = degrees;
    if (fitted) this.left.fit(true, degrees);
    else this.left.look(x, y, scale, degrees);
    this.link(this.left);
    this.clip();
    this.onView();
  }

  private fitBoth(): void {
    this.right.fit();
    this.left.fit(true, this.turned);
    this.link(this.left);
  }

  /** Let the other pane show the same place. */
  protected link(leader: P = this.leader): void {
    const { panes } = this;
    if (panes.length < 2 || this.following || !panes.every((pane) => pane.isSized)) return;
    this.following = true;
    this.follow(leader);
    this.following = false;
  }

  /** Bring opacity, clip, blending and tone in line with the mode. */
  protected blend(): void {
    const mode = this.mode.value;
    if (mode === "flicker") this.flicker.start();
    const still = !this.flicker.running;
    const { brightness, contrast, amplify } = this.tone;
    const gain = mode === "difference" && still ? amplify : 1;
    const filter = `brightness(${brightness * gain}) contrast(${contrast})`;
    for (const pane of [this.left, this.right])
      pane.viewer.drawer.canvas.style.filter = filter === "brightness(1) contrast(1)" ? "" : filter;
    const upper = this.upper;
    if (!upper) return;
    upper.setCompositeOperation((still && COMPOSITIONS[mode]) || "source-over");
    upper.setOpacity(Number(still ? this.isOverlay : this.flicker.shown === "b"));
    if (mode === "checker") upper.setCroppingPolygons(squares(this.left.layers[0]!));
    else upper.resetCroppingPolygons();
    this.clip();
    this.left.viewer.forceRedraw();
  }

  protected clip(): void {
    const upper = this.upper;
    if (!upper) return;
    if (this.mode.value !== "curtain" || this.flicker.running) {
      if (upper.getClip()) upper.setClip(null);
      return;
    }
    const { x: width, y: height } = upper.getContentSize();
    const box = this.left.host.getBoundingClientRect();
    const line = box.left + this.curtain.fraction * box.width;
    const [x, y] = this.left.pixelAt(line, box.top);
    const part = beyond([x + 0.5, y + 0.5], this.turned, [width, height]);
    const clip = upper.getClip();
    const now = clip ? [clip.x, clip.y, clip.width, clip.height] : [];
    if (clip && part.every((value, i) => Math.abs(value - now[i]!) < 1e-3)) return;
    upper.setClip(new OpenSeadragon.Rect(...part));
  }
}

/** Every other square of a picture, as polygons. */
function squares(image: OpenSeadragon.TiledImage): OpenSeadragon.Point[][] {
  const { x: width, y: height } = image.getContentSize();
  const side = Math.max(width, height) / SQUARES;
  const polygons: OpenSeadragon.Point[][] = [];
  for (let row = 0; row * side < height; row++)
    for (let column = row % 2; column * side < width; column += 2) {
      const [left, top] = [column * side, row * side];
      const [right, bottom] = [Math.min(left + side, width), Math.min(top + side, height)];
      const corners = [
        [left, top],
        [right, top],
        [right, bottom],
        [left, bottom],
      ] as const;
      polygons.push(corners.map(([x, y]) => new OpenSeadragon.Point(x, y)));
    }
  return polygons;
}
