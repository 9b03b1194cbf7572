// From a pixel of the grid to the native pixel of a band: cubic interpolation of a lattice of samples.
import type { Point } from "../shared/pane";
import type { Layer, LatticeFacts } from "./record";
import { loadScript, toBytes } from "./tiles";

type Size = [number, number] | null;

interface Payload {
  reference: string;
  reference_size: Size;
  bands: { size: Size; nodes: string }[];
}

interface Nodes {
  size: Size;
  table: Float32Array;
}

const EDGE = 0.5 + 1e-6;

/** The maps of one layer's bands; loaded on first use. */
export class Lattice {
  private loaded: Promise<{ reference: Nodes; bands: Nodes[] }> | null = null;

  constructor(
    private readonly layer: Layer,
    private readonly facts: LatticeFacts,
  ) {}

  /** Where a band recorded a pixel of the grid; null outside what is known. */
  async find(pixel: Point, band: number): Promise<Point | null> {
    this.loaded ??= this.load();
    const { reference, bands } = await this.loaded;
    const nodes = bands[band];
    if (!nodes || !this.inside(reference, pixel)) return null;
    return this.inside(nodes, pixel);
  }

  private async load(): Promise<{ reference: Nodes; bands: Nodes[] }> {
    const payload = (await loadScript(this.facts.file, `${this.layer.id}/native`)) as Payload;
    const decode = (text: string): Float32Array => new Float32Array(toBytes(text).buffer);
    return {
      reference: { size: payload.reference_size, table: decode(payload.reference) },
      bands: payload.bands.map((band) => ({ size: band.size, table: decode(band.nodes) })),
    };
  }

  private inside({ size, table }: Nodes, pixel: Point): Point | null {
    const found = interpolate(table, pixel, this.facts);
    const inside = !size || found.every((at, i) => at >= -EDGE && at <= size[i]! - 1 + EDGE);
    return inside && found.every(Number.isFinite) ? found : null;
  }
}

/** Interpolate a lattice of samples (rows x columns x 2) at a pixel; samples begin a step before the first. */
export function interpolate(
  table: Float32Array,
  [px, py]: Point,
  { step, columns, rows }: Pick<LatticeFacts, "step" | "columns" | "rows">,
): Point {
  const [u, v] = [px / step + 1, py / step + 1];
  const left = Math.min(Math.max(Math.floor(u), 1), columns - 3);
  const top = Math.min(Math.max(Math.floor(v), 1), rows - 3);
  const [across, down] = [weights(u - left), weights(v - top)];
  let [x, y] = [0, 0];
  for (let row = 0; row < 4; row++)
    for (let column = 0; column < 4; column++) {
      const place = 2 * ((top - 1 + row) * columns + left - 1 + column);
      const weight = down[row]! * across[column]!;
      x += weight * table[place]!;
      y += weight * table[place + 1]!;
    }
  return [x, y];
}

/** Catmull-Rom's weights of four neighbours at a fraction between the inner two. */
function weights(t: number): [number, number, number, number] {
  const [t2, t3] = [t * t, t * t * t];
  return [
    (-t + 2 * t2 - t3) / 2,
    (2 - 5 * t2 + 3 * t3) / 2,
    (t + 4 * t2 - 3 * t3) / 2,
    (-t2 + t3) / 2,
  ];
}
