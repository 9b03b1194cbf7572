// What the pixel under the cursor says: every camera's spectrum with sigma, and where each recorded it.
import { make } from "../element";
import { drawChart, type Curve } from "./chart";
import { Lattice } from "./lattice";
import type { Layer, Mark, PageRecord } from "./record";
import { Spectra, type Spectrum } from "./spectra";
import type { Pixel } from "./stage";

/** A bit that the page's record does not name. */
const UNKNOWN = { word: "unknown flag, not to be trusted", colour: "#000000", trusted: false };
export const COLOURS = ["--curve-1", "--curve-2", "--curve-3", "--curve-4", "--curve-5", "--curve-6", "--curve-7", "--curve-8"];

interface Told {
  layer: Layer;
  colour: string;
  spectrum: Spectrum | null;
  native: Pixel | null;
  why: string;
}

/** The panel "Spectrum"; `show` is called for every pixel the cursor comes to. */
export class Readout {
  private readonly sources: { layer: Layer; colour: string; spectra: Spectra | null; lattice: Lattice | null }[];
  private readonly place = make("p", { class: "place", role: "status" });
  private readonly drawing = make("div", { class: "drawing" });
  private readonly key = make("ul", { class: "key" });
  private readonly table = make("table", { class: "numbers" });
  private readonly save = make("button", { type: "button", class: "small", disabled: true }, "Save as CSV");
  private readonly hidden = new Set<string>();
  private wanted = 0;
  private last: { pixel: Pixel; told: Told[] } | null = null;

  constructor(host: HTMLElement, private readonly record: PageRecord, private readonly hint: string) {
    this.sources = record.layers
      .filter((layer) => layer.bands.length)
      .map((layer, i) => ({
        layer,
        colour: `var(${COLOURS[i % COLOURS.length]})`,
        spectra: layer.spectra && new Spectra(layer, layer.spectra),
        lattice: layer.lattice && new Lattice(layer, layer.lattice),
      }));
    const numbers = make("details", { class: "fold numbers-fold" }, make("summary", {}, "Numbers"), make("div", { class: "scroll", tabindex: 0, role: "region", "aria-label": "Numbers of the spectra" }, this.table));
    host.append(this.place, this.drawing, this.key, numbers, this.save);
    this.save.addEventListener("click", () => this.saveTable());
    this.clear();
  }

  /** Read a pixel and show it; an older reading that ends later is dropped. */
  async show(place: Pixel, pinned: boolean): Promise<void> {
    const turn = ++this.wanted;
    const pixel = { x: Math.round(place.x), y: Math.round(place.y) };
    const told = await Promise.all(this.sources.map((source) => this.read(source, place, pixel)));
    if (turn !== this.wanted) return;
    this.last = { pixel, told };
    this.place.textContent = `Grid ${pixel.x}, ${pixel.y}${this.millimetres(pixel)}${pinned ? " · pinned" : ""}`;
    this.place.dataset["pixel"] = `${pixel.x},${pixel.y}`;
    this.render(told);
    this.save.disabled = false;
  }

  clear(): void {
    this.wanted++;
    this.last = null;
    this.place.textContent = this.hint;
    delete this.place.dataset["pixel"];
    this.render(this.sources.map(({ layer, colour }) => ({ layer, colour, spectrum: null, native: null, why: "" })));
    this.save.disabled = true;
  }

  private async read(source: Readout["sources"][number], place: Pixel, pixel: Pixel): Promise<Told> {
    const { layer, colour, spectra, lattice } = source;
    const told: Told = { layer, colour, spectrum: null, native: null, why: "" };
    try {
      told.spectrum = spectra ? await spectra.read(pixel.x, pixel.y) : null;
      told.native = lattice ? await lattice.find(place, referenceBand(layer)) : null;
    } catch (error) {
      told.why = error instanceof Error ? error.message : String(error);
    }
    return told;
  }

  private render(told: Told[]): void {
    const curves: Curve[] = told.flatMap(({ layer, spectrum, colour }) => (spectrum && !this.hidden.has(layer.id) ? [{ layer, spectrum, colour }] : []));
    const reflectance = curves.filter((c) => c.layer.quantity === "reflectance");
    const chart = drawChart(reflectance.length ? reflectance : curves, reflectance.length ? "Reflectance" : "Counts");
    this.drawing.replaceChildren(chart ?? make("div", { class: "chart blank" }));
    this.key.replaceChildren(...told.map((one) => this.keyOf(one)));
    this.table.replaceChildren(...rowsOf(told, this.record.flags));
  }

  private keyOf({ layer, colour, native, spectrum, why }: Told): HTMLElement {
    const swatch = make("span", { class: "swatch", "aria-hidden": "true" });
    swatch.style.background = colour;
    const button = make("button", { type: "button", class: "curve", "aria-pressed": this.hidden.has(layer.id) ? "false" : "true" }, swatch, layer.name);
    button.addEventListener("click", () => {
      if (!this.hidden.delete(layer.id)) this.hidden.add(layer.id);
      const again = this.last?.told ?? this.sources.map((s) => ({ layer: s.layer, colour: s.colour, spectrum: null, native: null, why: "" }));
      this.render(again);
      this.key.querySelectorAll("button")[again.findIndex((t) => t.layer === layer)]?.focus();
    });
    const where = native ? `${native.x.toFixed(2)}, ${native.y.toFixed(2)}` : why || (spectrum && layer.lattice ? "not seen" : "");
    const text = make("span", { class: "native", title: native ? `Native pixel of ${layer.name}:${layer.bands[referenceBand(layer)]?.label ?? ""}` : null }, where);
    if (native) Object.assign(text.dataset, { layer: layer.name, x: String(native.x), y: String(native.y) });
    return make("li", {}, button, text, spectrum && placeless(layer) ? make("span", { class: "channels" }, listChannels(layer, spectrum)) : null);
  }

  private millimetres(pixel: Pixel): string {
    const scale = this.record.grid.px_per_mm;
    return scale ? ` · ${((pixel.x + 0.5) / scale).toFixed(1)}, ${((pixel.y + 0.5) / scale).toFixed(1)} mm` : "";
  }

  private saveTable(): void {
    if (!this.last) return;
    const { pixel, told } = this.last;
    const lines = ["x,y,layer,band,wavelength_nm,value,sigma,flags"];
    for (const { layer, spectrum } of told)
      layer.bands.forEach((band, i) => {
        if (!spectrum) return;
        const cells = [pixel.x, pixel.y, quoted(layer.name), quoted(band.label), band.wavelength ?? band.centroid ?? "", shortest(spectrum.values[i]!), spectrum.sigma ? shortest(spectrum.sigma[i]!) : "", spectrum.flags?.[i] ?? ""];
        lines.push(cells.join(","));
      });
    const link = make("a", { download: `${this.record.object.name}_${pixel.x}_${pixel.y}.csv` });
    link.href = URL.createObjectURL(new Blob([lines.join("\n") + "\n"], { type: "text/csv" }));
    link.click();
    setTimeout(() => URL.revokeObjectURL(link.href), 10_000);
  }
}

/** Whether a layer has channels only whose wavelengths nobody knows: they have no place in a drawing. */
function placeless(layer: Layer): boolean {
  return layer.bands.every((band) => band.wavelength === null && band.centroid === null);
}

function listChannels(layer: Layer, spectrum: Spectrum): string {
  const sigma = (i: number): string => (spectrum.sigma && Number.isFinite(spectrum.sigma[i]!) ? ` ± ${spectrum.sigma[i]!.toFixed(3)}` : "");
  return layer.bands.map((band, i) => `${band.label} ${Number.isFinite(spectrum.values[i]!) ? spectrum.values[i]!.toFixed(3) : "–"}${sigma(i)}`).join(" · ");
}

/** The band whose native pixel is told: the camera's reference channel. */
export function referenceBand(layer: Layer): number {
  return layer.reference_band;
}

/** The shortest decimal number that is this float32. */
export function shortest(value: number): string {
  if (!Number.isFinite(value)) return "nan";
  for (let digits = 6; digits < 10; digits++) {
    const text = value.toPrecision(digits);
    if (Math.fround(Number(text)) === value) return String(Number(text));
  }
  return String(value);
}

/** The marks of the bits that are set; a bit without a mark is not to be trusted. */
function marksOf(bits: number, table: Mark[]): Omit<Mark, "bit">[] {
  const known = table.reduce((sum, mark) => sum | mark.bit, 0);
  return [...table.filter((mark) => bits & mark.bit), ...(bits & ~known ? [UNKNOWN] : [])];
}

function rowsOf(told: Told[], table: Mark[]): HTMLElement[] {
  const head = make("thead", {}, make("tr", {}, ...["Band", "Value", "Sigma", "Flags"].map((text) => make("th", { scope: "col" }, text))));
  const bodies = told.filter((one) => one.spectrum).map(({ layer, spectrum }) => {
    const rows = layer.bands.map((band, i) => {
      const value = spectrum!.values[i]!;
      const sigma = spectrum!.sigma?.[i];
      const bits = spectrum!.flags?.[i] ?? 0;
      const cell = make("td", { class: "n" }, Number.isFinite(value) ? value.toFixed(4) : "–");
      cell.dataset["value"] = shortest(value);
      const spread = make("td", { class: "n" }, sigma !== undefined && Number.isFinite(sigma) ? sigma.toFixed(4) : "–");
      if (sigma !== undefined) spread.dataset["sigma"] = shortest(sigma);
      const marks = marksOf(bits, table);
      const flags = make("td", {}, ...marks.flatMap((mark, k) => {
        const swatch = make("span", { class: "swatch", "aria-hidden": "true" });
        swatch.style.background = mark.colour;
        return [k ? ", " : "", swatch, " ", mark.word];
      }));
      const row = make("tr", {}, make("th", { scope: "row" }, band.label), cell, spread, flags);
      if (marks.some((mark) => !mark.trusted)) row.classList.add("untrusted");
      return row;
    });
    const body = make("tbody", {}, make("tr", { class: "group" }, make("th", { colspan: 4, scope: "rowgroup" }, `${layer.name} · ${layer.quantity}`)), ...rows);
    body.dataset["layer"] = layer.name;
    return body;
  });
  return [head, ...bodies];
}

function quoted(text: string): string {
  // A cell that begins like a formula would be one in a spreadsheet.
  const tame = /^[=+\-@\t\r]/.test(text) ? `'${text}` : text;
  return `"${tame.replaceAll('"', '""')}"`;
}
