// A threshold of the paper's removal: a logarithmic slider, its number, and the campaign's own value.
import { effect } from "@preact/signals-core";
import { make } from "../shared/element";
import type { Store } from "./store";

/** Decimal logarithms of the least and the largest value, reference px. */
const RANGES = { reject: [0.5, 3.3], stop: [-2, 1.7] } as const;

export function thresholdSlider(
  store: Store,
  name: keyof typeof RANGES,
  label: string,
  title: string,
): HTMLElement {
  const [min, max] = RANGES[name];
  const range = make("input", {
    type: "range",
    id: `${name}-range`,
    min,
    max,
    step: 0.01,
    "aria-label": `${label}, logarithmic`,
  });
  const number = make("input", {
    type: "number",
    id: `${name}-number`,
    min: 0.001,
    step: "any",
    "aria-label": `${label}, reference pixels`,
  });
  const own = "The campaign's own value again";
  const reset = make(
    "button",
    {
      type: "button",
      class: "small",
      id: `${name}-reset`,
      hidden: true,
      "aria-label": `${label}: ${own.toLowerCase()}`,
      title: own,
    },
    "↺",
  );
  const send = latestOnly((value) => store.edit({ operation: "slide", name, value }));
  range.addEventListener("input", () => {
    const value = Number((10 ** Number(range.value)).toPrecision(3));
    number.value = String(value);
    send(value);
  });
  number.addEventListener("change", () => send(Number(number.value)));
  reset.addEventListener("click", () => void store.edit({ operation: "slide", name, value: null }));
  effect(() => {
    const session = store.session.value;
    if (!session) return;
    const value = session[name];
    if (document.activeElement !== number) number.value = String(Number(value.toPrecision(4)));
    if (document.activeElement !== range) range.value = String(Math.log10(value));
    reset.hidden = !session.overridden[name];
  });
  const unit = make("span", { class: "soft" }, "px");
  const head = make("label", { for: `${name}-range` }, label);
  return make("div", { class: "threshold", title }, head, range, number, unit, reset);
}

/** Run an action one value at a time; of values that come meanwhile only the last counts. */
export function latestOnly(act: (value: number) => Promise<void>): (value: number) => void {
  let busy = false;
  let waiting: number | null = null;
  const run = async (value: number): Promise<void> => {
    busy = true;
    await act(value).finally(() => (busy = false));
    if (waiting === null) return;
    const next = waiting;
    waiting = null;
    await run(next);
  };
  return (value) => {
    if (busy) waiting = value;
    else void run(value);
  };
}
