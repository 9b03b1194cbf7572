// What the map of the default method rests on: windows with their shifts, and windows that were searched freely.
import { effect } from "@preact/signals-core";
import { make, saveFile } from "../shared/element";
import { ink, onTheme } from "../shared/theme";
import { placeTurned } from "./figure";
import type { PlaneMap } from "./maps";
import { px, type Basis, type FrameInfo, type Windows } from "./record";
import type { Store } from "./store";

const [WIDTH, HEIGHT] = [320, 236];
const DENSITY = 2; // pixels of the canvas a unit
const MARGIN = 0.05;
const LINE = 12; // about the length of the longer shifts as drawn, units
const LIGHT = 0.5; // windows of less weight are drawn faintly
const LEGEND =
  "Above: windows to which the map was fitted; each line leads from the place given by the map to the place found in the picture. " +
  "Below: check windows, searched without the map. Filled: they agree with the map. Red: they lie elsewhere. Hollow: they were not found.";

export class BasisView {
  readonly root: HTMLElement;
  private readonly windows = canvas("Windows that the map was fitted to");
  private readonly checks = canvas("Windows that check the map");
  private readonly words = make("p", { class: "status", id: "basis-words" });

  constructor(private readonly store: Store) {
    const title =
      "Places, shifts, sigma, held-out errors and weights of the windows that are drawn";
    const save = make("button", { type: "button", class: "small", title }, "Save as CSV");
    this.root = make(
      "section",
      { class: "card basis", "aria-labelledby": "basis-head", hidden: true },
      make("h2", { id: "basis-head" }, "Evidence for the map"),
      this.windows,
      this.words,
      this.checks,
      make("p", { class: "soft" }, LEGEND),
      make("div", { class: "actions" }, save),
    );
    save.addEventListener("click", () => {
      const frame = store.frame.peek();
      if (!frame?.basis) return;
      const name = [frame.object, frame.camera, frame.sensor, "windows"].filter(Boolean).join("_");
      saveFile(`${name}.csv`, windowsTable(frame.basis.windows), "text/csv");
    });
    effect(() => this.draw());
    onTheme(() => this.draw());
  }

  private draw(): void {
    const frame = this.store.frame.value;
    const basis = frame?.basis;
    this.root.hidden = !basis;
    if (!frame || !basis) return;
    const turned = placeTurned(frame.size, frame.turn, [WIDTH, HEIGHT], MARGIN);
    const place: PlaneMap = (x, y) => turned.place(x + 0.5, y + 0.5);
    const times = enlargement(basis.windows, LINE / turned.scale);
    const along: PlaneMap = (x, y) => turned.direction(times * x, times * y);
    drawWindows(start(this.windows, frame, place), basis.windows, place, along);
    this.checks.hidden = !basis.checks;
    if (basis.checks) drawChecks(start(this.checks, frame, place), basis.checks, place);
    this.words.textContent = describe(basis, times);
  }
}

function canvas(label: string): HTMLCanvasElement {
  const [width, height] = [DENSITY * WIDTH, DENSITY * HEIGHT];
  return make("canvas", { width, height, role: "img", "aria-label": label });
}

function start(
  on: HTMLCanvasElement,
  { size }: FrameInfo,
  place: PlaneMap,
): CanvasRenderingContext2D {
  const context = on.getContext("2d")!;
  context.setTransform(DENSITY, 0, 0, DENSITY, 0, 0);
  context.clearRect(0, 0, WIDTH, HEIGHT);
  const [left, top] = place(-0.5, -0.5);
  const [right, bottom] = place(size[0] - 0.5, size[1] - 0.5);
  context.strokeStyle = ink("--ink");
  context.strokeRect(left, top, right - left, bottom - top); // of negative width where it is turned
  return context;
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

/** Windows as CSV, px of the reference; empty where a number is not known. */
export function windowsTable(windows: Windows): string {
  const names = ["x", "y", "shift_x", "shift_y", "sigma", "held_out", "weight"] as const;
  const lines = windows.x.map((_, i) => names.map((name) => windows[name][i] ?? "").join());
  return [names.join(), ...lines, ""].join("\n");
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
