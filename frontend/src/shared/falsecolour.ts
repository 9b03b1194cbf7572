// Which three bands are proposed as red, green and blue.

const INFRARED_NM = [900, 650, 550]; // of false-colour infrared: red, green, blue

/**
 * Propose three of some bands as red, green and blue, by their places in the list.
 *
 * Near infrared, red and green by their wavelengths; the last, the middle and the first band where
 * a wavelength is not known, or where two of the three fall on one band.
 */
export function proposeThree(wavelengths: readonly (number | null)[]): [number, number, number] {
  const last = wavelengths.length - 1;
  const [red, green, blue] = INFRARED_NM.map((wanted) => nearest(wavelengths, wanted));
  const known = wavelengths.every((one) => one !== null);
  return known && new Set([red, green, blue]).size === 3
    ? [red!, green!, blue!]
    : [last, Math.floor(last / 2), 0];
}

/** The place of the wavelength nearest to `wanted`; the first of equals, -1 where none is known. */
export function nearest(wavelengths: readonly (number | null)[], wanted: number): number {
  let [best, at] = [Infinity, -1];
  wavelengths.forEach((one, i) => {
    const apart = one === null ? Infinity : Math.abs(one - wanted);
    if (apart < best) [best, at] = [apart, i];
  });
  return at;
}
