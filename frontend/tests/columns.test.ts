import { expect, test } from "vitest";
import { readColumns, readSession } from "../src/workbench/columns";

/** Bytes as levkas.workbench.answer.to_bytes lays them out. */
function pack(answer: object, columns: ArrayBufferView<ArrayBuffer>[]): ArrayBuffer {
  let text = JSON.stringify(answer);
  text += " ".repeat((8 - ((4 + text.length) % 8)) % 8);
  const padded = columns.map(({ byteLength }) => Math.ceil(byteLength / 8) * 8);
  const body = new Uint8Array(4 + text.length + padded.reduce((a, b) => a + b, 0));
  new DataView(body.buffer).setUint32(0, text.length, true);
  body.set(new TextEncoder().encode(text), 4);
  let at = 4 + text.length;
  columns.forEach(({ buffer, byteOffset, byteLength }, i) => {
    body.set(new Uint8Array(buffer, byteOffset, byteLength), at);
    at += padded[i]!;
  });
  return body.buffer;
}

const words = (list: string[], at: number) => ({
  words: list,
  codes: { kind: "u1", shape: [2], at },
});

test("columns come as they stand in memory", () => {
  const answer = { a: { kind: "f4", shape: [2], at: 0 }, b: { kind: "i4", shape: [1], at: 8 } };
  const body = pack(answer, [new Float32Array([1.5, NaN]), new Int32Array([-7])]);
  expect(readColumns(body)).toEqual({
    a: new Float32Array([1.5, NaN]),
    b: new Int32Array([-7]),
  });
});

test("a session has its pairs in fours and its words spelled", () => {
  const pairs = new Float64Array([1, 2, 3, 4, 5, 6, 7, 8]);
  const codes = new Uint8Array([0, 1]);
  const answer = {
    version: 3,
    pairs: { kind: "f8", shape: [2, 4], at: 0 },
    state: words(["kept", "removed"], 64),
    hand: words(["", "deleted"], 72),
    reason: words(["", "deleted by hand"], 80),
  };
  const session = readSession(pack(answer, [pairs, codes, codes, codes]), []);
  expect(session.pairs).toEqual([
    [1, 2, 3, 4],
    [5, 6, 7, 8],
  ]);
  expect(session.state).toEqual(["kept", "removed"]);
  expect(session.hand).toEqual(["", "deleted"]);
  expect(session.version).toBe(3);
});

test("pairs that are not sent again are those of before", () => {
  const one = { words: [], codes: { kind: "u1", shape: [0], at: 0 } };
  const answer = { pairs: null, state: one, hand: one, reason: one };
  const before: [number, number, number, number][] = [[1, 2, 3, 4]];
  expect(readSession(pack(answer, []), before).pairs).toBe(before);
});
