// What the page of one object shows: a picture in A, one in B, how they are compared, and the pin.
import { signal } from "@preact/signals-core";
import type { Point } from "../shared/pane";
import type { Note } from "./annotations";
import type { Layer, Picture } from "./record";
import type { Region, Shape } from "./shapes";

export type Slot = "a" | "b";

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
  /** The pixel whose spectrum is held, fractions kept. */
  readonly pin = signal<Point | null>(null);
  /** Places that are kept. */
  readonly pins = signal<Pin[]>([]);
  /** Regions that are measured. */
  readonly regions = signal<Region[]>([]);
  /** Lengths and areas that are measured. */
  readonly measures = signal<Measure[]>([]);
  /** Notes that the reader wrote. */
  readonly notes = signal<Note[]>([]);
  /** Whether pins, shapes and notes are marked on the painting. */
  readonly marks = signal(true);
  /** Whether a grid lies over the painting. */
  readonly grid = signal(false);

  swap(): void {
    const { a, b } = this;
    if (a.value && b.value) [a.value, b.value] = [b.value, a.value];
  }
}
