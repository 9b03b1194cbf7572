// Rectangles and lengths over the panes: those that are kept, and the one that is being drawn.
import { draw } from "../shared/element";
import type { Pane, Point } from "../shared/pane";
import { joined } from "../shared/plot";
import { around } from "./spectra";
import type { Shape } from "./state";

const LEAST_PX = 3; // of the screen, between the ends of what is drawn

/** A shape as it is shown, with the words beside it. */
export interface Outline {
  kind: Shape;
  points: Point[];
  colour: string;
  label: string;
}

interface Sketch {
  kind: Shape;
  from: Point | null;
  to: Point | null;
  end: (points: Point[] | null) => void;
}

/** What is drawn over all panes. */
export class Drawing {
  /** Words beside what is being drawn. */
  words: (kind: Shape, points: Point[]) => string = () => "";
  private outlines: Outline[] = [];
  private readonly sheets: SVGElement[];
  private sketch: Sketch | null = null;

  constructor(private readonly panes: Pane[]) {
    this.sheets = panes.map(({ host }) => {
      const sheet = draw("svg", { class: "shapes-sheet", "aria-hidden": "true" });
      host.append(sheet);
      return sheet;
    });
    for (const pane of panes) this.listen(pane);
  }

  show(outlines: Outline[]): void {
    this.outlines = outlines;
    this.render();
  }

  /** Whether a shape is being drawn. */
  get active(): boolean {
    return this.sketch !== null;
  }

  /** Let the next drag, or two clicks, be a shape; null where it is given up. */
  begin(kind: Shape): Promise<Point[] | null> {
    this.cancel();
    this.hold(true);
    return new Promise((end) => {
      this.sketch = { kind, from: null, to: null, end };
    });
  }

  /** Take a place as the next end, as a click does. */
  add(place: Point): void {
    const { sketch } = this;
    if (!sketch) return;
    // A tenth of a pixel is what the address holds: whoever follows it finds the same numbers.
    const [x, y] = place.map((at) => Math.round(10 * at) / 10) as Point;
    const { from } = sketch;
    sketch.to = [x, y];
    if (!from) sketch.from = [x, y];
    else if (Math.hypot(x - from[0], y - from[1]) * this.panes[0]!.scale >= LEAST_PX)
      this.end([from, [x, y]]);
    this.render();
  }

  cancel(): void {
    this.end(null);
  }

  /** Draw everything anew; call it when the view has changed. */
  render(): void {
    const outlines = [...this.outlines];
    const { from = null, to = null, kind = "length" } = this.sketch ?? {};
    if (from && to) {
      const points = [from, to];
      outlines.push({ kind, points, colour: "#fff", label: this.words(kind, points) });
    }
    this.sheets.forEach((sheet, i) =>
      sheet.replaceChildren(...outlines.flatMap((one) => outlineOf(one, this.panes[i]!))),
    );
  }

  private listen(pane: Pane): void {
    const { container } = pane.viewer;
    const at = ({ clientX, clientY }: PointerEvent): Point => pane.pixelAt(clientX, clientY);
    container.addEventListener("pointerdown", (event) => {
      if (!this.sketch || event.button) return;
      container.setPointerCapture(event.pointerId);
      if (!this.sketch.from) this.add(at(event));
    });
    container.addEventListener("pointermove", (event) => {
      if (!this.sketch?.from) return;
      this.sketch.to = at(event);
      this.render();
    });
    container.addEventListener("pointerup", (event) => {
      if (this.sketch?.from && !event.button) this.add(at(event));
    });
  }

  private hold(on: boolean): void {
    for (const pane of this.panes) {
      pane.viewer.setMouseNavEnabled(!on);
      pane.host.classList.toggle("drawing", on);
    }
  }

  private end(points: Point[] | null): void {
    if (!this.sketch) return;
    const { end } = this.sketch;
    this.sketch = null;
    this.hold(false);
    this.render();
    end(points);
  }
}

/** A rectangle, from pixel to pixel with both, or a line, on a dark ground, and its words. */
function outlineOf({ kind, points, colour, label }: Outline, pane: Pane): SVGElement[] {
  const [x0, y0, x1, y1] = around(points);
  const corners: Point[] = [
    [x0 - 0.5, y0 - 0.5],
    [x1 + 0.5, y0 - 0.5],
    [x1 + 0.5, y1 + 0.5],
    [x0 - 0.5, y1 + 0.5],
  ];
  const places = (kind === "rectangle" ? corners : points).map((at) => pane.placeOf(...at));
  const tag = kind === "rectangle" ? "polygon" : "polyline";
  const line = draw(tag, { points: joined(places), class: "shape-line" });
  line.style.stroke = colour;
  const [x, y] = places[0]!;
  return [
    draw(tag, { points: joined(places), class: "shape-edge" }),
    line,
    draw("text", { x, y, class: "shape-label" }, label),
  ];
}
