// An answer of thousands of rows: a JSON text, and the columns that it names as they stand in memory.
import type { Numbers, Pair, Told } from "./record";

/** Where a column of the answer stands, and of what kind it is. */
interface Column {
  kind: keyof typeof KINDS;
  shape: number[];
  at: number;
}

interface Words {
  words: string[];
  codes: Numbers;
}

/** What the server tells, with its columns put in; pairs that are known already are not told again. */
type Answer = Omit<Told, "pairs" | "state" | "reason"> & { pairs: Numbers | null; state: Words; reason: Words };

const KINDS = { f4: Float32Array, f8: Float64Array, i4: Int32Array, u1: Uint8Array };

/** Read an answer; pairs that are not told again are those of `before`. */
export function read<T>(body: ArrayBuffer, before: Pair[]): Told & T {
  const told = columns(body) as Answer & T;
  return { ...told, pairs: told.pairs ? inFours(told.pairs) : before, state: spelled(told.state) as Told["state"], reason: spelled(told.reason) };
}

/** The length of a JSON text, the text, and the columns that it names, as they stand in memory. */
function columns(body: ArrayBuffer): unknown {
  const length = new DataView(body).getUint32(0, true);
  const text = new TextDecoder().decode(new Uint8Array(body, 4, length));
  return JSON.parse(text, (_, value: unknown) => (isColumn(value) ? new KINDS[value.kind](body, 4 + length + value.at, value.shape.reduce((a, b) => a * b, 1)) : value));
}

function isColumn(value: unknown): value is Column {
  return typeof value === "object" && value !== null && "kind" in value && "shape" in value && "at" in value;
}

function spelled({ words, codes }: Words): string[] {
  const made = new Array<string>(codes.length);
  for (let i = 0; i < codes.length; i++) made[i] = words[codes[i]!]!;
  return made;
}

function inFours(values: Numbers): Pair[] {
  const rows = new Array<Pair>(values.length / 4);
  for (let i = 0; i < rows.length; i++) rows[i] = [values[4 * i]!, values[4 * i + 1]!, values[4 * i + 2]!, values[4 * i + 3]!];
  return rows;
}
