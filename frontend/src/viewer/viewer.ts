// The page of one object: its parts, wired together.
import { effect } from "@preact/signals-core";
import "../shared/base.css";
import "./page.css";
import "./viewer.css";
import { find } from "../shared/element";
import {
  ARROWS,
  direction,
  helpDialog,
  isCommand,
  key,
  listenToKeys,
  plain,
  type Key,
} from "../shared/keys";
import type { Point } from "../shared/pane";
import type { Mode } from "../shared/stage";
import { startTheme } from "../shared/theme";
import { watch } from "../shared/watch";
import { Address, numbersOf } from "./address";
import { Drawing } from "./drawing";
import { KeptList } from "./kept";
import { LayerList } from "./layers";
import { startCopying } from "./linking";
import { Readout } from "./readout";
import { readRecord } from "./record";
import { ScaleBar } from "./scalebar";
import { openSpectra } from "./spectra";
import { PaintingStage } from "./stage";
import { SLOTS, State, type Slot } from "./state";
import { fillTone } from "./tone";
import { fillToolbar, MODES } from "./toolbar";
import { sayWhatIsShown, ViewBar } from "./viewbar";

const ZOOM_STEP = 1.4;
const NEAR_PX = 6; // of the screen
const HINT = "Point at the painting to read its spectrum; click to pin a place.";

const record = readRecord();
const { width, height } = record.grid;
const state = new State();
const address = new Address();
const size: Point = [width, height];
const stage = new PaintingStage(find("stage"), size, state);
const layers = new LayerList(find("layers"), record, state);
const spectra = openSpectra(record);
const readout = new Readout(find("spectrum"), record, spectra, HINT);
const go = (place: Point): void => {
  state.pin.value = place;
  stage.look(...place, stage.heading[2], false);
};
const drawing = new Drawing(stage.cells.map(({ pane }) => pane));
const kept = new KeptList(find("kept"), record, spectra, state, drawing, go, address);
const scaleBar = new ScaleBar(record.grid.px_per_mm);

startTheme(find<HTMLButtonElement>("theme"));
find("scale").append(scaleBar.element);
fillTone(find("tone"), stage, address);
const bar = new ViewBar(find("view"), stage, address);
const sections = { modes: find("modes"), settings: find("settings") };
fillToolbar(sections, { stage, address });
stage.setMode("single");
layers.onCompare = () => {
  if (stage.mode.value === "single") stage.setMode("curtain");
};
sayWhatIsShown(find("caption"), stage, state);
effect(() => {
  document.body.dataset["mode"] = stage.mode.value;
});
watch([stage.mode, state.c, state.d], () => {
  if (stage.mode.value === "grid") layers.fillGrid();
});
watch([state.a, state.b, state.c, state.d], () => void stage.load());

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

effect(() => void find("stage").classList.toggle("bare", !state.marks.value));
effect(() => {
  const pin = state.pin.value;
  document.body.classList.toggle("reading", pin !== null);
  stage.mark(pin, state.kept.value);
  if (pin) void readout.show(pin, true);
  else readout.clear();
});

find("close-reading").addEventListener("click", () => (state.pin.value = null));

function movePin(right: number, down: number): void {
  const from = state.pin.value ?? stage.left.centre;
  const [x, y] = stage.left.along([right, down]);
  state.pin.value = within([from[0] + x, from[1] + y]);
}

/** The pixel of the painting that is nearest to a place. */
function within([x, y]: Point): Point {
  const clip = (at: number, size: number): number =>
    Math.min(Math.max(Math.round(at), 0), size - 1);
  return [clip(x, width), clip(y, height)];
}

// --- keys -----------------------------------------------------------------------------------------

const digit = (event: KeyboardEvent): number =>
  isCommand(event) || event.altKey ? 0 : Number(/^Digit([1-9])$/.exec(event.code)?.[1] ?? 0);
const digitKey = (name: string, words: string, slot: Slot, shift: boolean): Key => ({
  keys: name.split(" "),
  words,
  match: (event) => digit(event) > 0 && event.shiftKey === shift,
  act: (event) => layers.choose(slot, layers.layers[digit(event) - 1]),
});
const arrowKey = (name: string, words: string, shift: boolean, act: Key["act"]): Key => ({
  keys: [name],
  words,
  match: (event) => event.shiftKey === shift && plain(...ARROWS)(event),
  act,
});
const modeKey = (letter: string, mode: Mode, words: string): Key =>
  key(letter, [letter.toLowerCase()], words, () =>
    stage.setMode(stage.mode.value === mode ? "single" : mode),
  );
/** A letter with Shift; it stands before the letter alone, which takes both cases. */
const shiftKey = (letter: string, words: string, act: () => void): Key => ({
  keys: ["Shift", letter],
  words,
  match: (event) => event.shiftKey && plain(letter.toLowerCase())(event),
  act,
});
const follow = (id: string) => (): void => document.getElementById(id)?.click();

const keys: Key[] = [
  digitKey("1 … 9", "Show a layer (A)", "a", false),
  digitKey("Shift 1 …", "Put a layer into B", "b", true),
  {
    ...key("Space", [" "], "Hold: flicker between A and B", () => stage.hold(true)),
    release: () => stage.hold(false),
  },
  shiftKey("C", "Curtain with a level line, or an upright one", () => {
    if (stage.mode.value === "curtain") stage.curtain.turn(!stage.curtain.level.value);
    else {
      stage.curtain.turn(true);
      stage.setMode("curtain");
    }
  }),
  modeKey("C", "curtain", "Curtain"),
  modeKey("O", "opacity", "B over A, by opacity"),
  key("K", ["k"], "Flicker on and off; where less motion is requested, the other picture", () => {
    const off = stage.mode.value === "flicker" && !stage.flicker.byHand;
    stage.setMode(off ? "single" : "flicker");
  }),
  modeKey("S", "side", "Side by side"),
  modeKey("Q", "grid", "Four pictures"),
  modeKey("D", "difference", "Difference"),
  key("X", ["x"], "Swap A and B", () => state.swap()),
  key("[", ["["], "Previous object", follow("previous")),
  key("]", ["]"], "Next object", follow("next")),
  key("F", ["f"], "Fit the picture", () => stage.fit()),
  key("0", ["0"], "One pixel of the picture as one of the screen", () => bar.showPixels()),
  shiftKey("T", "Turn by 90°, anticlockwise", () => bar.turn(-1)),
  key("T", ["t"], "Turn by 90°, clockwise", () => bar.turn(1)),
  key("W", ["w"], "The whole screen for the picture, on and off", () => bar.toggleScreen()),
  key("+ −", ["+", "=", "-", "_"], "Zoom", (event) =>
    stage.zoom("+=".includes(event.key) ? ZOOM_STEP : 1 / ZOOM_STEP),
  ),
  arrowKey("← ↑ → ↓", "Pan", false, (event) => stage.pan(...direction(event))),
  key(
    "R",
    ["r"],
    "Read and pin the middle of the view",
    () => (state.pin.value = stage.left.centre),
  ),
  arrowKey("Shift ← ↑ → ↓", "Move the pin by a pixel", true, (event) =>
    movePin(...direction(event)),
  ),
  key(
    "P",
    ["p"],
    "Keep the pinned place; while drawing: use it, or the middle, as a corner",
    () => {
      if (drawing.active) drawing.add(state.pin.value ?? stage.left.centre);
      else kept.keep();
    },
  ),
  key("M", ["m"], "Measure a length", () => void kept.start("length")),
  key("G", ["g"], "Measure a rectangle", () => void kept.start("rectangle")),
  key(
    "H",
    ["h"],
    "Marks on the painting on and off",
    () => (state.marks.value = !state.marks.value),
  ),
  key("Esc", ["Escape"], "Cancel the drawing, or remove the pin", () => {
    if (drawing.active) drawing.cancel();
    else state.pin.value = null;
  }),
  key("?", ["?"], "This page", () => help.showModal()),
];
const help = helpDialog(
  keys,
  "Drag to pan, turn the wheel to zoom, double-click to zoom in. On a phone two fingers move the picture, and one scrolls the page. Point at the painting to read every camera's spectrum there; click to pin a place, click it again to let go.",
  "Fast flicker can trouble people with photosensitive epilepsy: keep it at 2 Hz or below then.",
);
listenToKeys(keys);
find("help-button").addEventListener("click", () => help.showModal());

// --- the address remembers what is shown ----------------------------------------------------------

for (const [i, slot] of SLOTS.entries())
  address.add({
    signals: [state[slot]],
    carried: true,
    write: (facts) => {
      const choice = state[slot].value;
      if (choice) facts.set(slot, `${choice.layer.name}/${choice.picture.key}`);
    },
    read: (facts) => {
      const name = facts.get(slot) ?? "";
      const cut = name.lastIndexOf("/");
      if (i > 1 && !name) {
        state[slot].value = null; // C and D are filled when they are shown
        return;
      }
      const layer = layers.layers.find((one) => one.name === name.slice(0, cut));
      const fallback = layers.layers[i] ?? layers.layers[0];
      layers.choose(slot, layer ?? fallback, layer && name.slice(cut + 1));
    },
  });
address.add({
  signals: [stage.mode],
  carried: true,
  write: (facts) => facts.set("mode", stage.mode.value),
  read: (facts) => {
    const mode = MODES.find(({ value }) => value === facts.get("mode"))?.value ?? "single";
    if (mode === stage.mode.value) return;
    stage.setMode(mode);
    stage.flicker.wait(mode === "flicker"); // until a person starts it
  },
});
address.add({
  write: (facts) => {
    const [x, y, scale] = stage.heading;
    facts.set("at", [x, y].map((at) => at.toFixed(1)).join());
    facts.set("scale", scale.toPrecision(5));
  },
  read: (facts) => {
    const [at, scale] = [numbersOf(facts, "at", 2), numbersOf(facts, "scale", 1)];
    if (at && scale && scale[0]! > 0) stage.look(at[0]!, at[1]!, scale[0]!);
  },
});
const say = (sentence: string): void => void (find("said").textContent = sentence);
startCopying(find<HTMLButtonElement>("copy-link"), address, say);
if (layers.layers.length) {
  address.start();
  stage.onMove = () => {
    scaleBar.update(stage.left.scale);
    bar.update();
    drawing.render();
    address.remember();
  };
}

// For tests and for the curious: the parts by name.
Object.assign(window, { levkasViewer: { stage, layers, state, readout, record } });
