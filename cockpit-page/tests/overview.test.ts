// The overview, as far as it needs no browser: addresses, rows in words, orders, and what comes over the socket.

import assert from "node:assert/strict";
import { test } from "node:test";
import { hashOf, namesOf, OVERVIEW } from "../src/address.js";
import { pairingCode } from "../src/login.js";
import type { DroneRow } from "../src/model.js";
import { byName, describe, found, sorted } from "../src/row.js";
import { unpackAll } from "../src/smallvideo.js";

const row = (name: string, more: Partial<DroneRow> = {}): DroneRow => ({
  name, uri: "sim://", vehicle: "sim", transport: "local", state: "hovering", airborne: true, battery: 0.8, owner: null, me: false,
  links: { application: "up", vehicle: "up", reason: "" }, alarms: [], cameras: [], can_fly: true, why_not: "", recording: false,
  position: null, altitude: 1.25, yaw: null, replay: false, ...more,
});

test("an address names drones, or the overview; what was typed by hand does no harm", () => {
  for (const hash of ["", "#", OVERVIEW, "#/whatever"]) assert.deepEqual(namesOf(hash), []);
  assert.deepEqual(namesOf("#alpha,beta,alpha,"), ["alpha", "beta"]);
  assert.deepEqual(namesOf("#a%20b,%zz"), ["a b", "%zz"]);
  for (const names of [[], ["alpha"], ["a,b", "ü", "/"]]) assert.deepEqual(namesOf(hashOf(names)), names);
});

test("a drone in words", () => {
  assert.deepEqual([describe(row("a")).state, describe(row("a")).tone, describe(row("a")).holder], ["hovering · 1.3 m", "ok", "nobody has control"]);
  const alarm = { id: "battery", severity: "warning", text: "battery low: 12%" } as const;
  assert.deepEqual([describe(row("a", { alarms: [alarm] })).tone, describe(row("a", { alarms: [alarm] })).alarm], ["warn", "battery low: 12%"]);
  assert.equal(describe(row("a", { alarms: [alarm, { ...alarm, severity: "critical" }] })).tone, "bad");
  const lost = describe(row("a", { links: { application: "lost", vehicle: "up", reason: "" } }));
  assert.deepEqual([lost.state, lost.tone, lost.battery], ["lost", "bad", null], "the last known charge is not shown as now");
  const over = describe(row("a", { uri: "replay:x", links: { application: "lost", vehicle: "up", reason: "" }, alarms: [alarm] }));
  assert.deepEqual([over.state, over.tone, over.alarm], ["recording over", "quiet", ""], "its end is no alarm");
});

test("orders: as people count, and what is not known comes last whichever way", () => {
  const rows = [row("drone10", { battery: 0.5 }), row("drone9", { battery: null }), row("drone2", { battery: 0.9 })];
  const names = (list: readonly DroneRow[]): string[] => list.map((one) => one.name);
  assert.deepEqual(names([...rows].sort(byName)), ["drone2", "drone9", "drone10"]);
  assert.deepEqual(names(sorted(rows, "battery", false)), ["drone10", "drone2", "drone9"]);
  assert.deepEqual(names(sorted(rows, "battery", true)), ["drone2", "drone10", "drone9"]);
  assert.deepEqual(names(sorted(rows, "state", true)), ["drone2", "drone9", "drone10"], "equal ones by name");
});

test("a search finds by any words that are shown", () => {
  const one = row("Alpha", { owner: "follow.py" });
  for (const search of ["alpha", "ALP", "hover follow", "  "]) assert.ok(found(one, search), search);
  for (const search of ["beta", "alpha beta"]) assert.ok(!found(one, search), search);
});

test("frames of several cameras in one message; one that is cut off is refused", () => {
  const message = (head: object, ...jpegs: number[][]): ArrayBuffer => {
    const text = new TextEncoder().encode(JSON.stringify(head));
    const bytes = new Uint8Array(4 + text.length + jpegs.flat().length);
    new DataView(bytes.buffer).setUint32(0, text.length);
    bytes.set(text, 4);
    bytes.set(jpegs.flat(), 4 + text.length);
    return bytes.buffer;
  };
  const frames = [{ drone: "a", bytes: 2 }, { drone: "b", bytes: 3 }];
  const { ack, frames: split } = unpackAll(message({ ack: 7, frames }, [1, 2], [3, 4, 5]));
  assert.equal(ack, 7);
  assert.deepEqual(split.map(({ head, data }) => [head.drone, [...data]]), [["a", [1, 2]], ["b", [3, 4, 5]]]);
  assert.throws(() => unpackAll(message({ ack: 7, frames }, [1, 2], [3, 4])), /cut off/);
  assert.throws(() => unpackAll(new Uint8Array([0, 0, 1, 0, 1]).buffer), /cut off/);
});

test("only an address with a whole code pairs", () => {
  const code = "0dXbq3T2mW0uJm3iT5nIYbWfZ0b0v8_-";
  assert.equal(pairingCode(`#pair=${code}`), code);
  for (const hash of ["", "#pair=", "#pair=short", `#pair=${code}<b>`, `#alpha,pair=${code}`]) assert.equal(pairingCode(hash), null, hash);
});
