// Names that people give to places, regions and measures.

export const LONGEST_NAME = 60;

/** The first of "Length 1", "Length 2" … that is not taken. */
export function freeName(taken: { name: string }[], word: string): string {
  const names = new Set(taken.map(({ name }) => name));
  let number = 1;
  while (names.has(`${word} ${number}`)) number++;
  return `${word} ${number}`;
}
