// The list of cameras, by object; a click opens one.
import { effect } from "@preact/signals-core";
import { make, refill } from "../shared/element";
import type { CameraRow } from "./record";
import type { Store } from "./store";

/** Make the list; `open` is called with the id of the camera that was chosen. */
export function cameraList(store: Store, open: (id: string) => void): HTMLElement {
  const nav = make("nav", { "aria-label": "Cameras" });
  effect(() => {
    const current = store.frame.value?.id;
    const groups = new Map<string, CameraRow[]>();
    for (const row of store.cameras.value)
      groups.set(row.object, [...(groups.get(row.object) ?? []), row]);
    const sections = [...groups.values()].map((rows) => {
      const items = rows.map((row) => {
        const button = buttonOf(row, row.id === current);
        button.addEventListener("click", () => open(row.id));
        return make("li", {}, button);
      });
      return make("section", {}, make("h2", {}, rows[0]!.title), make("ul", {}, ...items));
    });
    refill(nav, make("p", { class: "soft campaign" }, store.campaign.value), ...sections);
  });
  return nav;
}

function buttonOf(row: CameraRow, current: boolean): HTMLButtonElement {
  const { id, camera, sensor, setup, bands, reference, decision, verdict, reason } = row;
  const about = [setup && `under ${setup}`, bands].filter(Boolean).join(", ");
  return make(
    "button",
    { type: "button", id: `camera-${id}`, "aria-current": current && "true", title: reason },
    make("span", { class: "name" }, sensor ? `${camera} · ${sensor}` : camera),
    make("span", { class: "soft of" }, about),
    make("span", { class: `badge ${reference ? "reference" : decision}` }, verdict),
  );
}
