import { expect, test } from "vitest";
import { across, dashOf, levels, niceTop, ticks, upwards } from "../src/shared/plot";
import { describeDoubts, runs, valueRange } from "../src/viewer/chart";

const BOX = { width: 360, height: 220, left: 40, right: 20, top: 10, bottom: 30 };

test("scales lead from margin to margin, values rise", () => {
  const [x, y] = [across(BOX, 400, 700), upwards(BOX, 0, 2)];
  expect([x(400), x(550), x(700)]).toEqual([40, 190, 340]);
  expect([y(0), y(1), y(2)]).toEqual([190, 100, 10]);
});

test("ticks are round and no more than seven", () => {
  expect(ticks(420, 950)).toEqual([500, 600, 700, 800, 900]);
  expect(ticks(500, 560)).toEqual([500, 510, 520, 530, 540, 550, 560]);
});

test("an axis ends at the next round number", () => {
  expect(niceTop(0.47)).toBeCloseTo(0.6, 12);
  expect(niceTop(1)).toBe(1);
  expect(niceTop(9.5)).toBe(10);
  expect(niceTop(0.0121)).toBeCloseTo(0.016, 12);
});

test("a line is cut at wide gaps and at values that are not to be trusted", () => {
  const cut = (samples: { nm: number; doubts: unknown[] }[]): number[][] =>
    runs(samples).map((run) => run.map(({ nm }) => nm));
  const sound = [400, 480, 561, 600].map((nm) => ({ nm, doubts: [] as unknown[] }));
  expect(cut(sound)).toEqual([
    [400, 480],
    [561, 600],
  ]);
  expect(cut([])).toEqual([]);
  sound[1]!.doubts = ["saturated"];
  expect(cut(sound)).toEqual([[400], [561, 600]]);
});

test("values below zero are within the range, and zero is a level", () => {
  const [low, top] = valueRange([
    { value: -0.03, sigma: 0.01 },
    { value: 0.5, sigma: NaN },
  ]);
  expect([low, top]).toEqual([expect.closeTo(-0.03, 12), expect.closeTo(0.6, 12)]);
  expect(levels(-0.03, 0.6)).toContain(0);
  expect(levels(0, 1)).toEqual([0, 0.2, 0.4, 0.6, 0.8, 1]);
  for (const top of [0.016, 0.6, 1.2, 3, 800]) {
    const count = levels(0, top).length;
    expect(count).toBeGreaterThan(2);
    expect(count).toBeLessThan(8);
  }
});

test("what is not to be trusted is said in a sentence", () => {
  const marks = [
    { bit: 2, word: "saturated", colour: "#f00", trusted: false },
    { bit: 8, word: "defect, replaced", colour: "#0f0", trusted: true },
    { bit: 16, word: "glare", colour: "#ff0", trusted: false },
  ];
  const bands = Array.from({ length: 4 }, (_, i) => ({
    label: String(i),
    wavelength: 400 + i,
    centroid: null,
    fwhm: null,
  }));
  const say = (flags: number[]): string =>
    describeDoubts({ bands }, { flags: Uint8Array.from(flags) }, marks);
  expect(say([0, 8, 0, 0])).toBe("");
  expect(say([2, 2, 0, 0])).toBe("2 of 4 bands are saturated here.");
  expect(say([2, 18, 0, 0])).toBe("2 of 4 bands are saturated, 1 shows glare here.");
});

test("each colour of a curve has dashes of its own, and a reference in grey another", () => {
  const colours = Array.from({ length: 8 }, (_, i) => `var(--curve-${i + 1})`);
  expect(new Set([...colours, "#777"].map(dashOf)).size).toBe(9);
});
