// Spectra of single pixels, from tiles of script files: the very numbers of the TIFF.
import type { Layer, SpectraFacts } from "./record";
import type { Bounds } from "./shapes";
import { inflate, loadScript, toBytes } from "./tiles";

export interface Spectrum {
  values: Float32Array;
  sigma: Float32Array | null;
  flags: Uint8Array | null;
}

interface Tile extends Spectrum {
  columns: number;
  rows: number;
}

/** A tile and where its first pixel lies on the grid. */
export interface PlacedTile extends Tile {
  left: number;
  top: number;
}

const KEPT = 24; // tiles a layer

/** The spectra of one layer; tiles are loaded when asked for, and the last ones kept. */
export class Spectra {
  private readonly tiles = new Map<string, Promise<Tile>>();

  constructor(
    private readonly layer: Layer,
    private readonly facts: SpectraFacts,
  ) {}

  /** Read one pixel; x and y are integers on the grid. */
  async read(x: number, y: number): Promise<Spectrum> {
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

  /** Bands of the layer. */
  get bands(): number {
    return this.facts.bands;
  }

  /** The tiles that have pixels between `x0`, `y0` and `x1`, `y1`, and where each begins on the grid. */
  async *tilesWithin([x0, y0, x1, y1]: Bounds): AsyncGenerator<PlacedTile> {
    const { columns, rows, width, height } = this.facts;
    const from = (low: number, side: number): number => Math.floor(Math.max(0, low) / side);
    const to = (high: number, size: number, side: number): number =>
      Math.floor(Math.min(size - 1, high) / side);
    for (let row = from(y0, rows); row <= to(y1, height, rows); row++)
      for (let column = from(x0, columns); column <= to(x1, width, columns); column++)
        yield { ...(await this.tile(column, row)), left: column * columns, top: row * rows };
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
    const { width, height, bands, folder, sigma, flags } = this.facts;
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

export function openSpectra(layers: Layer[]): LayerSpectra {
  return new Map(
    layers.flatMap((layer) => (layer.spectra ? [[layer, new Spectra(layer, layer.spectra)]] : [])),
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
