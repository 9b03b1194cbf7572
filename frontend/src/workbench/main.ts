// The registration workbench, served by `levkas inspect`.
import { effect } from "@preact/signals-core";
import "../shared/base.css";
import { BasisView } from "./basis";
import "./workbench.css";
import { GAIN, radioGroup, slider } from "../shared/controls";
import { make, refill } from "../shared/element";
import { RATES } from "../shared/flicker";
import { helpDialog, listenToKeys } from "../shared/keys";
import { startTheme } from "../shared/theme";
import { enter, messageOf, Refusal } from "./api";
import { cameraList } from "./cameras";
import { commands } from "./commands";
import { filesDialog } from "./files";
import { PairCard } from "./pair";
import { MODES, PairStage } from "./stage";
import { Store } from "./store";
import { PairTable } from "./table";
import { VerdictCard } from "./verdict";

const BEFORE_KEYS =
  "Drag to pan, turn the wheel to zoom. Click a place: its partner in the other picture is found, or click the partner yourself; Enter adds the pair. In the overlays a click measures how far off the pictures are there.";
const AFTER_KEYS =
  "Every change is saved at once in edits.toml and can be undone; levkas build applies the changes. Fast flicker can trouble people with photosensitive epilepsy.";

async function start(): Promise<void> {
  const store = new Store();
  const status = make("p", { class: "soft", role: "status" }, "Opening the pictures…");
  const waiting = page("Levkas workbench", status);
  waiting.setAttribute("aria-busy", "true");
  try {
    await enter();
    await store.loadCameras();
  } catch (error) {
    waiting.remove();
    const locked = error instanceof Refusal && error.status === 401;
    const words = locked
      ? "This address holds no token, or an old one. Open the address that `levkas inspect` printed."
      : messageOf(error);
    page("The workbench is locked", make("p", {}, words));
    return;
  }
  const cameras = store.cameras.value;
  const others = cameras.filter(({ reference }) => !reference);
  const first = others.find(({ decision }) => decision === "refuse") ?? others[0] ?? cameras[0];
  for (const row of first ? [first, ...cameras] : []) {
    await store.open(row.id).catch((error: unknown) => store.refuse(error));
    if (store.frame.value) break;
  }
  waiting.remove();
  if (store.frame.value) build(store);
  else
    page(
      store.campaign.value || "Workbench",
      make("p", {}, store.refused.value || "This campaign has no cameras."),
    );
}

/** Show a page that has a heading and a text alone. */
function page(title: string, text: HTMLElement): HTMLElement {
  const main = make("main", { class: "alone" }, make("h1", {}, title), text);
  document.body.append(main);
  return main;
}

function build(store: Store): void {
  const views = make("div", { class: "views", "data-mode": "side" });
  const [nav, bar, refused] = [make("div"), make("div", { class: "bar" }), refusal(store)];
  const table = new PairTable(store);
  const [pair, verdict, basis] = [
    new PairCard(store),
    new VerdictCard(store),
    new BasisView(store),
  ];
  const tools = [verdict.root, pair.root, basis.root];
  const aside = make("aside", { "aria-label": "Verdict and tools" }, ...tools);
  const [top, opened] = header(store);
  document.body.append(
    top,
    make(
      "div",
      { class: "desk" },
      nav,
      make("main", { class: "middle" }, bar, refused, views, table.root),
      aside,
    ),
  );
  const stage = new PairStage(views, store);
  verdict.root.before(stage.outline.root);
  const open = (id: string): void => {
    if (id !== store.frame.value?.id) store.open(id).catch((error: unknown) => store.refuse(error));
  };
  nav.replaceWith(cameraList(store, open));
  fillBar(bar, store, stage);
  stage.setMode("side");
  table.onPick = (row) => {
    const chosen = store.session.value?.pairs[row];
    if (chosen) stage.flyTo(chosen);
  };
  const step = (by: number): void => {
    const cameras = store.cameras.value;
    const own = (id = ""): string | undefined => id.split("-")[0];
    const at = cameras.findIndex(({ id }) => own(id) === own(store.frame.value?.id));
    const next = cameras[(at + by + cameras.length) % cameras.length];
    if (next) open(next.id);
  };
  const keys = commands({ store, stage, table, pair, step, help: () => help.showModal() });
  const help = helpDialog(keys, BEFORE_KEYS, AFTER_KEYS);
  const files = filesDialog(store);
  opened.help.addEventListener("click", () => help.showModal());
  opened.files.addEventListener("click", () => files.showModal());
  pair.next = () => table.following();
  pair.onNext = () => {
    const chosen = store.selectedPair();
    if (chosen && !stage.sees(chosen)) stage.flyTo(chosen);
  };
  listenToKeys(keys);
  Object.assign(window, { levkasWorkbench: { store, stage } });
}

/** The line at the top, and the buttons of it that open dialogs. */
function header(store: Store): [HTMLElement, { help: HTMLElement; files: HTMLElement }] {
  const button = (words: string, facts: Record<string, string>): HTMLButtonElement =>
    make("button", { type: "button", class: "small", ...facts }, words);
  const title = make("h1", {});
  const undo = button("Undo", { id: "undo", title: "Ctrl-Z" });
  const redo = button("Redo", { id: "redo", title: "Ctrl-Shift-Z" });
  const files = button("Files…", { id: "files" });
  const help = button("?", { "aria-label": "Keys and help" });
  const theme = button("", {});
  startTheme(theme);
  undo.addEventListener("click", () => void store.edit({ operation: "undo" }));
  redo.addEventListener("click", () => void store.edit({ operation: "redo" }));
  effect(() => {
    const { object = "", camera = "", sensor = "" } = store.frame.value ?? {};
    title.textContent = [object, camera, sensor].filter(Boolean).join(" · ");
    document.title = `${title.textContent} · Levkas workbench`;
  });
  effect(() => {
    const { undo: done = 0, redo: undone = 0 } = store.session.value?.can ?? {};
    [undo.disabled, redo.disabled] = [done === 0, undone === 0];
  });
  const mark = make("span", { class: "mark" }, "Levkas");
  const space = make("span", { class: "space" });
  const line = make("header", { class: "top" }, mark, title, space, undo, redo, files, help, theme);
  return [line, { help, files }];
}

/** Why the last change was refused. */
function refusal(store: Store): HTMLElement {
  const text = make("p", { class: "refused", role: "alert", hidden: true, id: "refused" });
  effect(() => {
    text.textContent = store.refused.value;
    text.hidden = store.refused.value === "";
  });
  return text;
}

/** How the pictures are shown: the mode, the map between them, what is drawn over them. */
function fillBar(bar: HTMLElement, store: Store, stage: PairStage): void {
  const label = { class: "modes", role: "radiogroup", "aria-label": "How the pictures are shown" };
  const modes = make("div", label);
  radioGroup(modes, MODES, stage.mode, (mode) => stage.setMode(mode));
  const button = (words: string, facts: Record<string, string>): HTMLButtonElement =>
    make("button", { type: "button", class: "small", ...facts }, words);
  const marks = button("Marks", { id: "marks", title: "Pairs over the pictures (H)" });
  const turn = button("↻", { id: "turn", "aria-label": "Turn by 90°", title: "Turn by 90° (T)" });
  marks.addEventListener("click", () => (stage.marks.value = !stage.marks.value));
  turn.addEventListener("click", () => void store.turn(90));
  const outline = button("Outline", {
    id: "outline",
    title: "Draw or correct the outline of the object over the reference",
  });
  outline.addEventListener("click", () => stage.outline.toggle());
  const built = make("option", { value: "built" }, "Last registration");
  const map = make(
    "select",
    { id: "map", "aria-label": "Map between the pictures" },
    make("option", { value: "pairs" }, "These pairs"),
    built,
  );
  map.addEventListener("change", () => {
    store.map.value = map.value === "built" ? "built" : "pairs";
  });
  const settings = [map, settingsOf(stage)];
  bar.append(
    make("div", { class: "line" }, modes, marks, turn, outline, besideOf(store)),
    make("div", { class: "line" }, ...settings),
  );
  effect(() => {
    map.value = store.map.value;
    built.disabled = !store.frame.value?.built;
    marks.setAttribute("aria-pressed", String(stage.marks.value));
    outline.setAttribute("aria-pressed", String(stage.outline.open.value));
    outline.hidden = (store.frame.value?.beside.length ?? 0) > 0;
  });
}

/** The neighbour beside which a tile of the reference is placed. */
function besideOf(store: Store): HTMLElement {
  const select = make("select", {
    id: "beside",
    title: "The tile beside which this one is placed",
  });
  const label = make("label", { class: "beside" }, "Beside ", select);
  select.addEventListener("change", () => {
    store.open(select.value).catch((error: unknown) => store.refuse(error));
  });
  effect(() => {
    const { id = "", beside = [] } = store.frame.value ?? {};
    label.hidden = beside.length === 0;
    const options = beside.map((one) => {
      const words = one.placed ? one.tile : `${one.tile}, left out`;
      return make("option", { value: one.id }, words);
    });
    refill(select, ...options);
    select.value = id;
  });
  return label;
}

/** Sliders of the mode that is chosen; their place is kept free, so that nothing moves. */
function settingsOf(stage: PairStage): HTMLElement {
  const rate = slider(
    "Rate",
    RATES,
    (hertz) => `${hertz} Hz`,
    (hertz) => (stage.flicker.rate = hertz),
  );
  const gain = slider(
    "Amplify",
    GAIN,
    (factor) => `× ${factor}`,
    (factor) => stage.setTone(1, 1, factor),
  );
  stage.setTone(1, 1, GAIN.value);
  effect(() => {
    rate.element.hidden = stage.mode.value !== "flicker";
    gain.element.hidden = stage.mode.value !== "difference";
  });
  return make("div", { class: "of-mode" }, rate.element, gain.element);
}

void start();
