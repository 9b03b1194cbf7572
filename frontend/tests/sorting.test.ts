import { expect, test } from "vitest";
import { sortRows } from "../src/workbench/sorting";

const ERRORS = [0.5, null, 2, 0.5, 0];
const ALL = [0, 1, 2, 3, 4];

test("rows rise or fall by their values, unknown ones last and equal ones by number", () => {
  expect(sortRows(ALL, ERRORS, false)).toEqual([4, 0, 3, 2, 1]);
  expect(sortRows(ALL, ERRORS, true)).toEqual([2, 0, 3, 4, 1]);
});

test("words are sorted", () => {
  expect(sortRows(ALL, ["b", "a", "b", "", "c"], false)).toEqual([3, 1, 0, 2, 4]);
});

test("what is sorted stays as it was", () => {
  const rows = [4, 2];
  sortRows(rows, ERRORS, true);
  expect(rows).toEqual([4, 2]);
});
