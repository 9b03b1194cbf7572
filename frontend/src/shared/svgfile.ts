// Drawings of a page as files of their own: styles stand in every element, so that they open anywhere.
import { draw, saveFile } from "./element";
import { dashOf } from "./plot";

const PROPERTIES = [
  ...["fill", "fill-opacity", "fill-rule", "opacity", "paint-order", "visibility", "display"],
  ...["stroke", "stroke-width", "stroke-opacity", "stroke-dasharray", "stroke-linejoin"],
  ...["stroke-linecap", "font-family", "font-size", "font-weight", "font-style", "text-anchor"],
];
const KEPT = /^(x|y|x1|x2|y1|y2|cx|cy|r|rx|ry|d|points|width|height|viewBox|id|clip-path)$/;
const NAMESPACE = "http://www.w3.org/2000/svg";
const ZOOM = 2; // of the size in which a chart is drawn
const LINE = 15; // height of a line of words beneath, in units of the chart
const MARGIN = 10;
const SANS = "system-ui, 'Segoe UI', Roboto, 'Helvetica Neue', Arial, sans-serif";

/** What stands beneath a chart in its file. */
export interface Caption {
  title: string;
  /** Curves: the colour of each, as the style sheet has it, and its name. */
  curves: { colour: string; name: string }[];
  /** Further lines: where it is from, under which licence. */
  lines: string[];
}

/** Save a chart with its caption as SVG, in light colours on white. */
export function saveChart(name: string, chart: SVGElement, caption: Caption): void {
  saveFile(name, chartFile(chart, caption), "image/svg+xml");
}

/** The file of a chart: its text. */
function chartFile(chart: SVGElement, { title, curves, lines }: Caption): string {
  const [, , width = 0, height = 0] = chart.getAttribute("viewBox")!.split(" ").map(Number);
  const foot = [
    ...curves.map(({ colour, name }) => ({ text: name, colour })),
    ...lines.flatMap((line) => wrapped(line, width)).map((text) => ({ text, colour: "" })),
  ];
  const beneath = foot.flatMap(({ text, colour }, i) => {
    const y = height + MARGIN + LINE * (i + 1);
    const words = draw(
      "text",
      { x: colour ? 46 : MARGIN, y, "font-size": 10, fill: "#1d1b16" },
      text,
    );
    const key = { x1: MARGIN, x2: 40, y1: y - 3, y2: y - 3, "stroke-width": 2.4 };
    const line = { ...key, stroke: colourOf(colour), "stroke-dasharray": dashOf(colour) };
    return colour ? [draw("line", line), words] : [words];
  });
  const total = height + MARGIN * 2 + LINE * foot.length;
  const inner = inLight(() => standalone(chart));
  inner.setAttribute("width", String(width));
  inner.setAttribute("height", String(height));
  const whole = draw(
    "svg",
    { viewBox: `0 0 ${width} ${total}`, width: ZOOM * width, height: ZOOM * total },
    draw("title", {}, title),
    draw("rect", { width, height: total, fill: "#fff" }),
    inner,
    draw("g", { "font-family": SANS }, ...beneath),
  );
  return fileOf(whole);
}

/** An SVG element as the text of a file. */
export function fileOf(element: SVGElement): string {
  element.setAttribute("xmlns", NAMESPACE);
  return new XMLSerializer().serializeToString(element);
}

/** A copy of a drawing in the page whose styles stand in its elements. */
export function standalone<T extends SVGElement>(original: T): T {
  const copy = original.cloneNode(true) as T;
  const pairs: [Element, Element][] = [[original, copy]];
  for (let i = 0; i < pairs.length; i++) {
    const [from, to] = pairs[i]!;
    for (const [j, child] of [...from.children].entries()) pairs.push([child, to.children[j]!]);
  }
  for (const [from, to] of pairs) inline(from, to);
  return copy;
}

function inline(from: Element, to: Element): void {
  const style = getComputedStyle(from);
  for (const { name } of [...to.attributes]) if (!KEPT.test(name)) to.removeAttribute(name);
  if (from instanceof SVGTitleElement || from instanceof SVGDefsElement) return;
  for (const property of PROPERTIES) to.setAttribute(property, style.getPropertyValue(property));
  if (style.transform !== "none") to.setAttribute("transform", style.transform);
}

/** The colour that a name of the style sheet stands for, in light colours. */
function colourOf(colour: string): string {
  const probe = document.createElement("span");
  probe.style.color = colour;
  document.body.append(probe);
  const found = inLight(() => getComputedStyle(probe).color);
  probe.remove();
  return found;
}

/** Do something while the page has light colours; nobody sees it, as nothing is painted meanwhile. */
function inLight<T>(act: () => T): T {
  const { dataset } = document.documentElement;
  const before = dataset["theme"];
  dataset["theme"] = "light";
  try {
    return act();
  } finally {
    if (before === undefined) delete dataset["theme"];
    else dataset["theme"] = before;
  }
}

/** Break a line into those that fit a chart. */
function wrapped(line: string, width: number): string[] {
  const most = Math.floor((width - 2 * MARGIN) / 5.2);
  const lines: string[] = [""];
  for (const word of line.split(" ")) {
    const longer = `${lines.at(-1)!} ${word}`.trim();
    if (longer.length <= most || !lines.at(-1)) lines[lines.length - 1] = longer;
    else lines.push(word);
  }
  return lines;
}
