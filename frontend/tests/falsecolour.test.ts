import { expect, test } from "vitest";
import { nearest, proposeThree } from "../src/shared/falsecolour";
import { bandNumber, mixKey, mixNumbers, pictureOf, proposeMix } from "../src/viewer/mixing";
import type { Layer, Picture } from "../src/viewer/record";

const picture = (key: string, kind: Picture["kind"]): Picture => ({
  key,
  label: key,
  kind,
  note: "",
  white: null,
  legend: null,
  folder: `layer/${key}`,
  width: 10,
  height: 8,
  tile: 256,
  overlap: 0,
  format: "png",
  least: 0,
  most: 1,
});

function layerOf(wavelengths: (number | null)[]): Layer {
  const bands = wavelengths.map((wavelength, i) => ({
    label: `${i}`,
    wavelength,
    centroid: null,
    fwhm: null,
  }));
  const pictures = wavelengths.map((_, i) => picture(`band-${i}`, "band"));
  return { bands, pictures: [picture("colour", "colour"), ...pictures] } as unknown as Layer;
}

test("infrared, red and green are proposed where the wavelengths are known", () => {
  expect(proposeThree([450, 550, 640, 700, 880, 1000])).toEqual([4, 2, 1]);
});

test("the last, the middle and the first band are proposed otherwise", () => {
  expect(proposeThree([450, null, 640, 700, 880])).toEqual([4, 2, 0]);
  expect(proposeThree([400, 410, 420])).toEqual([2, 1, 0]);
});

test("the nearest wavelength is found, the first of equals, none among unknown ones", () => {
  expect(nearest([500, 600, 700], 650)).toBe(1);
  expect(nearest([null, 600, null], 900)).toBe(1);
  expect(nearest([null, null], 900)).toBe(-1);
});

test("a key says which bands are mixed", () => {
  expect(mixKey([10, 5, 3])).toBe("mix-10-5-3");
  expect(mixNumbers("mix-10-5-3")).toEqual([10, 5, 3]);
  for (const key of ["band-3", "mix-1-2", "mix-1-2-3-4", "mix-a-b-c"])
    expect(mixNumbers(key)).toBeNull();
  expect(bandNumber(picture("band-12", "band"))).toBe(12);
});

test("a layer mixes its bands, and none that it does not have", () => {
  const layer = layerOf([450, 550, 640, 900]);
  expect(proposeMix(layer)).toBe("mix-3-2-1");
  const mixed = pictureOf(layer, "mix-3-2-1");
  expect(mixed?.kind).toBe("mix");
  expect(mixed?.mixed?.map(({ key }) => key)).toEqual(["band-3", "band-2", "band-1"]);
  expect(pictureOf(layer, "mix-3-2-9")).toBeUndefined();
  expect(pictureOf(layer, "colour")?.kind).toBe("colour");
  expect(proposeMix(layerOf([450, 550]))).toBeUndefined();
});
