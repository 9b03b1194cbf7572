// The line between A and B: upright or level, dragged, or moved with the arrow keys.
import { signal } from "@preact/signals-core";
import { make } from "./element";
import type { Point } from "./pane";

const STEP = 0.02;

/** A line over a pane: A is left of it or above, B right of it or below. */
export class Curtain {
  /** Where the line stands, 0 left or top to 1 right or bottom. */
  readonly place = signal(0.5);
  /** Whether the line is level, and B below it. */
  readonly level = signal(false);
  readonly line = make(
    "div",
    {
      class: "curtain",
      role: "slider",
      tabindex: 0,
      "aria-label": "Curtain between A and B",
      "aria-orientation": "horizontal",
      "aria-valuemin": 0,
      "aria-valuemax": 100,
      hidden: true,
    },
    make("span", { class: "curtain-name left", "aria-hidden": "true" }, "A"),
    make("span", { class: "curtain-grip", "aria-hidden": "true" }, "⇆"),
    make("span", { class: "curtain-name right", "aria-hidden": "true" }, "B"),
  );

  constructor(
    pane: HTMLElement,
    private readonly onMove: () => void,
  ) {
    pane.append(this.line);
    this.line.addEventListener("pointerdown", (event) => {
      event.stopPropagation();
      this.line.setPointerCapture(event.pointerId);
    });
    this.line.addEventListener("pointermove", (event) => {
      if (!this.line.hasPointerCapture(event.pointerId)) return;
      const box = pane.getBoundingClientRect();
      const level = this.level.peek();
      this.move(
        level ? (event.clientY - box.top) / box.height : (event.clientX - box.left) / box.width,
      );
    });
    this.line.addEventListener("keydown", (event) => {
      const [by, to] = [MOVES[event.key], ENDS[event.key]];
      if (by === undefined && to === undefined) return;
      event.preventDefault();
      event.stopPropagation();
      this.move(to ?? this.fraction + (by ?? 0));
    });
    this.draw();
  }

  set shown(on: boolean) {
    this.line.hidden = !on;
  }

  /** Where the line stands, 0 left or top to 1 right or bottom. */
  get fraction(): number {
    return this.place.peek();
  }

  /** Turn the line upright or level; it keeps its part of the view. */
  turn(level: boolean): void {
    this.level.value = level;
    this.line.classList.toggle("level", level);
    this.line.setAttribute("aria-orientation", level ? "vertical" : "horizontal");
    this.move(this.fraction);
  }

  move(fraction: number): void {
    this.place.value = Math.min(1, Math.max(0, fraction));
    this.draw();
    this.onMove();
  }

  private draw(): void {
    const part = `${100 * this.fraction}%`;
    const level = this.level.peek();
    [this.line.style.left, this.line.style.top] = level ? ["", part] : [part, ""];
    this.line.setAttribute("aria-valuenow", String(Math.round(100 * this.fraction)));
  }
}

const MOVES: Record<string, number> = {
  ArrowLeft: -STEP,
  ArrowUp: -STEP,
  ArrowRight: STEP,
  ArrowDown: STEP,
  PageDown: -5 * STEP,
  PageUp: 5 * STEP,
};
const ENDS: Record<string, number> = { Home: 0, End: 1 };

/** The part of a picture right of an upright line on screen through a place: left, top, width and height. */
export function beyond(
  [x, y]: Point,
  turned: number,
  [width, height]: Point,
): [number, number, number, number] {
  const across = Math.min(Math.max(x, 0), width - 1e-3);
  const down = Math.min(Math.max(y, 0), height - 1e-3);
  if (turned === 90) return [0, 0, width, down];
  if (turned === 180) return [0, 0, across, height];
  if (turned === 270) return [0, down, width, height - down];
  return [across, 0, width - across, height];
}
