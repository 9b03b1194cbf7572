// The verdict in words, what is chosen and what can be done with it.
import { make, refill } from "../element";
import { get, post, Refusal } from "./api";
import { DECISIONS, length, px, type Pair, type Partner } from "./record";
import type { Store } from "./store";

interface Building {
  state: string;
  line: string;
  done: number;
  total: number;
  problems: { message: string; fix?: string | null }[];
}

const POLL_MS = 400;
const ENOUGH = 4;

/** The verdict of the last build, the sum of the pairs, and a new registration. */
export class VerdictCard {
  readonly root = make("section", { class: "card verdict", "aria-labelledby": "verdict-head" });
  private readonly content = make("div");
  private readonly again = make("button", { type: "button", class: "primary", id: "build" }, "Register again");
  private readonly progress = make("p", { class: "soft", "aria-live": "polite", id: "build-said" });
  private running = false;
  private shown: unknown[] = [];

  constructor(private readonly store: Store) {
    this.root.append(make("h2", { id: "verdict-head" }, "Can it be believed?"), this.content, this.again, this.progress);
    this.again.title = "Runs the registration with your corrections, as levkas build does";
    this.again.addEventListener("click", () => void this.build());
    store.listen(() => this.draw());
  }

  private draw(): void {
    const { frame, told } = this.store;
    if (!frame || !told) return;
    this.again.disabled = this.running;
    if (this.shown[0] === frame && this.shown[1] === told) return;
    this.shown = [frame, told];
    const { decision, reasons, next_step } = frame.verdict;
    const stale = told.corrections !== "";
    refill(
      this.content,
      make("p", {}, make("span", { class: `badge ${decision}` }, DECISIONS[decision] ?? decision), stale ? make("span", { class: "soft" }, " as of the last registration") : null),
      make("p", { class: "sum", id: "sum" }, ...this.sum()),
      ...(reasons.length ? [make("ul", {}, ...reasons.map((reason) => make("li", {}, reason)))] : []),
      ...(next_step ? [make("p", {}, make("strong", {}, "Next: "), next_step)] : []),
      ...this.models(),
      ...(stale ? [make("p", { class: "soft", id: "corrections" }, `Your corrections: ${told.corrections.replace(/ \([0-9a-f]+\)$/, "")}. Saved in edits.toml.`)] : []),
    );
  }

  /** What the pairs say, for someone who has never heard of a residual. */
  private sum(): string[] {
    const { frame, told } = this.store;
    const { kept, pairs, mean, max, checks, check_mean } = told!.summary;
    if (frame!.is_reference) return ["This is the camera that all others are registered to. Its own bands are brought together by the registration; there are no pairs to correct."];
    if (told!.refusal || mean === null)
      return [pairs === 0 ? "No place was recognised in both pictures. Click a place that you can find in both, and Enter; " : `${kept} of at least ${ENOUGH} pairs. `, `${ENOUGH} pairs are enough for a new registration.`];
    const words = [`${kept} places are recognised in both pictures. A simple map through them is off by ${length(mean, frame!.px_per_mm)} on average, by ${length(max, frame!.px_per_mm)} at worst.`];
    const taken = frame!.ladder[0]?.[frame!.chosen[0] ?? ""];
    if (taken !== undefined && !told!.corrections) words.push(` The registration itself, which looks everywhere, is off by ${length(taken, frame!.px_per_mm)} where it was not fitted.`);
    if (checks) words.push(` Your ${checks} check point${checks > 1 ? "s are" : " is"} off by ${length(check_mean, frame!.px_per_mm)}.`);
    return words;
  }

  private models(): HTMLElement[] {
    const ladder = Object.entries(this.store.frame!.ladder[0] ?? {}).filter(([, error]) => Number.isFinite(error));
    if (!ladder.length) return [];
    const chosen = this.store.frame!.chosen[0];
    const rows = ladder.map(([name, error]) => make("tr", { class: name === chosen ? "taken" : null }, make("th", { scope: "row" }, name), make("td", {}, error.toFixed(3)), make("td", {}, name === chosen ? "taken" : "")));
    return [make("details", { id: "models" }, make("summary", { id: "models-head" }, "Models that were tried"), make("p", { class: "soft" }, "Error on parts of the picture that the model had not seen, px. A richer one is taken only where it is better there."), make("table", {}, ...rows))];
  }

  private async build(): Promise<void> {
    if (this.running || !this.store.frame) return;
    this.running = this.again.disabled = true;
    try {
      let told = await post<Building>(`${this.store.path}/build`, {});
      while (told.state === "running") {
        this.progress.textContent = `${told.line}${told.total ? ` (${told.done} of ${told.total})` : ""}`;
        await new Promise((resolve) => setTimeout(resolve, POLL_MS));
        told = await get<Building>("/api/build");
      }
      await this.store.open(this.store.frame.id);
      await this.store.loadCameras();
      const failed = told.problems.map((p) => [p.message, p.fix].filter(Boolean).join(". "));
      this.progress.textContent = failed.length ? failed.join("\n") : "Registered again.";
      this.store.map = this.store.frame.built ? "built" : "pairs";
    } catch (error) {
      this.progress.textContent = error instanceof Refusal ? error.message : String(error);
    }
    this.running = false;
    this.store.changed();
  }
}

/** The chosen pair, a proposed one, or a measured place. */
export class PairCard {
  private readonly head = make("h2", { id: "pair-head" });
  private readonly said = make("div", { "aria-live": "polite" });
  private readonly actions = make("div", { class: "actions", tabindex: -1, role: "group", "aria-labelledby": "pair-head" });
  readonly root = make("section", { class: "card pair", "aria-labelledby": "pair-head" }, this.head, this.said, this.actions);

  constructor(private readonly store: Store) {
    store.listen(() => this.draw());
  }

  /** Do something to the chosen pair. */
  act(operation: string): void {
    const pair = this.store.pair(this.store.selected);
    if (pair) void this.store.edit({ operation, pair });
  }

  /** Move what is chosen or proposed in the target, by px of it; whether there is anything. */
  nudge(dx: number, dy: number): boolean {
    const { proposal, selected } = this.store;
    if (proposal) {
      proposal.pair = [proposal.pair[0], proposal.pair[1], proposal.pair[2] + dx, proposal.pair[3] + dy];
      this.store.changed();
      return true;
    }
    const pair = this.store.pair(selected);
    if (!pair) return false;
    const to: Pair = [pair[0], pair[1], pair[2] + dx, pair[3] + dy];
    void this.store.edit({ operation: "move", pair, to }, to);
    return true;
  }

  /** Add the proposed pair, or keep the measured place as a check point. */
  accept(): void {
    const { proposal, measured } = this.store;
    if (proposal) this.keep("add", proposal);
    else if (measured) this.keep("check", measured);
  }

  cancel(): void {
    [this.store.proposal, this.store.measured, this.store.selected] = [null, null, -1];
    this.store.changed();
  }

  private keep(operation: string, partner: Partner): void {
    const pair = partner.pair;
    [this.store.proposal, this.store.measured] = [null, null];
    void this.store.edit({ operation, pair }, pair);
  }

  private draw(): void {
    const { told, selected, proposal, measured, frame } = this.store;
    if (!told || !frame) return;
    if (proposal) return this.show("A new pair", this.proposed(proposal), this.choices("Add it", "Cancel"));
    if (measured) return this.show("How far off here?", this.told(measured), this.choices("Keep as check point", "Close"));
    const pair = this.store.pair(selected);
    if (!pair)
      return this.show("No pair chosen", [make("p", { class: "soft" }, "Click a mark in a picture or a row of the table. Click an empty place to add a pair: its partner in the other picture is found for you.")], []);
    const state = told.state[selected]!;
    const said = state === "check" ? "measures only; the map does not know it" : state === "kept" ? "the map rests on it" : `removed: ${told.reason[selected]}`;
    const button = (id: string, words: string, operation: string, key: string, title: string): HTMLElement => {
      const made = make("button", { type: "button", id: `pair-${id}`, title: `${title} (${key})`, "data-operation": operation }, words);
      made.addEventListener("click", () => this.act(operation));
      return made;
    };
    this.show(
      `Pair ${selected + 1}`,
      [
        make("p", {}, make("strong", {}, length(told.residual[selected], frame.px_per_mm)), ` off; ${said}.`),
        make("p", { class: "soft" }, `By a map that does not know it: ${px(told.leave_one_out[selected])} px. `, `Reference ${pair[0].toFixed(1)}, ${pair[1].toFixed(1)}; here ${pair[2].toFixed(1)}, ${pair[3].toFixed(1)}.`),
      ],
      [
        state === "removed" ? button("use", "Restore", "restore", "R", "Let the map rest on it, come what may") : button("use", "Delete", "delete", "Del", "The map no longer rests on it"),
        button("pin", told.reason[selected] === "pinned by hand" ? "Unpin" : "Pin", "pin", "P", "Never to be removed"),
        button("snap", "Snap", "snap", "S", "Move it to where its surroundings agree best"),
        button("check", state === "check" ? "No check point" : "Check point", "check", "C", "Measures, and is never fitted"),
      ],
    );
  }

  private proposed(partner: Partner): HTMLElement[] {
    const score = partner.score < 0 ? "Placed by you." : partner.score === 0 ? "Nothing here can be compared: place it yourself." : `The partner was found by comparing, likeness ${Math.round(100 * partner.score)} %${partner.sure ? "" : ": look before you accept"}.`;
    return [make("p", {}, score), make("p", { class: "soft" }, `Not there? Click the right place in the other picture. Here ${partner.pair[2].toFixed(1)}, ${partner.pair[3].toFixed(1)}. Arrow keys move it by 0.1 px, with Shift by 1 px.`)];
  }

  private told(partner: Partner): HTMLElement[] {
    const known = partner.score > 0;
    return [make("p", { id: "measured" }, known ? make("strong", {}, length(partner.length, this.store.frame!.px_per_mm)) : "Nothing here can be compared.", known ? ` off (likeness ${Math.round(100 * partner.score)} %).` : "")];
  }

  /** To accept what is proposed or measured, or to let it go. */
  private choices(accept: string, cancel: string): HTMLElement[] {
    const button = (words: string, id: string, kind: string, act: () => void): HTMLElement => {
      const made = make("button", { type: "button", id: `pair-${id}`, class: kind }, words);
      made.addEventListener("click", act);
      return made;
    };
    return [button(accept, "accept", "primary", () => this.accept()), button(cancel, "cancel", "", () => this.cancel())];
  }

  private show(title: string, said: HTMLElement[], actions: HTMLElement[]): void {
    this.head.textContent = title;
    refill(this.said, ...said);
    refill(this.actions, ...actions);
  }
}
