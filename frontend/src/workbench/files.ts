// Control points of other programs: in and out.
import { make, saveFile } from "../shared/element";
import { openableDialog } from "../shared/keys";
import { getJson, messageOf } from "./api";
import type { SessionState } from "./record";
import type { Store } from "./store";

const CHUNK = 0x8000; // bytes that one call makes characters of

export function filesDialog(store: Store): HTMLDialogElement {
  const save = make("button", { type: "button", class: "primary", id: "export" }, "Save a CSV");
  const input = make("input", {
    type: "file",
    id: "import",
    "aria-label": "File of control points",
  });
  const status = make("p", { "aria-live": "polite", id: "files-status" });
  const show = (text: string): void => void (status.textContent = text);
  save.addEventListener("click", () => void exportPoints(store).then(show));
  input.addEventListener("change", () => {
    const file = input.files?.[0];
    input.value = "";
    if (file) void importPoints(store, file).then(show);
  });
  return openableDialog(
    "files",
    "Control points in files",
    make(
      "p",
      {},
      "Save the pairs as a CSV, or import pairs of a CSV, of BigWarp or of QGIS. Pixel conventions are converted.",
    ),
    make("h3", {}, "Save"),
    make("div", { class: "actions" }, save),
    make("h3", {}, "Open"),
    make("p", { class: "soft" }, "The format is recognised from the file."),
    input,
    status,
  );
}

async function exportPoints(store: Store): Promise<string> {
  try {
    const { name, data } = await getJson<{ name: string; data: string }>(
      `${store.path}/export`,
      {},
    );
    const bytes = Uint8Array.from(atob(data), (c) => c.charCodeAt(0));
    saveFile(name, bytes, "application/octet-stream");
    return `Saved ${name}.`;
  } catch (error) {
    return messageOf(error);
  }
}

async function importPoints(store: Store, file: File): Promise<string> {
  const data = await encode(file);
  let answer = "";
  await store.take(async () => {
    const session = await getJson<SessionState & { imported: number; known: number }>(
      `${store.path}/import`,
      { file: data },
    );
    const { imported, known } = session;
    answer = `${imported} ${imported === 1 ? "pair was" : "pairs were"} imported; ${known} in the file exist already or are disabled.`;
    return session;
  });
  return answer || store.refused.value;
}

/** A file in Base64. */
async function encode(file: File): Promise<string> {
  const bytes = new Uint8Array(await file.arrayBuffer());
  let text = "";
  for (let i = 0; i < bytes.length; i += CHUNK)
    text += String.fromCharCode(...bytes.subarray(i, i + CHUNK));
  return btoa(text);
}
