// The page of one object: its parts, wired together.
import { effect } from "@preact/signals-core";
import "../shared/base.css";
import "./page.css";
import "./viewer.css";
import { find } from "../shared/element";
import { direction, helpDialog, isCommand, listenToKeys, plain, type Key } from "../shared/keys";
import type { Point } from "../shared/pane";
import type { Mode } from "../shared/stage";
import { startTheme } from "../shared/theme";
import { watch } from "../shared/watch";
import { LayerList } from "./layers";
import { Readout } from "./readout";
import { readRecord } from "./record";
import { ScaleBar } from "./scalebar";
import { PaintingStage } from "./stage";
import { State, type Slot } from "./state";
import { fillToolbar, MODES } from "./toolbar";

const ZOOM_STEP = 1.4;
const NEAR_PX = 6; // of the screen
const SAVE_AFTER_MS = 300;
const HINT = "Point at the painting to read its spectrum; click to pin a place.";

const record = readRecord();
const state = new State();
const stage = new PaintingStage(find("stage"), [record.grid.width, record.grid.height], state);
const layers = new LayerList(find("layers"), record, state);
const readout = new Readout(find("spectrum"), record, HINT);
const scaleBar = new ScaleBar(record.grid.px_per_mm);

startTheme(find<HTMLButtonElement>("theme"));
find("stage").append(scaleBar.element);
fillToolbar(find("modes"), find("settings"), stage);
stage.setMode("single");
layers.onCompare = () => {
  if (stage.mode.value === "single") stage.setMode("curtain");
};

effect(() => {
  const name = (slot: Slot): string => {
    const choice = state[slot].value;
    return choice ? `${choice.layer.name}, ${choice.picture.label}` : "nothing";
  };
  const both = stage.mode.value !== "single";
  find("caption").textContent = both ? `A: ${name("a")} · B: ${name("b")}` : name("a");
  document.body.dataset["mode"] = stage.mode.value;
});
watch([state.a, state.b], () => void stage.load());

// --- the pixel under the cursor -------------------------------------------------------------------

let pointed: Point | null = null;

stage.onPoint = (pixel) => {
  if (state.pin.value || !pixel) return;
  if (!pointed)
    requestAnimationFrame(() => {
      if (pointed && !state.pin.value) void readout.show(pointed, false);
      pointed = null;
    });
  pointed = pixel;
};
stage.onPick = (pixel) => {
  const { value: pin } = state.pin;
  const apart = pin ? Math.hypot(pin[0] - pixel[0], pin[1] - pixel[1]) : Infinity;
  state.pin.value = apart * stage.left.scale < NEAR_PX ? null : pixel;
};

effect(() => {
  const pin = state.pin.value;
  stage.mark(pin);
  if (pin) void readout.show(pin, true);
  else readout.clear();
});

function movePin(x: number, y: number): void {
  const from = state.pin.value ?? stage.left.centre;
  const within = (at: number, size: number): number =>
    Math.min(Math.max(Math.round(at), 0), size - 1);
  const { width, height } = record.grid;
  state.pin.value = [within(from[0] + x, width), within(from[1] + y, height)];
}

// --- keys -----------------------------------------------------------------------------------------

const digit = (event: KeyboardEvent): number =>
  isCommand(event) || event.altKey ? 0 : Number(/^Digit([1-9])$/.exec(event.code)?.[1] ?? 0);
const arrows = plain("ArrowLeft", "ArrowRight", "ArrowUp", "ArrowDown");
const modeKey = (letter: string, mode: Mode, words: string): Key => ({
  keys: [letter.toUpperCase()],
  words,
  match: plain(letter),
  act: () => stage.setMode(stage.mode.value === mode ? "single" : mode),
});
const follow = (id: string): void => document.getElementById(id)?.click();

const keys: Key[] = [
  {
    keys: ["1", "…", "9"],
    words: "Show a layer (A)",
    match: (event) => digit(event) > 0 && !event.shiftKey,
    act: (event) => layers.choose("a", layers.layers[digit(event) - 1]),
  },
  {
    keys: ["Shift 1", "…"],
    words: "Put a layer into B",
    match: (event) => digit(event) > 0 && event.shiftKey,
    act: (event) => layers.choose("b", layers.layers[digit(event) - 1]),
  },
  {
    keys: ["Space"],
    words: "Hold: flicker between A and B",
    match: plain(" "),
    act: () => stage.hold(true),
    release: () => stage.hold(false),
  },
  modeKey("c", "curtain", "Curtain"),
  modeKey("k", "flicker", "Flicker on and off"),
  modeKey("s", "side", "Side by side"),
  modeKey("d", "difference", "Difference"),
  { keys: ["X"], words: "Swap A and B", match: plain("x"), act: () => state.swap() },
  { keys: ["["], words: "Previous object", match: plain("["), act: () => follow("previous") },
  { keys: ["]"], words: "Next object", match: plain("]"), act: () => follow("next") },
  { keys: ["F"], words: "Fit the picture", match: plain("f"), act: () => stage.fit() },
  {
    keys: ["+", "−"],
    words: "Zoom",
    match: plain("+", "=", "-", "_"),
    act: ({ key }) => stage.zoom("+=".includes(key) ? ZOOM_STEP : 1 / ZOOM_STEP),
  },
  {
    keys: ["← ↑ → ↓"],
    words: "Pan",
    match: (event) => arrows(event) && !event.shiftKey,
    act: (event) => stage.pan(...direction(event)),
  },
  {
    keys: ["R"],
    words: "Read and pin the middle of the view",
    match: plain("r"),
    act: () => (state.pin.value = stage.left.centre),
  },
  {
    keys: ["Shift ← ↑ → ↓"],
    words: "Move the pin by a pixel",
    match: (event) => arrows(event) && event.shiftKey,
    act: (event) => movePin(...direction(event)),
  },
  {
    keys: ["Esc"],
    words: "Let go of the pin",
    match: plain("Escape"),
    act: () => (state.pin.value = null),
  },
  { keys: ["?"], words: "This page", match: plain("?"), act: () => help.showModal() },
];
const help = helpDialog(
  keys,
  "Drag to pan, turn the wheel to zoom, double-click to zoom in. Point at the painting to read every camera's spectrum there; click to pin a place, click it again to let go.",
  "Fast flicker can trouble people with photosensitive epilepsy: keep it at 2 Hz or below then.",
);
listenToKeys(keys);
find("help-button").addEventListener("click", () => help.showModal());

// --- the address remembers what is shown ----------------------------------------------------------

let saving = 0;

function remember(): void {
  clearTimeout(saving);
  saving = window.setTimeout(() => {
    const [x, y, scale] = stage.heading;
    const facts = new URLSearchParams({ mode: stage.mode.value });
    facts.set("at", [x, y].map((at) => at.toFixed(1)).join());
    facts.set("scale", scale.toPrecision(5));
    for (const slot of ["a", "b"] as const) {
      const choice = state[slot].value;
      if (choice) facts.set(slot, `${choice.layer.name}/${choice.picture.key}`);
    }
    if (state.pin.value) facts.set("pin", state.pin.value.map((at) => at.toFixed(2)).join());
    history.replaceState(null, "", `#${facts.toString()}`);
  }, SAVE_AFTER_MS);
}

function recall(): void {
  const facts = new URLSearchParams(location.hash.slice(1));
  for (const [i, slot] of (["a", "b"] as const).entries()) {
    const name = facts.get(slot) ?? "";
    const cut = name.lastIndexOf("/");
    const layer = layers.layers.find((one) => one.name === name.slice(0, cut));
    const fallback = layers.layers[i] ?? layers.layers[0];
    layers.choose(slot, layer ?? fallback, layer && name.slice(cut + 1));
  }
  const mode = MODES.find(({ value }) => value === facts.get("mode"));
  if (mode) stage.setMode(mode.value);
  const numbers = (name: string): number[] | null => {
    const values = facts.get(name)?.split(",").map(Number);
    return values?.every(Number.isFinite) ? values : null;
  };
  const [at, scale, pin] = [numbers("at"), numbers("scale"), numbers("pin")];
  if (at?.length === 2 && scale && scale[0]! > 0) stage.look(at[0]!, at[1]!, scale[0]!);
  if (pin?.length === 2) state.pin.value = [pin[0]!, pin[1]!];
}

if (layers.layers.length) {
  recall();
  watch([state.a, state.b, state.pin, stage.mode], remember);
  stage.onMove = () => {
    scaleBar.update(stage.left.scale);
    remember();
  };
}

// For tests and for the curious: the parts by name.
Object.assign(window, { levkasViewer: { stage, layers, state, readout, record } });
