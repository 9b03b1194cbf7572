// The page of a session that is watched, served by `levkas watch`.
import "../shared/base.css";
import "./watch.css";
import { make, refill } from "../shared/element";
import { startTheme } from "../shared/theme";
import { enter, getJson, messageOf } from "../workbench/api";
import { faultsOf, groupsOf, newestOf, sentence, type Frame, type Session } from "./session";

const WORDS = { green: "green", look: "look", stop: "stop", waiting: "being written" };
const MOST_FAULTS = 60;
const POLL_MS = 500;
const LOCKED = "Open the address that levkas watch printed.";
const SILENT = "levkas watch does not answer. Was it ended? Start it again and open its address.";

class Page {
  private readonly title = make("h1", {}, "The session");
  private readonly notes = make("div", { class: "notes", role: "status" });
  private readonly counts = make("p", { class: "counts" });
  private readonly now = make("section", { class: "now", "aria-live": "polite" });
  private readonly faults = make("section", { class: "faults" });
  private readonly missing = make("section", { class: "missing" });
  private readonly all = make("section", { class: "all" });
  private session: Session | null = null;
  private newest: Frame | null = null;
  /** The name of a frame that a person chose. */
  private chosen = "";

  constructor() {
    const theme = make("button", { type: "button" });
    startTheme(theme);
    document.body.append(
      make("header", {}, make("div", {}, this.title, this.counts), make("nav", {}, theme)),
      this.notes,
      make("main", {}, this.now, this.missing, this.faults, this.all),
    );
  }

  /** Ask for what is new, for ever. */
  async follow(known = -1): Promise<void> {
    let version = known;
    try {
      const news = await getJson<{ version: number; session?: Session }>(
        `/api/session?known=${known}`,
      );
      version = news.version;
      if (news.session) this.take(news.session);
    } catch {
      refill(this.notes, make("p", { class: "stop" }, SILENT));
    }
    setTimeout(() => void this.follow(version), POLL_MS);
  }

  private take(session: Session): void {
    const newest = newestOf(session, this.session);
    if (newest) [this.newest, this.chosen] = [newest, ""];
    this.session = session;
    this.draw(session);
  }

  private draw(session: Session): void {
    const { folder, counts, frames } = session;
    this.title.textContent = folder;
    document.title = `${counts.stop + counts.look || "✓"} · ${folder}`;
    const verdicts = (["green", "look", "stop", "waiting"] as const).filter(
      (verdict) => verdict !== "waiting" || counts.waiting,
    );
    refill(
      this.counts,
      ...verdicts.map((one) => make("span", { class: one }, `${counts[one]} ${WORDS[one]}`)),
    );
    refill(this.notes, ...notesOf(session).map((text) => make("p", {}, text)));
    const shown = this.chosen || this.newest?.name;
    const frame = frames.find(({ name }) => name === shown) ?? null;
    refill(this.now, ...nowOf(frame, this.chosen !== ""));
    refill(this.missing, ...missingOf(session));
    const faults = faultsOf(frames);
    const rows = faults.slice(0, MOST_FAULTS).map((one) => this.faultOf(one));
    const more = faults.length - rows.length;
    refill(
      this.faults,
      make("h2", {}, "To look at"),
      rows.length ? make("ul", {}, ...rows) : make("p", { class: "soft" }, "Nothing."),
      more > 0 ? make("p", { class: "soft" }, `and ${more} more`) : null,
    );
    const groups = [...groupsOf(frames)].map(([name, some]) =>
      make(
        "div",
        { class: "group" },
        make("h3", {}, name, make("span", { class: "soft" }, ` ${some.length}`)),
        make("div", { class: "dots" }, ...some.map((one) => this.dotOf(one))),
      ),
    );
    refill(this.all, make("h2", {}, "All frames"), ...groups);
  }

  private faultOf(frame: Frame): HTMLElement {
    const { verdict, what, findings, name } = frame;
    const button = make("button", { type: "button", class: "link", title: name }, what);
    button.addEventListener("click", () => this.choose(name));
    const texts = findings.map(({ text, advice }) =>
      make("p", {}, sentence(text), " ", make("em", {}, sentence(advice))),
    );
    const badge = make("span", { class: "badge" }, verdict);
    return make("li", { class: verdict }, badge, " ", button, ...texts);
  }

  private dotOf({ name, what, verdict }: Frame): HTMLElement {
    const words = `${what}: ${WORDS[verdict]}`;
    const mark = { green: "", look: "?", stop: "×", waiting: "…" }[verdict];
    const facts = { type: "button", class: `dot ${verdict}`, title: words, "aria-label": words };
    const button = make("button", facts, mark);
    button.addEventListener("click", () => this.choose(name));
    return button;
  }

  private choose(name: string): void {
    this.chosen = name;
    if (this.session) this.draw(this.session);
    this.now.scrollIntoView({ block: "nearest" });
  }
}

function missingOf({ missing, frames }: Session): HTMLElement[] {
  const items = missing.map(({ kind, what, why }) => {
    const again = kind === "again";
    const words = make("strong", {}, again ? `${what} again` : what);
    return make("li", { class: again && "stop" }, words, " ", make("span", { class: "soft" }, why));
  });
  const none = frames.length ? "Nothing is missing." : "No frame has come yet.";
  const list = items.length ? make("ul", {}, ...items) : make("p", {}, none);
  return [make("h2", {}, "Before the object leaves"), list];
}

function notesOf({ away, guessed, strays, problems }: Session): string[] {
  const few = strays.slice(0, 3).join(", ") + (strays.length > 3 ? " …" : "");
  return [
    away ? "The folder cannot be reached. What was known of it is shown." : "",
    guessed
      ? "There is no campaign.toml: cameras, darks and whites are guessed from names and pixels."
      : "",
    strays.length ? `No pattern of campaign.toml fits ${few}.` : "",
    ...problems,
  ].filter(Boolean);
}

function nowOf(frame: Frame | null, chosen: boolean): HTMLElement[] {
  const heading = make("h2", {}, chosen ? "This frame" : "The last frame");
  if (!frame) return [heading, make("p", { class: "soft" }, "No frame has come yet.")];
  const { name, what, verdict, findings } = frame;
  const src = `/api/picture?name=${encodeURIComponent(name)}`;
  const reasons = make(
    "div",
    { class: "reasons" },
    make("p", { class: "what" }, what),
    ...findings.map(({ text, advice }) =>
      make("p", {}, sentence(text), make("strong", {}, ` ${sentence(advice)}`)),
    ),
    verdict === "green" && make("p", {}, "Nothing is wrong with it."),
    make("p", { class: "soft name" }, name),
  );
  const picture = verdict !== "waiting" && make("img", { src, alt: `Small picture of ${what}` });
  const card = { class: `card ${verdict}` };
  return [
    heading,
    make("div", card, make("p", { class: "verdict" }, WORDS[verdict]), reasons, picture),
  ];
}

async function start(): Promise<void> {
  try {
    await enter();
    await getJson("/api/session");
  } catch (error) {
    const words = make("p", {}, `${messageOf(error)} ${LOCKED}`);
    const heading = make("h1", {}, "The page is locked");
    document.body.append(make("main", { class: "alone" }, heading, words));
    return;
  }
  await new Page().follow();
}

void start();
