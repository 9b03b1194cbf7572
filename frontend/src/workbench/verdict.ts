// The verdict in words, and a new registration.
import { effect, signal } from "@preact/signals-core";
import { make, refill } from "../shared/element";
import { describeProblem, getJson, messageOf, type Problem } from "./api";
import { length, type FrameInfo, type SessionState } from "./record";
import type { Store } from "./store";

interface Building {
  state: string;
  line: string;
  done: number;
  total: number;
  problems: Problem[];
}

const POLL_MS = 400;
const NAME = "levkas-name"; // the cookie in which the browser keeps who confirms, from one port to the next
const ENOUGH = 4; // pairs from which a new registration can begin

/** The verdict of the last build, the sum of the pairs, and a new registration. */
export class VerdictCard {
  readonly root: HTMLElement;
  private readonly again: HTMLButtonElement;
  private readonly progress = make("p", {
    class: "soft",
    "aria-live": "polite",
    id: "build-status",
  });
  private readonly running = signal(false);
  private readonly byHand = make("button", {
    type: "button",
    id: "by-hand",
    title: "The layer is placed by your pairs alone, and labelled so everywhere",
  });
  private readonly takeBack = make(
    "button",
    {
      type: "button",
      class: "small",
      id: "take-back",
      title: "One change; Undo restores it",
    },
    "Take all back",
  );

  constructor(private readonly store: Store) {
    const content = make("div");
    const title = "Runs the registration with your corrections, as levkas build does";
    const button = { type: "button", class: "primary", id: "build", title };
    this.again = make("button", button, "Register again");
    this.again.addEventListener("click", () => void this.build());
    this.takeBack.addEventListener("click", () => void store.edit({ operation: "take_all_back" }));
    this.root = make(
      "section",
      { class: "card verdict", "aria-labelledby": "verdict-head" },
      make("h2", { id: "verdict-head" }, "Verdict"),
      content,
      this.again,
      " ",
      this.byHand,
      this.confirmation(),
      this.progress,
    );
    effect(() => {
      const [frame, session] = [store.frame.value, store.session.value];
      if (!frame || !session) return;
      const back = session.corrections !== "" && this.takeBack;
      refill(content, ...describe(frame, session, store.stale.value), back);
    });
    this.byHand.addEventListener("click", () => void this.place());
    effect(() => {
      const [frame, session] = [store.frame.value, store.session.value];
      this.again.disabled = this.byHand.disabled = this.running.value;
      const placed = session?.accept === "by hand";
      this.byHand.hidden = !frame || !session || frame.is_reference || !(placed || enough(session));
      this.byHand.textContent = placed ? "Register by the pictures" : "Place by hand";
    });
  }

  /** A person's word that a doubtful layer is right: name and a sentence, or to take it back. */
  private confirmation(): HTMLElement {
    const name = make("input", { id: "confirm-name", autocomplete: "name", required: true });
    const words = make("input", { id: "confirm-words", required: true });
    const button = make("button", { id: "confirm" }, "Confirm");
    const form = make(
      "form",
      { class: "confirm" },
      make("label", {}, "Your name", name),
      make("label", {}, "What you saw", words),
      button,
    );
    const summary = make("summary", { id: "confirm-head" }, "I looked: it is right");
    const open = make("details", {}, summary, form);
    const back = make("button", { type: "button", id: "unconfirm" }, "Take confirmation back");
    const send = async (body: Record<string, string | boolean>): Promise<void> => {
      const { frame, path } = this.store;
      if (!frame.value) return;
      try {
        await getJson(`${path}/confirm`, { ...body, map: frame.value.verdict.map });
        await this.store.open(frame.value.id);
        await this.store.loadCameras();
        this.progress.textContent =
          "Saved in edits.toml; the next build writes it into catalogue, report and pages.";
      } catch (error) {
        this.progress.textContent = messageOf(error);
      }
    };
    form.addEventListener("submit", (event) => {
      event.preventDefault();
      const kept = encodeURIComponent(name.value);
      document.cookie = `${NAME}=${kept}; max-age=31536000; samesite=strict; path=/`;
      void send({ name: name.value, words: words.value });
    });
    back.addEventListener("click", () => void send({ take_back: true }));
    effect(() => {
      const layer = this.store.frame.value?.verdict.layer;
      // Corrections that no registration knows yet will change the map.
      open.hidden = layer !== "warn" || this.store.stale.value;
      open.open = false;
      back.hidden = layer !== "confirmed";
      const kept = new RegExp(`(?:^|; )${NAME}=([^;]*)`).exec(document.cookie);
      name.value = decodeURIComponent(kept?.[1] ?? "");
      words.value = "";
    });
    return make("div", {}, open, back);
  }

  /** Place the layer by the pairs alone, or by the pictures again, and build it so. */
  private async place(): Promise<void> {
    const value = this.store.session.value?.accept !== "by hand";
    await this.store.edit({ operation: "accept", value });
    if ((this.store.session.value?.accept === "by hand") === value) await this.build();
  }

  private async build(): Promise<void> {
    const frame = this.store.frame.value;
    if (this.running.value || !frame) return;
    this.running.value = true;
    try {
      let state = await getJson<Building>(`${this.store.path}/build`, {});
      while (state.state === "running") {
        const share = state.total ? ` (${state.done} of ${state.total})` : "";
        this.progress.textContent = state.line + share;
        await new Promise((resolve) => setTimeout(resolve, POLL_MS));
        state = await getJson<Building>("/api/build");
      }
      await this.store.open(frame.id);
      await this.store.loadCameras();
      this.store.map.value = this.store.frame.value?.built ? "built" : "pairs";
      const { verdict } = this.store.frame.value ?? frame;
      const failed = state.problems.filter((problem) => !isSaid(problem, verdict.reasons));
      const refused = verdict.decision === "refuse" ? " It is refused, for the reasons above." : "";
      this.progress.textContent = failed.length
        ? failed.map(describeProblem).join("\n")
        : `Registered again.${refused}`;
    } catch (error) {
      this.progress.textContent = messageOf(error);
    }
    this.running.value = false;
  }
}

/** Whether a person set enough pairs to place a layer by them alone. */
function enough({ hand }: SessionState): boolean {
  return hand.filter((one) => ["added", "pinned", "restored"].includes(one)).length >= ENOUGH;
}

/** Whether the reasons of the verdict tell of a problem already. */
function isSaid({ message }: Problem, reasons: string[]): boolean {
  const text = message.toLowerCase();
  return reasons.some((reason) => text.includes(reason.toLowerCase()));
}

function describe(
  frame: FrameInfo,
  session: SessionState,
  stale: boolean,
): (HTMLElement | false)[] {
  const { decision, words, reasons, next_step } = frame.verdict;
  const badge = make("span", { class: `badge ${decision}` }, words);
  const corrections = session.corrections.replace(/ \([0-9a-f]+\)$/, "");
  return [
    make(
      "p",
      {},
      badge,
      stale &&
        make(
          "span",
          { class: "soft" },
          " as of the last registration, without your latest corrections",
        ),
    ),
    make("p", { class: "sum", id: "sum" }, ...summarise(frame, session, stale)),
    reasons.length > 0 && make("ul", {}, ...reasons.map((reason) => make("li", {}, reason))),
    // With corrections made since, that step may be done.
    next_step !== "" && !stale && make("p", {}, make("strong", {}, "Next: "), next_step),
    corrections !== "" &&
      make(
        "p",
        { class: "soft", id: "corrections" },
        `Your corrections: ${corrections}. Saved in edits.toml.`,
      ),
  ];
}

/** Error of the map on the pairs, in plain words. */
function summarise(frame: FrameInfo, session: SessionState, stale: boolean): string[] {
  const { summary, refusal } = session;
  const { kept, pairs, mean, max, checks, check_mean } = summary;
  const own = session.hand.filter((hand, i) => hand === "added" && session.state[i] === "kept");
  const measured = (value: number | null): string => length(value, frame.px_per_mm);
  if (frame.is_reference)
    return [
      "This is the reference camera: all others are registered to it. Its own bands are registered to each other without pairs, so there are no pairs to correct.",
    ];
  if (!refusal && mean === null && kept >= ENOUGH)
    return [
      `${kept} pairs determine a map without redundancy, so its error is unknown. Add a fifth pair.`,
    ];
  if (refusal || mean === null) {
    const found = pairs
      ? `${kept} of at least ${ENOUGH} pairs. `
      : "No matching places were found. Click a place that both pictures show, then press Enter; ";
    return [found, `${ENOUGH} pairs are enough for a new registration.`];
  }
  const words = [
    `${countPlaces(kept - own.length, own.length)} A simple map through them has a mean error of ${measured(mean)}, at most ${measured(max)}.`,
  ];
  const taken = frame.scores[0]?.[frame.chosen[0] ?? ""];
  // What was refused is off elsewhere than where this was measured: the reasons say so.
  if (taken !== undefined && !stale && frame.verdict.decision !== "refuse")
    words.push(` The held-out error of the registration itself is ${measured(taken)}.`);
  if (checks)
    words.push(
      ` The ${checks === 1 ? "error of your check point" : `mean error of your ${checks} check points`} is ${measured(check_mean)}.`,
    );
  return words;
}

function countPlaces(found: number, own: number): string {
  const set = `${own} ${own === 1 ? "pair is" : "pairs are"} set by hand`;
  if (!found) return `${set}.`;
  return `${found} places were matched in both pictures${own ? `, ${set}` : ""}.`;
}
