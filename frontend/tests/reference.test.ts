import { expect, test } from "vitest";
import { parseReference, spectralAngle, valueAt } from "../src/viewer/reference";

const sample = (nm: number, value: number, doubts: unknown[] = []) => ({ nm, value, doubts });

test("two columns of numbers are read, whatever stands around them", () => {
  const plain = parseReference("a", "wavelength,reflectance\n400,0.1\n500,0.5\n450,0.2\n");
  expect(plain).toEqual({ name: "a", nm: [400, 450, 500], values: [0.1, 0.2, 0.5] });
  const european = parseReference("b", "nm;R\r\n400;10,5\r\n450;20\r\n500;50\r\n");
  expect(european.values).toEqual([0.105, 0.2, 0.5]);
  expect(parseReference("c", "400 0.1\n400 0.9\n500\t0.2\n600  0.3").nm).toEqual([400, 500, 600]);
});

test("a file without a spectrum is refused by name", () => {
  for (const text of [
    "",
    "hello\nworld",
    "400,0.1\n500,0.2",
    '{"a": 1}',
    "\0\0\0",
    "400;\n500;\n600;",
  ])
    expect(() => parseReference("x.csv", text)).toThrow("x.csv has no spectrum");
});

test("a reference is interpolated and not continued", () => {
  const one = { name: "a", nm: [400, 500], values: [0, 1] };
  expect([400, 425, 500].map((nm) => valueAt(one, nm))).toEqual([0, 0.25, 1]);
  expect([399, 501].map((nm) => valueAt(one, nm))).toEqual([NaN, NaN]);
});

test("the spectral angle is that of the shapes, over bands that are to be trusted", () => {
  const flat = { name: "flat", nm: [400, 700], values: [0.5, 0.5] };
  expect(spectralAngle([sample(400, 1), sample(500, 1), sample(600, 1)], flat)).toBeCloseTo(0, 5);
  // (1, 1, 0) and (1, 1, 1): the cosine is 2 / √6.
  const angle = spectralAngle([sample(400, 1), sample(500, 1), sample(600, 0)], flat);
  expect(angle).toBeCloseTo((Math.acos(2 / Math.sqrt(6)) * 180) / Math.PI, 6);
  const struck = [sample(400, 1), sample(500, 1), sample(600, 0, ["saturated"]), sample(700, 1)];
  expect(spectralAngle(struck, flat)).toBeCloseTo(0, 5);
  expect(spectralAngle([sample(400, 1), sample(500, 1), sample(900, 1)], flat)).toBeNull();
});
