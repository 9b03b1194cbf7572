import { expect, test } from "vitest";
import { interpolate } from "../src/viewer/lattice";
import { invert, mapOf, turnAndScale, type PlaneMap } from "../src/workbench/maps";

const TURN = 0.1;
const turned: PlaneMap = (x, y) => [
  2 * (Math.cos(TURN) * x - Math.sin(TURN) * y) + 30,
  2 * (Math.sin(TURN) * x + Math.cos(TURN) * y) - 10,
];
const bent: PlaneMap = (x, y) => [x + 1e-4 * x * y + 5, y - 2e-4 * x * x + 1];

test("a map is inverted", () => {
  for (const map of [turned, bent])
    for (const [x, y] of [
      [0, 0],
      [200, 100],
      [-50, 300],
    ] as const) {
      const found = invert(map, map(x, y), [10, 10]);
      expect(found[0]).toBeCloseTo(x, 3);
      expect(found[1]).toBeCloseTo(y, 3);
    }
});

test("a map that leads nowhere gives the guess", () => {
  expect(invert(() => [1, 1], [5, 5], [3, 4])).toEqual([3, 4]);
});

test("turn, scale and mirroring are read from a map", () => {
  const { degrees, scale, mirrored } = turnAndScale(turned, 40, 50);
  expect(degrees).toBeCloseTo((TURN * 180) / Math.PI, 9);
  expect(scale).toBeCloseTo(2, 9);
  expect(mirrored).toBe(false);
  expect(turnAndScale((x, y) => [-x, y], 0, 0).mirrored).toBe(true);
});

test("a polynomial is of centred and scaled places", () => {
  // Terms 1, u and v, each with its two coefficients; u², uv and v² of the second order.
  const linear = { order: 1, centre: [10, 20] as [number, number], spread: 10 };
  expect(mapOf({ ...linear, terms: [3, 4, 10, 0, 0, 10] })(12, 24)).toEqual([5, 8]);
  const bent = { ...linear, order: 2, terms: [0, 0, 0, 0, 0, 0, 1, 0, 0, 1, 2, 0] };
  expect(mapOf(bent)(30, 50)).toEqual([2 ** 2 + 2 * 3 ** 2, 2 * 3]);
});

test("a lattice of cubic samples gives an affine map exactly, its edge too", () => {
  const [step, columns, rows] = [16, 7, 6];
  const table = new Float32Array(2 * columns * rows);
  const truth = (x: number, y: number): [number, number] => [0.5 * x + 3, 0.25 * y - 0.125 * x];
  for (let row = 0; row < rows; row++)
    for (let column = 0; column < columns; column++)
      table.set(truth((column - 1) * step, (row - 1) * step), 2 * (row * columns + column));
  for (const [x, y] of [
    [0, 0],
    [17.25, 33.5],
    [63, 47],
    [-4, 50],
  ] as const) {
    const [u, v] = interpolate(table, [x, y], { step, columns, rows });
    expect(u).toBeCloseTo(truth(x, y)[0], 5);
    expect(v).toBeCloseTo(truth(x, y)[1], 5);
  }
});
