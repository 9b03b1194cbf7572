// What the page of one object shows: a picture in A, one in B, how they are compared, and the pin.
import { signal } from "@preact/signals-core";
import type { Point } from "../shared/pane";
import type { Layer, Picture } from "./record";

export type Slot = "a" | "b";

export interface Choice {
  layer: Layer;
  picture: Picture;
}

export class State {
  readonly a = signal<Choice | null>(null);
  readonly b = signal<Choice | null>(null);
  /** The pixel whose spectrum is held, fractions kept. */
  readonly pin = signal<Point | null>(null);

  swap(): void {
    const { a, b } = this;
    if (a.value && b.value) [a.value, b.value] = [b.value, a.value];
  }
}
