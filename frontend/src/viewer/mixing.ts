// False colour: three single bands as red, green and blue, mixed tile by tile while they are looked at.
import { proposeThree } from "../shared/falsecolour";
import type { Layer as Tiles } from "../shared/pane";
import type { Layer, Picture } from "./record";
import { loadPicture } from "./tiles";

const INKS = ["#f00", "#0f0", "#00f"];
const MIX = /^mix-(\d+)-(\d+)-(\d+)$/;
const BAND = /^band-(\d+)$/;

/** Key of the mixture of three bands, by their numbers: ``mix-10-5-3``. */
export function mixKey(numbers: readonly number[]): string {
  return `mix-${numbers.join("-")}`;
}

/** The numbers of the three bands of a mixture; null for the key of another picture. */
export function mixNumbers(key: string): number[] | null {
  return MIX.exec(key)?.slice(1).map(Number) ?? null;
}

/** The number of the band that a picture shows; -1 for other pictures. */
export function bandNumber({ key }: Picture): number {
  return Number(BAND.exec(key)?.[1] ?? -1);
}

/** Pictures of single bands of a layer. */
export function bandsOf(layer: Layer): Picture[] {
  return layer.pictures.filter(({ kind }) => kind === "band");
}

/** Where a band lies, nm: its wavelength, or the centroid of a broad one; null where neither is known. */
export function placeOf(layer: Layer, number: number): number | null {
  const band = layer.bands[number];
  return band?.wavelength ?? band?.centroid ?? null;
}

/** Key of the mixture that is shown first; undefined where a layer has fewer than three bands. */
export function proposeMix(layer: Layer): string | undefined {
  const numbers = bandsOf(layer).map(bandNumber);
  if (numbers.length < 3) return undefined;
  const chosen = proposeThree(numbers.map((number) => placeOf(layer, number)));
  return mixKey(chosen.map((i) => numbers[i]!));
}

/** A picture of a layer by its key, or a mixture of three of its bands. */
export function pictureOf(layer: Layer, key: string): Picture | undefined {
  const numbers = mixNumbers(key);
  if (!numbers) return layer.pictures.find((picture) => picture.key === key);
  const parts = numbers.flatMap(
    (number) => bandsOf(layer).find((picture) => bandNumber(picture) === number) ?? [],
  );
  const [first] = parts;
  if (!first || parts.length !== 3) return undefined;
  const labels = parts.map(({ label }) => label).join(" / ");
  return {
    ...first,
    key,
    label: `False colour, ${labels}`,
    kind: "mix",
    white: null,
    note: `${labels} as red, green and blue, each from 0 to its own white`,
    mixed: parts,
  };
}

/** What OpenSeadragon needs to show a picture, or a mixture: its tiles stand in script files. */
export function sourceOf(picture: Picture): Tiles["source"] {
  const parts = picture.mixed ?? [picture];
  return {
    tileSize: picture.tile,
    tileOverlap: picture.overlap,
    minLevel: picture.least,
    maxLevel: picture.most,
    getTileUrl: (level, x, y) =>
      parts.map(({ folder }) => `${folder}/${level}/${x}_${y}`).join("|"),
    downloadTileStart: (job: Job) => {
      Promise.all(job.src.split("|").map((key) => loadPicture(key, picture.format))).then(
        (images) =>
          picture.mixed
            ? job.finish(blend(images), null, "context2d")
            : job.finish(images[0]!, null, "image"),
        () => job.fail("a tile cannot be read", null),
      );
    },
    downloadTileAbort: () => {},
  } as Tiles["source"];
}

interface Job {
  src: string;
  finish(data: CanvasRenderingContext2D | HTMLImageElement, request: null, type: string): void;
  fail(message: string, request: null): void;
}

/** Ink each grey picture in its colour, and add them up. */
function blend(images: HTMLImageElement[]): CanvasRenderingContext2D {
  const { naturalWidth, naturalHeight } = images[0]!;
  const [sum, one] = [sheet(naturalWidth, naturalHeight), sheet(naturalWidth, naturalHeight)];
  sum.globalCompositeOperation = "lighter";
  images.forEach((image, i) => {
    one.globalCompositeOperation = "source-over";
    one.drawImage(image, 0, 0);
    one.globalCompositeOperation = "multiply";
    one.fillStyle = INKS[i]!;
    one.fillRect(0, 0, naturalWidth, naturalHeight);
    sum.drawImage(one.canvas, 0, 0);
  });
  return sum;
}

function sheet(width: number, height: number): CanvasRenderingContext2D {
  const canvas = document.createElement("canvas");
  [canvas.width, canvas.height] = [width, height];
  return canvas.getContext("2d")!;
}
