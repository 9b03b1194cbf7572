// Black, white and gamma of a picture, in the values that it shows, and what they make of its 256 steps.
import type { Picture } from "./record";

/** How values are shown: `black` and below black, `white` and above white; gamma above 1 lifts what is between. */
export interface Levels {
  black: number;
  white: number;
  gamma: number;
  inverted: boolean;
}

export const STEPS = 256;
export const GAMMAS = { min: 0.2, max: 5 };
const LEAST_APART = 1e-3; // of black and white, as a part of white
const DIGITS = 4;

/** Light, 0 to 1, of a step of an sRGB picture, 0 to 1 (IEC 61966-2-1). */
export function decode(shown: number): number {
  return shown <= 0.04045 ? shown / 12.92 : ((shown + 0.055) / 1.055) ** 2.4;
}

/** The step of an sRGB picture, 0 to 1, for light, 0 to 1. */
export function encode(light: number): number {
  return light <= 0.0031308 ? 12.92 * light : 1.055 * light ** (1 / 2.4) - 0.055;
}

/** The value that a picture shows as white: of a single band in its own unit, else 1. */
export function whiteOf({ white }: Picture): number {
  return white ?? 1;
}

/** Whether a picture has levels: a map has fixed colours, which its legend explains. */
export function hasLevels({ kind }: Picture): boolean {
  return kind !== "map" && kind !== "angle";
}

/** The levels with which a picture was published. */
export function plainLevels(white: number): Levels {
  return { black: 0, white, gamma: 1, inverted: false };
}

/** Whether levels change nothing in a picture whose white is `white`. */
export function isPlain(levels: Levels, white: number): boolean {
  return levels.black === 0 && levels.white === white && levels.gamma === 1 && !levels.inverted;
}

/** Levels within bounds: black below white, gamma within `GAMMAS`. */
export function bounded({ black, white, gamma, inverted }: Levels): Levels {
  const top = Math.max(white, 1e-6);
  return {
    black: Math.min(Math.max(0, black), top * (1 - LEAST_APART)),
    white: top,
    gamma: Math.min(Math.max(gamma, GAMMAS.min), GAMMAS.max),
    inverted,
  };
}

/** How light a value is shown under levels, 0 to 1. */
export function shownAs(value: number, { black, white, gamma, inverted }: Levels): number {
  const part = Math.min(1, Math.max(0, (value - black) / (white - black)));
  const shown = encode(part ** (1 / gamma));
  return inverted ? 1 - shown : shown;
}

/** What levels make of each step, 0 to 255, of a picture whose own white is `white`; values 0 to 1. */
export function tableOf(levels: Levels, white: number): number[] {
  return Array.from({ length: STEPS }, (_, i) =>
    isPlain(levels, white) ? i / (STEPS - 1) : shownAs(white * decode(i / (STEPS - 1)), levels),
  );
}

/** Where a value stands on an axis that ends with `top` and is spaced as the eye sees, 0 to 1. */
export function placeOf(value: number, top: number): number {
  return encode(Math.min(1, Math.max(0, value / top)));
}

/** The value at a place of that axis. */
export function valueAt(place: number, top: number): number {
  return top * decode(Math.min(1, Math.max(0, place)));
}

/** The gamma at which a value between black and white is shown in the middle of the axis. */
export function gammaFor(value: number, { black, white }: Levels): number {
  const part = Math.min(Math.max((value - black) / (white - black), 1e-4), 1 - 1e-4);
  const gamma = Math.log(part) / Math.log(decode(0.5));
  return Math.min(Math.max(gamma, GAMMAS.min), GAMMAS.max);
}

/** The value that is shown in the middle of the axis. */
export function middleOf({ black, white, gamma }: Levels): number {
  return black + (white - black) * decode(0.5) ** gamma;
}

/** Count how many pixels have each step of lightness (Rec. 709); transparent ones are left out. */
export function countSteps(rgba: Uint8ClampedArray): number[] {
  const counts = new Array<number>(STEPS).fill(0);
  for (let i = 0; i < rgba.length; i += 4)
    if (rgba[i + 3]! > 127)
      counts[Math.round(0.2126 * rgba[i]! + 0.7152 * rgba[i + 1]! + 0.0722 * rgba[i + 2]!)]!++;
  return counts;
}

/** The steps below which `low`, and above which `1 - high` of all pixels lie; null without a pixel. */
export function percentiles(counts: number[], low: number, high: number): [number, number] | null {
  const total = counts.reduce((sum, n) => sum + n, 0);
  if (!total) return null;
  const reach = (part: number): number => {
    let sum = 0;
    return counts.findIndex((n) => (sum += n) >= part * total && sum > 0);
  };
  return [reach(low), reach(high)];
}

/** Levels as an address holds them: black,white,gamma,inverted. */
export function toText({ black, white, gamma, inverted }: Levels): string {
  const numbers = [black, white, gamma].map((value) => Number(value.toPrecision(DIGITS)));
  return [...numbers, Number(inverted)].join();
}

/** Read levels from an address; null where they are none. */
export function fromText(text: string): Levels | null {
  const values = text.split(",").map((part) => (part.trim() ? Number(part) : NaN));
  const [black, white, gamma, inverted] = values;
  if (values.length !== 4 || !values.every(Number.isFinite) || white! <= 0 || white! > 1e9)
    return null;
  return bounded({ black: black!, white: white!, gamma: gamma!, inverted: inverted === 1 });
}
