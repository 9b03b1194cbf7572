// An answer of thousands of rows: a JSON text, and the columns that it names as they stand in memory.
import type { Numbers, Pair, SessionState } from "./record";

const KINDS = { f4: Float32Array, f8: Float64Array, i4: Int32Array, u1: Uint8Array };

/** Where a column of the answer stands, and of what kind it is. */
interface Column {
  kind: keyof typeof KINDS;
  shape: number[];
  at: number;
}

/** Words, each once, and the number of each in its place. */
interface Words<T extends string> {
  words: T[];
  codes: Numbers;
}

type Spelled = "state" | "hand" | "reason";

/** A session as it comes; pairs that are known already are not sent again. */
type Answer = Omit<SessionState, "pairs" | Spelled> & { pairs: Numbers | null } & {
  [K in Spelled]: Words<SessionState[K][number]>;
};

/** Read a session, with whatever else `T` the answer has; pairs that were not sent are `before`. */
export function readSession<T = unknown>(body: ArrayBuffer, before: Pair[]): SessionState & T {
  const answer = readColumns(body) as Answer & T;
  return {
    ...answer,
    pairs: answer.pairs ? inFours(answer.pairs) : before,
    state: spell(answer.state),
    hand: spell(answer.hand),
    reason: spell(answer.reason),
  };
}

/** Read the length of a JSON text, the text, and the columns that it names, which stand behind it. */
export function readColumns(body: ArrayBuffer): unknown {
  const length = new DataView(body).getUint32(0, true);
  const text = new TextDecoder().decode(new Uint8Array(body, 4, length));
  return JSON.parse(text, (_, value: unknown) => {
    if (!isColumn(value)) return value;
    const count = value.shape.reduce((a, b) => a * b, 1);
    return new KINDS[value.kind](body, 4 + length + value.at, count);
  });
}

function isColumn(value: unknown): value is Column {
  return (
    typeof value === "object" &&
    value !== null &&
    "kind" in value &&
    "shape" in value &&
    "at" in value
  );
}

function spell<T extends string>({ words, codes }: Words<T>): T[] {
  return Array.from(codes, (code) => words[code]!);
}

function inFours(values: Numbers): Pair[] {
  const pairs = new Array<Pair>(values.length / 4);
  for (let i = 0; i < pairs.length; i++)
    pairs[i] = [values[4 * i]!, values[4 * i + 1]!, values[4 * i + 2]!, values[4 * i + 3]!];
  return pairs;
}
