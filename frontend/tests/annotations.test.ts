import { expect, test } from "vitest";
import {
  newId,
  NotesRefused,
  plainText,
  readNotes,
  writeNotes,
  type Ground,
  type Note,
} from "../src/viewer/annotations";
import type { Shape } from "../src/viewer/shapes";

const canvas = {
  id: "https://example.org/iiif/icon%201/canvas",
  manifest: "https://example.org/iiif/icon%201/manifest.json",
  width: 400,
  height: 300,
};
const full: Ground = { canvas, size: [400, 300] };
const medium: Ground = { canvas, size: [200, 150] };

const note = (shape: Shape): Note => ({
  id: newId(),
  shape,
  text: "a < b & c",
  author: "Ada",
  made: "2026-11-23T15:00:00Z",
});
const SHAPES: Shape[] = [
  { kind: "place", points: [[30, 40]] },
  {
    kind: "rectangle",
    points: [
      [10, 20],
      [30, 25],
    ],
  },
  {
    kind: "circle",
    points: [
      [50.5, 60.5],
      [60.5, 60.5],
    ],
  },
  {
    kind: "polygon",
    points: [
      [-0.5, -0.5],
      [100.3, 20.1],
      [399.5, 299.5],
    ],
  },
];

test.each(SHAPES)("a $kind comes back as it was written", (shape) => {
  const [back] = readNotes(writeNotes([note(shape)], full), full);
  expect(back).toMatchObject({ text: "a < b & c", author: "Ada", made: "2026-11-23T15:00:00Z" });
  expect(back!.shape.kind).toBe(shape.kind);
  back!.shape.points.forEach((point, i) => {
    expect(Math.hypot(point[0] - shape.points[i]![0], point[1] - shape.points[i]![1])).toBeLessThan(
      0.15,
    );
  });
});

test("a note on a smaller canvas lies on the same part of the larger one", () => {
  const rectangle: Shape = {
    kind: "rectangle",
    points: [
      [10, 20],
      [19, 29],
    ],
  };
  const text = writeNotes([note(rectangle)], medium);
  expect(text).toContain("xywh=20,40,20,20");
  expect(readNotes(text, full)[0]!.shape.points).toEqual([
    [20, 40],
    [39, 59],
  ]);
  expect(readNotes(text, medium)[0]!.shape.points).toEqual([
    [10, 20],
    [19, 29],
  ]);
});

test("notes of another object, and what is no note, are refused with the place and a sentence", () => {
  const text = writeNotes([note(SHAPES[0]!)], full);
  const other = { ...full, canvas: { ...canvas, id: "https://example.org/iiif/b/canvas" } };
  expect(() => readNotes(text, other)).toThrow(/items\[0\]\.target\.source: it is not the canvas/);
  expect(() => readNotes(text.replace('"Ada"', '"<b>"'), full)).toThrow(NotesRefused);
  expect(() => readNotes("[".repeat(1e5), full)).toThrow(/nested deeper/);
});

test("what is typed becomes plain text", () => {
  const typed = "a<b\u0000 <b>1 < 2</b>\n<!--";
  const plain = "a<b <b>1 < 2</b>\n<!--";
  expect(plainText(typed)).toBe(plain);
  const file = writeNotes([{ ...note(SHAPES[0]!), text: plain, author: "<i>" }], full);
  expect(file).not.toMatch(/<[a-z/!?]/i);
  expect(readNotes(file, full)[0]).toMatchObject({ text: plain, author: "<i>" });
  expect(plainText("<a".repeat(2000)).length).toBeLessThan(2700);
  expect(newId()).toMatch(
    /^urn:uuid:[0-9a-f]{8}-[0-9a-f]{4}-4[0-9a-f]{3}-[89ab][0-9a-f]{3}-[0-9a-f]{12}$/,
  );
});
