// Control points of other programs: in and out.
import { make } from "../element";
import { bytes, post } from "./api";
import { read } from "./columns";
import type { Store } from "./store";

const DIALECTS: [string, string][] = [
  ["levkas", "Levkas (CSV)"],
  ["bigwarp", "BigWarp (CSV)"],
  ["qgis", "QGIS georeferencer (.points)"],
  ["hugin", "Hugin (.pto)"],
  ["elastix", "ITK, elastix (two .txt)"],
  ["napari", "napari (two CSV)"],
  ["butterfly", "Butterfly Registrator (CSV)"],
  ["cpselect", "MATLAB cpselect (.mat)"],
];

export function filesDialog(store: Store): HTMLDialogElement {
  const kind = make("select", { id: "dialect", "aria-label": "Program" }, ...DIALECTS.map(([value, words]) => make("option", { value }, words)));
  const out = make("button", { type: "button", class: "primary", id: "export" }, "Save a file");
  const input = make("input", { type: "file", id: "import", multiple: true, "aria-label": "File of control points" });
  const said = make("p", { "aria-live": "polite", id: "files-said" });
  const close = make("button", { type: "button", class: "small", "aria-label": "Close" }, "×");
  const dialog = make(
    "dialog",
    { class: "files", "aria-labelledby": "files-head" },
    make("header", {}, make("h2", { id: "files-head" }, "Control points in files"), close),
    make("p", {}, "Take the pairs to another program, or bring those that you set there. Pixel conventions are translated."),
    make("h3", {}, "Save"),
    make("div", { class: "actions" }, kind, out),
    make("h3", {}, "Open"),
    make("p", { class: "soft" }, "The program is recognised by the file. Programs that write a file for each picture: choose both, the reference's first by name."),
    input,
    said,
  );
  close.addEventListener("click", () => dialog.close());
  out.addEventListener("click", () => void save(store, kind.value, said));
  input.addEventListener("change", () => void open(store, [...(input.files ?? [])], said).finally(() => (input.value = "")));
  document.body.append(dialog);
  return dialog;
}

async function save(store: Store, dialect: string, said: HTMLElement): Promise<void> {
  try {
    const told = await post<{ files: { name: string; data: string }[]; losses: string[] }>(`${store.path}/export`, { dialect });
    for (const file of told.files) {
      const bytes = Uint8Array.from(atob(file.data), (c) => c.charCodeAt(0));
      const link = make("a", { href: URL.createObjectURL(new Blob([bytes], { type: "application/octet-stream" })), download: file.name });
      link.click();
      setTimeout(() => URL.revokeObjectURL(link.href), 10_000);
    }
    said.textContent = [`Saved ${told.files.map((f) => f.name).join(" and ")}.`, ...told.losses.map((loss) => `Not held by this format: ${loss}.`)].join(" ");
  } catch (error) {
    said.textContent = error instanceof Error ? error.message : String(error);
  }
}

async function open(store: Store, files: File[], said: HTMLElement): Promise<void> {
  if (!files.length) return;
  files.sort((a, b) => (a.name.includes("reference") ? -1 : b.name.includes("reference") ? 1 : a.name < b.name ? -1 : 1));
  const data = await Promise.all(files.map(encode));
  const before = store.refused;
  await store.take(async (pairs) => {
    const told = read<{ imported: number; known: number }>(await bytes(`${store.path}/import`, { files: data }), pairs);
    said.textContent = `${told.imported} pairs came in; ${told.known} were there already or are switched off.`;
    return told;
  });
  if (store.refused && store.refused !== before) said.textContent = store.refused;
}

async function encode(file: File): Promise<string> {
  const bytes = new Uint8Array(await file.arrayBuffer());
  let text = "";
  for (let i = 0; i < bytes.length; i += 0x8000) text += String.fromCharCode(...bytes.subarray(i, i + 0x8000));
  return btoa(text);
}
