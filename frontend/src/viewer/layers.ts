// The list of layers, and which picture of which layer stands in A and in B.
import { effect } from "@preact/signals-core";
import { nearest } from "../shared/falsecolour";
import { make } from "../shared/element";
import { bandNumber, bandsOf, mixNumbers, pictureOf, placeOf, proposeMix } from "./mixing";
import { Picker } from "./picker";
import type { Layer, PageRecord } from "./record";
import { SLOTS, type Choice, type Slot, type State } from "./state";

const OTHERS = ["b", "c", "d"] as const;

/** The panel "Layers". Rows choose the layer of A, their small buttons that of B. */
/** Share of the layer that was not checked from which on the reasons are shown. */
const WORTH_NAMING = 0.1;

export class LayerList {
  /** Layers that have a picture. */
  readonly layers: Layer[];
  /** Called when a person put a layer into B, C or D. */
  onCompare: () => void = () => {};

  private readonly pickers: Picker[];

  constructor(
    host: HTMLElement,
    record: PageRecord,
    private readonly state: State,
  ) {
    this.pickers = SLOTS.map((slot) => new Picker(slot, state));
    this.layers = record.layers.filter((layer) => layer.pictures.length);
    host.append(
      make("ol", { class: "layers" }, ...record.layers.map((layer) => this.rowOf(layer))),
      ...this.pickers.map(({ element }) => element),
    );
  }

  /** Put a layer into a slot, with the kind of picture that was shown there before, where it has it. */
  choose(slot: Slot, layer: Layer | undefined, key?: string): void {
    const before = this.state[slot].peek();
    const picture =
      layer &&
      ((key ? pictureOf(layer, key) : undefined) ??
        (before && likePicture(layer, before)) ??
        layer.pictures[0]);
    if (picture) this.state[slot].value = { layer, picture };
  }

  /** Put something into C and D, where they are empty: the next layers, or further pictures of them. */
  fillGrid(): void {
    const count = this.layers.length;
    for (const [i, slot] of SLOTS.entries()) {
      const layer = this.layers[i % count];
      const picture = layer?.pictures[Math.floor(i / count)] ?? layer?.pictures[0];
      if (layer && picture && !this.state[slot].peek()) this.state[slot].value = { layer, picture };
    }
  }

  private rowOf(layer: Layer): HTMLElement {
    const number = this.layers.indexOf(layer) + 1;
    const disabled = number === 0;
    const about = describe(layer);
    const [, verdict = "", rest = ""] = /^([^,]*)(?:, (.*))?$/s.exec(layer.verdict) ?? [];
    const first = make(
      "button",
      {
        type: "button",
        class: "layer",
        disabled,
        "aria-label": `Show ${layer.name}, ${about}, ${layer.verdict}`,
      },
      thumbnail(layer),
      make(
        "span",
        { class: "words" },
        make(
          "span",
          { class: "first" },
          make("span", { class: "layer-name", title: layer.name }, layer.name),
          make("span", { class: `badge ${layer.decision}` }, verdict),
        ),
        make("span", { class: "soft" }, about),
        rest && make("span", { class: "soft", title: rest }, rest),
      ),
      number > 0 && number < 10 && make("kbd", { "aria-hidden": "true" }, String(number)),
    );
    const others = OTHERS.map((slot) => {
      const name = slot.toUpperCase();
      const label = slot === "b" ? `Compare with ${layer.name}` : `Show ${layer.name} in ${name}`;
      const title = slot === "b" ? "Compare: put into B" : `Put into ${name}`;
      const attributes = { type: "button", class: `second into-${slot}`, disabled, title };
      const button = make("button", { ...attributes, "aria-label": label }, name);
      button.addEventListener("click", () => {
        this.choose(slot, layer);
        this.onCompare();
      });
      return button;
    });
    first.addEventListener("click", () => this.choose("a", layer));
    const row = make("li", { class: "row" }, first, ...others);
    if (layer.by_hand) row.append(make("p", { class: "by-hand" }, `${layer.by_hand}.`));
    if (layer.decision !== "accept" || layer.unchecked >= WORTH_NAMING) {
      const reasons = layer.reasons.join(" ");
      if (reasons) row.append(folded(reasons));
    }
    effect(() => {
      const chosen = SLOTS.map((slot) => this.state[slot].value?.layer === layer);
      row.classList.toggle("is-a", chosen[0]);
      [first, ...others].forEach((one, i) => one.setAttribute("aria-pressed", String(chosen[i])));
    });
    return row;
  }
}

/** Reasons by their first sentence; the others unfold. */
function folded(reasons: string): HTMLElement {
  const [first = reasons] = /^.*?[.!?](?=\s|$)/s.exec(reasons) ?? [];
  const rest = reasons.slice(first.length).trim();
  if (!rest) return make("p", { class: "reasons" }, first);
  return make("details", { class: "reasons" }, make("summary", {}, first), make("p", {}, rest));
}

function thumbnail({ thumbnail }: Layer): HTMLElement {
  if (!thumbnail) return make("span", { class: "empty" });
  const src = thumbnail.split("/").map(encodeURIComponent).join("/");
  return make("img", { src, alt: "", width: 44, height: 44, loading: "lazy" });
}

function describe({ bands }: Layer): string {
  if (!bands.length) return "not registered";
  const count = `${bands.length} band${bands.length === 1 ? "" : "s"}`;
  const known = bands.map((band) => band.wavelength).filter((w) => w !== null);
  if (!known.length) return count;
  return `${count}, ${Math.round(Math.min(...known))}–${Math.round(Math.max(...known))} nm`;
}

/** The picture of a layer that shows what was shown of another one, where it has one. */
function likePicture(
  layer: Layer,
  { layer: other, picture }: Choice,
): Layer["pictures"][number] | undefined {
  if (mixNumbers(picture.key)) return pictureOf(layer, proposeMix(layer) ?? "");
  if (picture.kind !== "band") return pictureOf(layer, picture.key);
  const wanted = placeOf(other, bandNumber(picture));
  const bands = bandsOf(layer);
  const places = bands.map((band) => placeOf(layer, bandNumber(band)));
  return wanted === null ? bands[0] : (bands[nearest(places, wanted)] ?? bands[0]);
}
