// A spectrum from elsewhere, such as that of a pigment, to lay over measured ones.

/** A spectrum over wavelength, nm, in ascending order; reflectance, 1 is white. */
export interface Reference {
  name: string;
  nm: number[];
  values: number[];
}

/** Part of a spectrum that was measured: where, what, and whether it is to be trusted. */
export interface Sample {
  nm: number;
  value: number;
  doubts: unknown[];
}

const MOST_LINES = 100_000;
const LEAST_ROWS = 3;
const LEAST_ANGLE_BANDS = 3;

/**
 * Read two columns of numbers, wavelength in nm and reflectance; other lines are passed over.
 *
 * Columns are apart by commas, semicolons, tabs or spaces; a comma is the decimal point where
 * semicolons or tabs are there. Values of which one is above 2 are taken as per cent.
 */
export function parseReference(name: string, text: string): Reference {
  const rows = text
    .split(/\r\n|\n|\r/, MOST_LINES)
    .map(parseRow)
    .filter((row) => row !== null)
    .sort(([a], [b]) => a - b)
    .filter(([nm], i, all) => i === 0 || nm > all[i - 1]![0]);
  if (rows.length < LEAST_ROWS)
    throw new Error(
      `${name} has no spectrum: two columns of numbers were expected, wavelength in nm and reflectance, in at least ${LEAST_ROWS} lines.`,
    );
  const percent = rows.some(([, value]) => value > 2);
  return {
    name,
    nm: rows.map(([nm]) => nm),
    values: rows.map(([, value]) => (percent ? value / 100 : value)),
  };
}

function parseRow(line: string): [number, number] | null {
  const european = /[;\t]/.test(line);
  const cells = line.trim().split(european ? /\s*[;\t]\s*/ : /[\s,]+/);
  const numbers = cells.slice(0, 2).map((cell) => {
    const plain = cell.replaceAll('"', "").trim();
    return plain ? Number(european ? plain.replace(",", ".") : plain) : NaN;
  });
  const [nm, value] = numbers;
  const sound = numbers.length === 2 && numbers.every(Number.isFinite) && nm! > 0 && nm! < 1e5;
  return sound ? [nm!, value!] : null;
}

/** Interpolate a reference between its wavelengths; NaN beyond them. */
export function valueAt({ nm, values }: Reference, at: number): number {
  const after = nm.findIndex((one) => one >= at);
  if (after < 0 || (after === 0 && nm[0] !== at)) return NaN;
  if (nm[after] === at) return values[after]!;
  const part = (at - nm[after - 1]!) / (nm[after]! - nm[after - 1]!);
  return values[after - 1]! + part * (values[after]! - values[after - 1]!);
}

/**
 * Return the spectral angle of samples to a reference, degrees, over bands that both have and that are
 * to be trusted; null for fewer than three (Kruse et al. 1993, 10.1016/0034-4257(93)90013-N).
 */
export function spectralAngle(samples: Sample[], reference: Reference): number | null {
  let [both, own, other, count] = [0, 0, 0, 0];
  for (const { nm, value, doubts } of samples) {
    const expected = valueAt(reference, nm);
    if (doubts.length || !Number.isFinite(expected)) continue;
    both += value * expected;
    own += value * value;
    other += expected * expected;
    count++;
  }
  if (count < LEAST_ANGLE_BANDS || own === 0 || other === 0) return null;
  return (Math.acos(Math.min(1, both / Math.sqrt(own * other))) * 180) / Math.PI;
}
