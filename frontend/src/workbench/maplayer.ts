// Maps of what is known over the reference: uncertainty, errors, likeness, flags.
import { effect, signal } from "@preact/signals-core";
import { make } from "../shared/element";
import { getJson } from "./api";
import type { Pane, Point } from "../shared/pane";
import { px } from "./record";
import type { PairStage } from "./stage";
import type { Store } from "./store";

const KINDS: [string, string][] = [
  ["", "No colours"],
  ["sigma", "Uncertainty"],
  ["leave-one-out", "Leave-one-out error"],
  ["ssim", "Likeness (SSIM)"],
  ["flags", "Flags"],
];
const OPACITY = 0.62;

/** A map as it is laid over the reference. */
export interface MapImage {
  image: HTMLImageElement;
  opacity: number;
}

interface ColouredMap {
  png: string;
  low: number;
  high: number;
  meaning: string;
}

export class MapLayer {
  readonly choice: HTMLSelectElement;
  readonly legend = make("div", { class: "legend", hidden: true });
  private readonly kind = signal("");
  private wanted = "";

  constructor(
    private readonly store: Store,
    private readonly stage: PairStage,
  ) {
    const options = KINDS.map(([value, words]) => make("option", { value }, words));
    const label = { id: "layer", "aria-label": "Map over the reference" };
    this.choice = make("select", label, ...options);
    this.choice.addEventListener("change", () => (this.kind.value = this.choice.value));
    effect(() => {
      const known = store.frame.value?.maps ?? [];
      for (const option of options) option.disabled = !["", ...known].includes(option.value);
      if (!["", ...known].includes(this.kind.value)) this.kind.value = "";
    });
    effect(() => {
      const kind = (this.choice.value = this.kind.value);
      const version = store.session.value?.version ?? 0;
      const address = `${store.path}/maps/${kind}?map=${store.map.value}&v=${version}`;
      void this.load(kind && address);
    });
  }

  private async load(address: string): Promise<void> {
    if (address === this.wanted) return;
    this.wanted = address;
    if (!address) {
      this.clear();
      return;
    }
    try {
      const { png, low, high, meaning } = await getJson<ColouredMap>(address);
      const image = new Image();
      image.src = `data:image/png;base64,${png}`;
      await image.decode();
      if (address !== this.wanted) return;
      this.legend.replaceChildren(
        make("span", {}, px(low)),
        make("span", { class: "ramp", "aria-hidden": "true" }),
        make("span", {}, px(high)),
        make("span", { class: "soft" }, meaning),
      );
      this.legend.hidden = false;
      this.stage.lay({ image, opacity: OPACITY });
    } catch (error) {
      this.kind.value = "";
      this.store.refuse(error);
    }
  }

  private clear(): void {
    this.legend.hidden = true;
    this.stage.lay(null);
  }
}

/** Draw a map in colours over a picture of so many pixels. */
export function paintMap(
  context: CanvasRenderingContext2D,
  pane: Pane,
  { image, opacity }: MapImage,
  [w, h]: Point,
): void {
  const [left, top] = pane.placeOf(-0.5, -0.5);
  const [a, b] = pane.placeOf(w - 0.5, -0.5);
  const [c, d] = pane.placeOf(-0.5, h - 0.5);
  context.save();
  context.globalAlpha = opacity;
  context.transform((a - left) / w, (b - top) / w, (c - left) / h, (d - top) / h, left, top);
  context.drawImage(image, 0, 0, w, h);
  context.restore();
}
