// Pairs drawn on a canvas: kept ones green to red by their error, removed ones hollow, check points as diamonds.
import { ink } from "../theme";
import { Dots, packed } from "./dots";
import type { Map2 } from "./maps";
import { errorColour, shareOf, type Partner, type Point, type Told } from "./record";

type Place = (x: number, y: number) => Point;

const BINS = 16;
const REMOVED = BINS;
const MANY = 3000;
const LEAST_LINE = 1.5; // px of the screen
const GREY = "#9a9a9a";

/** Places on screen of the pairs in view, and the shade of each. */
interface InView {
  x: Float32Array;
  y: Float32Array;
  bin: Uint8Array;
  count: number;
  special: number[];
}

/** Draw all pairs over a picture; `scale` is that of the reference, screen pixels a pixel. */
export function paintPairs(context: CanvasRenderingContext2D, dots: Dots, told: Told, selected: number, part: 0 | 2, place: Place, map: Map2 | null, scale: number): void {
  const light = ink("--error-light") || "45%";
  const colour = (share: number): string => errorColour(share, 1).replace("var(--error-light)", light);
  // Maps of the view are affine: three places tell where all the others are.
  const [o, ex, ey] = [place(0, 0), place(1000, 0), place(0, 1000)];
  const [ax, ay, bx, by] = [(ex[0] - o[0]) / 1000, (ex[1] - o[1]) / 1000, (ey[0] - o[0]) / 1000, (ey[1] - o[1]) / 1000];
  const at = (x: number, y: number): Point => [o[0] + ax * x + bx * y, o[1] + ay * x + by * y];
  // By the scale of the reference: both pictures show the same place alike.
  const radius = Math.min(3.6, Math.max(1.7, 1 + (100 * scale) / 60));
  const lines = new Path2D();
  const join = (row: number, x: number, y: number): void => {
    if (part !== 0 || !map || !(told.residual[row]! * scale > LEAST_LINE)) return;
    lines.moveTo(x, y);
    lines.lineTo(...at(...map(told.pairs[row]![2], told.pairs[row]![3])));
  };
  const seen = findInView(context, told, selected, part, at, join);
  context.lineWidth = 0.4 + radius / 4;
  context.strokeStyle = "#ddd";
  context.stroke(lines);
  if (seen.count > MANY) paintMany(context, dots, seen, radius, colour);
  else paintFew(context, seen, radius, colour);
  for (const row of seen.special) {
    const pair = told.pairs[row]!;
    const [x, y] = at(pair[part], pair[part + 1]!);
    if (row !== selected) mark(context, x, y, told.state[row]!, colour(shareOf(told, row)), told.reason[row] !== "", 3.6);
  }
  const pair = told.pairs[selected];
  if (!pair) return;
  const [x, y] = place(pair[part], pair[part + 1]!);
  mark(context, x, y, told.state[selected]!, colour(shareOf(told, selected)), false, 3.6);
  ring(context, x, y, "#fff", 5);
  ring(context, x, y, ink("--gold") || "#d9b45b", 2.5);
}

function findInView(context: CanvasRenderingContext2D, told: Told, selected: number, part: 0 | 2, at: Place, join: (row: number, x: number, y: number) => void): InView {
  const [width, height] = [context.canvas.clientWidth, context.canvas.clientHeight];
  const n = told.pairs.length;
  const seen: InView = { x: new Float32Array(n), y: new Float32Array(n), bin: new Uint8Array(n), count: 0, special: [] };
  for (let row = 0; row < n; row++) {
    const pair = told.pairs[row]!;
    const [x, y] = at(pair[part], pair[part + 1]!);
    if (x < -9 || y < -9 || x > width + 9 || y > height + 9) continue;
    const state = told.state[row]!;
    if (row === selected || state === "check" || (state === "kept" && told.reason[row] !== "")) {
      seen.special.push(row);
      continue;
    }
    if (state === "kept") join(row, x, y);
    seen.bin[seen.count] = state === "removed" ? REMOVED : Math.round(shareOf(told, row) * (BINS - 1));
    seen.x[seen.count] = x;
    seen.y[seen.count++] = y;
  }
  return seen;
}

/** Circles with a rim, as paths of one shade each. */
function paintFew(context: CanvasRenderingContext2D, seen: InView, radius: number, colour: (share: number) => string): void {
  const bins = Array.from({ length: BINS + 1 }, () => new Path2D());
  const r = 0.8 * radius;
  for (let i = 0; i < seen.count; i++) {
    const [x, y, path] = [seen.x[i]!, seen.y[i]!, bins[seen.bin[i]!]!];
    if (seen.bin[i] === REMOVED) {
      path.moveTo(x - r, y - r);
      path.lineTo(x + r, y + r);
      path.moveTo(x - r, y + r);
      path.lineTo(x + r, y - r);
    } else {
      path.moveTo(x + radius, y);
      path.arc(x, y, radius, 0, 2 * Math.PI);
    }
  }
  context.strokeStyle = `${GREY}cc`;
  context.stroke(bins[REMOVED]!);
  for (let bin = 0; bin < BINS; bin++) {
    context.fillStyle = colour(bin / (BINS - 1));
    context.fill(bins[bin]!);
    context.strokeStyle = "#000b";
    context.stroke(bins[bin]!);
  }
}

/** Squares without one, the worst on top. */
function paintMany(context: CanvasRenderingContext2D, dots: Dots, seen: InView, radius: number, colour: (share: number) => string): void {
  const ratio = devicePixelRatio || 1;
  const side = Math.round(2 * radius * ratio);
  dots.begin(context.canvas.width, context.canvas.height);
  const rows = Array.from({ length: BINS + 1 }, (): number[] => []);
  for (let i = 0; i < seen.count; i++) rows[seen.bin[i]!]!.push(i);
  const grey = packed(GREY, context, 0.8);
  for (const i of rows[REMOVED]!) dots.cross(seen.x[i]! * ratio, seen.y[i]! * ratio, side, grey);
  for (let bin = 0; bin < BINS; bin++) {
    const pixel = packed(colour(bin / (BINS - 1)), context);
    for (const i of rows[bin]!) dots.square(seen.x[i]! * ratio, seen.y[i]! * ratio, side, pixel);
  }
  dots.drawOn(context);
}

export function paintProposal(context: CanvasRenderingContext2D, partner: Pick<Partner, "pair" | "predicted" | "sure">, part: 0 | 2, place: Place): void {
  const [x, y] = place(partner.pair[part], partner.pair[part + 1]!);
  const [a, b] = place(partner.predicted[part], partner.predicted[part + 1]!);
  line(context, [a, b], [x, y]);
  for (const [colour, width] of [["#000a", 4], [partner.sure ? "#7fe39b" : "#ffd166", 1.8]] as const) {
    context.strokeStyle = colour;
    context.lineWidth = width;
    context.beginPath();
    for (const [dx, dy] of [[1, 0], [-1, 0], [0, 1], [0, -1]] as const) {
      context.moveTo(x + 4 * dx, y + 4 * dy);
      context.lineTo(x + 14 * dx, y + 14 * dy);
    }
    context.stroke();
  }
}

/** The chosen pair in an overlay: its place in the reference, and the handle of the other one. */
export function paintHandle(context: CanvasRenderingContext2D, here: Point, there: Point): void {
  line(context, here, there);
  ring(context, here[0], here[1], "#fff", 4);
  ring(context, here[0], here[1], ink("--gold") || "#d9b45b", 2);
  for (const [colour, width] of [["#000a", 4], ["#fff", 1.6]] as const) {
    context.strokeStyle = colour;
    context.lineWidth = width;
    context.strokeRect(there[0] - 4, there[1] - 4, 8, 8);
  }
}

function line(context: CanvasRenderingContext2D, from: Point, to: Point): void {
  if (!Number.isFinite(to[0] + to[1]) || Math.hypot(to[0] - from[0], to[1] - from[1]) < 1.5) return;
  context.strokeStyle = "#ddd";
  context.lineWidth = 1.4;
  context.beginPath();
  context.moveTo(...from);
  context.lineTo(...to);
  context.stroke();
}

function mark(context: CanvasRenderingContext2D, x: number, y: number, state: string, colour: string, byHand: boolean, radius: number): void {
  context.lineWidth = 0.4 + radius / 4;
  if (state === "removed") {
    context.strokeStyle = "#9a9a9acc";
    context.beginPath();
    const r = 0.8 * radius;
    context.moveTo(x - r, y - r);
    context.lineTo(x + r, y + r);
    context.moveTo(x - r, y + r);
    context.lineTo(x + r, y - r);
    context.stroke();
    return;
  }
  context.strokeStyle = "#000b";
  context.fillStyle = state === "check" ? "#4da3ff" : colour;
  context.beginPath();
  if (state === "check") {
    context.moveTo(x, y - 5);
    context.lineTo(x + 5, y);
    context.lineTo(x, y + 5);
    context.lineTo(x - 5, y);
    context.closePath();
  } else if (byHand) context.rect(x - 4, y - 4, 8, 8);
  else context.arc(x, y, radius, 0, 2 * Math.PI);
  context.fill();
  context.stroke();
}

function ring(context: CanvasRenderingContext2D, x: number, y: number, colour: string, width: number): void {
  context.strokeStyle = colour;
  context.lineWidth = width;
  context.beginPath();
  context.arc(x, y, 9, 0, 2 * Math.PI);
  context.stroke();
}
