import { expect, test } from "vitest";
import type { Point } from "../src/shared/pane";
import { describeLength, fromText, toText } from "../src/viewer/kept";
import type { Layer, PageRecord } from "../src/viewer/record";
import { around, openSpectra } from "../src/viewer/spectra";
import type { Kept } from "../src/viewer/state";

const SIZE: Point = [100, 80];

test("what is kept goes through an address, its name too", () => {
  const kept: Kept[] = [
    { kind: "place", name: "a;b, c", points: [[3.25, 4]] },
    { kind: "rectangle", name: "sky", points: [[0, 1], [99, 79]] }, // prettier-ignore
    { kind: "length", name: "", points: [[1.5, 2.5], [3, 4]] }, // prettier-ignore
  ];
  expect(kept.map((one) => fromText(toText(one), SIZE))).toEqual(kept);
});

test("nonsense in an address is nothing", () => {
  for (const text of [
    ...["", "place", "place;1;a", "circle;1 2 3 4;a", "rectangle;1 2;a", "length;1 2 3;a"],
    ...["place;nan 1;a", "place;100 1;a", "rectangle;0 0 -1 5;a"],
  ])
    expect(fromText(text, SIZE)).toBeNull();
  expect(fromText(`place;1 2;${"x".repeat(99)}`, SIZE)?.name.length).toBe(60);
});

test("lengths are in px, mm or m", () => {
  expect([12.3456, 12000].map((px) => describeLength(px, 10))).toEqual(["1.235 mm", "1.2 m"]);
  expect(describeLength(12.3456, null)).toBe("12.35 px");
});

/** Spectra of one tile that stands in memory, a band a plane. */
function spectraOf(bands: number[][], columns: number, flags?: number[][]) {
  const rows = bands[0]!.length / columns;
  const facts = { columns, rows, width: columns, height: rows, bands: bands.length, folder: "" };
  const layer = { spectra: { ...facts, sigma: true, flags: true } } as unknown as Layer;
  const marks = [{ bit: 4, word: "replaced", colour: "", trusted: true }];
  const record = { layers: [layer], flags: marks } as unknown as PageRecord;
  const spectra = openSpectra(record).get(layer)!;
  const values = Float32Array.from(bands.flat());
  const tile = { columns, rows, values, sigma: values.map(() => 0.5) };
  const bits = Uint8Array.from(flags?.flat() ?? values.map(() => 0));
  Object.assign(spectra, { tile: () => Promise.resolve({ ...tile, flags: bits }) });
  return spectra;
}

test("the mean of a rectangle is of its sound pixels, with both corners", async () => {
  const plane = [1, 2, 3, 9, 4, 5, NaN, 9, 9, 9, 9, 9];
  const bits = [4, 0, 0, 0, 0, 2, 0, 0, 0, 0, 0, 0];
  const spectra = spectraOf([plane, plane.map((v) => 10 * v)], 4, [bits, plane.map(() => 0)]);
  const bounds = around([
    [2.2, 1.4],
    [0, 0.3],
  ]);
  expect(bounds).toEqual([0, 0, 2, 1]);
  const { values, spreads, counts, noises, size } = await spectra.mean(bounds);
  expect([counts, size]).toEqual([
    [4, 5],
    [3, 2],
  ]);
  expect(values).toEqual([2.5, 30]);
  expect(spreads[0]).toBeCloseTo(Math.sqrt(5 / 3), 12);
  expect(noises).toEqual([1, 1.25]);
  const none = await spectra.mean([2, 1, 2, 1]);
  expect([none.values[0], none.spreads[0], none.counts[0]]).toEqual([NaN, NaN, 0]);
});
