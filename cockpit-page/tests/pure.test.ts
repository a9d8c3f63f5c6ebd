// The parts of the page that need no browser.

import assert from "node:assert/strict";
import { test } from "node:test";
import { belongs, LATEST_NS, lateness, REACH_NS } from "../src/drawing.js";
import { passes } from "../src/events.js";
import { ServerClock } from "../src/clock.js";
import { bytes, clock, duration, figure, heading, headingText, lasting, plain, short } from "../src/format.js";
import { GamepadReader, type Pad } from "../src/gamepad.js";
import { History, Trail } from "../src/history.js";
import { Hold, HOLD_MS } from "../src/hold.js";
import { type Press, Keys, stopKeys } from "../src/keys.js";
import { named } from "../src/language/index.js";
import { en } from "../src/language/en.js";
import type { Authority, DroneRow, QueuePosition, Question, Sticks } from "../src/model.js";
import { grouped } from "../src/plots.js";
import { explained, pending, wins } from "../src/question.js";
import { lacking } from "../src/recordings.js";
import { isRecording, outcome } from "../src/safety.js";
import { CENTRED, DEAD_BAND, deadBand, Hands, isCentred, Latch, merge, PACES, type Pace, ramp, RAMP_S, scale } from "../src/sticks.js";
import { lineText, nowText } from "../src/strip.js";
import { ONE_PRESS_MS, parse, Presses, rangeText } from "../src/parameters.js";
import { othersOf } from "../src/world.js";
import { around, gridStep, toMetres, toPixels, zoomed } from "../src/view.js";
import { arrow, nearest } from "../src/maptool.js";
import { leg } from "../src/waypoint.js";

/** What the cockpit may refuse: skyloop/cockpit/commands.py. */
const COMMANDS = "take release answer takeoff hover land return stop fly goto route route_pause route_resume route_skip route_stop follow_select follow follow_mode follow_stop set".split(" ");
const near = (value: number, wanted: number): void => assert.ok(Math.abs(value - wanted) < 1e-9, `${value} is not ${wanted}`);
const push = (sticks: Partial<Sticks>): Sticks => ({ ...CENTRED, ...sticks });

test("a refusal calls its command as the button does", () => {
  const { names } = en.commands;
  for (const tag of COMMANDS) assert.match(named(names, tag), /^[A-Z][a-z ]+$/, tag);
  assert.equal(named(names, "goto"), en.waypoint.fly);
  assert.equal(named(names, "takeoff"), en.strip.takeOff);
  assert.equal(named(names, "route"), en.route.fly);
});

test("a double tap, or a key that is held, does something once", () => {
  const presses = new Presses();
  assert.equal(presses.isNew(0), true);
  for (let at_ms = 200; at_ms < 5 * ONE_PRESS_MS; at_ms += 200) assert.equal(presses.isNew(at_ms), false);
  assert.equal(presses.isNew(10 * ONE_PRESS_MS), true);
});

test("dead band: nothing within, no step at its edge, all at the end", () => {
  for (const value of [0, 0.05, DEAD_BAND, -DEAD_BAND, Number.NaN]) assert.equal(Math.abs(deadBand(value)), 0);
  near(deadBand(DEAD_BAND + 1e-6), 1e-6 / (1 - DEAD_BAND));
  assert.equal(deadBand(1), 1);
  assert.equal(deadBand(-1.4), -1);
  for (let value = -1; value < 1; value += 0.05) assert.ok(deadBand(value) <= deadBand(value + 0.05));
});

test("keys ramp up, and let go at once", () => {
  const half = ramp(CENTRED, push({ forward: 1 }), RAMP_S / 2);
  near(half.forward, 0.5);
  near(ramp(half, push({ forward: 1 }), RAMP_S).forward, 1);
  assert.equal(ramp(half, CENTRED, 0.05).forward, 0);
  assert.ok(ramp(push({ left: 1 }), push({ left: -1 }), 0.05).left < 0, "across the centre without a pause");
});

test("of several inputs the one pushed furthest counts", () => {
  assert.deepEqual(merge(push({ up: 0.2, left: -1 }), push({ up: -0.5 })), push({ up: -0.5, left: -1 }));
  const pace = PACES[0] as Pace;
  assert.deepEqual(scale(push({ forward: 1, yaw_rate: -1 }), pace), { forward: pace.speed, left: 0, up: 0, yaw_rate: -pace.turn });
  assert.ok(isCentred(CENTRED));
});

test("a stick that is pushed already must come back first", () => {
  const latch = new Latch();
  assert.ok(isCentred(latch.pass(push({ up: 1 }))));
  latch.pass(CENTRED);
  assert.equal(latch.pass(push({ up: 1 })).up, 1);
  latch.reset();
  assert.ok(isCentred(latch.pass(push({ up: 1 }))));
});

const press = (code: string, more: Partial<Press> = {}): Press => ({ code, repeat: false, modified: false, typing: false, ...more });

test("hands fly the drone that is selected, and another one only after they were centred", () => {
  const [alpha, beta] = [new Hands(), new Hands()];
  const forward = push({ forward: 1 });
  for (const source of ["keys", "pad", "thumbs"] as const) {
    const read = (hands: Hands, sticks: Sticks, counts: boolean): Sticks => {
      const of = (name: typeof source): Sticks => (name === source ? sticks : CENTRED);
      return hands.read(of("keys"), of("pad"), of("thumbs"), counts, 1);
    };
    for (const hands of [alpha, beta]) read(hands, CENTRED, hands === alpha);
    assert.deepEqual(read(alpha, forward, true), forward);
    assert.ok(isCentred(read(beta, forward, false)));
    assert.ok(isCentred(read(alpha, forward, false)), "beta is selected now");
    assert.ok(isCentred(read(beta, forward, true)), `${source}: pushed for alpha`);
    assert.ok(isCentred(read(alpha, forward, true)), "and back: it was never let go");
    for (const hands of [alpha, beta]) read(hands, CENTRED, hands === beta);
    assert.deepEqual(read(beta, forward, true), forward, "pushed anew");
    beta.rest();
    assert.ok(isCentred(read(beta, forward, true)), "after a rest it is centred first");
    for (const hands of [alpha, beta]) read(hands, CENTRED, false);
    assert.ok(isCentred(read(alpha, forward, false)), "no control");
    assert.ok(isCentred(read(alpha, forward, true)), "control, with the stick pushed already");
  }
});

test("macOS does not tell of keys that are released while Cmd is down: it lets go of all", () => {
  const keys = new Keys();
  keys.down(press("KeyW"));
  keys.down(press("MetaLeft", { modified: true }));
  assert.ok(isCentred(keys.sticks()));
  keys.up("MetaLeft");
  keys.down(press("KeyW", { repeat: true }));
  assert.ok(isCentred(keys.sticks()), "its repeats are no new press");
  keys.down(press("KeyW"));
  keys.up("MetaRight");
  assert.ok(isCentred(keys.sticks()), "pressed before the page had the focus");
});

test("keys: sticks by place, deeds once, nothing while somebody types", () => {
  const keys = new Keys();
  assert.equal(keys.down(press("KeyW")), "stick");
  assert.equal(keys.down(press("ArrowLeft")), "stick");
  assert.deepEqual(keys.sticks(), push({ forward: 1, yaw_rate: 1 }));
  keys.down(press("KeyS"));
  assert.equal(keys.sticks().forward, 0, "opposite keys cancel");
  keys.up("KeyW");
  assert.equal(keys.sticks().forward, -1);
  keys.clear();
  assert.ok(isCentred(keys.sticks()));
  assert.equal(keys.down(press("KeyT")), "takeoff");
  assert.equal(keys.down(press("KeyB")), "return");
  assert.equal(keys.down(press("KeyT", { repeat: true })), null);
  assert.equal(keys.down(press("KeyT", { typing: true })), null);
  assert.equal(keys.down(press("KeyR", { modified: true })), null, "Ctrl+R is the browser's");
  assert.ok(isCentred(keys.sticks()));
});

const keyed = (code: string, more: Partial<Parameters<typeof stopKeys>[0]> = {}): Parameters<typeof stopKeys>[0] => ({ code, ctrlKey: false, shiftKey: false, altKey: false, metaKey: false, ...more });

test("the emergency stop is Ctrl and Enter; Escape flies and stops nothing", () => {
  const keys = new Keys();
  for (const typing of [true, false]) assert.equal(keys.down(press("Escape", { typing })), null);
  assert.equal(stopKeys(keyed("Escape")), null);
  assert.equal(stopKeys(keyed("Enter")), null);
  assert.equal(stopKeys(keyed("Enter", { ctrlKey: true })), "one");
  assert.equal(stopKeys(keyed("NumpadEnter", { ctrlKey: true, shiftKey: true })), "all");
  assert.equal(stopKeys(keyed("Enter", { ctrlKey: true, altKey: true })), null, "AltGr is no Ctrl");
  assert.equal(stopKeys(keyed("KeyX", { ctrlKey: true })), null);
});

test("what is held counts, once, and starts anew when it was let go", () => {
  const hold = new Hold();
  assert.equal(hold.share(0), null);
  hold.press(1000);
  hold.press(1500); // another one meanwhile begins nothing
  assert.equal(hold.share(1400), 0.5);
  assert.ok(!hold.isDone(1799));
  hold.release();
  assert.ok(!hold.isDone(5000), "let go: nobody does it by chance");
  hold.press(6000);
  assert.ok(hold.isDone(6000 + HOLD_MS));
  assert.ok(!hold.isDone(6000 + HOLD_MS), "once");
});

test("what became of a command to all drones, the worst first", () => {
  const each = new Map([["a", { state: "sent", why: "" }], ["b", { state: "refused", why: "link lost" }]]);
  assert.deepEqual(outcome("stop_all", ["a", "b", "c"], each), { text: "Stop all · NOT stopped: b: link lost · pending: c · sent: a", bad: true });
  each.set("b", { state: "done", why: "" });
  assert.deepEqual(outcome("land_all", ["a", "b"], each), { text: "Land all · sent: a · landed: b", bad: false });
  assert.match(outcome("land_all", [], new Map()).text, /no drone/);
});

test("the cockpit's clock: to half of the time there and back, and what arrives late is old", () => {
  const clock = new ServerClock();
  assert.equal(clock.at(0), null);
  assert.equal(clock.age_s(5, 0), null);
  clock.pong(1000, 1100, 51.05); // it is 50 s ahead
  const stamp = clock.at(2000);
  assert.ok(stamp && Math.abs(stamp.at_s - 52) < 1e-6 && stamp.unsure_s >= 0.05 && stamp.unsure_s < 0.06);
  clock.pong(3000, 11_000, 60.9); // answered after a stall: known no better by that
  const later = clock.at(11_000);
  assert.ok(later && Math.abs(later.at_s - 61) < 1e-6 && later.unsure_s < 0.06);
  clock.received(12_000, 61.99);
  near(clock.age_s(61.99, 12_000) as number, 0);
  clock.received(13_000, 55); // seven seconds in some buffer
  assert.ok((clock.age_s(55, 13_000) as number) > 7.9);
  assert.ok((clock.age_s(61.99, 12_000 + 3_600_000) as number) > 3598, "an hour later it is an hour old");
});

test("a clock that jumps, as after sleep, is measured anew", () => {
  const clock = new ServerClock();
  clock.pong(1000, 1010, 51.005);
  clock.pong(2000, 2100, 652.05); // the page's machine slept for ten minutes
  const stamp = clock.at(3000);
  assert.ok(stamp && Math.abs(stamp.at_s - 653) < 1e-6);
  assert.ok((clock.age_s(652.05, 2100) as number) < 0.1);
});

test("who observes knows how old news is without asking anything", () => {
  const clock = new ServerClock();
  for (let ms = 0; ms < 5000; ms += 55) clock.received(ms + 5, 100 + ms / 1000);
  assert.ok((clock.age_s(105, 5010) as number) < 0.02);
  assert.ok((clock.age_s(105, 8000) as number) > 2.9);
});

const pad = (axes: number[], pressed: number[] = []): Pad => ({
  id: "Test pad",
  mapping: "standard",
  connected: true,
  axes,
  buttons: Array.from({ length: 17 }, (_, number) => ({ pressed: pressed.includes(number) })),
});

test("gamepad: sticks after they were centred, buttons once, and reported when it goes away", () => {
  const reader = new GamepadReader({ get: () => null });
  assert.ok(isCentred(reader.read(pad([0, -1, 0, 0]), "2").sticks), "pushed from the start");
  assert.ok(isCentred(reader.read(pad([0.05, -0.1, 0, 0.02]), "2").sticks), "dead band");
  assert.deepEqual(reader.read(pad([1, 0, -1, -1]), "2").sticks, push({ yaw_rate: -1, left: 1, forward: 1 }));
  assert.deepEqual(reader.read(pad([0, 0, 0, 0], [9]), "2").deeds, ["takeoff"]);
  assert.deepEqual(reader.read(pad([0, 0, 0, 0], [9]), "2").deeds, []);
  assert.ok(!reader.read(pad([0, 0, 0, 0], [4]), "2").stops, "one bumper alone does nothing");
  assert.ok(reader.read(pad([0, 0, 0, 0], [4, 5]), "2").stops, "both are to be held");
  assert.deepEqual(reader.read(pad([0, 0, 0, 0], [4, 5]), "2").deeds, []);
  assert.equal(reader.read(null, "2").lost, true);
  assert.equal(reader.read(null, "2").lost, false);
  assert.ok(isCentred(reader.read(pad([1, 0, 0, 0]), "2").sticks), "after it came back it must be centred again");
});

test("figures for people", () => {
  assert.equal(figure(-0.04, 1), "0.0");
  assert.equal(figure(-1.25, 1), "−1.3");
  assert.equal(figure(null, 1), "–");
  assert.equal(figure(Number.NaN, 1), "–");
  near(heading(0), 90);
  near(heading(Math.PI / 2), 0);
  assert.equal(headingText(Math.PI), "270");
  assert.equal(headingText(Math.PI / 2 + 0.001), "000");
  assert.equal(duration(0.0012), "1.20 ms");
  assert.equal(duration(0.25), "250 ms");
  assert.equal(duration(125), "2:05");
  assert.equal(clock(3725), "1:02:05");
  assert.deepEqual([0.2, 89, 90, 600, 5400, 9000].map(lasting), ["1 s", "89 s", "2 min", "10 min", "1.5 h", "2.5 h"]);
  assert.equal(bytes(1234), "1.2 kB");
  assert.equal(bytes(999_600), "1.0 MB");
  assert.equal(bytes(12), "12 B");
  assert.equal(short(0.012345), "0.0123");
  assert.equal(short(-1234.5), "−1235");
  assert.equal(short(123456.7), "123457", "a time in milliseconds is no power of ten");
  assert.equal(short(2.82e-5), "2.82e−5");
  assert.equal(short(2.82e-5, true), "0", "a height");
  assert.equal(plain(0.1), "0.1");
});

test("history keeps numbers by time, and holes as holes", () => {
  const history = new History();
  history.add(1, { a: 1 });
  history.add(2, { a: 2, b: 5 });
  history.add(3, { b: null });
  assert.deepEqual(history.since(0, ["a", "b", "unknown"]), [[1, 2, 3], [1, 2, null], [null, 5, null], [null, null, null]]);
  assert.deepEqual(history.since(2, ["a"]), [[2, 3], [2, null]]);
  assert.equal(history.newest("b"), null);
  for (let number = 4; number < 6000; number += 1) history.add(number, { a: number });
  const [times, values] = history.since(0, ["a"]);
  assert.equal(times?.length, 4096);
  assert.equal(times?.at(-1), 5999);
  assert.equal(values?.[0], times?.[0]);
});

test("a trail takes steps, not noise, and forgets", () => {
  const trail = new Trail(10, 0.1);
  trail.add(0, [0, 0, 0]);
  trail.add(1, [0.05, 0, 0]);
  trail.add(2, [0.2, 0, 0]);
  assert.equal(trail.points.length, 2);
  trail.add(11.5, [1, 0, 0]);
  assert.equal(trail.points.length, 2);
});

test("the map's view: there and back, and a zoom that keeps its point", () => {
  const size = { width: 400, height: 300 };
  const view = { east: 1, north: 2, scale: 50 };
  assert.deepEqual(toPixels(view, size, 1, 2), [200, 150]);
  assert.ok(toPixels(view, size, 1, 3)[1] < 150, "north is up");
  const [east, north] = toMetres(view, size, ...toPixels(view, size, -3.5, 4.25));
  near(east, -3.5);
  near(north, 4.25);
  const closer = zoomed(view, size, 2, 30, 40);
  toMetres(view, size, 30, 40).forEach((value, axis) => near(toMetres(closer, size, 30, 40)[axis] as number, value));
  const all = around([[0, 0], [10, 2]], size);
  assert.ok(all);
  for (const [x, y] of [[0, 0], [10, 2]] as const) {
    const [px, py] = toPixels(all, size, x, y);
    assert.ok(px > 0 && px < 400 && py > 0 && py < 300);
  }
  assert.equal(around([], size), null);
  assert.equal(gridStep(50), 1);
  assert.equal(gridStep(200), 0.5);
});

test("parameters as they are written", () => {
  assert.deepEqual(parse({ type: "float" }, " 1.5 "), { value: 1.5 });
  assert.deepEqual(parse({ type: "vector" }, "1, 2 -3"), { value: [1, 2, -3] });
  assert.deepEqual(parse({ type: "bool" }, "false"), { value: false });
  assert.deepEqual(parse({ type: "text" }, " a "), { value: " a " });
  for (const [type, text] of [["float", "fast"], ["float", ""], ["int", "1.5"], ["bool", "yes"], ["vector", "1,,2"]] as const) {
    assert.ok("problem" in parse({ type }, text), `${type} ${text}`);
  }
  assert.equal(rangeText({ minimum: 0.1, maximum: 3600, choices: [] }), "0.1 … 3600");
  assert.equal(rangeText({ minimum: null, maximum: null, choices: ["a", "b"] }), "a | b");
});

test("events by words and severity", () => {
  const event = { n: 1, kind: "battery_low", severity: "warning", text: "18 %", app: "", age_s: 0 };
  assert.ok(passes(event, "battery low", ""));
  assert.ok(passes(event, "", "warning"));
  assert.ok(!passes(event, "", "error"));
  assert.ok(!passes(event, "landing", ""));
});

test("numbers to plot are grouped; what a recording lacks is added up", () => {
  assert.deepEqual([...grouped(["log.b", "yaw", "log.a"])], [["log", ["log.a", "log.b"]], ["vehicle", ["yaw"]]]);
  assert.equal(lacking({ dropped: { a: { video: 2 } }, missed: { a: { feedback: 1 }, b: { video: 4 } } }), 7);
});

const asks = (more: Partial<Question> = {}): Question => ({ id: 3, by: "survey.py", priority: 4, for_s: 120, left_s: 10, declined: false, ...more });

test("maps show what flies, and of recordings what was recorded", () => {
  const row = (name: string, uri: string): DroneRow => ({ name, uri, position: [1, 2, 3], yaw: 0 }) as unknown as DroneRow;
  const rows = [row("alpha", "sim://"), row("beta", "sim://"), row("flight", "replay:///flight.mcap")];
  assert.deepEqual(othersOf({ name: "alpha", recorded: false }, rows).map((body) => body.name), ["beta"]);
  assert.deepEqual(othersOf({ name: "flight", recorded: true }, rows), [], "no live drone on the map of a recording");
});

test("recordings are known by their address", () => {
  assert.ok(isRecording({ uri: "replay:///home/me/flight.mcap" }));
  assert.ok(!isRecording({ uri: "sim://?seed=1" }));
});

test("a question for control says what becomes of it", () => {
  assert.ok(wins(asks(), 8));
  assert.ok(!wins(asks({ priority: 8 }), 8));
  assert.equal(explained(asks(), 8, 0), "Priority 4, yours 8. That is higher than yours: it gets control when the time is up. Wanted for 2 min.");
  assert.match(explained(asks({ priority: 16, for_s: null }), 8, 2), /you keep control unless.*unspecified time\. 2 more ask for it\.$/);
  assert.match(explained(asks({ declined: true }), 8, 0), /^You keep it for now; the higher priority/);
  const [kept, keptFromLower] = [asks({ declined: true }), asks({ id: 4, declined: true, priority: 16 })];
  assert.deepEqual(pending([kept, keptFromLower], 8), [kept], "nothing more comes of one that is no higher");
});

test("the place in the line, with what was answered", () => {
  const waits = (line: Partial<QueuePosition>, state: Authority["state"] = "queued"): string =>
    lineText({ type: "authority", state, holder: "follow.py", priority: 16, mine: false, why: null, given: false, app: "cockpit 1", waiting: [], line: { position: 2, wait_s: null, asked: false, declined: null, ...line } });
  assert.equal(waits({}), "You are number 2 in line");
  assert.equal(waits({ position: null }, "preempted"), "You wait in line");
  assert.equal(waits({ asked: true }), "follow.py was asked · you are number 2 in line");
  assert.equal(waits({ asked: true, declined: "" }), "follow.py keeps it for now · you are number 2 in line");
  assert.equal(waits({ asked: true, declined: "landing" }), "follow.py keeps it for now: “landing” · you are number 2 in line");
  assert.equal(waits({}, "none"), "");
});

test("one sentence says who has control, who waits, and what can be done", () => {
  const none: Authority = { type: "authority", state: "none", holder: null, priority: null, mine: false, why: null, given: false, app: "cockpit 1", waiting: [], line: null };
  const says = (authority: Partial<Authority>, questions: Question[] = [], wanted = { asks: false, priority: 8 }): string => nowText({ ...none, ...authority }, questions, wanted.asks, wanted.priority);
  assert.equal(says({}), "Nobody has control: take it to fly.");
  assert.equal(says({ waiting: ["cockpit 2"] }), "Nobody has control, and cockpit 2 waits for it: take it to fly.");
  const mine: Partial<Authority> = { state: "held", mine: true, holder: "cockpit 1", priority: 8 };
  assert.equal(says(mine), "You have control, and nobody waits for it: fly, or release it.");
  assert.equal(says({ ...mine, waiting: ["cockpit 2"] }, [asks({ by: "cockpit 2" })]), "You have control, and cockpit 2 waits for it: hand it over, keep it, or fly on.");
  assert.equal(says({ ...mine, waiting: ["cockpit 2"] }, [asks({ by: "survey.py", declined: true })]), "You have control, and cockpit 2 and survey.py wait for it: fly, or release it.");
  const other: Partial<Authority> = { holder: "cockpit 2", priority: 8 };
  assert.equal(says(other), "cockpit 2 has control, and nobody waits for it: ask for it, since your priority 8 is no higher.");
  assert.equal(says({ ...other, waiting: ["cockpit 3"] }, [], { asks: false, priority: 4 }), "cockpit 2 has control, and cockpit 3 waits for it: you can take it at once, since your priority 4 is higher.");
  assert.equal(says(other, [], { asks: true, priority: 8 }), "cockpit 2 has control, and nobody waits for it: ask for it, since your priority 8 is no higher.");
  assert.equal(says(other, [], { asks: true, priority: 4 }), "cockpit 2 has control, and nobody waits for it: ask for it, and it may be handed over.");
  const line = { position: 1, wait_s: null, asked: true, declined: null };
  assert.equal(says({ ...other, state: "queued", waiting: ["cockpit 1"], line }), "cockpit 2 has control, and you wait for it: it is yours when it is released and you are first.");
  assert.equal(says({ ...other, state: "preempted", waiting: ["cockpit 1", "cockpit 3"], line }), "cockpit 2 has control, and you and cockpit 3 wait for it: it is yours again when it is released and you are first.");
});

test("a drawing that comes late is shown with later pictures, up to a limit", () => {
  const drawn = { captured_ns: "5000000000" };
  const [own, soon, later, much] = [5_000_000_000n, 5_200_000_000n, 5_700_000_000n, 6_500_000_000n];
  assert.equal(lateness(drawn, null), 0n);
  assert.equal(lateness(drawn, soon), 0n, "with its own picture, or the next");
  assert.equal(lateness(drawn, later), 700_000_000n);
  assert.equal(lateness(drawn, 60_000_000_000n), 0n, "what somebody drew a minute ago is not late");
  for (const shown of [own, soon]) assert.equal(belongs(drawn, 0n, shown), "live");
  assert.equal(belongs(drawn, 0n, later), "", "one that came in time goes with its picture");
  assert.equal(belongs(drawn, 700_000_000n, later), "late");
  assert.equal(belongs(drawn, 700_000_000n, later + REACH_NS), "", "until the next one should be there");
  assert.equal(belongs(drawn, 1_500_000_000n, much), "", "things are elsewhere by now");
  assert.equal(belongs(drawn, LATEST_NS, 6_100_000_000n), "late");
});

test("what lies under a pointer, and how far a waypoint is", () => {
  const bodies = [{ name: "a", position: [0, 0, 1] }, { name: "b", position: [0.3, 0, 1] }];
  assert.equal(nearest([0.2, 0], 0.25, bodies)?.name, "b");
  assert.equal(nearest([2, 0], 0.25, bodies), null);
  assert.deepEqual(arrow("ArrowUp"), [0, 1]);
  assert.equal(arrow("KeyW"), null);
  assert.deepEqual(leg([0, 0, 1], [3, 4, 1], { along: 2, up: 1 }), { distance_m: 5, time_s: 2.5 });
  assert.deepEqual(leg([0, 0, 1], [0, 0, 3], { along: 2, up: 1 }), { distance_m: 2, time_s: 2 });
  assert.equal(leg([0, 0, 1], [0, 0, 3], null).time_s, null);
});
