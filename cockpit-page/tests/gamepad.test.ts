// What a gamepad's sticks and buttons do.

import assert from "node:assert/strict";
import { test } from "node:test";
import { chosen, GamepadReader, type Pad } from "../src/gamepad.js";
import { isCentred } from "../src/sticks.js";
import { AXES, Chord, movedAxis, PAD_DEEDS, PadMaps, parsed, shaped, sourcesOf, STANDARD_MAP, withButtons, withSource } from "../src/padmap.js";

const pad = (axes: number[], pressed: number[] = [], mapping = "standard"): Pad => ({ id: "pad", mapping, connected: true, axes, buttons: Array.from({ length: 17 }, (_, one) => ({ pressed: pressed.includes(one) })) });

test("a curve: nothing within the dead zone, everything at the end, and fine about the centre", () => {
  for (const expo of [0, 0.4, 1]) {
    const curve = { deadZone: 0.2, expo };
    for (const value of [0, 0.19, -0.2, Number.NaN]) assert.equal(Math.abs(shaped(value, curve)), 0);
    assert.deepEqual([shaped(1, curve), shaped(-1.5, curve)], [1, -1]);
    for (let value = -1; value < 1; value += 0.05) assert.ok(shaped(value, curve) <= shaped(value + 0.05, curve) + 1e-12);
  }
  assert.ok(shaped(0.5, { deadZone: 0.1, expo: 0.8 }) < shaped(0.5, { deadZone: 0.1, expo: 0 }) / 2);
});

test("modes of the sticks: mode 1 flies forward with the left one", () => {
  const reader = new GamepadReader({ get: () => null });
  reader.read(pad([0, 0, 0, 0]), "1");
  assert.deepEqual(reader.read(pad([0, -1, 0, 0]), "1").sticks, { forward: 1, left: 0, up: 0, yaw_rate: 0 });
  assert.deepEqual(reader.read(pad([0, -1, 0, 0]), "2").sticks, { forward: 0, left: 0, up: 1, yaw_rate: 0 });
});

test("an axis is assigned by moving it, and changes places with what had it", () => {
  assert.equal(movedAxis([0, 0], [0.3, -0.5]), null);
  assert.deepEqual(movedAxis([-1, 0, 0], [-1, 0.1, -0.9]), { axis: 2, sign: -1 }, "one that rests at its end has not moved");
  const sources = sourcesOf("2");
  const changed = withSource(sources, "forward", { axis: 1, sign: 1 });
  assert.deepEqual([changed.forward, changed.up], [{ axis: 1, sign: 1 }, sources.forward]);
});

test("buttons that are pressed together are assigned when they are released; the emergency stop keeps its own", () => {
  const chord = new Chord();
  assert.deepEqual([[3], [], [1], [1, 2], [2], []].map((pressed) => chord.update(pressed)), [null, null, null, null, null, [1, 2]]);
  const { buttons } = STANDARD_MAP;
  assert.equal(withButtons(buttons, "land", [4]), null);
  assert.deepEqual(withButtons(buttons, "take", [0]), { ...buttons, hover: [], take: [0] });
  assert.deepEqual(withButtons(buttons, "stop", [8])?.stop, [8]);
});

test("maps are remembered by the gamepad's id, and nonsense is not a map", () => {
  const stored = new Map<string, string>();
  const store = { get: (name: string) => stored.get(name) ?? null, set: (name: string, value: string) => void stored.set(name, value) };
  const map = { ...STANDARD_MAP, sources: sourcesOf("3"), buttons: { ...STANDARD_MAP.buttons, land: [7] } };
  new PadMaps(store).set("one", map);
  assert.deepEqual(new PadMaps(store).get("one"), map);
  assert.equal(new PadMaps(store).get("other"), null);
  const wrong: object[] = [{}, { ...map, curves: {} }, { ...map, sources: { ...map.sources, up: { axis: 1e9, sign: 1 } } }, { ...map, sources: { ...map.sources, up: { axis: 0, sign: 40 } } },
    { ...map, curves: { ...map.curves, up: { deadZone: 0, expo: 0 } } }, { ...map, curves: { ...map.curves, up: { deadZone: 0.1, expo: 9 } } }, { ...map, buttons: { ...map.buttons, land: ["x"] } }];
  for (const one of wrong) assert.equal(parsed(JSON.stringify(one)), null, JSON.stringify(one));
  for (const text of [null, "", "null", "[1"]) assert.equal(parsed(text), null);
  assert.deepEqual([AXES.length, PAD_DEEDS.length], [4, 6]);
});

test("a gamepad of an unknown layout flies nothing until its sticks are assigned", () => {
  const maps = { get: () => null as typeof STANDARD_MAP | null };
  const reader = new GamepadReader(maps);
  for (const axes of [[0, 0], [1, 1]]) assert.equal(reader.read(pad(axes, [0, 4, 5, 9], ""), "2").name, null);
  maps.get = () => ({ ...STANDARD_MAP, sources: { forward: { axis: 1, sign: 1 }, left: null, up: null, yaw_rate: null } });
  reader.read(pad([0, 0], [], ""), "2");
  assert.deepEqual(reader.read(pad([1, 1], [], ""), "2").sticks, { forward: 1, left: 0, up: 0, yaw_rate: 0 });
});

test("the press that wakes a gamepad commands nothing, the next one does; what is held over a rest is not new", () => {
  const reader = new GamepadReader({ get: () => null });
  reader.read(null, "2");
  assert.deepEqual(reader.read(pad([0, 0, 0, 0], [9]), "2").deeds, [], "browsers show a gamepad when it is first pressed");
  assert.deepEqual(reader.read(pad([0, 0, 0, 0]), "2").deeds, []);
  assert.deepEqual(reader.read(pad([0, 0, 0, 0], [9]), "2").deeds, ["takeoff"]);
  reader.reset();
  assert.deepEqual(reader.read(pad([0, 0, 0, 0], [9]), "2").deeds, []);
  assert.ok(new GamepadReader({ get: () => null }).read(pad([0, 0, 0, 0], [4, 5]), "2").stops, "the emergency stop, which is held, works at once");
});

test("a gamepad that is unplugged is lost also where another one lies there, and that one has to be centred first", () => {
  const one: Pad = { ...pad([0, 0, 0, -1]), index: 0 };
  const other: Pad = { ...pad([0, 1, 0, 0]), index: 1 };
  const reader = new GamepadReader({ get: () => null });
  reader.read({ ...one, axes: [0, 0, 0, 0] }, "2");
  assert.equal(reader.read(chosen([one, other], reader.pad, true), "2").sticks.forward, 1);
  const swapped = reader.read(chosen([other], reader.pad, true), "2");
  assert.deepEqual([swapped.lost, isCentred(swapped.sticks)], [true, true]);
  assert.ok(isCentred(reader.read(other, "2").sticks), "still as it lies there");
  reader.read({ ...other, axes: [0, 0, 0, 0] }, "2");
  assert.equal(reader.read(other, "2").sticks.up, -1);
});

test("in flight no other gamepad takes the place of the one that flies", () => {
  const [radio, plugged]: [Pad, Pad] = [{ ...pad([0], [], ""), id: "radio", index: 1 }, { ...pad([0]), index: 0 }];
  assert.equal(chosen([plugged, radio], radio, true), radio);
  assert.equal(chosen([plugged, radio], radio, false), plugged);
  assert.equal(chosen([plugged], radio, true), plugged);
  assert.equal(chosen([], radio, true), null);
});

test("what hands move is counted, also where it changes nothing: a stick at its end trembles across", () => {
  const reader = new GamepadReader({ get: () => null });
  const counts = [[0, -1], [0.01, -1], [0.01, -1]].map((axes) => reader.read(pad([0, 0, ...axes]), "2").touches);
  assert.ok((counts[1] as number) > (counts[0] as number));
  assert.equal(counts[2], counts[1]);
});
