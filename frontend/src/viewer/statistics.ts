// Mean, standard deviation and number of sound pixels of a region, band by band; and histograms.
import { marksOf } from "./numbers";
import type { Mark } from "./record";
import { boundsOf, contains, type Region } from "./shapes";
import type { Spectra } from "./spectra";

export interface Statistics {
  /** All pixels of the region on the grid. */
  pixels: number;
  /** Sound pixels of each band. */
  counts: number[];
  means: number[];
  /** Standard deviations, n − 1 in the denominator; NaN of fewer than two. */
  spreads: number[];
}

export interface Histogram {
  low: number;
  high: number;
  counts: number[];
}

/** Whether a value with these flags counts: no bit but trusted ones; 256 answers. */
function soundness(marks: Mark[]): boolean[] {
  return Array.from({ length: 256 }, (_, bits) =>
    marksOf(bits, marks).every(({ trusted }) => trusted),
  );
}

/** The sound values of a region in some bands, tile by tile. */
async function visit(
  spectra: Spectra,
  region: Region,
  { bands, marks }: { bands: number[]; marks: Mark[] },
  take: (band: number, value: number) => void,
): Promise<number> {
  const [inside, sound] = [contains(region), soundness(marks)];
  let pixels = 0;
  for await (const tile of spectra.tilesWithin(boundsOf(region))) {
    const places: number[] = [];
    for (let row = 0; row < tile.rows; row++)
      for (let column = 0; column < tile.columns; column++)
        if (inside(tile.left + column, tile.top + row)) places.push(row * tile.columns + column);
    pixels += places.length;
    for (const band of bands) {
      const plane = band * tile.rows * tile.columns;
      for (const place of places) {
        const value = tile.values[plane + place]!;
        if (sound[tile.flags?.[plane + place] ?? 0] && Number.isFinite(value)) take(band, value);
      }
    }
  }
  return pixels;
}

/** Measure a region in every band. */
export async function measure(
  spectra: Spectra,
  region: Region,
  marks: Mark[],
): Promise<Statistics> {
  const bands = Array.from({ length: spectra.bands }, (_, band) => band);
  const [counts, means, squares] = [0, 1, 2].map(() => new Float64Array(bands.length)) as [
    Float64Array,
    Float64Array,
    Float64Array,
  ];
  // Welford (1962), 10.1080/00401706.1962.10490022.
  const pixels = await visit(spectra, region, { bands, marks }, (band, value) => {
    const n = (counts[band]! += 1);
    const step = value - means[band]!;
    means[band]! += step / n;
    squares[band]! += step * (value - means[band]!);
  });
  return {
    pixels,
    counts: [...counts],
    means: bands.map((band) => (counts[band] ? means[band]! : NaN)),
    spreads: bands.map((band) =>
      counts[band]! > 1 ? Math.sqrt(squares[band]! / (counts[band]! - 1)) : NaN,
    ),
  };
}

/** Count the values of one band in equal steps from the least to the largest; null without one. */
export async function histogram(
  spectra: Spectra,
  region: Region,
  { band, bins, marks }: { band: number; bins: number; marks: Mark[] },
): Promise<Histogram | null> {
  const values: number[] = [];
  await visit(spectra, region, { bands: [band], marks }, (_, value) => values.push(value));
  if (!values.length) return null;
  let [low, high] = [Infinity, -Infinity];
  for (const value of values) [low, high] = [Math.min(low, value), Math.max(high, value)];
  const counts = new Array<number>(bins).fill(0);
  const width = (high - low) / bins || 1;
  for (const value of values) counts[Math.min(bins - 1, Math.floor((value - low) / width))]!++;
  return { low, high, counts };
}
