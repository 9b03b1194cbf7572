// What the map would be if a pair lay elsewhere: requested while it is dragged, before anything is saved.
import { getJson } from "./api";
import type { Pair } from "./record";
import type { Store } from "./store";

/** One question at a time, and of those that came meanwhile the newest. */
export class Trial {
  /** The number by which the server knows the map; 0 without one. */
  number = 0;
  private wanted: { pair: Pair; to: Pair | null } | null = null;
  /** Counts the ends: an answer that comes after one is dropped. */
  private ended = 0;
  private busy = false;

  constructor(
    private readonly store: Store,
    private readonly onMap: () => Promise<void>,
  ) {}

  /** Ask for the map with `pair` at `to`, or with a new pair. */
  async request(pair: Pair, to: Pair | null): Promise<void> {
    this.wanted = { pair, to };
    if (this.busy) return;
    this.busy = true;
    try {
      while (this.wanted) {
        const [body, ended] = [this.wanted, this.ended];
        this.wanted = null;
        const answer = await getJson<{ trial: number }>(`${this.store.path}/attempt`, body);
        if (ended !== this.ended) continue;
        this.number = answer.trial;
        await this.onMap();
      }
    } catch (error) {
      this.store.refuse(error);
    }
    this.busy = false;
  }

  /** Go back to the map of the pairs as they are. */
  end(): void {
    this.number = 0;
    this.ended++;
  }
}
