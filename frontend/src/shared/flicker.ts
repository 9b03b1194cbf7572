// Two preloaded pictures in turn. The rate is of whole turns: at 2 Hz each is seen for a quarter second.

export const RATES = { min: 0.5, max: 8, step: 0.5, value: 2 };

/** A clock that shows A and B in turn. */
export class Flicker {
  rate = RATES.value;
  shown: "a" | "b" = "a";
  running = false;
  private began = 0;
  private frame = 0;

  constructor(private readonly onTurn: (shown: "a" | "b") => void) {}

  start(): void {
    if (this.running) return;
    this.running = true;
    this.began = performance.now();
    const tick = (now: number): void => {
      if (!this.running) return;
      const halves = Math.floor(((now - this.began) / 1000) * this.rate * 2);
      this.show(halves % 2 === 0 ? "b" : "a");
      this.frame = requestAnimationFrame(tick);
    };
    this.frame = requestAnimationFrame(tick);
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
