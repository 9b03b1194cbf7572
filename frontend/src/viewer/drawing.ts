// Shapes drawn over the panes: those that parts of the page show, the one that is being drawn, and a grid.
import { draw } from "../shared/element";
import type { Pane, Point } from "../shared/pane";
import { joined } from "../shared/plot";
import { cornersOf, isWhole, radiusOf, type Shape, type ShapeKind } from "./shapes";

const LEAST_PX = 3; // of the screen, between the corners of what is drawn with the mouse
const PLACE_PX = 7;

/** A shape as it is shown, with the words beside it. */
export interface Outline {
  shape: Shape;
  colour: string;
  label: string;
  dashed?: boolean;
}

/** Lines of a grid, px: the first ones, how far apart they are, and how large the picture is. */
export interface GridLines {
  step: number;
  size: Point;
}

interface Sketch {
  kind: ShapeKind;
  points: Point[];
  words: (shape: Shape) => string;
  end: (points: Point[] | null) => void;
}

/** What is drawn over all panes. */
export class Drawing {
  grid: GridLines | null = null;
  private readonly groups = new Map<string, Outline[]>();
  private readonly sheets: Sheet[];
  private sketch: Sketch | null = null;

  constructor(private readonly panes: Pane[]) {
    this.sheets = panes.map((pane) => new Sheet(pane));
    for (const { viewer } of panes) this.listen(viewer.container);
  }

  /** Show the shapes of one part of the page in place of those that it showed before. */
  show(part: string, outlines: Outline[]): void {
    this.groups.set(part, outlines);
    this.render();
  }

  /** Whether a shape is being drawn. */
  get active(): boolean {
    return this.sketch !== null;
  }

  /** Let the next drag, or clicks, be a shape; null where it is given up. `words` stand beside it meanwhile. */
  begin(kind: ShapeKind, words: (shape: Shape) => string = () => ""): Promise<Point[] | null> {
    this.cancel();
    for (const pane of this.panes) {
      pane.viewer.setMouseNavEnabled(false);
      pane.host.classList.add("drawing");
    }
    return new Promise((end) => {
      this.sketch = { kind, points: [], words, end };
    });
  }

  /** Take a place as the next corner, as a click does. */
  add(place: Point): void {
    const { sketch } = this;
    if (!sketch) return;
    if (sketch.kind === "place") this.finish([place]);
    else if (isDragged(sketch) && sketch.points.length) this.finish([sketch.points[0]!, place]);
    // The last corner follows the cursor until the next click.
    else sketch.points = [...sketch.points.slice(0, -1), place, place];
    this.render();
  }

  /** End a polygon or a line at the corners that it has. */
  close(): void {
    const { sketch } = this;
    if (!sketch || isDragged(sketch)) return;
    const { points } = sketch;
    this.finish(points.filter((point, i) => i === 0 || this.isApart(point, points[i - 1]!)));
  }

  cancel(): void {
    this.end(null);
  }

  /** Draw everything anew; call it when the view has changed. */
  render(): void {
    const outlines = [...this.groups.values()].flat();
    if (this.sketch && this.sketch.points.length > 1) {
      const { kind, points, words } = this.sketch;
      const shape = { kind, points };
      outlines.push({ shape, colour: "#fff", label: words(shape) });
    }
    for (const sheet of this.sheets) sheet.render(outlines, this.grid);
  }

  private listen(container: HTMLElement): void {
    const pane = this.panes.find(({ viewer }) => viewer.container === container)!;
    const at = ({ clientX, clientY }: PointerEvent): Point => pane.pixelAt(clientX, clientY);
    container.addEventListener("pointerdown", (event) => {
      if (!this.sketch || event.button) return;
      if (isDragged(this.sketch)) this.sketch.points = [at(event), at(event)];
      container.setPointerCapture(event.pointerId);
    });
    container.addEventListener("pointermove", (event) => {
      if (!this.sketch?.points.length) return;
      if (!isDragged(this.sketch) || event.buttons & 1)
        this.sketch.points[this.sketch.points.length - 1] = at(event);
      this.render();
    });
    container.addEventListener("pointerup", (event) => {
      if (!this.sketch || event.button) return;
      const [start] = this.sketch.points;
      if (isDragged(this.sketch) && start && !this.isApart(start, at(event)))
        this.sketch.points = [];
      else this.add(at(event));
    });
    container.addEventListener("dblclick", () => this.close());
  }

  private isApart(a: Point, b: Point): boolean {
    return Math.hypot(a[0] - b[0], a[1] - b[1]) * this.panes[0]!.scale >= LEAST_PX;
  }

  private finish(points: Point[]): void {
    // A tenth of a pixel is what the address holds: whoever follows it finds the same numbers.
    const round = (at: number): number => Math.round(10 * at) / 10;
    const places = points.map(([x, y]): Point => [round(x), round(y)]);
    if (this.sketch && isWhole({ kind: this.sketch.kind, points: places })) this.end(places);
  }

  private end(points: Point[] | null): void {
    if (!this.sketch) return;
    const { end } = this.sketch;
    this.sketch = null;
    for (const pane of this.panes) {
      pane.viewer.setMouseNavEnabled(true);
      pane.host.classList.remove("drawing");
    }
    this.render();
    end(points);
  }
}

const isDragged = ({ kind }: Sketch): boolean => kind === "rectangle" || kind === "circle";

/** The drawing over one pane. */
class Sheet {
  private readonly svg = draw("svg", { class: "regions-sheet", "aria-hidden": "true" });

  constructor(private readonly pane: Pane) {
    pane.host.append(this.svg);
  }

  render(outlines: Outline[], grid: GridLines | null): void {
    const lines = grid ? this.gridOf(grid) : [];
    this.svg.replaceChildren(...lines, ...outlines.flatMap((one) => this.shapeOf(one)));
  }

  private shapeOf({ shape, colour, label, dashed }: Outline): SVGElement[] {
    const corners = cornersOf(shape).map(([x, y]) => this.pane.placeOf(x, y));
    const [x, y] = corners[0]!;
    const make = (kind: string): SVGElement => {
      const points = { points: joined(corners), class: kind };
      if (shape.kind === "line") return draw("polyline", points);
      if (shape.kind !== "circle" && shape.kind !== "place") return draw("polygon", points);
      const r = shape.kind === "place" ? PLACE_PX : radiusOf(corners);
      return draw("circle", { cx: x, cy: y, r, class: kind });
    };
    const line = make(dashed ? "region-line dashed" : "region-line");
    line.style.stroke = colour;
    const text = label && draw("text", { x, y, class: "region-number" }, label);
    return [make("region-edge"), line, ...(text ? [text] : [])];
  }

  /** Lines of the grid in view, each from edge to edge of the picture. */
  private gridOf({ step, size: [width, height] }: GridLines): SVGElement[] {
    const { clientWidth, clientHeight } = this.pane.host;
    const box = this.pane.host.getBoundingClientRect();
    const corners = [0, clientWidth].flatMap((x) =>
      [0, clientHeight].map((y) => this.pane.pixelAt(box.left + x, box.top + y)),
    );
    const places = (axis: 0 | 1, size: number): number[] => {
      const pixels = corners.map((corner) => corner[axis] + 0.5);
      const first = Math.max(0, Math.ceil(Math.min(...pixels) / step));
      const last = Math.floor(Math.min(size, Math.max(...pixels)) / step);
      const count = Math.max(0, last - first + 1);
      return Array.from({ length: count }, (_, i) => (first + i) * step - 0.5);
    };
    const line = (from: Point, to: Point): SVGElement => {
      const [[x1, y1], [x2, y2]] = [this.pane.placeOf(...from), this.pane.placeOf(...to)];
      return draw("line", { x1, y1, x2, y2, class: "grid-line" });
    };
    return [
      ...places(0, width).map((x) => line([x, -0.5], [x, height - 0.5])),
      ...places(1, height).map((y) => line([-0.5, y], [width - 0.5, y])),
    ];
  }
}
