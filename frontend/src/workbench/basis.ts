// What the map of the default method rests on: windows with their shifts, and windows that were searched freely.
import { effect } from "@preact/signals-core";
import { make } from "../shared/element";
import type { Point } from "../shared/pane";
import { ink, onTheme } from "../shared/theme";
import type { PlaneMap } from "./maps";
import { px, type Basis, type FrameInfo, type Windows } from "./record";
import type { Store } from "./store";

const [WIDTH, HEIGHT] = [320, 236];
const DENSITY = 2; // pixels of the canvas a unit
const MARGIN = 0.05;
const LINE = 12; // about the length of the longer shifts as drawn, units
const LIGHT = 0.5; // windows of less weight are drawn faintly
const LEGEND =
  "Each line leads from the place given by the map to the place found in the picture. " +
  "Circles: windows searched without the map. Filled: they agree with it. Red: they lie elsewhere. Hollow: they were not found.";

export class BasisView {
  readonly root: HTMLElement;
  private readonly canvas = make("canvas", {
    ...{ width: DENSITY * WIDTH, height: DENSITY * HEIGHT },
    ...{
      role: "img",
      "aria-label": "Windows that the map was fitted to, and windows that check it",
    },
  });
  private readonly words = make("p", { class: "status", id: "basis-words" });

  constructor(private readonly store: Store) {
    this.root = make(
      "section",
      { class: "card basis", "aria-labelledby": "basis-head", hidden: true },
      make("h2", { id: "basis-head" }, "Evidence for the map"),
      this.canvas,
      this.words,
      make("p", { class: "soft" }, LEGEND),
    );
    effect(() => this.draw());
    onTheme(() => this.draw());
  }

  private draw(): void {
    const frame = this.store.frame.value;
    const basis = frame?.basis;
    this.root.hidden = !basis;
    if (!frame || !basis) return;
    const { place, scale, direction } = turned(frame);
    const times = enlargement(basis.windows, LINE / scale);
    const context = this.canvas.getContext("2d")!;
    context.setTransform(DENSITY, 0, 0, DENSITY, 0, 0);
    context.clearRect(0, 0, WIDTH, HEIGHT);
    const [left, top] = place(-0.5, -0.5);
    const [right, bottom] = place(frame.size[0] - 0.5, frame.size[1] - 0.5);
    context.strokeStyle = ink("--ink");
    context.strokeRect(left, top, right - left, bottom - top); // of negative width where it is turned
    drawWindows(context, basis.windows, place, (x, y) => direction(times * x, times * y));
    if (basis.checks) drawChecks(context, basis.checks, place);
    this.words.textContent = describe(basis, times);
  }
}

/** Bring the reference into the middle of the drawing, turned clockwise by quarters. */
function turned({ size: [width, height], turn }: FrameInfo): {
  place: PlaneMap;
  scale: number;
  direction: PlaneMap;
} {
  const [wide, tall] = turn % 180 ? [height, width] : [width, height];
  const scale = (1 - 2 * MARGIN) * Math.min(WIDTH / wide, HEIGHT / tall);
  const [cosine, sine] = [0, 1].map((quarter) =>
    Math.round(Math.cos(((turn - 90 * quarter) * Math.PI) / 180)),
  ) as Point;
  const direction: PlaneMap = (x, y) => [
    scale * (cosine * x - sine * y),
    scale * (sine * x + cosine * y),
  ];
  const place: PlaneMap = (x, y) => {
    const [dx, dy] = direction(x + 0.5 - width / 2, y + 0.5 - height / 2);
    return [WIDTH / 2 + dx, HEIGHT / 2 + dy];
  };
  return { place, scale, direction };
}

function drawWindows(
  context: CanvasRenderingContext2D,
  { x, y, shift_x, shift_y, weight }: Windows,
  place: PlaneMap,
  direction: PlaneMap,
): void {
  for (let i = 0; i < x.length; i++) {
    const [left, top] = place(x[i]!, y[i]!);
    let [along, down] = direction(shift_x[i]!, shift_y[i]!);
    const cut = Math.min(1, (2 * LINE) / Math.max(Math.hypot(along, down), 1e-9));
    [along, down] = [cut * along, cut * down];
    context.globalAlpha = weight[i]! < LIGHT ? 0.25 : 1;
    context.strokeStyle = "#8888";
    context.beginPath();
    context.moveTo(left, top);
    context.lineTo(left + along, top + down);
    context.stroke();
    context.fillStyle = ink("--reference");
    context.fillRect(left - 0.75, top - 0.75, 1.5, 1.5);
  }
  context.globalAlpha = 1;
}

function drawChecks(
  context: CanvasRenderingContext2D,
  checks: NonNullable<Basis["checks"]>,
  place: PlaneMap,
): void {
  checks.x.forEach((x, i) => {
    const [left, top] = place(x, checks.y[i]!);
    const colour = confirms(checks, i) ? "--target" : checks.found[i] ? "--reference" : "--soft";
    context.strokeStyle = context.fillStyle = ink(colour);
    context.beginPath();
    context.arc(left, top, 2.5, 0, 2 * Math.PI);
    if (checks.found[i]) context.fill();
    context.stroke();
  });
}

/** Whether a window that was searched freely lies where the map puts it. */
export function confirms(
  { found, shift_x, shift_y, tolerance }: NonNullable<Basis["checks"]>,
  row: number,
): boolean {
  return found[row]! && Math.hypot(shift_x[row]!, shift_y[row]!) <= 2 * tolerance;
}

/** The round number by which three of four shifts become shorter than `most` px of the reference. */
export function enlargement({ shift_x, shift_y }: Windows, most: number): number {
  const lengths = shift_x.map((x, i) => Math.hypot(x, shift_y[i]!));
  const value = most / Math.max(quantile(lengths, 0.75), 1e-4);
  const power = 10 ** Math.floor(Math.log10(value));
  return Math.max(1, [5, 2, 1].find((step) => step * power <= value * (1 + 1e-9))! * power);
}

/** The value that a share of those which are known stay below; NaN where none is. */
export function quantile(values: readonly (number | null)[], share: number): number {
  const sorted = values.filter((value) => value !== null).sort((a, b) => a - b);
  return sorted[Math.round(share * (sorted.length - 1))] ?? NaN;
}

function describe({ source, band, count, windows, checks }: Basis, times: number): string {
  const whose = source === "fused" ? "all bands together" : source;
  const some = windows.x.length < count ? `, ${windows.x.length} of them drawn` : "";
  const words = [
    `${count} windows of ${whose}${some}; lines ${times} times as long.`,
    `Their shifts are known to ${px(quantile(windows.sigma, 0.5), 3)} px; a map fitted without them misses them by`,
    `${px(quantile(windows.held_out, 0.5), 3)} px, one in ten by more than ${px(quantile(windows.held_out, 0.9), 3)} px.`,
  ];
  if (checks) {
    const good = checks.x.filter((_, i) => confirms(checks, i)).length;
    words.push(`${good} of ${checks.x.length} free windows of ${band} confirm the map.`);
  }
  return words.join(" ");
}
