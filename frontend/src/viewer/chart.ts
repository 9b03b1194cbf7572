// Spectra as a chart: a line with its one-sigma band for narrow bands, points with bars for broad ones.
import { draw } from "../shared/element";
import type { Point } from "../shared/pane";
import { across, joined, level, startChart, upwards } from "../shared/plot";
import type { Layer } from "./record";
import type { Spectrum } from "./spectra";

export interface Curve {
  layer: Layer;
  spectrum: Spectrum;
  colour: string;
}

/** A band in the chart: where it lies, nm, what it measured, and whether it is broad. */
interface Sample {
  nm: number;
  value: number;
  sigma: number;
  broad: boolean;
}

const BOX = { width: 360, height: 220, left: 38, right: 16, top: 10, bottom: 30 };
const LEVELS = 4;
const GAP_NM = 80; // a line is not drawn over a wider gap
const OUTSIDE = 1; // the flag of a pixel that a camera did not see
const STEPS_NM = [10, 20, 50, 100, 200, 500];
const TOPS = [1, 1.2, 1.6, 2, 3, 4, 6, 8, 10];

/** Draw curves of one quantity; null where there is nothing to draw over wavelength. */
export function drawChart(curves: Curve[], quantity: string): SVGElement | null {
  const series = curves.map((curve) => ({ colour: curve.colour, samples: samplesOf(curve) }));
  const all = series.flatMap(({ samples }) => samples);
  if (!all.length) return null;
  const [from, to] = rangeOf(all.map(({ nm }) => nm));
  const top = niceTop(Math.max(...all.map(({ value, sigma }) => value + (sigma || 0)), 1e-6));
  const x = across(BOX, from, to);
  const y = upwards(BOX, 0, top);
  const place = (nm: number, value: number): Point => [x(nm), y(Math.max(value, 0))];
  const chart = startChart(BOX, `${quantity} over wavelength; the numbers are in the table below`);
  for (let i = 0; i <= LEVELS; i++) {
    const value = (top * i) / LEVELS;
    const text = String(Number(value.toPrecision(3)));
    chart.append(level(BOX, y(value), text, i ? "grid" : "axis"));
  }
  const foot = { y: BOX.height - 14, "text-anchor": "middle" };
  for (const nm of ticks(from, to)) chart.append(draw("text", { x: x(nm), ...foot }, String(nm)));
  const corner = { x: BOX.width - BOX.right, y: BOX.height - 2, "text-anchor": "end" };
  chart.append(draw("text", { ...corner, class: "unit" }, "nm"));
  for (const { colour, samples } of series)
    chart.append(
      draw(
        "g",
        { stroke: colour, fill: colour },
        ...runs(samples.filter(({ broad }) => !broad)).flatMap((run) => drawLine(run, place)),
        ...samples.filter(({ broad }) => broad).flatMap((one) => drawPoint(one, place)),
      ),
    );
  return chart;
}

function drawLine(run: Sample[], place: (nm: number, value: number) => Point): SVGElement[] {
  const middle = run.map(({ nm, value }) => place(nm, value));
  const elements: SVGElement[] = [];
  if (run.every(({ sigma }) => Number.isFinite(sigma))) {
    const upper = run.map(({ nm, value, sigma }) => place(nm, value + sigma));
    const lower = run.map(({ nm, value, sigma }) => place(nm, value - sigma)).reverse();
    elements.push(draw("polygon", { points: joined([...upper, ...lower]), class: "spread" }));
  }
  elements.push(draw("polyline", { points: joined(middle), class: "line" }));
  const [cx, cy] = middle[0]!;
  if (run.length === 1) elements.push(draw("circle", { cx, cy, r: 2.2, class: "dot" }));
  return elements;
}

function drawPoint(
  { nm, value, sigma }: Sample,
  place: (nm: number, value: number) => Point,
): SVGElement[] {
  const [x, y] = place(nm, value);
  const size = { x: x - 3, y: y - 3, width: 6, height: 6 };
  const diamond = draw("rect", { ...size, transform: `rotate(45 ${x} ${y})`, class: "dot" });
  if (!Number.isFinite(sigma)) return [diamond];
  const [y1, y2] = [place(nm, value - sigma)[1], place(nm, value + sigma)[1]];
  return [draw("line", { x1: x, x2: x, y1, y2, class: "bar" }), diamond];
}

function samplesOf({ layer, spectrum: { values, sigma, flags } }: Curve): Sample[] {
  const samples = layer.bands.flatMap(({ wavelength, centroid }, i) => {
    const [nm, value] = [wavelength ?? centroid, values[i]!];
    if (nm === null || !Number.isFinite(value) || (flags?.[i] ?? 0) & OUTSIDE) return [];
    return { nm, value, sigma: sigma?.[i] ?? NaN, broad: wavelength === null };
  });
  return samples.sort((a, b) => a.nm - b.nm);
}

/** Cut samples where the gap to the one before is too wide for a line. */
export function runs<T extends { nm: number }>(samples: T[]): T[][] {
  const result: T[][] = [];
  for (const [i, sample] of samples.entries()) {
    if (i && sample.nm - samples[i - 1]!.nm <= GAP_NM) result.at(-1)!.push(sample);
    else result.push([sample]);
  }
  return result;
}

function rangeOf(values: number[]): [number, number] {
  const [low, high] = [Math.min(...values), Math.max(...values)];
  return low === high ? [low - 50, high + 50] : [low, high];
}

/** Round wavelengths from `from` to `to`, seven at most. */
export function ticks(from: number, to: number): number[] {
  const step = STEPS_NM.find((s) => (to - from) / s <= 6.5) ?? 1000;
  const first = Math.ceil(from / step) * step;
  return Array.from({ length: Math.floor((to - first) / step) + 1 }, (_, i) => first + i * step);
}

/** The least round number that is not below a value. */
export function niceTop(value: number): number {
  const power = 10 ** Math.floor(Math.log10(value));
  return (TOPS.find((n) => n * power >= value) ?? 10) * power;
}
