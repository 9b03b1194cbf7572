// A deep-zoom picture with the pairs drawn over it.
import { make } from "../shared/element";
import { paintMiddle } from "./marks";
import { Pane, type Point } from "../shared/pane";
import { onTheme } from "../shared/theme";

export class MarkedPane extends Pane {
  /** The line under the picture: its name, and what can be chosen of it. */
  readonly foot = make("div", { class: "foot" });
  readonly label = make("span", { class: "label" });
  /** Whether something at a place is taken hold of, to be dragged rather than the picture. */
  grab: (at: Point) => boolean = () => false;
  /** Called while what was taken hold of is dragged, and when it is let go of, dragged or not. */
  onDrag: (at: Point, done: boolean, dragged: boolean) => void = () => {};
  /** Called with the place under the pointer, and with nothing when it leaves. */
  onPoint: (at: Point | null) => void = () => {};
  paint: (context: CanvasRenderingContext2D) => void = () => {};
  private readonly canvas = make("canvas", { class: "marks", "aria-hidden": "true" });
  private dragging = false;
  private dragged = false;
  private waiting = false;

  constructor(parent: HTMLElement, name: string, size: Point) {
    super(parent, size, { drawer: "canvas", zoomOnDoubleClick: false });
    this.host.setAttribute("role", "group");
    this.host.setAttribute("aria-label", name);
    const help = `${name}: drag to pan, wheel or + and - to zoom`;
    this.viewer.canvas.setAttribute("role", "group");
    this.viewer.canvas.setAttribute("aria-label", help);
    this.foot.append(this.label);
    this.host.append(this.canvas, this.foot);
    for (const event of [
      "animation",
      "resize",
      "zoom",
      "pan",
      "rotate",
      "update-viewport",
    ] as const)
      this.viewer.addHandler(event, () => this.redraw());
    this.viewer.addHandler("canvas-press", (event) => {
      this.dragging = this.grab(this.pixelOf(event));
      this.dragged = false;
    });
    this.viewer.addHandler("canvas-drag", (event) => {
      if (!this.dragging) return;
      event.preventDefaultAction = true;
      this.dragged = true;
      this.onDrag(this.pixelOf(event), false, true);
    });
    this.viewer.addHandler("canvas-release", (event) => {
      if (!this.dragging) return;
      this.dragging = false;
      this.onDrag(this.pixelOf(event), true, this.dragged);
    });
    const { container } = this.viewer;
    container.addEventListener("pointermove", ({ clientX, clientY }) =>
      this.onPoint(this.pixelAt(clientX, clientY)),
    );
    for (const event of ["focus", "blur"] as const)
      this.viewer.canvas.addEventListener(event, () => this.redraw());
    container.addEventListener("pointerleave", () => this.onPoint(null));
    new ResizeObserver(() => this.redraw()).observe(this.host);
    onTheme(() => this.redraw());
  }

  /** Draw the marks anew with the next frame; requested many times, done once. */
  redraw(): void {
    if (this.waiting) return;
    this.waiting = true;
    requestAnimationFrame(() => {
      this.waiting = false;
      this.draw();
    });
  }

  private draw(): void {
    const ratio = devicePixelRatio || 1;
    const [across, down] = [this.host.clientWidth, this.host.clientHeight];
    const [width, height] = [Math.round(across * ratio), Math.round(down * ratio)];
    const { canvas } = this;
    if (canvas.width !== width || canvas.height !== height)
      [canvas.width, canvas.height] = [width, height];
    const context = canvas.getContext("2d");
    if (!context) return;
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
    context.clearRect(0, 0, across, down);
    this.paint(context);
    if (this.viewer.canvas.matches(":focus-visible")) paintMiddle(context, [across / 2, down / 2]);
  }
}
