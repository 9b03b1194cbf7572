// A loupe in a corner of a picture: the surroundings of a place, magnified and turned as the picture is.
import { signal } from "@preact/signals-core";
import { make } from "../shared/element";
import type { Layer, Point } from "../shared/pane";
import { turnAndScale, type PlaneMap } from "./maps";
import type { Half, Pair } from "./record";

interface Enlarged {
  layer: Layer;
  at: Point;
  /** Screen pixels a pixel. */
  scale: number;
  degrees: number;
}

const SIDE = 156; // px of the screen
const CROSS = 14; // of the lines that lead to the middle, and of the gap there
const MOST_TILES = 96;
const TILE = 256;

const TIMES = 2; // of the picture's own scale
const LEAST = 6; // screen pixels a pixel of the reference

/** Tiles that were loaded, the latest last. */
const tiles = new Map<string, HTMLImageElement>();

/** What is in either picture, and how it is shown. */
export interface LoupeScene {
  layers: [Layer, Layer];
  /** The pair that is chosen, proposed or dragged. */
  pair: Pair | null;
  dragged: boolean;
  /** Of a proposed pair the picture in which it was begun. */
  begun: Half | null;
  map: PlaneMap | null;
  /** Screen pixels a pixel of the reference. */
  scale: number;
  /** By which either picture is turned, without what the map turns. */
  degrees: [number, number];
}

/** A loupe for either picture. */
export class LoupePair {
  /** Whether they are there while a pair is chosen, proposed or dragged. */
  readonly use = signal(true);
  readonly left = new Loupe();
  readonly right = new Loupe();
  private pointer: { half: Half; at: Point } | null = null;
  private waiting = false;

  constructor(private readonly scene: () => LoupeScene | null) {}

  /** Take over where the pointer is; null where it is in no picture. */
  point(pointer: { half: Half; at: Point } | null): void {
    this.pointer = pointer;
    this.redraw();
  }

  /** Show what there is with the next frame. */
  redraw(): void {
    if (this.waiting) return;
    this.waiting = true;
    requestAnimationFrame(() => {
      this.waiting = false;
      const [left, right] = this.enlarged();
      this.left.show(left);
      this.right.show(right);
    });
  }

  private enlarged(): [Enlarged | null, Enlarged | null] {
    const [use, scene] = [this.use.peek(), this.scene()];
    if (!scene?.pair || !use) return [null, null];
    const { layers, pair, map, begun, degrees } = scene;
    const pointer = scene.dragged ? null : this.pointer;
    const [here, there] = placesOf(pair, pointer, begun);
    const scale = Math.max(LEAST, TIMES * scene.scale);
    const turn = map ? turnAndScale(map, ...there) : null;
    const turned = degrees[1] + (turn && !turn.mirrored ? turn.degrees : 0);
    return [
      { layer: layers[0], at: here, scale, degrees: degrees[0] },
      { layer: layers[1], at: there, scale: scale * (turn?.scale ?? 1), degrees: turned },
    ];
  }
}

class Loupe {
  readonly root = make("canvas", { class: "loupe", "aria-hidden": "true", hidden: true });
  private shown: Enlarged | null = null;

  /** Show a place, or nothing; tiles that are missing are drawn once they have come. */
  show(what: Enlarged | null): void {
    this.shown = what;
    this.root.hidden = !what;
    if (what) this.draw(what);
  }

  private draw({ layer, at: [x, y], scale, degrees }: Enlarged): void {
    const ratio = devicePixelRatio || 1;
    const side = Math.round(SIDE * ratio);
    if (this.root.width !== side) [this.root.width, this.root.height] = [side, side];
    const context = this.root.getContext("2d")!;
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
    context.clearRect(0, 0, SIDE, SIDE);
    context.translate(SIDE / 2, SIDE / 2);
    context.rotate((degrees * Math.PI) / 180);
    context.scale(scale, scale);
    context.translate(-x - 0.5, -y - 0.5);
    context.imageSmoothingEnabled = false;
    for (const [column, row] of tilesAround([x, y], SIDE / scale, layer.size)) {
      const tile = this.tile(layer.source.getTileUrl(layer.source.maxLevel ?? 0, column, row));
      if (tile) context.drawImage(tile, TILE * column, TILE * row);
    }
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
    cross(context);
  }

  private tile(address: string): HTMLImageElement | null {
    const known = tiles.get(address);
    if (known) return known.complete && known.naturalWidth ? known : null;
    const image = new Image();
    image.src = address;
    tiles.set(address, image);
    for (const oldest of [...tiles.keys()].slice(0, Math.max(0, tiles.size - MOST_TILES)))
      tiles.delete(oldest);
    image.decode().then(
      () => this.shown && this.draw(this.shown),
      () => tiles.delete(address),
    );
    return null;
  }
}

/** The places that the loupes show: of the pair; of a pair begun in one picture what is under the pointer in the other. */
export function placesOf(
  [x, y, targetX, targetY]: Pair,
  pointer: { half: Half; at: Point } | null,
  begun: Half | null,
): [Point, Point] {
  const [here, there]: [Point, Point] = [
    [x, y],
    [targetX, targetY],
  ];
  if (!pointer || begun === null || begun === pointer.half) return [here, there];
  return pointer.half === 0 ? [pointer.at, there] : [here, pointer.at];
}

/** Columns and rows of the tiles within a circle of `breadth` px about a place. */
export function tilesAround([x, y]: Point, breadth: number, [width, height]: Point): Point[] {
  const reach = (breadth / 2) * Math.SQRT2;
  const range = (at: number, size: number): number[] => {
    const first = Math.max(0, Math.floor((at + 0.5 - reach) / TILE));
    const last = Math.min(Math.ceil(size / TILE) - 1, Math.floor((at + 0.5 + reach) / TILE));
    return Array.from({ length: Math.max(0, last - first + 1) }, (_, i) => first + i);
  };
  return range(y, height).flatMap((row) => range(x, width).map((column): Point => [column, row]));
}

/** Lines towards the middle, which stays free: light on a dark ground, visible on any picture. */
function cross(context: CanvasRenderingContext2D): void {
  const [middle, gap] = [SIDE / 2, CROSS / 2];
  const path = new Path2D();
  for (const [dx, dy] of [
    [1, 0],
    [-1, 0],
    [0, 1],
    [0, -1],
  ] as const) {
    path.moveTo(middle + gap * dx, middle + gap * dy);
    path.lineTo(middle + (gap + CROSS) * dx, middle + (gap + CROSS) * dy);
  }
  for (const [strokeStyle, lineWidth] of [
    ["#000a", 3.5],
    ["#fff", 1.2],
  ] as const) {
    Object.assign(context, { strokeStyle, lineWidth });
    context.stroke(path);
  }
}
