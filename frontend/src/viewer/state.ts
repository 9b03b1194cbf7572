// What the page of one object shows: pictures in A to D, pins, regions and measures.
import { signal } from "@preact/signals-core";
import type { Point } from "../shared/pane";
import type { Layer, Picture } from "./record";
import type { Region, Shape } from "./shapes";

export const SLOTS = ["a", "b", "c", "d"] as const;
export type Slot = (typeof SLOTS)[number];

export interface Choice {
  layer: Layer;
  picture: Picture;
}

/** A place that is kept: its name and where it is on the grid, fractions kept. */
export interface Pin {
  name: string;
  at: Point;
}

/** A length or an area that is measured. */
export interface Measure extends Shape {
  name: string;
  kind: Exclude<Shape["kind"], "place">;
}

export class State {
  readonly a = signal<Choice | null>(null);
  readonly b = signal<Choice | null>(null);
  /** Pictures beside A and B, where four are shown. */
  readonly c = signal<Choice | null>(null);
  readonly d = signal<Choice | null>(null);
  /** The pixel whose spectrum is held, fractions kept. */
  readonly pin = signal<Point | null>(null);
  /** Places that are kept. */
  readonly pins = signal<Pin[]>([]);
  /** Regions that are measured. */
  readonly regions = signal<Region[]>([]);
  /** Lengths and areas that are measured. */
  readonly measures = signal<Measure[]>([]);
  /** Whether pins and shapes are marked on the painting. */
  readonly marks = signal(true);
  /** Whether a grid lies over the painting. */
  readonly grid = signal(false);

  swap(): void {
    const { a, b } = this;
    if (a.value && b.value) [a.value, b.value] = [b.value, a.value];
  }
}
