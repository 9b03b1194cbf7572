// Spectra of single pixels, from tiles of script files: the very numbers of the TIFF.
import type { Point } from "../shared/pane";
import { marksOf, type Layer, type Mark, type PageRecord } from "./record";
import type { Gradient, SpectraFacts, Spectrum } from "./record";
import { inflate, loadScript, toBytes } from "./tiles";
import type { Mean } from "./uncertainty";

/** Columns and rows of the first and the last pixel of a rectangle. */
export type Bounds = [x0: number, y0: number, x1: number, y1: number];

/** The pixels round some places. */
export function around(points: Point[]): Bounds {
  const [xs, ys] = [0, 1].map((axis) => points.map((at) => Math.round(at[axis]!)));
  return [Math.min(...xs!), Math.min(...ys!), Math.max(...xs!), Math.max(...ys!)];
}

/** A mean with the standard deviation of its pixels, n − 1 in the denominator; NaN of fewer than two. */
export interface Statistics extends Mean {
  spreads: number[];
}

interface Tile extends Spectrum {
  columns: number;
  rows: number;
}

const KEPT = 24; // tiles a layer

/** The spectra of one layer; tiles are loaded on request, and the last ones kept. */
export class Spectra {
  private readonly tiles = new Map<string, Promise<Tile>>();
  /** Whether a value with these flags counts: no bit but trusted ones. */
  private readonly isSound: boolean[];

  constructor(
    private readonly layer: Layer,
    private readonly facts: SpectraFacts,
    marks: Mark[],
  ) {
    this.isSound = Array.from({ length: 256 }, (_, bits) =>
      marksOf(bits, marks).every(({ trusted }) => trusted),
    );
  }

  /** Read one pixel; x and y are integers on the grid. */
  async read(x: number, y: number): Promise<Spectrum> {
    const spectrum = await this.pixel(x, y);
    if (!this.layer.budget?.place) return spectrum;
    return { ...spectrum, slopes: await this.slopes([x, y, x, y]) };
  }

  /** Mean, spread and number of the sound pixels of a rectangle, band by band. */
  async mean(bounds: Bounds): Promise<Statistics> {
    const { columns, rows, bands } = this.facts;
    const [x0, y0, x1, y1] = bounds;
    const [counts, values, squares, noises] = [0, 1, 2, 3].map(() =>
      new Array<number>(bands).fill(0),
    ) as [number[], number[], number[], number[]];
    const take = (tile: Tile, place: number): void => {
      for (let band = 0, at = place; band < bands; band++, at += tile.columns * tile.rows) {
        const value = tile.values[at]!;
        // Of NaN and infinities the difference from itself is not 0.
        if (value - value !== 0 || (tile.flags && !this.isSound[tile.flags[at]!])) continue;
        // Welford 1962, 10.1080/00401706.1962.10490022
        const apart = value - values[band]!;
        values[band]! += apart / ++counts[band]!;
        squares[band]! += apart * (value - values[band]!);
        noises[band]! += (tile.sigma?.[at] ?? 0) ** 2;
      }
    };
    for (let row = Math.floor(y0 / rows); row * rows <= y1; row++)
      for (let column = Math.floor(x0 / columns); column * columns <= x1; column++) {
        const tile = await this.tile(column, row);
        const [left, top] = [column * columns, row * rows];
        for (let y = Math.max(y0, top); y <= Math.min(y1, top + tile.rows - 1); y++)
          for (let x = Math.max(x0, left); x <= Math.min(x1, left + tile.columns - 1); x++)
            take(tile, (y - top) * tile.columns + x - left);
      }
    return {
      values: values.map((value, i) => (counts[i] ? value : NaN)),
      spreads: squares.map((sum, i) => (counts[i]! > 1 ? Math.sqrt(sum / (counts[i]! - 1)) : NaN)),
      counts,
      noises,
      size: [x1 - x0 + 1, y1 - y0 + 1],
      slopes: this.layer.budget?.place && (await this.slopes(bounds, counts)),
    };
  }

  /** Slopes of the mean of a rectangle, means of central differences: of a line of pixels the ends alone count. */
  private async slopes([x0, y0, x1, y1]: Bounds, counts?: number[]): Promise<Gradient> {
    const { width, height, bands } = this.facts;
    const [x, y] = [0, 1].map(() => new Array<number>(bands).fill(0)) as [number[], number[]];
    const add = (sums: number[], rises: number[]): void =>
      rises.forEach((rise, i) => (sums[i]! += rise / (counts?.[i] ?? 1)));
    for (let row = y0; row <= y1; row++) add(x, await this.rise([x0, row], [x1, row], [1, 0]));
    for (let at = x0; at <= x1; at++) add(y, await this.rise([at, y0], [at, y1], [0, 1]));
    const share = (low: number, high: number, size: number): number =>
      (low + high) / 2 / Math.max(1, size - 1);
    return { x, y, at: [share(x0, x1, width), share(y0, y1, height)] };
  }

  private async pixel(x: number, y: number): Promise<Spectrum> {
    const { columns, rows, bands } = this.facts;
    const [column, row] = [Math.floor(x / columns), Math.floor(y / rows)];
    const tile = await this.tile(column, row);
    const place = (y - row * rows) * tile.columns + (x - column * columns);
    const plane = tile.columns * tile.rows;
    const pick = <T extends Float32Array | Uint8Array>(from: T, into: T): T => {
      for (let band = 0; band < bands; band++) into[band] = from[band * plane + place]!;
      return into;
    };
    return {
      values: pick(tile.values, new Float32Array(bands)),
      sigma: tile.sigma && pick(tile.sigma, new Float32Array(bands)),
      flags: tile.flags && pick(tile.flags, new Uint8Array(bands)),
    };
  }

  /** The sum of the central differences of a run of pixels, along it, of every band; 0 where its ends are not sound. */
  private async rise([x0, y0]: Point, [x1, y1]: Point, along: Point): Promise<number[]> {
    const [dx, dy] = along;
    const [after, last, first, before] = await Promise.all([
      this.sound(x1 + dx, y1 + dy, along),
      this.sound(x1, y1, along),
      this.sound(x0, y0, along),
      this.sound(x0 - dx, y0 - dy, along),
    ]);
    return Array.from(last, (value, i) => {
      const rise = (after[i]! + value - first[i]! - before[i]!) / 2;
      return Number.isFinite(rise) ? rise : 0;
    });
  }

  /** Values of a pixel, NaN where they are not sound; those beside the grid as a line through the last two has them. */
  private async sound(x: number, y: number, [dx, dy]: Point): Promise<Float32Array> {
    const { width, height } = this.facts;
    if (x < 0 || y < 0 || x >= width || y >= height) {
      const inwards = x < 0 || y < 0 ? 1 : -1;
      const [u, v] = [inwards * dx, inwards * dy];
      if (x + 2 * u < 0 || y + 2 * v < 0 || x + 2 * u >= width || y + 2 * v >= height)
        return new Float32Array(this.facts.bands).fill(NaN);
      const near = await this.sound(x + u, y + v, [dx, dy]);
      const far = await this.sound(x + 2 * u, y + 2 * v, [dx, dy]);
      return near.map((value, i) => 2 * value - far[i]!);
    }
    const { values, flags } = await this.pixel(x, y);
    return flags ? values.map((value, i) => (this.isSound[flags[i]!] ? value : NaN)) : values;
  }

  private tile(column: number, row: number): Promise<Tile> {
    const name = `${column}_${row}`;
    let tile = this.tiles.get(name);
    if (!tile) {
      tile = this.load(column, row);
      tile.catch(() => this.tiles.delete(name));
    }
    this.tiles.delete(name);
    this.tiles.set(name, tile);
    if (this.tiles.size > KEPT) this.tiles.delete(this.tiles.keys().next().value!);
    return tile;
  }

  private async load(column: number, row: number): Promise<Tile> {
    const { bands, folder, sigma, flags, width, height } = this.facts;
    const columns = Math.min(this.facts.columns, width - column * this.facts.columns);
    const rows = Math.min(this.facts.rows, height - row * this.facts.rows);
    const text = await loadScript(
      `${folder}/${column}_${row}.js`,
      `${this.layer.id}/spectra/${column}_${row}`,
    );
    const data = await inflate(toBytes(String(text)));
    const count = columns * rows * bands;
    const restored = (start: number, octets: number): Uint8Array<ArrayBuffer> =>
      restore(data, { start, columns, rows, bands, octets });
    return {
      columns,
      rows,
      values: new Float32Array(restored(0, 4).buffer),
      sigma: sigma ? new Float32Array(restored(4 * count, 4).buffer) : null,
      flags: flags ? restored(sigma ? 8 * count : 4 * count, 1) : null,
    };
  }
}

/** The spectra of every layer that has them; one reader a layer, for its files are scripts that load once. */
export type LayerSpectra = Map<Layer, Spectra>;

export function openSpectra({ layers, flags }: PageRecord): LayerSpectra {
  return new Map(
    layers.flatMap((layer) =>
      layer.spectra ? [[layer, new Spectra(layer, layer.spectra, flags)]] : [],
    ),
  );
}

/** Where an array of bands x rows x columns stands among bytes, and how many bytes a sample has. */
export interface Block {
  start: number;
  columns: number;
  rows: number;
  bands: number;
  octets: number;
}

/** Undo differences along x and the split into byte planes: the reverse of Levkas' `encode_block`. */
export function restore(data: Uint8Array, block: Block): Uint8Array<ArrayBuffer> {
  const { columns, rows, bands, octets } = block;
  const result = new Uint8Array(columns * rows * bands * octets);
  let from = block.start;
  for (let band = 0; band < bands; band++)
    for (let octet = 0; octet < octets; octet++)
      for (let row = 0; row < rows; row++) {
        let to = (band * rows + row) * columns * octets + octet;
        for (let column = 0, sum = 0; column < columns; column++, to += octets) {
          sum = (sum + data[from++]!) & 255;
          result[to] = sum;
        }
      }
  return result;
}
