// Levels on the screen: a filter a slot, which the browser applies to the canvas of its pane.
import { effect } from "@preact/signals-core";
import { draw } from "../shared/element";
import { hasLevels, isPlain, tableOf, whiteOf } from "./levels";
import type { PaintingStage } from "./stage";
import { SLOTS, type Choice, type Slot, type State } from "./state";

/** Filters with a table of 256 values: exact for eight bits. */
export class LevelFilters {
  private readonly tables = new Map<Slot, SVGElement[]>();

  constructor(stage: PaintingStage, state: State) {
    const filters = SLOTS.map((slot) => {
      const parts = ["feFuncR", "feFuncG", "feFuncB"].map((name) =>
        draw(name as "feFuncR", { type: "discrete" }),
      );
      this.tables.set(slot, parts);
      const transfer = draw("feComponentTransfer", {}, ...parts);
      const attributes = { id: `levels-${slot}`, "color-interpolation-filters": "sRGB" };
      return draw("filter", { ...attributes, x: 0, y: 0, width: 1, height: 1 }, transfer);
    });
    document.body.append(draw("svg", { class: "filters", "aria-hidden": "true" }, ...filters));
    for (const { slot, pane } of stage.cells)
      effect(() => {
        const canvas = pane.viewer.drawer.canvas as HTMLElement;
        canvas.style.filter = this.filterOf(slot, state[slot].value, state);
      });
  }

  /** The filter of a slot's picture in CSS, none where its levels change nothing. */
  filterOf(slot: Slot, choice: Choice | null, state: State): string {
    if (!choice || !hasLevels(choice.picture)) return "";
    const levels = state.levelsOf(choice);
    const white = whiteOf(choice.picture);
    if (isPlain(levels, white)) return "";
    const values = tableOf(levels, white).map((value) => value.toFixed(5));
    for (const part of this.tables.get(slot)!) part.setAttribute("tableValues", values.join(" "));
    return `url(#levels-${slot})`;
  }
}
