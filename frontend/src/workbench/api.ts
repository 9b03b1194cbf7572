// Talks to the local server; no request goes to any other host.
import type { Layer, Point } from "../shared/pane";

export interface Problem {
  code?: string;
  message: string;
  fix?: string | null;
}

/** A request that the server refused, or that it did not answer (status 0). */
export class Refusal extends Error {
  constructor(
    readonly status: number,
    problems: Problem[],
  ) {
    super(problems.map(describeProblem).join("\n") || `the server answers ${status}`);
  }
}

/** A problem and what to do about it, in words. */
export function describeProblem({ message, fix }: Problem): string {
  return fix ? `${message}. ${fix}` : message;
}

/** The words of anything that was thrown. */
export function messageOf(error: unknown): string {
  return error instanceof Error ? error.message : String(error);
}

/** Hand in the token of the address, once; the browser keeps a cookie that no script can read. */
export async function enter(): Promise<void> {
  const token = location.hash.slice(1);
  if (token.length < 40) return;
  history.replaceState(null, "", location.pathname);
  await request("/enter", { token });
}

/** Get JSON; with a body it is a change. */
export async function getJson<T>(path: string, body?: unknown): Promise<T> {
  return (await (await request(path, body)).json()) as T;
}

async function request(path: string, body?: unknown): Promise<Response> {
  const how: RequestInit =
    body === undefined
      ? {}
      : {
          method: "POST",
          body: JSON.stringify(body),
          headers: { "content-type": "application/json" },
        };
  let answer: Response;
  try {
    answer = await fetch(path, { ...how, credentials: "same-origin", cache: "no-store" });
  } catch {
    const fix = "Was it ended with Ctrl-C? Start `levkas inspect` again and open the new address";
    throw new Refusal(0, [{ message: "The workbench's server does not answer", fix }]);
  }
  if (answer.ok) return answer;
  const record = (await answer.json().catch(() => ({}))) as { problems?: Problem[] };
  throw new Refusal(answer.status, record.problems ?? []);
}

const TILE = 256;

/** A picture by its address: tiles are requested by level, column and row, level 0 in full size. */
export function layerOf(address: string, size: Point): Layer {
  const maxLevel = Math.max(0, Math.ceil(Math.log2(Math.max(...size) / TILE)));
  const [path, query] = address.split("?");
  const getTileUrl = (level: number, x: number, y: number): string =>
    `${path}/${maxLevel - level}/${x}/${y}?${query}`;
  const source = { tileSize: TILE, tileOverlap: 0, minLevel: 0, maxLevel, getTileUrl };
  return { key: address, size, source };
}
