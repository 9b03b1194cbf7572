import { expect, test } from "vitest";
import { describeArea, describeLength } from "../src/viewer/measures";
import {
  areaOf,
  boundsOf,
  contains,
  fromText,
  KINDS,
  lengthOf,
  toText,
  type Region,
} from "../src/viewer/shapes";

const region = (kind: Region["kind"], ...points: Region["points"]): Region => ({
  name: "a",
  kind,
  points,
});

function count(one: Region, size: number): number {
  const inside = contains(one);
  let n = 0;
  for (let y = 0; y < size; y++) for (let x = 0; x < size; x++) n += Number(inside(x, y));
  return n;
}

test("a rectangle has the pixels of both corners, whichever way it was drawn", () => {
  expect(count(region("rectangle", [2, 3], [5, 4]), 20)).toBe(8);
  expect(count(region("rectangle", [5.4, 4.2], [1.6, 2.9]), 20)).toBe(8);
});

test("a circle and a polygon have the pixels whose centres lie within", () => {
  expect(count(region("circle", [10, 10], [12, 10]), 20)).toBe(13);
  expect(count(region("polygon", [-0.5, -0.5], [9.6, -0.5], [-0.5, 9.6]), 20)).toBe(55);
  expect(boundsOf(region("circle", [10, 10], [10, 13]))).toEqual([7, 7, 13, 13]);
});

test("addresses hold regions, and nothing else is taken for one", () => {
  const one = region("polygon", [1, 2], [3, 4.5], [0, 9]);
  one.name = "sky; upper";
  expect(fromText(toText(one), KINDS, 60)).toEqual(one);
  const wrong = ["", "circle;1 2;a", "polygon;1 2 3 4;a", "star;1 2 3 4;a", "circle;1 2 3 x;a"];
  for (const text of wrong) expect(fromText(text, KINDS, 60)).toBeNull();
  expect(fromText(`polygon;${"1 2 ".repeat(5000)}1 2;a`, KINDS, 60)).toBeNull();
});

test("lengths and areas are those of geometry, a rectangle's of its whole pixels", () => {
  expect(
    lengthOf({
      kind: "line",
      points: [
        [0, 0],
        [3, 4],
        [3, 14],
      ],
    }),
  ).toBe(15);
  expect(areaOf(region("rectangle", [2, 3], [5, 4]))).toBe(8);
  expect(lengthOf(region("rectangle", [2, 3], [5, 4]))).toBe(12);
  expect(areaOf(region("circle", [10, 10], [12, 10]))).toBeCloseTo(4 * Math.PI);
  expect(areaOf(region("polygon", [0, 0], [10, 0], [10, 10], [0, 10]))).toBe(100);
  expect(areaOf(region("polygon", [0, 0], [0, 10], [10, 10], [10, 0]))).toBe(100);
  expect(
    areaOf({
      kind: "line",
      points: [
        [0, 0],
        [3, 4],
        [9, 9],
      ],
    }),
  ).toBe(0);
});

test("lengths and areas have units that fit, and pixels where no scale is known", () => {
  expect(describeLength(125, 1.25)).toBe("100 mm");
  expect(describeLength(0.5, 4)).toBe("0.125 mm");
  expect(describeLength(12_345.678, 10)).toBe("1.235 m");
  expect(describeLength(12.34567, null)).toBe("12.35 px");
  expect(describeArea(100, 1.25)).toBe("64 mm²");
  expect(describeArea(2_500_000, 5)).toBe("1000 cm²");
  expect(describeArea(1000, null)).toBe("1000 px²");
});

test("addresses of measures hold lines, which are no regions", () => {
  const text = "line;1.0 2.0 3.0 4.5;edge";
  expect(fromText(text, ["line", ...KINDS], 60)).toEqual({
    name: "edge",
    kind: "line",
    points: [
      [1, 2],
      [3, 4.5],
    ],
  });
  expect(fromText(text, KINDS, 60)).toBeNull();
});
