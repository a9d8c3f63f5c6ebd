// What the page does with its connections: newest frame wins, sockets come back, the pilot's line is safe.

import assert from "node:assert/strict";
import { test } from "node:test";
import type { Authority, FrameHead, Question } from "../src/model.js";
import { NewestFrame, unpack } from "../src/newest.js";
import { Pilot } from "../src/pilot.js";
import { FIRST_PAUSE_MS, type Handlers, LastingSocket, LONGEST_PAUSE_MS, REFUSED_PAUSE_MS, type Wire } from "../src/socket.js";
import { ServerClock } from "../src/clock.js";
import { CENTRED } from "../src/sticks.js";

const head = (ack: number): FrameHead => ({ ack, camera: "front", seq: ack, captured_ns: "1", age_s: 0, now_s: 0, width: 4, height: 3 });
const frame = (ack: number) => ({ head: head(ack), jpeg: new Uint8Array([ack]), received_ms: 0 });
const settle = (): Promise<void> => new Promise((done) => setImmediate(done));

test("a frame's message is taken apart", () => {
  const text = new TextEncoder().encode(JSON.stringify(head(7)));
  const message = new Uint8Array(4 + text.length + 2);
  new DataView(message.buffer).setUint32(0, text.length);
  message.set(text, 4);
  message.set([0xff, 0xd8], 4 + text.length);
  const { head: parsed, jpeg } = unpack(message.buffer);
  assert.equal(parsed.ack, 7);
  assert.deepEqual([...jpeg], [0xff, 0xd8]);
  assert.throws(() => unpack(message.buffer.slice(0, 10)), RangeError);
});

test("while one is decoded only the newest is kept, and each is acknowledged once", async () => {
  const waiting: (() => void)[] = [];
  const [shown, acknowledged]: [number[], number[]] = [[], []];
  const frames = new NewestFrame(
    (jpeg) => new Promise<{ close(): void; number: number }>((done) => waiting.push(() => done({ close: () => undefined, number: jpeg[0] as number }))),
    (_, picture) => shown.push(picture.number),
    (ack) => acknowledged.push(ack),
  );
  for (const ack of [1, 2, 3]) frames.put(frame(ack));
  assert.deepEqual(acknowledged, [2], "left out, as 3 is newer");
  waiting.shift()?.();
  await settle();
  waiting.shift()?.();
  await settle();
  assert.deepEqual(shown, [1, 3]);
  assert.deepEqual(acknowledged, [2, 1, 3]);
  assert.equal(frames.skipped, 1);
});

test("a picture that can't be decoded does not stop the next one; nothing is shown after the end", async () => {
  const [shown, acknowledged]: [number[], number[]] = [[], []];
  const decode = async (jpeg: Uint8Array): Promise<{ close(): void }> => {
    if (jpeg[0] === 1) throw new Error("no picture");
    return { close: () => undefined };
  };
  const frames = new NewestFrame(decode, (one) => shown.push(one.head.ack), (ack) => acknowledged.push(ack));
  frames.put(frame(1));
  await settle();
  frames.put(frame(2));
  await settle();
  assert.deepEqual([shown, acknowledged], [[2], [1, 2]]);
  frames.put(frame(3));
  frames.end();
  await settle();
  assert.deepEqual(shown, [2]);
});

class FakeWire implements Wire {
  binaryType = "";
  readyState = 0;
  bufferedAmount = 0;
  onopen: Wire["onopen"] = null;
  onmessage: Wire["onmessage"] = null;
  onclose: Wire["onclose"] = null;
  sent: string[] = [];
  send(text: string): void {
    this.sent.push(text);
  }
  close(): void {
    this.readyState = 3;
  }
  open(): void {
    this.readyState = 1;
    this.onopen?.(undefined as never);
  }
  end(code = 1006): void {
    this.readyState = 3;
    this.onclose?.({ code, reason: "" });
  }
}

function lasting(path: string | (() => string) = "/ws"): { socket: LastingSocket; wires: FakeWire[]; paths: string[]; pauses: number[]; later: () => void; states: boolean[]; received: unknown[] } {
  const paths: string[] = [];
  const [wires, pauses, states, received]: [FakeWire[], number[], boolean[], unknown[]] = [[], [], [], []];
  let act: () => void = () => undefined;
  const around = {
    connect: (where: string) => {
      paths.push(where);
      wires.push(new FakeWire());
      return wires.at(-1) as FakeWire;
    },
    later: (what: () => void, ms: number) => {
      pauses.push(ms);
      act = what;
    },
    cancel: () => {
      act = () => undefined;
    },
  };
  const socket = new LastingSocket(path, { message: (data) => received.push(data), state: (open) => states.push(open) }, around);
  return { socket, wires, paths, pauses, later: () => act(), states, received };
}

test("a socket comes back, with longer and longer pauses, and short ones again after it was told something", () => {
  const { wires, pauses, later, states } = lasting();
  for (let number = 0; number < 12; number += 1) {
    wires.at(-1)?.end();
    later();
  }
  assert.equal(pauses[0], FIRST_PAUSE_MS);
  assert.equal(pauses.at(-1), LONGEST_PAUSE_MS);
  wires.at(-1)?.open();
  wires.at(-1)?.end(4404);
  assert.equal(pauses.at(-1), LONGEST_PAUSE_MS, "accepted and closed: what is absent is not asked for in a hurry");
  later();
  wires.at(-1)?.open();
  wires.at(-1)?.onmessage?.({ data: "{}" });
  wires.at(-1)?.end();
  assert.equal(pauses.at(-1), FIRST_PAUSE_MS);
  assert.deepEqual(states.slice(-2), [true, false]);
  later();
  wires.at(-1)?.end(4403);
  assert.equal(pauses.at(-1), REFUSED_PAUSE_MS, "not allowed: no hurry");
});

test("a socket that begins anew asks for its path again", () => {
  let name = "";
  const { socket, wires, paths, later } = lasting(() => `/ws?name=${name}`);
  wires[0]?.open();
  name = "Anna";
  socket.reopen();
  wires[0]?.end(1000);
  later();
  assert.deepEqual(paths, ["/ws?name=", "/ws?name=Anna"]);
});

test("nothing is sent or kept while it is not open; closed is closed", () => {
  const { socket, wires, later, received } = lasting();
  assert.equal(socket.send({ do: "stop" }), false);
  wires[0]?.open();
  assert.equal(socket.send({ do: "stop" }), true);
  assert.deepEqual(wires[0]?.sent, ['{"do":"stop"}']);
  socket.close();
  wires[0]?.onmessage?.({ data: "late" });
  wires[0]?.end();
  later();
  assert.equal(wires.length, 1);
  assert.deepEqual(received, []);
});

test("a route of a connection that broke is forgotten, and control that was given is not told as lost", () => {
  const told: unknown[] = [];
  let handlers: Handlers | null = null;
  const pilot = new Pilot(
    (given) => {
      handlers = given;
      return { isOpen: true, send: () => true, close: () => undefined };
    },
    new ServerClock(),
    { changed: () => undefined, refused: () => undefined, done: (command, what) => told.push(`${command}: ${what}`), route: (progress) => told.push(progress) },
  );
  const [receive, link] = [(message: object) => handlers?.message(JSON.stringify(message)), (open: boolean) => handlers?.state?.(open, 0, "")];
  link(true);
  receive(held(true));
  receive({ ...held(false, "survey.py"), state: "preempted", why: "survey.py has control now", given: true });
  assert.equal(pilot.ended, "");
  assert.equal(told.at(-1), "given: survey.py");
  receive(held(true));
  assert.equal(told.at(-1), "granted: undefined", "it waited, and has it back");
  link(false);
  assert.equal(told.at(-1), null, "“Fly the route” is not held back by a flight that is gone");
});

type Sent = Record<string, unknown>;
interface Flown {
  pilot: Pilot;
  sent: Sent[];
  reported: string[];
  receive: (message: object) => void;
  link: (open: boolean) => void;
  at: (ms: number) => void;
  /** The cockpit answers the newest ping, at once. */
  pong: () => void;
  /** The line is open and known to be alive. */
  live: () => void;
}

/** A page's pilot, and a cockpit whose clock is 1000 s ahead. */
function flown(): Flown {
  const [sent, reported]: [Sent[], string[]] = [[], []];
  let [now_ms, open] = [0, false];
  let handlers: Handlers | null = null;
  const pilot = new Pilot(
    (given) => {
      handlers = given;
      return { get isOpen() { return open; }, send: (message) => open && sent.push(message as Sent) > 0, close: () => undefined };
    },
    new ServerClock(),
    { changed: () => undefined, refused: (command, why) => reported.push(`${command}: ${why}`), done: (command) => reported.push(`done ${command}`) },
    () => now_ms,
  );
  const receive = (message: object): void => handlers?.message(JSON.stringify(message));
  const pong = (): void => receive({ type: "pong", n: sent.findLast((message) => message["do"] === "ping")?.["n"], now_s: 1000 + now_ms / 1000 });
  const link = (up: boolean): void => {
    open = up;
    handlers?.state?.(up, 0, "");
  };
  return {
    pilot, sent, reported, receive, link, pong,
    at: (ms) => {
      now_ms = ms;
    },
    live: () => {
      link(true);
      pong();
    },
  };
}

const held = (mine: boolean, holder: string | null = mine ? "cockpit 1" : null): Authority => ({ type: "authority", state: mine ? "held" : "none", holder, priority: 8, mine, why: null, given: false, app: "cockpit 1", line: null, waiting: [] });
const doings = (sent: Record<string, unknown>[]): unknown[] => sent.map((message) => message["do"]).filter((one) => one !== "ping");
const FORWARD = { ...CENTRED, forward: 0.5 };

test("sticks fly only with the authority, and hover once when they are let go", () => {
  const { pilot, sent, receive, live } = flown();
  live();
  pilot.steer(FORWARD);
  assert.deepEqual(doings(sent), []);
  receive(held(true));
  pilot.steer(FORWARD);
  pilot.steer(FORWARD);
  pilot.steer(CENTRED);
  pilot.steer(CENTRED);
  assert.deepEqual(doings(sent), ["fly", "fly", "hover"]);
});

test("a page that loses the focus hovers what it has under way, and nothing else", () => {
  const { pilot, sent, receive, live } = flown();
  live();
  receive(held(true));
  pilot.rest();
  assert.deepEqual(doings(sent), []);
  pilot.steer(FORWARD);
  pilot.rest();
  pilot.goTo(1, 2, 3);
  pilot.rest();
  assert.deepEqual(doings(sent), ["fly", "hover", "goto", "hover"]);
  pilot.goTo(1, 2, 3);
  receive({ type: "done", do: "goto" });
  pilot.rest();
  assert.deepEqual(doings(sent).slice(4), ["goto"], "there already");
});

test("what became of a flight to an earlier place ends no other flight", () => {
  const { pilot, sent, receive, live } = flown();
  live();
  receive(held(true));
  pilot.goTo(1, 2, 3);
  pilot.goTo(4, 5, 6);
  const [first, second] = sent.filter((message) => message["do"] === "goto").map((message) => message["n"]);
  receive({ type: "done", do: "goto", n: first });
  receive({ type: "refused", do: "goto", n: first, why: "ended on the way" });
  pilot.rest();
  assert.deepEqual(doings(sent), ["goto", "goto", "hover"], "it was on its way to the second one");
  pilot.goTo(7, 8, 9);
  receive({ type: "done", do: "goto", n: second });
  receive({ type: "done", do: "goto", n: sent.findLast((message) => message["do"] === "goto")?.["n"] });
  pilot.rest();
  assert.deepEqual(doings(sent).slice(3), ["goto"], "there already");
});

test("sticks that are let go, or count no more, as no answers come, hover all the same", () => {
  const { pilot, sent, receive, live, at } = flown();
  live();
  receive(held(true));
  pilot.steer(FORWARD);
  at(1200);
  assert.ok(!pilot.isFlyable);
  pilot.steer(CENTRED);
  assert.deepEqual(doings(sent), ["fly", "hover"]);
  assert.ok(Math.abs((sent.findLast((message) => message["do"] === "hover")?.["at_s"] as number) - 1001.2) < 0.1);
});

test("sticks that could not be sent, or were refused, were flying before: they hover when they are let go", () => {
  const { pilot, sent, receive, live, at } = flown();
  live();
  receive(held(true));
  pilot.steer(FORWARD);
  at(1200);
  pilot.steer(FORWARD); // still in the hand when the answers became old
  assert.deepEqual(doings(sent), ["fly", "hover"]);
  const late = flown();
  late.live();
  late.receive(held(true));
  late.pilot.steer(FORWARD);
  late.receive({ type: "refused", do: "fly", n: 0, why: "it arrived 0.6 s after it was requested" });
  late.pilot.steer(CENTRED);
  assert.deepEqual(doings(late.sent), ["fly", "hover"]);
});

test("what is to take the place of a flight and can't be sent leaves it hovering", () => {
  for (const act of [(pilot: Pilot) => pilot.act("hover"), (pilot: Pilot) => pilot.act("land"), (pilot: Pilot) => pilot.goTo(4, 5, 6), (pilot: Pilot) => pilot.flyRoute("2")]) {
    const { pilot, sent, receive, live, at } = flown();
    live();
    receive(held(true));
    pilot.goTo(1, 2, 3);
    at(1200);
    act(pilot);
    assert.deepEqual(doings(sent), ["goto", "hover"]);
    assert.equal(sent.at(-1)?.["automatic"], true);
    assert.ok(!pilot.going);
  }
});

test("what was to take the place of a flight and was refused, as it came too late, leaves it under way: it hovers when the page is left", () => {
  for (const act of [(pilot: Pilot) => pilot.act("hover"), (pilot: Pilot) => pilot.act("land"), (pilot: Pilot) => pilot.goTo(4, 5, 6), (pilot: Pilot) => pilot.release()]) {
    const { pilot, sent, receive, live } = flown();
    live();
    receive(held(true));
    pilot.goTo(1, 2, 3);
    receive({ type: "sent", do: "goto", n: sent.at(-1)?.["n"] });
    act(pilot);
    assert.ok(!pilot.following);
    const { do: what, n } = sent.at(-1) as Sent;
    receive({ type: "refused", do: what, n, why: "it arrived 0.6 s after it was requested" });
    assert.ok(pilot.going);
    pilot.rest();
    assert.equal(sent.at(-1)?.["automatic"], true);
    pilot.goTo(1, 2, 3);
    act(pilot);
    const last = sent.at(-1) as Sent;
    receive({ type: "sent", do: last["do"], n: last["n"] });
    receive({ type: "refused", do: last["do"], n: last["n"], why: "ended on the way" });
    assert.ok(!pilot.going, "the cockpit had it: what was before is over");
  }
});

test("a hover that nobody pressed says so, and sticks say how often hands were seen", () => {
  const { pilot, sent, receive, live } = flown();
  live();
  receive(held(true));
  pilot.steer(FORWARD, 7);
  pilot.steer(CENTRED, 7);
  pilot.act("hover");
  const [fly, rest, pressed] = sent.filter((message) => message["do"] !== "ping");
  assert.deepEqual([fly?.["touches"], rest?.["automatic"], pressed?.["automatic"]], [7, true, undefined]);
});

test("until the vehicle shows an emergency stop, or it is given up, sticks that are held command nothing", () => {
  for (const end of [{ type: "done", do: "stop" }, { type: "refused", do: "stop", n: 0, why: "not shown" }]) {
    const { pilot, sent, receive, live } = flown();
    live();
    receive(held(true));
    pilot.steer(FORWARD);
    pilot.act("stop");
    assert.ok(!pilot.isFlyable);
    pilot.steer(CENTRED);
    pilot.rest();
    receive({ type: "sent", do: "stop", n: sent.findLast((message) => message["do"] === "stop")?.["n"] });
    assert.ok(!pilot.isFlyable, "passed on, and not shown yet");
    assert.deepEqual(doings(sent), ["fly", "stop"], "no hover either");
    receive(end);
    assert.ok(!pilot.isFlyable, "no round of the sticks has seen the stop, which may show at once: what is held must be centred first");
    pilot.steer(CENTRED);
    assert.ok(pilot.isFlyable);
  }
});

test("while it holds control it tells that it is there and what it hears, and measures how long that takes", () => {
  const { pilot, sent, receive, live, at } = flown();
  live();
  receive(held(true));
  for (let ms = 0; ms <= 1000; ms += 50) {
    at(ms);
    pilot.steer(CENTRED);
  }
  const pings = sent.filter((message) => message["do"] === "ping");
  assert.ok(pings.length >= 6, `${pings.length} pings in a second: the cockpit waits 0.5 s`);
  at(1004);
  receive({ type: "pong", n: pings.at(-1)?.["n"], now_s: 1001 });
  assert.ok(pilot.round_trip_s !== null && pilot.round_trip_s <= 0.154 && pilot.round_trip_s >= 0.004);
  at(1200);
  pilot.steer(CENTRED);
  assert.equal(sent.at(-1)?.["seen_s"], 1001, "when the newest pong that it received was sent");
  assert.ok(Math.abs((sent.at(-1)?.["at_s"] as number) - 1001.2) < 0.1);
});

test("each command carries the time of its press, on the cockpit's clock, and is pending until the cockpit has it", () => {
  const { pilot, sent, receive, live, at } = flown();
  live();
  at(300);
  receive(held(true));
  pilot.act("takeoff");
  const command = sent.at(-1) as Sent;
  assert.equal(command["do"], "takeoff");
  assert.ok(Math.abs((command["at_s"] as number) - 1000.3) < 0.01);
  assert.ok((command["unsure_s"] as number) < 0.02);
  assert.equal(pilot.result("takeoff")?.fate, "pending");
  receive({ type: "sent", do: "takeoff", n: (command["n"] as number) - 1 });
  assert.equal(pilot.result("takeoff")?.fate, "pending", "that was another one");
  receive({ type: "sent", do: "takeoff", n: command["n"] });
  assert.equal(pilot.result("takeoff")?.fate, "sent");
  receive({ type: "refused", do: "takeoff", n: 0, why: "battery low" });
  assert.deepEqual(pilot.result("takeoff"), { ...pilot.result("takeoff"), fate: "refused", why: "battery low" });
});

test("the way back to the start is flown from the page, which makes it hover when it loses the focus", () => {
  const { pilot, sent, receive, live } = flown();
  live();
  receive(held(true));
  pilot.act("return");
  assert.equal(sent.at(-1)?.["do"], "return");
  assert.ok(pilot.going);
  pilot.rest();
  assert.equal(sent.at(-1)?.["do"], "hover");
  pilot.act("return");
  receive({ type: "done", do: "return" });
  assert.ok(!pilot.going, "it lands by itself from there on");
  pilot.act("return");
  receive({ type: "refused", do: "return", n: 0, why: "a no-fly zone blocks the straight line" });
  assert.ok(!pilot.going);
});

test("a page that has no answer for a second sends nothing, and says so on the control", () => {
  const { pilot, sent, reported, receive, live, at } = flown();
  live();
  receive(held(true));
  at(1500);
  const before = sent.length;
  pilot.act("takeoff");
  pilot.steer(FORWARD);
  assert.deepEqual(doings(sent.slice(before)), []);
  assert.equal(pilot.result("takeoff")?.fate, "not_sent");
  assert.match(reported.at(-1) ?? "", /no answer from the cockpit for 1\.5 s/);
});

test("what left and was never answered is shown as that, not as sent", () => {
  const { pilot, receive, live, at } = flown();
  live();
  receive(held(true));
  pilot.act("land");
  for (let ms = 0; ms <= 2000; ms += 50) {
    at(ms);
    pilot.steer(CENTRED);
  }
  assert.equal(pilot.result("land")?.fate, "no_answer");
});

test("an emergency stop needs no control, stays pending for two seconds, and goes when the link is back by then", () => {
  const { pilot, sent, live, at, receive } = flown();
  pilot.act("stop");
  assert.equal(pilot.result("stop")?.fate, "pending");
  at(1500);
  live();
  const command = sent.at(-1) as Sent;
  assert.equal(command["do"], "stop");
  assert.ok(Math.abs((command["at_s"] as number) - 1000) < 0.01, "it says when it was pressed, not when it was sent");
  receive({ type: "sent", do: "stop", n: command["n"] });
  assert.equal(pilot.result("stop")?.fate, "sent");
});

test("an emergency stop that did not go within two seconds never goes, and is shown as not sent", () => {
  const { pilot, sent, reported, live, at } = flown();
  pilot.act("stop");
  at(2100);
  pilot.steer(CENTRED);
  assert.equal(pilot.result("stop")?.fate, "not_sent");
  assert.match(reported.at(-1) ?? "", /stop: not sent/);
  live();
  pilot.steer(CENTRED);
  assert.deepEqual(doings(sent), []);
});

test("how control was lost stays to be read until control is taken again or it was understood", () => {
  const { pilot, receive, live, link } = flown();
  live();
  receive(held(true));
  receive({ ...held(false), why: "the link to the proxy of alpha is down: nobody has control" });
  assert.match(pilot.ended, /nobody has control/);
  receive(held(false));
  assert.match(pilot.ended, /nobody has control/, "still to be read");
  pilot.understood();
  assert.equal(pilot.ended, "");
  receive(held(true));
  link(false);
  assert.match(pilot.ended, /connection to the cockpit broke/);
  live();
  receive(held(true));
  assert.equal(pilot.ended, "");
});

test("who loses control learns who has it; after a broken connection nothing is flown on", () => {
  const { pilot, sent, receive, link, live } = flown();
  live();
  pilot.take(8, false);
  receive(held(true));
  pilot.steer(FORWARD);
  receive({ ...held(false, "follow.py"), why: "follow.py has control now" });
  assert.match(pilot.ended, /follow\.py has control/);
  pilot.steer(FORWARD);
  receive(held(true));
  pilot.steer(FORWARD);
  link(false);
  assert.equal(pilot.mine, false);
  link(true);
  pilot.steer(FORWARD);
  assert.deepEqual(doings(sent), ["take", "fly", "fly"]);
});

const asks = (id: number, more: Partial<Question> = {}): Question => ({ id, by: `app ${id}`, priority: 4, for_s: null, left_s: 10, declined: false, ...more });

test("who has control is asked for it, and answers; the time runs out here too", () => {
  const { pilot, sent, receive, link, live, at, pong } = flown();
  live();
  receive(held(true));
  at(1000);
  pilot.steer(CENTRED);
  pong();
  receive({ type: "asked", questions: [asks(3)] });
  assert.equal(pilot.questions.length, 1);
  at(5000);
  assert.equal(pilot.left_s(pilot.questions[0] as Question), 6);
  at(12_000);
  assert.equal(pilot.left_s(pilot.questions[0] as Question), 0);
  pilot.steer(CENTRED);
  pong();
  pilot.answer(3, false, "landing");
  pilot.answer(3, true, "");
  const commands = (what: string): Sent[] => sent.filter((message) => message["do"] === what).map(({ n: _, at_s: __, unsure_s: ___, ...command }) => command);
  assert.deepEqual(commands("answer"), [
    { do: "answer", id: 3, grant: false, reason: "landing" },
    { do: "answer", id: 3, grant: true, reason: "" },
  ]);
  receive(held(false, "app 3"));
  assert.deepEqual(pilot.questions, [], "who has no control is asked nothing");
  receive(held(true));
  receive({ type: "asked", questions: [asks(4)] });
  link(false);
  assert.deepEqual(pilot.questions, []);
});

test("who asks first waits, and sees for how long", () => {
  const { pilot, sent, receive, live, at, pong } = flown();
  live();
  pilot.take(8, true);
  assert.deepEqual([sent.at(-1)?.["do"], sent.at(-1)?.["priority"], sent.at(-1)?.["ask"]], ["take", 8, true]);
  assert.equal(pilot.wait_s, null);
  receive({ ...held(false, "follow.py"), state: "queued", line: { position: 1, wait_s: 9, asked: true, declined: null } });
  at(4000);
  assert.ok(pilot.waits);
  assert.equal(pilot.wait_s, 5);
  receive({ ...held(false, "follow.py"), state: "queued", line: { position: 1, wait_s: null, asked: true, declined: "" } });
  assert.equal(pilot.wait_s, null, "not known");
  pilot.steer(CENTRED);
  pong();
  pilot.release();
  receive(held(false, "follow.py"));
  assert.equal(pilot.wait_s, null);
  assert.equal(pilot.ended, "", "control that was never had is not lost");
});

test("what is marked is followed until something else is commanded; a page that loses the focus hovers", () => {
  const { pilot, sent, receive, live } = flown();
  live();
  pilot.selectTarget("front");
  pilot.markTarget({ camera: "front", captured_ns: "17", box: [1, 2, 30, 40], class_name: "person", size: [640, 480] });
  const follow = sent.findLast((message) => message["do"] === "follow");
  assert.deepEqual([follow?.["camera"], follow?.["captured_ns"], follow?.["box"]], ["front", "17", [1, 2, 30, 40]]);
  receive(held(true));
  receive({ type: "follow", state: "tracking", camera: "front" });
  pilot.rest();
  assert.deepEqual(doings(sent), ["follow_select", "follow"], "nothing flies yet");
  pilot.flyAfter("orbit", 5);
  receive({ type: "follow", state: "flying", camera: "front", mode: "orbit" });
  pilot.rest();
  assert.deepEqual(doings(sent).slice(2), ["follow_mode", "hover"]);
  receive({ type: "follow", state: "flying", camera: "front", mode: "orbit" });
  receive({ type: "follow", state: "ended", camera: "front", problem: "" });
  pilot.rest();
  pilot.flyAfter("follow", null);
  receive({ type: "refused", do: "follow_mode", n: 0, why: "take off first" });
  pilot.rest();
  assert.deepEqual(doings(sent).slice(4), ["follow_mode"]);
  assert.ok(!("distance_m" in (sent.findLast((message) => message["do"] === "follow_mode") ?? {})));
});
