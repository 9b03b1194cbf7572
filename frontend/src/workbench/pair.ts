// The selected pair, a proposed one, or a measured place, and what can be done with it.
import { effect } from "@preact/signals-core";
import { make, refill } from "../shared/element";
import { length, px, type Pair, type Partner, type Proposal } from "./record";
import { rowAt, type Store } from "./store";

const HINT =
  "Click a mark in a picture or a row of the table. Click an empty place to add a pair: its partner in the other picture is found for you.";

const LOOSE_HINT =
  "Click a place in one picture, then the same place in the other, and press Enter. ↻ under the right picture turns it by itself.";
const LOOSE_KEYS =
  "By keyboard: move it with the arrows until the place is in its middle, then press I.";

export class PairCard {
  private readonly head = make("h2", { id: "pair-head" });
  private readonly text = make("div", { "aria-live": "polite" });
  private readonly actions = make("div", {
    class: "actions",
    tabindex: -1,
    role: "group",
    "aria-labelledby": "pair-head",
  });
  readonly root = make(
    "section",
    { class: "card pair", "aria-labelledby": "pair-head" },
    this.head,
    this.text,
    this.actions,
  );

  /** The pair that is chosen after the selected one was deleted. */
  next: () => Pair | null = () => null;
  onNext: () => void = () => {};

  /** A pair whose move is on its way: as it is, and where it is to be. */
  private moving: { from: Pair; to: Pair } | null = null;

  constructor(private readonly store: Store) {
    effect(() => {
      this.root.hidden = store.frame.value?.is_reference === true;
    });
    effect(() => {
      const [proposal, measured] = [store.proposal.value, store.measured.value];
      const pair = store.selectedPair();
      if (proposal) this.showProposal(proposal);
      else if (measured) this.showMeasured(measured);
      else if (pair) this.showPair(pair);
      else {
        const hint = store.session.value?.map ? HINT : LOOSE_HINT;
        this.show("No pair chosen", [make("p", { class: "soft" }, hint)], []);
      }
    });
  }

  /** Do something to the selected pair. */
  act(operation: string): void {
    const pair = this.store.selectedPair();
    if (!pair) return;
    const next = operation === "delete" ? this.next() : null;
    void this.store.edit({ operation, pair }, next ?? pair).then(() => next && this.onNext());
  }

  /** Move what is selected or proposed in the target, by px of it; whether there is anything. */
  nudge(dx: number, dy: number): boolean {
    const proposal = this.store.proposal.peek();
    const pair = proposal?.pair ?? this.store.selectedPair();
    if (!pair) return false;
    const onward = ([a, b, x, y]: Pair): Pair => [a, b, x + dx, y + dy];
    if (proposal) {
      this.store.choose({ proposal: { ...proposal, pair: onward(pair), placed: true } });
    } else if (this.moving && rowAt([this.moving.from, this.moving.to], pair) >= 0) {
      this.moving.to = onward(this.moving.to);
    } else void this.move(pair, onward(pair));
    return true;
  }

  /** Move a saved pair; steps that come meanwhile are one more move, from where it is by then. */
  private async move(from: Pair, to: Pair): Promise<void> {
    const moving = (this.moving = { from, to });
    while (moving.from !== moving.to) {
      const [pair, wanted] = [moving.from, moving.to];
      await this.store.edit({ operation: "move", pair, to: wanted }, wanted);
      moving.from = wanted;
      if (this.store.refused.peek()) break;
    }
    if (this.moving === moving) this.moving = null;
  }

  /** Add the proposed pair, or keep the measured place as a check point. */
  accept(): void {
    const proposal = this.store.proposal.peek();
    const pair = (proposal ?? this.store.measured.peek())?.pair;
    if (!pair || !isFound(proposal ?? this.store.measured.peek()!)) return;
    this.cancel();
    void this.store.edit({ operation: proposal ? "add" : "check", pair }, pair);
  }

  cancel(): void {
    this.store.choose({});
  }

  private showPair(pair: Pair): void {
    const [session, row] = [this.store.session.value!, this.store.selected.value];
    const [state, hand] = [session.state[row]!, session.hand[row]];
    const standing = {
      check: "measured only, not used for the map",
      kept: "used for the map",
      removed: `removed: ${session.reason[row]}`,
    };
    const removed = state === "removed";
    const isCheck = state === "check";
    this.show(
      `Pair ${session.number[row]}`,
      [
        Number.isFinite(session.residual[row] ?? NaN)
          ? make("p", {}, this.lengthOf(session.residual[row]), ` off; ${standing[state]}.`)
          : make("p", {}, `The error is unknown; ${standing[state]}.`),
        make(
          "p",
          { class: "soft" },
          `Error of a map fitted without it: ${px(session.leave_one_out[row])} px.`,
        ),
        coordinates(pair, (to) => void this.store.edit({ operation: "move", pair, to }, to)),
      ],
      [
        removed
          ? this.button("use", "Restore", "restore", "Always use it for the map (U)")
          : this.button("use", "Delete", "delete", "Do not use it for the map (Del)"),
        this.button("pin", hand === "pinned" ? "Unpin" : "Pin", "pin", "Never to be removed (P)"),
        this.button("snap", "Snap", "snap", "Move it to where its surroundings agree best (J)"),
        this.button(
          "check",
          isCheck ? "No check point" : "Check point",
          "check",
          "Measures, and is never fitted (V)",
        ),
      ],
    );
  }

  private showProposal(proposal: Proposal): void {
    const { pair, score, sure, placed } = proposal;
    const sought = !this.store.session.value?.map && !isFound(proposal);
    const found = sure
      ? `The partner was found by comparing the pictures, likeness ${percent(score)}.`
      : "The partner was not found. Click it in the other picture.";
    this.show(
      "A new pair",
      [
        make("p", {}, placed ? "Placed by you." : found),
        make(
          "p",
          { class: "soft" },
          sought
            ? LOOSE_KEYS
            : "If the place is wrong, click the correct one in the other picture. Arrow keys move it by 0.1 px, with Shift by 1 px.",
        ),
        coordinates(pair, (to) =>
          this.store.choose({ proposal: { ...proposal, pair: to, placed: true } }),
        ),
      ],
      this.choices("Add it", "Cancel", isFound(proposal)),
    );
  }

  private showMeasured({ score, sure, length }: Partner): void {
    const unlike =
      score > 0
        ? `The pictures are too different here to compare (likeness ${percent(score)}): the error is unknown.`
        : "Nothing here can be compared.";
    const text = sure ? [this.lengthOf(length), ` off (likeness ${percent(score)}).`] : [unlike];
    this.show(
      "Error here",
      [make("p", { id: "measured" }, ...text)],
      this.choices("Keep as check point", "Close", sure),
    );
  }

  private lengthOf(value: number | null | undefined): HTMLElement {
    return make("strong", {}, length(value, this.store.frame.value?.px_per_mm ?? null));
  }

  private button(id: string, words: string, operation: string, title: string): HTMLElement {
    const facts = { type: "button", id: `pair-${id}`, title, "data-operation": operation };
    const button = make("button", facts, words);
    button.addEventListener("click", () => this.act(operation));
    return button;
  }

  /** To accept what is proposed or measured, or to let it go. */
  private choices(accept: string, cancel: string, allowed = true): HTMLElement[] {
    const facts = { type: "button", id: "pair-accept", class: "primary", disabled: !allowed };
    const yes = make("button", facts, accept);
    const no = make("button", { type: "button", id: "pair-cancel" }, cancel);
    yes.addEventListener("click", () => this.accept());
    no.addEventListener("click", () => this.cancel());
    return [yes, no];
  }

  private show(title: string, text: HTMLElement[], actions: HTMLElement[]): void {
    this.head.textContent = title;
    refill(this.text, ...text);
    refill(this.actions, ...actions);
  }
}

/** Whether the partner of a pair was found by comparing or placed by a person, not only guessed by the map. */
export function isFound({ sure, placed }: Partner & Partial<Proposal>): boolean {
  return sure || placed === true;
}

const FIELDS = ["Reference x", "Reference y", "Here x", "Here y"];

/** Four numbers that can be typed over: Enter, or leaving a field, sets them. */
function coordinates(pair: Pair, set: (to: Pair) => void): HTMLElement {
  const labels = FIELDS.map((name, i) => {
    const value = pair[i]!.toFixed(2);
    const input = make("input", { type: "number", step: 0.1, value, id: `pair-at-${i}` });
    input.addEventListener("change", () => {
      const to: Pair = [...pair];
      to[i] = input.valueAsNumber;
      if (Number.isFinite(to[i])) set(to);
      else input.value = value;
    });
    return make("label", {}, make("span", { class: "soft" }, name), input);
  });
  return make(
    "div",
    { class: "coordinates", role: "group", "aria-label": "Coordinates, px" },
    ...labels,
  );
}

function percent(share: number): string {
  return `${Math.round(100 * share)} %`;
}
