// One deep-zoom picture of one layer or more. Pixel centres are whole numbers.
import OpenSeadragon from "openseadragon";
import { make } from "./element";

/** A place in a picture, px, or on the page. */
export type Point = [x: number, y: number];
/** What a view shows: the place in its middle, and screen pixels a pixel. */
export type Aim = [x: number, y: number, scale: number];

/** A picture in tiles; `key` tells it from all others. */
export interface Layer {
  key: string;
  size: Point;
  source: Omit<OpenSeadragon.TileSourceOptions, "width" | "height"> & {
    getTileUrl: (level: number, x: number, y: number) => string;
  };
}

export interface PaneOptions {
  drawer: string | string[];
  zoomOnDoubleClick: boolean;
}

const MARGIN = 0.03; // of the longer side, round a picture that is fitted
const STILL_PX = 0.02;
const SMOOTH_BELOW = 3; // screen pixels a pixel: beyond, single pixels are shown as squares
const PATIENCE_COMPUTED_MS = 600_000; // for a tile that the page computes
const UNSAID_MS = 400; // a picture that is there by then does not say that it loads
const PATIENCE_MS = 1500; // for new tiles, before the old ones go all the same

export class Pane {
  readonly viewer: OpenSeadragon.Viewer;
  readonly host: HTMLElement;
  layers: OpenSeadragon.TiledImage[] = [];
  keys: string[] = [];
  onClick: (x: number, y: number) => void = () => {};
  /** Called whenever the view has changed. */
  onView: () => void = () => {};
  /** Called when a person moves the view. */
  onGesture: () => void = () => {};
  private generation = 0;
  private showing = 0;
  private smooth: boolean | null = null;
  private readonly loading = make(
    "p",
    { class: "loading", role: "status", hidden: true },
    "Loading the picture …",
  );

  constructor(
    parent: HTMLElement,
    private size: Point,
    options: PaneOptions,
  ) {
    this.host = make("div", { class: "pane" });
    parent.append(this.host);
    this.viewer = openViewer(this.host, options);
    this.host.append(this.loading);
    for (const name of ["animation", "animation-finish", "resize", "zoom", "pan"] as const)
      this.viewer.addHandler(name, () => {
        this.sharpen();
        this.onView();
      });
    for (const name of [
      "canvas-scroll",
      "canvas-drag",
      "canvas-pinch",
      "canvas-double-click",
    ] as const)
      this.viewer.addHandler(name, () => this.onGesture());
    this.viewer.addHandler("canvas-key", (event) => {
      event.preventDefaultAction = true; // the page has keys of its own
    });
    this.viewer.addHandler("canvas-click", (event) => {
      if (event.quick) this.onClick(...this.pixelOf(event));
    });
  }

  /** Show layers, the first one below; with patience what was there stays until they are loaded. */
  async show(layers: Layer[], patient: boolean): Promise<void> {
    this.size = layers[0]?.size ?? this.size;
    this.showing++;
    setTimeout(() => this.sayLoading(), UNSAID_MS);
    await this.exchange(layers, patient).finally(() => this.showing--);
    this.sayLoading();
  }

  /** Whether all that is in view is there, and nothing else is on its way. */
  get settled(): boolean {
    return (
      this.showing === 0 &&
      this.layers.length > 0 &&
      this.layers.every((image) => image.getFullyLoaded())
    );
  }

  /** Say over the picture that it is on its way, for as long as it is. */
  private sayLoading(): void {
    const late = this.showing > 0 || !this.layers.every((image) => image.getFullyLoaded());
    if (this.loading.hidden === late) this.loading.hidden = !late;
  }

  private async exchange(layers: Layer[], patient: boolean): Promise<void> {
    const keys = layers.map((layer) => layer.key);
    if (keys.join() === this.keys.join()) return;
    const mine = ++this.generation;
    const [old, before] = [this.layers, this.keys];
    const images: OpenSeadragon.TiledImage[] = [];
    for (const layer of layers)
      images.push(old[before.indexOf(layer.key)] ?? (await this.add(layer, patient)));
    const fresh = images.filter((image) => !old.includes(image));
    if (patient) await Promise.race([Promise.all(fresh.map(loaded)), wait(PATIENCE_MS)]);
    const { world } = this.viewer;
    if (mine !== this.generation) {
      for (const image of fresh) world.removeItem(image);
      return;
    }
    [this.layers, this.keys] = [images, keys];
    images.forEach((image, i) => {
      world.setItemIndex(image, world.getItemCount() - images.length + i);
      image.setOpacity(1);
    });
    for (const image of old) if (!images.includes(image)) world.removeItem(image);
  }

  private add({ size, source }: Layer, hidden: boolean): Promise<OpenSeadragon.TiledImage> {
    return new Promise((resolve, reject) => {
      this.viewer.addTiledImage({
        opacity: hidden ? 0 : 1,
        preload: true,
        tileSource: { width: size[0], height: size[1], ...source },
        success: (event) => {
          const { item } = event as unknown as { item: OpenSeadragon.TiledImage };
          item.addHandler("fully-loaded-change", () => this.sayLoading());
          resolve(item);
        },
        error: () => reject(new Error("a picture could not be opened")),
      });
    });
  }

  /** The pixel under a point of the page, fractions kept. */
  pixelAt(clientX: number, clientY: number): Point {
    const box = this.viewer.container.getBoundingClientRect();
    const point = new OpenSeadragon.Point(clientX - box.left, clientY - box.top);
    return this.toPixel(this.viewer.viewport.viewerElementToViewportCoordinates(point));
  }

  /** The pixel of an event of OpenSeadragon's. */
  protected pixelOf(event: { originalEvent: Event }): Point {
    const { clientX, clientY } = event.originalEvent as MouseEvent;
    return this.pixelAt(clientX, clientY);
  }

  /** Whether a pixel is one of the picture. */
  contains([x, y]: Point): boolean {
    return x >= -0.5 && y >= -0.5 && x < this.size[0] - 0.5 && y < this.size[1] - 0.5;
  }

  /** Where a pixel lies in the pane. */
  placeOf(x: number, y: number): Point {
    const place = this.viewer.viewport.viewportToViewerElementCoordinates(this.toViewport(x, y));
    return [place.x, place.y];
  }

  /** Where a pixel lies on the page. */
  pageOf(x: number, y: number): Point {
    const box = this.viewer.container.getBoundingClientRect();
    const [left, top] = this.placeOf(x, y);
    return [box.left + left, box.top + top];
  }

  /** Screen pixels a pixel. */
  get scale(): number {
    const { viewport } = this.viewer;
    return (viewport.getZoom(true) * viewport.getContainerSize().x) / this.size[0];
  }

  /** The pixel in the middle. */
  get centre(): Point {
    return this.toPixel(this.viewer.viewport.getCenter(true));
  }

  /** What the view shows, or is on its way to. */
  get aim(): Aim {
    const { viewport } = this.viewer;
    const scale = (viewport.getZoom(false) * viewport.getContainerSize().x) / this.size[0];
    return [...this.toPixel(viewport.getCenter(false)), scale];
  }

  /** A way on the screen as one in the picture, where that is turned. */
  along([x, y]: Point): Point {
    const turned = (this.viewer.viewport.getRotation(true) * Math.PI) / 180;
    const [cos, sin] = [Math.cos(turned), Math.sin(turned)];
    return [cos * x + sin * y, cos * y - sin * x];
  }

  /** Show a place in the middle; a view that is there already stays still. */
  look(x: number, y: number, scale: number, degrees = 0, immediately = true): void {
    const { viewport } = this.viewer;
    const width = viewport.getContainerSize().x;
    const zoom = (scale * this.size[0]) / width;
    const place = this.toViewport(x, y);
    this.turnTo(degrees);
    // Linked panes would answer one another for ever.
    if (Math.abs(viewport.getZoom(true) / zoom - 1) > 1e-5)
      viewport.zoomTo(zoom, undefined, immediately);
    if (place.distanceTo(viewport.getCenter(true)) * zoom * width > STILL_PX)
      viewport.panTo(place, immediately);
  }

  /** Whether the view knows how large the pane is: for a frame after a change it does not. */
  get isSized(): boolean {
    return Math.abs(this.viewer.viewport.getContainerSize().x - this.host.clientWidth) < 1;
  }

  /** The whole picture with a little of the wall around it. */
  private get whole(): OpenSeadragon.Rect {
    const [width, height] = [1, this.size[1] / this.size[0]];
    const edge = MARGIN * Math.max(width, height);
    return new OpenSeadragon.Rect(-edge, -edge, width + 2 * edge, height + 2 * edge);
  }

  /** Whether the picture is turned by so many degrees. */
  isTurned(degrees: number): boolean {
    const apart = positive(this.viewer.viewport.getRotation(true) - degrees);
    return Math.min(apart, 360 - apart) <= 0.01;
  }

  private turnTo(degrees: number): void {
    if (!this.isTurned(degrees)) this.viewer.viewport.setRotation(positive(degrees), true);
  }

  /** Whether the picture lies on its side. */
  private get aside(): boolean {
    return Math.round(this.viewer.viewport.getRotation(true) / 90) % 2 !== 0;
  }

  /** Show the whole picture, turned by quarters. */
  fit(immediately = true, degrees = 0): void {
    const { viewport } = this.viewer;
    this.turnTo(degrees);
    const whole = this.whole;
    if (!this.aside) {
      viewport.fitBounds(whole, immediately);
      return;
    }
    viewport.panTo(whole.getCenter(), immediately);
    viewport.zoomTo(this.fittedZoom(whole), undefined, immediately);
  }

  /** The zoom at which the whole picture is just in view. */
  private fittedZoom({ width, height }: OpenSeadragon.Rect): number {
    const [wide, tall] = this.aside ? [height, width] : [width, height];
    return 1 / Math.max(wide, tall * this.viewer.viewport.getAspectRatio());
  }

  /** Whether the picture is as small in the view as `fit` shows it, or smaller. */
  get isFitted(): boolean {
    return this.viewer.viewport.getZoom(true) <= 1.01 * this.fittedZoom(this.whole);
  }

  zoom(factor: number): void {
    this.viewer.viewport.zoomBy(factor);
    this.viewer.viewport.applyConstraints();
  }

  toViewport(x: number, y: number): OpenSeadragon.Point {
    return new OpenSeadragon.Point((x + 0.5) / this.size[0], (y + 0.5) / this.size[0]);
  }

  // OpenSeadragon's whole numbers are corners of pixels, ours their centres.
  private toPixel(place: OpenSeadragon.Point): Point {
    return [place.x * this.size[0] - 0.5, place.y * this.size[0] - 0.5];
  }

  private sharpen(): void {
    const smooth = this.scale < SMOOTH_BELOW;
    if (smooth === this.smooth) return;
    this.smooth = smooth; // setting it draws everything anew
    this.viewer.drawer.setImageSmoothingEnabled(smooth);
  }
}

/** An angle from 0 on, below 360 degrees. */
function positive(degrees: number): number {
  return ((degrees % 360) + 360) % 360;
}

/** Until all tiles in view are there. */
function loaded(image: OpenSeadragon.TiledImage): Promise<void> {
  return new Promise((resolve) => {
    if (image.getFullyLoaded()) resolve();
    else image.addOnceHandler("fully-loaded-change", () => resolve());
  });
}

function wait(ms: number): Promise<void> {
  return new Promise((resolve) => setTimeout(resolve, ms));
}

function openViewer(
  element: HTMLElement,
  { drawer, zoomOnDoubleClick }: PaneOptions,
): OpenSeadragon.Viewer {
  // OpenSeadragon adds a style element unless one with this mark is there; the page's policy forbids
  // style elements, and one of another namespace is none.
  const instead = document.createElementNS("urn:levkas", "style");
  instead.setAttribute("data-openseadragon-mobile-css", "");
  document.head.append(instead);
  const viewer = OpenSeadragon({
    element,
    drawer: drawer as OpenSeadragon.Options["drawer"],
    preserveViewport: true,
    showNavigationControl: false,
    showNavigator: false,
    animationTime: matchMedia("(prefers-reduced-motion: reduce)").matches ? 0 : 0.3,
    blendTime: 0,
    visibilityRatio: 0.3,
    minZoomImageRatio: 0.5,
    maxZoomPixelRatio: 40,
    defaultZoomLevel: 0,
    imageLoaderLimit: 6,
    timeout: PATIENCE_COMPUTED_MS,
    gestureSettingsMouse: { clickToZoom: false, dblClickToZoom: zoomOnDoubleClick },
    gestureSettingsTouch: { clickToZoom: false, dblClickToZoom: true },
    gestureSettingsPen: { clickToZoom: false },
  });
  instead.remove();
  return viewer;
}
