// Notes as W3C Web Annotations, read by a grammar of their own: what is not in it is refused with a sentence.
import type { Point } from "../shared/pane";
import type { CanvasFacts } from "./record";
import type { Shape } from "./shapes";

/** A note on a place or a part of the painting; places are pixels of the page's grid. */
export interface Note {
  id: string;
  shape: Shape;
  text: string;
  author: string;
  /** When it was written, ISO 8601, or empty. */
  made: string;
}

/** What a note lies on: the IIIF canvas, and how large the page's grid is, px. */
export interface Ground {
  canvas: CanvasFacts;
  size: Point;
}

export class NotesRefused extends Error {}

export const LARGEST_FILE = 2_000_000; // characters
export const MOST_NOTES = 500;
export const LONGEST_TEXT = 4000;
export const LONGEST_AUTHOR = 100;
const DEEPEST = 64;
const MOST_CORNERS = 200;
const ROUNDING = 0.06; // px: places are written to a tenth
const LONGEST_SELECTOR = 8000;
const CONTEXT = "http://www.w3.org/ns/anno.jsonld";
const SVG = ['<svg xmlns="http://www.w3.org/2000/svg">', "</svg>"] as const;
const NUMBER = String.raw`\d{1,6}(?:\.\d{1,6})?`;
const FRAGMENT = new RegExp(`^xywh=(?:pixel:)?(${NUMBER}),(${NUMBER}),(${NUMBER}),(${NUMBER})$`);
const POLYGON = /^<polygon points="([\d., ]+)"\s?\/>$/;
const CIRCLE = new RegExp(`^<circle cx="(${NUMBER})" cy="(${NUMBER})" r="(${NUMBER})"\\s?/>$`);
const CORNER = new RegExp(`^(${NUMBER}),(${NUMBER})$`);
const DATE = /^\d{4}-\d{2}-\d{2}(T\d{2}:\d{2}(:\d{2}(\.\d{1,6})?)?(Z|[+-]\d{2}:\d{2})?)?$/;
const NAME = /^(urn:uuid:[0-9a-f-]{36}|https?:\/\/[\w.~:/?#@!$&()*+,;=%-]{1,500})$/i;
const MARKUP = /<[a-z/!?]/i;
const JOINER = "\u2060";
const GUARDED = /<\u2060(?=[a-z/!?])/gi;
const CONTROL = /[\0-\x08\x0b\x0c\x0e-\x1f\x7f]/;
const CONTROLS = new RegExp(CONTROL.source, "g");

type Table = Record<string, unknown>;

/** Read a file of notes on this ground; throws NotesRefused, and takes nothing, where one thing in it is wrong. */
export function readNotes(text: string, ground: Ground): Note[] {
  if (text.length > LARGEST_FILE) refuse("", `it is larger than ${LARGEST_FILE / 1e6} MB`);
  if (depthOf(text) > DEEPEST) refuse("", `it is nested deeper than ${DEEPEST} brackets`);
  let page: unknown;
  try {
    page = JSON.parse(text);
  } catch {
    refuse("", "it is not JSON");
  }
  return readPage(page, ground);
}

/** Read an AnnotationPage. */
export function readPage(value: unknown, ground: Ground): Note[] {
  const page = tableOf(value, "the file");
  if (page["type"] !== "AnnotationPage") refuse("type", 'it is not "AnnotationPage"');
  const { items } = page;
  if (!Array.isArray(items)) refuse("items", "it is not a list");
  if (items.length > MOST_NOTES) refuse("items", `there are more than ${MOST_NOTES} notes`);
  return items.map((item, i) => readNote(item, `items[${i}]`, ground));
}

/** Make what a person typed a plain text without control characters, that is short enough in a file, too. */
export function plainText(text: string): string {
  let plain = text.replace(CONTROLS, "").slice(0, LONGEST_TEXT);
  while (guarded(plain).length > LONGEST_TEXT) plain = plain.slice(0, -1);
  return plain;
}

/** Write a text so that no program takes a < in it for markup: an invisible word joiner stands behind it. */
function guarded(text: string): string {
  return text.replace(/<(?=[a-z/!?])/gi, `<${JOINER}`);
}

/** Say why a text is not taken as a note; empty where it is. */
function faultOf(text: string): string {
  if (text.length > LONGEST_TEXT) return `it is longer than ${LONGEST_TEXT} characters`;
  if (MARKUP.test(text)) return "it holds markup: put a space after <";
  return CONTROL.test(text) ? "it holds control characters" : "";
}

function readNote(value: unknown, where: string, ground: Ground): Note {
  const item = tableOf(value, where);
  if (item["type"] !== "Annotation") refuse(`${where}.type`, 'it is not "Annotation"');
  const { motivation = "commenting", id, created, modified } = item;
  if (motivation !== "commenting") refuse(`${where}.motivation`, 'it is not "commenting"');
  const body = tableOf(single(item["body"]), `${where}.body`);
  if (body["type"] !== "TextualBody") refuse(`${where}.body.type`, 'it is not "TextualBody"');
  const { format = "text/plain" } = body;
  if (format !== "text/plain") refuse(`${where}.body.format`, 'it is not "text/plain"');
  const text = textOf(body["value"], `${where}.body.value`);
  const fault = faultOf(text);
  if (fault) refuse(`${where}.body.value`, fault);
  const made = modified ?? created ?? "";
  if (typeof made !== "string" || (made && !DATE.test(made)))
    refuse(`${where}.modified`, "it is not a date");
  return {
    id: typeof id === "string" && NAME.test(id) ? id : newId(),
    shape: readTarget(single(item["target"]), `${where}.target`, ground),
    text: text.replace(GUARDED, "<"),
    author: authorOf(single(item["creator"]), `${where}.creator`).replace(GUARDED, "<"),
    made,
  };
}

function authorOf(value: unknown, where: string): string {
  if (value === undefined) return "";
  const name = typeof value === "string" ? value : tableOf(value, where)["name"];
  const text = textOf(name, where);
  if (text.length > LONGEST_AUTHOR) refuse(where, `it is longer than ${LONGEST_AUTHOR} characters`);
  const fault = faultOf(text);
  if (fault) refuse(where, fault);
  return text;
}

function readTarget(value: unknown, where: string, { canvas, size }: Ground): Shape {
  if (typeof value === "string") {
    const [source = "", fragment = ""] = value.split("#", 2);
    return readTarget({ source, selector: { type: "FragmentSelector", value: fragment } }, where, {
      canvas,
      size,
    });
  }
  const target = tableOf(value, where);
  const source = typeof target["source"] === "string" ? { id: target["source"] } : target["source"];
  const { id, width = canvas.width, height = canvas.height } = tableOf(source, `${where}.source`);
  if (typeof id !== "string" || tailOf(id) !== tailOf(canvas.id))
    refuse(`${where}.source`, `it is not the canvas of this object, ${canvas.id}`);
  const [columns, rows] = [width, height].map((side, i) =>
    typeof side === "number" && side >= 1 && side <= 1e6
      ? side
      : refuse(`${where}.source.${i ? "height" : "width"}`, "it is not a number of pixels"),
  ) as [number, number];
  const scale = size[0] / columns;
  if (Math.abs(rows * scale - size[1]) > 2 + 2 * scale)
    refuse(`${where}.source`, "the picture has another shape");
  const selector = tableOf(single(target["selector"]), `${where}.selector`);
  const text = textOf(selector["value"], `${where}.selector.value`);
  if (text.length > LONGEST_SELECTOR) refuse(`${where}.selector.value`, "it is too long");
  return shapeOf(selector["type"], text, `${where}.selector`, { size: [columns, rows], scale });
}

/** The shape that a selector names; its numbers are from edge to edge of pixels, ours between their middles. */
function shapeOf(
  type: unknown,
  text: string,
  where: string,
  { size, scale }: { size: Point; scale: number },
): Shape {
  const place = (x: number, y: number): Point => {
    if (x > size[0] + ROUNDING || y > size[1] + ROUNDING)
      refuse(`${where}.value`, "it lies outside the painting");
    return [tenth(x * scale - 0.5), tenth(y * scale - 0.5)];
  };
  if (type === "FragmentSelector") {
    const found = FRAGMENT.exec(text)?.slice(1).map(Number);
    if (!found) return refuse(`${where}.value`, "it is not xywh=X,Y,WIDTH,HEIGHT in pixels");
    const [x, y, w, h] = found as [number, number, number, number];
    place(x + w, y + h);
    if (w <= 1 && h <= 1) return { kind: "place", points: [place(x + w / 2, y + h / 2)] };
    // The first and the last pixel within.
    const half = 0.5 / scale;
    const last = place(Math.max(x + w - half, x), Math.max(y + h - half, y));
    return { kind: "rectangle", points: [place(x + half, y + half), last] };
  }
  if (type !== "SvgSelector")
    refuse(`${where}.type`, 'it is neither "FragmentSelector" nor "SvgSelector"');
  const svg = text.trim().replaceAll("'", '"');
  const inner =
    svg.startsWith(SVG[0]) && svg.endsWith(SVG[1])
      ? svg.slice(SVG[0].length, -SVG[1].length).trim()
      : "";
  const circle = CIRCLE.exec(inner)?.slice(1).map(Number);
  if (circle) {
    const [x, y, r] = circle as [number, number, number];
    if (r > Math.max(...size)) refuse(`${where}.value`, "it lies outside the painting");
    const [cx, cy] = place(x, y);
    return { kind: "circle", points: [[cx, cy], [tenth(cx + r * scale), cy]] }; // prettier-ignore
  }
  const corners = POLYGON.exec(inner)?.[1]?.trim().split(/ +/) ?? [];
  if (corners.length < 3 || corners.length > MOST_CORNERS)
    refuse(
      `${where}.value`,
      `it is neither a circle nor a polygon of 3 to ${MOST_CORNERS} corners`,
    );
  const points = corners.map((corner) => {
    const found = CORNER.exec(corner);
    return found
      ? place(Number(found[1]), Number(found[2]))
      : refuse(`${where}.value`, "it has a corner that is not X,Y");
  });
  return { kind: "polygon", points };
}

/** Notes as an AnnotationPage. */
export function writeNotes(notes: Note[], ground: Ground): string {
  const page = {
    "@context": CONTEXT,
    type: "AnnotationPage",
    items: notes.map((note) => writeNote(note, ground)),
  };
  return JSON.stringify(page, null, 1) + "\n";
}

function writeNote({ id, shape, text, author, made }: Note, { canvas, size }: Ground): Table {
  return {
    id,
    type: "Annotation",
    motivation: "commenting",
    ...(made ? { modified: made } : {}),
    ...(author ? { creator: { type: "Person", name: guarded(author) } } : {}),
    body: { type: "TextualBody", value: guarded(text), format: "text/plain" },
    target: {
      type: "SpecificResource",
      source: {
        id: canvas.id,
        type: "Canvas",
        width: canvas.width,
        height: canvas.height,
        partOf: [{ id: canvas.manifest, type: "Manifest" }],
      },
      selector: selectorOf(shape, { scale: canvas.width / size[0], canvas }),
    },
  };
}

function selectorOf(
  { kind, points }: Shape,
  { scale, canvas }: { scale: number; canvas: CanvasFacts },
): Table {
  const inside = (value: number, most: number): number => Math.min(Math.max(value, 0), most);
  const place = ([x, y]: Point): Point => [
    inside(tenth((x + 0.5) * scale), canvas.width),
    inside(tenth((y + 0.5) * scale), canvas.height),
  ];
  const fragment = (...numbers: number[]): Table => ({
    type: "FragmentSelector",
    conformsTo: "http://www.w3.org/TR/media-frags/",
    value: `xywh=${numbers.join()}`,
  });
  const [[x, y], second] = [place(points[0]!), points[1]];
  if (kind === "place") {
    const whole = [
      inside(Math.floor(x), canvas.width - 1),
      inside(Math.floor(y), canvas.height - 1),
    ];
    return fragment(...whole, 1, 1);
  }
  if (kind === "rectangle") {
    const corners = points.map(([x, y]): Point => [Math.round(x), Math.round(y)]);
    const [xs, ys] = [corners.map(([x]) => x), corners.map(([, y]) => y)];
    const first = place([Math.min(...xs) - 0.5, Math.min(...ys) - 0.5]);
    const last = place([Math.max(...xs) + 0.5, Math.max(...ys) + 0.5]);
    return fragment(...first, tenth(last[0] - first[0]), tenth(last[1] - first[1]));
  }
  const radius = second ? Math.hypot(second[0] - points[0]![0], second[1] - points[0]![1]) : 0;
  const inner =
    kind === "circle"
      ? `<circle cx="${x}" cy="${y}" r="${tenth(radius * scale)}"/>`
      : `<polygon points="${points.map((point) => place(point).join()).join(" ")}"/>`;
  return { type: "SvgSelector", value: SVG.join(inner) };
}

/** A new name of a note, a random UUID; `crypto.randomUUID` is not there on pages over http. */
export function newId(): string {
  const bytes = crypto.getRandomValues(new Uint8Array(16));
  bytes[6] = (bytes[6]! & 15) | 64;
  bytes[8] = (bytes[8]! & 63) | 128;
  const hex = [...bytes].map((byte) => byte.toString(16).padStart(2, "0")).join("");
  return `urn:uuid:${hex.replace(/^(.{8})(.{4})(.{4})(.{4})/, "$1-$2-$3-$4-")}`;
}

/** What tells the canvas of one object from others, wherever the folder stands: iiif/OBJECT/canvas. */
function tailOf(id: string): string {
  return id.split("/").slice(-3).join("/");
}

const tenth = (value: number): number => Math.round(10 * value) / 10;

const single = (value: unknown): unknown =>
  Array.isArray(value) && value.length === 1 ? (value[0] as unknown) : value;

function tableOf(value: unknown, where: string): Table {
  if (typeof value !== "object" || value === null || Array.isArray(value))
    refuse(where, "it is not a table of keys and values");
  return value as Table;
}

function textOf(value: unknown, where: string): string {
  return typeof value === "string" ? value : refuse(where, "it is not text");
}

function refuse(where: string, why: string): never {
  throw new NotesRefused(where ? `${where}: ${why}` : why);
}

/** How deep brackets are nested, outside texts. */
function depthOf(text: string): number {
  let [depth, deepest, inside] = [0, 0, false];
  for (let i = 0; i < text.length; i++) {
    const sign = text[i];
    if (inside) {
      if (sign === "\\") i++;
      else if (sign === '"') inside = false;
    } else if (sign === '"') inside = true;
    else if (sign === "[" || sign === "{") deepest = Math.max(deepest, ++depth);
    else if (sign === "]" || sign === "}") depth--;
  }
  return deepest;
}
