import { expect, test } from "vitest";
import { isSafeAddress } from "../src/shared/element";
import { beyond } from "../src/shared/curtain";
import { restore } from "../src/viewer/spectra";
import { confirms, enlargement, quantile } from "../src/workbench/basis";
import { placesOf, tilesAround } from "../src/workbench/loupe";
import { cornerAt, sideAt } from "../src/workbench/outline";
import {
  isMarked,
  type Filter,
  type Pair,
  type SessionState,
  type Windows,
} from "../src/workbench/record";
import { rowAt } from "../src/workbench/store";

const PAIRS: Pair[] = [
  [10, 10, 20, 20],
  [10.01, 10, 20, 20.02],
  [50, 50, 60, 60],
];

test("a pair is found by its place, the nearest of those that were rounded", () => {
  expect(rowAt(PAIRS, [10.01, 10, 20, 20.01])).toBe(1);
  expect(rowAt(PAIRS, [10, 10, 20, 20])).toBe(0);
  expect(rowAt(PAIRS, [50, 50, 60, 60.04])).toBe(-1);
});

test("shifts of windows are enlarged by a round number, and only windows in their place confirm", () => {
  const columns = { shift_x: [0.01, 0.02, 0.03, 0.04], shift_y: [0, 0, 0, 0] };
  expect(enlargement(columns as unknown as Windows, 10)).toBe(200);
  expect(quantile([3, null, 1, 2], 0.5)).toBe(2);
  const checks = { x: [0, 1, 2], y: [0, 0, 0], shift_x: [0, 3, 0], shift_y: [1.9, 0, 0] };
  const all = { ...checks, found: [true, true, false], tolerance: 1 };
  expect([0, 1, 2].map((row) => confirms(all, row))).toEqual([true, false, false]);
});

test("differences along x and byte planes are undone", () => {
  // One band of one row, two-byte samples 0x0102, 0x0104, 0x0203: low bytes, then high bytes.
  const coded = new Uint8Array([9, 2, 2, 255, 1, 0, 1]);
  const block = { start: 1, columns: 3, rows: 1, bands: 1, octets: 2 };
  expect([...new Uint16Array(restore(coded, block).buffer)]).toEqual([0x0102, 0x0104, 0x0203]);
});

test("links lead to pages and mail, never into a script", () => {
  for (const address of ["a/b.html", "https://x.org", "mailto:a@b.c", "#top", "a:b".slice(2)])
    expect(isSafeAddress(address)).toBe(true);
  for (const address of ["javascript:alert(1)", " java\nscript:alert(1)", "data:text/html,x"])
    expect(isSafeAddress(address)).toBe(false);
});

test("loupes show the pair that is placed, and what is under the pointer where its other end is sought", () => {
  const pair: Pair = [10, 20, 30, 40];
  const over = { half: 2 as const, at: [7, 8] as [number, number] };
  const own = [
    [10, 20],
    [30, 40],
  ];
  expect(placesOf(pair, null, null)).toEqual(own);
  expect(placesOf(pair, over, null)).toEqual(own);
  expect(placesOf(pair, over, 2)).toEqual(own);
  expect(placesOf(pair, over, 0)).toEqual([own[0], [7, 8]]);
  expect(tilesAround([255.5, 0], 20, [600, 200])).toEqual([
    [0, 0],
    [1, 0],
  ]);
});

test("the part beyond an upright line on screen turns with the picture", () => {
  const parts = [0, 90, 180, 270].map((turn) => beyond([30, 40], turn, [100, 80]));
  expect(parts).toEqual([
    [30, 0, 70, 80],
    [0, 0, 100, 40],
    [0, 0, 30, 80],
    [0, 40, 100, 40],
  ]);
});

test("pictures show the pairs that the table lists, and all check points", () => {
  const session = {
    state: ["kept", "removed", "check", "removed"],
    hand: ["", "", "checks", "deleted"],
  } as unknown as SessionState;
  const shown = (filter: Filter): number[] =>
    [0, 1, 2, 3].filter((i) => isMarked(session, i, filter));
  expect(shown("kept")).toEqual([0, 2]);
  expect(shown("removed")).toEqual([1, 2, 3]);
  expect(shown("hand")).toEqual([2, 3]);
});

test("a place is at the nearest corner or side of an outline within reach, the side that closes it too", () => {
  const corners: [number, number][] = [
    [0, 0],
    [100, 0],
    [100, 80],
  ];
  expect(cornerAt(corners, [98, 3], 9)).toBe(1);
  expect(cornerAt(corners, [50, 3], 9)).toBe(-1);
  expect(sideAt(corners, [50, 3], 9)).toBe(0);
  expect(sideAt(corners, [103, 40], 9)).toBe(1);
  expect(sideAt(corners, [45, 41], 9)).toBe(2);
  expect(sideAt(corners, [45, 60], 9)).toBe(-1);
  expect(sideAt(corners, [45, 60], Infinity)).toBe(2);
});
