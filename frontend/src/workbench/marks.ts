// Pairs drawn on a canvas: kept ones green to red by their error, removed ones as crosses, check points as diamonds.
import type { Point } from "../shared/pane";
import { ink } from "../shared/theme";
import type { PlaneMap } from "./maps";
import { errorColour, isMarked, shareOf } from "./record";
import type { Filter, Half, Partner, SessionState } from "./record";

const BINS = 16;
const REMOVED = BINS;
const LEAST_LINE = 1.5; // px of the screen
const EDGE = 9; // px round the canvas in which marks still show
const LARGE = 3.6; // radius of a mark that stands out
const GREY = "#9a9a9a";
const RIM = "#000b";
const OUTLINE = "#40c8eb"; // cyan is rare in paintings; the report draws it so too

/** Places on screen of the pairs in view, and the shade of each. */
interface InView {
  x: Float32Array;
  y: Float32Array;
  bin: Uint8Array;
  count: number;
  /** Rows that are drawn one by one: check points, and what a person set. */
  special: number[];
}

/** What is drawn, and how places of a picture become places on the canvas. */
export interface Scene {
  session: SessionState;
  selected: number;
  /** Which of the two places of a pair this picture shows. */
  half: Half;
  place: PlaneMap;
  /** Target px to reference px; null where there is no map yet. */
  map: PlaneMap | null;
  /** Screen pixels a pixel of the reference: both pictures show the same place alike. */
  scale: number;
  /** Which pairs are drawn. */
  filter: Filter;
}

/** Draw all pairs over a picture. */
export function paintPairs(context: CanvasRenderingContext2D, scene: Scene): void {
  const { session, selected, half, place, map, scale, filter } = scene;
  const light = ink("--error-light") || "45%";
  const colour = (share: number): string =>
    errorColour(share, 1).replace("var(--error-light)", light);
  const at = affineOf(place);
  const radius = Math.min(LARGE, Math.max(1.7, 1 + (100 * scale) / 60));
  const lines = new Path2D();
  const join = (row: number, x: number, y: number): void => {
    if (half !== 0 || !map || !((session.residual[row] ?? 0) * scale > LEAST_LINE)) return;
    const [, , targetX, targetY] = session.pairs[row]!;
    const [endX, endY] = at(...map(targetX, targetY));
    lines.moveTo(x, y);
    lines.lineTo(endX, endY);
  };
  const shows = (row: number): boolean => row !== selected && isMarked(session, row, filter);
  const visible = findInView(context.canvas, session, half, at, shows, join);
  context.lineWidth = 0.4 + radius / 4;
  context.strokeStyle = "#ddd";
  context.stroke(lines);
  paintOrdinary(context, visible, radius, colour);
  for (const row of [...visible.special, ...(selected in session.pairs ? [selected] : [])]) {
    const pair = session.pairs[row]!;
    const [x, y] = at(pair[half], pair[half + 1]!);
    const kind = row === selected || session.hand[row] === "" ? "circle" : "square";
    if (session.state[row] === "removed") cross(context, x, y, 0.8 * LARGE, `${GREY}cc`);
    else if (session.state[row] === "check") diamond(context, x, y);
    else dot(context, x, y, kind, colour(shareOf(session, row)));
    if (row === selected) rings(context, x, y, 5, 2.5);
  }
}

/** Draw the outline of the object, within which pictures are compared, over the reference. */
export function paintOutline(
  context: CanvasRenderingContext2D,
  corners: readonly Point[],
  place: PlaneMap,
  handles: { closed: boolean; chosen: number } | null = null,
): void {
  if (!corners.length) return;
  const [path, squares] = [new Path2D(), new Path2D()];
  for (const [x, y] of corners) path.lineTo(...place(x, y));
  if (handles?.closed ?? true) path.closePath();
  outline(context, path, OUTLINE, 3, 1.4);
  if (!handles) return;
  for (const [x, y] of corners.map((corner) => place(...corner))) squares.rect(x - 4, y - 4, 8, 8);
  fill(context, squares, OUTLINE);
  const chosen = corners[handles.chosen];
  if (chosen) rings(context, ...place(...chosen), 4, 2);
}

/** Views are affine: three places say where all the others are. */
function affineOf(place: PlaneMap): PlaneMap {
  const [o, ex, ey] = [place(0, 0), place(1000, 0), place(0, 1000)];
  const [ax, ay] = [(ex[0] - o[0]) / 1000, (ex[1] - o[1]) / 1000];
  const [bx, by] = [(ey[0] - o[0]) / 1000, (ey[1] - o[1]) / 1000];
  return (x, y) => [o[0] + ax * x + bx * y, o[1] + ay * x + by * y];
}

function findInView(
  { clientWidth, clientHeight }: HTMLCanvasElement,
  session: SessionState,
  half: Half,
  at: PlaneMap,
  shows: (row: number) => boolean,
  join: (row: number, x: number, y: number) => void,
): InView {
  const n = session.pairs.length;
  const bin = new Uint8Array(n);
  const visible: InView = {
    x: new Float32Array(n),
    y: new Float32Array(n),
    bin,
    count: 0,
    special: [],
  };
  for (let row = 0; row < n; row++) {
    const pair = session.pairs[row]!;
    const [x, y] = at(pair[half], pair[half + 1]!);
    if (x < -EDGE || y < -EDGE || x > clientWidth + EDGE || y > clientHeight + EDGE) continue;
    if (!shows(row)) continue;
    const state = session.state[row]!;
    if (state === "check" || (state === "kept" && session.hand[row] !== "")) {
      visible.special.push(row);
      continue;
    }
    if (state === "kept") join(row, x, y);
    const share = shareOf(session, row);
    bin[visible.count] = state === "removed" ? REMOVED : Math.round(share * (BINS - 1));
    visible.x[visible.count] = x;
    visible.y[visible.count++] = y;
  }
  return visible;
}

/** Circles with a rim, as paths of one shade each. */
function paintOrdinary(
  context: CanvasRenderingContext2D,
  visible: InView,
  radius: number,
  colour: (share: number) => string,
): void {
  const bins = Array.from({ length: BINS + 1 }, () => new Path2D());
  for (let i = 0; i < visible.count; i++) {
    const [x, y, path] = [visible.x[i]!, visible.y[i]!, bins[visible.bin[i]!]!];
    if (visible.bin[i] === REMOVED) addCross(path, x, y, 0.8 * radius);
    else {
      path.moveTo(x + radius, y);
      path.arc(x, y, radius, 0, 2 * Math.PI);
    }
  }
  context.strokeStyle = `${GREY}cc`;
  context.stroke(bins[REMOVED]!);
  for (let bin = 0; bin < BINS; bin++) {
    context.fillStyle = colour(bin / (BINS - 1));
    context.fill(bins[bin]!);
    context.strokeStyle = RIM;
    context.stroke(bins[bin]!);
  }
}

/** Draw a proposed or measured pair: where the map puts it, and where it is. */
export function paintProposal(
  context: CanvasRenderingContext2D,
  { pair, predicted, sure }: Pick<Partner, "pair" | "predicted" | "sure">,
  half: Half,
  place: PlaneMap,
): void {
  const [x, y] = place(pair[half], pair[half + 1]!);
  line(context, place(predicted[half], predicted[half + 1]!), [x, y]);
  outline(context, hair([x, y]), sure ? "#7fe39b" : "#ffd166", 4, 1.8);
}

/** Draw where the middle of the view is, for who has no pointer. */
export function paintMiddle(context: CanvasRenderingContext2D, at: Point): void {
  outline(context, hair(at), "#fff", 3.5, 1.2);
}

/** Four lines towards a place, which stays free. */
function hair([x, y]: Point): Path2D {
  const path = new Path2D();
  for (const [dx, dy] of [
    [1, 0],
    [-1, 0],
    [0, 1],
    [0, -1],
  ] as const) {
    path.moveTo(x + 4 * dx, y + 4 * dy);
    path.lineTo(x + 14 * dx, y + 14 * dy);
  }
  return path;
}

/** Draw the selected pair in an overlay: its place in the reference, and the handle of the other one. */
export function paintHandle(context: CanvasRenderingContext2D, here: Point, there: Point): void {
  line(context, here, there);
  rings(context, ...here, 4, 2);
  const path = new Path2D();
  path.rect(there[0] - 4, there[1] - 4, 8, 8);
  outline(context, path, "#fff", 4, 1.6);
}

function line(context: CanvasRenderingContext2D, from: Point, to: Point): void {
  const apart = Math.hypot(to[0] - from[0], to[1] - from[1]);
  if (!(apart >= LEAST_LINE)) return;
  context.strokeStyle = "#ddd";
  context.lineWidth = 1.4;
  context.beginPath();
  context.moveTo(...from);
  context.lineTo(...to);
  context.stroke();
}

/** Stroke a path in a colour on a dark ground, to be visible on any picture. */
function outline(
  context: CanvasRenderingContext2D,
  path: Path2D,
  colour: string,
  wide: number,
  narrow: number,
  ground = "#000a",
): void {
  for (const [strokeStyle, lineWidth] of [
    [ground, wide],
    [colour, narrow],
  ] as const) {
    Object.assign(context, { strokeStyle, lineWidth });
    context.stroke(path);
  }
}

function rings(
  context: CanvasRenderingContext2D,
  x: number,
  y: number,
  wide: number,
  narrow: number,
): void {
  const path = new Path2D();
  path.arc(x, y, EDGE, 0, 2 * Math.PI);
  outline(context, path, ink("--gold") || "#d9b45b", wide, narrow, "#fff");
}

function addCross(path: Path2D, x: number, y: number, r: number): void {
  path.moveTo(x - r, y - r);
  path.lineTo(x + r, y + r);
  path.moveTo(x - r, y + r);
  path.lineTo(x + r, y - r);
}

function cross(
  context: CanvasRenderingContext2D,
  x: number,
  y: number,
  r: number,
  colour: string,
): void {
  const path = new Path2D();
  addCross(path, x, y, r);
  Object.assign(context, { strokeStyle: colour, lineWidth: 0.4 + LARGE / 4 });
  context.stroke(path);
}

function diamond(context: CanvasRenderingContext2D, x: number, y: number): void {
  const path = new Path2D();
  for (const [dx, dy] of [
    [0, -5],
    [5, 0],
    [0, 5],
    [-5, 0],
  ] as const)
    path.lineTo(x + dx, y + dy);
  path.closePath();
  fill(context, path, "#4da3ff");
}

function dot(
  context: CanvasRenderingContext2D,
  x: number,
  y: number,
  kind: "circle" | "square",
  colour: string,
): void {
  const path = new Path2D();
  if (kind === "square") path.rect(x - 4, y - 4, 8, 8);
  else path.arc(x, y, LARGE, 0, 2 * Math.PI);
  fill(context, path, colour);
}

function fill(context: CanvasRenderingContext2D, path: Path2D, colour: string): void {
  Object.assign(context, { fillStyle: colour, strokeStyle: RIM, lineWidth: 0.4 + LARGE / 4 });
  context.fill(path);
  context.stroke(path);
}
