import { expect, test } from "vitest";
import { sortRows } from "../src/workbench/sorting";

const ERRORS = new Float32Array([0.5, NaN, 2, 0.5, 0]);
const ALL = [0, 1, 2, 3, 4];

test("rows rise or fall by their values, unknown ones last and equal ones by number", () => {
  expect(sortRows(ALL, ERRORS, false)).toEqual([4, 0, 3, 2, 1]);
  expect(sortRows(ALL, ERRORS, true)).toEqual([2, 0, 3, 4, 1]);
});

test("words are sorted, and rows without values by their numbers", () => {
  expect(sortRows(ALL, ["b", "a", "b", "", "c"], false)).toEqual([3, 1, 0, 2, 4]);
  expect(sortRows([1, 3, 4], null, true)).toEqual([4, 3, 1]);
});

test("what is sorted stays as it was", () => {
  const rows = [4, 2];
  sortRows(rows, ERRORS, true);
  expect(rows).toEqual([4, 2]);
});

test("ten thousand rows are in order", () => {
  const values = Float32Array.from({ length: 10_000 }, (_, i) => (i * 7919) % 10_007);
  const order = sortRows([...values.keys()], values, true);
  const sorted = order.map((row) => values[row]!);
  expect(sorted).toEqual([...sorted].sort((a, b) => b - a));
});
