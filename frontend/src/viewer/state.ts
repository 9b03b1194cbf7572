// What the page of one object shows: pictures in A to D, their levels, pins, regions and measures.
import { signal } from "@preact/signals-core";
import type { Point } from "../shared/pane";
import type { Note } from "./annotations";
import { plainLevels, whiteOf, type Levels } from "./levels";
import type { Layer, Picture } from "./record";
import type { Region, Shape } from "./shapes";

export const SLOTS = ["a", "b", "c", "d"] as const;
export type Slot = (typeof SLOTS)[number];

export interface Choice {
  layer: Layer;
  picture: Picture;
}

/** A picture of a layer, as addresses name it. */
export const nameOf = ({ layer, picture }: Choice): string => `${layer.name}/${picture.key}`;

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
  /** Levels of pictures that a person changed, by `nameOf`. */
  readonly levels = signal<Record<string, Levels>>({});
  /** Levels that hold for all pictures alike, in the same values; null where each has its own. */
  readonly locked = signal<Levels | null>(null);
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

  /** The levels that a choice is shown with. */
  levelsOf(choice: Choice): Levels {
    const own = this.levels.value[nameOf(choice)];
    return this.locked.value ?? own ?? plainLevels(whiteOf(choice.picture));
  }

  /** Change the levels of a choice, or of all where they are locked; null takes its own change back. */
  setLevels(choice: Choice, levels: Levels | null): void {
    if (this.locked.value && levels) this.locked.value = levels;
    else {
      const others = Object.entries(this.levels.value).filter(([name]) => name !== nameOf(choice));
      if (levels) others.push([nameOf(choice), levels]);
      this.levels.value = Object.fromEntries(others);
    }
  }

  swap(): void {
    const { a, b } = this;
    if (a.value && b.value) [a.value, b.value] = [b.value, a.value];
  }
}
