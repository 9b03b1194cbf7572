// How the outliers left: the paper's Figure 9 as a picture to scrub through, its Figure 10 beneath.
import { find, make } from "../element";
import { ink, onTheme } from "../theme";
import { Dots, packed } from "./dots";
import { mapOf, type Map2 } from "./maps";
import type { Point, Told } from "./record";
import type { Store } from "./store";

const FIGURE = { width: 320, height: 236 };
const CURVE = { width: 320, height: 84, left: 34, bottom: 16 };
const PLAY_MS = 4000;

export class TraceView {
  readonly root: HTMLElement;
  private readonly figure = canvas(FIGURE, "The course of the removal of outliers");
  private readonly dots = new Dots();
  private readonly curve = canvas(CURVE, "Largest error by round");
  private readonly range = make("input", { type: "range", min: -1, max: 0, value: 0, id: "round", "aria-label": "Round of the removal" });
  private readonly said = make("p", { class: "said", "aria-live": "polite" });
  private readonly play = make("button", { type: "button", class: "small", "aria-label": "Play the removal" }, "▶");
  private readonly idle = make(
    "p",
    { class: "soft", id: "thresholds-idle", hidden: true },
    "Both belong to the paper's method. The default method made this map and has neither: here they redraw the figure alone.",
  );
  private round = 0;
  private follow = true;
  private running = 0;
  private seen: Told | null = null;

  constructor(private readonly store: Store) {
    this.root = make(
      "section",
      { class: "card trace", "aria-labelledby": "trace-head" },
      make("h2", { id: "trace-head" }, "How wrong pairs left"),
      this.figure,
      make("div", { class: "scrub" }, this.play, this.range),
      this.curve,
      this.said,
      this.slider("reject", "Cut at the start", "Pairs farther apart than this under scale alone are dropped at once (the paper's T1)."),
      this.slider("stop", "Stop at", "The worst pair leaves until none is farther off than this (the paper's T2)."),
      this.idle,
    );
    this.range.addEventListener("input", () => this.go(Number(this.range.value)));
    this.play.addEventListener("click", () => this.toggle());
    this.curve.addEventListener("click", (event) => {
      const rounds = this.store.told?.trace?.largest.length ?? 0;
      const share = (event.offsetX * (CURVE.width / this.curve.clientWidth) - CURVE.left) / (CURVE.width - CURVE.left - 6);
      if (rounds) this.go(Math.round(-1 + share * rounds));
    });
    store.listen(() => this.update());
    onTheme(() => this.draw());
  }

  /** Go to a round; -1 is the start, under scale alone. */
  go(round: number): void {
    const last = (this.store.told?.trace?.largest.length ?? 0) - 1;
    this.round = Math.max(-1, Math.min(last, round));
    this.follow = this.round === last;
    this.range.value = String(this.round);
    this.draw();
  }

  private toggle(): void {
    const last = (this.store.told?.trace?.largest.length ?? 0) - 1;
    if (this.running || last < 0) {
      cancelAnimationFrame(this.running);
      this.running = 0;
      this.play.textContent = "▶";
      return;
    }
    const from = this.round >= last ? -1 : this.round;
    const began = performance.now();
    this.play.textContent = "❚❚";
    const tick = (now: number): void => {
      const share = Math.min(1, (now - began) / PLAY_MS);
      this.go(Math.round(from + share * (last - from)));
      if (share < 1) this.running = requestAnimationFrame(tick);
      else {
        this.running = 0;
        this.play.textContent = "▶";
      }
    };
    this.running = requestAnimationFrame(tick);
  }

  private update(): void {
    if (this.store.told === this.seen) return;
    this.seen = this.store.told;
    const trace = this.store.told?.trace;
    const last = (trace?.largest.length ?? 0) - 1;
    this.range.max = String(Math.max(last, -1));
    this.range.disabled = this.play.disabled = !trace;
    this.idle.hidden = !this.store.frame?.built || this.store.frame.method === "mirhashemi2019";
    if (this.follow || this.round > last) this.round = last;
    this.range.value = String(this.round);
    for (const name of ["reject", "stop"] as const) {
      const value = this.store.told?.[name];
      const number = find<HTMLInputElement>(`${name}-number`);
      const range = find<HTMLInputElement>(`${name}-range`);
      if (value === undefined) continue;
      if (document.activeElement !== number) number.value = String(Number(value.toPrecision(4)));
      if (document.activeElement !== range) range.value = String(Math.log10(value));
      find(`${name}-reset`).hidden = !this.store.told?.overridden[name];
    }
    this.draw();
  }

  private slider(name: "reject" | "stop", label: string, title: string): HTMLElement {
    const [low, high] = name === "reject" ? [0.5, 3.3] : [-2, 1.7];
    const range = make("input", { type: "range", id: `${name}-range`, min: low, max: high, step: 0.01, "aria-label": `${label}, logarithmic` });
    const number = make("input", { type: "number", id: `${name}-number`, min: 0.001, step: "any", "aria-label": `${label}, reference pixels` });
    const reset = make("button", { type: "button", class: "small", id: `${name}-reset`, hidden: true, "aria-label": `${label}: the campaign's own value again`, title: "The campaign's own value again" }, "↺");
    let [pending, wanted] = [false, NaN];
    const send = async (value: number): Promise<void> => {
      wanted = value;
      if (pending) return;
      pending = true;
      while (Number.isFinite(wanted)) {
        const value = wanted;
        wanted = NaN;
        await this.store.edit({ operation: "slide", name, value });
      }
      pending = false;
    };
    range.addEventListener("input", () => {
      const value = Number((10 ** Number(range.value)).toPrecision(3));
      number.value = String(value);
      void send(value);
    });
    number.addEventListener("change", () => void send(Number(number.value)));
    reset.addEventListener("click", () => void this.store.edit({ operation: "slide", name, value: null }));
    return make("div", { class: "slider", title }, make("label", { for: `${name}-range` }, label), range, number, make("span", { class: "soft" }, "px"), reset);
  }

  private draw(): void {
    const told = this.store.told;
    const kept = told ? keptAt(told, this.round) : [];
    drawFigure(this.figure, this.dots, told, this.round, kept);
    drawCurve(this.curve, told, this.round);
    this.said.textContent = told ? words(told, this.round, kept.length) : "";
  }
}

/** The pairs that the fit of a round rests on. */
export function keptAt(told: Told, round: number): number[] {
  const trace = told.trace;
  const gone = new Uint8Array(told.pairs.length);
  if (trace && round >= 0) for (const row of trace.removed.subarray(0, round)) if (row >= 0) gone[row] = 1;
  const rows: number[] = [];
  for (let row = 0; row < gone.length; row++) {
    if (gone[row] || told.state[row] === "check" || told.reason[row] === "deleted by hand") continue;
    if (trace && round >= 0 && told.round[row] === 0) continue;
    rows.push(row);
  }
  return rows;
}

function words(told: Told, round: number, kept: number): string {
  const trace = told.trace;
  if (!trace) return told.refusal ? `No map yet: ${told.refusal}.` : "";
  const rounds = trace.largest.length;
  if (round < 0) return `Start: ${kept} pairs, under ${trace.cut ? "a first map" : "scale"} alone; ${trace.cut} lie too far apart and are cut.`;
  const end = round === rounds - 1 ? "the end" : `round ${round + 1} of ${rounds}`;
  return `${end[0]!.toUpperCase()}${end.slice(1)}: ${kept} pairs, the worst ${trace.largest[round]!.toFixed(2)} px off.`;
}

function drawFigure(view: HTMLCanvasElement, dots: Dots, told: Told | null, round: number, rows: number[]): void {
  const context = begin(view, FIGURE);
  const trace = told?.trace;
  if (!told || !trace) return;
  const scale = mapOf(trace, -1);
  const map = mapOf(trace, round);
  const [w, h] = trace.size;
  const frame: Point[] = [[-0.5, -0.5], [w - 0.5, -0.5], [w - 0.5, h - 0.5], [-0.5, h - 0.5]];
  const place = placing([...frame], FIGURE);
  outline(context, frame.map(place), ink("--ink"));
  const box = bounds(told);
  outline(context, edge(box, scale).map(place), ink("--reference"));
  if (round >= 0) outline(context, edge(box, map).map(place), ink("--fit"));
  const every = Math.max(1, Math.floor(rows.length / 1500));
  const ends = rows.filter((_, i) => i % every === 0).map((row) => {
    const [a, b, c, d] = told.pairs[row]!;
    return [place([a, b]), place(map(c, d))] as const;
  });
  context.strokeStyle = "#8888";
  context.lineWidth = 0.8;
  context.beginPath();
  for (const [from, to] of ends) {
    context.moveTo(...from);
    context.lineTo(...to);
  }
  context.stroke();
  dots.begin(view.width, view.height);
  for (const [which, name] of [[1, "--target"], [0, "--reference"]] as const) {
    const pixel = packed(ink(name), context);
    for (const point of ends) dots.square(2 * point[which][0], 2 * point[which][1], 4, pixel);
  }
  dots.drawOn(context);
}

/** Where the target's pairs lie: the frame that is drawn of it. */
function bounds(told: Told): [number, number, number, number] {
  const box: [number, number, number, number] = [Infinity, Infinity, -Infinity, -Infinity];
  for (const [, , x, y] of told.pairs) [box[0], box[1], box[2], box[3]] = [Math.min(box[0], x), Math.min(box[1], y), Math.max(box[2], x), Math.max(box[3], y)];
  return box;
}

function edge([x0, y0, x1, y1]: [number, number, number, number], map: Map2): Point[] {
  const along = Array.from({ length: 12 }, (_, i) => i / 12);
  const walk = (a: Point, b: Point): Point[] => along.map((t) => map(a[0] + t * (b[0] - a[0]), a[1] + t * (b[1] - a[1])));
  const corners: Point[] = [[x0, y0], [x1, y0], [x1, y1], [x0, y1]];
  return corners.flatMap((corner, i) => walk(corner, corners[(i + 1) % 4]!));
}

function drawCurve(view: HTMLCanvasElement, told: Told | null, round: number): void {
  const context = begin(view, CURVE);
  const trace = told?.trace;
  if (!told || !trace) return;
  const values = Float64Array.from([Math.max(told.reject, trace.largest[0] ?? 1), ...trace.largest], (v) => Math.max(v, 1e-3));
  const [least, most] = values.reduce(([a, b], v) => [Math.min(a, v), Math.max(b, v)] as [number, number], [told.stop, 0] as [number, number]);
  const [low, high] = [Math.log10(least) - 0.15, Math.log10(most) + 0.1];
  const x = (i: number): number => CURVE.left + ((CURVE.width - CURVE.left - 6) * i) / Math.max(values.length - 1, 1);
  const y = (v: number): number => 4 + ((CURVE.height - CURVE.bottom - 4) * (high - Math.log10(v))) / (high - low);
  context.font = "10px system-ui, sans-serif";
  context.fillStyle = ink("--soft");
  context.strokeStyle = ink("--line");
  context.textAlign = "right";
  for (let power = Math.ceil(low); power <= Math.floor(high); power++) {
    context.beginPath();
    context.moveTo(CURVE.left, y(10 ** power));
    context.lineTo(CURVE.width - 6, y(10 ** power));
    context.stroke();
    context.fillText(`${10 ** power}`, CURVE.left - 4, y(10 ** power) + 3);
  }
  context.fillText("round", CURVE.width - 6, CURVE.height - 3);
  context.textAlign = "left";
  context.fillText("largest error, px", CURVE.left, CURVE.height - 3);
  context.strokeStyle = ink("--target");
  context.setLineDash([4, 3]);
  context.beginPath();
  context.moveTo(CURVE.left, y(told.stop));
  context.lineTo(CURVE.width - 6, y(told.stop));
  context.stroke();
  context.setLineDash([]);
  context.strokeStyle = ink("--reference");
  context.lineWidth = 1.6;
  context.beginPath();
  // Of thousands of rounds as many as can be told apart, and the largest of those that fall together.
  const every = Math.ceil(values.length / (2 * CURVE.width));
  for (let i = 0; i < values.length; i += every) context.lineTo(x(i), y(values.subarray(i, i + every).reduce((a, b) => Math.max(a, b))));
  context.lineTo(x(values.length - 1), y(values[values.length - 1]!));
  context.stroke();
  context.fillStyle = ink("--gold");
  context.beginPath();
  context.arc(x(round + 1), y(values[round + 1] ?? values[0]!), 4, 0, 2 * Math.PI);
  context.fill();
}

function canvas(size: { width: number; height: number }, label: string): HTMLCanvasElement {
  return make("canvas", { width: 2 * size.width, height: 2 * size.height, role: "img", "aria-label": label });
}

function begin(view: HTMLCanvasElement, size: { width: number; height: number }): CanvasRenderingContext2D {
  const context = view.getContext("2d")!;
  context.setTransform(2, 0, 0, 2, 0, 0);
  context.clearRect(0, 0, size.width, size.height);
  context.lineWidth = 1;
  return context;
}

function placing(points: Point[], size: { width: number; height: number }): (p: Point) => Point {
  const xs = points.map((p) => p[0]);
  const ys = points.map((p) => p[1]);
  const [x0, y0, x1, y1] = [Math.min(...xs), Math.min(...ys), Math.max(...xs), Math.max(...ys)];
  const margin = 0.09;
  const scale = Math.min(size.width / (x1 - x0), size.height / (y1 - y0)) * (1 - 2 * margin);
  const [dx, dy] = [(size.width - scale * (x0 + x1)) / 2, (size.height - scale * (y0 + y1)) / 2];
  return ([x, y]) => [dx + scale * x, dy + scale * y];
}

function outline(context: CanvasRenderingContext2D, points: Point[], colour: string): void {
  context.strokeStyle = colour;
  context.lineWidth = 1.4;
  context.beginPath();
  for (const point of points) context.lineTo(...point);
  context.closePath();
  context.stroke();
}
