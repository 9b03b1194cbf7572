// The row of ways to compare pictures, and the settings of each.
import { effect } from "@preact/signals-core";
import { GAIN, radioGroup, slider, type Option, type Range } from "../shared/controls";
import { make } from "../shared/element";
import { RATES } from "../shared/flicker";
import type { Mode } from "../shared/stage";
import { numbersOf, type Address } from "./address";
import type { PaintingStage } from "./stage";

export const MODES: Option<Mode>[] = [
  { value: "single", label: "One", title: "A alone" },
  { value: "curtain", label: "Curtain", title: "A on one side of a line, B on the other (C)" },
  { value: "opacity", label: "Opacity", title: "B over A, with adjustable opacity (O)" },
  { value: "flicker", label: "Flicker", title: "A and B in turn (K)" },
  { value: "side", label: "Side by side", title: "A and B, linked (S)" },
  { value: "grid", label: "Four", title: "A, B, C and D, linked (Q)" },
  { value: "difference", label: "Difference", title: "Differences between A and B are bright (D)" },
];
const OPACITY: Range = { min: 0, max: 1, step: 0.01, value: 0.5 };

/** What the toolbar works on. */
interface Parts {
  stage: PaintingStage;
  address: Address;
}

/** Fill the toolbar above the picture. */
export function fillToolbar(
  { modes, settings }: Record<"modes" | "settings", HTMLElement>,
  { stage, address }: Parts,
): void {
  const { curtain, flicker, opacity, gain } = stage;
  const keep = (change: () => void): void => {
    change();
    address.remember();
  };
  const rate = slider("Rate", RATES, hertz, (value) => keep(() => (flicker.rate = value)));
  const amplify = slider("Amplify", GAIN, times, (value) => keep(() => (gain.value = value)));
  const cover = slider("B over A", OPACITY, percent, (value) =>
    keep(() => (opacity.value = value)),
  );
  const other = pill(
    "Show the other",
    "Your system requests less motion: the pictures do not alternate by themselves",
  );
  other.addEventListener("click", () => flicker.step());
  const begin = pill("Start", "This page was opened by a link: press K to start the flicker");
  begin.addEventListener("click", () => flicker.wait(false));
  const level = pill("Level line", "A above the line, B below it (Shift C)");
  level.addEventListener("click", () => curtain.turn(!curtain.level.value));
  address.addSlider("rate", rate, RATES);
  address.addSlider("amplify", amplify, GAIN);
  address.addSlider("opacity", cover, OPACITY);
  address.add({
    signals: [curtain.place, curtain.level],
    carried: true,
    write: (facts) => {
      if (stage.mode.value === "curtain") facts.set("curtain", curtain.fraction.toFixed(3));
      if (curtain.level.value) facts.set("line", "level");
    },
    read: (facts) => {
      const place = numbersOf(facts, "curtain", 1);
      if (place) curtain.move(place[0]!);
      curtain.turn(facts.get("line") === "level");
    },
  });
  settings.append(begin, rate.element, other, amplify.element, cover.element, level);
  radioGroup(modes, MODES, stage.mode, (mode) => stage.setMode(mode));
  effect(() => {
    const mode = stage.mode.value;
    rate.element.hidden = mode !== "flicker" || flicker.byHand;
    other.hidden = mode !== "flicker" || !flicker.byHand;
    begin.hidden = mode !== "flicker" || !flicker.waits.value;
    amplify.element.hidden = mode !== "difference";
    cover.element.hidden = mode !== "opacity";
    level.hidden = mode !== "curtain";
    level.setAttribute("aria-pressed", String(curtain.level.value));
  });
}

const percent = (value: number): string => `${Math.round(100 * value)} %`;
const hertz = (value: number): string => `${value} Hz`;
const times = (value: number): string => `× ${value}`;
const pill = (words: string, title: string): HTMLButtonElement =>
  make("button", { type: "button", class: "pill", title }, words);
