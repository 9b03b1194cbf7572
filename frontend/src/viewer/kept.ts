// What is kept of the painting: places and rectangles with their spectra over one another, and lengths.
import { effect } from "@preact/signals-core";
import { make, saveFile } from "../shared/element";
import type { Point } from "../shared/pane";
import { numbersOf, type Address } from "./address";
import { drawChart, type Curve } from "./chart";
import type { Drawing } from "./drawing";
import { cellsOfU, describeU, plusMinus, quoted, shortest } from "./numbers";
import type { Layer, PageRecord } from "./record";
import { around, type LayerSpectra, type Spectra } from "./spectra";
import { colourOf, type Kept, type Shape, type State } from "./state";
import { meanOfPixel, uncertain } from "./uncertainty";

const MOST = 24;
const LONGEST_NAME = 60;
const DIGITS = 4;
const COUNTS = { place: 1, rectangle: 2, length: 2 };
const WORDS = { place: "Place", rectangle: "Rectangle", length: "Length" };
const HINT = "Drag over the painting, or click twice; Esc cancels.";
const CSV_HEAD = "name,x,y,x2,y2,layer,band,wavelength_nm,value,sigma,flags,u,U,spread,n";

/** A spectrum as it is listed: of a pixel with its noise, or the mean of a rectangle. */
interface Measured {
  curve: Omit<Curve, "colour">;
  u: number[] | null;
  /** Of a rectangle: standard deviation and number of the sound pixels of each band. */
  spreads?: ArrayLike<number>;
  counts?: ArrayLike<number>;
}

/** The panel "Kept places". */
export class KeptList {
  private readonly list = make("ol", { class: "pins" });
  private readonly drawing = make("div", { class: "drawing" });
  private readonly message = make("p", { class: "note-line soft", role: "status" });
  private readonly save = button("Save as CSV");
  private readonly tools: HTMLButtonElement[];
  private turn = 0;

  constructor(
    host: HTMLElement,
    private readonly record: PageRecord,
    private readonly spectra: LayerSpectra,
    private readonly state: State,
    private readonly sketches: Drawing,
    private readonly go: (place: Point) => void,
    address: Address,
  ) {
    const keep = button("Keep this place");
    keep.addEventListener("click", () => this.keep());
    this.tools = (["rectangle", "length"] as const).map((kind) => this.tool(kind));
    const tools = make("div", { class: "pin-tools" }, keep, ...this.tools, this.save);
    host.append(tools, this.list, this.drawing, this.message);
    this.save.addEventListener("click", () => void this.saveAll());
    sketches.words = (kind, points) => this.describe(kind, points);
    effect(() => {
      const full = state.kept.value.length >= MOST;
      keep.disabled = !state.pin.value || full;
      for (const tool of this.tools) tool.disabled = full;
      this.save.disabled = !state.kept.value.length;
    });
    effect(() => {
      const outlines = state.kept.value.flatMap(({ kind, points }, i) => {
        const label = `${i + 1} ${kind === "place" ? "" : this.describe(kind, points)}`;
        return kind === "place" ? [] : [{ kind, points, colour: colourOf(i), label }];
      });
      sketches.show(outlines);
    });
    effect(() => void this.refresh(state.a.value?.layer));
    this.register(address);
  }

  /** Keep the place that is pinned. */
  keep(): void {
    const { pin } = this.state;
    if (pin.value) this.add("place", [pin.value]);
  }

  /** Let a person draw a rectangle or a length. */
  async start(kind: Shape): Promise<void> {
    if (this.state.kept.value.length >= MOST) return;
    const tool = this.tools[kind === "rectangle" ? 0 : 1]!;
    const done = this.sketches.begin(kind);
    tool.setAttribute("aria-pressed", "true");
    this.message.textContent = HINT;
    const points = await done;
    tool.setAttribute("aria-pressed", "false");
    this.message.textContent = "";
    if (points) this.add(kind, points);
  }

  private add(kind: Kept["kind"], points: Point[]): void {
    const { kept } = this.state;
    if (kept.value.length >= MOST) return;
    const names = new Set(kept.value.map(({ name }) => name));
    let number = 1;
    while (names.has(`${WORDS[kind]} ${number}`)) number++;
    const { width, height } = this.record.grid;
    const clip = (at: number, size: number): number => Math.min(Math.max(at, 0), size - 1);
    const inside = points.map(([x, y]): Point => [clip(x, width), clip(y, height)]);
    kept.value = [...kept.value, { kind, name: `${WORDS[kind]} ${number}`, points: inside }];
  }

  private tool(kind: Shape): HTMLButtonElement {
    const tool = button(WORDS[kind], { "aria-pressed": "false" });
    tool.addEventListener("click", () => {
      if (tool.getAttribute("aria-pressed") === "true") this.sketches.cancel();
      else void this.start(kind);
    });
    return tool;
  }

  private register(address: Address): void {
    const { pin, kept } = this.state;
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
    address.add({
      signals: [kept],
      write: (facts) => {
        for (const one of kept.value) facts.append("kept", toText(one));
      },
      read: (facts) => {
        const { width, height } = this.record.grid;
        kept.value = facts
          .getAll("kept")
          .slice(0, MOST)
          .flatMap((text) => fromText(text, [width, height]) ?? []);
      },
    });
  }

  /** Read the spectra of all that is kept and show them; an older reading that ends later is dropped. */
  private async refresh(shown: Layer | undefined): Promise<void> {
    const kept = this.state.kept.value;
    const turn = ++this.turn;
    const [layer, spectra] = [...this.spectra].find(([one]) => one === shown) ?? [];
    if (kept.some(({ kind }) => kind === "rectangle")) this.message.textContent = "Measuring …";
    const readings = kept.map(async (one) =>
      layer && spectra ? measure(layer, spectra, one).catch(() => null) : null,
    );
    const found = await Promise.all(readings);
    if (turn !== this.turn) return;
    this.fill(kept, found);
    const curves = found.flatMap((one, i) =>
      one ? { ...one.curve, colour: colourOf(i), mark: String(i + 1) } : [],
    );
    const quantity = layer?.quantity === "reflectance" ? "Reflectance" : "Counts";
    const chart = curves.length ? drawChart(curves, quantity, this.record.flags) : null;
    this.drawing.replaceChildren(...(chart ? [chart] : []));
    this.message.textContent =
      layer && curves.length ? `Spectra of ${layer.name}. ${describeU(layer)}` : "";
  }

  private fill(kept: Kept[], found: (Measured | null)[]): void {
    // Who types a name stays where they are.
    const held = document.activeElement;
    const typing = held instanceof HTMLInputElement && this.list.contains(held);
    if (typing && this.list.childElementCount === kept.length) return;
    this.list.replaceChildren(...kept.map((one, i) => this.row(one, i, found[i] ?? null)));
  }

  private row(one: Kept, number: number, found: Measured | null): HTMLElement {
    const badge = make("span", { class: "pin-number", "aria-hidden": "true" }, String(number + 1));
    badge.style.background = colourOf(number);
    const label = `Name of ${one.kind} ${number + 1}`;
    const name = make("input", { type: "text", maxlength: LONGEST_NAME, "aria-label": label });
    name.value = one.name;
    name.addEventListener("input", () => this.change(number, { ...one, name: name.value }));
    const [x0, y0, x1, y1] = around(one.points);
    const middle: Point = one.kind === "place" ? one.points[0]! : [(x0 + x1) / 2, (y0 + y1) / 2];
    const where = button(middle.map(Math.round).join(", "), { title: "Show this place" });
    where.addEventListener("click", () => this.go(middle));
    const remove = button("×", { "aria-label": `Remove ${one.name || label}` });
    remove.addEventListener("click", () => this.change(number, null));
    const words = make("span", { class: "pin-words soft" });
    const parts = one.kind === "place" ? [] : [this.describe(one.kind, one.points)];
    if (found) {
      const { layer, spectrum } = found.curve;
      const band = layer.reference_band;
      const value = spectrum.values[band] ?? NaN;
      const [spread, n] = [found.spreads?.[band], found.counts?.[band]];
      parts.push(`${layer.bands[band]?.label ?? ""}: ${plusMinus(value, found.u?.[band])}`);
      if (n !== undefined) parts.push(`spread ${(spread ?? NaN).toPrecision(3)}`, `${n} valid px`);
      const facts = { mean: value, u: found.u?.[band] ?? "", spread: spread ?? "", n: n ?? "" };
      Object.assign(words.dataset, facts);
    }
    words.textContent = parts.join(" · ");
    return make("li", {}, badge, name, where, remove, words);
  }

  private change(number: number, one: Kept | null): void {
    const { kept } = this.state;
    kept.value = kept.value.flatMap((old, i) => (i !== number ? [old] : one ? [one] : []));
  }

  /** How long something is, or how wide and high. */
  private describe(kind: Shape, points: Point[]): string {
    const scale = this.record.grid.px_per_mm;
    const [[ax, ay], [bx, by]] = [points[0]!, points[1]!];
    if (kind === "length") return describeLength(Math.hypot(bx - ax, by - ay), scale);
    const [x0, y0, x1, y1] = around(points);
    return [x1 - x0 + 1, y1 - y0 + 1].map((px) => describeLength(px, scale)).join(" × ");
  }

  private async saveAll(): Promise<void> {
    const rows = this.state.kept.value.flatMap((one) =>
      [...this.spectra].map(async ([layer, spectra]) => {
        const found = await measure(layer, spectra, one).catch(() => null);
        return found ? csvRows(one, found) : [];
      }),
    );
    const lines = (await Promise.all(rows)).flat();
    const text = [CSV_HEAD, ...lines, ""].join("\n");
    saveFile(`${this.record.object.name}_places.csv`, text, "text/csv");
  }
}

function button(words: string, facts: Record<string, string> = {}): HTMLButtonElement {
  return make("button", { type: "button", class: "small", ...facts }, words);
}

/** The spectrum of a place, or the mean of a rectangle; null of a length. */
async function measure(layer: Layer, spectra: Spectra, one: Kept): Promise<Measured | null> {
  if (one.kind === "length") return null;
  if (one.kind === "place") {
    const [x, y] = one.points[0]!.map(Math.round) as Point;
    const spectrum = await spectra.read(x, y);
    return { curve: { layer, spectrum }, u: uncertain(layer, meanOfPixel(spectrum)) };
  }
  const found = await spectra.mean(around(one.points));
  const [u, values] = [uncertain(layer, found), Float32Array.from(found.values)];
  const spectrum = { values, sigma: u && Float32Array.from(u), flags: null };
  return { curve: { layer, spectrum }, u, spreads: found.spreads, counts: found.counts };
}

/** Lines of comma-separated values, a band a line; of a rectangle spread and number in place of sigma and flags. */
function csvRows({ name, points }: Kept, { curve, u, spreads, counts }: Measured): string[] {
  const { layer, spectrum } = curve;
  const { values, sigma, flags } = spectrum;
  const places = [...points.flat(), "", ""].slice(0, 4);
  const number = (of: ArrayLike<number> | null | undefined, i: number): string =>
    of ? shortest(Math.fround(of[i]!)) : "";
  return layer.bands.map(({ label, wavelength, centroid }, i) =>
    [
      quoted(name),
      ...places,
      quoted(layer.name),
      quoted(label),
      wavelength ?? centroid ?? "",
      shortest(values[i]!),
      spreads ? "" : number(sigma, i),
      flags?.[i] ?? "",
      ...cellsOfU(u, i),
      number(spreads, i),
      counts?.[i] ?? "",
    ].join(),
  );
}

/** What is kept as the address of a page holds it: kind;x y x y;name. */
export function toText({ kind, points, name }: Kept): string {
  const places = points.flat().map((at) => at.toFixed(kind === "place" ? 2 : 1));
  return [kind, places.join(" "), name].join(";");
}

/** Read what is kept from an address; null where it is nonsense, or lies beside the grid. */
export function fromText(text: string, [width, height]: Point): Kept | null {
  const [word, numbers = "", ...rest] = text.split(";");
  const kind = (["place", "rectangle", "length"] as const).find((one) => one === word);
  const values = numbers.split(" ").map(Number);
  const inside = values.every((at, i) => at >= 0 && at <= (i % 2 ? height : width) - 1);
  if (!kind || values.length !== 2 * COUNTS[kind] || !inside) return null;
  const points = values.flatMap<Point>((x, i) => (i % 2 ? [] : [[x, values[i + 1]!]]));
  return { kind, points, name: rest.join(";").slice(0, LONGEST_NAME) };
}

/** A length of so many pixels in mm, in m from one on; in px where the scale is not known. */
export function describeLength(px: number, pxPerMm: number | null): string {
  const digits = (value: number): string => Number(value.toPrecision(DIGITS)).toString();
  if (!pxPerMm) return `${digits(px)} px`;
  const mm = px / pxPerMm;
  return mm >= 1000 ? `${digits(mm / 1000)} m` : `${digits(mm)} mm`;
}
