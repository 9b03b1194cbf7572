// Regions on the painting: those that are kept, and the one that is being drawn.
import { draw } from "../shared/element";
import type { Pane, Point } from "../shared/pane";
import { joined } from "../shared/plot";
import { cornersOf, isWhole, radiusOf, type Kind, type Region } from "./shapes";

const LEAST_PX = 3; // of the screen, between the corners of what is drawn with the mouse

/** Draws regions over one pane, and lets a person draw a new one. */
export class RegionLayer {
  onDrawn: (kind: Kind, points: Point[]) => void = () => {};
  onEnd: () => void = () => {};
  private readonly sheet = draw("svg", { class: "regions-sheet", "aria-hidden": "true" });
  private kind: Kind | null = null;
  private points: Point[] = [];
  private regions: { region: Region; colour: string }[] = [];

  constructor(private readonly pane: Pane) {
    pane.host.append(this.sheet);
    const { container } = pane.viewer;
    const at = ({ clientX, clientY }: PointerEvent): Point => pane.pixelAt(clientX, clientY);
    container.addEventListener("pointerdown", (event) => {
      if (!this.kind || event.button) return;
      if (this.kind !== "polygon") this.points = [at(event), at(event)];
      container.setPointerCapture(event.pointerId);
    });
    container.addEventListener("pointermove", (event) => {
      if (!this.kind || !this.points.length) return;
      if (this.kind === "polygon" || event.buttons & 1)
        this.points[this.points.length - 1] = at(event);
      this.render();
    });
    container.addEventListener("pointerup", (event) => {
      if (!this.kind || event.button) return;
      if (this.kind !== "polygon") this.finish(at(event));
      else {
        // The last corner follows the cursor until the next click.
        this.points = [...this.points.slice(0, -1), at(event), at(event)];
        this.render();
      }
    });
    container.addEventListener("dblclick", () => this.close());
  }

  /** Whether a region is being drawn. */
  get drawing(): boolean {
    return this.kind !== null;
  }

  /** Let the next drag, or clicks, be a region. */
  start(kind: Kind): void {
    [this.kind, this.points] = [kind, []];
    this.pane.viewer.setMouseNavEnabled(false);
    this.pane.host.classList.add("drawing");
  }

  /** End a polygon at the corners that it has. */
  close(): void {
    if (this.kind !== "polygon") return;
    const apart = this.points.filter(
      (point, i) => i === 0 || this.distance(point, this.points[i - 1]!) >= LEAST_PX,
    );
    this.keep("polygon", apart);
  }

  cancel(): void {
    if (!this.kind) return;
    [this.kind, this.points] = [null, []];
    this.pane.viewer.setMouseNavEnabled(true);
    this.pane.host.classList.remove("drawing");
    this.render();
    this.onEnd();
  }

  /** Show regions that are kept; call it anew when the view has changed. */
  show(regions: { region: Region; colour: string }[] = this.regions): void {
    this.regions = regions;
    this.render();
  }

  private finish(end: Point): void {
    const [kind, start] = [this.kind!, this.points[0]];
    if (start && this.distance(start, end) >= LEAST_PX) this.keep(kind, [start, end]);
    else this.points = [];
  }

  private keep(kind: Kind, points: Point[]): void {
    if (!isWhole({ name: "", kind, points })) return;
    this.cancel();
    // A tenth of a pixel is what the address holds: whoever follows it finds the same numbers.
    this.onDrawn(
      kind,
      points.map(([x, y]) => [Math.round(10 * x) / 10, Math.round(10 * y) / 10]),
    );
  }

  private distance(a: Point, b: Point): number {
    return Math.hypot(a[0] - b[0], a[1] - b[1]) * this.pane.scale;
  }

  private render(): void {
    const shapes = this.regions.flatMap(({ region, colour }, i) =>
      this.shapeOf(region, colour, String(i + 1)),
    );
    if (this.kind && this.points.length > 1) {
      const open = { name: "", kind: this.kind, points: this.points };
      shapes.push(...this.shapeOf(open, "#fff", ""));
    }
    this.sheet.replaceChildren(...shapes);
  }

  private shapeOf(region: Region, colour: string, label: string): SVGElement[] {
    const box = this.pane.host.getBoundingClientRect();
    const place = (point: Point): Point => {
      const [x, y] = this.pane.pageOf(...point);
      return [x - box.left, y - box.top];
    };
    const corners = cornersOf(region).map(place);
    const make = (kind: string): SVGElement => {
      if (region.kind !== "circle")
        return draw("polygon", { points: joined(corners), class: kind });
      const [cx, cy] = corners[0]!;
      return draw("circle", { cx, cy, r: radiusOf(corners), class: kind });
    };
    const [x, y] = corners[0]!;
    const line = make("region-line");
    line.style.stroke = colour;
    const text = label && draw("text", { x, y, class: "region-number" }, label);
    return [make("region-edge"), line, ...(text ? [text] : [])];
  }
}
