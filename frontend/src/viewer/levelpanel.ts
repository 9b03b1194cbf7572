// The panel "Levels": a histogram of what is shown, with handles for black, middle and white.
import { computed, effect, signal } from "@preact/signals-core";
import { radioGroup } from "../shared/controls";
import { draw, make } from "../shared/element";
import type { Point } from "../shared/pane";
import { joined } from "../shared/plot";
import { watch } from "../shared/watch";
import type { Address } from "./address";
import {
  bounded,
  countSteps,
  decode,
  fromText,
  gammaFor,
  hasLevels,
  middleOf,
  percentiles,
  placeOf,
  plainLevels,
  STEPS,
  tableOf,
  toText,
  valueAt,
  whiteOf,
  type Levels,
} from "./levels";
import { loadWhole } from "./mixing";
import type { Picture } from "./record";
import type { PaintingStage } from "./stage";
import { SLOTS, type Choice, type Slot, type State } from "./state";

const [WIDTH, HEIGHT] = [320, 84];
const SAMPLE_PX = 320; // of the longer side of what is counted
const LEAST_PIXELS = 64;
const TAILS = 0.01; // of the pixels, at either end, that a stretch gives up
const STEP = 1 / 255;
const MOST_NAMES = 100;
const WAIT_MS = 150;

type Handle = "black" | "middle" | "white";
const HANDLES: Handle[] = ["black", "middle", "white"];
const MARKS: Record<Handle, string> = { black: "Black", middle: "Gamma", white: "White" };

export class LevelPanel {
  private readonly slot = signal<Slot>("a");
  /** The slot that is worked on: the chosen one while it is on the screen. */
  private readonly active = computed<Slot>(() => {
    const slots = this.stage.slots.value;
    return slots.includes(this.slot.value) ? this.slot.value : "a";
  });
  private readonly choice = computed(() => this.state[this.active.value].value);
  private readonly bars = draw("polygon", { class: "bars" });
  private readonly curve = draw("polyline", { class: "law" });
  private readonly plot = draw("svg", {
    viewBox: `0 0 ${WIDTH} ${HEIGHT}`,
    preserveAspectRatio: "none",
    role: "img",
    "aria-label": "Histogram of what is in view",
  });
  private readonly handles = new Map<Handle, HTMLElement>();
  private readonly field = make("div", { class: "level-field" });
  private readonly words = make("p", { class: "note-line", role: "status" });
  private readonly message = make("p", { class: "note-line soft" });
  private readonly invert = toggle("Invert");
  private readonly lock = toggle("Same levels for all");
  private readonly body: HTMLElement;
  private counts: number[] = [];
  private waiting = 0;
  private turn = 0;

  constructor(
    private readonly host: HTMLDetailsElement,
    private readonly stage: PaintingStage,
    private readonly state: State,
    address: Address,
  ) {
    const tabs = make("div", {
      class: "level-tabs",
      role: "radiogroup",
      "aria-label": "Levels of",
    });
    radioGroup(
      tabs,
      SLOTS.map((value) => ({ value, label: value.toUpperCase() })),
      this.active,
      (slot) => (this.slot.value = slot),
    );
    this.plot.append(this.bars, this.curve);
    this.field.append(this.plot);
    for (const handle of HANDLES) this.field.append(this.makeHandle(handle));
    const [view, whole, reset] = ["Stretch view", "Stretch whole", "Reset"].map(small) as [
      HTMLButtonElement,
      HTMLButtonElement,
      HTMLButtonElement,
    ];
    view.title = "Black and white at 1 % and 99 % of what is in view";
    whole.title = "Black and white at 1 % and 99 % of the whole picture";
    view.addEventListener("click", () => void this.stretch(false));
    whole.addEventListener("click", () => void this.stretch(true));
    reset.addEventListener("click", () => this.reset());
    this.invert.addEventListener("click", () => this.change({ inverted: !this.levels?.inverted }));
    this.lock.addEventListener("click", () => this.toggleLock());
    this.lock.title = "The same value has the same brightness in all pictures";
    const buttons = make("div", { class: "pin-tools" }, view, whole, this.invert, reset);
    const below = make("div", { class: "pin-tools" }, this.lock);
    this.body = make("div", {}, this.field, this.words, buttons);
    host.append(tabs, this.body, this.message, below);
    host.addEventListener("toggle", () => this.count());
    effect(() => {
      const slots = this.stage.slots.value;
      tabs.hidden = slots.length < 2;
      tabs.querySelectorAll("button").forEach((button, i) => {
        button.hidden = !slots.includes(SLOTS[i]!);
      });
    });
    effect(() => this.show());
    watch([this.choice], () => this.count());
    this.register(address);
  }

  /** Open the panel, and go to its first handle. */
  open(): void {
    this.host.open = true;
    this.host.scrollIntoView({ block: "nearest" });
    this.handles.get("black")!.focus();
  }

  /** Let one set of levels hold for all pictures, or each have its own again. */
  toggleLock(): void {
    const { state } = this;
    if (state.locked.value) state.locked.value = null;
    else {
      const levels = this.shown.map((choice) => state.levelsOf(choice));
      const white = Math.max(...levels.map((one) => one.white));
      state.locked.value = bounded({ ...(this.levels ?? plainLevels(white)), white });
    }
  }

  /** Count the pixels in view anew, a moment after the last change. */
  count(): void {
    clearTimeout(this.waiting);
    if (this.host.open) this.waiting = window.setTimeout(() => void this.recount(), WAIT_MS);
  }

  private async recount(): Promise<void> {
    const mine = ++this.turn;
    let counts = this.countView(this.active.peek());
    const few = sum(counts) < LEAST_PIXELS;
    const choice = this.choice.peek();
    if (few && choice) counts = await countWhole(choice.picture).catch(() => []);
    if (mine !== this.turn) return;
    this.counts = counts;
    this.plot.setAttribute(
      "aria-label",
      few ? "Histogram of the whole picture" : "Histogram of what is in view",
    );
    this.show();
  }

  /** Choices that are on the screen and have levels. */
  private get shown(): Choice[] {
    const choices = this.stage.slots.value.flatMap((slot) => this.state[slot].value ?? []);
    return choices.filter(({ picture }) => hasLevels(picture));
  }

  private get levels(): Levels | null {
    const choice = this.choice.value;
    return choice && hasLevels(choice.picture) ? this.state.levelsOf(choice) : null;
  }

  /** The value at the right end of the axis. */
  private get top(): number {
    const levels = this.levels;
    const whites = (this.state.locked.value ? this.shown : [this.choice.value]).map((choice) =>
      choice ? whiteOf(choice.picture) : 1,
    );
    return Math.max(...whites, levels?.white ?? 0);
  }

  private makeHandle(handle: Handle): HTMLElement {
    const element = make("div", {
      class: `level-handle ${handle}`,
      role: "slider",
      tabindex: 0,
      "aria-label": MARKS[handle],
      "aria-orientation": "horizontal",
      "aria-valuemin": 0,
      "aria-valuemax": 100,
    });
    this.handles.set(handle, element);
    element.addEventListener("pointerdown", (event) => {
      event.preventDefault();
      element.focus();
      element.setPointerCapture(event.pointerId);
    });
    element.addEventListener("pointermove", (event) => {
      if (!element.hasPointerCapture(event.pointerId)) return;
      const box = this.plot.getBoundingClientRect();
      this.move(handle, (event.clientX - box.left) / box.width);
    });
    element.addEventListener("keydown", (event) => {
      const by = { ArrowLeft: -1, ArrowDown: -1, ArrowRight: 1, ArrowUp: 1 }[event.key];
      const page = { PageDown: -10, PageUp: 10 }[event.key];
      const to = { Home: 0, End: 1 }[event.key];
      if (by === undefined && page === undefined && to === undefined) return;
      event.preventDefault();
      event.stopPropagation();
      const steps = page ?? (by ?? 0) * (event.shiftKey ? 10 : 1);
      this.move(handle, to ?? this.place(handle) + steps * STEP);
    });
    return element;
  }

  /** Where a handle stands, 0 left to 1 right. */
  private place(handle: Handle): number {
    const { levels, top } = this;
    if (!levels) return 0;
    return placeOf(handle === "middle" ? middleOf(levels) : levels[handle], top);
  }

  private move(handle: Handle, place: number): void {
    const { levels, top } = this;
    if (!levels) return;
    const value = valueAt(place, top);
    if (handle === "black")
      this.change({ black: Math.min(value, valueAt(this.place("white") - STEP, top)) });
    else if (handle === "white")
      this.change({ white: Math.max(value, valueAt(this.place("black") + STEP, top)) });
    else this.change({ gamma: gammaFor(value, levels) });
  }

  private change(part: Partial<Levels>): void {
    const [choice, levels] = [this.choice.peek(), this.levels];
    if (choice && levels) this.state.setLevels(choice, bounded({ ...levels, ...part }));
  }

  private reset(): void {
    const { state } = this;
    if (state.locked.value) {
      const white = Math.max(...this.shown.map(({ picture }) => whiteOf(picture)));
      state.locked.value = plainLevels(white);
    } else if (this.choice.value) state.setLevels(this.choice.value, null);
    this.message.textContent = "";
  }

  /** Put black and white at 1 % and 99 % of the pixels; of all pictures on the screen where levels are locked. */
  private async stretch(whole: boolean): Promise<void> {
    const { stage, state } = this;
    const slots = state.locked.value ? stage.slots.value : [this.active.value];
    const bounds: Point[] = [];
    let few = false;
    for (const slot of slots) {
      const picture = state[slot].value?.picture;
      if (!picture || !hasLevels(picture)) continue;
      let counts = whole ? [] : this.countView(slot);
      if (sum(counts) < LEAST_PIXELS) {
        few ||= !whole;
        counts = await countWhole(picture).catch(() => []);
      }
      const found = percentiles(counts, TAILS, 1 - TAILS);
      const white = whiteOf(picture);
      if (found) bounds.push([white * decode(found[0] * STEP), white * decode(found[1] * STEP)]);
    }
    if (!bounds.length) return;
    const black = Math.min(...bounds.map(([low]) => low));
    const white = Math.max(...bounds.map(([, high]) => high), black + 1e-3);
    this.change({ black, white, gamma: 1 });
    this.message.textContent = few
      ? "Too little of the picture is in view: the whole picture was used."
      : "";
  }

  /** Count the steps that a pane shows now, before any levels. */
  private countView(slot: Slot): number[] {
    const cell = this.stage.cells.find((one) => one.slot === slot)!;
    const canvas = cell.pane.viewer.drawer.canvas;
    if (!canvas.width || !canvas.height || !cell.pane.layers.length) return [];
    try {
      return countIn(canvas, canvas.width, canvas.height);
    } catch {
      return []; // a browser that forbids reading what is drawn
    }
  }

  private show(): void {
    const { levels, top } = this;
    const { locked } = this.state;
    this.lock.setAttribute("aria-pressed", String(locked.value !== null));
    this.body.hidden = !levels;
    const choice = this.choice.value;
    if (!levels || !choice) {
      this.message.textContent = choice
        ? "A map has fixed colours, which its legend explains: it has no levels."
        : "";
      return;
    }
    this.message.textContent = "";
    this.invert.setAttribute("aria-pressed", String(levels.inverted));
    this.drawBars(choice.picture, top);
    const law = Array.from({ length: 65 }, (_, i): Point => {
      const shown = tableOf(levels, top)[Math.round((i / 64) * (STEPS - 1))]!;
      return [(i / 64) * WIDTH, HEIGHT * (1 - shown)];
    });
    this.curve.setAttribute("points", joined(law));
    const values = { black: levels.black, middle: middleOf(levels), white: levels.white };
    for (const handle of HANDLES) {
      const element = this.handles.get(handle)!;
      const place = 100 * this.place(handle);
      element.style.left = `calc(${place / 100} * (100% - 18px))`;
      element.setAttribute("aria-valuenow", place.toFixed(0));
      const text = handle === "middle" ? levels.gamma.toFixed(2) : say(values[handle]);
      element.setAttribute("aria-valuetext", text);
    }
    const unit = choice.picture.white === null ? "" : ` ${choice.layer.quantity}`;
    this.words.textContent = `Black ${say(levels.black)} · gamma ${levels.gamma.toFixed(2)} · white ${say(levels.white)}${unit}`;
  }

  private drawBars(picture: Picture, top: number): void {
    const white = whiteOf(picture);
    const most = Math.max(1, ...this.counts.slice(1, -1));
    const high = (n: number): number => HEIGHT * (1 - Math.min(1, Math.sqrt(n / most)));
    const points = this.counts.map((n, i): Point => [
      WIDTH * placeOf(white * decode(i * STEP), top),
      high(n),
    ]);
    const ends: Point[] = [
      [WIDTH * placeOf(white, top), HEIGHT],
      [0, HEIGHT],
    ];
    this.bars.setAttribute("points", points.length ? joined([...points, ...ends]) : "");
  }

  private register(address: Address): void {
    const { levels, locked } = this.state;
    address.add({
      signals: [levels, locked],
      carried: true,
      write: (facts) => {
        for (const [name, one] of Object.entries(levels.value))
          facts.append("levels", `${toText(one)},${name}`);
        if (locked.value) facts.set("locked", toText(locked.value));
      },
      read: (facts) => {
        const found = facts.getAll("levels").slice(0, MOST_NAMES).map(readNamed);
        levels.value = Object.fromEntries(found.filter((one) => one !== null));
        locked.value = fromText(facts.get("locked") ?? "");
      },
    });
  }
}

/** Read levels and the name of a picture from an address. */
function readNamed(text: string): [string, Levels] | null {
  const parts = text.split(",");
  const levels = fromText(parts.slice(0, 4).join());
  return levels && parts.length > 4 ? [parts.slice(4).join(), levels] : null;
}

async function countWhole(picture: Picture): Promise<number[]> {
  const image = await loadWhole(picture);
  return countIn(image, image.width, image.height);
}

/** Count the steps of a picture, or of every n-th of its pixels. */
function countIn(image: CanvasImageSource, width: number, height: number): number[] {
  const part = Math.min(1, SAMPLE_PX / Math.max(width, height));
  const canvas = document.createElement("canvas");
  [canvas.width, canvas.height] = [Math.ceil(part * width), Math.ceil(part * height)];
  const context = canvas.getContext("2d", { willReadFrequently: true })!;
  context.imageSmoothingEnabled = false;
  context.drawImage(image, 0, 0, canvas.width, canvas.height);
  return countSteps(context.getImageData(0, 0, canvas.width, canvas.height).data);
}

const sum = (counts: number[]): number => counts.reduce((total, n) => total + n, 0);
const say = (value: number): string => String(Number(value.toPrecision(3)));
const small = (words: string): HTMLButtonElement =>
  make("button", { type: "button", class: "small" }, words);

function toggle(words: string): HTMLButtonElement {
  const button = small(words);
  button.setAttribute("aria-pressed", "false");
  return button;
}
