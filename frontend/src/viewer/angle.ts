// The spectral angle of every pixel of a layer to that of one place, from the numbers of the TIFF
// (Kruse et al. 1993, 10.1016/0034-4257(93)90013-N). It compares shapes, and is no identification.
import { signal } from "@preact/signals-core";
import type { Point } from "../shared/pane";
import { marksOf } from "./numbers";
import type { Layer, Legend, Mark, Picture } from "./record";
import type { LayerSpectra, Tile, Spectrum } from "./spectra";

/** Angles at the dark end of the scale, degrees. */
export const RANGES = [2, 5, 10, 20, 40];
export const USUAL_RANGE = 10;
const LEAST_BANDS = 3;
const LARGEST_PX = 40_000_000;
const KEPT = 4; // maps
const KEY = /^angle-(\d{1,6})-(\d{1,6})-(\d{1,2})$/;
/** From alike to unlike; lightness falls evenly. */
const SCALE: [number, number, number][] = [
  [250, 236, 190],
  [217, 154, 60],
  [181, 83, 51],
  [122, 46, 76],
  [60, 32, 64],
  [20, 17, 15],
];
const GIVEN_UP_MS = 3000; // after a map is no longer shown
const UNSOUND: [number, number, number] = [128, 128, 128];

/** What a picture of angles is made from. */
export interface AngleFacts {
  layer: Layer;
  place: Point;
  range: number;
}

/** What is being computed just now, as a sentence; empty when all is done. */
export const progress = signal("");

/** Key of the picture of angles to a pixel: ``angle-120-80-10``. */
export function angleKey([x, y]: Point, range: number): string {
  return `angle-${Math.round(x)}-${Math.round(y)}-${range}`;
}

/** The pixel and the range of a picture of angles; null for the key of another picture. */
export function angleFacts(key: string): { place: Point; range: number } | null {
  const [x, y, range] = KEY.exec(key)?.slice(1).map(Number) ?? [];
  if (x === undefined || y === undefined || range === undefined) return null;
  return RANGES.includes(range) ? { place: [x, y], range } : null;
}

/** Whether a layer has what angles need: three bands, numbers, and a size that a page can hold. */
export function hasAngles({ spectra }: Layer): boolean {
  return (
    spectra !== null && spectra.bands >= LEAST_BANDS && spectra.width * spectra.height <= LARGEST_PX
  );
}

/** The picture of angles of a layer; undefined where there can be none. */
export function anglePicture(layer: Layer, key: string): Picture | undefined {
  const facts = angleFacts(key);
  const [first] = layer.pictures;
  if (!facts || !first || !layer.spectra || !hasAngles(layer)) return undefined;
  const [x, y] = facts.place;
  if (x >= layer.spectra.width || y >= layer.spectra.height) return undefined;
  return {
    ...first,
    key,
    label: `Spectral angle to ${x}, ${y}: not an identification`,
    kind: "angle",
    white: null,
    note:
      `Angle between the spectrum of each pixel and that at ${x}, ${y}: 0° means the same shape at any brightness. ` +
      "Not an identification: different paints may have the same shape, and one paint may have several. " +
      "Grey: a needed band is not reliable.",
    legend: legendOf(facts.range),
    angle: { layer, ...facts },
  };
}

function legendOf(range: number): Legend {
  const entries = SCALE.map((rgb) => ({ name: "", colour: `rgb(${rgb.join()})` }));
  return { entries, least: "0°, alike", most: `${range}° and more` };
}

/** Bands of the spectrum at the place that are to be trusted, and their values. */
function trusted(spectrum: Spectrum, marks: Mark[]): number[] {
  const bands: number[] = [];
  spectrum.values.forEach((value, band) => {
    const flags = marksOf(spectrum.flags?.[band] ?? 0, marks);
    if (Number.isFinite(value) && flags.every((mark) => mark.trusted)) bands.push(band);
  });
  return bands;
}

/**
 * Write the angles of a tile's pixels into `angles`, degrees; NaN where a band is not to be trusted.
 *
 * `sound` tells by the flags of a value whether it is.
 */
export function fillAngles(
  angles: Float32Array,
  width: number,
  [tile, left, top]: [Tile, left: number, top: number],
  { bands, values, sound }: { bands: number[]; values: Float32Array; sound: boolean[] },
): void {
  const plane = tile.columns * tile.rows;
  const length = Math.hypot(...bands.map((band) => values[band]!));
  for (let row = 0; row < tile.rows; row++)
    for (let column = 0; column < tile.columns; column++) {
      const place = row * tile.columns + column;
      let [both, own] = [0, 0];
      for (const band of bands) {
        const at = band * plane + place;
        const value = sound[tile.flags?.[at] ?? 0] ? tile.values[at]! : NaN;
        both += value * values[band]!;
        own += value * value;
      }
      const cosine = both / (Math.sqrt(own) * length);
      angles[(top + row) * width + left + column] =
        (Math.acos(Math.max(-1, Math.min(1, cosine))) * 180) / Math.PI;
    }
}

/** Nobody looks at a map any more before it is whole. */
class GivenUp extends Error {}

/** A map of angles, and its picture. */
class AngleMap {
  private readonly sheets = new Map<number, HTMLCanvasElement>();

  constructor(
    readonly width: number,
    readonly height: number,
    readonly angles: Promise<Float32Array>,
  ) {}

  /** The angles as colours, up to `range` degrees. */
  async sheet(range: number): Promise<HTMLCanvasElement> {
    const angles = await this.angles;
    let sheet = this.sheets.get(range);
    if (!sheet) {
      sheet = document.createElement("canvas");
      [sheet.width, sheet.height] = [this.width, this.height];
      const pixels = new ImageData(paint(angles, range), this.width, this.height);
      sheet.getContext("2d")!.putImageData(pixels, 0, 0);
      this.sheets.clear(); // one is enough, and each takes much memory
      this.sheets.set(range, sheet);
    }
    return sheet;
  }
}

/** Return angles as RGBA; grey where there is none. */
export function paint(angles: Float32Array, range: number): Uint8ClampedArray<ArrayBuffer> {
  const pixels = new Uint8ClampedArray(4 * angles.length);
  const steps = SCALE.length - 1;
  const table = Array.from({ length: 256 }, (_, i) => {
    const at = (i / 255) * steps;
    const low = Math.min(Math.floor(at), steps - 1);
    return SCALE[low]!.map((from, ink) => from + (at - low) * (SCALE[low + 1]![ink]! - from));
  });
  for (const [i, angle] of angles.entries()) {
    const colour = Number.isNaN(angle)
      ? UNSOUND
      : table[Math.min(255, Math.round((255 * angle) / range))]!;
    for (let ink = 0; ink < 3; ink++) pixels[4 * i + ink] = colour[ink]!;
    pixels[4 * i + 3] = 255;
  }
  return pixels;
}

/** All maps of a page, the last ones kept. */
export class AngleMaps {
  private readonly maps = new Map<string, AngleMap>();

  /** `shown` tells which maps are on the screen: the others are not computed to their end. */
  constructor(
    private readonly spectra: LayerSpectra,
    private readonly marks: Mark[],
    private readonly shown: () => (AngleFacts | undefined)[],
  ) {}

  /** The map of a layer and a place. */
  find({ layer, place }: AngleFacts): AngleMap {
    const key = `${layer.id} ${place.join()}`;
    let map = this.maps.get(key);
    if (!map) {
      const { width, height } = layer.spectra!;
      map = new AngleMap(width, height, this.compute(layer, place));
      map.angles.catch(() => this.maps.delete(key));
    }
    this.maps.delete(key);
    this.maps.set(key, map);
    if (this.maps.size > KEPT) this.maps.delete(this.maps.keys().next().value!);
    return map;
  }

  private async compute(layer: Layer, place: Point): Promise<Float32Array> {
    let last = Date.now();
    const wanted = (): boolean => {
      const here = (one?: AngleFacts): boolean =>
        one?.layer === layer && one.place.join() === place.join();
      if (this.shown().some(here)) last = Date.now();
      return Date.now() - last < GIVEN_UP_MS;
    };
    const [spectra, facts] = [this.spectra.get(layer)!, layer.spectra!];
    const angles = new Float32Array(facts.width * facts.height).fill(NaN);
    try {
      const spectrum = await spectra.read(...place);
      const bands = trusted(spectrum, this.marks);
      if (bands.length < LEAST_BANDS) {
        progress.value = `Fewer than ${LEAST_BANDS} bands are reliable at ${place.join(", ")}: no angle can be computed.`;
        return angles;
      }
      const sound = Array.from({ length: 256 }, (_, bits) =>
        marksOf(bits, this.marks).every((mark) => mark.trusted),
      );
      const needed = { bands, values: spectrum.values, sound };
      let [done, read] = [0, 0];
      const pixels = facts.width * facts.height;
      const places = spectra.placesWithin([0, 0, facts.width - 1, facts.height - 1]);
      for await (const tile of spectra.readTiles(places)) {
        if (!wanted()) throw new GivenUp();
        const [left, top] = spectra.shapeOf(places[read++]!);
        fillAngles(angles, facts.width, [tile, left, top], needed);
        done += tile.columns * tile.rows;
        progress.value = `Computing the spectral angle: ${Math.floor((100 * done) / pixels)} %.`;
      }
      progress.value = "";
      return angles;
    } catch (error) {
      progress.value =
        error instanceof GivenUp ? "" : "No spectral angle: a file of spectra cannot be read.";
      throw error;
    }
  }

  /** Draw one tile of a picture of angles. */
  async tile(
    picture: Picture,
    level: number,
    x: number,
    y: number,
  ): Promise<CanvasRenderingContext2D> {
    const facts = picture.angle!;
    return cutTile(await this.find(facts).sheet(facts.range), picture, level, [x, y]);
  }
}

/** Cut a tile of a level from the whole picture, with its neighbours' nearest pixels. */
function cutTile(
  sheet: HTMLCanvasElement,
  { tile, overlap, most }: Picture,
  level: number,
  place: Point,
): CanvasRenderingContext2D {
  const scale = 2 ** (most - level);
  const size = [sheet.width, sheet.height].map((side) => Math.ceil(side / scale));
  const low = place.map((at) => Math.max(0, at * tile - overlap));
  const high = place.map((at, i) => Math.min(size[i]!, (at + 1) * tile + overlap));
  const canvas = document.createElement("canvas");
  [canvas.width, canvas.height] = [high[0]! - low[0]!, high[1]! - low[1]!];
  const context = canvas.getContext("2d")!;
  context.imageSmoothingQuality = "high";
  context.imageSmoothingEnabled = scale > 1;
  const [left, top] = [low[0]! * scale, low[1]! * scale];
  const [across, down] = [canvas.width * scale, canvas.height * scale];
  context.drawImage(sheet, left, top, across, down, 0, 0, canvas.width, canvas.height);
  return context;
}

let maps: AngleMaps | null = null;

/** Say where angles are computed from; once a page. */
export function provideAngles(made: AngleMaps): void {
  maps = made;
}

/** One tile of a picture of angles, by its address ``KEY/LEVEL/X_Y``; empty where the map was given up. */
export async function loadAngles(
  picture: Picture,
  address: string,
): Promise<CanvasRenderingContext2D> {
  const place = address.split("/").slice(1).join("_").split("_");
  const [level, x, y] = place.map(Number) as [number, number, number];
  try {
    return await maps!.tile(picture, level, x, y);
  } catch (error) {
    if (error instanceof GivenUp) return document.createElement("canvas").getContext("2d")!;
    throw error;
  }
}
