// The page of a session that is watched, served by `levkas watch`.
import "../shared/base.css";
import "./watch.css";
import { make, refill, saveFile } from "../shared/element";
import { startTheme } from "../shared/theme";
import { enter, messageOf } from "../workbench/api";
import { asText, sentence, Session, type Frame, type News } from "./session";

const WORDS = { green: "green", look: "look", stop: "stop", waiting: "being written" };
const MOST_FAULTS = 60;

class Page {
  private readonly session = new Session();
  private readonly title = make("h1", {}, "The session");
  private readonly notes = make("div", { class: "notes", role: "status" });
  private readonly counts = make("p", { class: "counts" });
  private readonly now = make("section", { class: "now", "aria-live": "polite" });
  private readonly faults = make("section", { class: "faults" });
  private readonly missing = make("section", { class: "missing" });
  private readonly all = make("section", { class: "all" });
  private chosen: string | null = null;

  constructor() {
    const theme = make("button", { type: "button" });
    const tools = make(
      "nav",
      { "aria-label": "Page" },
      this.large(),
      this.file(),
      this.print(),
      theme,
    );
    startTheme(theme);
    document.body.append(
      make("header", {}, make("div", {}, this.title, this.counts), tools),
      this.notes,
      make("main", {}, this.now, this.missing, this.faults, this.all),
    );
    document.addEventListener("keydown", (event) => {
      if (event.key === "l" && !event.ctrlKey && !event.metaKey && !event.altKey)
        document.getElementById("large")?.click();
    });
  }

  follow(): void {
    const source = new EventSource("/api/events");
    source.addEventListener("message", ({ data }: MessageEvent<string>) => {
      const fresh = this.session.take(JSON.parse(data) as News);
      if (fresh.length) this.chosen = null;
      this.draw();
    });
    source.addEventListener("error", () => {
      const words =
        "levkas watch does not answer. Was it ended? Start it again and open its address.";
      refill(this.notes, make("p", { class: "stop" }, words));
    });
  }

  private draw(): void {
    const news = this.session.news;
    if (!news) return;
    this.title.textContent = news.folder;
    document.title = `${news.counts.stop + news.counts.look || "✓"} · ${news.folder}`;
    refill(
      this.counts,
      ...(["green", "look", "stop", "waiting"] as const).map((verdict) =>
        verdict === "waiting" && !news.counts.waiting
          ? null
          : make("span", { class: verdict }, `${news.counts[verdict]} ${WORDS[verdict]}`),
      ),
    );
    refill(this.notes, ...notesOf(news).map((text) => make("p", {}, text)));
    const shown = this.chosen ? this.session.frames.get(this.chosen) : this.session.newest;
    refill(this.now, ...nowOf(shown ?? null, this.chosen !== null));
    this.drawMissing(news);
    this.drawFaults();
    this.drawAll();
  }

  private drawMissing({ missing }: News): void {
    const items = missing.map(({ kind, what, why }) =>
      make(
        "li",
        { class: kind === "again" ? "stop" : null },
        make("strong", {}, what + (kind === "again" ? " again" : "")),
        " ",
        make("span", { class: "soft" }, why),
      ),
    );
    const list = items.length
      ? make("ul", {}, ...items)
      : make("p", {}, this.session.frames.size ? "Nothing is missing." : "No frame has come yet.");
    refill(this.missing, make("h2", {}, "Before the object leaves"), list);
  }

  private drawFaults(): void {
    const faults = this.session.faults();
    const rows = faults
      .slice(0, MOST_FAULTS)
      .map((frame) =>
        make(
          "li",
          { class: frame.verdict },
          make("span", { class: "badge" }, frame.verdict),
          " ",
          this.opener(frame, frame.what),
          ...frame.findings.map(({ text, advice }) =>
            make("p", {}, sentence(text), " ", make("em", {}, sentence(advice))),
          ),
        ),
      );
    const more = faults.length - rows.length;
    refill(
      this.faults,
      make("h2", {}, "To look at"),
      rows.length ? make("ul", {}, ...rows) : make("p", { class: "soft" }, "Nothing."),
      more > 0 ? make("p", { class: "soft" }, `and ${more} more`) : null,
    );
  }

  private drawAll(): void {
    const groups = [...this.session.groups()].map(([name, frames]) =>
      make(
        "div",
        { class: "group" },
        make("h3", {}, name, make("span", { class: "soft" }, ` ${frames.length}`)),
        make("div", { class: "dots" }, ...frames.map((frame) => this.dot(frame))),
      ),
    );
    refill(this.all, make("h2", {}, "All frames"), ...groups);
  }

  private dot(frame: Frame): HTMLButtonElement {
    const words = `${frame.what}: ${WORDS[frame.verdict]}`;
    const mark = { green: "", look: "?", stop: "×", waiting: "…" }[frame.verdict];
    const button = make(
      "button",
      { type: "button", class: `dot ${frame.verdict}`, title: words, "aria-label": words },
      mark,
    );
    button.addEventListener("click", () => this.choose(frame.name));
    return button;
  }

  private opener(frame: Frame, text: string): HTMLButtonElement {
    const button = make("button", { type: "button", class: "link", title: frame.name }, text);
    button.addEventListener("click", () => this.choose(frame.name));
    return button;
  }

  private choose(name: string): void {
    this.chosen = name;
    this.draw();
    this.now.scrollIntoView({ block: "nearest" });
  }

  private large(): HTMLButtonElement {
    const button = make(
      "button",
      { type: "button", id: "large", "aria-pressed": "false", title: "Key L" },
      "Large print",
    );
    button.addEventListener("click", () => {
      const on = document.documentElement.toggleAttribute("data-large");
      button.setAttribute("aria-pressed", String(on));
    });
    return button;
  }

  private file(): HTMLButtonElement {
    const button = make("button", { type: "button" }, "Save the list");
    button.addEventListener("click", () => {
      const news = this.session.news;
      if (news) saveFile("session.txt", asText(news, this.session.faults()), "text/plain");
    });
    return button;
  }

  private print(): HTMLButtonElement {
    const button = make("button", { type: "button" }, "Print");
    button.addEventListener("click", () => print());
    return button;
  }
}

function notesOf({ away, guessed, strays, problems }: News): string[] {
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

function nowOf(frame: Frame | null, chosen: boolean): (HTMLElement | null)[] {
  const heading = make("h2", {}, chosen ? "This frame" : "The last frame");
  if (!frame) return [heading, make("p", { class: "soft" }, "No frame has come yet.")];
  const picture = make("img", {
    src: `/api/picture?name=${encodeURIComponent(frame.name)}`,
    alt: `Small picture of ${frame.what}`,
  });
  return [
    heading,
    make(
      "div",
      { class: `card ${frame.verdict}` },
      make("p", { class: "verdict" }, WORDS[frame.verdict]),
      make(
        "div",
        { class: "reasons" },
        make("p", { class: "what" }, frame.what),
        ...frame.findings.map(({ text, advice }) =>
          make("p", {}, sentence(text), make("strong", {}, ` ${sentence(advice)}`)),
        ),
        frame.verdict === "green" ? make("p", {}, "Nothing is wrong with it.") : null,
        make("p", { class: "soft name" }, frame.name),
      ),
      frame.verdict === "waiting" ? null : picture,
    ),
  ];
}

async function start(): Promise<void> {
  try {
    await enter();
    const answer = await fetch("/api/session", { credentials: "same-origin" });
    if (answer.status === 401) throw new Error("This address holds no token, or an old one.");
  } catch (error) {
    const words = `${messageOf(error)} Open the address that levkas watch printed.`;
    document.body.append(
      make("main", { class: "alone" }, make("h1", {}, "The page is locked"), make("p", {}, words)),
    );
    return;
  }
  new Page().follow();
}

void start();
