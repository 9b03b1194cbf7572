// The session as the server tells it: frames by name, counts, what is missing.

export type Verdict = "green" | "look" | "stop" | "waiting";

export interface Finding {
  check: string;
  severity: "look" | "stop";
  text: string;
  advice: string;
}

export interface Frame {
  name: string;
  what: string;
  camera: string;
  setup: string;
  role: string;
  target: string;
  band: string;
  verdict: Verdict;
  findings: Finding[];
  at: number;
}

export interface Missing {
  kind: string;
  what: string;
  why: string;
}

export interface News {
  folder: string;
  counts: Record<Verdict, number>;
  frames: Frame[];
  gone: string[];
  missing: Missing[];
  guessed: boolean;
  strays: string[];
  problems: string[];
  away: boolean;
}

const ORDER: Verdict[] = ["stop", "look", "waiting", "green"];

/** Everything that is known, and what came last. */
export class Session {
  readonly frames = new Map<string, Frame>();
  news: News | null = null;
  newest: Frame | null = null;
  private begun = false;

  /** Take in what changed; return the frames that are new since the page was opened. */
  take(news: News): Frame[] {
    this.news = news;
    for (const name of news.gone) this.frames.delete(name);
    for (const frame of news.frames) this.frames.set(frame.name, frame);
    if (this.newest && !this.frames.has(this.newest.name)) this.newest = null;
    const judged = news.frames.filter(({ verdict }) => verdict !== "waiting");
    // Of some that come together the gravest is shown; of the frames that were there, the last.
    const shown = this.begun ? gravest(judged) : lastFirst(judged)[0];
    if (shown) this.newest = shown;
    else if (this.newest) this.newest = this.frames.get(this.newest.name) ?? null;
    const fresh = this.begun ? judged : [];
    this.begun = true;
    return fresh;
  }

  /** Frames that are not well, the gravest first, of equals the last first. */
  faults(): Frame[] {
    const some = [...this.frames.values()].filter(({ findings }) => findings.length);
    return lastFirst(some).sort((a, b) => rank(a) - rank(b));
  }

  /** Frames by camera, setup and what they show. */
  groups(): Map<string, Frame[]> {
    const found = new Map<string, Frame[]>();
    for (const frame of this.frames.values()) {
      const camera = frame.setup ? `${frame.camera}@${frame.setup}` : frame.camera;
      const key = `${camera} · ${frame.role === "object" ? frame.target : frame.role}`;
      const group = found.get(key);
      if (group) group.push(frame);
      else found.set(key, [frame]);
    }
    for (const group of found.values()) group.sort((a, b) => a.at - b.at);
    return new Map([...found].sort(([a], [b]) => a.localeCompare(b, "en", { numeric: true })));
  }
}

/** Frames by time, the last first; of the same time the one that is listed last. */
function lastFirst(frames: Frame[]): Frame[] {
  return [...frames].reverse().sort((a, b) => b.at - a.at);
}

function rank(frame: Frame): number {
  return ORDER.indexOf(frame.verdict);
}

/** The frame with the gravest verdict, of equals the last; undefined of none. */
export function gravest(frames: Frame[]): Frame | undefined {
  return lastFirst(frames).sort((a, b) => rank(a) - rank(b))[0];
}

/** A sentence as it stands alone. */
export function sentence(text: string): string {
  return `${text.slice(0, 1).toUpperCase()}${text.slice(1)}.`;
}

/** The list to file or to print, as plain text. */
export function asText({ folder, counts, missing }: News, faults: Frame[]): string {
  const lines = [
    `${folder}: ${counts.green} green, ${counts.look} look, ${counts.stop} stop`,
    "",
    "Before the object leaves",
    ...(missing.length
      ? missing.map(
          ({ kind, what, why }) => `[ ] ${what}${kind === "again" ? " again" : ""} (${why})`,
        )
      : ["nothing is missing"]),
    "",
    "Frames to look at",
    ...faults.flatMap(({ name, verdict, what, findings }) => [
      `${verdict}  ${what}  ${name}`,
      ...findings.map(({ text, advice }) => `      ${sentence(text)} ${sentence(advice)}`),
    ]),
  ];
  return `${lines.join("\n")}\n`;
}
