// What the page knows, in one place; whoever draws something of it listens.
import { bytes, get, Refusal } from "./api";
import { read } from "./columns";
import type { CameraRow, FrameInfo, Pair, Partner, Told } from "./record";

type Listener = () => void;

export class Store {
  campaign = "";
  cameras: CameraRow[] = [];
  frame: FrameInfo | null = null;
  told: Told | null = null;
  selected = -1;
  proposal: Partner | null = null;
  /** In which picture the proposed pair was begun: a click into the other one places its partner. */
  begun: 0 | 2 = 0;
  measured: Partner | null = null;
  map: "pairs" | "built" = "pairs";
  message = "";
  refused = "";
  private readonly listeners: Listener[] = [];
  private queue: Promise<unknown> = Promise.resolve();

  listen(listener: Listener): void {
    this.listeners.push(listener);
  }

  changed(): void {
    for (const listener of this.listeners) listener();
  }

  get path(): string {
    return `/api/cameras/${this.frame?.id ?? ""}`;
  }

  async loadCameras(): Promise<void> {
    const told = await get<{ campaign: string; cameras: CameraRow[] }>("/api/cameras");
    this.campaign = told.campaign;
    this.cameras = told.cameras;
    this.changed();
  }

  async open(id: string): Promise<void> {
    this.frame = await get<FrameInfo>(`/api/cameras/${id}`);
    this.told = read(await bytes(`${this.path}/pairs`), []);
    [this.selected, this.proposal, this.measured, this.message] = [-1, null, null, ""];
    this.map = this.frame.built && !this.told.corrections ? "built" : "pairs";
    this.changed();
  }

  /** Wait until all that was asked is answered. */
  async settled(): Promise<void> {
    await this.queue;
  }

  /** Change something; answers come in the order of the questions. */
  edit(body: Record<string, unknown>, keep?: Pair): Promise<void> {
    return this.take((pairs) => bytes(`${this.path}/edit`, { ...body, known: this.told?.places ?? "" }).then((answer) => read(answer, pairs)), keep);
  }

  take(question: (pairs: Pair[]) => Promise<Told>, keep?: Pair): Promise<void> {
    const before = keep ?? this.pair(this.selected);
    const run = this.queue.then(async () => {
      try {
        this.told = await question(this.told?.pairs ?? []);
        this.refused = "";
        this.selected = before ? this.rowAt(before) : -1;
        if (this.map === "built" && this.told.corrections) this.map = "pairs";
      } catch (error) {
        this.refuse(error);
        // Another workbench or an editor was first: what is there now is shown.
        if (error instanceof Refusal && error.status === 409) this.told = read(await bytes(`${this.path}/pairs`), []);
      }
      this.changed();
    });
    this.queue = run;
    return run;
  }

  refuse(error: unknown): void {
    this.refused = error instanceof Refusal || error instanceof Error ? error.message : String(error);
    this.changed();
  }

  pair(row: number): Pair | null {
    return this.told?.pairs[row] ?? null;
  }

  /** The row of a pair, by its place; the nearest one where it was rounded. */
  rowAt(pair: Pair): number {
    const pairs = this.told?.pairs ?? [];
    let [best, at] = [0.03, -1];
    pairs.forEach((p, i) => {
      if (Math.abs(p[0] - pair[0]) >= best) return;
      const apart = Math.max(...p.map((v, k) => Math.abs(v - pair[k]!)));
      if (apart < best) [best, at] = [apart, i];
    });
    return at;
  }

  select(row: number): void {
    if (row === this.selected) return;
    [this.selected, this.proposal, this.measured] = [row, null, null];
    this.changed();
  }
}
