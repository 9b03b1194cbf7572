// Charts in SVG: they take their colours from the style sheet, print sharply, and their text is text.
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

/** Places as SVG writes them. */
export function joined(points: Point[]): string {
  return points.map((point) => point.join()).join(" ");
}
