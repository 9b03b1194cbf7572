// The order of the rows of a table.
/** Rows by their values; those that are not known come last, equal ones by their numbers. */
export function sortRows(
  rows: readonly number[],
  values: readonly (number | null)[] | readonly string[],
  down: boolean,
): number[] {
  const sign = down ? -1 : 1;
  const ranks = isWords(values) ? rank(values) : values;
  return [...rows].sort((a, b) => {
    const [x, y] = [ranks[a] ?? NaN, ranks[b] ?? NaN];
    if (x !== x || y !== y) return Number(x !== x) - Number(y !== y) || a - b;
    return sign * (x - y) || a - b;
  });
}

function isWords(
  values: readonly (number | null)[] | readonly string[],
): values is readonly string[] {
  return typeof values[0] === "string";
}

/** The place of each word among all that there are. */
function rank(words: readonly string[]): number[] {
  const places = new Map([...new Set(words)].sort().map((word, i) => [word, i]));
  return words.map((word) => places.get(word)!);
}
