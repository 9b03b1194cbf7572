// Regions of the painting: rectangles, circles and polygons, and which pixels lie within.
import type { Point } from "../shared/pane";

export type Kind = "rectangle" | "circle" | "polygon";

/** A region: of a rectangle two corners, of a circle its centre and a place on it, of a polygon all corners, px. */
export interface Region {
  name: string;
  kind: Kind;
  points: Point[];
}

/** Least x and y, largest x and y. */
export type Bounds = [x0: number, y0: number, x1: number, y1: number];

export const KINDS: Kind[] = ["rectangle", "circle", "polygon"];
const MOST_POINTS = 200;

/** Whether a region has as many points as it takes. */
export function isWhole({ kind, points }: Region): boolean {
  return kind === "polygon" ? points.length >= 3 : points.length === 2;
}

/** The radius of a circle, px. */
export function radiusOf([centre, edge]: Point[]): number {
  return Math.hypot(edge![0] - centre![0], edge![1] - centre![1]);
}

/** The corners of a rectangle, from pixel to pixel, both included, or of a polygon. */
export function cornersOf({ kind, points }: Region): Point[] {
  if (kind !== "rectangle") return points;
  const [x0, y0, x1, y1] = around(points.map(([x, y]) => [Math.round(x), Math.round(y)]));
  return [
    [x0 - 0.5, y0 - 0.5],
    [x1 + 0.5, y0 - 0.5],
    [x1 + 0.5, y1 + 0.5],
    [x0 - 0.5, y1 + 0.5],
  ];
}

function around(points: Point[]): Bounds {
  const [xs, ys] = [points.map(([x]) => x), points.map(([, y]) => y)];
  return [Math.min(...xs), Math.min(...ys), Math.max(...xs), Math.max(...ys)];
}

export function boundsOf(region: Region): Bounds {
  if (region.kind !== "circle") return around(cornersOf(region));
  const [[x, y], r] = [region.points[0]!, radiusOf(region.points)];
  return [x - r, y - r, x + r, y + r];
}

/** Whether the centre of a pixel lies within; of a polygon by the even-odd rule, as `layer.region` has it. */
export function contains(region: Region): (x: number, y: number) => boolean {
  if (region.kind === "circle") {
    const [[cx, cy], r] = [region.points[0]!, radiusOf(region.points)];
    return (x, y) => (x - cx) ** 2 + (y - cy) ** 2 <= r * r;
  }
  const corners = cornersOf(region);
  return (x, y) => {
    let inside = false;
    for (let i = 0, j = corners.length - 1; i < corners.length; j = i++) {
      const [[ax, ay], [bx, by]] = [corners[j]!, corners[i]!];
      if (ay > y !== by > y && x < ax + ((y - ay) / (by - ay)) * (bx - ax)) inside = !inside;
    }
    return inside;
  };
}

/** A region as the address of a page holds it: kind;x y x y …;name. */
export function toText({ kind, points, name }: Region): string {
  return [
    kind,
    points
      .flat()
      .map((at) => at.toFixed(1))
      .join(" "),
    name,
  ].join(";");
}

/** Read a region from an address; null where it is none. */
export function fromText(text: string, longest: number): Region | null {
  const [kind, numbers = "", ...rest] = text.split(";");
  const values = numbers.split(" ").map(Number);
  if (values.length % 2 || values.length > 2 * MOST_POINTS || !values.every(Number.isFinite))
    return null;
  const points = values.flatMap<Point>((x, i) => (i % 2 ? [] : [[x, values[i + 1]!]]));
  const known = KINDS.find((one) => one === kind);
  const region = known && { kind: known, points, name: rest.join(";").slice(0, longest) };
  return region && isWhole(region) ? region : null;
}
