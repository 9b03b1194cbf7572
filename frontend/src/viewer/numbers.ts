// Spectra as numbers: a table of bands, and text that a spreadsheet reads.
import { make, swatch } from "../shared/element";
import type { Point } from "../shared/pane";
import type { Layer, Mark } from "./record";
import type { Spectrum } from "./spectra";

/** What one layer has of a pixel. */
export interface Reading {
  layer: Layer;
  colour: string;
  spectrum: Spectrum | null;
  native: Point | null;
  failure: string;
}

/** Shown for a bit that the page's record does not name. */
const UNKNOWN = { word: "unknown flag, not reliable", colour: "#000000", trusted: false };

/** The shortest decimal number that is this float32; ``nan`` where it is not finite. */
export function shortest(value: number): string {
  if (!Number.isFinite(value)) return "nan";
  for (let digits = 6; digits < 10; digits++) {
    const number = Number(value.toPrecision(digits));
    if (Math.fround(number) === value) return String(number);
  }
  return String(value);
}

/** The marks of the bits that are set; a bit without a mark is not to be trusted. */
export function marksOf(bits: number, table: Mark[]): Omit<Mark, "bit">[] {
  const known = table.reduce((sum, mark) => sum | mark.bit, 0);
  return [...table.filter((mark) => bits & mark.bit), ...(bits & ~known ? [UNKNOWN] : [])];
}

/** The channels of a layer in a line, where no wavelength is known: they have no place in a chart. */
export function describeChannels({ bands }: Layer, { values, sigma }: Spectrum): string | null {
  if (bands.some(({ wavelength, centroid }) => wavelength !== null || centroid !== null))
    return null;
  const spread = (i: number): string =>
    sigma && Number.isFinite(sigma[i]) ? ` ± ${sigma[i]!.toFixed(3)}` : "";
  return bands.map(({ label }, i) => `${label} ${fixed(values[i], 3)}${spread(i)}`).join(" · ");
}

/** Rows of the table of numbers: a body for every layer that has a spectrum. */
export function numbersTable(readings: Reading[], marks: Mark[]): HTMLElement[] {
  const heads = ["Band", "Value", "Sigma", "Flags"];
  const head = heads.map((text) => make("th", { scope: "col" }, text));
  const bodies = readings.flatMap(({ layer, spectrum }) => {
    if (!spectrum) return [];
    const group = make(
      "th",
      { colspan: heads.length, scope: "rowgroup" },
      `${layer.name} · ${layer.quantity}`,
    );
    const rows = layer.bands.map((band, i) => rowOf(band.label, spectrum, i, marks));
    const body = make("tbody", {}, make("tr", { class: "group" }, group), ...rows);
    body.dataset["layer"] = layer.name;
    return body;
  });
  return [make("thead", {}, make("tr", {}, ...head)), ...bodies];
}

function rowOf(
  label: string,
  { values, sigma, flags }: Spectrum,
  i: number,
  table: Mark[],
): HTMLElement {
  const value = make("td", { class: "n" }, fixed(values[i], 4));
  value.dataset["value"] = shortest(values[i]!);
  const spread = make("td", { class: "n" }, fixed(sigma?.[i], 4));
  if (sigma) spread.dataset["sigma"] = shortest(sigma[i]!);
  const marks = marksOf(flags?.[i] ?? 0, table);
  const words = marks.flatMap(({ colour, word }, k) => [k ? ", " : "", swatch(colour), " ", word]);
  const row = make(
    "tr",
    {},
    make("th", { scope: "row" }, label),
    value,
    spread,
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

export const CSV_HEAD = "x,y,layer,band,wavelength_nm,value,sigma,flags";

/** The spectra of a pixel as lines of comma-separated values, a band a line. */
export function csvRows([x, y]: Point, readings: Pick<Reading, "layer" | "spectrum">[]): string[] {
  return readings.flatMap(({ layer, spectrum }) =>
    layer.bands.flatMap((band, i) => {
      if (!spectrum) return [];
      const { values, sigma, flags } = spectrum;
      const [name, label] = [quoted(layer.name), quoted(band.label)];
      const spread = sigma ? shortest(sigma[i]!) : "";
      const nm = band.wavelength ?? band.centroid ?? "";
      return [x, y, name, label, nm, shortest(values[i]!), spread, flags?.[i] ?? ""].join();
    }),
  );
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
