// Pairs drawn on a canvas: kept ones green to red by their error, removed ones hollow, check points as diamonds.
import type { Map2 } from "./maps";
import { errorColour, type Partner, type Point, type Told } from "./record";

type Place = (x: number, y: number) => Point;

const BINS = 16;
const MANY = 3000;

export function paintPairs(context: CanvasRenderingContext2D, told: Told, selected: number, part: 0 | 2, place: Place, map: Map2 | null): void {
  const style = getComputedStyle(document.documentElement);
  const light = style.getPropertyValue("--error-light").trim() || "45%";
  const colour = (share: number): string => errorColour(share, 1).replace("var(--error-light)", light);
  const [width, height] = [context.canvas.clientWidth, context.canvas.clientHeight];
  // Maps of the view are affine: three places tell where all the others are.
  const [o, ex, ey] = [place(0, 0), place(1000, 0), place(0, 1000)];
  const [ax, ay, bx, by] = [(ex[0] - o[0]) / 1000, (ex[1] - o[1]) / 1000, (ey[0] - o[0]) / 1000, (ey[1] - o[1]) / 1000];
  const at = (x: number, y: number): Point => [o[0] + ax * x + bx * y, o[1] + ay * x + by * y];
  const radius = Math.min(3.6, Math.max(1.7, 1 + (100 * Math.hypot(ax, ay)) / 60));
  const bins = Array.from({ length: BINS }, () => new Path2D());
  const [removed, lines] = [new Path2D(), new Path2D()];
  const special: number[] = [];
  const square = told.pairs.length > MANY;
  for (let row = 0; row < told.pairs.length; row++) {
    const pair = told.pairs[row]!;
    const [x, y] = at(pair[part], pair[part + 1]!);
    if (x < -9 || y < -9 || x > width + 9 || y > height + 9) continue;
    const state = told.state[row]!;
    if (row === selected || state === "check" || (state === "kept" && told.reason[row] !== "")) {
      special.push(row);
      continue;
    }
    if (state === "removed") {
      const r = 0.8 * radius;
      removed.moveTo(x - r, y - r);
      removed.lineTo(x + r, y + r);
      removed.moveTo(x - r, y + r);
      removed.lineTo(x + r, y - r);
      continue;
    }
    if (part === 0 && map) {
      const [a, b] = at(...map(pair[2], pair[3]));
      if (Math.hypot(a - x, b - y) > 1.5) {
        lines.moveTo(x, y);
        lines.lineTo(a, b);
      }
    }
    const share = Math.min(1, (told.residual[row] ?? 0) / Math.max(told.stop, 1e-9));
    const path = bins[Math.round(share * (BINS - 1))]!;
    if (square) path.rect(x - radius, y - radius, 2 * radius, 2 * radius);
    else {
      path.moveTo(x + radius, y);
      path.arc(x, y, radius, 0, 2 * Math.PI);
    }
  }
  context.lineWidth = 0.4 + radius / 4;
  context.strokeStyle = "#9a9a9acc";
  context.stroke(removed);
  context.strokeStyle = "#ddd";
  context.stroke(lines);
  bins.forEach((path, bin) => {
    context.fillStyle = colour(bin / (BINS - 1));
    context.fill(path);
    if (square) return;
    context.strokeStyle = "#000b";
    context.stroke(path);
  });
  for (const row of special) {
    const pair = told.pairs[row]!;
    const [x, y] = at(pair[part], pair[part + 1]!);
    const share = Math.min(1, (told.residual[row] ?? 0) / Math.max(told.stop, 1e-9));
    if (row !== selected) mark(context, x, y, told.state[row]!, colour(share), told.reason[row] !== "", 3.6);
  }
  const pair = told.pairs[selected];
  if (!pair) return;
  const [x, y] = place(pair[part], pair[part + 1]!);
  const share = Math.min(1, (told.residual[selected] ?? 0) / Math.max(told.stop, 1e-9));
  mark(context, x, y, told.state[selected]!, colour(share), false, 3.6);
  ring(context, x, y, "#fff", 5);
  ring(context, x, y, style.getPropertyValue("--gold").trim() || "#d9b45b", 2.5);
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
  const style = getComputedStyle(document.documentElement);
  ring(context, here[0], here[1], "#fff", 4);
  ring(context, here[0], here[1], style.getPropertyValue("--gold").trim() || "#d9b45b", 2);
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
