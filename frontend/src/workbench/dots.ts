// Thousands of small squares, set as pixels: a path of as many takes longer than all else on screen.

export class Dots {
  private readonly canvas = document.createElement("canvas");
  private readonly context = this.canvas.getContext("2d")!;
  private image = new ImageData(1, 1);
  private pixels = new Uint32Array(1);

  /** Begin anew on a picture of `width` x `height` pixels. */
  begin(width: number, height: number): void {
    if (this.image.width === width && this.image.height === height) {
      this.pixels.fill(0);
      return;
    }
    [this.canvas.width, this.canvas.height] = [width, height];
    this.image = new ImageData(Math.max(1, width), Math.max(1, height));
    this.pixels = new Uint32Array(this.image.data.buffer);
  }

  /** A square of `side` pixels about a place; `colour` as `packed` gives it. */
  square(x: number, y: number, side: number, colour: number): void {
    const { width, height } = this.image;
    const [left, top] = [Math.round(x - side / 2), Math.round(y - side / 2)];
    const [from, to] = [Math.max(left, 0), Math.min(left + side, width)];
    const last = Math.min(top + side, height);
    for (let row = Math.max(top, 0); row < last; row++)
      this.pixels.fill(colour, row * width + from, row * width + Math.max(from, to));
  }

  /** Lay all of it over what is drawn already, a pixel on a pixel. */
  drawOn(context: CanvasRenderingContext2D): void {
    this.context.putImageData(this.image, 0, 0);
    context.save();
    context.setTransform(1, 0, 0, 1, 0, 0);
    context.drawImage(this.canvas, 0, 0);
    context.restore();
  }
}

/** A colour of the style sheet as a pixel. */
export function packed(colour: string, context: CanvasRenderingContext2D): number {
  context.fillStyle = colour; // any colour of CSS becomes #rrggbb
  const [r, g, b] = [1, 3, 5].map((at) =>
    parseInt((context.fillStyle as string).slice(at, at + 2), 16),
  );
  return ((255 << 24) | (b! << 16) | (g! << 8) | r!) >>> 0;
}
