// Mean, standard deviation and number of sound pixels of a region, band by band; and histograms.
import type { Point } from "../shared/pane";
import type { Mark } from "./record";
import { boundsOf, contains, type Region } from "./shapes";
import { soundness, type Spectra, type Sums } from "./spectra";
import type { Gradient } from "./uncertainty";

export interface Statistics {
  /** All pixels of the region on the grid. */
  pixels: number;
  /** Sound pixels of each band. */
  counts: number[];
  means: number[];
  /** Standard deviations, n − 1 in the denominator; NaN of fewer than two. */
  spreads: number[];
  /** Sums of squared sigmas of the sound pixels; 0 where they were not wanted. */
  noises: number[];
  /** Columns and rows of the grid that the region spans. */
  size: [columns: number, rows: number];
  /** Sound values of each band, once they were read, and while they are kept. */
  values: Float32Array[] | null;
  /** Of the means; absent where they are not wanted. */
  slopes?: Gradient | undefined;
}

export interface Histogram {
  low: number;
  high: number;
  counts: number[];
}

/** Visit the tiles that a region has pixels in: places of these pixels in the tile, and how many pixels the tile has. */
function tilesOf(spectra: Spectra, region: Region): Part[] {
  const inside = contains(region);
  return spectra.placesWithin(boundsOf(region)).flatMap((place) => {
    const [left, top, columns, rows] = spectra.shapeOf(place);
    const places = new Uint32Array(columns * rows);
    let count = 0;
    for (let row = 0; row < rows; row++)
      for (let column = 0; column < columns; column++)
        if (inside(left + column, top + row)) places[count++] = row * columns + column;
    const whole = count === places.length;
    return count ? [{ place, places: places.subarray(0, count), whole }] : [];
  });
}

interface Part {
  place: Point;
  places: Uint32Array;
  whole: boolean;
}

/** Visit the sound values of a region in some bands, tile by tile. */
async function visit(
  spectra: Spectra,
  parts: Part[],
  { bands, marks, noise = false }: { bands: number[]; marks: Mark[]; noise?: boolean },
  take: (band: number, values: Float32Array, noise: number) => void,
): Promise<void> {
  const sound = soundness(marks);
  let next = 0;
  for await (const tile of spectra.readTiles(parts.map((p) => p.place))) {
    const { values, flags, columns, rows } = tile;
    const sigma = noise ? tile.sigma : null;
    const { places } = parts[next++]!;
    const [size, found] = [columns * rows, new Float32Array(places.length)];
    for (const band of bands) {
      let [n, squares] = [0, 0];
      for (const place of places) {
        const at = band * size + place;
        const value = values[at]!;
        // Of NaN and infinities the difference from itself is not 0.
        if (value - value !== 0 || (flags && !sound[flags[at]!])) continue;
        found[n++] = value;
        if (sigma) squares += sigma[at]! * sigma[at]!;
      }
      take(band, found.subarray(0, n), squares);
    }
  }
}

/** Measure a region in every band, with its noise if that is wanted; of tiles that lie in it whole the sums were published. */
export async function measure(
  spectra: Spectra,
  region: Region,
  { marks, noise }: { marks: Mark[]; noise: boolean },
): Promise<Statistics> {
  const bands = Array.from({ length: spectra.bands }, (_, band) => band);
  const all = bands.map((): Sums => ({ n: 0, mean: 0, squares: 0, noise: 0 }));
  const parts = tilesOf(spectra, region);
  const known = parts.some(({ whole }) => whole) ? await spectra.sums() : null;
  for (const { place, whole } of parts)
    if (known && whole) for (const band of bands) merge(all[band]!, known(place, band));
  const others = parts.filter(({ whole }) => !known || !whole);
  await visit(spectra, others, { bands, marks, noise }, (band, values, squares) =>
    merge(all[band]!, sumsOf(values, squares)),
  );
  return {
    pixels: parts.reduce((sum, { places }) => sum + places.length, 0),
    counts: all.map(({ n }) => n),
    means: all.map(({ n, mean }) => (n ? mean : NaN)),
    spreads: all.map(({ n, squares }) => (n > 1 ? Math.sqrt(squares / (n - 1)) : NaN)),
    noises: all.map(({ noise }) => noise),
    size: spectra.sizeWithin(boundsOf(region)),
    values: null,
    slopes:
      noise && spectra.hasPlaces
        ? await meanSlopes(
            spectra,
            region,
            all.map(({ n }) => n),
          )
        : undefined,
  };
}

/** Slopes of the mean of a region, means of central differences: of a line or column of pixels the ends alone count. */
async function meanSlopes(spectra: Spectra, region: Region, counts: number[]): Promise<Gradient> {
  const [x0, y0, x1, y1] = boundsOf(region);
  const inside = contains(region);
  const [width, height] = spectra.size;
  const xs = range(Math.max(0, Math.ceil(x0)), Math.min(width - 1, Math.floor(x1)));
  const ys = range(Math.max(0, Math.ceil(y0)), Math.min(height - 1, Math.floor(y1)));
  const mean = async (lines: Point[][], along: Point): Promise<number[]> => {
    const sums = counts.map(() => 0);
    for (const line of lines)
      for (const run of runsOf(line.map((place) => (inside(...place) ? place : null))))
        (await spectra.rise(...run, along)).forEach((rise, i) => (sums[i]! += rise));
    return sums.map((sum, i) => sum / counts[i]!);
  };
  return {
    x: await mean(
      ys.map((y) => xs.map((x): Point => [x, y])),
      [1, 0],
    ),
    y: await mean(
      xs.map((x) => ys.map((y): Point => [x, y])),
      [0, 1],
    ),
    at: spectra.share([(x0 + x1) / 2, (y0 + y1) / 2]),
  };
}

const range = (low: number, high: number): number[] =>
  Array.from({ length: Math.max(0, high - low + 1) }, (_, i) => low + i);

/** First and last places of the runs of a line that are not interrupted. */
function runsOf(line: (Point | null)[]): [first: Point, last: Point][] {
  return line.flatMap((first, i) => {
    if (!first || line[i - 1]) return [];
    const after = line.indexOf(null, i);
    return [[first, line[after < 0 ? line.length - 1 : after - 1]!]];
  });
}

/** Number, mean and sum of squared differences from the mean, with a sum of squared sigmas. */
function sumsOf(values: Float32Array, noise: number): Sums {
  let [sum, squares] = [0, 0];
  for (const value of values) sum += value;
  const mean = values.length ? sum / values.length : 0;
  for (const value of values) squares += (value - mean) * (value - mean);
  return { n: values.length, mean, squares, noise };
}

/** Add the sums of a part to others (Chan, Golub and LeVeque 1983, 10.1080/00031305.1983.10483115). */
function merge(all: Sums, { n, mean, squares, noise }: Sums): void {
  if (!n) return;
  const total = all.n + n;
  const apart = mean - all.mean;
  all.mean += (apart * n) / total;
  all.squares += squares + (apart * apart * all.n * n) / total;
  all.noise += noise;
  all.n = total;
}

/** Read the sound values of a region in some bands. */
export async function valuesOf(
  spectra: Spectra,
  region: Region,
  { bands, marks }: { bands: number[]; marks: Mark[] },
): Promise<Float32Array[]> {
  const parts = tilesOf(spectra, region);
  const most = parts.reduce((sum, { places }) => sum + places.length, 0);
  const found = new Map(bands.map((band) => [band, { n: 0, all: new Float32Array(most) }]));
  await visit(spectra, parts, { bands, marks }, (band, values) => {
    const one = found.get(band)!;
    one.all.set(values, one.n);
    one.n += values.length;
  });
  return [...found.values()].map(({ n, all }) => all.subarray(0, n));
}

/** Count values in equal steps from the least to the largest; null without one. */
export function histogram(values: Float32Array, bins: number): Histogram | null {
  if (!values.length) return null;
  let [low, high] = [Infinity, -Infinity];
  for (const value of values) {
    if (value < low) low = value;
    if (value > high) high = value;
  }
  const counts = new Array<number>(bins).fill(0);
  const width = (high - low) / bins || 1;
  for (const value of values) counts[Math.min(bins - 1, Math.floor((value - low) / width))]!++;
  return { low, high, counts };
}
