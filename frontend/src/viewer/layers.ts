// The list of layers, and which picture of which layer stands in A and in B.
import { make } from "../element";
import { bandsOf, isMix, mix, mixKey, proposeMix } from "./mixing";
import type { Layer, Legend, PageRecord, Picture } from "./record";
import type { Slot } from "./stage";

export interface Choice {
  layer: Layer;
  picture: Picture;
}

type OnChoice = (slot: Slot, choice: Choice) => void;

/** The panel "Layers". Rows choose the layer of A, their small buttons that of B. */
export class LayerList {
  readonly chosen: { a: Choice | null; b: Choice | null } = { a: null, b: null };
  private readonly rows = new Map<string, { row: HTMLElement; a: HTMLButtonElement; b: HTMLButtonElement }>();
  private readonly pickers: { a: Picker; b: Picker };
  readonly layers: Layer[];
  /** Told when a person put a layer into B. */
  onCompare: () => void = () => {};

  constructor(host: HTMLElement, record: PageRecord, private readonly onChoice: OnChoice) {
    this.layers = record.layers.filter((layer) => layer.pictures.length);
    const list = make("ol", { class: "layers" });
    record.layers.forEach((layer) => list.append(this.rowOf(layer)));
    this.pickers = { a: new Picker("a", (picture) => this.pick("a", picture)), b: new Picker("b", (picture) => this.pick("b", picture)) };
    host.append(list, this.pickers.a.element, this.pickers.b.element);
  }

  /** Put a layer into a slot, with the kind of picture that was shown there before, where it has it. */
  choose(slot: Slot, layer: Layer | undefined, key?: string): void {
    if (!layer) return;
    const before = this.chosen[slot]?.picture;
    const picture =
      (key ? pictureOf(layer, key) : undefined) ??
      (before && before.kind === "mix" ? pictureOf(layer, proposeMix(layer) ?? "") : undefined) ??
      (before && before.kind === "band" ? nearestBand(layer, this.chosen[slot]!, before) : undefined) ??
      layer.pictures.find((p) => p.key === before?.key) ??
      layer.pictures[0];
    if (picture) this.set(slot, { layer, picture });
  }

  swap(): void {
    const { a, b } = this.chosen;
    if (!a || !b) return;
    this.set("a", b);
    this.set("b", a);
  }

  private pick(slot: Slot, picture: Picture): void {
    const layer = this.chosen[slot]?.layer;
    if (layer) this.set(slot, { layer, picture });
  }

  private set(slot: Slot, choice: Choice): void {
    this.chosen[slot] = choice;
    for (const [id, { row, a, b }] of this.rows) {
      const [isA, isB] = [this.chosen.a?.layer.id === id, this.chosen.b?.layer.id === id];
      row.classList.toggle("is-a", isA);
      row.classList.toggle("is-b", isB);
      a.setAttribute("aria-pressed", String(isA));
      b.setAttribute("aria-pressed", String(isB));
    }
    this.pickers[slot].show(choice);
    this.onChoice(slot, choice);
  }

  private rowOf(layer: Layer): HTMLElement {
    const number = this.layers.indexOf(layer) + 1;
    const shown = layer.pictures.length > 0;
    const picture = layer.thumbnail ? make("img", { src: layer.thumbnail.split("/").map(encodeURIComponent).join("/"), alt: "", width: 44, height: 44, loading: "lazy" }) : make("span", { class: "empty" });
    const title = make("span", { class: "first" }, make("span", { class: "layer-name", title: layer.name }, layer.name), make("span", { class: `badge ${layer.decision}` }, layer.verdict));
    const words = make("span", { class: "words" }, title, make("span", { class: "soft" }, describe(layer)));
    const a = make("button", { type: "button", class: "layer", "aria-pressed": "false", disabled: !shown, "aria-label": `Show ${layer.name}, ${describe(layer)}, ${layer.verdict}` }, picture, words, number > 0 && number < 10 ? make("kbd", { "aria-hidden": "true" }, String(number)) : null);
    const b = make("button", { type: "button", class: "second", "aria-pressed": "false", disabled: !shown, "aria-label": `Compare with ${layer.name}`, title: "Compare: put into B" }, "B");
    a.addEventListener("click", () => this.choose("a", layer));
    b.addEventListener("click", () => {
      this.choose("b", layer);
      this.onCompare();
    });
    const row = make("li", { class: "row" }, a, b);
    if (layer.decision === "refuse" || layer.decision === "warn") {
      const reasons = [...layer.reasons, layer.next_step].filter(Boolean).join(" ");
      if (reasons) row.append(make("p", { class: "reasons" }, reasons));
    }
    if (shown) this.rows.set(layer.id, { row, a, b });
    return row;
  }
}

/** Chooses among the pictures of the layer in one slot: a list, and a slider over single bands. */
class Picker {
  readonly element: HTMLElement;
  private readonly select = make("select", {});
  private readonly slider = make("input", { type: "range", min: 0, step: 1 });
  private readonly note = make("p", { class: "note soft" });
  private readonly legend = make("div", { class: "legend" });
  private readonly bandLine = make("div", { class: "band-line" });
  private readonly mixLine = make("div", { class: "band-line mix" });
  private readonly inks: HTMLSelectElement[];
  private layer: Layer | null = null;

  constructor(slot: Slot, private readonly onPick: (picture: Picture) => void) {
    const name = slot.toUpperCase();
    this.select.setAttribute("aria-label", `Picture in ${name}`);
    this.slider.setAttribute("aria-label", `Band in ${name}`);
    this.bandLine.append(this.slider);
    this.inks = ["red", "green", "blue"].map((ink) => make("select", { class: ink, "aria-label": `Band shown as ${ink} in ${name}` }));
    this.mixLine.append(...this.inks);
    for (const ink of this.inks) ink.addEventListener("change", () => this.pickKey(mixKey(this.inks.map((one) => Number(one.value)))));
    this.element = make("div", { class: `picker picker-${slot}`, hidden: true }, make("div", { class: "picker-line" }, make("span", { class: `slot slot-${slot}`, "aria-hidden": "true" }, name), this.select), this.bandLine, this.mixLine, this.note, this.legend);
    this.select.addEventListener("change", () => this.pickKey(this.select.value === MIX ? ((this.layer && proposeMix(this.layer)) ?? "") : this.select.value));
    this.slider.addEventListener("input", () => {
      const picture = this.bands[Number(this.slider.value)];
      if (picture) this.onPick(picture);
    });
  }

  private pickKey(key: string): void {
    const picture = this.layer && pictureOf(this.layer, key);
    if (picture) this.onPick(picture);
  }

  show({ layer, picture }: Choice): void {
    if (this.layer !== layer) {
      this.layer = layer;
      for (const ink of this.inks) ink.replaceChildren(...bandsOf(layer).map(({ number, picture: band }) => make("option", { value: number }, band.label)));
      this.select.replaceChildren(...groupsOf(layer));
      this.slider.max = String(Math.max(0, this.bands.length - 1));
    }
    this.element.hidden = false;
    this.select.value = isMix(picture.key) ? MIX : picture.key;
    this.mixLine.hidden = picture.kind !== "mix";
    if (picture.kind === "mix") picture.key.split("-").slice(1).forEach((number, i) => (this.inks[i]!.value = number));
    this.bandLine.hidden = picture.kind !== "band" || this.bands.length < 2;
    if (picture.kind === "band") this.slider.value = String(this.bands.indexOf(picture));
    this.slider.setAttribute("aria-valuetext", picture.label);
    this.note.textContent = picture.note;
    this.legend.replaceChildren(...(picture.legend ? drawLegend(picture.legend) : []));
  }

  private get bands(): Picture[] {
    return this.layer?.pictures.filter((p) => p.kind === "band") ?? [];
  }
}

const MIX = "mix";

/** A picture of a layer by its key, or a mixture of three of its bands. */
function pictureOf(layer: Layer, key: string): Picture | undefined {
  return isMix(key) ? mix(layer, key) : layer.pictures.find((p) => p.key === key);
}

const GROUPS: [Picture["kind"], string][] = [["colour", "As seen"], ["light", "Under another light"], ["map", "How far to trust it"], ["band", "Single bands"]];

function groupsOf(layer: Layer): HTMLElement[] {
  return GROUPS.map(([kind, label]) => {
    const options = layer.pictures.filter((p) => p.kind === kind).map((p) => make("option", { value: p.key }, p.label));
    if (kind === "colour" && proposeMix(layer)) options.push(make("option", { value: MIX }, "False colour of three bands…"));
    return options.length ? make("optgroup", { label }, ...options) : null;
  }).filter((group) => group !== null);
}

function drawLegend(legend: Legend): HTMLElement[] {
  if (legend.least || legend.most) {
    const bar = make("span", { class: "scale", "aria-hidden": "true" });
    bar.style.background = `linear-gradient(to right, ${legend.entries.map((e) => e.colour).join(", ")})`;
    return [make("span", {}, legend.least), bar, make("span", {}, legend.most)];
  }
  return legend.entries.map(({ name, colour }) => {
    const swatch = make("span", { class: "swatch", "aria-hidden": "true" });
    swatch.style.background = colour;
    return make("span", { class: "entry" }, swatch, name);
  });
}

function describe(layer: Layer): string {
  const known = layer.bands.map((band) => band.wavelength).filter((w) => w !== null);
  const count = `${layer.bands.length} band${layer.bands.length === 1 ? "" : "s"}`;
  if (!layer.bands.length) return "not registered";
  return known.length ? `${count}, ${Math.round(Math.min(...known))}–${Math.round(Math.max(...known))} nm` : count;
}

function nearestBand(layer: Layer, before: Choice, picture: Picture): Picture | undefined {
  const place = (owner: Layer, key: string): number | null => {
    const band = owner.bands[Number(key.replace("band-", ""))];
    return band ? (band.wavelength ?? band.centroid) : null;
  };
  const wanted = place(before.layer, picture.key);
  const bands = layer.pictures.filter((p) => p.kind === "band");
  if (wanted === null) return bands[0];
  const apart = (p: Picture): number => Math.abs((place(layer, p.key) ?? Infinity) - wanted);
  return bands.reduce<Picture | undefined>((best, p) => (best && apart(best) <= apart(p) ? best : p), undefined);
}
