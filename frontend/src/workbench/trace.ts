// How the outliers of the paper's method left: its Figure 9 as a picture to scrub through, its Figure 10 beneath.
import { effect, signal } from "@preact/signals-core";
import { make, saveFile } from "../shared/element";
import { saveChart } from "../shared/svgfile";
import { onTheme } from "../shared/theme";
import { Curve } from "./curve";
import { Figure } from "./figure";
import type { SessionState } from "./record";
import type { Store } from "./store";
import { thresholdSlider } from "./threshold";

const PLAY_MS = 4000;
const PLAY = "▶";
const PAUSE = "❚❚";

export class TraceView {
  readonly root: HTMLElement;
  /** The round that is shown; -1 is the start, under scale alone. */
  private readonly round = signal(0);
  private readonly figure = new Figure();
  private readonly curve = new Curve((round) => this.go(round));
  private readonly status = make("p", { class: "status", "aria-live": "polite" });
  private readonly play: HTMLButtonElement;
  /** Whether the last round is shown, also when another one becomes the last. */
  private atEnd = true;
  private frame = 0;
  private readonly saveDrawing = button("Save as SVG", "The largest error by round");
  private readonly saveRounds = button("Save as CSV", "Every round: largest error, pair removed");

  constructor(private readonly store: Store) {
    this.play = make(
      "button",
      { type: "button", class: "small", "aria-label": "Play the removal" },
      PLAY,
    );
    const label = "Round of the removal";
    const facts = { type: "range", min: -1, max: 0, value: 0, id: "round", "aria-label": label };
    const range = make("input", facts);
    const reject =
      "Pairs with a larger error under scale alone are removed at once (the paper's T1).";
    const stop = "The worst pair is removed until no error is larger than this (the paper's T2).";
    this.root = make(
      "section",
      { class: "card trace", "aria-labelledby": "trace-head" },
      make("h2", { id: "trace-head" }, "Removal of wrong pairs"),
      this.figure.root,
      make("div", { class: "scrub" }, this.play, range),
      this.curve.root,
      this.status,
      make("div", { class: "actions" }, this.saveDrawing, this.saveRounds),
      thresholdSlider(store, "reject", "Cut at the start (reject)", reject),
      thresholdSlider(store, "stop", "Worst error left (stop)", stop),
    );
    range.addEventListener("input", () => this.go(Number(range.value)));
    this.play.addEventListener("click", () => this.toggle());
    this.saveDrawing.addEventListener("click", () => this.save("svg"));
    this.saveRounds.addEventListener("click", () => this.save("csv"));
    effect(() => {
      const { frame, session } = store;
      range.max = String(Math.max(lastRound(session.value), -1));
      const missing = !session.value?.trace;
      range.disabled = this.play.disabled = missing;
      this.saveDrawing.disabled = this.saveRounds.disabled = missing;
      this.root.hidden = !frame.value?.removes || frame.value.is_reference;
      this.go(this.atEnd ? Infinity : this.round.peek());
    });
    effect(() => {
      range.value = String(this.round.value);
      this.draw();
    });
    onTheme(() => this.draw());
  }

  /** Go to a round. */
  go(round: number): void {
    const last = lastRound(this.store.session.peek());
    this.atEnd = round >= last;
    this.round.value = Math.max(-1, Math.min(last, round));
  }

  /** Save the largest errors by round, as a drawing or as numbers. */
  private save(kind: "svg" | "csv"): void {
    const [frame, session] = [this.store.frame.peek(), this.store.session.peek()];
    const chart = this.curve.root.querySelector("svg");
    if (!frame || !session?.trace || !chart) return;
    const name = [frame.object, frame.camera, frame.sensor, "removal"].filter(Boolean).join("_");
    const title = `${frame.object}, ${frame.camera}: largest error by round, reference px`;
    if (kind === "csv") saveFile(`${name}.csv`, roundsTable(session), "text/csv");
    else
      saveChart(`${name}.svg`, chart, {
        title,
        curves: [
          { colour: "var(--reference)", name: "largest error of a pair" },
          { colour: "var(--target)", name: `where the removal stops, ${session.stop} px` },
        ],
        lines: [title],
      });
  }

  private toggle(): void {
    const last = lastRound(this.store.session.peek());
    if (this.frame || last < 0) return this.pause();
    const from = this.round.value >= last ? -1 : this.round.value;
    const began = performance.now();
    this.play.textContent = PAUSE;
    const tick = (now: number): void => {
      const share = Math.min(1, (now - began) / PLAY_MS);
      this.go(Math.round(from + share * (last - from)));
      if (share < 1) this.frame = requestAnimationFrame(tick);
      else this.pause();
    };
    this.frame = requestAnimationFrame(tick);
  }

  private pause(): void {
    cancelAnimationFrame(this.frame);
    this.frame = 0;
    this.play.textContent = PLAY;
  }

  private draw(): void {
    const [session, round] = [this.store.session.value, this.round.value];
    const rows = session ? rowsAt(session, round) : [];
    this.figure.draw(session, round, rows, this.store.frame.value?.turn ?? 0);
    this.curve.draw(session, round);
    this.status.textContent = session ? describeRound(session, round, rows.length) : "";
  }
}

function button(words: string, title: string): HTMLButtonElement {
  return make("button", { type: "button", class: "small", title }, words);
}

/** Rounds of the removal as CSV: the largest error before each, px, and the number of the pair that left then. */
export function roundsTable({ trace, number }: Pick<SessionState, "trace" | "number">): string {
  const lines = Array.from(trace!.largest, (error, round) => {
    const removed = trace!.removed[round] ?? -1;
    return [round + 1, error.toFixed(3), removed < 0 ? "" : number[removed]].join();
  });
  return ["round,largest_error_px,removed_pair", ...lines, ""].join("\n");
}

function lastRound(session: SessionState | null): number {
  return (session?.trace?.largest.length ?? 0) - 1;
}

/** The pairs that the fit of a round rests on. */
export function rowsAt(session: SessionState, round: number): number[] {
  const { pairs, trace, state, hand, round: left } = session;
  const started = trace && round >= 0;
  const gone = new Set(started ? trace.removed.subarray(0, round) : []);
  return [...pairs.keys()].filter(
    (row) =>
      !gone.has(row) &&
      state[row] !== "check" &&
      hand[row] !== "deleted" &&
      !(started && left[row] === 0),
  );
}

function describeRound({ trace, refusal }: SessionState, round: number, kept: number): string {
  if (!trace) return refusal ? `No map yet: ${refusal}.` : "";
  const rounds = trace.largest.length;
  if (round < 0) {
    const start = trace.cut ? "a first map" : "scale";
    return `Start: ${kept} pairs kept under ${start} alone; ${trace.cut} above \`reject\` were removed.`;
  }
  const end = round === rounds - 1 ? "The end" : `Round ${round + 1} of ${rounds}`;
  return `${end}: ${kept} pairs, largest error ${trace.largest[round]!.toFixed(2)} px.`;
}
