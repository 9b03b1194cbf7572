// Histograms of regions, drawn over one another.
import { draw } from "../shared/element";
import type { Point } from "../shared/pane";
import {
  across,
  clipped,
  dashOf,
  footers,
  joined,
  level,
  niceTop,
  startChart,
  ticks,
  titles,
  upwards,
  type Box,
} from "../shared/plot";
import { pinColour } from "./pins";
import type { Histogram } from "./statistics";

const BOX: Box = { width: 360, height: 136, left: 52, right: 16, top: 8, bottom: 32 };

/** Histograms of one band over each other, as steps; null where there is nothing to draw. */
export function drawHistograms(bars: (Histogram | null)[], quantity: string): SVGElement | null {
  const known = bars.flatMap((one, i) => (one ? [{ ...one, colour: pinColour(i) }] : []));
  if (!known.length) return null;
  const low = Math.min(...known.map((one) => one.low));
  const high = Math.max(...known.map((one) => one.high));
  const top = niceTop(Math.max(...known.flatMap(({ counts }) => counts)));
  const [from, to] = low === high ? [low - 0.5, high + 0.5] : [low, high];
  const [x, y] = [across(BOX, from, to), upwards(BOX, 0, top)];
  const chart = startChart(BOX, `Pixels over ${quantity.toLowerCase()}`);
  for (const value of [0, top / 2, top])
    chart.append(level(BOX, y(value), String(value), value ? "grid" : "axis"));
  const words = (value: number): string => String(Number(value.toPrecision(3)));
  chart.append(...footers(BOX, x, ticks(from, to), words), ...titles(BOX, quantity, "Pixels"));
  const steps = known.map(({ low: first, high: last, counts, colour }) => {
    const width = (last - first) / counts.length || (to - from) / counts.length;
    const points = counts.flatMap<Point>((n, i) => [
      [x(first + i * width), y(n)],
      [x(first + (i + 1) * width), y(n)],
    ]);
    const line = draw("polyline", {
      points: joined(points),
      class: "line",
      "stroke-dasharray": dashOf(colour) || null,
    });
    return draw("g", { stroke: colour, fill: colour }, line);
  });
  chart.append(clipped(BOX, ...steps));
  return chart;
}
