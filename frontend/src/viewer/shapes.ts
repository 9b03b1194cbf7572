// Shapes on the painting: places, lines, rectangles, circles and polygons; their lengths, areas and pixels.
import type { Point } from "../shared/pane";

/** A shape: of a rectangle two corners, of a circle its centre and a place on it, else all corners, px. */
export interface Shape {
  kind: ShapeKind;
  points: Point[];
}
export type ShapeKind = Kind | "line" | "place";
/** Shapes that have an area. */
export type Kind = "rectangle" | "circle" | "polygon";

/** A part of the painting that is measured. */
export interface Region {
  name: string;
  kind: Kind;
  points: Point[];
}

/** Least x and y, largest x and y. */
export type Bounds = [x0: number, y0: number, x1: number, y1: number];

export const KINDS: Kind[] = ["rectangle", "circle", "polygon"];
export const MOST_POINTS = 200;
const LEAST_POINTS = { place: 1, line: 2, rectangle: 2, circle: 2, polygon: 3 };

/** Whether a shape has as many points as it takes. */
export function isWhole({ kind, points }: Shape): boolean {
  const least = LEAST_POINTS[kind];
  const open = kind === "polygon" || kind === "line";
  return points.length >= least && points.length <= (open ? MOST_POINTS : least);
}

/** The radius of a circle, px. */
export function radiusOf([centre, edge]: Point[]): number {
  return Math.hypot(edge![0] - centre![0], edge![1] - centre![1]);
}

/** The corners of a rectangle, from pixel to pixel, both included, or of another shape. */
export function cornersOf({ kind, points }: Shape): Point[] {
  if (kind !== "rectangle") return points;
  const [x0, y0, x1, y1] = around(points.map(([x, y]) => [Math.round(x), Math.round(y)]));
  return [
    [x0 - 0.5, y0 - 0.5],
    [x1 + 0.5, y0 - 0.5],
    [x1 + 0.5, y1 + 0.5],
    [x0 - 0.5, y1 + 0.5],
  ];
}

/** The length of a line, px, or how long it is round another shape. */
export function lengthOf(shape: Shape): number {
  if (shape.kind === "circle") return 2 * Math.PI * radiusOf(shape.points);
  const corners = cornersOf(shape);
  const last = shape.kind === "line" ? corners[0]! : corners.at(-1)!;
  let [sum, before] = [0, last];
  for (const corner of corners) {
    sum += Math.hypot(corner[0] - before[0], corner[1] - before[1]);
    before = corner;
  }
  return sum;
}

/** The area of a shape, px²; that of a polygon without the places that it covers twice the other way round. */
export function areaOf(shape: Shape): number {
  if (shape.kind === "circle") return Math.PI * radiusOf(shape.points) ** 2;
  if (shape.kind === "line" || shape.kind === "place") return 0;
  const corners = cornersOf(shape);
  let [twice, before] = [0, corners.at(-1)!];
  for (const corner of corners) {
    twice += before[0] * corner[1] - corner[0] * before[1];
    before = corner;
  }
  return Math.abs(twice) / 2;
}

function around(points: Point[]): Bounds {
  const [xs, ys] = [points.map(([x]) => x), points.map(([, y]) => y)];
  return [Math.min(...xs), Math.min(...ys), Math.max(...xs), Math.max(...ys)];
}

export function boundsOf(shape: Shape): Bounds {
  if (shape.kind !== "circle") return around(cornersOf(shape));
  const [[x, y], r] = [shape.points[0]!, radiusOf(shape.points)];
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

/** A named shape as the address of a page holds it: kind;x y x y …;name. */
export function toText({ kind, points, name }: Shape & { name: string }): string {
  return [
    kind,
    points
      .flat()
      .map((at) => at.toFixed(1))
      .join(" "),
    name,
  ].join(";");
}

/** Read a named shape of some kinds from an address; null where it is none. */
export function fromText<K extends ShapeKind>(
  text: string,
  kinds: readonly K[],
  longest: number,
): { name: string; kind: K; points: Point[] } | null {
  const [kind, numbers = "", ...rest] = text.split(";");
  const values = numbers.split(" ").map(Number);
  if (values.length % 2 || values.length > 2 * MOST_POINTS || !values.every(Number.isFinite))
    return null;
  const points = values.flatMap<Point>((x, i) => (i % 2 ? [] : [[x, values[i + 1]!]]));
  const known = kinds.find((one) => one === kind);
  const shape = known && { kind: known, points, name: rest.join(";").slice(0, longest) };
  return shape && isWhole(shape) ? shape : null;
}
