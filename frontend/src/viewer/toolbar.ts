// The row of ways to compare two layers, and the settings of each.
import { effect } from "@preact/signals-core";
import { GAIN, radioGroup, slider, type Option, type Range } from "../shared/controls";
import { make } from "../shared/element";
import { RATES } from "../shared/flicker";
import type { Mode } from "../shared/stage";
import { numbersOf, type Address } from "./address";
import type { PaintingStage } from "./stage";

export const MODES: Option<Mode>[] = [
  { value: "single", label: "One", title: "A alone" },
  { value: "curtain", label: "Curtain", title: "A left of a line, B right of it" },
  { value: "flicker", label: "Flicker", title: "A and B in turn" },
  { value: "side", label: "Side by side", title: "A and B, linked" },
  { value: "difference", label: "Difference", title: "Where A and B differ is bright" },
];
const BRIGHTNESS: Range = { min: 0.25, max: 4, step: 0.05, value: 1 };
const CONTRAST: Range = { min: 0.5, max: 3, step: 0.05, value: 1 };

/** Fill the toolbar above the picture. */
export function fillToolbar(
  { modes, settings }: Record<"modes" | "settings", HTMLElement>,
  stage: PaintingStage,
  address: Address,
): void {
  const percent = (value: number): string => `${Math.round(100 * value)} %`;
  const setTone = (): void => {
    stage.setTone(bright.value, contrast.value, gain.value);
    address.remember();
  };
  const setRate = (hertz: number): void => {
    stage.flicker.rate = hertz;
    address.remember();
  };
  const rate = slider("Rate", RATES, (hertz) => `${hertz} Hz`, setRate);
  const gain = slider("Amplify", GAIN, (factor) => `× ${factor}`, setTone);
  const bright = slider("Brightness", BRIGHTNESS, percent, setTone);
  const contrast = slider("Contrast", CONTRAST, percent, setTone);
  const reset = make("button", { type: "button", class: "small" }, "Reset");
  reset.addEventListener("click", () => {
    bright.set(1);
    contrast.set(1);
  });
  const tone = make(
    "details",
    { class: "tone" },
    make("summary", { title: "Brightness and contrast" }, "Tone"),
    make("div", { class: "popover" }, bright.element, contrast.element, reset),
  );
  address.addSlider("rate", rate, RATES);
  address.addSlider("amplify", gain, GAIN);
  address.addSlider("brightness", bright, BRIGHTNESS);
  address.addSlider("contrast", contrast, CONTRAST);
  address.add({
    signals: [stage.curtain.place],
    carried: true,
    write: (facts) => {
      if (stage.mode.value === "curtain") facts.set("curtain", stage.curtain.fraction.toFixed(3));
    },
    read: (facts) => {
      const place = numbersOf(facts, "curtain", 1);
      if (place) stage.curtain.move(place[0]!);
    },
  });
  settings.append(rate.element, gain.element, tone);
  radioGroup(modes, MODES, stage.mode, (mode) => stage.setMode(mode));
  effect(() => {
    rate.element.hidden = stage.mode.value !== "flicker";
    gain.element.hidden = stage.mode.value !== "difference";
  });
}
