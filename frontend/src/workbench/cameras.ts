// The list of cameras, by object; a click opens one.
import { effect } from "@preact/signals-core";
import { make, refill } from "../shared/element";
import type { CameraRow } from "./record";
import type { Store } from "./store";

const FEW_TILES = 3; // accepted ones that are listed among the others

/** Make the list; `open` is called with the id of the camera that was chosen. */
export function cameraList(store: Store, open: (id: string) => void): HTMLElement {
  const nav = make("nav", { "aria-label": "Cameras" });
  effect(() => {
    const current = store.frame.value?.id;
    const groups = new Map<string, CameraRow[]>();
    for (const row of store.cameras.value)
      groups.set(row.object, [...(groups.get(row.object) ?? []), row]);
    const sections = [...groups.values()].map((rows) => {
      const itemOf = (row: CameraRow): HTMLElement => {
        const button = buttonOf(row, isOpen(row, current));
        button.addEventListener("click", () => open(row.id));
        return make("li", {}, button);
      };
      const right = rows.filter((row) => row.tile !== "" && row.decision === "accept");
      const folded = right.length > FEW_TILES ? right : [];
      const shown = rows.filter((row) => !folded.includes(row));
      const more =
        folded.length > 0 &&
        make(
          "details",
          { class: "folded", open: folded.some((row) => isOpen(row, current)) },
          make("summary", {}, `${folded.length} tiles that are accepted`),
          make("ul", {}, ...folded.map(itemOf)),
        );
      const list = make("ul", {}, ...shown.map(itemOf));
      return make("section", {}, make("h2", {}, rows[0]!.title), list, more);
    });
    refill(nav, make("p", { class: "soft campaign" }, store.campaign.value), ...sections);
  });
  return nav;
}

/** Whether it is the one that is open; a tile of the reference has an id for each of its neighbours. */
function isOpen(row: CameraRow, current: string | undefined): boolean {
  return row.id.split("-")[0] === current?.split("-")[0];
}

function buttonOf(row: CameraRow, current: boolean): HTMLButtonElement {
  const { id, sensor, setup, tile, bands, reference, decision, verdict, reason } = row;
  const camera = tile ? `${row.camera}#${tile}` : row.camera;
  const about = [setup && `under ${setup}`, bands].filter(Boolean).join(", ");
  return make(
    "button",
    {
      type: "button",
      id: `camera-${id.split("-")[0]}`,
      "aria-current": current && "true",
      title: [verdict, reason].filter(Boolean).join(": "),
    },
    make("span", { class: "name" }, sensor ? `${camera} · ${sensor}` : camera),
    make("span", { class: "soft of" }, about),
    make("span", { class: `badge ${reference ? "reference" : decision}` }, verdict.split(",")[0]),
  );
}
