// What is edited of a route.

import assert from "node:assert/strict";
import { test } from "node:test";
import { directionText, emptyRoute, hasPhoto, headingOf, moved, parseDirection, type RouteCheck, toneOf, turnOf, waitOf, whole, withActions, withHeading, withTurn } from "../src/route.js";

const PLACE = { x: 1, y: 2, z: 1 };

test("a wait and a photo are actions; turns stay, and nothing is left behind", () => {
  const looking = { ...PLACE, actions: [{ do: "photo", camera: "bottom" } as const, { do: "look", yaw: 1 } as const] };
  const waiting = withActions(looking, 2, true);
  assert.deepEqual(waiting.actions, [{ do: "look", yaw: 1 }, { do: "wait", seconds: 2 }, { do: "photo", camera: "bottom" }]);
  assert.equal(waitOf(waiting), 2);
  assert.ok(hasPhoto(waiting));
  assert.deepEqual(withActions(withActions(PLACE, 3, true), 0, false), PLACE);
});

test("waypoints change places, and stay where there is no place", () => {
  assert.deepEqual(moved(["a", "b", "c"], 0, 2), ["b", "c", "a"]);
  assert.deepEqual(moved(["a", "b", "c"], 2, 1), ["a", "c", "b"]);
  assert.deepEqual(moved(["a", "b"], 0, -1), ["a", "b"]);
  assert.deepEqual(moved(["a", "b"], 1, 2), ["a", "b"]);
});

test("a leg has the colour of the worst that was found", () => {
  const finding = (waypoint: number | null, severity: "error" | "warning") => ({ waypoint, severity, reason: "" });
  const check: RouteCheck = { id: "", ok: false, findings: [finding(2, "warning"), finding(2, "error"), finding(3, "warning"), finding(null, "error")], length_m: 0, seconds: 0, battery_left: null };
  assert.deepEqual([1, 2, 3].map((number) => toneOf(check, number)), ["accent", "bad", "warn"]);
  assert.equal(toneOf(null, 1), "accent");
});

test("what a file leaves out is filled in", () => {
  assert.deepEqual(whole({ waypoints: [PLACE] }), { ...emptyRoute(), waypoints: [PLACE] });
});

test("a direction is degrees or a point", () => {
  assert.deepEqual(parseDirection(" 180 "), { yaw: Math.PI });
  assert.deepEqual(parseDirection("1.5, -2"), { at: [1.5, -2] });
  assert.deepEqual(parseDirection(""), {});
  assert.equal(parseDirection("north"), null);
  assert.equal(parseDirection("1, 2, 3"), null);
  assert.equal(directionText({ yaw: Math.PI / 2 }), "90");
  assert.equal(directionText({ at: [1.5, -2] }), "1.5, -2");
  assert.equal(directionText({}), "");
});

test("a waypoint has one heading, and its first turn is edited", () => {
  const looking = withHeading({ ...PLACE, yaw: 1 }, { at: [0, 0] });
  assert.deepEqual(looking, { ...PLACE, look_at: [0, 0] });
  assert.deepEqual(headingOf(looking), { at: [0, 0] });
  assert.deepEqual(withHeading(looking, {}), PLACE);
  const turning = withTurn({ ...PLACE, actions: [{ do: "wait", seconds: 1 }] }, { yaw: 1 });
  assert.deepEqual(turning.actions, [{ do: "look", yaw: 1 }, { do: "wait", seconds: 1 }]);
  assert.deepEqual(turnOf(turning), { do: "look", yaw: 1 });
  assert.deepEqual(withTurn(withTurn(PLACE, { at: [1, 1] }), {}), PLACE);
});
