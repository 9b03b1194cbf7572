// Maps between the pictures, as the server sent them: polynomials target → reference, and back by Newton's steps.
import type { Point } from "../shared/pane";
import type { Polynomial } from "./record";

export type PlaneMap = (x: number, y: number) => Point;

/** Target px → reference px. */
export function mapOf({ order, centre, spread, terms }: Polynomial): PlaneMap {
  return (x, y) => {
    const u = (x - centre[0]) / spread;
    const v = (y - centre[1]) / spread;
    let [a, b, at] = [0, 0, 0];
    for (let degree = 0; degree <= order; degree++)
      for (let j = 0; j <= degree; j++, at += 2) {
        const value = u ** (degree - j) * v ** j;
        a += terms[at]! * value;
        b += terms[at + 1]! * value;
      }
    return [a, b];
  };
}

/** Where a map leads to `to`, from a guess. */
export function invert(map: PlaneMap, to: Point, guess: Point): Point {
  let [x, y] = guess;
  for (let step = 0; step < 12; step++) {
    const [a, b] = map(x, y);
    const [e, f] = [to[0] - a, to[1] - b];
    if (Math.hypot(e, f) < 1e-4) break;
    const { ax, bx, ay, by, det } = slopes(map, x, y);
    if (!Number.isFinite(det) || Math.abs(det) < 1e-12) break;
    x += (e * by - f * ay) / det;
    y += (f * ax - e * bx) / det;
  }
  return [x, y];
}

/** Turn, in degrees, and scale of a map at a place. */
export function turnAndScale(
  map: PlaneMap,
  x: number,
  y: number,
): { degrees: number; scale: number; mirrored: boolean } {
  const { ax, bx, det } = slopes(map, x, y);
  const degrees = (Math.atan2(bx, ax) * 180) / Math.PI;
  return { degrees, scale: Math.sqrt(Math.abs(det)), mirrored: det < 0 };
}

/** Derivatives of a map (a, b) along x and y, over a pixel, and their determinant. */
function slopes(map: PlaneMap, x: number, y: number) {
  const [a, b] = map(x, y);
  const [a1, b1] = map(x + 1, y);
  const [a2, b2] = map(x, y + 1);
  const [ax, bx, ay, by] = [a1 - a, b1 - b, a2 - a, b2 - b];
  return { ax, bx, ay, by, det: ax * by - ay * bx };
}
