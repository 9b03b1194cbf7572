// The registration workbench, served by `levkas inspect`.
import "../style/tokens.css";
import "./workbench.css";
import { make, refill } from "../element";
import { startTheme } from "../theme";
import { enter, Refusal } from "./api";
import { filesDialog } from "./files";
import { helpDialog, listenTo, plain, type Key } from "./keys";
import { MapLayer } from "./layers";
import { DECISIONS, type CameraRow } from "./record";
import { PairCard, VerdictCard } from "./side";
import { MODES, Stage, type Mode } from "./stage";
import { Store } from "./store";
import { PairTable } from "./table";
import { TraceView } from "./trace";

async function start(): Promise<void> {
  const store = new Store();
  const waiting = make("main", { class: "alone", "aria-busy": "true" }, make("h1", {}, "Levkas workbench"), make("p", { class: "soft", role: "status" }, "Opening the pictures…"));
  document.body.append(waiting);
  try {
    await enter();
    await store.loadCameras();
  } catch (error) {
    waiting.remove();
    const words = error instanceof Refusal && error.status === 401 ? "This address holds no token, or an old one. Open the address that `levkas inspect` printed." : String(error instanceof Error ? error.message : error);
    document.body.append(make("main", { class: "alone" }, make("h1", {}, "The workbench is locked"), make("p", {}, words)));
    return;
  }
  const first = store.cameras.find((c) => !c.reference && c.decision === "refuse") ?? store.cameras.find((c) => !c.reference) ?? store.cameras[0];
  if (!first) return waiting.replaceChildren(make("p", {}, "This campaign has no cameras."));
  await openFirst(store, first);
  waiting.remove();
  build(store);
}

async function openFirst(store: Store, first: CameraRow): Promise<void> {
  for (const row of [first, ...store.cameras]) {
    try {
      await store.open(row.id);
      return;
    } catch (error) {
      store.refused = error instanceof Error ? error.message : String(error);
    }
  }
}

function build(store: Store): void {
  if (!store.frame) {
    document.body.append(make("main", { class: "alone" }, make("h1", {}, store.campaign || "Workbench"), make("p", {}, store.refused)));
    return;
  }
  const theme = make("button", { type: "button", class: "small" });
  const help = make("button", { type: "button", class: "small", "aria-label": "Keys and help" }, "?");
  const undo = make("button", { type: "button", class: "small", id: "undo", title: "Ctrl-Z" }, "Undo");
  const redo = make("button", { type: "button", class: "small", id: "redo", title: "Ctrl-Shift-Z" }, "Redo");
  const files = make("button", { type: "button", class: "small", id: "files" }, "Files…");
  const title = make("h1", {});
  const said = make("p", { class: "refused", role: "alert", hidden: true, id: "refused" });
  const views = make("div", { class: "views" });
  const stage = new Stage(views, store);
  const table = new PairTable(store);
  const pair = new PairCard(store);
  const verdict = new VerdictCard(store);
  const trace = new TraceView(store);
  const layer = new MapLayer(store, () => stage);
  const nav = make("nav", { "aria-label": "Cameras" });
  const modes = make("div", { class: "modes", role: "radiogroup", "aria-label": "How the pictures are shown" });
  const which = make("select", { id: "map", "aria-label": "Which map brings them together" }, make("option", { value: "pairs" }, "These pairs"), make("option", { value: "built" }, "Last registration"));
  const setMode = (mode: Mode): void => {
    stage.setMode(mode);
    bar.dataset["mode"] = mode;
    for (const button of modes.querySelectorAll("button")) {
      const chosen = button.dataset["mode"] === mode;
      button.setAttribute("aria-checked", String(chosen));
      button.tabIndex = chosen ? 0 : -1;
    }
  };
  for (const [mode, words] of MODES) {
    const button = make("button", { type: "button", role: "radio", "data-mode": mode, "aria-checked": "false" }, words);
    button.addEventListener("click", () => setMode(mode));
    modes.append(button);
  }
  modes.addEventListener("keydown", (event) => {
    const by = { ArrowRight: 1, ArrowDown: 1, ArrowLeft: -1, ArrowUp: -1 }[event.key];
    if (!by) return;
    event.preventDefault();
    event.stopPropagation();
    const next = (MODES.findIndex(([mode]) => mode === stage.mode) + by + MODES.length) % MODES.length;
    setMode(MODES[next]![0]);
    modes.querySelectorAll("button")[next]!.focus();
  });
  which.addEventListener("change", () => {
    store.map = which.value === "built" ? "built" : "pairs";
    store.changed();
  });
  table.onPick = (row) => {
    const chosen = store.pair(row);
    if (chosen) stage.flyTo(chosen);
  };
  const rate = make("input", { type: "range", id: "rate", min: 0.5, max: 8, step: 0.5, value: stage.flicker.rate, "aria-label": "Flicker, turns a second" });
  const rateSaid = make("label", { class: "rate", for: "rate" }, "2 Hz");
  rate.addEventListener("input", () => {
    stage.flicker.rate = Number(rate.value);
    rateSaid.textContent = `${rate.value} Hz`;
  });
  const bar = make("div", { class: "bar" }, modes, make("span", { class: "rates" }, rate, rateSaid), which, layer.choice, layer.legend);
  document.body.append(
    make("header", { class: "top" }, make("span", { class: "mark" }, "Levkas"), title, make("span", { class: "space" }), undo, redo, files, help, theme),
    make("div", { class: "desk" }, nav, make("main", { class: "middle" }, bar, said, views, table.root), make("aside", { "aria-label": "Verdict and tools" }, verdict.root, pair.root, trace.root)),
  );
  const open = async (id: string): Promise<void> => {
    if (id === store.frame?.id) return;
    try {
      await store.open(id);
      store.refused = "";
      store.changed();
    } catch (error) {
      store.refuse(error);
    }
  };
  const step = (by: number): void => {
    const at = store.cameras.findIndex((c) => c.id === store.frame?.id);
    const next = store.cameras[(at + by + store.cameras.length) % store.cameras.length];
    if (next) void open(next.id);
  };
  const keys = allKeys(store, stage, table, pair, setMode, step, () => helpPage.showModal());
  const helpPage = helpDialog(keys);
  const filesPage = filesDialog(store);
  listenTo(keys);
  startTheme(theme);
  help.addEventListener("click", () => helpPage.showModal());
  files.addEventListener("click", () => filesPage.showModal());
  undo.addEventListener("click", () => void store.edit({ operation: "undo" }));
  redo.addEventListener("click", () => void store.edit({ operation: "redo" }));
  store.listen(() => {
    const { frame, told } = store;
    if (!frame || !told) return;
    const name = [frame.object, frame.camera, frame.sensor].filter(Boolean).join(" · ");
    title.textContent = name;
    document.title = `${name} · Levkas workbench`;
    undo.disabled = told.can.undo === 0;
    redo.disabled = told.can.redo === 0;
    which.value = store.map;
    which.options[1]!.disabled = !frame.built;
    said.hidden = store.refused === "";
    said.textContent = store.refused;
    drawCameras(nav, store, open);
  });
  setMode("side");
  store.changed();
  Object.assign(window, { levkasWorkbench: { store, stage, trace } });
}

function drawCameras(nav: HTMLElement, store: Store, open: (id: string) => Promise<void>): void {
  const shown = JSON.stringify([store.campaign, store.cameras, store.frame?.id]);
  if (nav.dataset["shown"] === shown) return;
  nav.dataset["shown"] = shown;
  const groups = new Map<string, CameraRow[]>();
  for (const row of store.cameras) groups.set(row.object, [...(groups.get(row.object) ?? []), row]);
  const made = [...groups].map(([, rows]) => {
    const items = rows.map((row) => {
      const button = make(
        "button",
        { type: "button", id: `camera-${row.id}`, "aria-current": row.id === store.frame?.id ? "true" : null, title: row.reason },
        make("span", { class: "name" }, row.sensor ? `${row.camera} · ${row.sensor}` : row.camera),
        make("span", { class: "soft of" }, [row.setup && `under ${row.setup}`, row.bands].filter(Boolean).join(", ")),
        row.reference ? make("span", { class: "badge reference" }, "Reference") : make("span", { class: `badge ${row.decision}` }, DECISIONS[row.decision] ?? row.decision),
      );
      button.addEventListener("click", () => void open(row.id));
      return make("li", {}, button);
    });
    return make("section", {}, make("h2", {}, rows[0]!.title), make("ul", {}, ...items));
  });
  refill(nav, make("p", { class: "soft campaign" }, store.campaign), ...made);
}

function allKeys(store: Store, stage: Stage, table: PairTable, pair: PairCard, setMode: (mode: Mode) => void, step: (by: number) => void, help: () => void): Key[] {
  const nudges: Record<string, [number, number]> = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };
  const command = (event: KeyboardEvent): boolean => event.ctrlKey || event.metaKey;
  return [
    { keys: ["Enter"], words: "add the proposed pair; keep a measured place as check point", match: plain("Enter"), act: () => pair.accept() },
    { keys: ["Esc"], words: "let go", match: plain("Escape"), act: () => pair.cancel() },
    {
      keys: ["←", "→", "↑", "↓"],
      words: "move the pair by 0.1 px, with Shift by 1 px; the pictures where none is chosen",
      match: plain(...Object.keys(nudges)),
      act: (event) => {
        const [dx, dy] = nudges[event.key]!;
        const by = event.shiftKey ? 1 : 0.1;
        if (!pair.nudge(dx * by, dy * by)) stage.pan(dx, dy);
      },
    },
    { keys: ["N"], words: "propose a pair in the middle of the reference; in an overlay, measure there", match: plain("n", "N"), act: () => void stage.pointAtMiddle() },
    { keys: ["Del"], words: "delete the pair", match: plain("Delete", "Backspace"), act: () => pair.act("delete") },
    { keys: ["R"], words: "restore it", match: plain("r", "R"), act: () => pair.act("restore") },
    { keys: ["P"], words: "pin it: never to be removed", match: plain("p", "P"), act: () => pair.act("pin") },
    { keys: ["S"], words: "snap it to where its surroundings agree", match: plain("s", "S"), act: () => pair.act("snap") },
    { keys: ["C"], words: "make it a check point", match: plain("c", "C"), act: () => pair.act("check") },
    { keys: ["W"], words: "go to the worst pair", match: plain("w", "W"), act: () => table.worst() >= 0 && table.pick(table.worst()) },
    { keys: ["Ctrl-Z"], words: "undo, without end", match: (e) => command(e) && !e.shiftKey && e.key.toLowerCase() === "z", act: () => void store.edit({ operation: "undo" }) },
    { keys: ["Ctrl-Shift-Z", "Ctrl-Y"], words: "redo", match: (e) => command(e) && (e.key.toLowerCase() === "y" || (e.shiftKey && e.key.toLowerCase() === "z")), act: () => void store.edit({ operation: "redo" }) },
    { keys: ["1", "…", "6"], words: MODES.map(([, words]) => words.toLowerCase()).join(", "), match: plain("1", "2", "3", "4", "5", "6"), act: (event) => setMode(MODES[Number(event.key) - 1]![0]) },
    { keys: ["Space"], words: "hold to flicker in an overlay", match: plain(" "), act: () => stage.hold(true), release: () => stage.hold(false) },
    { keys: ["F"], words: "fit the whole picture", match: plain("f", "F"), act: () => stage.fit() },
    { keys: ["+", "-"], words: "zoom", match: plain("+", "-", "="), act: (event) => stage.zoom(event.key === "-" ? 1 / 1.5 : 1.5) },
    { keys: [",", "."], words: "band before, after in the picture to register; with Shift in the reference", match: (e) => !e.ctrlKey && !e.metaKey && !e.altKey && [",", ".", ";", ":", "<", ">"].includes(e.key), act: (event) => stage.stepBand(event.shiftKey || ";:<>".includes(event.key) ? "left" : "right", [".", ":", ">"].includes(event.key) ? 1 : -1) },
    { keys: ["[", "]"], words: "previous, next camera", match: plain("[", "]"), act: (event) => step(event.key === "]" ? 1 : -1) },
    { keys: ["?"], words: "this page", match: plain("?"), act: help },
  ];
}

void start();
