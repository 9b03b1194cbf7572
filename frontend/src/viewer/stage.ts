// The painting: pictures A and B of two layers, on one grid of pixels.
import OpenSeadragon from "openseadragon";
import { make } from "../shared/element";
import { Pane, type Layer, type PaneOptions, type Point } from "../shared/pane";
import { Stage, type Wanted } from "../shared/stage";
import { sourceOf } from "./mixing";
import { pinColour } from "./pins";
import type { Picture } from "./record";
import type { Pin, Slot, State } from "./state";

/** The stage of the viewer; both panes have the grid's pixels. */
export class PaintingStage extends Stage<Pane> {
  onPoint: (pixel: Point | null) => void = () => {};
  onPick: (pixel: Point) => void = () => {};
  onMove: () => void = () => {};
  /** The picture of B once it was needed: it stays loaded while another mode is chosen. */
  private needed: Picture | null = null;

  constructor(
    host: HTMLElement,
    size: Point,
    private readonly state: State,
  ) {
    host.dataset["mode"] = "side"; // room for both while they are made
    const options: PaneOptions = { drawer: findDrawer(), zoomOnDoubleClick: true };
    const [left, right] = [new Pane(host, size, options), new Pane(host, size, options)];
    super(host, left, right, true);
    right.host.classList.add("beside");
    this.tone.amplify = 4;
    for (const pane of [left, right]) {
      // The stage around them has the name, takes the focus and listens to the keys.
      pane.viewer.canvas.removeAttribute("tabindex");
      const inside = (pixel: Point): Point | null => (pane.contains(pixel) ? pixel : null);
      const { container } = pane.viewer;
      container.addEventListener("pointermove", ({ clientX, clientY }) =>
        this.onPoint(inside(pane.pixelAt(clientX, clientY))),
      );
      container.addEventListener("pointerleave", () => this.onPoint(null));
      pane.onClick = (x, y) => {
        if (inside([x, y])) this.onPick([x, y]);
      };
    }
  }

  /** Mark the pixel that is read, if any, and the places that are kept in both panes. */
  mark(pixel: Point | null, pins: Pin[]): void {
    const placement = OpenSeadragon.Placement.CENTER;
    for (const pane of [this.left, this.right]) {
      pane.viewer.clearOverlays();
      const add = (element: HTMLElement, place: Point): void => {
        pane.viewer.addOverlay({ element, location: pane.toViewport(...place), placement });
      };
      for (const [i, { at }] of pins.entries()) {
        const element = make("div", { class: "kept-pin", "aria-hidden": "true" }, String(i + 1));
        element.style.background = pinColour(i);
        add(element, at);
      }
      if (pixel) add(make("div", { class: "pin", "aria-hidden": "true" }), pixel);
    }
  }

  protected override onView(): void {
    this.onMove();
  }

  protected wanted(): Wanted | null {
    const [a, b] = [this.state.a.value?.picture, this.state.b.value?.picture];
    if (!a) return null;
    if (b && this.isOverlay) this.needed = b;
    const left = [layerOf("a", a)];
    if (b && this.needed === b) left.push(layerOf("b", b));
    const beside = b && this.mode.value === "side";
    return { subject: "painting", left, ...(beside ? { right: [layerOf("b", b)] } : {}) };
  }

  protected follow(leader: Pane): void {
    const other = leader === this.left ? this.right : this.left;
    other.look(...leader.centre, leader.scale);
  }
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
