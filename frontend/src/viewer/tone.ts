// Brightness and contrast of what is on the screen: two sliders, which the browser applies to all pictures alike.
import { slider, type Range } from "../shared/controls";
import { make } from "../shared/element";
import type { Address } from "./address";
import type { PaintingStage } from "./stage";

const BRIGHTNESS: Range = { min: 0.2, max: 5, step: 0.05, value: 1 };
const CONTRAST: Range = { min: 0.2, max: 5, step: 0.05, value: 1 };

/** Fill the fold "Brightness and contrast". */
export function fillTone(host: HTMLElement, stage: PaintingStage, address: Address): void {
  const show = (): void => {
    const plain = bright.value === 1 && contrast.value === 1;
    const filter = plain ? "" : `brightness(${bright.value}) contrast(${contrast.value})`;
    for (const { pane } of stage.cells)
      (pane.viewer.drawer.canvas as HTMLElement).style.filter = filter;
    address.remember();
  };
  const times = (value: number): string => `× ${value.toFixed(2)}`;
  const bright = slider("Brightness", BRIGHTNESS, times, () => show());
  const contrast = slider("Contrast", CONTRAST, times, () => show());
  const reset = make("button", { type: "button", class: "small" }, "Reset");
  reset.addEventListener("click", () => {
    bright.set(1);
    contrast.set(1);
  });
  address.addSlider("brightness", bright, BRIGHTNESS);
  address.addSlider("contrast", contrast, CONTRAST);
  host.append(bright.element, contrast.element, reset);
}
