// The view as a picture file: what the stage shows, with scale bar, layers, settings and citation beneath.
import { saveFile } from "../shared/element";
import { fileOf, standalone } from "../shared/svgfile";

const EDGE = 16; // px of the page, round the words
const LINE = 19;
const INK = "#1d1b16";
const SOFT = "#55503f";
const FONT = "system-ui, 'Segoe UI', Roboto, 'Helvetica Neue', Arial, sans-serif";

/** What stands beneath the picture. */
export interface Legend {
  title: string;
  /** A bar as long as so many px of the page, and the length that it stands for. */
  bar: { width: number; words: string };
  lines: string[];
}

/** Save what the stage shows as PNG; returns a sentence. */
export async function savePicture(
  stage: HTMLElement,
  name: string,
  legend: Legend,
): Promise<string> {
  const canvas = await drawView(stage, legend);
  if (!canvas)
    return "This browser cannot save a picture with levels: reset the levels, or use another browser.";
  try {
    const blob = await new Promise<Blob | null>((resolve) => canvas.toBlob(resolve, "image/png"));
    if (!blob) return "The picture is too large for this browser: make the window smaller.";
    saveFile(name, blob, "image/png");
    return `Saved as ${name}.`;
  } catch {
    // Tiles that the browser takes for another site's. Those of the viewer are data in scripts: none is known to.
    return "This browser does not allow pages from a file to save pictures: run “python -m http.server” in the folder, and open http://localhost:8000/ there.";
  }
}

/** Draw stage and legend; null where the browser has no filters for canvases, and one is in use. */
async function drawView(stage: HTMLElement, legend: Legend): Promise<HTMLCanvasElement | null> {
  const box = stage.getBoundingClientRect();
  const first = stage.querySelector<HTMLCanvasElement>(".pane canvas");
  const ratio = first ? first.width / first.clientWidth || 1 : 1;
  const canvas = document.createElement("canvas");
  const pen = canvas.getContext("2d")!;
  pen.font = `14px ${FONT}`;
  const lines = legend.lines.flatMap((line) => wrap(pen, line, box.width - 2 * EDGE));
  const foot = 2 * EDGE + LINE * (lines.length + 2);
  canvas.width = Math.round(box.width * ratio);
  canvas.height = Math.round((box.height + foot) * ratio);
  pen.scale(ratio, ratio);
  pen.fillStyle = groundOf(stage);
  pen.fillRect(0, 0, box.width, box.height);
  pen.translate(-box.left, -box.top);
  for (const part of stage.querySelectorAll<HTMLElement>(".pane canvas, .amplifier"))
    if (isShown(part) && !drawPart(pen, part, { ratio, origin: box })) return null;
  for (const sheet of stage.querySelectorAll<SVGSVGElement>(".regions-sheet"))
    if (isShown(sheet)) await drawSheet(pen, sheet);
  for (const mark of stage.querySelectorAll<HTMLElement>(
    ".pin, .kept-pin, .curtain, .curtain-name, .cell-label",
  ))
    if (isShown(mark)) drawMark(pen, mark);
  pen.translate(box.left, box.top);
  drawLegend(pen, { ...legend, lines }, box);
  return canvas;
}

function isShown(element: Element): boolean {
  const { width, height } = element.getBoundingClientRect();
  return width > 0 && height > 0 && element.checkVisibility({ visibilityProperty: true });
}

function groundOf(stage: HTMLElement): string {
  for (let at: HTMLElement | null = stage; at; at = at.parentElement) {
    const { backgroundColor } = getComputedStyle(at);
    if (!/^(transparent|rgba\(.*, 0\))$/.test(backgroundColor)) return backgroundColor;
  }
  return "#808080";
}

/** Draw a canvas as the style sheet shows it: filter, opacity, blending, clip; or amplify what is there. */
function drawPart(
  pen: CanvasRenderingContext2D,
  part: HTMLElement,
  { ratio, origin }: { ratio: number; origin: DOMRect },
): boolean {
  const style = getComputedStyle(part);
  const found = part.getBoundingClientRect();
  // Whole pixels: half ones at an edge would shine where pictures are subtracted.
  const whole = (at: number): number => Math.round(at * ratio) / ratio;
  const box = new DOMRect(
    origin.left + whole(found.left - origin.left),
    origin.top + whole(found.top - origin.top),
    part.offsetWidth,
    part.offsetHeight,
  );
  const own = part instanceof HTMLCanvasElement;
  const wanted = own ? style.filter : style.getPropertyValue("backdrop-filter");
  if (wanted !== "none" && wanted !== "" && !("filter" in pen)) return false;
  pen.save();
  const [top, right, bottom, left] = insetOf(style.clipPath, box);
  pen.beginPath();
  pen.rect(box.left + left, box.top + top, box.width - left - right, box.height - top - bottom);
  pen.clip();
  pen.filter = wanted || "none";
  pen.globalAlpha = Number(style.opacity);
  const blend = style.mixBlendMode === "normal" ? "source-over" : style.mixBlendMode;
  pen.globalCompositeOperation = blend as GlobalCompositeOperation;
  pen.imageSmoothingEnabled = false;
  if (own) pen.drawImage(part, box.left, box.top, box.width, box.height);
  else {
    const before = document.createElement("canvas");
    const { width, height } = pen.canvas;
    [before.width, before.height] = [width, height];
    before.getContext("2d")!.drawImage(pen.canvas, 0, 0);
    const at = pen.getTransform();
    const [x, y] = [-at.e / ratio, -at.f / ratio];
    pen.drawImage(before, x, y, width / ratio, height / ratio);
  }
  pen.restore();
  return true;
}

/** What `clip-path: inset(…)` cuts off at the top, right, bottom and left, px. */
function insetOf(path: string, box: DOMRect): [number, number, number, number] {
  const words = /^inset\(([^)]*)\)/.exec(path)?.[1]?.split(" ");
  if (!words) return [0, 0, 0, 0];
  const part = (i: number): string => words[i] ?? words[i - 2] ?? words[0]!;
  const px = (text: string, whole: number): number =>
    text.endsWith("%") ? (parseFloat(text) / 100) * whole : parseFloat(text);
  return [
    px(part(0), box.height),
    px(part(1), box.width),
    px(part(2), box.height),
    px(part(3), box.width),
  ];
}

/** Draw the shapes over a pane. */
async function drawSheet(pen: CanvasRenderingContext2D, sheet: SVGSVGElement): Promise<void> {
  const { left, top, width, height } = sheet.getBoundingClientRect();
  const copy = standalone(sheet);
  copy.setAttribute("width", String(width));
  copy.setAttribute("height", String(height));
  const image = new Image();
  image.src = `data:image/svg+xml;charset=utf-8,${encodeURIComponent(fileOf(copy))}`;
  await image.decode();
  pen.drawImage(image, left, top, width, height);
}

/** Draw a pin, a kept place, the line of the curtain or the name of a picture. */
function drawMark(pen: CanvasRenderingContext2D, mark: HTMLElement): void {
  const { left, top, width, height } = mark.getBoundingClientRect();
  const [x, y] = [left + width / 2, top + height / 2];
  const style = getComputedStyle(mark);
  pen.save();
  pen.lineWidth = 2;
  if (mark.classList.contains("curtain")) {
    pen.fillStyle = "#fff";
    if (width < height) pen.fillRect(x - 1, top, 2, height);
    else pen.fillRect(left, y - 1, width, 2);
  } else if (mark.matches(".curtain-name, .cell-label")) {
    pen.fillStyle = "#000b";
    pen.fillRect(left, top, width, height);
    if (style.textAlign === "center") drawWords(pen, mark, x, y, "#fff");
    else drawWords(pen, mark, left + parseFloat(style.paddingLeft), y, "#fff", "left");
  } else {
    pen.beginPath();
    pen.arc(x, y, height / 2 - 1, 0, 2 * Math.PI);
    pen.fillStyle = style.backgroundColor;
    pen.fill();
    for (const [ink, wide] of [
      ["#000b", 4],
      ["#fff", 2],
    ] as const) {
      [pen.strokeStyle, pen.lineWidth] = [ink, wide];
      pen.stroke();
    }
    drawWords(pen, mark, x, y, style.color);
  }
  pen.restore();
}

function drawWords(
  pen: CanvasRenderingContext2D,
  mark: HTMLElement,
  x: number,
  y: number,
  ink: string,
  align: CanvasTextAlign = "center",
): void {
  const { fontSize, fontWeight } = getComputedStyle(mark);
  pen.font = `${fontWeight} ${fontSize} ${FONT}`;
  [pen.fillStyle, pen.textAlign, pen.textBaseline] = [ink, align, "middle"];
  pen.fillText(mark.textContent, x, y);
}

function drawLegend(
  pen: CanvasRenderingContext2D,
  { title, bar, lines }: Legend,
  { width, height }: DOMRect,
): void {
  pen.fillStyle = "#fff";
  pen.fillRect(0, height, width, 2 * EDGE + LINE * (lines.length + 2));
  [pen.fillStyle, pen.textBaseline] = [INK, "alphabetic"];
  let y = height + EDGE + 14;
  pen.font = `600 16px ${FONT}`;
  pen.fillText(title, EDGE, y, width - 2 * EDGE - bar.width - 90);
  const [right, words] = [width - EDGE, bar.words];
  pen.fillRect(right - bar.width, y - 6, bar.width, 3);
  pen.fillRect(right - bar.width, y - 10, 1.5, 11);
  pen.fillRect(right - 1.5, y - 10, 1.5, 11);
  pen.font = `14px ${FONT}`;
  pen.textAlign = "right";
  pen.fillText(words, right, y + LINE);
  pen.textAlign = "left";
  y += LINE;
  for (const [i, line] of lines.entries()) {
    pen.fillStyle = i === 0 ? INK : SOFT;
    pen.fillText(line, EDGE, (y += LINE));
  }
}

/** Break a line into those that fit. */
function wrap(pen: CanvasRenderingContext2D, line: string, width: number): string[] {
  const lines: string[] = [""];
  for (const word of line.split(" ")) {
    const longer = `${lines.at(-1)!} ${word}`.trim();
    if (!lines.at(-1) || pen.measureText(longer).width <= width) lines[lines.length - 1] = longer;
    else lines.push(word);
  }
  return lines;
}
