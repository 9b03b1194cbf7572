// The painting: up to four pictures on one grid of pixels, B over A or all beside one another.
import { computed, signal } from "@preact/signals-core";
import OpenSeadragon from "openseadragon";
import { make } from "../shared/element";
import { Pane, type Layer, type PaneOptions, type Point } from "../shared/pane";
import { Stage, type Mode, type Wanted } from "../shared/stage";
import { watch } from "../shared/watch";
import { sourceOf } from "./mixing";
import type { Picture } from "./record";
import { colourOf, SLOTS, type Kept, type Slot, type State } from "./state";

/** A slot on the screen: its pane, the words above it, and the pointer of another pane. */
export interface Cell {
  slot: Slot;
  pane: Pane;
  element: HTMLElement;
  label: HTMLElement;
  pointer: HTMLElement;
}

/** The stage of the viewer; all panes have the grid's pixels, and each shows one picture. */
export class PaintingStage extends Stage<Pane> {
  onPoint: (pixel: Point | null) => void = () => {};
  onPick: (pixel: Point) => void = () => {};
  onMove: () => void = () => {};
  readonly cells: Cell[];
  /** How much of B is visible over A, 0 to 1. */
  readonly opacity = signal(0.5);
  /** By how much differences are brightened. */
  readonly gain = signal(4);
  /** The slots whose pictures are on the screen or next in turn, A first. */
  readonly slots = computed<Slot[]>(() => {
    const mode = this.mode.value;
    const held = this.held.value;
    if (mode === "grid") return SLOTS.filter((slot) => this.state[slot].value);
    return mode === "single" && !held ? ["a"] : ["a", "b"];
  });
  /** Whether a key is held that flickers. */
  readonly held = signal(false);
  private readonly amplifier = make("div", { class: "amplifier", hidden: true });
  /** B is loaded once it was needed, and stays so. */
  private needed = false;
  /** The mode to go back to when the key is let go of. */
  private before: Mode | null = null;

  constructor(
    host: HTMLElement,
    private readonly size: Point,
    private readonly state: State,
  ) {
    host.dataset["mode"] = "grid"; // room for all while they are made
    const options: PaneOptions = { drawer: findDrawer(), zoomOnDoubleClick: true };
    const cells = SLOTS.map((slot) => makeCell(host, slot, size, options));
    super(host, cells[0]!.pane, cells[1]!.pane, true);
    this.cells = cells;
    this.right.host.classList.add("beside");
    host.append(this.amplifier);
    for (const { pane } of cells) this.listen(pane);
    for (const { pane } of cells.slice(2)) this.lead(pane);
    watch([this.opacity, this.gain], () => this.blend());
  }

  /** By how much the pictures are turned clockwise, degrees. */
  get degrees(): number {
    return this.turned;
  }

  /** Turn all pictures by so many degrees. */
  turn(by: number): void {
    this.turnTo((this.turned + by + 360) % 360);
    this.blend();
  }

  /** Mark the pixel that is read, if any, and the places that are kept in all panes. */
  mark(pixel: Point | null, kept: Kept[]): void {
    const placement = OpenSeadragon.Placement.CENTER;
    const rotationMode = OpenSeadragon.OverlayRotationMode.NO_ROTATION;
    for (const { pane } of this.cells) {
      pane.viewer.clearOverlays();
      const add = (element: HTMLElement, place: Point): void => {
        const location = pane.toViewport(...place);
        pane.viewer.addOverlay({ element, location, placement, rotationMode });
      };
      for (const [i, { kind, points }] of kept.entries()) {
        if (kind !== "place") continue;
        const element = make("div", { class: "kept-pin", "aria-hidden": "true" }, String(i + 1));
        element.style.background = colourOf(i);
        add(element, points[0]!);
      }
      if (pixel) add(make("div", { class: "pin", "aria-hidden": "true" }), pixel);
    }
  }

  override hold(on: boolean): void {
    const mode = this.mode.peek();
    const beside = mode === "side" || mode === "grid";
    if (on && beside) {
      this.before = mode;
      this.setMode("flicker");
      return;
    }
    if (!on && this.before) {
      const { before } = this;
      this.before = null;
      this.setMode(before);
      return;
    }
    this.held.value = on && mode !== "flicker";
    super.hold(on);
  }

  /** Let one finger scroll the page past the painting, and two move it; or one finger move it. */
  set scrolls(on: boolean) {
    for (const { pane } of this.cells) pane.viewer.setCooperativeGestures(on);
  }

  protected override get panes(): Pane[] {
    if (this.mode.value === "grid")
      return this.cells.filter(({ slot }) => this.state[slot].value).map(({ pane }) => pane);
    return this.needed ? [this.left, this.right] : [this.left];
  }

  protected override arrange(mode: Mode): void {
    for (const { slot, element } of this.cells)
      element.hidden = slot !== "a" && slot !== "b" && mode !== "grid";
  }

  protected override onView(): void {
    this.onMove();
  }

  protected wanted(): Wanted | null {
    const picture = (slot: Slot): Layer[] => {
      const choice = this.state[slot].value;
      return choice ? [layerOf(slot, choice.picture)] : [];
    };
    const [a, b] = [picture("a"), picture("b")];
    if (!a.length) return null;
    if (b.length && this.mode.value !== "single") this.needed = true;
    if (b.length && this.flicker.running) this.needed = true;
    const others = this.mode.value === "grid" ? [picture("c"), picture("d")] : [];
    return { subject: "painting", left: a, ...(this.needed ? { right: b } : {}), others };
  }

  protected override get others(): Pane[] {
    return this.cells.slice(2).map(({ pane }) => pane);
  }

  protected follow(leader: Pane): void {
    for (const pane of this.panes)
      if (pane !== leader) pane.look(...leader.centre, leader.scale, this.turned);
  }

  protected override showOne(): void {
    this.blend();
  }

  /** Lay B over A as the mode has it: every picture has a canvas of its own, and the browser blends them. */
  protected override blend(): void {
    const mode = this.mode.peek();
    if (mode === "flicker") this.flicker.start();
    const turning = this.flicker.running;
    const { style } = this.right.viewer.drawer.canvas as HTMLElement;
    const beside = mode === "side" || mode === "grid";
    const covers = turning ? this.flicker.shown === "b" : mode !== "single";
    style.visibility = beside || covers ? "" : "hidden";
    style.opacity = mode === "opacity" && !turning ? String(this.opacity.peek()) : "";
    const differs = mode === "difference" && !turning;
    style.mixBlendMode = differs ? "difference" : "";
    this.amplifier.hidden = !differs;
    const brightness = `brightness(${this.gain.peek()})`;
    this.amplifier.style.setProperty("backdrop-filter", brightness);
    this.amplifier.style.setProperty("-webkit-backdrop-filter", brightness);
    this.clip();
    this.link();
  }

  /** Cut B off where the curtain shows A; and both to whole pixels of the screen where they differ at the edge alone. */
  protected override clip(): void {
    const [below, { style }] = [this.left, this.right].map(
      ({ viewer }) => viewer.drawer.canvas as HTMLElement,
    ) as [HTMLElement, HTMLElement];
    const turning = this.flicker.running;
    const edge = this.mode.peek() === "difference" && !turning ? this.inside() : "";
    below.style.clipPath = edge;
    const { fraction, level } = this.curtain;
    const part = `${100 * fraction}%`;
    const cut = level.peek() ? `inset(${part} 0 0 0)` : `inset(0 0 0 ${part})`;
    style.clipPath = this.mode.peek() === "curtain" && !turning ? cut : edge;
  }

  /** The whole pixels of the screen that the picture fills. */
  private inside(): string {
    const { left, size } = this;
    const [a, b] = [left.placeOf(-0.5, -0.5), left.placeOf(size[0] - 0.5, size[1] - 0.5)];
    const { clientWidth, clientHeight } = left.host;
    const box = left.host.getBoundingClientRect(); // itself not always on whole pixels
    const origin = [box.left, box.top] as const;
    const first = (axis: 0 | 1): number =>
      Math.max(0, Math.ceil(origin[axis] + Math.min(a[axis], b[axis])) - origin[axis]);
    const last = (axis: 0 | 1, all: number): number =>
      Math.max(0, all + origin[axis] - Math.floor(origin[axis] + Math.max(a[axis], b[axis])));
    const sides = [first(1), last(0, clientWidth), last(1, clientHeight), first(0)];
    return `inset(${sides.map((side) => `${side}px`).join(" ")})`;
  }

  private listen(pane: Pane): void {
    // The stage around them has the name, takes the focus and listens to the keys.
    pane.viewer.canvas.removeAttribute("tabindex");
    const inside = (pixel: Point): Point | null => (pane.contains(pixel) ? pixel : null);
    const { container } = pane.viewer;
    const point = (pixel: Point | null): void => {
      for (const cell of this.cells) placePointer(cell, cell.pane === pane ? null : pixel);
      this.onPoint(pixel);
    };
    container.addEventListener("pointermove", ({ clientX, clientY }) =>
      point(inside(pane.pixelAt(clientX, clientY))),
    );
    container.addEventListener("pointerleave", () => point(null));
    pane.onClick = (x, y) => {
      if (inside([x, y])) this.onPick([x, y]);
    };
  }
}

function makeCell(host: HTMLElement, slot: Slot, size: Point, options: PaneOptions): Cell {
  const label = make("p", { class: "cell-label" });
  const element = make("div", { class: `cell cell-${slot}` }, label);
  host.append(element);
  const pane = new Pane(element, size, options);
  const pointer = make("div", { class: "pointer", "aria-hidden": "true", hidden: true });
  pane.host.append(pointer);
  return { slot, pane, element, label, pointer };
}

/** Show where the pointer is in another pane. */
function placePointer({ pane, pointer }: Cell, pixel: Point | null): void {
  pointer.hidden = !pixel;
  if (!pixel) return;
  const [x, y] = pane.placeOf(...pixel);
  [pointer.style.left, pointer.style.top] = [`${x}px`, `${y}px`];
}

/** A picture as OpenSeadragon reads it; the same one in both slots is two layers. */
function layerOf(slot: Slot, picture: Picture): Layer {
  return {
    key: `${slot} ${picture.folder} ${picture.key}`,
    size: [picture.width, picture.height],
    source: sourceOf(picture),
  };
}
/** WebGL where it is done by a graphics card and may use the tiles; from file:// it may not, and stays blank. */
function findDrawer(): string | string[] {
  const wanted = new URLSearchParams(location.search).get("drawer");
  if (wanted === "canvas" || location.protocol === "file:") return "canvas";
  return wanted === "webgl" || hasGraphicsCard() ? ["webgl", "canvas"] : "canvas";
}

/** Whether WebGL is there and is no software: that is slower than drawing without it. */
function hasGraphicsCard(): boolean {
  const context = document
    .createElement("canvas")
    .getContext("webgl2", { failIfMajorPerformanceCaveat: true });
  if (!context) return false;
  const facts = context.getExtension("WEBGL_debug_renderer_info");
  const name = String(
    context.getParameter(facts ? facts.UNMASKED_RENDERER_WEBGL : context.RENDERER),
  );
  context.getExtension("WEBGL_lose_context")?.loseContext();
  return !/swiftshader|llvmpipe|softpipe|software|basic render/i.test(name);
}
