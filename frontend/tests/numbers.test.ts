import { expect, test } from "vitest";
import { quoted, shortest, toCsv } from "../src/viewer/numbers";
import { marksOf, type Layer } from "../src/viewer/record";
import { describeMillimetres, roundBelow } from "../src/viewer/scalebar";
import { errorColour, length, px, shareOf, type SessionState } from "../src/workbench/record";

test("the shortest number is the float32 again", () => {
  for (const value of [0.1, 1 / 3, 1e-7, 123456.789, 16777216, 0.30000001192092896]) {
    const text = shortest(Math.fround(value));
    expect(Math.fround(Number(text))).toBe(Math.fround(value));
  }
  expect(shortest(Math.fround(0.1))).toBe("0.1");
  expect(shortest(NaN)).toBe("nan");
});

test("a bit that the page does not name is not to be trusted", () => {
  const table = [
    { bit: 1, word: "outside", colour: "#000", trusted: false },
    { bit: 4, word: "replaced", colour: "#fff", trusted: true },
  ];
  expect(marksOf(5, table).map(({ word }) => word)).toEqual(["outside", "replaced"]);
  expect(marksOf(0, table)).toEqual([]);
  expect(marksOf(128, table).map(({ trusted }) => trusted)).toEqual([false]);
});

test("cells that begin like a formula are tamed, quotation marks doubled", () => {
  expect(quoted('a "b"')).toBe('"a ""b"""');
  expect(quoted("=HYPERLINK(1)")).toBe('"\'=HYPERLINK(1)"');
  expect(quoted("@x")).toBe('"\'@x"');
});

test("spectra are saved with a line a band", () => {
  const bands = [{ label: "a", wavelength: 500, centroid: null, fwhm: null }];
  const spectrum = { values: new Float32Array([0.25]), sigma: null, flags: new Uint8Array([4]) };
  const text = toCsv([3, 4], [{ layer: { name: "vis", bands } as unknown as Layer, spectrum }]);
  expect(text).toBe(
    'x,y,layer,band,wavelength_nm,value,sigma,flags,u,U\n3,4,"vis","a",500,0.25,,4,,\n',
  );
});

test("lengths of the scale bar are round", () => {
  expect([0.9, 1, 4.9, 5, 99, 100].map(roundBelow)).toEqual([0.5, 1, 2, 5, 50, 100]);
  expect([0.05, 0.5, 5, 50, 5000].map(describeMillimetres)).toEqual([
    "50 µm",
    "500 µm",
    "5 mm",
    "5 cm",
    "5 m",
  ]);
});

test("what is not known is a dash", () => {
  expect([px(1.234), px(NaN), px(null), px(undefined), px(2, 0)]).toEqual([
    "1.23",
    "–",
    "–",
    "–",
    "2",
  ]);
  expect(length(3, 10)).toBe("3.00 px · 0.30 mm");
  expect(length(0.3, 10)).toBe("0.30 px · 0.030 mm");
  expect(length(3, null)).toBe("3.00 px");
  expect(length(NaN, 10)).toBe("–");
});

test("errors are shares of what is tolerated, green to red", () => {
  const session: Partial<SessionState> = { residual: [0, 1, 8, null], stop: 2 };
  const shares = [0, 1, 2, 3].map((row) => shareOf(session as SessionState, row));
  expect(shares).toEqual([0, 0.5, 1, 0]);
  expect(errorColour(0, 2)).toContain("hsl(130");
  expect(errorColour(9, 2)).toContain("hsl(0");
  expect(errorColour(null, 2)).toBe("var(--soft)");
});
