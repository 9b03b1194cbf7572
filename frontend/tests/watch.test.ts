import { expect, test } from "vitest";
import { asText, gravest, sentence, Session } from "../src/watch/session";
import type { Frame, News, Verdict } from "../src/watch/session";

function frame(name: string, verdict: Verdict, at: number, more: Partial<Frame> = {}): Frame {
  const bad = verdict === "look" || verdict === "stop";
  const findings = bad
    ? [
        {
          check: "drift",
          severity: verdict,
          text: "the lamp sank",
          advice: "wait for it",
        },
      ]
    : [];
  const known = {
    camera: "d80",
    setup: "",
    role: "object",
    target: "icon",
    band: "550 nm",
  };
  return {
    name,
    what: `what ${name}`,
    verdict,
    findings,
    at,
    ...known,
    ...more,
  };
}

function news(frames: Frame[], more: Partial<News> = {}): News {
  return {
    folder: "session",
    counts: { green: 0, look: 0, stop: 0, waiting: 0 },
    frames,
    gone: [],
    missing: [],
    guessed: false,
    strays: [],
    problems: [],
    away: false,
    ...more,
  };
}

const names = (frames: Frame[]) => frames.map(({ name }) => name);

test("of what was there when the page was opened the last frame is shown, and nothing is announced", () => {
  const session = new Session();
  const fresh = session.take(
    news([frame("a", "stop", 1), frame("b", "green", 3), frame("c", "waiting", 9)]),
  );
  expect(fresh).toEqual([]);
  expect(session.newest?.name).toBe("b");
});

test("of frames that come together the gravest is shown, a frame still being written is not", () => {
  const session = new Session();
  session.take(news([]));
  const fresh = session.take(
    news([frame("a", "look", 1), frame("b", "green", 2), frame("c", "waiting", 3)]),
  );
  expect(names(fresh)).toEqual(["a", "b"]);
  expect(session.newest?.name).toBe("a");
});

test("a frame whose verdict changes is announced again, one that is deleted is forgotten", () => {
  const session = new Session();
  session.take(news([frame("a", "green", 1), frame("b", "green", 2)]));
  expect(names(session.take(news([frame("a", "stop", 1)])))).toEqual(["a"]);
  expect(names(session.faults())).toEqual(["a"]);
  expect(session.take(news([], { gone: ["a"] }))).toEqual([]);
  expect(session.newest).toBeNull();
  expect([...session.frames.keys()]).toEqual(["b"]);
});

test("a folder that cannot be reached for a while takes no frame off the page", () => {
  const session = new Session();
  session.take(news([frame("a", "look", 1)]));
  session.take(news([], { away: true }));
  expect(session.news?.away).toBe(true);
  expect(names(session.faults())).toEqual(["a"]);
  expect(session.newest?.name).toBe("a");
});

test("faults begin with the gravest, of equals with the last", () => {
  const session = new Session();
  session.take(
    news([
      frame("a", "look", 5),
      frame("b", "stop", 1),
      frame("c", "stop", 2),
      frame("d", "green", 9),
    ]),
  );
  expect(names(session.faults())).toEqual(["c", "b", "a"]);
  expect(gravest([])).toBeUndefined();
});

test("frames are grouped by camera, lighting and what they show, in natural order and by time", () => {
  const session = new Session();
  session.take(
    news([
      frame("late", "green", 2, { target: "icon10" }),
      frame("early", "green", 1, { target: "icon10" }),
      frame("two", "green", 1, { target: "icon2" }),
      frame("white", "green", 1, {
        role: "white",
        target: "grey card",
        setup: "uv",
      }),
    ]),
  );
  const groups = [...session.groups()].map(([key, frames]) => [key, names(frames)]);
  expect(groups).toEqual([
    ["d80 · icon2", ["two"]],
    ["d80 · icon10", ["early", "late"]],
    ["d80@uv · white", ["white"]],
  ]);
});

test("the list to file has what is missing and each fault with what to do", () => {
  const counts = { green: 4, look: 1, stop: 0, waiting: 0 };
  const missing = [
    { kind: "again", what: "d80: icon", why: "the lamp sank" },
    { kind: "white", what: "d80: white", why: "after the object" },
  ];
  const text = asText(news([], { counts, missing }), [frame("a", "look", 1)]);
  expect(text.split("\n")).toEqual([
    "session: 4 green, 1 look, 0 stop",
    "",
    "Before the object leaves",
    "[ ] d80: icon again (the lamp sank)",
    "[ ] d80: white (after the object)",
    "",
    "Frames to look at",
    "look  what a  a",
    "      The lamp sank. Wait for it.",
    "",
  ]);
  expect(asText(news([]), [])).toContain("nothing is missing");
  expect(sentence("é")).toBe("É.");
});

test("of frames of the same time the one that is listed last is the last", () => {
  const session = new Session();
  session.take(news([frame("dark", "green", 1), frame("white", "stop", 1)]));
  expect(session.newest?.name).toBe("white");
  expect(gravest([frame("a", "look", 1), frame("b", "look", 1)])?.name).toBe("b");
});
