// A replay's time and the list of recordings, as far as they need no browser.

import assert from "node:assert/strict";
import { test } from "node:test";
import { History, Trail } from "../src/history.js";
import type { PastRecording } from "../src/model.js";
import { chosen } from "../src/recordings.js";
import { before, clamped, fine, nearest, next, playbackOf, type Replayed, step, ticksOf } from "../src/replaytime.js";

const REPLAYED: Replayed = {
  recording: "flight.mcap",
  notes: { text: "", marks: [{ at_s: 2, text: "own" }] },
  timeline: {
    events: [{ at_s: 1, kind: "state_changed", severity: "info", text: "flying" }, { at_s: 3, kind: "collision", severity: "warning", text: "bump" }],
    marks: [{ at_s: 1.1, text: "logged" }],
    times: [0, 1, 2, 3],
    track: [null, [0, 0, 1], [1, 0, 1], [2, 0, 1]],
    values: { altitude: [0, 1, 1, null] },
  },
};

test("a state says where its replay is; one of no replay says nothing", () => {
  const values = { "native.replay.position_s": 1.5, "native.replay.duration_s": 4, "native.replay.speed": 2, "native.replay.paused": 1, "native.replay.jumps": 3 };
  assert.deepEqual(playbackOf(values), { position_s: 1.5, duration_s: 4, speed: 2, paused: true, jumps: 3 });
  assert.equal(playbackOf({ altitude: 1 }), null);
});

test("ticks by time; a finger means the mark rather than the event beside it", () => {
  const ticks = ticksOf(REPLAYED);
  assert.deepEqual(ticks.map((tick) => [tick.at_s, tick.kind]), [[1, "event"], [1.1, "mark"], [2, "own"], [3, "alarm"]]);
  assert.equal(nearest(ticks, 1.02, 0.2)?.kind, "mark");
  assert.equal(nearest(ticks, 1.6, 0.2), null);
  assert.equal(next(ticks, 2, 1, 0.3)?.at_s, 3);
  assert.equal(next(ticks, 2, -1, 0.3)?.at_s, 1.1);
  assert.equal(next(ticks, 3, 1, 0.3), null);
});

test("keys, ends and figures", () => {
  assert.deepEqual(["ArrowLeft", "ArrowRight", "PageUp", "Home", "x"].map((key) => step(key, false)), [-1, 1, 10, -Infinity, null]);
  assert.equal(step("ArrowLeft", true), -0.1);
  assert.deepEqual([clamped(-Infinity, 4), clamped(Infinity, 4)], [0, 4]);
  assert.deepEqual([fine(0), fine(59.96), fine(61.24)], ["0:00.0", "1:00.0", "1:01.2"]);
});

test("after a jump the flight before it is known, and no line leads across", () => {
  const past = before(REPLAYED.timeline, 2.5, 1.6);
  assert.deepEqual(past.map((one) => one.at_s), [1, 2]);
  assert.deepEqual(past[0], { at_s: 1, values: { altitude: 1 }, place: [0, 0, 1] });
  const [history, trail] = [new History(), new Trail()];
  history.add(9, { altitude: 5 });
  trail.add(9, [5, 5, 5]);
  history.clear();
  trail.clear();
  for (const { at_s, values, place } of past) {
    history.add(at_s, values);
    if (place) trail.add(at_s, place);
  }
  assert.deepEqual(history.since(0, ["altitude"]), [[1, 2], [1, 1]]);
  assert.deepEqual(trail.points.map((point) => point.at_s), [1, 2]);
});

test("recordings are found by words of name, drone and note, and put in order", () => {
  const one = (name: string, more: Partial<PastRecording> = {}): PastRecording => ({ name, size: 1, started: 0, drones: ["alpha"], seconds: 1, problem: "", note: "", marks: 0, ...more });
  const past = [one("b10.mcap", { note: "windy Gate" }), one("b2.mcap", { seconds: 9, size: 0 }), one("a.mcap", { drones: ["beta"] })];
  const names = (words: string, order: Parameters<typeof chosen>[2]): string[] => chosen(past, words, order).map((found) => found.name);
  assert.deepEqual(names("", "newest"), ["b10.mcap", "b2.mcap", "a.mcap"]);
  assert.deepEqual(names("", "name"), ["a.mcap", "b2.mcap", "b10.mcap"]);
  assert.equal(names("", "longest")[0], "b2.mcap");
  assert.deepEqual(names("gate alpha", "newest"), ["b10.mcap"]);
  assert.deepEqual(names("BETA", "newest"), ["a.mcap"]);
});
