// The whole picture, small in a corner, with a frame about what is in view.
import { draw, make } from "../shared/element";
import type { Pane, Point } from "../shared/pane";
import { joined } from "../shared/plot";
import { loadWhole } from "./mixing";
import type { Picture } from "./record";

const LONGEST_PX = 150;
const WHOLE = 0.995; // of either side in view: then there is nothing to find

export class Minimap {
  readonly element = make("div", {
    class: "minimap",
    role: "img",
    "aria-label": "The whole picture; the frame is what is in view",
    hidden: true,
  });
  private readonly canvas = make("canvas", {});
  private readonly frame = draw("polygon", { class: "minimap-frame" });
  private readonly edge = draw("polygon", { class: "minimap-edge" });
  private readonly sheet = draw("svg", {}, this.edge, this.frame);
  private picture: Picture | null = null;
  private image: HTMLImageElement | HTMLCanvasElement | null = null;
  private wanted = false;

  /** `go` shows a place of the picture. */
  constructor(
    private readonly pane: Pane,
    private readonly size: Point,
    go: (place: Point) => void,
  ) {
    this.element.append(this.canvas, this.sheet);
    const move = (event: PointerEvent): void => {
      event.preventDefault();
      const box = this.canvas.getBoundingClientRect();
      const middle: Point = [
        event.clientX - box.left - box.width / 2,
        event.clientY - box.top - box.height / 2,
      ];
      const [x, y] = this.pane.along(middle).map((way) => way / this.scale);
      go([x! + size[0] / 2 - 0.5, y! + size[1] / 2 - 0.5]);
    };
    this.element.addEventListener("pointerdown", (event) => {
      this.element.setPointerCapture(event.pointerId);
      move(event);
    });
    this.element.addEventListener("pointermove", (event) => {
      if (this.element.hasPointerCapture(event.pointerId)) move(event);
    });
  }

  set shown(on: boolean) {
    this.wanted = on;
    this.update();
  }

  /** Show another picture; `filter` is that of its levels. */
  async show(picture: Picture, filter: string): Promise<void> {
    this.canvas.style.filter = filter;
    if (picture === this.picture) return;
    this.picture = picture;
    const image = await loadWhole(picture).catch(() => null);
    if (picture !== this.picture) return;
    this.image = image;
    this.paint();
    this.update();
  }

  /** Draw what is in view; call it when the view has changed. */
  update(): void {
    const corners = this.corners();
    const inside = corners.every(([x, y]) => beyond(x, this.size[0]) && beyond(y, this.size[1]));
    this.element.hidden = !this.wanted || !this.image || inside;
    if (this.element.hidden) return;
    this.paint();
    const places = corners.map((corner) => this.place(corner));
    for (const one of [this.edge, this.frame]) one.setAttribute("points", joined(places));
  }

  /** Screen pixels a pixel of the picture. */
  private get scale(): number {
    return LONGEST_PX / Math.max(...this.size);
  }

  private get degrees(): number {
    return this.pane.viewer.viewport.getRotation(true);
  }

  private corners(): Point[] {
    const { clientWidth, clientHeight } = this.pane.host;
    const box = this.pane.host.getBoundingClientRect();
    return [
      [0, 0],
      [clientWidth, 0],
      [clientWidth, clientHeight],
      [0, clientHeight],
    ].map(([x, y]) => this.pane.pixelAt(box.left + x!, box.top + y!));
  }

  /** Where a pixel lies in the small picture, which is turned as the large one is. */
  private place([x, y]: Point): Point {
    const turned = (this.degrees * Math.PI) / 180;
    const [cos, sin] = [Math.cos(turned), Math.sin(turned)];
    const [right, down] = [
      (x + 0.5 - this.size[0] / 2) * this.scale,
      (y + 0.5 - this.size[1] / 2) * this.scale,
    ];
    const { clientWidth, clientHeight } = this.canvas;
    return [
      clientWidth / 2 + cos * right - sin * down,
      clientHeight / 2 + sin * right + cos * down,
    ];
  }

  private paint(): void {
    const aside = Math.round(this.degrees / 90) % 2 !== 0;
    const [across, down] = this.size.map((side) => Math.max(1, Math.round(side * this.scale)));
    const [width, height] = aside ? [down!, across!] : [across!, down!];
    const key = `${width} ${height} ${this.degrees} ${this.picture?.folder} ${this.picture?.key}`;
    if (this.canvas.dataset["key"] === key || !this.image) return;
    this.canvas.dataset["key"] = key;
    const ratio = devicePixelRatio || 1;
    [this.canvas.width, this.canvas.height] = [width * ratio, height * ratio];
    [this.canvas.style.width, this.canvas.style.height] = [`${width}px`, `${height}px`];
    this.sheet.setAttribute("viewBox", `0 0 ${width} ${height}`);
    const context = this.canvas.getContext("2d")!;
    context.setTransform(ratio, 0, 0, ratio, (width * ratio) / 2, (height * ratio) / 2);
    context.rotate((this.degrees * Math.PI) / 180);
    context.drawImage(this.image, -across! / 2, -down! / 2, across!, down!);
  }
}

/** Whether a corner of the view lies at an edge of the picture, or outside. */
const beyond = (at: number, size: number): boolean =>
  at + 0.5 <= (1 - WHOLE) * size || at + 0.5 >= WHOLE * size;
