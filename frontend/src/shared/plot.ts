// Charts in SVG, one module for all pages: axes, titles, ticks and clipping. They take their colours from the
// style sheet, print sharply, and their text is text.
// uPlot would be 51 kB, an eighth of each page, and leave error bars, gaps and marks to be drawn here.
import { draw } from "./element";
import type { Point } from "./pane";

/** The size of a chart and what its margins leave for the curves, in units of its viewBox. */
export interface Box {
  width: number;
  height: number;
  left: number;
  right: number;
  top: number;
  bottom: number;
}

/** Start a chart; `label` is what a screen reader says of it. */
export function startChart({ width, height }: Box, label: string): SVGSVGElement {
  const viewBox = `0 0 ${width} ${height}`;
  return draw("svg", { viewBox, role: "img", class: "chart", "aria-label": label });
}

/** Return a function that maps values from `from` to `to` on to the width of a chart. */
export function across(box: Box, from: number, to: number): (value: number) => number {
  const width = box.width - box.left - box.right;
  return (value) => box.left + (width * (value - from)) / (to - from);
}

/** Return a function that maps values from `from` to `to` on to the height of a chart, upwards. */
export function upwards(box: Box, from: number, to: number): (value: number) => number {
  const height = box.height - box.top - box.bottom;
  return (value) => box.height - box.bottom - (height * (value - from)) / (to - from);
}

/** Draw a level line with its number on the left. */
export function level(
  { left, right, width }: Box,
  y: number,
  text: string,
  kind = "grid",
): SVGElement {
  return draw(
    "g",
    {},
    draw("line", { x1: left, x2: width - right, y1: y, y2: y, class: kind }),
    draw("text", { x: left - 6, y: y + 3.5, "text-anchor": "end" }, text),
  );
}

/** Draw the title of the horizontal axis at the lower right, that of the vertical one upright on the left. */
export function titles(box: Box, across: string, upwards: string): SVGElement[] {
  const { width, height, right, top, bottom } = box;
  const corner = { x: width - right, y: height - 2, "text-anchor": "end" };
  const middle = (top + height - bottom) / 2;
  const turned = { "text-anchor": "middle", transform: `translate(11 ${middle}) rotate(-90)` };
  return [
    draw("text", { ...corner, class: "unit" }, across),
    draw("text", { ...turned, class: "unit" }, upwards),
  ];
}

/** Write numbers under the horizontal axis, at `x` of each. */
export function footers(
  box: Box,
  x: (value: number) => number,
  values: readonly number[],
  words: (value: number) => string = String,
): SVGElement[] {
  const place = { y: box.height - 14, "text-anchor": "middle" };
  return values.map((value) => draw("text", { x: x(value), ...place }, words(value)));
}

/** A group of what is drawn within the frame: what lies outside is cut there, a mark's breadth further. */
export function clipped(box: Box, ...inside: SVGElement[]): SVGElement {
  const { left, right, top, bottom, width, height } = box;
  const id = `frame-${++frames}`;
  const size = { width: width - left - right + 12, height: height - top - bottom + 8 };
  const area = draw("rect", { x: left - 6, y: top - 4, ...size });
  const group = draw("g", { "clip-path": `url(#${id})` }, ...inside);
  return draw("g", {}, draw("defs", {}, draw("clipPath", { id }, area)), group);
}

let frames = 0;

const LEVEL_STEPS = [1, 2, 2.5, 5, 10];
const TICK_STEPS = [1, 2, 5, 10];
const TOPS = [1, 1.2, 1.6, 2, 3, 4, 6, 8, 10];

/** Round values from `low` to `top`, about five; 0 is among them where it lies between. */
export function levels(low: number, top: number): number[] {
  const power = 10 ** Math.floor(Math.log10((top - low) / 4));
  const step = power * LEVEL_STEPS.find((n) => n * power * 5 >= top - low)!;
  return multiples(step, low, top);
}

/** Round values from `from` to `to`, seven at most. */
export function ticks(from: number, to: number): number[] {
  const power = 10 ** Math.floor(Math.log10((to - from) / 6.5));
  const step = power * TICK_STEPS.find((n) => (to - from) / (n * power) <= 6.5)!;
  return multiples(step, from, to);
}

function multiples(step: number, low: number, top: number): number[] {
  const first = Math.ceil(low / step - 1e-9);
  const count = Math.floor(top / step + 1e-9) - first + 1;
  return Array.from({ length: count }, (_, i) => Number(((first + i) * step).toPrecision(12)) || 0);
}

/** The least round number that is not below a value. */
export function niceTop(value: number): number {
  const power = 10 ** Math.floor(Math.log10(value));
  return (TOPS.find((n) => n * power >= value) ?? 10) * power;
}

/** Places as SVG writes them. */
export function joined(points: Point[]): string {
  return points.map((point) => point.join()).join(" ");
}

const DASHES = ["", "7 3", "2 2.5", "9 3 2 3", "13 4", "4 2 1.5 2 1.5 2", "5 5", "13 3 2 3 2 3"];

/** How a curve is dashed: each of the colours --curve-1 and on has its own, so that colour is not the only sign. */
export function dashOf(colour: string): string {
  const number = Number(/--curve-(\d+)/.exec(colour)?.[1] ?? 0);
  return number ? DASHES[(number - 1) % DASHES.length]! : "1 3";
}

/** A short piece of a curve, beside the word for it. */
export function curveSwatch(colour: string): SVGSVGElement {
  const line = { x1: 0, x2: 30, y1: 5, y2: 5, "stroke-dasharray": dashOf(colour) };
  return draw(
    "svg",
    { viewBox: "0 0 30 10", width: 30, height: 10, class: "curve-swatch", "aria-hidden": "true" },
    draw("g", { stroke: colour }, draw("line", line)),
  );
}
