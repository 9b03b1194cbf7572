import { expect, test } from "vitest";
import { angleFacts, angleKey, anglePicture, fillAngles, paint } from "../src/viewer/angle";
import type { Layer } from "../src/viewer/record";

const SOUND = Array.from({ length: 256 }, (_, bits) => bits === 0);

function tile(spectra: number[][], flags: number[][]) {
  const bands = spectra[0]!.length;
  const planes = <T>(rows: T[][]): T[] =>
    Array.from({ length: bands }, (_, band) => rows.map((row) => row[band]!)).flat();
  return {
    columns: spectra.length,
    rows: 1,
    values: Float32Array.from(planes(spectra)),
    sigma: null,
    flags: Uint8Array.from(planes(flags)),
  };
}

test("angles are those of the spectra, whatever their length; a flag in a needed band gives none", () => {
  const values = Float32Array.from([1, 0, 0, 9]);
  const spectra = [
    [3, 0, 0, 1],
    [1, 1, 0, 2],
    [0, 0, 2, 3],
    [-1, 0, 0, 4],
    [0, 0, 0, 5],
    [1, 0, 0, 6],
    [1, 0, 0, 7],
  ];
  const flags = spectra.map((_, i) => [i === 5 ? 2 : 0, 0, 0, i === 6 ? 2 : 0]);
  const angles = new Float32Array(9 * 3).fill(-1);
  fillAngles(angles, 9, [tile(spectra, flags), 1, 1], { bands: [0, 1, 2], values, sound: SOUND });
  const row = [...angles.slice(10, 17)];
  expect(row.slice(0, 4).map((angle) => Math.round(angle * 100) / 100)).toEqual([0, 45, 90, 180]);
  expect(row[4]).toBeNaN(); // no length, no angle
  expect(row[5]).toBeNaN();
  expect(row[6]).toBeCloseTo(0); // the fourth band is not needed
  expect([angles[9], angles[17], angles[0]]).toEqual([-1, -1, -1]);
});

test("alike is light, unlike dark, and what is not to be trusted grey", () => {
  const pixels = paint(Float32Array.from([0, 10, 90, NaN]), 10);
  const colours = [0, 1, 2, 3].map((i) => [...pixels.slice(4 * i, 4 * i + 4)]);
  expect(colours).toEqual([
    [250, 236, 190, 255],
    [20, 17, 15, 255],
    [20, 17, 15, 255],
    [128, 128, 128, 255],
  ]);
});

test("the key holds place and scale; nonsense is no picture", () => {
  expect(angleFacts(angleKey([12.4, 7.6], 20))).toEqual({ place: [12, 8], range: 20 });
  const nonsense = ["angle-1-2-3", "angle--1-2-10", "angle-1-2", "band-1", "angle-1-2-10x"];
  expect(nonsense.map(angleFacts)).toEqual(nonsense.map(() => null));
  const spectra = { bands: 3, width: 20, height: 10 };
  const layer = { pictures: [{ key: "colour" }], spectra } as unknown as Layer;
  expect(anglePicture(layer, "angle-19-9-5")?.label).toContain("not an identification");
  expect(anglePicture(layer, "angle-20-9-5")).toBeUndefined();
  for (const change of [{ bands: 2 }, { width: 1e5, height: 1e5 }])
    expect(
      anglePicture({ ...layer, spectra: { ...layer.spectra!, ...change } }, "angle-1-1-5"),
    ).toBeUndefined();
});
