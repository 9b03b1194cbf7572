// Maps between the pictures, as the server sent them: polynomials target → reference, and back by Newton's steps.
import type { Point } from "../shared/pane";
import type { Numbers, Trace } from "./record";

export type PlaneMap = (x: number, y: number) => Point;

/** The map of a round: -1 is the start, under scale alone. */
export function mapOf(trace: Trace, round: number): PlaneMap {
  if (round < 0) return affine(trace.scale);
  let at = 0;
  while (at + 1 < trace.rounds.length && trace.rounds[at + 1]! <= round) at++;
  const terms = (trace.order + 1) * (trace.order + 2);
  return polynomial(
    trace.order,
    trace.centre,
    trace.spread,
    trace.models.subarray(at * terms, (at + 1) * terms),
  );
}

function affine(m: Trace["scale"]): PlaneMap {
  return (x, y) => [m[0][0] * x + m[0][1] * y + m[0][2], m[1][0] * x + m[1][1] * y + m[1][2]];
}

function polynomial(order: number, centre: Point, spread: number, terms: Numbers): PlaneMap {
  return (x, y) => {
    const u = (x - centre[0]) / spread;
    const v = (y - centre[1]) / spread;
    let [a, b, at] = [0, 0, 0];
    for (let degree = 0; degree <= order; degree++)
      for (let j = 0; j <= degree; j++, at += 2) {
        let value = 1;
        for (let k = j; k < degree; k++) value *= u;
        for (let k = 0; k < j; k++) value *= v;
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
