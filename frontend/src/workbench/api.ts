// Talks to the local server; nothing else is ever asked.

export interface Problem {
  code: string;
  message: string;
  found?: unknown;
  expected?: unknown;
  fix?: string | null;
}

export class Refusal extends Error {
  constructor(readonly status: number, readonly problems: Problem[]) {
    super(problems.map((p) => [p.message, p.fix].filter(Boolean).join(". ")).join("\n") || `the server says ${status}`);
  }
}

/** Hand in the token of the address, once; the browser keeps a cookie that no script can read. */
export async function enter(): Promise<void> {
  const token = location.hash.slice(1);
  if (token.length < 40) return;
  history.replaceState(null, "", location.pathname);
  await post("/enter", { token });
}

export async function get<T>(path: string): Promise<T> {
  return (await (await ask(path)).json()) as T;
}

export async function post<T>(path: string, body: unknown): Promise<T> {
  return (await (await ask(path, body)).json()) as T;
}

/** Ask for what comes in columns; with a body it is a change. */
export async function bytes(path: string, body?: unknown): Promise<ArrayBuffer> {
  return (await ask(path, body)).arrayBuffer();
}

async function ask(path: string, body?: unknown): Promise<Response> {
  const how: RequestInit = body === undefined ? {} : { method: "POST", body: JSON.stringify(body), headers: { "content-type": "application/json" } };
  let answer: Response;
  try {
    answer = await fetch(path, { ...how, credentials: "same-origin", cache: "no-store" });
  } catch {
    throw new Refusal(0, [{ code: "E_GONE", message: "The workbench's server does not answer", fix: "Was it ended with Ctrl-C? Start `levkas inspect` again and open the new address" }]);
  }
  if (answer.ok) return answer;
  const record = (await answer.json().catch(() => ({}))) as { problems?: Problem[] };
  throw new Refusal(answer.status, record.problems ?? []);
}
