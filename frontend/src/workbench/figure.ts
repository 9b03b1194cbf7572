// A round of the removal in the reference's coordinates: frames, pairs, and grey lines between their ends.
import { make } from "../shared/element";
import type { Point } from "../shared/pane";
import { ink } from "../shared/theme";
import { Dots, packed } from "./dots";
import { mapOf, type PlaneMap } from "./maps";
import type { Pair, SessionState } from "./record";

const [WIDTH, HEIGHT] = [320, 236];
const DENSITY = 2; // pixels of the canvas a unit
const MARGIN = 0.09;
const MOST_LINES = 1500;
const STEPS = 12; // of each edge of a frame, which a map may bend

type Box = [left: number, top: number, right: number, bottom: number];

export class Figure {
  readonly root = make("canvas", {
    width: DENSITY * WIDTH,
    height: DENSITY * HEIGHT,
    role: "img",
    "aria-label": "The course of the removal of outliers",
  });
  private readonly dots = new Dots();

  /** Draw the pairs `rows` that the fit of a round rests on, turned as the pictures are. */
  draw(session: SessionState | null, round: number, rows: number[], turn: number): void {
    const context = this.root.getContext("2d")!;
    context.setTransform(DENSITY, 0, 0, DENSITY, 0, 0);
    context.clearRect(0, 0, WIDTH, HEIGHT);
    const trace = session?.trace;
    if (!trace) return;
    const map = mapOf(trace, round);
    const frame: Box = [-0.5, -0.5, trace.size[0] - 0.5, trace.size[1] - 0.5];
    const place = placing(frame, turn);
    const bounds = boundsOf(session.pairs);
    outline(context, edge(frame, place), ink("--ink"));
    const moved = (by: PlaneMap) => edge(bounds, (x, y) => place(...by(x, y)));
    outline(context, moved(mapOf(trace, -1)), ink("--reference"));
    if (round >= 0) outline(context, moved(map), ink("--fit"));
    const every = Math.max(1, Math.floor(rows.length / MOST_LINES));
    const ends = rows
      .filter((_, i) => i % every === 0)
      .map((row) => {
        const [x, y, targetX, targetY] = session.pairs[row]!;
        return { here: place(x, y), there: place(...map(targetX, targetY)) };
      });
    context.strokeStyle = "#8888";
    context.lineWidth = 0.8;
    context.beginPath();
    for (const { here, there } of ends) {
      context.moveTo(...here);
      context.lineTo(...there);
    }
    context.stroke();
    this.dots.begin(this.root.width, this.root.height);
    const [blue, red] = [packed(ink("--target"), context), packed(ink("--reference"), context)];
    for (const { there } of ends) this.dot(there, blue);
    for (const { here } of ends) this.dot(here, red);
    this.dots.drawOn(context);
  }

  private dot([x, y]: Point, colour: number): void {
    this.dots.square(DENSITY * x, DENSITY * y, 2 * DENSITY, colour);
  }
}

/** Where the target's places of pairs lie: the frame that is drawn of it. */
export function boundsOf(pairs: readonly Pair[]): Box {
  const box: Box = [Infinity, Infinity, -Infinity, -Infinity];
  for (const [, , x, y] of pairs) {
    box[0] = Math.min(box[0], x);
    box[1] = Math.min(box[1], y);
    box[2] = Math.max(box[2], x);
    box[3] = Math.max(box[3], y);
  }
  return box;
}

/** Places along the edge of a box, clockwise from the upper left corner, as a map lays them. */
export function edge([left, top, right, bottom]: Box, map: PlaneMap): Point[] {
  const corners: Point[] = [
    [left, top],
    [right, top],
    [right, bottom],
    [left, bottom],
  ];
  return corners.flatMap(([x, y], i) => {
    const [nextX, nextY] = corners[(i + 1) % corners.length]!;
    return Array.from({ length: STEPS }, (_, k) =>
      map(x + (k / STEPS) * (nextX - x), y + (k / STEPS) * (nextY - y)),
    );
  });
}

/** Scale, quarter turn and shift that bring a box into the middle of the figure. */
function placing([left, top, right, bottom]: Box, turn: number): PlaneMap {
  const size: Point = [right - left, bottom - top];
  const { place } = placeTurned(size, turn, [WIDTH, HEIGHT], MARGIN);
  return (x, y) => place(x - left, y - top);
}

/** Bring a picture of a size into the middle of a box, turned clockwise by quarters. */
export function placeTurned(
  [width, height]: Point,
  turn: number,
  [across, down]: Point,
  margin: number,
): { place: PlaneMap; scale: number; direction: PlaneMap } {
  const [wide, tall] = turn % 180 ? [height, width] : [width, height];
  const scale = (1 - 2 * margin) * Math.min(across / wide, down / tall);
  const [cosine, sine] = [0, 1].map((quarter) =>
    Math.round(Math.cos(((turn - 90 * quarter) * Math.PI) / 180)),
  ) as Point;
  const direction: PlaneMap = (x, y) => [
    scale * (cosine * x - sine * y),
    scale * (sine * x + cosine * y),
  ];
  const place: PlaneMap = (x, y) => {
    const [dx, dy] = direction(x - width / 2, y - height / 2);
    return [across / 2 + dx, down / 2 + dy];
  };
  return { place, scale, direction };
}

function outline(context: CanvasRenderingContext2D, points: Point[], colour: string): void {
  context.strokeStyle = colour;
  context.lineWidth = 1.4;
  context.beginPath();
  for (const point of points) context.lineTo(...point);
  context.closePath();
  context.stroke();
}
