// The panel "Regions": mean spectra with their spread, histograms of a band, and numbers to save.
import { effect } from "@preact/signals-core";
import { make, saveFile } from "../shared/element";
import type { Point } from "../shared/pane";
import { saveChart } from "../shared/svgfile";
import { drawChart, type Curve } from "./chart";
import type { Address } from "./address";
import type { Drawing } from "./drawing";
import { drawHistograms } from "./histograms";
import { describeArea } from "./measures";
import { freeName, LONGEST_NAME } from "./names";
import { cellsOfU, describeU, plusMinus, quoted, shortest } from "./numbers";
import { pinColour } from "./pins";
import type { Layer, PageRecord } from "./record";
import { areaOf, fromText, KINDS, toText, type Kind, type Region } from "./shapes";
import type { LayerSpectra } from "./spectra";
import type { State } from "./state";
import { histogram, measure, valuesOf, type Histogram, type Statistics } from "./statistics";
import { compare, uncertain, uOf, type Uncertain } from "./uncertainty";

const MOST_REGIONS = 12;
const BINS = 40;
const MOST_KEPT = 128_000_000; // bytes of values

export class RegionPanel {
  private readonly choice = make("select", { "aria-label": "Layer that regions are measured in" });
  private readonly band = make("select", { "aria-label": "Band of the histogram" });
  private readonly other = make("select", { "aria-label": "Band for ratio and difference" });
  private readonly list = make("ol", { class: "pins" });
  private readonly plots = make("div", { class: "drawing" });
  private readonly bars = make("div", { class: "drawing histogram" });
  private readonly message = make("p", { class: "note-line soft", role: "status" });
  private readonly save = make("button", { type: "button", class: "small" }, "Save regions as CSV");
  private readonly files: HTMLButtonElement[] = [];
  private readonly tools: HTMLButtonElement[];
  private withValues: Statistics[] = [];
  private readonly measured = new Map<string, Promise<Statistics>>();
  private shown: (Histogram & { name: string })[] = [];
  private turn = 0;

  constructor(
    host: HTMLElement,
    private readonly record: PageRecord,
    private readonly spectra: LayerSpectra,
    private readonly state: State,
    private readonly drawing: Drawing,
    view: () => [Point, Point],
    address: Address,
  ) {
    for (const { name } of spectra.keys())
      this.choice.append(make("option", { value: name }, name));
    this.tools = KINDS.map((kind) => this.tool(kind));
    const whole = make("button", { type: "button", class: "small" }, "What is in view");
    whole.addEventListener("click", () => this.add("rectangle", view()));
    const line = (...parts: HTMLElement[]): HTMLElement =>
      make("div", { class: "pin-tools" }, ...parts);
    const compared = make("label", { class: "compared" }, "Measured in ", this.choice);
    const shown = make("label", { class: "compared" }, "Histogram of ", this.band);
    const against = make("label", { class: "compared" }, "Ratio and difference to ", this.other);
    this.files.push(
      this.fileButton("Save spectra of regions as SVG", () => this.saveSpectra()),
      this.fileButton("Save histogram as SVG", () => this.saveHistogram()),
      this.fileButton("Save histogram as CSV", () => this.saveCounts()),
    );
    const parts = [line(...this.tools, whole), line(compared, shown, against)];
    host.append(
      ...parts,
      this.list,
      this.plots,
      this.bars,
      this.message,
      line(this.save, ...this.files),
    );
    this.choice.addEventListener("change", () => this.chooseLayer());
    this.band.addEventListener("change", () => void this.refresh());
    this.other.addEventListener("change", () => void this.refresh());
    this.save.addEventListener("click", () => void this.saveAll());
    this.offerBands();
    effect(() => {
      const regions = state.regions.value;
      for (const button of [this.save, ...this.files]) button.disabled = !regions.length;
      for (const button of [...this.tools, whole]) button.disabled = regions.length >= MOST_REGIONS;
      const outlines = regions.map((shape, i) => ({
        shape,
        colour: pinColour(i),
        label: String(i + 1),
      }));
      drawing.show("regions", outlines);
      void this.refresh();
    });
    this.register(address);
  }

  private tool(kind: Kind): HTMLButtonElement {
    const attributes = { type: "button", class: "small", "aria-pressed": "false" };
    const button = make("button", attributes, kind[0]!.toUpperCase() + kind.slice(1));
    button.addEventListener("click", () => {
      if (button.getAttribute("aria-pressed") === "true") this.drawing.cancel();
      else void this.sketch(kind, button);
    });
    return button;
  }

  /** Let a person draw a region. */
  private async sketch(kind: Kind, button: HTMLElement): Promise<void> {
    const done = this.drawing.begin(kind);
    button.setAttribute("aria-pressed", "true");
    this.message.textContent =
      kind === "polygon"
        ? "Click the corners; a double click or Enter closes the polygon, Esc cancels."
        : `Drag over the painting${kind === "circle" ? ", from the middle outwards" : ""}; Esc cancels.`;
    const points = await done;
    button.setAttribute("aria-pressed", "false");
    this.message.textContent = "";
    if (points) this.add(kind, points);
  }

  private add(kind: Kind, points: Point[]): void {
    const { regions } = this.state;
    if (regions.value.length >= MOST_REGIONS) return;
    const name = freeName(regions.value, "Region");
    regions.value = [...regions.value, { name, kind, points }];
  }

  private register(address: Address): void {
    const { regions } = this.state;
    const [first] = this.spectra.keys();
    address.addChoice("measured", this.choice, () => first?.name ?? "");
    address.addChoice("histogram", this.band, () => String(this.layer?.reference_band ?? 0));
    address.addChoice("against", this.other, () => "");
    address.add({
      signals: [regions],
      write: (facts) => {
        for (const region of regions.value) facts.append("region", toText(region));
      },
      read: (facts) => {
        regions.value = facts
          .getAll("region")
          .slice(0, MOST_REGIONS)
          .flatMap((text) => fromText(text, KINDS, LONGEST_NAME) ?? []);
      },
    });
  }

  private get layer(): Layer | undefined {
    return [...this.spectra.keys()].find(({ name }) => name === this.choice.value);
  }

  private chooseLayer(): void {
    this.offerBands();
    void this.refresh();
  }

  private offerBands(): void {
    const { layer } = this;
    const labels = layer?.bands.map(({ label }) => label) ?? [];
    this.band.replaceChildren(...labels.map((label, i) => make("option", { value: i }, label)));
    const none = make("option", { value: "" }, "no other band");
    this.other.replaceChildren(
      none,
      ...labels.map((label, i) => make("option", { value: i }, label)),
    );
    if (layer) this.band.value = String(layer.reference_band);
  }

  private statistics(layer: Layer, region: Region): Promise<Statistics> {
    const key = JSON.stringify([layer.id, region.kind, region.points]);
    let found = this.measured.get(key);
    if (!found) {
      const wanted = { marks: this.record.flags, noise: layer.budget !== undefined };
      found = measure(this.spectra.get(layer)!, region, wanted);
      this.measured.set(key, found);
      found.catch(() => this.measured.delete(key));
    }
    return found;
  }

  /** Count the values of the chosen band; those of all bands are kept where they are not too many. */
  private async count(layer: Layer, region: Region, found: Statistics): Promise<Histogram | null> {
    const [band, spectra] = [Number(this.band.value), this.spectra.get(layer)!];
    const marks = this.record.flags;
    if (found.values) return histogram(found.values[band]!, BINS);
    if (4 * found.pixels * layer.bands.length > MOST_KEPT) {
      const [values] = await valuesOf(spectra, region, { bands: [band], marks });
      return histogram(values!, BINS);
    }
    found.values = await valuesOf(spectra, region, { bands: layer.bands.map((_, i) => i), marks });
    // Of older regions the values go where all take too much memory.
    let left = MOST_KEPT;
    this.withValues = [found, ...this.withValues].filter((one) => {
      left -= one.values?.reduce((sum, { length }) => sum + 4 * length, 0) ?? 0;
      if (left < 0) one.values = null;
      return one.values;
    });
    return histogram(found.values[band]!, BINS);
  }

  /** Measure all regions and show them; what was requested before and ends later is dropped. */
  private async refresh(): Promise<void> {
    const turn = ++this.turn;
    const regions = this.state.regions.value;
    const { layer } = this;
    if (!layer) return;
    if (regions.length) this.message.textContent = "Measuring …";
    try {
      const found = await Promise.all(regions.map((region) => this.statistics(layer, region)));
      if (turn !== this.turn) return;
      this.fill(layer, regions, found);
      this.plot(layer, found);
      // Histograms need every value: they come later, where a region is large.
      const bars = await Promise.all(
        regions.map((region, i) => this.count(layer, region, found[i]!)),
      );
      if (turn !== this.turn) return;
      this.shown = bars.flatMap((one, i) => (one ? [{ ...one, name: regions[i]!.name }] : []));
      const drawn = drawHistograms(bars, quantityOf(layer));
      this.bars.replaceChildren(...(drawn ? [drawn] : []));
      this.message.textContent = regions.length
        ? `Lines are means. The shaded range is one standard deviation of the pixels, not of the mean. ${describeU(layer)}`
        : "";
    } catch (error) {
      if (turn === this.turn) this.message.textContent = String(error);
    }
  }

  private plot(layer: Layer, found: Statistics[]): void {
    const curves = found.map(({ means, spreads }, i): Curve => ({
      layer,
      colour: pinColour(i),
      mark: String(i + 1),
      spectrum: {
        values: Float32Array.from(means),
        sigma: Float32Array.from(spreads),
        flags: null,
      },
    }));
    const options = { quantity: quantityOf(layer), marks: this.record.flags, range: null };
    const chart = curves.length ? drawChart(curves, options) : null;
    this.plots.replaceChildren(...(chart ? [chart] : []));
  }

  private fill(layer: Layer, regions: Region[], found: Statistics[]): void {
    const held = document.activeElement;
    const typing = held instanceof HTMLInputElement && this.list.contains(held);
    if (typing && this.list.childElementCount === regions.length) return;
    this.list.replaceChildren(
      ...regions.map((region, i) => this.row(region, i, this.describe(layer, region, found[i]!))),
    );
  }

  /** Numbers of a region in the chosen band, and beside another one. */
  private describe(layer: Layer, region: Region, found: Statistics): HTMLElement[] {
    const [band, other] = [Number(this.band.value), this.other.value];
    const { means, spreads, counts, pixels } = found;
    const sure = uncertainMean(layer, found);
    const [mean, spread, n] = [means[band] ?? NaN, spreads[band] ?? NaN, counts[band] ?? 0];
    const u = sure ? uOf(sure, band) : undefined;
    const differing = Number.isFinite(spread) ? ` · spread ${spread.toPrecision(3)}` : "";
    const numbers = `${plusMinus(mean, u)}${differing} · ${n} of ${pixels} valid px · ${describeArea(areaOf(region), this.record.grid.px_per_mm)}`;
    const words = make("span", { class: "region-words soft" }, numbers);
    Object.assign(words.dataset, { mean, spread, n, u: u ?? "" });
    if (other === "" || Number(other) === band) return [words];
    const [ratio, difference] = compare(
      sure ?? { values: means, shared: [], alone: means.map(() => 0) },
      band,
      Number(other),
    );
    const [a, b] = [band, Number(other)].map((i) => layer.bands[i]!.label.replace(" ", "\u00a0"));
    const pair = make("span", { class: "region-pair soft" });
    pair.textContent = `${a}\u00a0/\u00a0${b}: ${plusMinus(...ratio)} · ${a}\u00a0−\u00a0${b}: ${plusMinus(...difference)}`;
    Object.assign(pair.dataset, { ratio: ratio.join(), difference: difference.join() });
    return [words, pair];
  }

  private row(region: Region, number: number, words: HTMLElement[]): HTMLElement {
    const badge = make("span", { class: "pin-number", "aria-hidden": "true" }, String(number + 1));
    badge.style.background = pinColour(number);
    const name = make("input", {
      type: "text",
      maxlength: LONGEST_NAME,
      "aria-label": `Name of region ${number + 1}`,
    });
    name.value = region.name;
    name.addEventListener("input", () => this.change(number, { ...region, name: name.value }));
    const remove = make(
      "button",
      { type: "button", class: "small", "aria-label": `Remove ${region.name}` },
      "×",
    );
    remove.addEventListener("click", () => this.change(number, null));
    return make("li", { class: "region-row" }, badge, name, remove, ...words);
  }

  private change(number: number, region: Region | null): void {
    const { regions } = this.state;
    regions.value = regions.value.flatMap((old, i) =>
      i !== number ? [old] : region ? [region] : [],
    );
  }

  private fileButton(words: string, save: () => void): HTMLButtonElement {
    const button = make("button", { type: "button", class: "small" }, words);
    button.addEventListener("click", save);
    return button;
  }

  private saveSpectra(): void {
    this.saveDrawing(this.plots, `spectra of ${this.choice.value}`, "regions");
  }

  private saveHistogram(): void {
    this.saveDrawing(this.bars, this.bandName, "histogram");
  }

  /** The layer and the band of the histogram. */
  private get bandName(): string {
    return `${this.choice.value}, ${this.band.selectedOptions[0]?.label ?? ""}`;
  }

  private saveDrawing(host: HTMLElement, what: string, name: string): void {
    const chart = host.querySelector<SVGElement>("svg");
    if (!chart) return;
    const { object, credits } = this.record;
    const curves = this.state.regions.value.map(({ name }, i) => ({ colour: pinColour(i), name }));
    const title = `${object.title}, ${what}`;
    saveChart(`${object.name}_${name}.svg`, chart, { title, curves, lines: [title, ...credits] });
  }

  /** Save the bars of the histogram: the values between which each lies, and its pixels. */
  private saveCounts(): void {
    const rows = this.shown.flatMap(({ name, counts, low, high }) => {
      const width = (high - low) / counts.length;
      const edge = (i: number): string => shortest(Math.fround(low + i * width));
      const first = [name, this.choice.value, this.band.selectedOptions[0]?.label ?? ""];
      return counts.map((n, i) => [...first.map(quoted), edge(i), edge(i + 1), n].join());
    });
    const text = ["region,layer,band,from,to,pixels", ...rows, ""].join("\n");
    saveFile(`${this.record.object.name}_histogram.csv`, text, "text/csv");
  }

  private async saveAll(): Promise<void> {
    const lines: string[] = ["region,layer,band,wavelength_nm,mean,std,n,pixels,u,U"];
    for (const region of this.state.regions.value)
      for (const layer of this.spectra.keys()) {
        const found = await this.statistics(layer, region);
        const { means, spreads, counts, pixels } = found;
        const sure = uncertainMean(layer, found);
        layer.bands.forEach(({ label, wavelength, centroid }, i) => {
          const names = [region.name, layer.name, label].map(quoted);
          const numbers = [means[i]!, spreads[i]!].map((value) => shortest(Math.fround(value)));
          const count = [counts[i], pixels, ...cellsOfU(sure, i)];
          lines.push([...names, wavelength ?? centroid ?? "", ...numbers, ...count].join());
        });
      }
    const text = [...lines, ""].join("\n");
    saveFile(`${this.record.object.name}_regions.csv`, text, "text/csv");
  }
}

/** Means of a region with their errors; null where these are not recorded. */
const uncertainMean = (layer: Layer, found: Statistics): Uncertain | null =>
  uncertain(layer, { ...found, values: found.means });

const quantityOf = ({ quantity }: Layer): string =>
  quantity === "reflectance" ? "Reflectance" : "Counts";
