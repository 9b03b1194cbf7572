import { expect, test } from "vitest";
import { across, upwards } from "../src/shared/plot";
import { niceTop, runs, ticks } from "../src/viewer/chart";
import { thinOut } from "../src/workbench/curve";

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

test("a line is cut at wide gaps", () => {
  const samples = [400, 480, 561, 600].map((nm) => ({ nm }));
  expect(runs(samples).map((run) => run.map(({ nm }) => nm))).toEqual([
    [400, 480],
    [561, 600],
  ]);
  expect(runs([])).toEqual([]);
});

test("thousands of values are thinned out to their largest, few are all kept", () => {
  expect(thinOut([3, 2, 1], 10)).toEqual([
    [0, 3],
    [1, 2],
    [2, 1],
  ]);
  const many = Array.from({ length: 1000 }, (_, i) => (i === 503 ? 99 : 1));
  const kept = thinOut(many, 100);
  expect(kept.length).toBeLessThanOrEqual(101);
  expect(Math.max(...kept.map(([, value]) => value))).toBe(99);
  expect(kept.at(-1)).toEqual([999, 1]);
});
