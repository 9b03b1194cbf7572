// One deep-zoom picture with the pairs drawn over it. Pixel centres are whole numbers.
import OpenSeadragon from "openseadragon";
import { make } from "../element";
import { onTheme } from "../theme";
import { Dots } from "./dots";
import type { Point } from "./record";

const TILE = 256;
const STILL_PX = 0.02;
const PATIENCE_MS = 1500; // for new tiles, before the old ones go all the same

export interface Layer {
  address: string;
  size: Point;
}

export class Pane {
  readonly viewer: OpenSeadragon.Viewer;
  readonly canvas = make("canvas", { class: "marks", "aria-hidden": "true" });
  /** The line under the picture: its name, and what can be chosen of it. */
  readonly foot = make("div", { class: "foot" });
  readonly label = make("span", { class: "label" });
  readonly host: HTMLElement;
  readonly dots = new Dots();
  layers: OpenSeadragon.TiledImage[] = [];
  private addresses: string[] = [];
  onClick: (x: number, y: number, event: MouseEvent) => void = () => {};
  onDrag: (x: number, y: number, done: boolean) => void = () => {};
  grab: (x: number, y: number) => boolean = () => false;
  onView: () => void = () => {};
  onGesture: () => void = () => {};
  paint: (context: CanvasRenderingContext2D) => void = () => {};
  private dragging = false;
  private generation = 0;
  private waiting = false;
  private showing = 0;
  private smooth: boolean | null = null;

  constructor(name: string, private size: Point) {
    this.host = make("div", { class: "pane", role: "group", "aria-label": name });
    this.viewer = openViewer(this.host);
    this.viewer.canvas.setAttribute("aria-label", `${name}: drag to pan, wheel or + and - to zoom`);
    this.label.textContent = name;
    this.foot.append(this.label);
    this.host.append(this.canvas, this.foot);
    for (const event of ["animation", "resize", "open", "zoom", "pan", "rotate", "update-viewport"] as const)
      this.viewer.addHandler(event, () => this.redraw());
    for (const event of ["animation", "animation-finish"] as const) this.viewer.addHandler(event, () => this.onView());
    for (const event of ["canvas-scroll", "canvas-drag", "canvas-pinch", "canvas-double-click"] as const) this.viewer.addHandler(event, () => this.onGesture());
    this.viewer.addHandler("canvas-key", (event) => {
      event.preventDefaultAction = true;
    });
    this.viewer.addHandler("canvas-click", (event) => {
      if (!event.quick) return;
      const at = event.originalEvent as MouseEvent;
      this.onClick(...this.pixelAt(at.clientX, at.clientY), at);
    });
    this.viewer.addHandler("canvas-press", (event) => {
      const at = event.originalEvent as MouseEvent;
      this.dragging = this.grab(...this.pixelAt(at.clientX, at.clientY));
    });
    this.viewer.addHandler("canvas-drag", (event) => {
      if (!this.dragging) return;
      event.preventDefaultAction = true;
      const at = event.originalEvent as MouseEvent;
      this.onDrag(...this.pixelAt(at.clientX, at.clientY), false);
    });
    this.viewer.addHandler("canvas-release", (event) => {
      if (!this.dragging) return;
      this.dragging = false;
      const at = event.originalEvent as MouseEvent;
      this.onDrag(...this.pixelAt(at.clientX, at.clientY), true);
    });
    new ResizeObserver(() => this.redraw()).observe(this.host);
    onTheme(() => this.redraw());
  }

  set name(words: string) {
    this.label.textContent = words;
  }

  /** Show layers, the first one below; with patience what was there stays until they are loaded. */
  async show(layers: Layer[], patient: boolean): Promise<void> {
    this.showing++;
    await this.exchange(layers, patient).finally(() => this.showing--);
  }

  /** Whether all that is in view is there, and nothing else is on its way. */
  get settled(): boolean {
    return this.showing === 0 && this.layers.length > 0 && this.layers.every((image) => image.getFullyLoaded());
  }

  private async exchange(layers: Layer[], patient: boolean): Promise<void> {
    const addresses = layers.map((layer) => layer.address);
    if (addresses.join() === this.addresses.join()) return;
    const mine = ++this.generation;
    const [old, before] = [this.layers, this.addresses];
    const made: OpenSeadragon.TiledImage[] = [];
    for (const [i, address] of addresses.entries()) made.push(old[before.indexOf(address)] ?? (await this.add(layers[i]!, patient)));
    const fresh = made.filter((image) => !old.includes(image));
    if (patient) await Promise.race([Promise.all(fresh.map(loaded)), wait(PATIENCE_MS)]);
    if (mine !== this.generation) {
      for (const image of fresh) this.viewer.world.removeItem(image);
      return;
    }
    [this.layers, this.addresses] = [made, addresses];
    this.size = layers[0]?.size ?? this.size;
    made.forEach((image, i) => this.viewer.world.setItemIndex(image, this.viewer.world.getItemCount() - made.length + i));
    for (const image of made) image.setOpacity(1);
    for (const image of old) if (!made.includes(image)) this.viewer.world.removeItem(image);
    this.redraw();
  }

  private add(layer: Layer, hidden: boolean): Promise<OpenSeadragon.TiledImage> {
    const most = Math.max(0, Math.ceil(Math.log2(Math.max(...layer.size) / TILE)));
    const [path, query] = layer.address.split("?");
    return new Promise((resolve, reject) => {
      this.viewer.addTiledImage({
        opacity: hidden ? 0 : 1,
        preload: hidden,
        tileSource: {
          width: layer.size[0],
          height: layer.size[1],
          tileSize: TILE,
          tileOverlap: 0,
          minLevel: 0,
          maxLevel: most,
          getTileUrl: (level: number, x: number, y: number) => `${path}/${most - level}/${x}/${y}?${query ?? ""}`,
        } as unknown as OpenSeadragon.TileSourceOptions,
        success: (event) => resolve((event as unknown as { item: OpenSeadragon.TiledImage }).item),
        error: () => reject(new Error("a picture could not be opened")),
      });
    });
  }

  /** The pixel under a point of the page, fractions kept. */
  pixelAt(clientX: number, clientY: number): Point {
    const box = this.viewer.container.getBoundingClientRect();
    const place = this.viewer.viewport.viewerElementToViewportCoordinates(new OpenSeadragon.Point(clientX - box.left, clientY - box.top));
    // OpenSeadragon's whole numbers are corners of pixels, ours their centres.
    return [place.x * this.size[0] - 0.5, place.y * this.size[0] - 0.5];
  }

  /** Where a pixel lies in the pane. */
  placeOf(x: number, y: number): Point {
    const place = this.viewer.viewport.viewportToViewerElementCoordinates(this.toViewport(x, y));
    return [place.x, place.y];
  }

  /** Where a pixel lies on the page. */
  pageOf(x: number, y: number): Point {
    const box = this.viewer.container.getBoundingClientRect();
    const [a, b] = this.placeOf(x, y);
    return [box.left + a, box.top + b];
  }

  /** Screen pixels a pixel. */
  get scale(): number {
    return (this.viewer.viewport.getZoom(true) * this.viewer.viewport.getContainerSize().x) / this.size[0];
  }

  get centre(): Point {
    const middle = this.viewer.viewport.getCenter(true);
    return [middle.x * this.size[0] - 0.5, middle.y * this.size[0] - 0.5];
  }

  /** The place in the middle and the scale that the view has, or is on its way to. */
  get aim(): [number, number, number] {
    const viewport = this.viewer.viewport;
    const [middle, across] = [viewport.getCenter(false), viewport.getContainerSize().x];
    return [middle.x * this.size[0] - 0.5, middle.y * this.size[0] - 0.5, (viewport.getZoom(false) * across) / this.size[0]];
  }

  /** Show a place in the middle, at `scale` screen pixels a pixel; a view that is there already stays still. */
  look(x: number, y: number, scale: number, degrees = 0, immediately = true): void {
    const viewport = this.viewer.viewport;
    const width = viewport.getContainerSize().x;
    const zoom = (scale * this.size[0]) / width;
    const place = this.toViewport(x, y);
    if (Math.abs(viewport.getRotation(true) - degrees) > 0.01) viewport.setRotation(degrees, true);
    // Linked panes would answer one another for ever.
    if (Math.abs(viewport.getZoom(true) / zoom - 1) > 1e-5) viewport.zoomTo(zoom, undefined, immediately);
    if (place.distanceTo(viewport.getCenter(true)) * zoom * width > STILL_PX) viewport.panTo(place, immediately);
  }

  /** Whether the view knows how large the pane is: for a frame after a change it does not. */
  get isSized(): boolean {
    return Math.abs(this.viewer.viewport.getContainerSize().x - this.host.clientWidth) < 1;
  }

  fit(): void {
    const [width, height] = [1, this.size[1] / this.size[0]];
    const edge = 0.03 * Math.max(width, height);
    this.viewer.viewport.fitBounds(new OpenSeadragon.Rect(-edge, -edge, width + 2 * edge, height + 2 * edge), true);
  }

  /** Whether the whole picture is in view, as `fit` shows it. */
  get isFitted(): boolean {
    const viewport = this.viewer.viewport;
    return viewport.getZoom(true) <= viewport.getHomeZoom() * 1.05;
  }

  zoom(factor: number): void {
    this.viewer.viewport.zoomBy(factor);
    this.viewer.viewport.applyConstraints();
  }

  /** Draw the marks anew with the next frame; asked for many times, done once. */
  redraw(): void {
    if (this.waiting) return;
    this.waiting = true;
    requestAnimationFrame(() => {
      this.waiting = false;
      this.draw();
    });
  }

  private draw(): void {
    const ratio = devicePixelRatio || 1;
    const [across, down] = [this.host.clientWidth, this.host.clientHeight];
    const [width, height] = [Math.round(across * ratio), Math.round(down * ratio)];
    if (this.canvas.width !== width || this.canvas.height !== height) [this.canvas.width, this.canvas.height] = [width, height];
    const context = this.canvas.getContext("2d");
    if (!context) return;
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
    context.clearRect(0, 0, across, down);
    this.paint(context);
    const smooth = this.scale < 4;
    if (smooth === this.smooth) return;
    this.smooth = smooth; // telling OpenSeadragon draws everything anew
    this.viewer.drawer.setImageSmoothingEnabled(smooth);
  }

  private toViewport(x: number, y: number): OpenSeadragon.Point {
    return new OpenSeadragon.Point((x + 0.5) / this.size[0], (y + 0.5) / this.size[0]);
  }
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

function openViewer(element: HTMLElement): OpenSeadragon.Viewer {
  // OpenSeadragon would put a style element into the page, which the page's policy forbids.
  const instead = document.createElementNS("urn:levkas", "style");
  instead.setAttribute("data-openseadragon-mobile-css", "");
  document.head.append(instead);
  const viewer = OpenSeadragon({
    element,
    drawer: "canvas",
    showNavigationControl: false,
    showNavigator: false,
    animationTime: matchMedia("(prefers-reduced-motion: reduce)").matches ? 0 : 0.3,
    blendTime: 0,
    visibilityRatio: 0.2,
    minZoomImageRatio: 0.4,
    maxZoomPixelRatio: 40,
    imageLoaderLimit: 6,
    gestureSettingsMouse: { clickToZoom: false, dblClickToZoom: false, scrollToZoom: true },
    gestureSettingsTouch: { clickToZoom: false, dblClickToZoom: true },
    gestureSettingsPen: { clickToZoom: false },
  });
  instead.remove();
  return viewer;
}
