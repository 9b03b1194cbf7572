// What the page of one object shows: pictures in A to D, and what is kept of the painting.
import { signal } from "@preact/signals-core";
import type { Point } from "../shared/pane";
import type { Layer, Picture } from "./record";

export const SLOTS = ["a", "b", "c", "d"] as const;
export type Slot = (typeof SLOTS)[number];

export interface Choice {
  layer: Layer;
  picture: Picture;
}

/** What is drawn: of a rectangle two corners, of a length its ends, px of the grid. */
export type Shape = "rectangle" | "length";

/** Something that is kept: its name and where it is on the grid, fractions kept. */
export interface Kept {
  kind: "place" | Shape;
  name: string;
  points: Point[];
}

const CURVES = 8; // colours of the style sheet, --curve-1 and on

/** The colour of the curve, or of what is kept, of a number, from 0. */
export const colourOf = (number: number): string => `var(--curve-${(number % CURVES) + 1})`;

export class State {
  readonly a = signal<Choice | null>(null);
  readonly b = signal<Choice | null>(null);
  /** Pictures beside A and B, where four are shown. */
  readonly c = signal<Choice | null>(null);
  readonly d = signal<Choice | null>(null);
  /** The pixel whose spectrum is held, fractions kept. */
  readonly pin = signal<Point | null>(null);
  /** Places, rectangles and lengths that are kept. */
  readonly kept = signal<Kept[]>([]);
  /** Whether what is kept is marked on the painting. */
  readonly marks = signal(true);

  swap(): void {
    const { a, b } = this;
    if (a.value && b.value) [a.value, b.value] = [b.value, a.value];
  }
}
