import { expect, test } from "vitest";
import { faultsOf, groupsOf, newestOf, type Frame, type Session } from "../src/watch/session";

const frame = (name: string, verdict: Frame["verdict"], at: number, more = {}): Frame => ({
  ...{ name, verdict, at, what: `what ${name}`, setup: "", role: "object", target: "icon" },
  ...{ camera: "d80", findings: verdict === "green" ? [] : [{ text: "dim", advice: "wait" }] },
  ...more,
});
const session = (...frames: Frame[]): Session => ({ frames }) as unknown as Session;
const names = (frames: Frame[]): string[] => frames.map(({ name }) => name);

test("at first the last frame is shown, then the gravest of those that came or changed", () => {
  const first = session(frame("a", "stop", 1), frame("b", "green", 3), frame("c", "waiting", 9));
  expect(newestOf(first, null)?.name).toBe("b");
  expect(newestOf(first, first)).toBeUndefined();
  const next = session(...first.frames, frame("d", "look", 4), frame("e", "green", 5));
  expect(newestOf(next, first)?.name).toBe("d");
  const changed = session(frame("a", "stop", 1), frame("b", "look", 3));
  expect(newestOf(changed, first)?.name).toBe("b");
});

test("faults begin with the gravest, of equals with the last", () => {
  const frames = [frame("a", "look", 5), frame("b", "stop", 1), frame("c", "stop", 2)];
  expect(names(faultsOf([...frames, frame("d", "green", 9)]))).toEqual(["c", "b", "a"]);
});

test("frames are grouped by camera, lighting and what they show, in natural order and by time", () => {
  const groups = groupsOf([
    frame("late", "green", 2, { target: "icon10" }),
    frame("early", "green", 1, { target: "icon10" }),
    frame("two", "green", 1, { target: "icon2" }),
    frame("white", "green", 1, { role: "white", setup: "uv" }),
  ]);
  expect([...groups].map(([key, frames]) => [key, names(frames)])).toEqual([
    ["d80 · icon2", ["two"]],
    ["d80 · icon10", ["early", "late"]],
    ["d80@uv · white", ["white"]],
  ]);
});
