// Two preloaded pictures in turn. The rate is of whole turns: at 2 Hz each is shown for a quarter second.

import { signal } from "@preact/signals-core";

export const RATES = { min: 0.5, max: 8, step: 0.5, value: 2 };
const STILL = "(prefers-reduced-motion: reduce)";

/** A clock that shows A and B in turn; where the system requests less motion, nothing turns by itself. */
export class Flicker {
  rate = RATES.value;
  shown: "a" | "b" = "a";
  running = false;
  /** Whether it waits for a person to start it: nothing turns because a link was followed. */
  readonly waits = signal(false);
  private began = 0;
  private frame = 0;
  private readonly still = matchMedia(STILL);

  constructor(private readonly onTurn: (shown: "a" | "b") => void) {
    this.still.addEventListener("change", () => {
      if (!this.running) return;
      this.stop();
      this.start();
    });
  }

  /** Whether a person turns from one picture to the other, by `step`. */
  get byHand(): boolean {
    return this.still.matches || this.waits.value;
  }

  start(): void {
    if (this.running) return;
    this.running = true;
    if (this.byHand) {
      if (!this.waits.peek()) this.show("b");
      return;
    }
    this.began = performance.now();
    const tick = (now: number): void => {
      if (!this.running) return;
      const halves = Math.floor(((now - this.began) / 1000) * this.rate * 2);
      this.show(halves % 2 === 0 ? "b" : "a");
      this.frame = requestAnimationFrame(tick);
    };
    this.frame = requestAnimationFrame(tick);
  }

  /** Wait for a person to start it, or start what waits. */
  wait(on: boolean): void {
    this.waits.value = on;
    if (!this.running) return;
    this.stop();
    this.start();
  }

  /** Show the other picture. */
  step(): void {
    if (this.running) this.show(this.shown === "a" ? "b" : "a");
  }

  stop(): void {
    if (!this.running) return;
    this.running = false;
    cancelAnimationFrame(this.frame);
    this.show("a");
  }

  private show(shown: "a" | "b"): void {
    if (shown !== this.shown) this.onTurn((this.shown = shown));
  }
}
