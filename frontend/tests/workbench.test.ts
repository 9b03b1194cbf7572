import { expect, test } from "vitest";
import { isSafeAddress } from "../src/shared/element";
import { restore } from "../src/viewer/spectra";
import { confirms, enlargement, quantile } from "../src/workbench/basis";
import type { Pair, SessionState, Windows } from "../src/workbench/record";
import { rowAt } from "../src/workbench/store";
import { latestOnly } from "../src/workbench/threshold";
import { rowsAt } from "../src/workbench/trace";

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
