// Controls that both pages have: a group of radio buttons, and a slider with its value in words.
import { effect, type ReadonlySignal } from "@preact/signals-core";
import { make } from "./element";

export interface Option<T extends string> {
  value: T;
  label: string;
  title?: string;
}

/** Fill `host` with a button an option; one is a stop of the Tab key, arrows lead to the others. */
export function radioGroup<T extends string>(
  host: HTMLElement,
  options: readonly Option<T>[],
  chosen: ReadonlySignal<T>,
  choose: (value: T) => void,
): void {
  const buttons = options.map(({ value, label, title }) => {
    const button = make(
      "button",
      { type: "button", role: "radio", "data-mode": value, title },
      label,
    );
    button.addEventListener("click", () => choose(value));
    return button;
  });
  host.append(...buttons);
  host.addEventListener("keydown", (event) => {
    const by = { ArrowRight: 1, ArrowDown: 1, ArrowLeft: -1, ArrowUp: -1 }[event.key];
    if (!by) return;
    event.preventDefault();
    event.stopPropagation();
    const now = options.findIndex(({ value }) => value === chosen.peek());
    const next = (now + by + options.length) % options.length;
    choose(options[next]!.value);
    buttons[next]!.focus();
  });
  effect(() => {
    buttons.forEach((button, i) => {
      const on = options[i]!.value === chosen.value;
      button.setAttribute("aria-checked", String(on));
      button.tabIndex = on ? 0 : -1;
    });
  });
}

export interface Range {
  min: number;
  max: number;
  step: number;
  value: number;
}

/** By how much differences are brightened. */
export const GAIN: Range = { min: 1, max: 16, step: 1, value: 4 };

export interface Slider {
  element: HTMLElement;
  readonly value: number;
  set(value: number): void;
}

/** Make a labelled slider; `words` puts a value into words. */
export function slider(
  label: string,
  { min, max, step, value }: Range,
  words: (value: number) => string,
  onChange: (value: number) => void,
): Slider {
  const input = make("input", { type: "range", min, max, step, value });
  const output = make("output", {});
  const show = (): void => {
    output.textContent = words(Number(input.value));
    input.setAttribute("aria-valuetext", output.textContent);
  };
  const change = (): void => {
    show();
    onChange(Number(input.value));
  };
  input.addEventListener("input", change);
  show();
  return {
    element: make("label", { class: "slider" }, make("span", {}, label), input, output),
    get value() {
      return Number(input.value);
    },
    set(to) {
      input.value = String(to);
      change();
    },
  };
}
