// Alarms: what is acknowledged, and when something is to be heard.

import assert from "node:assert/strict";
import { test } from "node:test";
import { AlarmBook, CLEAR_MS } from "../src/alarms.js";
import { type AlarmSource, REPEAT_MS, Ringing } from "../src/alarmsound.js";
import type { Alarm } from "../src/model.js";

const alarm = (id: string, severity: Alarm["severity"] = "warning"): Alarm => ({ id, severity, text: id });
const ids = (alarms: readonly Alarm[]): string[] => alarms.map(({ id }) => id);

test("an acknowledged alarm folds, and stays so while it lasts", () => {
  const book = new AlarmBook();
  book.update([alarm("battery"), alarm("vehicle_link")], 0);
  assert.equal(book.raised, 2);
  assert.equal(book.acknowledge("battery", 300), false, "nobody can have read it yet");
  assert.equal(book.acknowledge("battery", 700), true);
  book.update([alarm("battery"), alarm("vehicle_link")], 800);
  assert.deepEqual([ids(book.open), ids(book.acknowledged), book.raised], [["vehicle_link"], ["battery"], 2]);
  assert.equal(book.acknowledge("no such", 700), false);
});

test("an acknowledged alarm comes back when it gets worse, or was gone for a while", () => {
  const book = new AlarmBook();
  book.update([alarm("battery")], 0);
  book.acknowledge("battery", 1000);
  assert.equal(book.loudest, null);
  book.update([alarm("battery", "critical")], 1000);
  assert.deepEqual([book.loudest, book.raised], ["critical", 2]);
  book.acknowledge("battery", 2000);
  book.update([alarm("battery", "warning")], 2000);
  assert.equal(book.loudest, null, "it got better");
  book.update([alarm("battery", "critical")], 2100);
  assert.equal(book.loudest, "critical", "as bad as before is worth a look again");
  book.acknowledge("battery", 3000);
  book.update([alarm("battery", "critical")], 3000);
  book.update([], 3100);
  book.update([alarm("battery", "critical")], 3000 + CLEAR_MS / 2);
  assert.equal(book.loudest, null, "a gap of a moment is none");
  book.update([], 4000);
  book.update([alarm("battery", "critical")], 4001 + CLEAR_MS);
  assert.equal(book.loudest, "critical");
});

test("a warning is heard once, a critical alarm again and again until it is acknowledged", () => {
  const source = (raised: number, loudest: AlarmSource["loudest"], repeats = true): AlarmSource[] => [{ name: "alpha", raised, loudest, repeats }];
  const ringing = new Ringing();
  assert.equal(ringing.due(source(0, null), 0), null);
  assert.equal(ringing.due(source(1, "warning"), 1), "warning");
  assert.equal(ringing.due(source(1, "warning"), 60_000), null);
  assert.equal(ringing.due(source(2, "critical"), 60_001), "critical");
  assert.equal(ringing.due(source(2, "critical"), 60_002), null);
  assert.equal(ringing.due(source(2, "critical"), 60_001 + REPEAT_MS), "critical");
  assert.equal(ringing.due(source(2, null), 90_000), null, "acknowledged");
  assert.equal(ringing.due(source(3, "critical", false), 90_001), "critical");
  assert.equal(ringing.due(source(3, "critical", false), 99_000), null, "nobody can acknowledge it there");
});
