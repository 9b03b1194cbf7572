// Chooses among the pictures of the layer in one slot.
import { effect } from "@preact/signals-core";
import { make, swatch } from "../shared/element";
import { bandNumber, bandsOf, mixKey, mixNumbers, pictureOf, proposeMix } from "./mixing";
import type { Layer, Legend, Picture } from "./record";
import type { Choice, Slot, State } from "./state";

const MIX = "mix";
const GROUPS: [Picture["kind"], string][] = [
  ["colour", "As seen"],
  ["light", "Under another light"],
  ["map", "Reliability"],
  ["analysis", "Computed from its bands"],
  ["band", "Single bands"],
];

/** A list of pictures, a slider over single bands, and three bands as red, green and blue. */
export class Picker {
  readonly element: HTMLElement;
  private readonly select: HTMLSelectElement;
  private readonly slider: HTMLInputElement;
  private readonly inks: HTMLSelectElement[];
  private readonly note = make("p", { class: "note soft" });
  private readonly legend = make("div", { class: "legend" });
  private readonly bandLine: HTMLElement;
  private readonly mixLine: HTMLElement;
  private offered: Layer | null = null;

  constructor(
    private readonly slot: Slot,
    private readonly state: State,
  ) {
    const name = slot.toUpperCase();
    this.select = make("select", { "aria-label": `Picture in ${name}` });
    this.slider = make("input", {
      type: "range",
      min: 0,
      step: 1,
      "aria-label": `Band in ${name}`,
    });
    this.inks = ["red", "green", "blue"].map((ink) =>
      make("select", { class: ink, "aria-label": `Band shown as ${ink} in ${name}` }),
    );
    this.bandLine = make("div", { class: "band-line" }, this.slider);
    this.mixLine = make("div", { class: "band-line mix" }, ...this.inks);
    const mark = make("span", { class: `slot slot-${slot}`, "aria-hidden": "true" }, name);
    this.element = make(
      "div",
      { class: `picker picker-${slot}`, hidden: true },
      make("div", { class: "picker-line" }, mark, this.select),
      this.bandLine,
      this.mixLine,
      this.note,
      this.legend,
    );
    this.listen();
    effect(() => {
      const choice = state[slot].value;
      if (choice) this.show(choice);
    });
  }

  private listen(): void {
    for (const ink of this.inks)
      ink.addEventListener("change", () =>
        this.pick(mixKey(this.inks.map((one) => Number(one.value)))),
      );
    this.select.addEventListener("change", () => {
      const { value } = this.select;
      this.pick(value === MIX && this.offered ? (proposeMix(this.offered) ?? "") : value);
    });
    this.slider.addEventListener("input", () => {
      const band = this.offered && bandsOf(this.offered)[Number(this.slider.value)];
      if (band) this.pick(band.key);
    });
  }

  private pick(key: string): void {
    const layer = this.offered;
    const picture = layer && pictureOf(layer, key);
    if (picture) this.state[this.slot].value = { layer, picture };
  }

  private show({ layer, picture }: Choice): void {
    const bands = bandsOf(layer);
    if (this.offered !== layer) {
      this.offered = layer;
      for (const ink of this.inks)
        ink.replaceChildren(
          ...bands.map((band) => make("option", { value: bandNumber(band) }, band.label)),
        );
      this.select.replaceChildren(...groupsOf(layer));
      this.slider.max = String(Math.max(0, bands.length - 1));
    }
    const mixed = mixNumbers(picture.key);
    const at = bands.indexOf(picture);
    this.element.hidden = false;
    this.select.value = mixed ? MIX : picture.key;
    this.mixLine.hidden = !mixed;
    mixed?.forEach((number, i) => (this.inks[i]!.value = String(number)));
    this.bandLine.hidden = at < 0 || bands.length < 2;
    if (at >= 0) this.slider.value = String(at);
    this.slider.setAttribute("aria-valuetext", picture.label);
    this.note.textContent = picture.note;
    this.legend.replaceChildren(...(picture.legend ? drawLegend(picture.legend) : []));
  }
}

function groupsOf(layer: Layer): HTMLElement[] {
  return GROUPS.flatMap(([kind, label]) => {
    const options = layer.pictures
      .filter((picture) => picture.kind === kind)
      .map((picture) => make("option", { value: picture.key }, picture.label));
    if (kind === "colour" && proposeMix(layer))
      options.push(make("option", { value: MIX }, "False colour of three bands…"));
    return options.length ? make("optgroup", { label }, ...options) : [];
  });
}

function drawLegend({ entries, least, most }: Legend): HTMLElement[] {
  if (!least && !most)
    return entries.map(({ name, colour }) =>
      make("span", { class: "entry" }, swatch(colour), name),
    );
  const bar = make("span", { class: "scale", "aria-hidden": "true" });
  bar.style.background = `linear-gradient(to right, ${entries.map((e) => e.colour).join(", ")})`;
  return [make("span", {}, least), bar, make("span", {}, most)];
}
