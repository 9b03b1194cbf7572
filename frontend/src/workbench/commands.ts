// What each key does.
import { ARROWS, direction, isCommand, key, type Key } from "../shared/keys";
import type { PairCard } from "./pair";
import { MODES, type PairStage } from "./stage";
import type { Store } from "./store";
import type { PairTable } from "./table";

const ZOOM_STEP = 1.5;
const NUDGE_PX = 0.1;

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
  const nudge = (event: KeyboardEvent): void => {
    const [dx, dy] = direction(event);
    const by = event.shiftKey ? 1 : NUDGE_PX;
    if (!pair.nudge(dx * by, dy * by)) stage.pan(dx, dy);
  };
  const goToWorst = (): void => {
    const row = table.worst();
    if (row >= 0) table.pick(row);
  };
  const keep = "add the proposed pair; keep a measured place as check point";
  const move = "move the pair by 0.1 px, with Shift by 1 px; the pictures where none is chosen";
  const propose = "propose a pair in the middle of the reference; in an overlay, measure there";
  return [
    key("Enter", ["Enter"], keep, () => pair.accept()),
    key("Esc", ["Escape"], "let go", () => pair.cancel()),
    key("← → ↑ ↓", ARROWS, move, nudge),
    key("N", ["n"], propose, () => stage.pointAtMiddle()),
    key("Del", ["Delete", "Backspace"], "delete the pair", () => pair.act("delete")),
    key("R", ["r"], "restore it", () => pair.act("restore")),
    key("P", ["p"], "pin it: never to be removed", () => pair.act("pin")),
    key("S", ["s"], "snap it to where its surroundings agree", () => pair.act("snap")),
    key("C", ["c"], "make it a check point", () => pair.act("check")),
    key("W", ["w"], "go to the worst pair", goToWorst),
    {
      keys: ["Ctrl-Z"],
      words: "undo, without end",
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

function viewKeys({ stage, step, help }: Parts): Key[] {
  const digits = MODES.map((_, i) => String(i + 1));
  const modes = MODES.map(({ label }) => label.toLowerCase()).join(", ");
  const bands = "band before, after in the picture to register; with Shift in the reference";
  return [
    key(`1 … ${MODES.length}`, digits, modes, (event) =>
      stage.setMode(MODES[Number(event.key) - 1]!.value),
    ),
    {
      ...key("Space", [" "], "hold to flicker in an overlay", () => stage.hold(true)),
      release: () => stage.hold(false),
    },
    key("F", ["f"], "fit the whole picture", () => stage.fit()),
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

function isLetter(event: KeyboardEvent, letter: string): boolean {
  return isCommand(event) && event.key.toLowerCase() === letter;
}
