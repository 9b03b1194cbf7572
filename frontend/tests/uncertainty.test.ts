import { expect, test } from "vitest";
import { describeChannels, describeU, plusMinus, toCsv } from "../src/viewer/numbers";
import type { BudgetRow, Layer } from "../src/viewer/record";
import { meanOfPixel, neighbours, slopesOf, uncertain, type Mean } from "../src/viewer/uncertainty";

const band = (wavelength: number | null): Layer["bands"][number] => ({
  label: String(wavelength),
  wavelength,
  centroid: null,
  fwhm: null,
});
const row = (unit: BudgetRow["unit"], size: number[], { line = false } = {}): BudgetRow => ({
  unit,
  size,
  line,
});
const layer = (rows: BudgetRow[], nm: (number | null)[] = [500, 600], correlation = [[1]]): Layer =>
  ({ bands: nm.map(band), budget: { rows, unknown: ["stray light"], correlation } }) as Layer;
const mean = (values: number[], sigma: number, n: number, size: Mean["size"]): Mean => ({
  values,
  noises: values.map(() => n * sigma ** 2),
  counts: values.map(() => n),
  size,
});

const pixel = (values: number[], sigma: number[] | null): Parameters<typeof meanOfPixel>[0] => ({
  values: Float32Array.from(values),
  sigma: sigma && Float32Array.from(sigma),
});

// R = 0.495 with 0.0059 of its own; 0.0025 by the white and 0.0015 by the lamp: docs/explanation/how_sure.md.
const worked = [row("relative", [0.005 / 0.99]), row("relative", [0.003])];

test("a pixel has its noise and what is common; the mean of many keeps what is common", () => {
  const one = uncertain(layer(worked, [500]), meanOfPixel(pixel([0.495], [0.0059])))!;
  expect(one[0]!).toBeCloseTo(0.0066, 4);
  expect(plusMinus(0.495, one[0])).toBe("0.495\u00a0±\u00a00.013");
  const many = uncertain(layer(worked, [500]), mean([0.495], 0.0059, 10_000, [100, 100]))!;
  expect(many[0]!).toBeCloseTo(0.0029, 4);
  expect(plusMinus(0.495, many[0])).toBe("0.4950\u00a0±\u00a00.0058");
});

test("absolute errors do not grow with the value, and lines of a scan average", () => {
  const rows = [row("reflectance", [0.004], { line: true })];
  const one = uncertain(layer(rows, [500]), mean([0.9], 0, 400, [25, 16]))!;
  expect(one[0]!).toBeCloseTo(0.001, 9);
});

test("an error that is nil at a value does not move it, and its mate on the other side oppositely", () => {
  const bent: BudgetRow = { ...row("relative", [0.01, 0.01]), zero: [1, 1] };
  const curve = uncertain(layer([bent]), meanOfPixel(pixel([1, 0.5], null)))!;
  expect([curve[0]!, curve[1]!]).toEqual([0, 0.0025]);
  const stray: BudgetRow = { ...row("reflectance", [0.02, 0.02]), zero: [0.4, 0.4] };
  const light = uncertain(layer([stray]), meanOfPixel(pixel([0.9, 0.1], null)))!;
  // 0.02 · 0.5 downwards and 0.02 · 0.3 upwards.
  expect(light).toEqual([expect.closeTo(0.01, 8), expect.closeTo(0.006, 8)]);
});

test("an error of the wavelength moves a value by the slope of the spectrum", () => {
  const one = uncertain(layer([row("nm", [1, 1])]), meanOfPixel(pixel([0.2, 0.5], null)))!;
  expect(one[0]!).toBeCloseTo(0.003, 9);
  expect(slopesOf([400, 410, 430].map(band), [0, 1, 9])).toEqual([0.1, 0.2, 0.4]);
  // In any order of bands, and none where a band has no wavelength or no value.
  expect(slopesOf([600, 500, null].map(band), [0.5, 0.2, 1])[2]).toBe(0);
  expect(slopesOf([600, 500, 550].map(band), [0.5, 0.2, NaN])[1]).toBeCloseTo(0.003, 9);
  expect(slopesOf([500, 500].map(band), [0.5, 0.2])).toEqual([0, 0]);
});

test("neighbours that share noise make a mean less sure, a pixel alone not", () => {
  const share = [
    [0, 0.5, 0],
    [0.5, 1, 0.5],
    [0, 0.5, 0],
  ];
  expect(neighbours(share, [1, 1])).toBe(1);
  // Two pixels: (1 + 1 + 2 · 0.5)/2.
  expect(neighbours(share, [2, 1])).toBe(1.5);
  expect(neighbours(share, [1000, 1000])).toBeCloseTo(3, 2);
  const one = uncertain(layer([], [500], share), mean([0.5], 0.01, 2, [2, 1]))!;
  expect(one[0]!).toBeCloseTo(Math.sqrt(3) * 0.005, 9);
});

test("nothing is stated where the errors of a layer are not recorded", () => {
  const silent = { bands: [band(500)], name: "vis" } as unknown as Layer;
  expect(uncertain(silent, meanOfPixel(pixel([0.5], [0.01])))).toBeNull();
  expect(plusMinus(0.5, undefined)).toBe("0.5000");
  expect(plusMinus(NaN, 0.1)).toBe("–");
  expect(plusMinus(-0.05, 0.006)).toBe("−0.050\u00a0±\u00a00.012");
  expect(describeU(silent)).toContain("not recorded");
  expect(describeU(layer([]))).toMatch(/U with k.=.2 .*; not contained: stray light\.$/);
});

test("counts have no more digits than their uncertainty", () => {
  expect(plusMinus(2060.4, 61)).toBe("2060\u00a0±\u00a0122");
});

test("a pixel is saved with its standard and its expanded uncertainty", () => {
  const vis = { ...layer([row("relative", [0.02])], [500]), name: "vis" };
  const spectrum = { values: new Float32Array([0.5]), sigma: null, flags: null };
  expect(toCsv([3, 4], [{ layer: vis, spectrum }]).split("\n")[1]).toBe(
    '3,4,"vis","500",500,0.5,,,0.01,0.02',
  );
});

test("channels without a wavelength have their uncertainty in the line", () => {
  const spectrum = { values: new Float32Array([0.5]), sigma: null, flags: null };
  const rgb = layer([row("relative", [0.02])], [null]);
  expect(describeChannels(rgb, spectrum)).toBe("null 0.500\u00a0±\u00a00.020");
  const silent = { bands: [band(null)] } as unknown as Layer;
  expect(describeChannels(silent, spectrum)).toBe("null 0.500");
});

test("what a region has in common of sigma does not become smaller", () => {
  const rows = [row("sigma", [0.8, -0.8]), { ...row("sigma", [0.36, 0.36]), pixel: true }];
  const many = uncertain(layer(rows), mean([0.5, 0.25], 0.02, 10_000, [100, 100]))!;
  expect(many[0]!).toBeCloseTo(0.016, 4);
  const one = uncertain(layer(rows), meanOfPixel(pixel([0.5, 0.25], [0.02, 0.02])))!;
  expect(one[0]!).toBeCloseTo(0.02, 9);
});

test("a place that is known to some px makes a value on a slope uncertain", () => {
  const known = layer([]);
  known.budget!.place = { columns: 2, rows: 2, tables: [[0, 0.2, 0, 0.2]], of: [0, -1] };
  const slopes = { x: [0.03, 0.03], y: [0.04, 0.04], at: [0.5, 0.3] as [number, number] };
  const one = uncertain(known, { ...mean([0.5, 0.5], 0, 1, [1, 1]), slopes })!;
  expect(one[0]!).toBeCloseTo(0.1 * 0.05, 9);
  expect(one[1]!).toBe(0);
});
