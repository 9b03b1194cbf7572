import { expect, test } from "vitest";
import { isSafeAddress } from "../src/shared/element";
import { beyond } from "../src/shared/curtain";
import { restore } from "../src/viewer/spectra";
import { confirms, enlargement, quantile, windowsTable } from "../src/workbench/basis";
import { thinned } from "../src/workbench/thinning";
import { placeTurned } from "../src/workbench/figure";
import { placesOf, tilesAround } from "../src/workbench/loupe";
import { cornerAt, sideAt } from "../src/workbench/outline";
import type { PlaneMap } from "../src/workbench/maps";
import {
  isMarked,
  type Filter,
  type Pair,
  type SessionState,
  type Windows,
} from "../src/workbench/record";
import { rowAt } from "../src/workbench/store";
import { latestOnly } from "../src/workbench/threshold";
import { roundsTable, rowsAt } from "../src/workbench/trace";

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

test("a round rests on what was not cut, removed before, deleted or a check point", () => {
  const session = {
    pairs: Array<Pair>(6).fill([0, 0, 0, 0]),
    state: ["kept", "kept", "removed", "removed", "check", "removed"],
    hand: ["", "pinned", "", "", "", "deleted"],
    round: new Int32Array([-1, -1, 0, 1, -1, -1]),
    trace: { removed: new Int32Array([3, -1]) },
  } as unknown as SessionState;
  expect(rowsAt(session, -1)).toEqual([0, 1, 2, 3]);
  expect(rowsAt(session, 0)).toEqual([0, 1, 3]);
  expect(rowsAt(session, 1)).toEqual([0, 1]);
});

test("shifts of windows are enlarged by a round number, and only windows in their place confirm", () => {
  const columns = { shift_x: [0.01, 0.02, 0.03, 0.04], shift_y: [0, 0, 0, 0] };
  expect(enlargement(columns as unknown as Windows, 10)).toBe(200);
  expect(quantile([3, null, 1, 2], 0.5)).toBe(2);
  const checks = { x: [0, 1, 2], y: [0, 0, 0], shift_x: [0, 3, 0], shift_y: [1.9, 0, 0] };
  const all = { ...checks, found: [true, true, false], tolerance: 1 };
  expect([0, 1, 2].map((row) => confirms(all, row))).toEqual([true, false, false]);
});

test("of values that come while one is on its way only the last is sent", async () => {
  const sent: number[] = [];
  const answers: (() => void)[] = [];
  const send = latestOnly((value) => {
    sent.push(value);
    return new Promise((resolve) => answers.push(resolve));
  });
  for (const value of [1, 2, 3]) send(value);
  expect(sent).toEqual([1]);
  answers[0]!();
  await new Promise((resolve) => setTimeout(resolve));
  expect(sent).toEqual([1, 3]);
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
  const map: PlaneMap = (x, y) => [x + 5, y];
  const pair: Pair = [10, 20, 30, 40];
  const places = { pair, pointer: null, follows: false, begun: null, map } as const;
  expect(placesOf(places)).toEqual([
    [10, 20],
    [30, 40],
  ]);
  const over = { half: 2 as const, at: [7, 8] as [number, number] };
  expect(placesOf({ ...places, pointer: over })[1]).toEqual([30, 40]);
  expect(placesOf({ ...places, pointer: over, begun: 0 })).toEqual([
    [10, 20],
    [7, 8],
  ]);
  expect(placesOf({ ...places, pair: null, pointer: over, follows: true })).toEqual([
    [12, 8],
    [7, 8],
  ]);
  const here = { half: 0 as const, at: [12, 8] as [number, number] };
  const [, there] = placesOf({ ...places, pair: null, pointer: here, follows: true });
  expect(there).toEqual([expect.closeTo(7, 6), expect.closeTo(8, 6)]);
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

test("a frame that is turned by a quarter lies on its side in the middle", () => {
  const { place, direction, scale } = placeTurned([200, 100], 90, [300, 300], 0);
  expect(scale).toBe(1.5);
  const round = ([x, y]: [number, number]): number[] => [Math.round(x), Math.round(y)];
  expect([place(0, 0), place(200, 0), place(0, 100)].map(round)).toEqual([
    [225, 0],
    [225, 300],
    [75, 0],
  ]);
  expect(round(direction(2, 0))).toEqual([0, 3]);
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

test("of many marks in one spot the worst is shown, until one zooms in, and all of a hand", () => {
  const session = {
    pairs: [0, 1, 2, 3, 400].map((x) => [x, 5, x, 5]),
    residual: new Float32Array([0.2, 0.9, 0.1, 0.1, 0.1]),
    state: ["kept", "kept", "kept", "check", "kept"],
    hand: ["", "", "added", "checks", ""],
  } as unknown as SessionState;
  const far = thinned(session, "kept", 1);
  expect([[...far.shown], far.count, far.all]).toEqual([[0, 1, 1, 1, 1], 4, 5]);
  expect(thinned(session, "kept", 64).count).toBe(5);
});

test("rounds and windows are saved as tables", () => {
  const trace = { largest: new Float32Array([4, 2.5]), removed: new Int32Array([2, -1]) };
  const session = { trace, number: new Int32Array([1, 2, 7]) } as unknown as SessionState;
  expect(roundsTable(session)).toBe("round,largest_error_px,removed_pair\n1,4.000,7\n2,2.500,\n");
  const column = [1, 2];
  const shifts = { x: column, y: column, shift_x: [0.1, 0.2], shift_y: column, weight: column };
  const windows = { ...shifts, sigma: [null, 0.02], held_out: [0.5, null] };
  expect(windowsTable(windows).split("\n").slice(0, 3)).toEqual([
    "x,y,shift_x,shift_y,sigma,held_out,weight",
    "1,1,0.1,1,,0.5,1",
    "2,2,0.2,2,0.02,,2",
  ]);
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
