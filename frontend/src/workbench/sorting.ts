// The order of the rows of a table.
import type { Numbers } from "./record";

/** Rows by their values; those that are not known come last, equal ones by their numbers. */
export function sortRows(
  rows: readonly number[],
  values: Numbers | readonly string[] | null,
  down: boolean,
): number[] {
  const sign = down ? -1 : 1;
  if (!values) return [...rows].sort((a, b) => sign * (a - b));
  const ranks = isWords(values) ? rank(values) : values;
  return [...rows].sort((a, b) => {
    const [x, y] = [ranks[a]!, ranks[b]!];
    if (x !== x || y !== y) return Number(x !== x) - Number(y !== y) || a - b;
    return sign * (x - y) || a - b;
  });
}

function isWords(values: Numbers | readonly string[]): values is readonly string[] {
  return Array.isArray(values);
}

/** The place of each word among all that there are. */
function rank(words: readonly string[]): Numbers {
  const places = new Map([...new Set(words)].sort().map((word, i) => [word, i]));
  return Float32Array.from(words, (word) => places.get(word)!);
}
