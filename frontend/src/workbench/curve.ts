// The largest error of each round of the removal, logarithmically; a click leads to a round.
import { draw, make } from "../shared/element";
import type { Point } from "../shared/pane";
import {
  across,
  clipped,
  footers,
  joined,
  level,
  startChart,
  ticks,
  titles,
  upwards,
} from "../shared/plot";
import type { SessionState } from "./record";

const BOX = { width: 320, height: 128, left: 48, right: 10, top: 6, bottom: 30 };
const LEAST_PX = 1e-3;
const LABEL =
  "Largest error by round, px, logarithmic; the words below say that of the round shown";

export class Curve {
  readonly root = make("div", { class: "curve" });
  private rounds = 0;

  constructor(onPick: (round: number) => void) {
    this.root.addEventListener("click", (event) => {
      const box = this.root.getBoundingClientRect();
      const x = ((event.clientX - box.left) / box.width) * BOX.width;
      const share = (x - BOX.left) / (BOX.width - BOX.left - BOX.right);
      if (this.rounds) onPick(Math.round(-1 + share * this.rounds));
    });
  }

  /** Draw the errors of a session and mark a round. */
  draw(session: SessionState | null, round: number): void {
    const trace = session?.trace;
    this.rounds = trace?.largest.length ?? 0;
    if (!trace) return this.root.replaceChildren(startChart(BOX, LABEL));
    const start = Math.max(session.reject, trace.largest[0] ?? 1);
    const values = [start, ...trace.largest].map((value) => Math.max(value, LEAST_PX));
    const low = Math.log10(values.reduce((a, b) => Math.min(a, b), session.stop)) - 0.15;
    const high = Math.log10(values.reduce((a, b) => Math.max(a, b))) + 0.1;
    const x = across(BOX, 0, Math.max(values.length - 1, 1));
    const height = upwards(BOX, low, high);
    const y = (value: number): number => height(Math.log10(value));
    const chart = startChart(BOX, LABEL);
    for (let power = Math.ceil(low); power <= Math.floor(high); power++)
      chart.append(level(BOX, y(10 ** power), String(10 ** power)));
    const [left, right] = [BOX.left, BOX.width - BOX.right];
    const stop = y(session.stop);
    const points = thinOut(values, 2 * BOX.width).map(([i, value]): Point => [x(i), y(value)]);
    const at = { cx: x(round + 1), cy: y(values[round + 1] ?? values[0]!) };
    const rounds = ticks(0, Math.max(values.length - 1, 1)).filter(Number.isInteger);
    chart.append(
      ...footers(BOX, x, rounds),
      ...titles(BOX, "Round", "Largest error, px"),
      clipped(
        BOX,
        draw("line", { x1: left, x2: right, y1: stop, y2: stop, class: "stop" }),
        draw("polyline", { points: joined(points), class: "line" }),
        draw("circle", { ...at, r: 4, class: "shown" }),
      ),
    );
    this.root.replaceChildren(chart);
  }
}

/** Of thousands of values about as many as can be distinguished: the largest of those that fall together, and the last. */
export function thinOut(values: readonly number[], most: number): [index: number, value: number][] {
  const every = Math.max(1, Math.ceil(values.length / most));
  const kept: [number, number][] = [];
  for (let i = 0; i < values.length; i += every)
    kept.push([i, Math.max(...values.slice(i, i + every))]);
  const last = values.length - 1;
  if (every > 1) kept.push([last, values[last]!]);
  return kept;
}
