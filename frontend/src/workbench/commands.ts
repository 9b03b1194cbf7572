// What each key does.
import { ARROWS, direction, isCommand, key, type Key } from "../shared/keys";
import type { PairCard } from "./pair";
import type { Mode } from "../shared/stage";
import { MODES, type PairStage } from "./stage";
import type { Store } from "./store";
import type { PairTable } from "./table";

const ZOOM_STEP = 1.5;
const NUDGE_PX = 0.1;
/** Of the ways to show two pictures; docs/screens.md has the keys of all screens. */
const LETTERS: Partial<Record<Mode, string>> = {
  side: "S",
  curtain: "C",
  flicker: "K",
  difference: "D",
  checker: "B",
};

export interface Parts {
  store: Store;
  stage: PairStage;
  table: PairTable;
  pair: PairCard;
  /** Open the camera so many places on in the list. */
  step: (by: number) => void;
  help: () => void;
}

/** List the keys of the workbench. */
export function commands(parts: Parts): Key[] {
  return [...pairKeys(parts), ...viewKeys(parts)];
}

function pairKeys({ store, stage, table, pair }: Parts): Key[] {
  const { outline } = stage;
  const isOpen = (): boolean => outline.open.peek();
  const goToWorst = (): void => {
    const row = table.worst();
    if (row >= 0) table.pick(row);
  };
  const keep = "add the proposed pair; keep a measured place as check point; close the outline";
  const accept = (): void => {
    pair.accept();
    stage.placing.goOn();
  };
  const move = "move the pair by 0.1 px, with Shift by 1 px; the pictures where none is chosen";
  return [
    key("Enter", ["Enter"], keep, () => (isOpen() ? outline.finish() : accept())),
    key("Esc", ["Escape"], "let go", () => (isOpen() ? outline.cancel() : pair.cancel())),
    key("← → ↑ ↓", ARROWS, move, (event) => nudge(event, stage, pair)),
    key(
      "I",
      ["i"],
      "insert a pair in the middle of the picture with the focus, or its other end; or a corner of the outline",
      () => (isOpen() ? stage.cornerAtMiddle() : stage.placing.insertAtMiddle()),
    ),
    key("R", ["r"], "measure the error in the middle of the view", () =>
      stage.placing.measureAtMiddle(),
    ),
    key(
      "Del",
      ["Delete", "Backspace"],
      "delete the pair, the next one is chosen; or the corner",
      () => (isOpen() ? outline.remove() : pair.act("delete")),
    ),
    key("U", ["u"], "use a deleted or removed pair again", () => pair.act("restore")),
    key("P", ["p"], "pin the pair: it is never removed", () => pair.act("pin")),
    key("J", ["j"], "snap the pair to the best match nearby", () => pair.act("snap")),
    key("V", ["v"], "make it a check point: measured, not fitted", () => pair.act("check")),
    key("W", ["w"], "go to the worst pair", goToWorst),
    {
      keys: ["Ctrl-Z"],
      words: "undo",
      match: (event) => isLetter(event, "z") && !event.shiftKey,
      act: () => store.edit({ operation: "undo" }),
    },
    {
      keys: ["Ctrl-Shift-Z", "Ctrl-Y"],
      words: "redo",
      match: (event) => (isLetter(event, "z") && event.shiftKey) || isLetter(event, "y"),
      act: () => store.edit({ operation: "redo" }),
    },
  ];
}

/** Move what is chosen by an arrow, else the pictures. */
function nudge(event: KeyboardEvent, stage: PairStage, pair: PairCard): void {
  const { outline } = stage;
  const [dx, dy] = direction(event);
  if (outline.open.peek()) {
    const px = event.shiftKey ? 10 : 1;
    if (!outline.nudge(...stage.left.along([dx * px, dy * px]))) stage.pan(dx, dy);
    return;
  }
  // Without a map the other picture is moved until the place is in its middle.
  if (stage.isLoose && stage.placing.isSought) return stage.pan(dx, dy);
  const by = event.shiftKey ? 1 : NUDGE_PX;
  const [along, down] = stage.toTarget(dx * by, dy * by);
  if (!pair.nudge(along, down)) stage.pan(dx, dy);
}

function viewKeys({ stage, step, help }: Parts): Key[] {
  const bands = "band before, after in the picture to register; with Shift in the reference";
  const digit = (event: KeyboardEvent): number =>
    isCommand(event) || event.altKey ? 0 : Number(/^Digit([1-9])$/.exec(event.code)?.[1] ?? 0);
  const digitKey = (name: string, side: "left" | "right", words: string): Key => ({
    keys: [name],
    words,
    match: (event) => digit(event) > 0 && event.shiftKey === (side === "left"),
    act: (event) => stage.bands[side].show(digit(event) - 1),
  });
  return [
    ...MODES.filter(({ value }) => LETTERS[value]).map(({ value, label }) =>
      key(LETTERS[value]!, [LETTERS[value]!.toLowerCase()], modeWords(label), () =>
        stage.setMode(stage.mode.value === value ? "side" : value),
      ),
    ),
    digitKey("1 … 9", "right", "show a band of the picture to register"),
    digitKey("Shift 1 …", "left", "show a band of the reference"),
    {
      ...key("Space", [" "], "hold to flicker in an overlay", () => stage.hold(true)),
      release: () => stage.hold(false),
    },
    key("F", ["f"], "fit the whole picture", () => stage.fit()),
    key(
      "T",
      ["t"],
      "turn the pictures by 90°, with Shift back; before there is a map that to register alone, if it has the focus",
      (event) => stage.turn(event.shiftKey ? -90 : 90),
    ),
    key("H", ["h"], "marks on and off", () => {
      stage.marks.value = !stage.marks.value;
    }),
    key("L", ["l"], "loupes while placing on and off", () => {
      stage.loupes.use.value = !stage.loupes.use.value;
    }),
    key("+ -", ["+", "-", "="], "zoom", (event) =>
      stage.zoom(event.key === "-" ? 1 / ZOOM_STEP : ZOOM_STEP),
    ),
    key(", .", [",", ".", ";", ":", "<", ">"], bands, (event) => {
      const side = event.shiftKey || ";:<>".includes(event.key) ? "left" : "right";
      stage.bands[side].step([".", ":", ">"].includes(event.key) ? 1 : -1);
    }),
    key("[ ]", ["[", "]"], "previous, next camera", (event) => step(event.key === "]" ? 1 : -1)),
    key("?", ["?"], "this page", help),
  ];
}

function modeWords(label: string): string {
  return label === "Side by side" ? "side by side" : `${label.toLowerCase()}, and back`;
}

function isLetter(event: KeyboardEvent, letter: string): boolean {
  return isCommand(event) && event.key.toLowerCase() === letter;
}
