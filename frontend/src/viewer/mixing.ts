// False colour: three single bands as red, green and blue, mixed tile by tile while they are looked at.
import type OpenSeadragon from "openseadragon";
import type { Layer, Picture } from "./record";

const WANTED_NM = [900, 650, 550]; // of false-colour infrared
const INKS = ["#f00", "#0f0", "#00f"];
const START = "mix-";

/** Key of the mixture of three bands, by their numbers: ``mix-10-5-3``. */
export function mixKey(numbers: number[]): string {
  return START + numbers.join("-");
}

export function isMix(key: string | undefined): boolean {
  return key?.startsWith(START) ?? false;
}

/** Single bands of a layer that have a picture, by their numbers. */
export function bandsOf(layer: Layer): { number: number; picture: Picture }[] {
  return layer.pictures.filter((p) => p.kind === "band").map((picture) => ({ number: Number(picture.key.replace("band-", "")), picture }));
}

/** Infrared, red and green where the layer has them; else its last, its middle and its first band. */
export function proposeMix(layer: Layer): string | undefined {
  const bands = bandsOf(layer);
  if (bands.length < 3) return undefined;
  const place = (number: number): number | null => layer.bands[number]?.wavelength ?? layer.bands[number]?.centroid ?? null;
  const spread = [bands.length - 1, Math.floor((bands.length - 1) / 2), 0].map((i) => bands[i]!.number);
  if (bands.some(({ number }) => place(number) === null)) return mixKey(spread);
  const nearest = WANTED_NM.map((wanted) => bands.reduce((best, band) => (Math.abs(place(band.number)! - wanted) < Math.abs(place(best.number)! - wanted) ? band : best)).number);
  return mixKey(new Set(nearest).size === 3 ? nearest : spread);
}

/** The mixture of three bands as a picture, where the layer has all three. */
export function mix(layer: Layer, key: string): Picture | undefined {
  const numbers = key.slice(START.length).split("-").map(Number);
  const parts = numbers.map((n) => layer.pictures.find((p) => p.key === `band-${n}`));
  const [first] = parts;
  if (numbers.length !== 3 || !first || parts.some((p) => !p)) return undefined;
  const labels = parts.map((p) => p!.label).join(" / ");
  return { ...first, key, label: `False colour, ${labels}`, kind: "mix", note: `${labels} as red, green and blue, each from 0 to its own white`, mixed: parts as Picture[] };
}

interface Job {
  src: string;
  finish(data: CanvasRenderingContext2D, request: null, type: string): void;
  fail(message: string, request: null): void;
}

/** What OpenSeadragon needs to show a mixture: a tile is asked for by the addresses of its three parts. */
export function mixedSource(parts: Picture[], addressOf: (picture: Picture, level: number, x: number, y: number) => string): Partial<OpenSeadragon.TileSourceOptions> {
  return {
    getTileUrl: (level: number, x: number, y: number) => parts.map((part) => addressOf(part, level, x, y)).join("|"),
    downloadTileStart: (job: Job) => {
      Promise.all(job.src.split("|").map(loadImage)).then(
        (images) => job.finish(blend(images), null, "context2d"),
        () => job.fail("a band cannot be read", null),
      );
    },
    downloadTileAbort: () => {},
  } as unknown as Partial<OpenSeadragon.TileSourceOptions>;
}

function loadImage(address: string): Promise<HTMLImageElement> {
  return new Promise((resolve, reject) => {
    const image = new Image();
    image.onload = () => resolve(image);
    image.onerror = reject;
    image.src = address;
  });
}

/** Ink each grey picture in its colour, and add them up. Nothing is read back: a page from file:// may not. */
function blend(images: HTMLImageElement[]): CanvasRenderingContext2D {
  const [width, height] = [images[0]!.naturalWidth, images[0]!.naturalHeight];
  const [sum, one] = [sheet(width, height), sheet(width, height)];
  sum.globalCompositeOperation = "lighter";
  images.forEach((image, i) => {
    one.globalCompositeOperation = "source-over";
    one.drawImage(image, 0, 0);
    one.globalCompositeOperation = "multiply";
    one.fillStyle = INKS[i]!;
    one.fillRect(0, 0, width, height);
    sum.drawImage(one.canvas, 0, 0);
  });
  return sum;
}

function sheet(width: number, height: number): CanvasRenderingContext2D {
  const canvas = document.createElement("canvas");
  [canvas.width, canvas.height] = [width, height];
  return canvas.getContext("2d")!;
}
