// How sure numbers are: what pixels have alone and what they share, combined to first order (JCGM 100:2008, Eq. 13).
import type { Gradient, Layer, PlaceFacts, Spectrum } from "./record";

/** A mean of pixels: of each band, the sum of their squared sigmas and their number; within how many columns and rows. */
export interface Mean {
  values: ArrayLike<number>;
  noises: ArrayLike<number>;
  counts: ArrayLike<number>;
  size: [columns: number, rows: number];
  /** Slopes of the mean in x and in y, per px, and where on the grid its middle lies, from 0 to 1. */
  slopes?: Gradient | undefined;
}

/** Factor of an expanded uncertainty. */
export const COVERAGE = 2;

type Known = Pick<Layer, "bands" | "budget">;

/** Standard uncertainty of the mean of some pixels in each band; null where the errors of the layer are not recorded. */
export function uncertain(layer: Known, mean: Mean): number[] | null {
  if (!layer.budget) return null;
  const { rows, correlation, place } = layer.budget;
  const values = layer.bands.map((_, i) => mean.values[i]!);
  const factor = neighbours(correlation, mean.size);
  const slopes = slopesOf(layer.bands, values);
  const { x, y, at } = mean.slopes ?? { x: [], y: [], at: [0, 0] as const };
  const sigma = place && mean.slopes ? placeSigma(place, at) : () => 0;
  return values.map((value, i) => {
    const random = (factor * mean.noises[i]!) / mean.counts[i]! ** 2;
    let [variance, used] = [(sigma(i) * Math.hypot(x[i] ?? 0, y[i] ?? 0)) ** 2, 0];
    for (const { unit, size, zero, pixel, line } of rows) {
      if (unit === "sigma") used += size[i]! ** 2;
      const by =
        unit === "nm"
          ? slopes[i]!
          : unit === "sigma"
            ? Math.sqrt(pixel ? random : mean.noises[i]! / mean.counts[i]!)
            : moveBy(unit, value, zero?.[i] ?? 0);
      variance += (by * size[i]!) ** 2 / (line ? mean.size[1] : 1);
    }
    return Math.sqrt(variance + random * Math.max(0, 1 - used));
  });
}

/** By how much an error of size 1 moves a value; one that is nil at a value has the other sign beyond it. */
function moveBy(unit: "relative" | "reflectance" | "counts", value: number, zero: number): number {
  if (unit === "relative") return zero > 0 ? value * (1 - value / zero) : value;
  return zero > 0 ? zero - value : 1;
}

/** How well the place of a band is known at a place of the grid, 0 to 1: linear between the places of its table. */
function placeSigma(
  { columns, rows, tables, of }: PlaceFacts,
  [x, y]: readonly [number, number],
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
