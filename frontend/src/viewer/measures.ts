// The panel "Measure": lengths and areas on the painting, and a grid; in mm where the sampling is known.
import { effect } from "@preact/signals-core";
import { make, saveFile } from "../shared/element";
import type { Point } from "../shared/pane";
import type { Address } from "./address";
import type { Drawing } from "./drawing";
import { quoted } from "./numbers";
import { freeName, LONGEST_NAME } from "./names";
import type { PageRecord } from "./record";
import { describeMillimetres, roundBelow, type ScaleBar } from "./scalebar";
import { areaOf, fromText, KINDS, lengthOf, toText, type Kind, type Shape } from "./shapes";
import type { Measure, State } from "./state";

const MOST_MEASURES = 24;
const COLOUR = "#ffd75e";
const WIDEST_PX = 130; // of the screen, between two lines of the grid
const DIGITS = 4;
const MEASURED: Measure["kind"][] = ["line", ...KINDS];
const LABELS = { line: "Length", polygon: "Area", rectangle: "Rectangle", circle: "Circle" };
const HINTS: Record<Measure["kind"], string> = {
  line: "Click the corners of a line; a double click or Enter ends it, Esc cancels.",
  polygon: "Click the corners; a double click or Enter closes the area, Esc cancels.",
  rectangle: "Drag over the painting; Esc cancels.",
  circle: "Drag from the middle outwards; Esc cancels.",
};

export class MeasurePanel {
  private readonly list = make("ol", { class: "pins" });
  private readonly message = make("p", { class: "note-line soft", role: "status" });
  private readonly save = make(
    "button",
    { type: "button", class: "small" },
    "Save measures as CSV",
  );
  private readonly grid = make("input", { type: "checkbox" });
  private readonly marks = make("input", { type: "checkbox" });
  private readonly tools = new Map<Measure["kind"], HTMLButtonElement>();

  constructor(
    host: HTMLElement,
    private readonly record: PageRecord,
    private readonly state: State,
    private readonly drawing: Drawing,
    address: Address,
  ) {
    for (const kind of ["line", "polygon", "rectangle", "circle"] as const)
      this.tools.set(kind, this.tool(kind));
    const grid = make("label", { class: "keep" }, this.grid, " Show a grid");
    const marks = make("label", { class: "keep" }, this.marks, " Show marks on the painting");
    const line = (...parts: HTMLElement[]): HTMLElement =>
      make("div", { class: "pin-tools" }, ...parts);
    host.append(
      line(...this.tools.values(), grid, marks),
      this.list,
      this.message,
      line(this.save),
    );
    if (!record.grid.px_per_mm)
      this.message.textContent = "The sampling of this object is not known: lengths are in pixels.";
    this.save.addEventListener("click", () => this.saveAll());
    this.grid.addEventListener("change", () => (state.grid.value = this.grid.checked));
    effect(() => {
      const measures = state.measures.value;
      this.save.disabled = !measures.length;
      for (const button of this.tools.values()) button.disabled = measures.length >= MOST_MEASURES;
      this.fill(measures);
      const outlines = measures.map((shape, i) => ({
        shape,
        colour: COLOUR,
        label: `M${i + 1} ${this.describe(shape)}`,
      }));
      drawing.show("measures", outlines);
    });
    this.marks.addEventListener("change", () => (state.marks.value = this.marks.checked));
    effect(() => {
      this.grid.checked = state.grid.value;
      this.marks.checked = state.marks.value;
    });
    this.register(address);
  }

  /** Let a person draw a line or an area. */
  async start(kind: Measure["kind"]): Promise<void> {
    const { measures } = this.state;
    if (measures.value.length >= MOST_MEASURES) return;
    const button = this.tools.get(kind)!;
    const done = this.drawing.begin(kind, (shape) => this.describe(shape));
    button.setAttribute("aria-pressed", "true");
    this.message.textContent = HINTS[kind];
    const points = await done;
    button.setAttribute("aria-pressed", "false");
    this.message.textContent = "";
    if (!points) return;
    const name = freeName(measures.value, LABELS[kind]);
    measures.value = [...measures.value, { name, kind, points }];
  }

  /** Set the lines of the grid for a scale, screen pixels a pixel; words for it, or none. */
  scaleGrid(scale: number, bar: ScaleBar): void {
    const { width, height, px_per_mm } = this.record.grid;
    const unit = px_per_mm ?? 1; // pixels a mm, or a pixel
    const step = roundBelow(WIDEST_PX / (scale * unit));
    const shown = this.state.grid.value && Number.isFinite(step);
    this.drawing.grid = shown ? { step: step * unit, size: [width, height] } : null;
    const words = px_per_mm ? describeMillimetres(step) : `${step} px`;
    bar.note(shown ? `grid ${words}` : "");
  }

  private describe(shape: Shape): string {
    const { px_per_mm } = this.record.grid;
    return shape.kind === "line"
      ? describeLength(lengthOf(shape), px_per_mm)
      : describeArea(areaOf(shape), px_per_mm);
  }

  private register(address: Address): void {
    const { measures, grid, marks } = this.state;
    address.add({
      signals: [measures],
      write: (facts) => {
        for (const measure of measures.value) facts.append("measure", toText(measure));
      },
      read: (facts) => {
        measures.value = facts
          .getAll("measure")
          .slice(0, MOST_MEASURES)
          .flatMap((text) => fromText(text, MEASURED, LONGEST_NAME) ?? []);
      },
    });
    address.add({
      signals: [grid, marks],
      carried: true,
      write: (facts) => {
        if (grid.value) facts.set("grid", "1");
        if (!marks.value) facts.set("marks", "0");
      },
      read: (facts) => {
        grid.value = facts.get("grid") === "1";
        marks.value = facts.get("marks") !== "0";
      },
    });
  }

  private tool(kind: Measure["kind"]): HTMLButtonElement {
    const attributes = { type: "button", class: "small", "aria-pressed": "false" };
    const button = make("button", attributes, LABELS[kind]);
    if (kind !== "line") button.setAttribute("aria-label", `Measure ${WORDS[kind]}`);
    button.addEventListener("click", () => {
      if (button.getAttribute("aria-pressed") === "true") this.drawing.cancel();
      else void this.start(kind);
    });
    return button;
  }

  private fill(measures: Measure[]): void {
    const held = document.activeElement;
    const typing = held instanceof HTMLInputElement && this.list.contains(held);
    if (typing && this.list.childElementCount === measures.length) return;
    this.list.replaceChildren(...measures.map((measure, i) => this.row(measure, i)));
  }

  private row(measure: Measure, number: number): HTMLElement {
    const badge = make("span", { class: "pin-number measure" }, `M${number + 1}`);
    const name = make("input", {
      type: "text",
      maxlength: LONGEST_NAME,
      "aria-label": `Name of measure ${number + 1}`,
    });
    name.value = measure.name;
    name.addEventListener("input", () => this.change(number, { ...measure, name: name.value }));
    const label = `Remove ${measure.name || `measure ${number + 1}`}`;
    const remove = make("button", { type: "button", class: "small", "aria-label": label }, "×");
    remove.addEventListener("click", () => this.change(number, null));
    const round =
      measure.kind === "line"
        ? ""
        : `, outline ${describeLength(lengthOf(measure), this.record.grid.px_per_mm)}`;
    const words = make("span", { class: "region-words soft" }, `${this.describe(measure)}${round}`);
    return make("li", { class: "region-row" }, badge, name, remove, words);
  }

  private change(number: number, measure: Measure | null): void {
    const { measures } = this.state;
    measures.value = measures.value.flatMap((old, i) =>
      i !== number ? [old] : measure ? [measure] : [],
    );
  }

  private saveAll(): void {
    const scale = this.record.grid.px_per_mm ?? NaN;
    const number = (value: number): string => (Number.isFinite(value) ? value.toPrecision(7) : "");
    const rows = this.state.measures.value.map((measure) => {
      const [length, area] = [lengthOf(measure), areaOf(measure)];
      const places = measure.points.map((place: Point) => place.join(" ")).join(" ");
      const numbers = [length, length / scale, area || NaN, area ? area / scale ** 2 : NaN];
      return [quoted(measure.name), measure.kind, ...numbers.map(number), quoted(places)].join();
    });
    const head = "name,kind,length_px,length_mm,area_px,area_mm2,places_px";
    const text = [head, ...rows, ""].join("\n");
    saveFile(`${this.record.object.name}_measures.csv`, text, "text/csv");
  }
}

const WORDS: Record<Kind, string> = {
  polygon: "an area",
  rectangle: "a rectangle",
  circle: "a circle",
};

/** A length of so many pixels in mm, in m from one on; in px where the scale is not known. */
export function describeLength(px: number, pxPerMm: number | null): string {
  if (!pxPerMm) return `${digits(px)} px`;
  const mm = px / pxPerMm;
  return mm >= 1000 ? `${digits(mm / 1000)} m` : `${digits(mm)} mm`;
}

/** An area of so many square pixels in mm², in cm² from 10,000 on; in px² where the scale is not known. */
export function describeArea(px: number, pxPerMm: number | null): string {
  if (!pxPerMm) return `${digits(px)} px²`;
  const area = px / pxPerMm ** 2;
  return area >= 10_000 ? `${digits(area / 100)} cm²` : `${digits(area)} mm²`;
}

function digits(value: number): string {
  return Number(value.toPrecision(DIGITS)).toString();
}
