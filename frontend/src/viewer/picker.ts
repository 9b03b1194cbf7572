// Chooses among the pictures of the layer in one slot.
import { effect } from "@preact/signals-core";
import { make, swatch } from "../shared/element";
import type { Point } from "../shared/pane";
import { angleKey, hasAngles, progress, RANGES, USUAL_RANGE } from "./angle";
import { bandNumber, bandsOf, mixKey, mixNumbers, pictureOf, proposeMix } from "./mixing";
import type { Layer, Legend, Picture } from "./record";
import type { Choice, Slot, State } from "./state";

const MIX = "mix";
const ANGLE = "angle";
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
  private readonly range = make(
    "select",
    {},
    ...RANGES.map((degrees) => make("option", { value: degrees }, `${degrees}°`)),
  );
  private readonly take = make(
    "button",
    { type: "button", class: "small" },
    "Take the pinned place",
  );
  private readonly angleLine: HTMLElement;
  private readonly computing = make("p", { class: "note soft", role: "status" });
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
    this.range.value = String(USUAL_RANGE);
    this.range.setAttribute("aria-label", `Largest angle shown in ${name}`);
    const scale = make("label", {}, "Scale to ", this.range);
    this.angleLine = make("div", { class: "band-line angle-line" }, scale, this.take);
    const mark = make("span", { class: `slot slot-${slot}`, "aria-hidden": "true" }, name);
    this.element = make(
      "div",
      { class: `picker picker-${slot}`, hidden: true },
      make("div", { class: "picker-line" }, mark, this.select),
      this.bandLine,
      this.mixLine,
      this.angleLine,
      this.note,
      this.computing,
      this.legend,
    );
    this.listen();
    effect(() => {
      const choice = state[slot].value;
      if (choice) this.show(choice);
    });
    effect(() => {
      const facts = state[slot].value?.picture.angle;
      const pin = state.pin.value;
      this.take.disabled = !pin || !facts || pixelOf(pin).join() === facts.place.join();
      this.computing.textContent = facts ? progress.value : "";
      this.offerAngle();
    });
  }

  private listen(): void {
    this.take.addEventListener("click", () => this.showAngle());
    this.range.addEventListener("change", () => this.scaleAngle());
    for (const ink of this.inks)
      ink.addEventListener("change", () =>
        this.pick(mixKey(this.inks.map((one) => Number(one.value)))),
      );
    this.select.addEventListener("change", () => {
      const { value } = this.select;
      if (value === ANGLE) this.showAngle();
      else this.pick(value === MIX && this.offered ? (proposeMix(this.offered) ?? "") : value);
    });
    this.slider.addEventListener("input", () => {
      const band = this.offered && bandsOf(this.offered)[Number(this.slider.value)];
      if (band) this.pick(band.key);
    });
  }

  /** Show the spectral angle to the pinned place. */
  showAngle(): void {
    const pin = this.state.pin.peek();
    if (pin) this.pick(angleKey(pixelOf(pin), Number(this.range.value)));
  }

  private scaleAngle(): void {
    const facts = this.state[this.slot].peek()?.picture.angle;
    if (facts) this.pick(angleKey(facts.place, Number(this.range.value)));
  }

  /** Without a pinned place there is nothing to compare with, and the list says so. */
  private offerAngle(): void {
    const option = this.select.querySelector<HTMLOptionElement>(`option[value=${ANGLE}]`);
    if (!option) return;
    const shown = this.state[this.slot].value?.picture.angle;
    const pinned = this.state.pin.value ?? shown?.place;
    option.disabled = !pinned;
    option.textContent = pinned ? "Spectral angle to a place" : "Spectral angle: pin a place first";
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
      this.offerAngle();
      this.slider.max = String(Math.max(0, bands.length - 1));
    }
    const mixed = mixNumbers(picture.key);
    const at = bands.indexOf(picture);
    this.element.hidden = false;
    this.select.value = mixed ? MIX : picture.angle ? ANGLE : picture.key;
    this.angleLine.hidden = !picture.angle;
    if (picture.angle) this.range.value = String(picture.angle.range);
    this.mixLine.hidden = !mixed;
    mixed?.forEach((number, i) => (this.inks[i]!.value = String(number)));
    this.bandLine.hidden = at < 0 || bands.length < 2;
    if (at >= 0) this.slider.value = String(at);
    this.slider.setAttribute("aria-valuetext", picture.label);
    this.note.textContent = picture.note;
    this.legend.replaceChildren(...(picture.legend ? drawLegend(picture.legend) : []));
  }
}

const pixelOf = (place: Point): Point => [Math.round(place[0]), Math.round(place[1])];

function groupsOf(layer: Layer): HTMLElement[] {
  return GROUPS.flatMap(([kind, label]) => {
    const options = layer.pictures
      .filter((picture) => picture.kind === kind)
      .map((picture) => make("option", { value: picture.key }, picture.label));
    if (kind === "colour" && proposeMix(layer))
      options.push(make("option", { value: MIX }, "False colour of three bands…"));
    if (kind === "analysis" && hasAngles(layer))
      options.push(make("option", { value: ANGLE }, "Spectral angle to a place"));
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
