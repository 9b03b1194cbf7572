// How long a millimetre is on the screen, in round numbers.
import { make } from "../shared/element";

const LONGEST_PX = 150;
const ROUND = [1, 2, 5];

/** A bar in the corner of the picture: millimetres where the sampling is known, else pixels. */
export class ScaleBar {
  private readonly bar = make("span", { class: "ruler", "aria-hidden": "true" });
  private readonly text = make("span", {});
  readonly element = make("div", { class: "scalebar" }, this.bar, this.text);

  constructor(private readonly pxPerMm: number | null) {}

  /** How long the bar is, px of the screen, and what it stands for, as it is shown. */
  get shown(): { width: number; words: string } {
    return { width: parseFloat(this.bar.style.width) || 0, words: this.text.textContent };
  }

  /** Show a round length at `scale` screen pixels a pixel. */
  update(scale: number): void {
    const unit = scale * (this.pxPerMm ?? 1); // screen pixels a mm, or a pixel
    if (!Number.isFinite(unit) || unit <= 0) return;
    const length = roundBelow(LONGEST_PX / unit);
    this.bar.style.width = `${length * unit}px`;
    this.text.textContent = this.pxPerMm ? describeMillimetres(length) : `${length} px`;
  }
}

/** The largest of 1, 2 and 5 times a power of ten that is not above `most`. */
export function roundBelow(most: number): number {
  const power = 10 ** Math.floor(Math.log10(most));
  return Math.max(...ROUND.map((n) => n * power).filter((n) => n <= most));
}

/** A length in m, cm, mm or µm, whichever gives a number from one on. */
export function describeMillimetres(mm: number): string {
  if (mm >= 1000) return `${mm / 1000} m`;
  if (mm >= 10) return `${mm / 10} cm`;
  return mm >= 1 ? `${mm} mm` : `${Number((mm * 1000).toPrecision(3))} µm`;
}
