// What the person chose, and the words of the page.

import assert from "node:assert/strict";
import { test } from "node:test";
import { isOfCamera } from "../src/cameracontrols.js";
import { en } from "../src/language/en.js";
import { accented, pseudo } from "../src/language/pseudo.js";
import { Settings, settings } from "../src/settings.js";
import { STICK_MODES } from "../src/sticks.js";
import { thumbed } from "../src/thumbs.js";
import { lengthText, speedText } from "../src/units.js";
import { fileName } from "../src/videotools.js";

const store = (stored: Record<string, string> = {}) => ({ stored, get: (name: string) => stored[name] ?? null, set: (name: string, value: string) => void (stored[name] = value) });

test("settings: remembered, announced once, and the standard for what is not allowed", () => {
  const kept = store({ theme: "light", units: "cubits" });
  const settings = new Settings(kept);
  assert.equal(settings.get("theme"), "light");
  assert.equal(settings.get("units"), "metric");
  let told = 0;
  const end = settings.on("units", () => (told += 1));
  settings.set("units", "imperial");
  settings.set("units", "imperial");
  assert.deepEqual([told, kept.stored["units"]], [1, "imperial"]);
  kept.stored["units"] = "metric"; // in another tab
  settings.reread();
  assert.deepEqual([told, settings.get("units")], [2, "metric"]);
  end();
  settings.set("units", "imperial");
  assert.equal(told, 2);
});

test("each mode of the sticks flies each direction once", () => {
  for (const { left, right } of Object.values(STICK_MODES)) assert.deepEqual([left.x, left.y, right.x, right.y].sort(), ["forward", "left", "up", "yaw_rate"]);
});

test("the language for tests has all that English has, marked", () => {
  assert.equal(accented("Land"), "⟦Láñd⟧");
  const words = pseudo(en);
  assert.equal(words.modal.close, accented(en.modal.close));
  assert.equal(words.settings.modeNote("a", "b"), accented(en.settings.modeNote("a", "b")));
});

test("a photo is named by drone, camera and capture; controls are those of the cameras that are shown", () => {
  assert.equal(fileName("lab/alpha", "front", new Date(0)), "lab_alpha-front-1970-01-01T00-00-00.000Z");
  const of = (name: string): boolean => isOfCamera(name, ["front", "down"], new Set(["front"]));
  assert.deepEqual(["camera.front.gain", "camera.down.gain", "camera.fps", "limits.speed"].map(of), [true, false, true, false]);
});

test("thumbs fly as the mode of the sticks says", () => {
  assert.deepEqual(thumbed("2", "left", 1, 1), { yaw_rate: -1, up: 1 });
  assert.deepEqual(thumbed("2", "right", -1, 1), { left: 1, forward: 1 });
  assert.deepEqual(thumbed("1", "left", 0, 1), { yaw_rate: 0, forward: 1 });
  assert.deepEqual(thumbed("1", "right", 0, -1), { left: 0, up: -1 });
});

test("lengths and speeds have the unit that the person chose", () => {
  assert.equal(lengthText(3.048, 1), "3.0 m");
  settings.set("units", "imperial");
  assert.equal(lengthText(3.048, 1), "10.0 ft");
  assert.equal(lengthText(null, 1), "–");
  assert.equal(speedText(0.3048, 1), "1.0 ft/s");
  settings.set("units", "metric");
});
