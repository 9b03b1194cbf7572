// What each key does.
import { direction, isCommand, plain, type Key } from "../shared/keys";
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
export function commands({ store, stage, table, pair, step, help }: Parts): Key[] {
  const isZ = (event: KeyboardEvent): boolean =>
    isCommand(event) && event.key.toLowerCase() === "z";
  const isY = (event: KeyboardEvent): boolean =>
    isCommand(event) && event.key.toLowerCase() === "y";
  const simple = (key: string, name: string, words: string, act: () => unknown): Key => ({
    keys: [name],
    words,
    match: plain(key),
    act,
  });
  return [
    simple("Enter", "Enter", "add the proposed pair; keep a measured place as check point", () =>
      pair.accept(),
    ),
    simple("Escape", "Esc", "let go", () => pair.cancel()),
    {
      keys: ["←", "→", "↑", "↓"],
      words: "move the pair by 0.1 px, with Shift by 1 px; the pictures where none is chosen",
      match: plain("ArrowLeft", "ArrowRight", "ArrowUp", "ArrowDown"),
      act: (event) => {
        const [dx, dy] = direction(event);
        const by = event.shiftKey ? 1 : NUDGE_PX;
        if (!pair.nudge(dx * by, dy * by)) stage.pan(dx, dy);
      },
    },
    simple(
      "n",
      "N",
      "propose a pair in the middle of the reference; in an overlay, measure there",
      () => stage.pointAtMiddle(),
    ),
    {
      keys: ["Del"],
      words: "delete the pair",
      match: plain("Delete", "Backspace"),
      act: () => pair.act("delete"),
    },
    simple("r", "R", "restore it", () => pair.act("restore")),
    simple("p", "P", "pin it: never to be removed", () => pair.act("pin")),
    simple("s", "S", "snap it to where its surroundings agree", () => pair.act("snap")),
    simple("c", "C", "make it a check point", () => pair.act("check")),
    simple("w", "W", "go to the worst pair", () => {
      const row = table.worst();
      if (row >= 0) table.pick(row);
    }),
    {
      keys: ["Ctrl-Z"],
      words: "undo, without end",
      match: (event) => isZ(event) && !event.shiftKey,
      act: () => void store.edit({ operation: "undo" }),
    },
    {
      keys: ["Ctrl-Shift-Z", "Ctrl-Y"],
      words: "redo",
      match: (event) => (isZ(event) && event.shiftKey) || isY(event),
      act: () => void store.edit({ operation: "redo" }),
    },
    {
      keys: ["1", "…", String(MODES.length)],
      words: MODES.map(({ label }) => label.toLowerCase()).join(", "),
      match: plain(...MODES.map((_, i) => String(i + 1))),
      act: (event) => stage.setMode(MODES[Number(event.key) - 1]!.value),
    },
    {
      keys: ["Space"],
      words: "hold to flicker in an overlay",
      match: plain(" "),
      act: () => stage.hold(true),
      release: () => stage.hold(false),
    },
    simple("f", "F", "fit the whole picture", () => stage.fit()),
    {
      keys: ["+", "-"],
      words: "zoom",
      match: plain("+", "-", "="),
      act: (event) => stage.zoom(event.key === "-" ? 1 / ZOOM_STEP : ZOOM_STEP),
    },
    {
      keys: [",", "."],
      words: "band before, after in the picture to register; with Shift in the reference",
      match: plain(",", ".", ";", ":", "<", ">"),
      act: ({ key, shiftKey }) => {
        const side = shiftKey || ";:<>".includes(key) ? "left" : "right";
        stage.bands[side].step([".", ":", ">"].includes(key) ? 1 : -1);
      },
    },
    {
      keys: ["[", "]"],
      words: "previous, next camera",
      match: plain("[", "]"),
      act: (event) => step(event.key === "]" ? 1 : -1),
    },
    simple("?", "?", "this page", help),
  ];
}
