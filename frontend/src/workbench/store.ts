// What the page knows. Whatever shows a part of it is an effect of that part.
import { batch, computed, signal } from "@preact/signals-core";
import { getJson, messageOf, Refusal } from "./api";
import type { Point } from "../shared/pane";
import type { CameraRow, Filter, FrameInfo, Pair, Partner, Proposal, SessionState } from "./record";

const SAME_PX = 0.03; // pairs are rounded on their way

export class Store {
  readonly campaign = signal("");
  readonly cameras = signal<CameraRow[]>([]);
  readonly frame = signal<FrameInfo | null>(null);
  readonly session = signal<SessionState | null>(null);
  readonly selected = signal(-1);
  readonly proposal = signal<Proposal | null>(null);
  readonly measured = signal<Partner | null>(null);
  /** The map that brings the pictures together. */
  readonly map = signal<"pairs" | "built">("pairs");
  readonly filter = signal<Filter>("kept");
  /** Whether the corrections have changed since the last registration. */
  readonly stale = computed(() => {
    const now = this.session.value?.corrections ?? "";
    const known = JSON.stringify(this.frame.value?.registered_outline ?? []);
    const outline = JSON.stringify(this.declared.value);
    return now !== (this.frame.value?.registered ?? "") || outline !== known;
  });
  /** The outline that a person drew, or that campaign.toml declares. */
  private readonly declared = computed((): Point[] => {
    const drawn = this.session.value?.outline ?? [];
    return drawn.length ? drawn : (this.frame.value?.declared_outline ?? []);
  });
  /** The outline that holds from now on; none where it is to be found anew. */
  readonly outline = computed((): Point[] => {
    const [frame, declared] = [this.frame.value, this.declared.value];
    if (declared.length || frame?.registered_outline?.length) return declared;
    return frame?.outline ?? [];
  });
  readonly refused = signal("");
  private queue: Promise<unknown> = Promise.resolve();

  get path(): string {
    return `/api/cameras/${this.frame.value?.id ?? ""}`;
  }

  async loadCameras(): Promise<void> {
    const answer = await getJson<{ campaign: string; cameras: CameraRow[] }>("/api/cameras");
    batch(() => {
      this.campaign.value = answer.campaign;
      this.cameras.value = answer.cameras;
    });
  }

  async open(id: string): Promise<void> {
    const path = `/api/cameras/${id}`;
    const frame = await getJson<FrameInfo>(path);
    const session = await getJson<SessionState>(`${path}/pairs`);
    batch(() => {
      this.choose({});
      this.frame.value = frame;
      this.session.value = session;
      this.map.value = frame.built && !this.stale.value ? "built" : "pairs";
      this.refused.value = "";
    });
  }

  /** Wait until all requests are answered. */
  async settled(): Promise<void> {
    await this.queue;
  }

  /** Change something; answers come in the order of the requests. */
  edit(change: Record<string, unknown>, keep?: Pair): Promise<void> {
    return this.take(() => getJson<SessionState>(`${this.path}/edit`, change), keep);
  }

  /** Queue a request that answers with a session; the pair `keep` is the selected one afterwards. */
  take(request: () => Promise<SessionState>, keep?: Pair): Promise<void> {
    const before = keep ?? this.selectedPair();
    const run = this.queue.then(async () => {
      try {
        const session = await request();
        batch(() => {
          this.session.value = session;
          this.refused.value = "";
          this.selected.value = before ? rowAt(session.pairs, before) : -1;
          if (this.stale.value) this.map.value = "pairs";
        });
      } catch (error) {
        this.refuse(error);
        // Another workbench or an editor was first: what is there now is shown.
        if (error instanceof Refusal && error.status === 409)
          this.session.value = await getJson<SessionState>(`${this.path}/pairs`);
      }
    });
    this.queue = run;
    return run;
  }

  /** Turn the pictures of this object by so many degrees clockwise, for good. */
  async turn(by: number): Promise<void> {
    const frame = this.frame.peek();
    if (!frame) return;
    const degrees = (frame.turn + by + 360) % 360;
    this.frame.value = { ...frame, turn: degrees };
    await getJson(`${this.path}/turn`, { degrees }).catch((error: unknown) => this.refuse(error));
  }

  refuse(error: unknown): void {
    this.refused.value = messageOf(error);
  }

  selectedPair(): Pair | null {
    return this.session.value?.pairs[this.selected.value] ?? null;
  }

  /** Select a row, show a proposal or a measured place; one of them at a time, and nothing by `{}`. */
  choose(what: { row?: number; proposal?: Proposal; measured?: Partner }): void {
    batch(() => {
      this.selected.value = what.row ?? -1;
      this.proposal.value = what.proposal ?? null;
      this.measured.value = what.measured ?? null;
    });
  }
}

/** The row of a pair, by its place; the nearest one where it was rounded, -1 where there is none. */
export function rowAt(pairs: readonly Pair[], pair: Pair): number {
  let [best, at] = [SAME_PX, -1];
  pairs.forEach((one, row) => {
    if (Math.abs(one[0] - pair[0]) >= best) return;
    const apart = Math.max(...one.map((value, i) => Math.abs(value - pair[i]!)));
    if (apart < best) [best, at] = [apart, row];
  });
  return at;
}
