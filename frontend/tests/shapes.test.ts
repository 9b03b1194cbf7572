import { expect, test } from "vitest";
import { boundsOf, contains, fromText, toText, type Region } from "../src/viewer/shapes";

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
  expect(fromText(toText(one), 60)).toEqual(one);
  const wrong = ["", "circle;1 2;a", "polygon;1 2 3 4;a", "star;1 2 3 4;a", "circle;1 2 3 x;a"];
  for (const text of wrong) expect(fromText(text, 60)).toBeNull();
  expect(fromText(`polygon;${"1 2 ".repeat(5000)}1 2;a`, 60)).toBeNull();
});
