// Who ends an emergency stop that is held: nobody but who began it.

import assert from "node:assert/strict";
import { test } from "node:test";
import { ServerClock } from "../src/clock.js";
import type { CommandSocket } from "../src/commands.js";
import { Countdown, HOLD_MS, holdButton } from "../src/hold.js";
import { Safety, type Target } from "../src/safety.js";
import type { Handlers } from "../src/socket.js";

/** As much of an element as a button needs that is held. */
class Part extends EventTarget {
  disabled = false;
  hidden = false;
  isConnected = true;
  textContent = "";
  readonly style = { setProperty(): void {} };
  private readonly attributes = new Map<string, string>();
  append(): void {}
  setPointerCapture(): void {}
  setAttribute(name: string, value: string): void { this.attributes.set(name, value); }
  getAttribute(name: string): string | null { return this.attributes.get(name) ?? null; }
  tell(type: string, about: object = {}): void { this.dispatchEvent(Object.assign(new Event(type), about)); }
}

let now_ms = 0;
let rounds: (() => void)[] = [];
const made: Part[] = [];
const createElement = (): Part => (made.push(new Part()), made.at(-1) as Part);
Object.assign(globalThis, { window: new Part(), document: Object.assign(new Part(), { createElement }), requestAnimationFrame: (round: () => void) => rounds.push(round), setInterval: () => 0, setTimeout: () => 0 });
performance.now = () => now_ms;

function pass(after_ms: number): void {
  now_ms += after_ms;
  const due = rounds;
  rounds = [];
  for (const round of due) round();
}

interface Stops {
  countdown: Countdown;
  stopped: string[];
  /** A button of its own for a drone. */
  button: (name: string) => Part;
}

function stops(): Stops {
  const [countdown, stopped] = [new Countdown(), [] as string[]];
  return { countdown, stopped, button: (name) => holdButton(countdown, () => ({ what: name, act: () => stopped.push(name) }), {}) as unknown as Part };
}

const FIRST = { pointerId: 1, button: 0 };
const SECOND = { pointerId: 2, button: 0 };
const SPACE = { code: "Space", repeat: false, ctrlKey: false };

test("to let go of what was done before does not end what is held now", () => {
  const { stopped, button } = stops();
  const [left, all] = [button("left"), button("all")];
  left.tell("pointerdown", FIRST);
  pass(HOLD_MS);
  all.tell("pointerdown", SECOND);
  pass(HOLD_MS / 2);
  left.tell("pointerup", FIRST);
  pass(HOLD_MS / 2);
  assert.deepEqual(stopped, ["left", "all"]);
});

test("to let go of a button that is held ends it, and of another one does not", () => {
  const { countdown, stopped, button } = stops();
  const [left, right] = [button("left"), button("right")];
  left.tell("pointerdown", FIRST);
  right.tell("pointerdown", SECOND);
  right.tell("pointerup", SECOND);
  assert.ok(countdown.isHeld);
  assert.notEqual(right.getAttribute("data-held"), "true");
  left.tell("pointerup", FIRST);
  pass(HOLD_MS);
  assert.deepEqual(stopped, []);
});

test("the focus that moves away ends what a key holds, not what a finger holds", () => {
  const { stopped, button } = stops();
  const left = button("left");
  left.tell("pointerdown", FIRST);
  left.tell("blur");
  pass(HOLD_MS);
  left.tell("pointerup", FIRST);
  left.tell("keydown", SPACE);
  left.tell("blur");
  pass(HOLD_MS);
  assert.deepEqual(stopped, ["left"]);
});

test("a button that is gone holds nothing", () => {
  const { countdown, stopped, button } = stops();
  const left = button("left");
  left.tell("pointerdown", FIRST);
  left.isConnected = false;
  pass(HOLD_MS);
  assert.ok(!countdown.isHeld);
  assert.deepEqual(stopped, []);
});

interface Line extends CommandSocket {
  isOpen: boolean;
  handlers: Handlers;
  sent: Record<string, unknown>[];
}

function aimed(): Stops & { safety: Safety; target: (name: string) => Target; line: Line } {
  const all = stops();
  const line: Line = { isOpen: false, handlers: { message: () => undefined }, sent: [], send: (message) => line.isOpen && line.sent.push(message as Record<string, unknown>) > 0, close: () => undefined };
  const connect = (handlers: Handlers): CommandSocket => Object.assign(line, { handlers });
  const target = (name: string): Target => ({ name, result: null, stop: () => all.stopped.push(name) });
  return { ...all, safety: new Safety(connect, new ServerClock(), all.countdown), target, line };
}

test("whatever keys aim at, a drone's own button stops that drone", () => {
  const { stopped, button, safety, target } = aimed();
  const right = button("right");
  safety.aim(target("left"));
  right.tell("keydown", SPACE);
  safety.aim(target("left")); // as with each state that comes of it
  safety.aim(target("another"));
  pass(HOLD_MS);
  assert.deepEqual(stopped, ["right"]);
});

test("keys that are held stop nothing else once another drone is seen, and end only what they began", () => {
  const { stopped, button, safety, target } = aimed();
  safety.aim(target("left"));
  safety.hold("one");
  safety.aim(target("left"));
  safety.aim(target("right"));
  pass(HOLD_MS);
  assert.deepEqual(stopped, []);
  button("other").tell("pointerdown", FIRST);
  safety.hold("one");
  safety.hold(null);
  pass(HOLD_MS);
  assert.deepEqual(stopped, ["other"]);
  safety.hold("one");
  safety.hold(null);
  pass(HOLD_MS);
  assert.deepEqual(stopped, ["other"], "let go too early");
  safety.hold("one");
  pass(HOLD_MS);
  assert.deepEqual(stopped, ["other", "right"]);
});

test("Stop all that is held before this page knows a drone, or its cockpit answers, is sent as soon as it can be", () => {
  const { safety, line } = aimed();
  const all = made.findLast((part) => part.getAttribute("aria-keyshortcuts") === "Control+Shift+Enter") as Part;
  safety.know([]);
  all.tell("pointerdown", FIRST);
  pass(HOLD_MS);
  all.tell("pointerup", FIRST);
  assert.equal((safety.message as unknown as Part).textContent, "Stop all · pending");
  line.isOpen = true;
  line.handlers.state?.(true, 0, "");
  line.handlers.message(JSON.stringify({ type: "pong", n: line.sent.at(-1)?.["n"], now_s: 1000 }));
  assert.deepEqual(line.sent.map((message) => message["do"]), ["ping", "stop_all"]);
});
