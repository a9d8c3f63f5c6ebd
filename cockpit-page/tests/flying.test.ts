// What keys and the gamepad do to a page that is left and comes back.

import assert from "node:assert/strict";
import { test } from "node:test";
import type { Pad } from "../src/gamepad.js";
import type { Sticks } from "../src/model.js";

type Listener = (event: never) => void;

/** As much of a browser as flying looks at. */
function browser(): { tell(name: string, event?: object): void; pads: Pad[] } {
  const listeners = new Map<string, Listener[]>();
  const addEventListener = (name: string, listener: Listener): void => void listeners.set(name, [...(listeners.get(name) ?? []), listener]);
  const pads: Pad[] = [];
  const element = (): object => ({ append: () => undefined, replaceChildren: () => undefined, setAttribute: () => undefined, addEventListener: () => undefined, style: { setProperty: () => undefined }, dataset: {}, classList: { toggle: () => undefined } });
  Object.assign(globalThis, {
    window: { addEventListener },
    document: { addEventListener, hidden: false, hasFocus: () => true, querySelector: () => null, activeElement: null, createElement: element, createElementNS: element, documentElement: element() },
    addEventListener,
  });
  Object.defineProperty(globalThis, "navigator", { configurable: true, value: { getGamepads: () => pads } });
  return { tell: (name, event = {}) => listeners.get(name)?.forEach((listener) => listener(event as never)), pads };
}

test("keys that were let go while the page was left do not keep the gamepad from stopping the motors", async (context) => {
  context.mock.timers.enable({ apis: ["setInterval"] });
  const { tell, pads } = browser();
  const { Flying } = await import("../src/flying.js");
  const held: (string | null)[] = [];
  new Flying({ flown: () => [], selected: () => null, act: () => undefined, hold: (which) => held.push(which), inputs: () => undefined });
  const keys = { code: "Enter", key: "Enter", ctrlKey: true, shiftKey: false, altKey: false, metaKey: false, repeat: false, preventDefault: () => undefined, stopImmediatePropagation: () => undefined };
  tell("keydown", keys);
  tell("blur"); // the releases go to another window
  assert.deepEqual(held, ["one", null]);
  const { STANDARD_MAP } = await import("../src/padmap.js");
  pads.push({ id: "pad", index: 0, mapping: "standard", connected: true, axes: [0, 0, 0, 0], buttons: Array.from({ length: 17 }, (_, one) => ({ pressed: STANDARD_MAP.buttons.stop.includes(one) })) });
  context.mock.timers.tick(50);
  assert.deepEqual(held, ["one", null, "one"]);
});

test("a stick that is held while the motors are stopped flies nothing after the reset, until it was centred", async (context) => {
  context.mock.timers.enable({ apis: ["setInterval"] });
  const { pads } = browser();
  const [{ Flying }, { Hands, isCentred }] = [await import("../src/flying.js"), await import("../src/sticks.js")];
  const steered: boolean[] = [];
  const pilot = { isFlyable: true, mine: true, rest: () => undefined, steer: (sticks: Sticks) => steered.push(!isCentred(sticks)) };
  const flown = { pilot: pilot as never, hands: new Hands(), thumbs: { sticks: { forward: 0, left: 0, up: 0, yaw_rate: 0 }, touches: 0, release: () => undefined }, isStopped: false };
  new Flying({ flown: () => [flown], selected: () => flown, act: () => undefined, hold: () => undefined, inputs: () => undefined });
  const push = (forward: number): void => {
    pads[0] = { id: "pad", index: 0, mapping: "standard", connected: true, axes: [0, 0, 0, forward], buttons: Array.from({ length: 17 }, () => ({ pressed: false })) };
    context.mock.timers.tick(50);
  };
  push(0);
  push(-0.8);
  flown.isStopped = true; // by another page, say
  push(-0.8);
  flown.isStopped = false;
  push(-0.8);
  assert.deepEqual(steered, [false, true, false, false]);
  push(0);
  push(-0.8);
  assert.equal(steered.at(-1), true);
});

test("an Enter that is held presses what it moved the focus to no more: a place was chosen, and nobody said to fly there", async (context) => {
  context.mock.timers.enable({ apis: ["setInterval"] });
  const { tell } = browser();
  const { Flying } = await import("../src/flying.js");
  new Flying({ flown: () => [], selected: () => null, act: () => undefined, hold: () => undefined, inputs: () => undefined });
  const prevented = (event: object): boolean => {
    let is = false;
    const plain = { key: "", ctrlKey: false, shiftKey: false, altKey: false, metaKey: false, isComposing: false };
    tell("keydown", { ...plain, ...event, preventDefault: () => (is = true), stopImmediatePropagation: () => undefined });
    return is;
  };
  for (const code of ["Enter", "NumpadEnter"]) {
    assert.equal(prevented({ code, repeat: false }), false);
    assert.equal(prevented({ code, repeat: true }), true);
  }
  Object.assign(document, { activeElement: { matches: (what: string) => what.includes("textarea"), dataset: {} } });
  assert.equal(prevented({ code: "Enter", repeat: true }), false, "a note has as many lines as are typed");
});

test("a page that stood still, as in the browser's cache, flies nothing that is held, until it was centred", async (context) => {
  context.mock.timers.enable({ apis: ["setInterval"] });
  const { pads } = browser();
  const [{ Flying }, { Hands, isCentred }] = [await import("../src/flying.js"), await import("../src/sticks.js")];
  const told: string[] = [];
  let now_ms = 1000;
  context.mock.method(performance, "now", () => now_ms);
  const pilot = { isFlyable: true, mine: true, rest: () => told.push("rest"), steer: (sticks: Sticks) => told.push(isCentred(sticks) ? "centred" : "flies") };
  const flown = { pilot: pilot as never, hands: new Hands(), thumbs: { sticks: { forward: 0, left: 0, up: 0, yaw_rate: 0 }, touches: 0, release: () => undefined }, isStopped: false };
  new Flying({ flown: () => [flown], selected: () => flown, act: () => undefined, hold: () => undefined, inputs: () => undefined });
  const push = (forward: number, after_ms: number): void => {
    now_ms += after_ms;
    pads[0] = { id: "pad", index: 0, mapping: "standard", connected: true, axes: [0, 0, 0, forward], buttons: Array.from({ length: 17 }, () => ({ pressed: false })) };
    context.mock.timers.tick(50);
  };
  push(0, 50);
  push(-0.8, 50);
  push(-0.8, 5000);
  push(-0.8, 50);
  assert.deepEqual(told, ["centred", "flies", "rest", "centred", "centred"]);
  push(0, 50);
  push(-0.8, 50);
  assert.equal(told.at(-1), "flies");
});
