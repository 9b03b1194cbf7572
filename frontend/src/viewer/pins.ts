// Places that are kept: named, marked on the painting, their spectra over one another.
import { effect } from "@preact/signals-core";
import { make, saveFile } from "../shared/element";
import type { Point } from "../shared/pane";
import { saveChart } from "../shared/svgfile";
import { numbersOf, type Address } from "./address";
import { drawChart, samplesOf, type Curve } from "./chart";
import { freeName, LONGEST_NAME } from "./names";
import { csvRows, CSV_HEAD, describeU, plusMinus, quoted, uncertainPixel } from "./numbers";
import type { Layer, PageRecord } from "./record";
import { parseReference, spectralAngle, type Reference } from "./reference";
import type { LayerSpectra, Spectra, Spectrum } from "./spectra";
import type { Pin, State } from "./state";
import { uOf } from "./uncertainty";

const MOST_PINS = 24;
const CURVES = 8; // colours of the style sheet, --curve-1 and on
const GREY = "var(--soft)";
const LARGEST_FILE = 2_000_000; // bytes

/** The colour of the pin of a number, from 0. */
export const pinColour = (number: number): string => `var(--curve-${(number % CURVES) + 1})`;

interface Source {
  layer: Layer;
  spectra: Spectra;
}

/** The panel "Kept places". */
export class PinList {
  private readonly sources: Source[];
  private readonly choice = make("select", { "aria-label": "Layer whose spectra are compared" });
  private readonly list = make("ol", { class: "pins" });
  private readonly drawing = make("div", { class: "drawing" });
  private readonly file = make("input", {
    type: "file",
    accept: ".csv,.txt,.tsv,text/csv,text/plain",
    class: "visually-hidden",
    "aria-label": "File of a reference spectrum",
  });
  private readonly forget = make(
    "button",
    { type: "button", class: "small" },
    "Remove the reference",
  );
  private readonly message = make("p", { class: "note-line soft", role: "status" });
  private readonly save = make("button", { type: "button", class: "small" }, "Save places as CSV");
  private readonly saveDrawing = make(
    "button",
    { type: "button", class: "small" },
    "Save spectra as SVG",
  );
  private reference: Reference | null = null;
  private turn = 0;
  private following = true;

  constructor(
    host: HTMLElement,
    private readonly record: PageRecord,
    spectra: LayerSpectra,
    private readonly state: State,
    private readonly go: (place: Point) => void,
    address: Address,
  ) {
    this.sources = [...spectra]
      .filter(([{ bands }]) => bands.length)
      .map(([layer, one]) => ({ layer, spectra: one }));
    for (const { layer } of this.sources)
      this.choice.append(make("option", { value: layer.name }, layer.name));
    const most = [...this.sources].sort((a, b) => narrow(b.layer) - narrow(a.layer))[0];
    if (most) this.choice.value = most.layer.name;
    const keep = make("button", { type: "button", class: "small" }, "Keep this place");
    const load = make("button", { type: "button", class: "small" }, "Load a reference (CSV)…");
    const compared = make("label", { class: "compared" }, "Spectra of ", this.choice);
    const tools = make(
      "div",
      { class: "pin-tools" },
      this.save,
      this.saveDrawing,
      load,
      this.forget,
      this.file,
    );
    host.append(
      make("div", { class: "pin-tools" }, keep, compared),
      this.list,
      this.drawing,
      this.message,
      tools,
    );
    keep.addEventListener("click", () => this.keep());
    load.addEventListener("click", () => this.file.click());
    this.file.addEventListener("change", () => void this.load());
    this.forget.addEventListener("click", () => this.use(null));
    const shown = this.follow(most?.layer.name ?? "");
    this.save.addEventListener("click", () => void this.saveAll());
    this.saveDrawing.addEventListener("click", () => this.saveChart());
    effect(() => {
      keep.disabled = !state.pin.value || state.pins.value.length >= MOST_PINS;
    });
    effect(() => {
      this.save.disabled = !state.pins.value.length;
      void this.refresh();
    });
    this.register(address, shown);
  }

  /** Until a person chooses, compare spectra of the layer that is shown; return which that is. */
  private follow(otherwise: string): () => string {
    const shown = (): string => {
      const name = this.state.a.value?.layer.name ?? "";
      return this.sources.some(({ layer }) => layer.name === name) ? name : otherwise;
    };
    this.choice.addEventListener("change", () => {
      this.following = false;
      void this.refresh();
    });
    effect(() => {
      const name = shown();
      if (!this.following || this.choice.value === name) return;
      this.choice.value = name;
      void this.refresh();
    });
    return shown;
  }

  private register(address: Address, fresh: () => string): void {
    const { pin, pins } = this.state;
    const { width, height } = this.record.grid;
    address.add({
      signals: [pin],
      write: (facts) => {
        if (pin.value) facts.set("pin", pin.value.map((at) => at.toFixed(2)).join());
      },
      read: (facts) => {
        const place = numbersOf(facts, "pin", 2);
        pin.value = place && [place[0]!, place[1]!];
      },
    });
    address.addChoice("spectra", this.choice, fresh);
    const readPin = (text: string): Pin[] => {
      const [x, y, ...rest] = text.split(",");
      const at: Point = [Number(x), Number(y)];
      const inside = at[0] >= 0 && at[1] >= 0 && at[0] <= width - 1 && at[1] <= height - 1;
      return inside ? [{ name: rest.join().slice(0, LONGEST_NAME), at }] : [];
    };
    address.add({
      signals: [pins],
      write: (facts) => {
        for (const { name, at } of pins.value)
          facts.append("kept", [...at.map((value) => value.toFixed(2)), name].join());
      },
      read: (facts) => {
        pins.value = facts.getAll("kept").slice(0, MOST_PINS).flatMap(readPin);
      },
    });
  }

  /** Keep the place that is pinned. */
  keep(): void {
    const { pin, pins } = this.state;
    if (!pin.value || pins.value.length >= MOST_PINS) return;
    pins.value = [...pins.value, { name: freeName(pins.value, "Place"), at: pin.value }];
  }

  private async load(): Promise<void> {
    const file = this.file.files?.[0];
    this.file.value = "";
    if (!file) return;
    try {
      if (file.size > LARGEST_FILE) throw new Error(`${file.name} is too large for a spectrum.`);
      this.use(parseReference(file.name, await file.text()));
    } catch (error) {
      this.use(null, error instanceof Error ? error.message : String(error));
    }
  }

  private use(reference: Reference | null, message = ""): void {
    this.reference = reference;
    void this.refresh(message);
  }

  /** Read the spectra of all kept places and show them; an older reading that ends later is dropped. */
  private async refresh(message = ""): Promise<void> {
    const turn = ++this.turn;
    const pins = this.state.pins.value;
    const source = this.sources.find(({ layer }) => layer.name === this.choice.value);
    const spectra = source ? await Promise.all(pins.map((pin) => read(source.spectra, pin))) : [];
    if (turn !== this.turn) return;
    const { flags } = this.record;
    const curves = spectra.map((spectrum, i) =>
      source && spectrum
        ? { layer: source.layer, colour: pinColour(i), mark: String(i + 1), spectrum }
        : null,
    );
    const angles = curves.map((curve) =>
      curve && this.reference ? spectralAngle(samplesOf(curve, flags), this.reference) : null,
    );
    this.fill(
      pins,
      angles,
      spectra.map((spectrum) => (source && spectrum ? describePixel(source.layer, spectrum) : "")),
    );
    const known: Curve[] = curves.filter((curve) => curve !== null);
    const reflectance = source?.layer.quantity === "reflectance";
    if (this.reference && reflectance) known.push(curveOf(this.reference));
    const quantity = reflectance ? "Reflectance" : "Counts";
    const chart = known.length ? drawChart(known, { quantity, marks: flags, range: null }) : null;
    this.drawing.replaceChildren(...(chart ? [chart] : []));
    this.saveDrawing.disabled = !chart;
    this.forget.hidden = !this.reference;
    const sure = source && pins.length ? describeU(source.layer) : "";
    this.message.textContent = message || `${this.explain()} ${sure}`.trim();
  }

  private explain(): string {
    if (!this.reference) return "";
    const { name, nm } = this.reference;
    const range = `${nm[0]!.toFixed(0)} to ${nm.at(-1)!.toFixed(0)} nm`;
    return `Grey: ${name}, ${range}. The spectral angle compares shapes; a small one is not an identification.`;
  }

  private fill(pins: Pin[], angles: (number | null)[], words: string[]): void {
    // Who types a name stays where they are.
    const held = document.activeElement;
    const typing = held instanceof HTMLInputElement && this.list.contains(held);
    if (typing && this.list.childElementCount === pins.length) {
      this.list.querySelectorAll(".angle").forEach((element, i) => {
        element.textContent = describeAngle(angles[i] ?? null);
      });
      return;
    }
    this.list.replaceChildren(
      ...pins.map((pin, i) => this.row(pin, i, angles[i] ?? null, words[i]!)),
    );
  }

  private row(pin: Pin, number: number, angle: number | null, words: string): HTMLElement {
    const badge = make("span", { class: "pin-number", "aria-hidden": "true" }, String(number + 1));
    badge.style.background = pinColour(number);
    const name = make("input", {
      type: "text",
      maxlength: LONGEST_NAME,
      "aria-label": `Name of place ${number + 1}`,
    });
    name.value = pin.name;
    name.addEventListener("input", () => this.change(number, { ...pin, name: name.value }));
    const [x, y] = pin.at.map((at) => Math.round(at));
    const where = make("button", { type: "button", class: "small" }, `${x}, ${y}`);
    where.title = "Show this place";
    where.addEventListener("click", () => this.go(this.state.pins.value[number]!.at));
    const label = `Remove ${pin.name || `place ${number + 1}`}`;
    const remove = make("button", { type: "button", class: "small", "aria-label": label }, "×");
    remove.addEventListener("click", () => this.change(number, null));
    const apart = make("span", { class: "angle" }, describeAngle(angle));
    const numbers = make("span", { class: "region-words soft" }, words);
    return make("li", {}, badge, name, where, apart, remove, numbers);
  }

  private change(number: number, pin: Pin | null): void {
    const { pins } = this.state;
    pins.value = pins.value.flatMap((old, i) => (i !== number ? [old] : pin ? [pin] : []));
  }

  private saveChart(): void {
    const chart = this.drawing.querySelector<SVGElement>("svg");
    if (!chart) return;
    const { object, credits } = this.record;
    const curves = this.state.pins.value.map(({ name }, i) => ({ colour: pinColour(i), name }));
    if (this.reference) curves.push({ colour: GREY, name: this.reference.name });
    const title = `${object.title}, spectra of ${this.choice.value}`;
    const lines = [title, ...(this.reference ? [this.explain()] : []), ...credits];
    saveChart(`${object.name}_places.svg`, chart, { title, curves, lines });
  }

  private async saveAll(): Promise<void> {
    const lines = await Promise.all(
      this.state.pins.value.map(async (pin) => {
        const pixel = pixelOf(pin);
        const readings = await Promise.all(
          this.sources.map(async ({ layer, spectra }) => ({
            layer,
            spectrum: await spectra.read(...pixel).catch(() => null),
          })),
        );
        return csvRows(pixel, readings).map((row) => `${quoted(pin.name)},${row}`);
      }),
    );
    const text = [`place,${CSV_HEAD}`, ...lines.flat(), ""].join("\n");
    saveFile(`${this.record.object.name}_places.csv`, text, "text/csv");
  }
}

const pixelOf = ({ at }: Pin): Point => [Math.round(at[0]), Math.round(at[1])];

const describeAngle = (angle: number | null): string =>
  angle === null ? "" : `${angle.toFixed(1)}°`;

const narrow = ({ bands }: Layer): number =>
  bands.filter(({ wavelength }) => wavelength !== null).length;

/** The value of the reference channel with its uncertainty. */
function describePixel(layer: Layer, spectrum: Spectrum): string {
  const [band, sure] = [layer.reference_band, uncertainPixel(layer, spectrum)];
  const value = plusMinus(spectrum.values[band] ?? NaN, sure ? uOf(sure, band) : undefined);
  return `${layer.bands[band]?.label ?? ""}: ${value}`;
}

function read(spectra: Spectra, pin: Pin): Promise<Spectrum | null> {
  return spectra.read(...pixelOf(pin)).catch(() => null);
}

/** A reference as a curve of the chart, in grey. */
function curveOf({ nm, values }: Reference): Curve {
  const bands = nm.map((wavelength) => ({
    label: String(wavelength),
    wavelength,
    centroid: null,
    fwhm: null,
  }));
  return {
    layer: { bands },
    colour: GREY,
    spectrum: { values: Float32Array.from(values), sigma: null, flags: null },
  };
}
