// The session as the server tells it: frames, counts, what is missing.

export type Verdict = "green" | "look" | "stop" | "waiting";

export interface Finding {
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
  verdict: Verdict;
  findings: Finding[];
  at: number;
}

export interface Session {
  folder: string;
  counts: Record<Verdict, number>;
  frames: Frame[];
  missing: { kind: string; what: string; why: string }[];
  guessed: boolean;
  strays: string[];
  problems: string[];
  away: boolean;
}

const ORDER: Verdict[] = ["stop", "look", "waiting", "green"];

/** The frame to show: of some that come together the gravest, of those that were there at first the last. */
export function newestOf({ frames }: Session, before: Session | null): Frame | undefined {
  const known = new Map(before?.frames.map((frame) => [frame.name, JSON.stringify(frame)]));
  const fresh = frames.filter((one) => known.get(one.name) !== JSON.stringify(one));
  const judged = lastFirst(fresh.filter(({ verdict }) => verdict !== "waiting"));
  return before ? judged.sort(byVerdict)[0] : judged[0];
}

/** Frames that are not well, the gravest first, of equals the last first. */
export function faultsOf(frames: Frame[]): Frame[] {
  return lastFirst(frames.filter(({ findings }) => findings.length)).sort(byVerdict);
}

/** Frames by camera, setup and what they show. */
export function groupsOf(frames: Frame[]): Map<string, Frame[]> {
  const found = new Map<string, Frame[]>();
  for (const frame of [...frames].sort((a, b) => a.at - b.at)) {
    const camera = frame.setup ? `${frame.camera}@${frame.setup}` : frame.camera;
    const key = `${camera} · ${frame.role === "object" ? frame.target : frame.role}`;
    found.set(key, [...(found.get(key) ?? []), frame]);
  }
  return new Map([...found].sort(([a], [b]) => a.localeCompare(b, "en", { numeric: true })));
}

/** A sentence as it stands alone. */
export function sentence(text: string): string {
  return `${text.slice(0, 1).toUpperCase()}${text.slice(1)}.`;
}

/** Frames by time, the last first; of the same time the one that is listed last. */
function lastFirst(frames: Frame[]): Frame[] {
  return [...frames].reverse().sort((a, b) => b.at - a.at);
}

const byVerdict = (a: Frame, b: Frame): number =>
  ORDER.indexOf(a.verdict) - ORDER.indexOf(b.verdict);
