// Spectra as numbers: a table of bands, and text that a spreadsheet reads.
import { make, swatch } from "../shared/element";
import type { Point } from "../shared/pane";
import { marksOf, type Layer, type Mark, type Spectrum } from "./record";
import { COVERAGE, meanOfPixel, uncertain } from "./uncertainty";

/** What one layer has of a pixel. */
export interface Reading {
  layer: Layer;
  colour: string;
  spectrum: Spectrum | null;
  native: Point | null;
  failure: string;
}

/** The shortest decimal number that is this float32; ``nan`` where it is not finite. */
export function shortest(value: number): string {
  if (!Number.isFinite(value)) return "nan";
  for (let digits = 6; digits < 10; digits++) {
    const number = Number(value.toPrecision(digits));
    if (Math.fround(number) === value) return String(number);
  }
  return String(value);
}

/** A value with its expanded uncertainty to two digits, "0.495 ± 0.013"; the value alone where that is not known. */
export function plusMinus(value: number, u: number | undefined): string {
  if (!Number.isFinite(value)) return "–";
  const expanded = COVERAGE * (u ?? NaN);
  if (!(expanded > 0 && expanded < Infinity)) return value.toPrecision(4);
  const digits = Math.min(9, Math.max(0, 1 - Math.floor(Math.log10(expanded))));
  // Never broken over lines.
  return `${value.toFixed(digits).replace("-", "−")}\u00a0±\u00a0${expanded.toFixed(digits)}`;
}

/** What stands behind "±" for a layer, in a sentence. */
export function describeU({ budget }: Layer): string {
  if (!budget) return "The uncertainty U of these values is not recorded.";
  const missing = budget.unknown.length ? `; not contained: ${budget.unknown.join(", ")}` : "";
  return `± is the uncertainty U with k\u00a0=\u00a0${COVERAGE} (about 95\u00a0%)${missing}.`;
}

/** A pixel's own noise and what its layer's pixels share; null where the latter is not recorded. */
export function uncertainPixel(layer: Layer, spectrum: Spectrum): number[] | null {
  return uncertain(layer, meanOfPixel(spectrum));
}

/** Two cells: standard and expanded uncertainty of a band; empty where they are not known. */
export function cellsOfU(one: number[] | null, band: number): [u: string, expanded: string] {
  const u = one?.[band] ?? NaN;
  if (!Number.isFinite(u)) return ["", ""];
  return [shortest(Math.fround(u)), shortest(Math.fround(COVERAGE * u))];
}

/** The channels of a layer in a line, where no wavelength is known: they have no place in a chart. */
export function describeChannels(layer: Layer, spectrum: Spectrum): string | null {
  const { bands } = layer;
  if (bands.some(({ wavelength, centroid }) => wavelength !== null || centroid !== null))
    return null;
  const sure = uncertainPixel(layer, spectrum);
  const value = (i: number): string =>
    sure ? plusMinus(spectrum.values[i]!, sure[i]) : fixed(spectrum.values[i], 3);
  return bands.map(({ label }, i) => `${label} ${value(i)}`).join(" · ");
}

/** Rows of the table of numbers: a body for every layer that has a spectrum. */
export function numbersTable(readings: Reading[], marks: Mark[]): HTMLElement[] {
  const heads = ["Band", "Value", "Sigma", `U, k\u00a0=\u00a0${COVERAGE}`, "Flags"];
  const head = heads.map((text) => make("th", { scope: "col" }, text));
  const bodies = readings.flatMap(({ layer, spectrum }) => {
    if (!spectrum) return [];
    const group = make(
      "th",
      { colspan: heads.length, scope: "rowgroup" },
      `${layer.name} · ${layer.quantity}`,
    );
    const sure = uncertainPixel(layer, spectrum);
    const rows = layer.bands.map((band, i) => rowOf(band.label, { spectrum, sure, i, marks }));
    const body = make("tbody", {}, make("tr", { class: "group" }, group), ...rows);
    body.dataset["layer"] = layer.name;
    return body;
  });
  return [make("thead", {}, make("tr", {}, ...head)), ...bodies];
}

interface Cell {
  spectrum: Spectrum;
  sure: number[] | null;
  i: number;
  marks: Mark[];
}

function rowOf(label: string, { spectrum, sure, i, marks: table }: Cell): HTMLElement {
  const { values, sigma, flags } = spectrum;
  const value = make("td", { class: "n" }, fixed(values[i], 4));
  value.dataset["value"] = shortest(values[i]!);
  const spread = make("td", { class: "n" }, fixed(sigma?.[i], 4));
  if (sigma) spread.dataset["sigma"] = shortest(sigma[i]!);
  const expanded = sure ? COVERAGE * sure[i]! : undefined;
  const doubt = make("td", { class: "n" }, fixed(expanded, 4));
  if (expanded) doubt.dataset["expanded"] = String(expanded);
  const marks = marksOf(flags?.[i] ?? 0, table);
  const words = marks.flatMap(({ colour, word }, k) => [k ? ", " : "", swatch(colour), " ", word]);
  const row = make(
    "tr",
    {},
    make("th", { scope: "row" }, label),
    value,
    spread,
    doubt,
    make("td", {}, ...words),
  );
  row.classList.toggle(
    "untrusted",
    marks.some((mark) => !mark.trusted),
  );
  return row;
}

function fixed(value: number | undefined, digits: number): string {
  return value !== undefined && Number.isFinite(value) ? value.toFixed(digits) : "–";
}

export const CSV_HEAD = "x,y,layer,band,wavelength_nm,value,sigma,flags,u,U";

/** The spectra of a pixel as lines of comma-separated values, a band a line. */
export function csvRows([x, y]: Point, readings: Pick<Reading, "layer" | "spectrum">[]): string[] {
  return readings.flatMap(({ layer, spectrum }) => {
    if (!spectrum) return [];
    const { values, sigma, flags } = spectrum;
    const sure = uncertainPixel(layer, spectrum);
    return layer.bands.map((band, i) => {
      const [name, label] = [quoted(layer.name), quoted(band.label)];
      const spread = sigma ? shortest(sigma[i]!) : "";
      const nm = band.wavelength ?? band.centroid ?? "";
      const numbers = [shortest(values[i]!), spread, flags?.[i] ?? "", ...cellsOfU(sure, i)];
      return [x, y, name, label, nm, ...numbers].join();
    });
  });
}

/** The spectra of a pixel as a table of comma-separated values. */
export function toCsv(pixel: Point, readings: Pick<Reading, "layer" | "spectrum">[]): string {
  return [CSV_HEAD, ...csvRows(pixel, readings), ""].join("\n");
}

/** A cell in quotation marks; one that begins like a formula would be one in a spreadsheet. */
export function quoted(text: string): string {
  const tame = /^[=+\-@\t\r]/.test(text) ? `'${text}` : text;
  return `"${tame.replaceAll('"', '""')}"`;
}
