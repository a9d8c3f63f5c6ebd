// What maps show around a drone, and how zones are edited.

import assert from "node:assert/strict";
import { test } from "node:test";
import { corners, hull, rayEnd, turned } from "../src/worldlayer.js";
import type { Zone } from "../src/surroundings.js";
import { type Finding, TakeOffQuestion } from "../src/preflight.js";
import { Writes } from "../src/parameters.js";
import { type Bounds, fields, handles, rectangle, round, writes, zoneAt, zoneName, zonesText } from "../src/zones.js";

const near = (is: readonly number[], should: readonly number[]): void => should.forEach((value, place) => assert.ok(Math.abs((is[place] as number) - value) < 1e-9, `${is} is not ${should}`));
const box: Zone = { kind: "box", low: [0, 0, 0], high: [2, 1, 3] };
const pillar: Zone = { kind: "cylinder", centre: [1, 0.5], radius: 0.2, low: 0, high: 3 };
const bounds: Bounds = { box: { low: [-4, -3, null], high: [4, 3, 2.5] }, zones: [box, pillar] };

test("a body's axes turn as REP 103 says", () => {
  near(turned([1, 0, 0], 0, 0, Math.PI / 2), [0, 1, 0]);
  near(turned([1, 0, 0], 0, Math.PI / 2, 0), [0, 0, -1]); // nose down
  near(turned([0, 1, 0], Math.PI / 2, 0, 0), [0, 0, 1]); // right side down
});

test("a camera's view ends at the floor, and has a convex outline", () => {
  near(rayEnd([0, 0, 1], [0, 0, -1], 3), [0, 0, 0]);
  near(rayEnd([0, 0, 1], [1, 0, 0], 3), [3, 0, 1]);
  assert.equal(hull([[0, 0], [1, 0], [1, 1], [0, 1], [0.5, 0.5]]).length, 4);
  near(corners(1, 1, 2, 4, 0)[0] as readonly number[], [2, 3]);
});

test("zones as the drone reads them", () => {
  assert.equal(zonesText([box, pillar]), "box 0 0 0 2 1 3; cylinder 1 0.5 0.2 0 3");
  assert.equal(zonesText([{ ...pillar, name: "tree" }]), "tree: cylinder 1 0.5 0.2 0 3");
  assert.equal(zonesText([]), "");
  assert.equal(zoneName({ kind: "box", low: [1.075, -1.87, 0], high: [2, 1 / 3, 3] }), "box 1.075 -1.87 0 2 0.333333 3", "as str() of the proxy's Box has it in a refusal");
  assert.equal(zoneName({ ...pillar, name: "tree" }), "tree");
  assert.deepEqual(rectangle([2, 1], [0, 3], 0, 1), { kind: "box", low: [0, 1, 0], high: [2, 3, 1] });
  const thin = rectangle([1, 1], [1, 1], 0, 1);
  assert.ok(thin.kind === "box" && thin.high[0] > thin.low[0] && thin.high[1] > thin.low[1]);
  assert.deepEqual(round([0, 0], [3, 4], 0, 1), { kind: "cylinder", centre: [0, 0], radius: 5, low: 0, high: 1 });
});

test("the zone under a pointer is the smallest", () => {
  assert.equal(zoneAt(bounds.zones, [1, 0.5]), 1);
  assert.equal(zoneAt(bounds.zones, [1.9, 0.9]), 0);
  assert.equal(zoneAt(bounds.zones, [5, 5]), null);
});

test("corners are dragged, and a zone by its centre", () => {
  const [first, , , , middle] = handles(bounds, 0);
  assert.deepEqual(first?.drag([-1, -2]).zones[0], { kind: "box", low: [-1, -2, 0], high: [2, 1, 3] });
  assert.deepEqual(first?.drag([3, 2]).zones[0], { kind: "box", low: [2, 1, 0], high: [3, 2, 3] }, "over the opposite corner");
  assert.deepEqual(middle?.drag([2, 1.5]).zones[0], { kind: "box", low: [1, 1, 0], high: [3, 2, 3] });
  const [centre, edge] = handles(bounds, 1);
  assert.deepEqual(centre?.drag([5, 5]).zones[1], { ...pillar, centre: [5, 5] });
  assert.deepEqual(edge?.drag([2, 0.5]).zones[1], { ...pillar, radius: 1 });
  assert.equal(handles(bounds, "box").length, 4);
  assert.deepEqual(handles(bounds, "box")[0]?.drag([-5, -6]).box?.low, [-5, -6, null]);
  assert.equal(handles({ ...bounds, box: null }, "box").length, 0);
});

test("what is written, and in which order", () => {
  const moved: Bounds = { ...bounds, box: { low: [5, -3, null], high: [9, 3, 2.5] } };
  assert.deepEqual(writes(bounds, moved), [{ name: "safety.box.x_high", value: 9 }, { name: "safety.box.x_low", value: 5 }], "a wall never passes the other");
  assert.deepEqual(writes(bounds, { ...bounds, zones: [pillar] }), [{ name: "safety.zones", value: "cylinder 1 0.5 0.2 0 3" }]);
  assert.deepEqual(writes(bounds, bounds), []);
  const gone = writes(bounds, { ...bounds, box: null }).map(({ name }) => name);
  assert.equal(gone.length, 5, "the lower wall was none before");
});

test("every number has a field, and an empty wall is none", () => {
  assert.deepEqual(fields(bounds, 0).map(({ value }) => value), [0, 2, 0, 1, 0, 3]);
  assert.deepEqual(fields(bounds, 1).map(({ value }) => value), [1, 0.5, 0.2, 0, 3]);
  const [west] = fields({ ...bounds, box: { low: [-4, null, null], high: [null, null, null] } }, "box");
  assert.equal(west?.with(null).box, null);
  assert.deepEqual(fields(bounds, 0)[5]?.with(2).zones[0], { ...box, high: [2, 1, 2] });
});

test("parameters are written one after the other, and a refusal is of the one under way", async () => {
  const sent: string[] = [];
  const queue = new Writes((name) => sent.push(name));
  const [first, second] = [queue.write("a", 1), queue.write("b", 2)];
  await Promise.resolve();
  assert.deepEqual(sent, ["a"]);
  assert.ok(!queue.done("other"));
  assert.ok(queue.done("a"));
  assert.equal(await first, "");
  await Promise.resolve();
  assert.ok(queue.refused("too far"));
  assert.equal(await second, "too far");
  assert.ok(!queue.refused("of something else"));
});

test("a take-off that something speaks against is asked about once, and the pilot decides", () => {
  const finding = (level: Finding["level"]): Finding => ({ check: "battery", level, detail: "5% left", why: "it lands at once", remedy: "charge it" });
  const question = new TakeOffQuestion();
  assert.equal(question.ask([finding("ok"), finding("warn")], 0, 0), "", "a warning forbids nothing");
  assert.match(question.ask([finding("fail")], 0, 1000), /battery: 5% left – it lands at once/);
  assert.notEqual(question.ask([finding("fail")], 0, 1200), "", "too soon: nobody has read it");
  assert.equal(question.ask([finding("fail")], 0, 3000), "", "the second press is the answer");
  assert.notEqual(question.ask([finding("fail")], 0, 3500), "", "the next take-off is asked about again");
  assert.notEqual(question.ask([finding("fail")], 0, 20_000), "", "the answer came too late: asked again");
  assert.notEqual(question.ask([{ ...finding("fail"), check: "link" }], 0, 21_000), "", "it is another question");
  assert.equal(new TakeOffQuestion().ask([finding("fail")], 60_000, 0), "", "what is old says nothing");
});
