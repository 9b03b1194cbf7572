import { expect, test } from "vitest";
import {
  bounded,
  countSteps,
  decode,
  encode,
  fromText,
  gammaFor,
  middleOf,
  percentiles,
  placeOf,
  plainLevels,
  shownAs,
  tableOf,
  toText,
  valueAt,
} from "../src/viewer/levels";

test("levels that change nothing leave every step as it is, whatever the white", () => {
  for (const white of [0.02, 0.83, 1, 5000]) {
    const steps = tableOf(plainLevels(white), white).map((value) => value * 255);
    steps.forEach((value, i) => expect(value).toBeCloseTo(i, 9));
    // So does the law itself, to a thousandth of a step.
    for (let i = 0; i < 256; i++)
      expect(255 * shownAs(white * decode(i / 255), plainLevels(white))).toBeCloseTo(i, 3);
  }
});

test("two pictures with whites of their own show one value alike under the same levels", () => {
  const levels = { black: 0.05, white: 0.6, gamma: 1.3, inverted: false };
  for (const value of [0.1, 0.25, 0.5]) {
    const shown = [0.83, 1.2].map((white) => {
      const step = Math.round(255 * encode(value / white));
      return 255 * tableOf(levels, white)[step]!;
    });
    expect(Math.abs(shown[0]! - shown[1]!)).toBeLessThan(3); // steps of 8 bits
  }
});

test("black and below is black, white and above white, and inverted the other way", () => {
  const levels = { black: 0.2, white: 0.5, gamma: 1, inverted: false };
  for (const [value, shown] of [
    [0.1, 0],
    [0.2, 0],
    [0.5, 1],
    [0.9, 1],
  ] as const) {
    expect(shownAs(value, levels)).toBeCloseTo(shown, 12);
    expect(shownAs(value, { ...levels, inverted: true })).toBeCloseTo(1 - shown, 12);
  }
});

test("the middle handle is where it was put", () => {
  const levels = { ...plainLevels(0.8), black: 0.1 };
  for (const value of [0.15, 0.3, 0.6]) {
    const gamma = gammaFor(value, levels);
    expect(middleOf({ ...levels, gamma })).toBeCloseTo(value, 9);
    expect(shownAs(value, { ...levels, gamma })).toBeCloseTo(0.5, 9);
  }
});

test("places and values are each other's inverse", () => {
  for (const value of [0, 0.01, 0.4, 1.2])
    expect(valueAt(placeOf(value, 1.2), 1.2)).toBeCloseTo(value, 9);
});

test("percentiles of counts, and none without a pixel", () => {
  const counts = new Array<number>(256).fill(0);
  for (let i = 50; i < 150; i++) counts[i] = 1;
  expect(percentiles(counts, 0.01, 0.99)).toEqual([50, 148]);
  expect(percentiles(counts, 0, 1)).toEqual([50, 149]);
  expect(percentiles(new Array<number>(256).fill(0), 0.01, 0.99)).toBeNull();
});

test("lightness is counted, and what is transparent is not", () => {
  const counts = countSteps(Uint8ClampedArray.of(10, 10, 10, 255, 255, 0, 0, 255, 9, 9, 9, 0));
  expect(counts[10]).toBe(1);
  expect(counts[54]).toBe(1);
  expect(counts.reduce((sum, n) => sum + n)).toBe(2);
});

test("levels come back from an address, and nonsense does not", () => {
  const levels = { black: 0.05, white: 0.83, gamma: 1.3, inverted: true };
  expect(fromText(toText(levels))).toEqual(levels);
  for (const text of [
    "",
    "1,2,3",
    "a,b,c,d",
    "0,0,1,0",
    "0,-1,1,0",
    "0,,1,0",
    "0,NaN,1,0",
    "0,1e99,1,0",
  ])
    expect(fromText(text), text).toBeNull();
  const { black, white, gamma } = fromText("9,0.5,99,0")!;
  expect(black).toBeLessThan(white);
  expect(gamma).toBe(5);
  expect(bounded(plainLevels(0)).white).toBeGreaterThan(0);
});
