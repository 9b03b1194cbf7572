// The picture itself: two layers, A and B, in one deep zoom, and the ways of comparing them.
import OpenSeadragon from "openseadragon";
import { make } from "../element";
import { Curtain } from "./curtain";
import { Flicker } from "./flicker";
import { mixedSource } from "./mixing";
import type { Picture } from "./record";

export type Slot = "a" | "b";
export type Mode = "single" | "curtain" | "flicker" | "side" | "difference";
export interface Pixel {
  x: number;
  y: number;
}

const SMOOTH_BELOW = 3; // screen pixels a pixel: beyond, single pixels are shown as squares
const PAN_STEP = 0.12;
const MARGIN = 0.035; // of the longer side

/** A deep zoom with two slots. Pixels are those of the grid: centres at integers. */
export class Stage {
  readonly viewer: OpenSeadragon.Viewer;
  readonly flicker: Flicker;
  readonly curtain: Curtain;
  mode: Mode = "single";
  onPoint: (pixel: Pixel | null) => void = () => {};
  onPick: (pixel: Pixel) => void = () => {};
  onView: () => void = () => {};
  private second: OpenSeadragon.Viewer | null = null;
  private readonly panes: { a: HTMLElement; b: HTMLElement };
  private readonly pictures: { a: Picture | null; b: Picture | null } = { a: null, b: null };
  private readonly images: { a: OpenSeadragon.TiledImage | null; b: OpenSeadragon.TiledImage | null } = { a: null, b: null };
  private besideShown: Picture | null = null;
  private marked: Pixel | null = null;
  private amplify = 4;
  private brightness = 1;
  private contrast = 1;

  constructor(host: HTMLElement, private readonly size: { width: number; height: number }) {
    this.panes = { a: make("div", { class: "pane" }), b: make("div", { class: "pane beside", hidden: true }) };
    host.append(this.panes.a, this.panes.b);
    this.viewer = openViewer(this.panes.a);
    this.flicker = new Flicker((shown) => this.applyOpacity(shown));
    this.curtain = new Curtain(this.panes.a, () => this.applyClip());
    this.wire();
  }

  /** Show a picture in a slot; what was there stays until the new one is drawn. */
  show(slot: Slot, picture: Picture): void {
    this.pictures[slot] = picture;
    if (slot === "a" || this.needsB) this.load(slot, picture);
    if (slot === "b") this.loadBeside();
  }

  /** Which picture a slot has. */
  picture(slot: Slot): Picture | null {
    return this.pictures[slot];
  }

  setMode(mode: Mode): void {
    const resized = (mode === "side") !== (this.mode === "side");
    this.mode = mode;
    const b = this.pictures.b;
    if (this.needsB && b && !this.images.b) this.load("b", b);
    this.panes.b.hidden = mode !== "side";
    this.panes.a.parentElement?.classList.toggle("split", mode === "side");
    this.loadBeside();
    this.curtain.shown = mode === "curtain";
    if (mode === "flicker") this.flicker.start();
    else this.flicker.stop();
    this.apply();
    if (resized) this.keepPlace();
  }

  /** Flicker for as long as a key is held, whatever the mode. */
  hold(on: boolean): void {
    const b = this.pictures.b;
    if (on && b && !this.images.b) this.load("b", b);
    if (on) this.flicker.start();
    else if (this.mode !== "flicker") this.flicker.stop();
    this.apply();
  }

  /** The pane has another width now: the middle and the scale stay, and the panes agree. */
  private keepPlace(): void {
    const [centre, scale] = [this.centre, this.scale];
    const whole = Math.abs(this.viewer.viewport.getZoom(true) / this.wholeZoom - 1) < 0.01;
    requestAnimationFrame(() => {
      this.viewer.forceResize();
      this.second?.forceResize();
      requestAnimationFrame(() => {
        if (whole) this.fit(true);
        else this.look(centre, scale);
        if (this.second) follow(this.second, this.viewer);
      });
    });
  }

  /** The zoom of `fit`. */
  private get wholeZoom(): number {
    const [width, height] = [1, this.size.height / this.size.width];
    const edge = 2 * MARGIN * Math.max(width, height);
    const aspect = this.viewer.viewport.getAspectRatio();
    return 1 / Math.max(width + edge, (height + edge) * aspect);
  }

  setTone(brightness: number, contrast: number, amplify: number): void {
    Object.assign(this, { brightness, contrast, amplify });
    this.apply();
  }

  /** Show the whole picture with a little of the wall around it. */
  fit(immediately = false): void {
    const [width, height] = [1, this.size.height / this.size.width];
    const edge = MARGIN * Math.max(width, height);
    this.viewer.viewport.fitBounds(new OpenSeadragon.Rect(-edge, -edge, width + 2 * edge, height + 2 * edge), immediately);
  }

  zoom(factor: number): void {
    this.viewer.viewport.zoomBy(factor);
    this.viewer.viewport.applyConstraints();
  }

  pan(x: number, y: number): void {
    const bounds = this.viewer.viewport.getBounds();
    this.viewer.viewport.panBy(new OpenSeadragon.Point(x * PAN_STEP * bounds.width, y * PAN_STEP * bounds.height));
    this.viewer.viewport.applyConstraints();
  }

  /** Screen pixels a pixel of the grid. */
  get scale(): number {
    return (this.viewer.viewport.getZoom(true) * this.viewer.viewport.getContainerSize().x) / this.size.width;
  }

  /** The pixel at the middle of the view. */
  get centre(): Pixel {
    const middle = this.viewer.viewport.getCenter(true);
    return { x: middle.x * this.size.width - 0.5, y: middle.y * this.size.width - 0.5 };
  }

  /** Move the view: the pixel at its middle, and screen pixels a pixel. */
  look(pixel: Pixel, scale: number): void {
    const viewport = this.viewer.viewport;
    viewport.zoomTo((scale * this.size.width) / viewport.getContainerSize().x, undefined, true);
    viewport.panTo(this.toViewport(pixel), true);
  }

  /** The pixel under a point of the page, fractions kept; null outside the picture. */
  pixelAt(clientX: number, clientY: number, pane: Slot = "a"): Pixel | null {
    const viewer = pane === "b" && this.second ? this.second : this.viewer;
    const box = viewer.container.getBoundingClientRect();
    const place = viewer.viewport.pointFromPixel(new OpenSeadragon.Point(clientX - box.left, clientY - box.top), true);
    // OpenSeadragon's integers are corners of pixels, ours their centres.
    const pixel = { x: place.x * this.size.width - 0.5, y: place.y * this.size.width - 0.5 };
    const inside = pixel.x >= -0.5 && pixel.y >= -0.5 && pixel.x < this.size.width - 0.5 && pixel.y < this.size.height - 0.5;
    return inside ? pixel : null;
  }

  /** Where a pixel is on the page. */
  pointOf(pixel: Pixel): { x: number; y: number } {
    const box = this.viewer.container.getBoundingClientRect();
    const point = this.viewer.viewport.pixelFromPoint(this.toViewport(pixel), true);
    return { x: box.left + point.x, y: box.top + point.y };
  }

  /** Mark a pixel in every pane, or take the marks away. */
  mark(pixel: Pixel | null): void {
    this.marked = pixel;
    for (const viewer of this.viewers) {
      viewer.clearOverlays();
      if (!pixel) continue;
      const element = make("div", { class: "pin", "aria-hidden": "true" });
      viewer.addOverlay({ element, location: this.toViewport(pixel), placement: OpenSeadragon.Placement.CENTER });
    }
  }

  /** Whether all that is in view has been drawn in full. */
  get settled(): boolean {
    const wanted: Slot[] = this.needsB ? ["a", "b"] : ["a"];
    return wanted.every((slot) => !this.pictures[slot] || this.images[slot]?.getFullyLoaded() === true);
  }

  private get needsB(): boolean {
    return this.mode === "curtain" || this.mode === "flicker" || this.mode === "difference" || this.flicker.running;
  }

  private toViewport(pixel: Pixel): OpenSeadragon.Point {
    return new OpenSeadragon.Point((pixel.x + 0.5) / this.size.width, (pixel.y + 0.5) / this.size.width);
  }

  private load(slot: Slot, picture: Picture): void {
    const world = this.viewer.world;
    const old = this.images[slot];
    const index = slot === "a" ? (old ? world.getIndexOfItem(old) + 1 : 0) : world.getItemCount();
    this.viewer.addTiledImage({
      tileSource: tileSource(picture),
      index,
      opacity: slot === "a" || this.needsB ? 1 : 0,
      preload: true,
      success: (event) => {
        const image = (event as unknown as { item: OpenSeadragon.TiledImage }).item;
        if (this.pictures[slot] !== picture) return world.removeItem(image);
        const before = this.images[slot];
        this.images[slot] = image;
        // Pictures may come in any order: B is always above A.
        if (this.images.b) world.setItemIndex(this.images.b, world.getItemCount() - 1);
        this.apply();
        if (before) afterLoading(image, () => world.removeItem(before));
      },
    });
  }

  private loadBeside(): void {
    const picture = this.pictures.b;
    if (this.mode !== "side" || !picture || this.besideShown === picture) return;
    this.besideShown = picture;
    const beside = (this.second ??= this.openSecond());
    const world = beside.world;
    const before = world.getItemCount() ? world.getItemAt(world.getItemCount() - 1) : null;
    beside.addTiledImage({
      tileSource: tileSource(picture),
      success: (event) => {
        const image = (event as unknown as { item: OpenSeadragon.TiledImage }).item;
        if (before) afterLoading(image, () => world.removeItem(before));
        follow(beside, this.viewer);
      },
    });
  }

  /** Bring opacity, clip, blending and tone in line with the mode. */
  private apply(): void {
    const { b } = this.images;
    if (b) b.setCompositeOperation(this.mode === "difference" && !this.flicker.running ? "difference" : "source-over");
    this.applyOpacity(this.flicker.shown);
    this.applyClip();
    const gain = this.mode === "difference" && !this.flicker.running ? this.amplify : 1;
    const tone = `brightness(${this.brightness * gain}) contrast(${this.contrast})`;
    for (const viewer of this.viewers) viewer.drawer.canvas.style.filter = tone === "brightness(1) contrast(1)" ? "" : tone;
  }

  private applyOpacity(shown: Slot): void {
    const { b } = this.images;
    if (!b) return;
    if (this.flicker.running) b.setOpacity(shown === "b" ? 1 : 0);
    else b.setOpacity(this.mode === "curtain" || this.mode === "difference" ? 1 : 0);
  }

  private applyClip(): void {
    const { b } = this.images;
    if (!b) return;
    if (this.mode !== "curtain" || this.flicker.running) {
      if (b.getClip()) b.setClip(null);
      return;
    }
    const x = this.curtain.fraction * this.viewer.viewport.getContainerSize().x;
    const edge = this.viewer.viewport.pointFromPixel(new OpenSeadragon.Point(x, 0), true).x * this.size.width;
    const left = Math.min(Math.max(edge, 0), this.size.width);
    const clip = b.getClip();
    if (clip && Math.abs(clip.x - left) < 1e-3) return;
    b.setOpacity(left < this.size.width ? 1 : 0);
    b.setClip(new OpenSeadragon.Rect(left, 0, Math.max(this.size.width - left, 1e-3), this.size.height));
  }

  private get viewers(): OpenSeadragon.Viewer[] {
    return this.second ? [this.viewer, this.second] : [this.viewer];
  }

  private openSecond(): OpenSeadragon.Viewer {
    const viewer = openViewer(this.panes.b);
    this.second = viewer;
    for (const name of ["animation", "zoom", "pan"] as const) viewer.addHandler(name, () => this.mode === "side" && follow(this.viewer, viewer));
    this.listenTo("b", viewer);
    this.mark(this.marked);
    this.apply();
    return viewer;
  }

  private wire(): void {
    const changed = (): void => {
      this.applyClip();
      if (this.mode === "side" && this.second) follow(this.second, this.viewer);
      this.onView();
    };
    for (const name of ["animation", "animation-finish", "resize", "open", "zoom", "pan"] as const) this.viewer.addHandler(name, changed);
    this.listenTo("a", this.viewer);
  }

  private listenTo(slot: Slot, viewer: OpenSeadragon.Viewer): void {
    viewer.addHandler("animation", () => sharpen(viewer, this.scale));
    viewer.addHandler("canvas-key", (event) => {
      event.preventDefaultAction = true;
    });
    viewer.addHandler("canvas-click", (event) => {
      const at = event.originalEvent as MouseEvent;
      const pixel = event.quick ? this.pixelAt(at.clientX, at.clientY, slot) : null;
      if (pixel) this.onPick(pixel);
    });
    viewer.container.addEventListener("pointermove", (event) => this.onPoint(this.pixelAt(event.clientX, event.clientY, slot)));
    viewer.container.addEventListener("pointerleave", () => this.onPoint(null));
  }
}

function openViewer(element: HTMLElement): OpenSeadragon.Viewer {
  // OpenSeadragon would put a style element into the page, which the page's policy forbids.
  const instead = document.createElementNS("urn:levkas", "style");
  instead.setAttribute("data-openseadragon-mobile-css", "");
  document.head.append(instead);
  const viewer = startViewer(element);
  instead.remove();
  return viewer;
}

function startViewer(element: HTMLElement): OpenSeadragon.Viewer {
  const drawer = findDrawer();
  const viewer = OpenSeadragon({
    element,
    drawer: drawer as OpenSeadragon.Options["drawer"],
    crossOriginPolicy: false,
    preserveViewport: true,
    showNavigationControl: false,
    showNavigator: false,
    animationTime: matchMedia("(prefers-reduced-motion: reduce)").matches ? 0 : 0.35,
    blendTime: 0,
    visibilityRatio: 0.3,
    minZoomImageRatio: 0.5,
    maxZoomPixelRatio: 40,
    defaultZoomLevel: 0,
    imageLoaderLimit: 6,
    gestureSettingsMouse: { clickToZoom: false, dblClickToZoom: true, scrollToZoom: true },
    gestureSettingsTouch: { clickToZoom: false, dblClickToZoom: true },
    gestureSettingsPen: { clickToZoom: false },
  });
  // The stage around it has the name, takes the focus and listens to the keys.
  viewer.canvas.removeAttribute("tabindex");
  return viewer;
}

/** WebGL where it is done by a graphics card and may use the tiles; from file:// it may not, and stays blank. */
function findDrawer(): string | string[] {
  const wanted = new URLSearchParams(location.search).get("drawer");
  if (wanted === "canvas" || location.protocol === "file:") return "canvas";
  return wanted === "webgl" || hasGraphicsCard() ? ["webgl", "canvas"] : "canvas";
}

/** Whether WebGL is there and is no software: that is slower than drawing without it. */
function hasGraphicsCard(): boolean {
  const context = document.createElement("canvas").getContext("webgl2", { failIfMajorPerformanceCaveat: true });
  if (!context) return false;
  const facts = context.getExtension("WEBGL_debug_renderer_info");
  const name = String(context.getParameter(facts ? facts.UNMASKED_RENDERER_WEBGL : context.RENDERER));
  context.getExtension("WEBGL_lose_context")?.loseContext();
  return !/swiftshader|llvmpipe|softpipe|software|basic render/i.test(name);
}

function tileSource(picture: Picture): OpenSeadragon.TileSourceOptions {
  const addressOf = (part: Picture, level: number, x: number, y: number): string => `${part.folder.split("/").map(encodeURIComponent).join("/")}/${level}/${x}_${y}.${part.format}`;
  return {
    width: picture.width,
    height: picture.height,
    tileSize: picture.tile,
    tileOverlap: picture.overlap,
    minLevel: picture.least,
    maxLevel: picture.most,
    getTileUrl: (level: number, x: number, y: number) => addressOf(picture, level, x, y),
    ...(picture.mixed ? mixedSource(picture.mixed, addressOf) : {}),
  } as unknown as OpenSeadragon.TileSourceOptions;
}

/** Give one view the place and scale of another. */
function follow(view: OpenSeadragon.Viewer, leader: OpenSeadragon.Viewer): void {
  const [to, from] = [view.viewport, leader.viewport];
  if (!view.world.getItemCount()) return;
  const apart = to.getCenter(true).distanceTo(from.getCenter(true));
  if (Math.abs(to.getZoom(true) / from.getZoom(true) - 1) > 1e-6) to.zoomTo(from.getZoom(true), undefined, true);
  if (apart > 1e-7) to.panTo(from.getCenter(true), true);
}

function sharpen(viewer: OpenSeadragon.Viewer, scale: number): void {
  viewer.drawer.setImageSmoothingEnabled(scale < SMOOTH_BELOW);
}

function afterLoading(image: OpenSeadragon.TiledImage, then: () => void): void {
  if (image.getFullyLoaded()) then();
  else image.addOnceHandler("fully-loaded-change", then);
}
