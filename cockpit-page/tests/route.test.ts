// What is edited of a route.

import assert from "node:assert/strict";
import { test } from "node:test";
import { emptyRoute, hasPhoto, moved, type RouteCheck, toneOf, waitOf, whole, withActions } from "../src/route.js";

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
