// The pixel under the cursor: every camera's spectrum with sigma, and where each camera recorded it.
import { make, saveFile } from "../shared/element";
import type { Point } from "../shared/pane";
import { curveSwatch } from "../shared/plot";
import { describeDoubts, drawChart } from "./chart";
import { Lattice } from "./lattice";
import { describeChannels, numbersTable, toCsv, type Reading } from "./numbers";
import type { Layer, PageRecord } from "./record";
import type { LayerSpectra, Spectra } from "./spectra";
import { colourOf } from "./state";
import { COVERAGE } from "./uncertainty";

const NO_CURVE =
  "No curve: no band here has both a wavelength and a value. The values are listed below.";

interface Source {
  layer: Layer;
  colour: string;
  spectra: Spectra | null;
  lattice: Lattice | null;
}

/** The panel "Spectrum"; `show` is called for every pixel the cursor comes to. */
export class Readout {
  private readonly sources: Source[];
  private readonly place = make("p", { class: "place", role: "status" });
  private readonly drawing = make("div", { class: "drawing" });
  private readonly key = make("ul", { class: "key" });
  private readonly table = make("table", { class: "numbers" });
  private readonly note = make("p", { class: "note-line soft" });
  private readonly save = make("button", { type: "button", class: "small" }, "Save as CSV");
  private readonly hidden = new Set<Layer>();
  private turn = 0;
  private pixel: Point | null = null;
  private readings: Reading[] = [];

  constructor(
    host: HTMLElement,
    private readonly record: PageRecord,
    spectra: LayerSpectra,
    private readonly hint: string,
  ) {
    this.sources = record.layers
      .filter((layer) => layer.bands.length)
      .map((layer, i) => ({
        layer,
        colour: colourOf(i),
        spectra: spectra.get(layer) ?? null,
        lattice: layer.lattice && new Lattice(layer, layer.lattice),
      }));
    const label = "Numbers of the spectra";
    const scroll = { class: "scroll", tabindex: 0, role: "region", "aria-label": label };
    const numbers = make(
      "details",
      { class: "fold numbers-fold" },
      make("summary", {}, "Numbers"),
      make("div", scroll, this.table),
      this.note,
    );
    host.append(this.place, this.drawing, this.key, numbers, this.save);
    this.save.addEventListener("click", () => this.saveTable());
    this.clear();
  }

  /** Read a pixel and show it; an older reading that ends later is dropped. */
  async show(place: Point, pinned: boolean): Promise<void> {
    const turn = ++this.turn;
    const pixel: Point = [Math.round(place[0]), Math.round(place[1])];
    const readings = await Promise.all(this.sources.map((one) => read(one, place, pixel)));
    if (turn !== this.turn) return;
    this.render(pixel, readings);
    this.place.textContent = `Grid ${pixel.join(", ")}${this.millimetres(pixel)}${pinned ? " · pinned" : ""}`;
    this.place.dataset["pixel"] = pixel.join();
  }

  clear(): void {
    this.turn++;
    const nothing = { spectrum: null, native: null, failure: "" };
    this.render(
      null,
      this.sources.map(({ layer, colour }) => ({ layer, colour, ...nothing })),
    );
    this.place.textContent = this.hint;
    delete this.place.dataset["pixel"];
  }

  private render(pixel: Point | null, readings: Reading[]): void {
    [this.pixel, this.readings] = [pixel, readings];
    const curves = readings.flatMap(({ layer, colour, spectrum }) =>
      spectrum && !this.hidden.has(layer) ? { layer, colour, spectrum } : [],
    );
    const reflectance = curves.filter(({ layer }) => layer.quantity === "reflectance");
    const quantity = reflectance.length ? "Reflectance" : "Counts";
    const drawn = reflectance.length ? reflectance : curves;
    const chart = drawChart(drawn, quantity, this.record.flags);
    const empty = pixel && curves.length ? NO_CURVE : "";
    this.drawing.replaceChildren(chart ?? make("div", { class: "chart blank" }, empty));
    this.key.replaceChildren(...readings.map((reading) => this.keyOf(reading)));
    this.table.replaceChildren(...numbersTable(readings, this.record.flags));
    this.note.textContent = explainU(readings);
    this.save.disabled = !pixel;
  }

  private keyOf({ layer, colour, native, spectrum, failure }: Reading): HTMLElement {
    const shown = String(!this.hidden.has(layer));
    const curve = { type: "button", class: "curve", "aria-pressed": shown };
    const button = make("button", curve, curveSwatch(colour), layer.name);
    button.addEventListener("click", () => {
      if (!this.hidden.delete(layer)) this.hidden.add(layer);
      this.render(this.pixel, this.readings);
      const at = this.readings.findIndex((reading) => reading.layer === layer);
      this.key.querySelectorAll("button")[at]?.focus();
    });
    const missing = failure || (spectrum && layer.lattice ? "not covered" : "");
    const band = layer.bands[layer.reference_band]?.label ?? "";
    const place = make(
      "span",
      { class: "native", title: native && `Native pixel of ${layer.name}:${band}` },
      native?.map((value) => value.toFixed(2)).join(", ") ?? missing,
    );
    if (native)
      Object.assign(place.dataset, {
        layer: layer.name,
        x: String(native[0]),
        y: String(native[1]),
      });
    const channels = spectrum && describeChannels(layer, spectrum);
    const doubts = spectrum && native && describeDoubts(layer, spectrum, this.record.flags);
    return make(
      "li",
      {},
      button,
      place,
      channels && make("span", { class: "channels" }, channels),
      doubts && make("span", { class: "doubts" }, doubts),
    );
  }

  private millimetres([x, y]: Point): string {
    const scale = this.record.grid.px_per_mm;
    return scale
      ? ` · ${((x + 0.5) / scale).toFixed(1)}, ${((y + 0.5) / scale).toFixed(1)} mm`
      : "";
  }

  private saveTable(): void {
    if (!this.pixel) return;
    const name = `${this.record.object.name}_${this.pixel.join("_")}.csv`;
    saveFile(name, toCsv(this.pixel, this.readings), "text/csv");
  }
}

/** What U has and has not, of the cameras whose errors are recorded. */
function explainU(readings: Reading[]): string {
  const known = readings.filter(({ layer, spectrum }) => spectrum && layer.budget);
  if (!known.length) return "";
  const missing = known.flatMap(({ layer: { name, budget } }) =>
    budget!.unknown.length ? `${budget!.unknown.join(", ")} (${name})` : [],
  );
  const not = missing.length ? ` Not contained: ${missing.join("; ")}.` : "";
  return `Sigma is the noise of the pixel alone, U with k\u00a0=\u00a0${COVERAGE} also has what all pixels share.${not}`;
}

async function read(
  { layer, colour, spectra, lattice }: Source,
  place: Point,
  pixel: Point,
): Promise<Reading> {
  const reading: Reading = { layer, colour, spectrum: null, native: null, failure: "" };
  try {
    reading.spectrum = spectra ? await spectra.read(...pixel) : null;
    reading.native = lattice ? await lattice.find(place, layer.reference_band) : null;
  } catch (error) {
    reading.failure = error instanceof Error ? error.message : String(error);
  }
  return reading;
}
