// Spectra as a chart: a line with its one-sigma band for narrow bands, points with bars for broad ones.
// A value that is not to be trusted is a hollow, struck mark, and no line leads through it.
import { draw } from "../shared/element";
import type { Point } from "../shared/pane";
import {
  across,
  clipped,
  dashOf,
  footers,
  joined,
  level,
  levels,
  niceTop,
  startChart,
  ticks,
  titles,
  upwards,
} from "../shared/plot";
import { marksOf, type Layer, type Mark, type Spectrum } from "./record";

export interface Curve {
  layer: Layer;
  spectrum: Spectrum;
  colour: string;
  /** A word of one or two letters at the end of the curve. */
  mark?: string;
}

/** A band in the chart: where it lies and how wide it is, nm, what it measured, and its flags. */
export interface Sample {
  nm: number;
  width: number;
  value: number;
  sigma: number;
  broad: boolean;
  /** Flags for which the value is not to be trusted. */
  doubts: Doubt[];
}

type Doubt = Pick<Mark, "word" | "colour">;

const BOX = { width: 360, height: 220, left: 52, right: 16, top: 10, bottom: 30 };
const GAP_NM = 80; // a line is not drawn over a wider gap
const OUTSIDE = 1; // the flag of a pixel that a camera did not see

/** Draw curves of one quantity; null where there is nothing to draw over wavelength. */
export function drawChart(curves: Curve[], quantity: string, marks: Mark[]): SVGElement | null {
  const series = curves.map((curve) => ({
    colour: curve.colour,
    mark: curve.mark ?? "",
    samples: samplesOf(curve, marks),
  }));
  const all = series.flatMap(({ samples }) => samples);
  if (!all.length) return null;
  const [from, to] = rangeOf(all.map(({ nm }) => nm));
  const [low, top] = valueRange(all);
  const [x, y] = [across(BOX, from, to), upwards(BOX, low, top)];
  const place = (nm: number, value: number): Point => [x(nm), y(value)];
  const label = `${quantity} over wavelength; the numbers are in the table below`;
  const chart = startChart(BOX, label);
  for (const value of levels(low, top)) {
    const text = String(Number(value.toPrecision(3)));
    chart.append(level(BOX, y(value), text, value ? "grid" : "axis"));
  }
  chart.append(...footers(BOX, x, ticks(from, to)), ...titles(BOX, "Wavelength, nm", quantity));
  const inside: SVGElement[] = [];
  for (const { colour, mark, samples } of series) {
    const narrow = runs(samples.filter(({ broad }) => !broad));
    const lines = narrow.flatMap((run) => drawLine(run, dashOf(colour), place));
    const points = samples.filter(({ broad }) => broad).flatMap((one) => drawPoint(one, x, place));
    const doubtful = samples.filter(({ doubts }) => doubts.length);
    const last = samples.filter(({ doubts }) => !doubts.length).at(-1);
    if (mark && last) chart.append(drawMark(mark, colour, place(last.nm, last.value)));
    inside.push(
      draw("g", { stroke: colour, fill: colour }, ...lines, ...points),
      ...doubtful.map((one) => drawDoubt(one, colour, place)),
    );
  }
  chart.append(clipped(BOX, ...inside));
  return chart;
}

function drawMark(mark: string, colour: string, [x, y]: Point): SVGElement {
  const text = draw("text", { x: x + 4, y: y + 3.5, "font-weight": 700 }, mark);
  text.style.fill = colour;
  return text;
}

function drawLine(
  run: Sample[],
  dash: string,
  place: (nm: number, value: number) => Point,
): SVGElement[] {
  const middle = run.map(({ nm, value }) => place(nm, value));
  const elements: SVGElement[] = [];
  if (run.every(({ sigma }) => Number.isFinite(sigma))) {
    const upper = run.map(({ nm, value, sigma }) => place(nm, value + sigma));
    const lower = run.map(({ nm, value, sigma }) => place(nm, value - sigma)).reverse();
    elements.push(draw("polygon", { points: joined([...upper, ...lower]), class: "spread" }));
  }
  elements.push(
    draw("polyline", { points: joined(middle), class: "line", "stroke-dasharray": dash || null }),
  );
  const [cx, cy] = middle[0]!;
  if (run.length === 1) elements.push(draw("circle", { cx, cy, r: 2.2, class: "dot" }));
  return elements;
}

/** Draw a broad band: a diamond, one sigma upright, and from end to end of its full width at half maximum. */
function drawPoint(
  { nm, width, value, sigma, doubts }: Sample,
  across: (nm: number) => number,
  place: (nm: number, value: number) => Point,
): SVGElement[] {
  const [x, y] = place(nm, value);
  const elements: SVGElement[] = [];
  if (Number.isFinite(sigma)) {
    const [y1, y2] = [place(nm, value - sigma)[1], place(nm, value + sigma)[1]];
    elements.push(draw("line", { x1: x, x2: x, y1, y2, class: "bar" }));
  }
  if (width > 0) {
    const [x1, x2] = [across(nm - width / 2), across(nm + width / 2)];
    elements.push(draw("line", { x1, x2, y1: y, y2: y, class: "bar width" }));
  }
  const size = { x: x - 3, y: y - 3, width: 6, height: 6 };
  if (!doubts.length)
    elements.push(draw("rect", { ...size, transform: `rotate(45 ${x} ${y})`, class: "dot" }));
  return elements;
}

/** Draw a value that is not to be trusted: hollow and struck through, in the colour of its flag. */
function drawDoubt(
  { nm, value, doubts }: Sample,
  colour: string,
  place: (nm: number, value: number) => Point,
): SVGElement {
  const [cx, cy] = place(nm, value);
  const strike = { x1: cx - 4.5, y1: cy + 4.5, x2: cx + 4.5, y2: cy - 4.5 };
  return draw(
    "g",
    { class: "doubt", stroke: colour },
    draw("title", {}, `${nm.toFixed(0)} nm: ${doubts.map(({ word }) => word).join(", ")}`),
    draw("circle", { cx, cy, r: 3.2, stroke: doubts[0]!.colour }),
    draw("line", strike),
  );
}

/** The bands of a curve that have a wavelength and a value, by wavelength. */
export function samplesOf(
  { layer, spectrum: { values, sigma, flags } }: Pick<Curve, "layer" | "spectrum">,
  marks: Mark[],
): Sample[] {
  const samples = layer.bands.flatMap(({ wavelength, centroid, fwhm }, i) => {
    const [nm, value, bits] = [wavelength ?? centroid, values[i]!, flags?.[i] ?? 0];
    if (nm === null || !Number.isFinite(value) || bits & OUTSIDE) return [];
    const doubts = marksOf(bits, marks).filter(({ trusted }) => !trusted);
    const broad = wavelength === null;
    return { nm, width: fwhm ?? NaN, value, sigma: sigma?.[i] ?? NaN, broad, doubts };
  });
  return samples.sort((a, b) => a.nm - b.nm);
}

/** Say in words how many bands of a layer are not to be trusted here, and why; empty where all are. */
export function describeDoubts(
  { bands }: Pick<Layer, "bands">,
  { flags }: Pick<Spectrum, "flags">,
  marks: Mark[],
): string {
  const counts = new Map<string, number>();
  for (const bits of flags ?? [])
    for (const { word, trusted } of marksOf(bits, marks))
      if (!trusted) counts.set(word, (counts.get(word) ?? 0) + 1);
  const parts = [...counts].map(([word, n], i) => {
    const [is, are] = VERBS[word] ?? [`is ${word}`, `are ${word}`];
    const verb = n === 1 ? is : are;
    return i ? `${n} ${verb}` : `${n} of ${bands.length} bands ${verb}`;
  });
  return parts.length ? `${parts.join(", ")} here.` : "";
}

const VERBS: Record<string, [singular: string, plural: string]> = {
  glare: ["shows glare", "show glare"],
  moved: ["moved between shots", "moved between shots"],
};

/** From 0, or the round number below the least value, to the round number above the largest. */
export function valueRange(samples: Pick<Sample, "value" | "sigma">[]): [low: number, top: number] {
  const values = samples.map(({ value }) => value);
  const upper = samples.map(({ value, sigma }) => value + (sigma || 0));
  const least = Math.min(...values);
  return [least < 0 ? -niceTop(-least) : 0, niceTop(Math.max(...upper, 1e-6))];
}

/** Cut samples where the gap to the one before is too wide for a line, and at values not to be trusted. */
export function runs<T extends { nm: number; doubts: unknown[] }>(samples: T[]): T[][] {
  const result: T[][] = [];
  let open = false;
  for (const [i, sample] of samples.entries()) {
    const near = i > 0 && sample.nm - samples[i - 1]!.nm <= GAP_NM;
    if (!sample.doubts.length) {
      if (open && near) result.at(-1)!.push(sample);
      else result.push([sample]);
    }
    open = !sample.doubts.length;
  }
  return result;
}

function rangeOf(values: number[]): [number, number] {
  const [low, high] = [Math.min(...values), Math.max(...values)];
  return low === high ? [low - 50, high + 50] : [low, high];
}
