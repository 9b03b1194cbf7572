// Spectra of single pixels, from tiles of script files: the very numbers of the TIFF.
import type { Point } from "../shared/pane";
import { marksOf } from "./numbers";
import type { Layer, Mark, PageRecord, SpectraFacts } from "./record";
import type { Bounds } from "./shapes";
import { inflate, loadScript, toBytes } from "./tiles";
import type { Gradient } from "./uncertainty";

export interface Spectrum {
  values: Float32Array;
  sigma: Float32Array | null;
  flags: Uint8Array | null;
  /** Of a pixel of a layer whose places are known. */
  slopes?: Gradient | undefined;
}

/** Whether a value with these flags counts: no bit but trusted ones; 256 answers. */
export function soundness(marks: Mark[]): boolean[] {
  return Array.from({ length: 256 }, (_, bits) =>
    marksOf(bits, marks).every(({ trusted }) => trusted),
  );
}

export interface Tile extends Spectrum {
  columns: number;
  rows: number;
}

/** Sound values of one band of a tile: how many, their mean, and sums of squares: of differences from it, and of sigma. */
export interface Sums {
  n: number;
  mean: number;
  squares: number;
  noise: number;
}

type Four = [number, number, number, number];

const KEPT = 24; // tiles a layer
const AHEAD = 12; // of KEPT, while a region is read

/** The spectra of one layer; tiles are loaded on request, and the last ones kept. */
export class Spectra {
  private readonly tiles = new Map<string, Promise<Tile>>();
  private summed: Promise<Float64Array> | null = null;
  private readonly isSound: boolean[];

  constructor(
    private readonly layer: Layer,
    private readonly facts: SpectraFacts,
    marks: Mark[],
  ) {
    this.isSound = soundness(marks);
  }

  /** Read one pixel; x and y are integers on the grid. */
  async read(x: number, y: number): Promise<Spectrum> {
    const spectrum = await this.pixel(x, y);
    if (!this.hasPlaces) return spectrum;
    const here: [Point, Point] = [
      [x, y],
      [x, y],
    ];
    const slopes = [await this.rise(...here, [1, 0]), await this.rise(...here, [0, 1])] as const;
    return { ...spectrum, slopes: { x: slopes[0], y: slopes[1], at: this.share([x, y]) } };
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
  async rise([x0, y0]: Point, [x1, y1]: Point, along: Point): Promise<number[]> {
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
        return new Float32Array(this.bands).fill(NaN);
      const near = await this.sound(x + u, y + v, [dx, dy]);
      const far = await this.sound(x + 2 * u, y + 2 * v, [dx, dy]);
      return near.map((value, i) => 2 * value - far[i]!);
    }
    const { values, flags } = await this.pixel(x, y);
    return flags ? values.map((value, i) => (this.isSound[flags[i]!] ? value : NaN)) : values;
  }

  /** Whether it is known how well the layer's places are. */
  get hasPlaces(): boolean {
    return this.layer.budget?.place !== undefined;
  }

  /** Width and height of the grid. */
  get size(): [width: number, height: number] {
    return [this.facts.width, this.facts.height];
  }

  /** Where a place lies on the grid, from 0 to 1. */
  share([x, y]: Point): Point {
    const [width, height] = this.size;
    return [x / Math.max(1, width - 1), y / Math.max(1, height - 1)];
  }

  /** Bands of the layer. */
  get bands(): number {
    return this.facts.bands;
  }

  /** Columns and rows of the tiles that have pixels of a part of the grid. */
  placesWithin([x0, y0, x1, y1]: Bounds): Point[] {
    const { columns, rows, width, height } = this.facts;
    const [right, bottom] = [Math.min(width - 1, x1), Math.min(height - 1, y1)];
    const places: Point[] = [];
    for (let row = Math.max(0, Math.floor(y0 / rows)); row * rows <= bottom; row++)
      for (let column = Math.max(0, Math.floor(x0 / columns)); column * columns <= right; column++)
        places.push([column, row]);
    return places;
  }

  /** How many columns and rows of the grid have pixels of a part of it. */
  sizeWithin([x0, y0, x1, y1]: Bounds): [columns: number, rows: number] {
    const { width, height } = this.facts;
    const span = (low: number, high: number, end: number): number =>
      Math.max(0, Math.min(end - 1, Math.floor(high)) - Math.max(0, Math.ceil(low)) + 1);
    return [span(x0, x1, width), span(y0, y1, height)];
  }

  /** Where a tile begins on the grid, and its size. */
  shapeOf([column, row]: Point): [left: number, top: number, columns: number, rows: number] {
    const { columns, rows, width, height } = this.facts;
    const [left, top] = [column * columns, row * rows];
    return [left, top, Math.min(columns, width - left), Math.min(rows, height - top)];
  }

  /** Read tiles one after the other; some are on their way while one is looked at. */
  async *readTiles(places: Point[]): AsyncGenerator<Tile> {
    const coming = places.slice(0, AHEAD).map((place) => this.tile(...place));
    for (let i = 0; i < places.length; i++) {
      const next = places[i + AHEAD];
      if (next) coming.push(this.tile(...next));
      yield await coming.shift()!;
    }
  }

  /** What was published of whole tiles; null where nothing was. */
  async sums(): Promise<((place: Point, band: number) => Sums) | null> {
    const { folder, bands, columns, width, sums } = this.facts;
    if (!sums) return null;
    this.summed ??= loadScript(`${folder}/sums.js`, `${this.layer.id}/spectra/sums`).then(
      (text) => new Float64Array(toBytes(String(text)).buffer),
    );
    const [table, across] = [await this.summed, Math.ceil(width / columns)];
    return ([column, row], band) => {
      const at = 4 * ((row * across + column) * bands + band);
      const [n, mean, squares, noise] = [0, 1, 2, 3].map((i) => table[at + i]!) as Four;
      return { n, mean, squares, noise };
    };
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
    const { bands, folder, sigma, flags } = this.facts;
    const [, , columns, rows] = this.shapeOf([column, row]);
    const text = await loadScript(
      `${folder}/${column}_${row}.js`,
      `${this.layer.id}/spectra/${column}_${row}`,
    );
    const data = await inflate(toBytes(String(text)));
    const count = columns * rows * bands;
    const restored = (start: number, octets: number): Uint8Array<ArrayBuffer> =>
      restore(data, { start, columns, rows, bands, octets });
    let spread: Float32Array | null = null;
    return {
      columns,
      rows,
      values: new Float32Array(restored(0, 4).buffer),
      // Histograms do not need it.
      get sigma(): Float32Array | null {
        spread ??= sigma ? new Float32Array(restored(4 * count, 4).buffer) : null;
        return spread;
      },
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
