// How sure numbers are: what pixels have alone and what they share, combined to first order (JCGM 100:2008, Eq. 13).
import type { Point } from "../shared/pane";
import type { Layer, PlaceFacts } from "./record";
import type { Spectrum } from "./spectra";

/** A mean of pixels: of each band, the sum of their squared sigmas and their number; within how many columns and rows. */
export interface Mean {
  values: ArrayLike<number>;
  noises: ArrayLike<number>;
  counts: ArrayLike<number>;
  size: [columns: number, rows: number];
  /** Slopes of the mean in x and in y, per px, and where on the grid its middle lies, from 0 to 1. */
  slopes?: Gradient | undefined;
}

/** Slopes in x and in y of every band, per px, at a place of the grid, from 0 to 1. */
export interface Gradient {
  x: ArrayLike<number>;
  y: ArrayLike<number>;
  at: Point;
}

/** Values, errors that move all bands by these coefficients, and variances that each band has alone. */
export interface Uncertain {
  values: number[];
  shared: number[][];
  alone: number[];
}

/** Factor of an expanded uncertainty. */
export const COVERAGE = 2;

type Known = Pick<Layer, "bands" | "budget">;

/** The mean of some pixels with its errors; null where the errors of the layer are not recorded. */
export function uncertain(layer: Known, mean: Mean): Uncertain | null {
  if (!layer.budget) return null;
  const { rows, correlation, place } = layer.budget;
  const values = layer.bands.map((_, i) => mean.values[i]!);
  const factor = neighbours(correlation, mean.size);
  const random = values.map((_, i) => (factor * mean.noises[i]!) / mean.counts[i]! ** 2);
  const alone = random.map((variance, i) => {
    const used = rows.reduce(
      (sum, { unit, size }) => sum + (unit === "sigma" ? size[i]! ** 2 : 0),
      0,
    );
    return variance * Math.max(0, 1 - used);
  });
  const shared: number[][] = [];
  const slopes = slopesOf(layer.bands, values);
  for (const row of rows) {
    const moves = values.map((value, i) => {
      const by =
        row.unit === "nm"
          ? slopes[i]!
          : row.unit === "sigma"
            ? Math.sqrt(row.pixel ? random[i]! : mean.noises[i]! / mean.counts[i]!)
            : moveBy(row.unit, value, row.zero?.[i] ?? 0);
      return (by * row.size[i]!) / Math.sqrt(row.line ? mean.size[1] : 1);
    });
    if (row.shared) shared.push(moves);
    else moves.forEach((move, i) => (alone[i]! += move * move));
  }
  if (place && mean.slopes) {
    const sigma = placeSigma(place, mean.slopes.at);
    for (const along of [mean.slopes.x, mean.slopes.y])
      shared.push(values.map((_, i) => sigma(i) * (along[i] || 0)));
  }
  return { values, shared, alone };
}

/** By how much an error of size 1 moves a value; one that is nil at a value has the other sign beyond it. */
function moveBy(unit: "relative" | "reflectance" | "counts", value: number, zero: number): number {
  if (unit === "relative") return zero > 0 ? value * (1 - value / zero) : value;
  return zero > 0 ? zero - value : 1;
}

/** How well the place of a band is known at a place of the grid, 0 to 1: linear between the places of its table. */
function placeSigma(
  { columns, rows, tables, of }: PlaceFacts,
  [x, y]: Point,
): (band: number) => number {
  const cell = (at: number, count: number): [first: number, share: number] => {
    const place = Math.min(1, Math.max(0, at)) * (count - 1);
    const first = Math.min(count - 2, Math.floor(place));
    return [first, place - first];
  };
  const [[column, u], [row, v]] = [cell(x, columns), cell(y, rows)];
  return (band) => {
    const table = tables[of[band]!];
    if (!table) return 0;
    const line = (at: number): number =>
      (1 - u) * table[at * columns + column]! + u * table[at * columns + column + 1]!;
    return (1 - v) * line(row) + v * line(row + 1);
  };
}

/** One pixel as a mean. */
export function meanOfPixel({
  values,
  sigma,
  slopes,
}: Pick<Spectrum, "values" | "sigma" | "slopes">): Mean {
  const noises = Array.from(values, (_, i) => (sigma ? sigma[i]! ** 2 : 0));
  return { values, noises, counts: noises.map(() => 1), size: [1, 1], slopes };
}

/** By how much more the variance of a mean is, as neighbours share noise: exact for rectangles of even noise. */
export function neighbours(correlation: number[][], [columns, rows]: Mean["size"]): number {
  const reach = correlation.length >> 1;
  const within = (lag: number, length: number): number => Math.max(0, 1 - Math.abs(lag) / length);
  const shares = correlation.flatMap((line, y) =>
    line.map((share, x) => share * within(y - reach, rows) * within(x - reach, columns)),
  );
  const total = shares.reduce((sum, share) => sum + share, 0);
  return Math.max(0, total);
}

/** Change of a spectrum with wavelength, 1/nm, of second order between neighbours; 0 where it is not known. */
export function slopesOf(bands: Known["bands"], values: number[]): number[] {
  const slopes = values.map(() => 0);
  const known = bands.flatMap(({ wavelength: nm }, band) =>
    nm !== null && Number.isFinite(values[band]) ? [{ nm, band, value: values[band]! }] : [],
  );
  known.sort((a, b) => a.nm - b.nm);
  const gap = (i: number): number => (known[i + 1]?.nm ?? NaN) - (known[i]?.nm ?? NaN);
  const rises = known.slice(1).map(({ value }, i) => (value - known[i]!.value) / gap(i));
  if (!rises.every(Number.isFinite)) return slopes;
  known.forEach(({ band }, i) => {
    const [before, after] = [rises[i - 1], rises[i]];
    const weight = gap(i) / (gap(i - 1) + gap(i));
    slopes[band] =
      before === undefined
        ? (after ?? 0)
        : after === undefined
          ? before
          : weight * before + (1 - weight) * after;
  });
  return slopes;
}

type Slopes = [band: number, slope: number][];

/** Standard uncertainty of a function of the bands, by its slope in each of some of them. */
export function sigmaOf({ shared, alone }: Uncertain, slopes: Slopes): number {
  const add = (sum: number, row: number[]): number =>
    sum + slopes.reduce((move, [i, slope]) => move + slope * row[i]!, 0) ** 2;
  const own = slopes.reduce((sum, [i, slope]) => sum + slope * slope * alone[i]!, 0);
  return Math.sqrt(shared.reduce(add, own));
}

/** Standard uncertainty of one band. */
export const uOf = (one: Uncertain, band: number): number => sigmaOf(one, [[band, 1]]);

export type Estimate = [value: number, u: number];

/** Ratio and difference of two bands, each with its standard uncertainty; what both share leaves the ratio. */
export function compare(
  one: Uncertain,
  a: number,
  b: number,
): [ratio: Estimate, difference: Estimate] {
  const [first, second] = [one.values[a]!, one.values[b]!];
  const slopes = (by: number, against: number): Slopes => [
    [a, by],
    [b, against],
  ];
  return [
    [first / second, sigmaOf(one, slopes(1 / second, -first / second ** 2))],
    [first - second, sigmaOf(one, slopes(1, -1))],
  ];
}
