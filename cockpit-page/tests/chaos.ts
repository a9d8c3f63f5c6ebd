// Flies a drone with the page's own logic, a gamepad and no browser, for tests/promises/chaos: node chaos.mjs ADDRESS DRONE JOURNAL.
//
// Lines on standard input say what hands do: centre, push, swap (another gamepad is there, its sticks deflected), back;
// takeoff, stop, reset. Each set-point is a number of its own, as a yaw rate, and is journalled when it is sent.

import { appendFileSync } from "node:fs";
import { createInterface } from "node:readline";
import type { Pad } from "../src/gamepad.js";
import type { Wire } from "../src/socket.js";

const [address = "", drone = "", path = ""] = process.argv.slice(2);
const NUMBER_RAD_S = 1e-5;
const MOST = 100_000; // 1 rad/s, all that the sticks give

const note = (what: string, number = 0): void => appendFileSync(path, `${process.hrtime.bigint()} ${what} ${number}\n`);

let number = 0;
let hands: "centre" | "push" | "swap" = "centre";

const pad = (id: string, index: number, axes: number[]): Pad => ({ id, index, mapping: "standard", connected: true, axes, buttons: Array.from({ length: 17 }, () => ({ pressed: false })) });

/** What browsers tell of gamepads: read once a round. */
function gamepads(): (Pad | null)[] {
  const { DEAD_BAND, RATE } = scales;
  if (hands === "swap") return [null, pad("other", 1, [0.0, -0.7, 0.5, -0.8])];
  if (hands === "centre") return [pad("usual", 0, [0, 0, 0, 0])];
  number = (number % MOST) + 1;
  return [pad("usual", 0, [-(DEAD_BAND + (1 - DEAD_BAND) * ((number * NUMBER_RAD_S) / RATE)), 0, 0, 0])];
}

const nothing = (): undefined => undefined;
const element = (): object => ({ append: nothing, replaceChildren: nothing, setAttribute: nothing, addEventListener: nothing, style: { setProperty: nothing }, dataset: {}, classList: { toggle: nothing } });
Object.assign(globalThis, {
  window: { addEventListener: nothing },
  document: { addEventListener: nothing, hidden: false, hasFocus: () => true, querySelector: () => null, activeElement: null, createElement: element, createElementNS: element, documentElement: element() },
  addEventListener: nothing,
});
Object.defineProperty(globalThis, "navigator", { configurable: true, value: { getGamepads: gamepads } });

const { ServerClock } = await import("../src/clock.js");
const { Flying } = await import("../src/flying.js");
const { Pilot } = await import("../src/pilot.js");
const { LastingSocket } = await import("../src/socket.js");
const { DEAD_BAND, Hands, PACES } = await import("../src/sticks.js");
const scales = { DEAD_BAND, RATE: PACES[1]?.turn ?? 1 };

/** Node's WebSocket takes headers besides what browsers' do; a cockpit answers to its own page only. */
const Socket = WebSocket as unknown as new (url: string, more: object) => Wire;
const origin = address.replace(/\/$/, "");

function connect(to: string): Wire {
  const wire = new Socket(`${origin.replace("http", "ws")}${to}`, { headers: { Origin: origin } });
  const send = wire.send.bind(wire);
  wire.send = (text) => {
    const command = JSON.parse(text) as { do: string; yaw_rate?: number };
    const flies = command.do === "fly";
    // As it travels: by now the gamepads may have been read once more.
    const sent = Math.round((command.yaw_rate ?? 0) / NUMBER_RAD_S);
    if (flies) note("call", sent);
    send(text);
    if (flies) note("called", sent);
  };
  return wire;
}

const around = { connect, later: setTimeout, cancel: (timer: unknown) => clearTimeout(timer as number) };
const say = (...words: unknown[]): void => console.error(new Date().toISOString(), ...words);
let flies = false;
const pilot = new Pilot(
  (handlers) => new LastingSocket(`/ws/drones/${drone}/control`, handlers, around),
  new ServerClock(),
  {
    changed: () => {
      if (pilot.mine && !flies) console.log("flying");
      flies ||= pilot.mine;
    },
    refused: (command, why) => say("refused", command, why),
    done: (command) => say("done", command),
  },
);
const flown = { pilot, hands: new Hands(), thumbs: { sticks: { forward: 0, left: 0, up: 0, yaw_rate: 0 }, touches: 0, release: nothing }, isStopped: false };
new Flying({ flown: () => [flown], selected: () => flown, act: nothing, hold: nothing, inputs: nothing });
setInterval(() => !pilot.mine && !pilot.waits && pilot.isReady && pilot.take(5, false), 1000);

createInterface({ input: process.stdin }).on("line", (line) => {
  if (line === "centre" || line === "push" || line === "swap") hands = line;
  else if (line === "back") hands = "centre";
  else if (line === "takeoff" || line === "stop" || line === "reset") {
    if (line !== "reset") note(`ask_${line}`);
    pilot.act(line);
  }
});
