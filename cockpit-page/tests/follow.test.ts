// Marking what is to be followed: pixels of the pointer are pixels of the frame, and what was detected is found.

import assert from "node:assert/strict";
import { test } from "node:test";
import { contain } from "../src/drawing.js";
import { beside, between, type Box, foundAt, foundIn, isLarge, nudged, toFrame, toView } from "../src/follow.js";
import { figures, FollowPanel } from "../src/followpanel.js";
import type { Drawing, Shape } from "../src/model.js";
import { UNREAD_MS } from "../src/question.js";

const FRAME = { width: 320, height: 240 };
const square = ([x, y, w, h]: Box): [number, number][] => [[x, y], [x + w, y], [x + w, y + h], [x, y + h]];
const outline = (box: Box, closed = true): Shape => ({ kind: "line", points: square(box), closed, colour: [64, 220, 100] });
const said = (text: string): Shape => ({ kind: "text", text, at: [0, 0], colour: [64, 220, 100] });
const drawing = (shapes: Shape[], more: Partial<Drawing> = {}): Drawing => ({ type: "drawing", source: "detections", captured_ns: "1000000000000000000", ...FRAME, shapes, ...more });
const AT = "1000000000000000000";

test("a pointer over a letterboxed picture is over the pixel that is drawn there", () => {
  // 320×240 in a box of 1000×600: 2.5 times as large, 100 pixels free on both sides.
  const fit = contain(320, 240, { width: 1000, height: 600 }, 1);
  assert.deepEqual(toFrame(fit, [100, 0]), [0, 0]);
  assert.deepEqual(toFrame(fit, [900, 600]), [320, 240]);
  assert.deepEqual(toFrame(fit, [350, 250]), [100, 100]);
  assert.deepEqual(toFrame(fit, [20, 700]), [0, 240], "beyond the edge it is at the edge");
  const upright = contain(320, 240, { width: 390, height: 844 }, 1);
  const [x, y] = toFrame(upright, [195, 422]);
  assert.deepEqual([Math.round(x), Math.round(y)], [160, 120]);
  for (const box of [[0, 0, 320, 240], [12.5, 40, 33, 80.1]] as Box[]) {
    const [left, top, width, height] = toView(fit, box);
    const back = between(toFrame(fit, [left + width, top]), toFrame(fit, [left, top + height]));
    assert.deepEqual(back, box, "whichever corners it is dragged between");
  }
});

test("a box has at least the size that can be tracked", () => {
  assert.ok(isLarge([0, 0, 6, 6]));
  assert.ok(!isLarge([0, 0, 5.9, 60]));
  assert.ok(!isLarge(between([10, 10], [10, 90])));
});

test("what a processor drew is found, with its class, also in the pixels of a smaller picture", () => {
  const shapes = [outline([10, 20, 30, 60]), said("traffic light 0.87"), outline([200, 100, 8, 8]), outline([0, 0, 50, 50], false), outline([50, 50, 3, 3])];
  const found = foundIn([drawing(shapes)], AT, FRAME);
  assert.deepEqual(found, [
    { box: [10, 20, 30, 60], name: "traffic light", captured_ns: AT },
    { box: [200, 100, 8, 8], name: "", captured_ns: AT },
  ]);
  const half = foundIn([drawing([outline([5, 10, 15, 30])], { width: 160, height: 120 })], AT, FRAME);
  assert.deepEqual(half[0]?.box, [10, 20, 30, 60]);
  assert.deepEqual(foundIn([drawing([outline([-20, 20, 30, 600])])], AT, FRAME)[0]?.box, [0, 20, 10, 220], "within the frame");
  for (const other of [{ source: "follow" }, { captured_ns: "1000000000300000001" }, { captured_ns: "999999999699999999" }]) {
    assert.deepEqual(foundIn([drawing(shapes, other)], AT, FRAME), [], "of the target itself, or of another moment");
  }
});

test("of several that are pressed the smallest counts", () => {
  const found = foundIn([drawing([outline([0, 0, 100, 100]), said("car 0.9"), outline([20, 20, 20, 20]), said("person 0.50")])], AT, FRAME);
  assert.equal(foundAt(found, [25, 25])?.name, "person");
  assert.equal(foundAt(found, [60, 60])?.name, "car");
  assert.equal(foundAt(found, [101, 50]), null);
});

test("keys move and resize a box, which stays in the frame", () => {
  let box = nudged(null, [1, 0], false, FRAME);
  assert.deepEqual(box, [128, 72, 64, 96]);
  box = nudged(box, [1, 0], false, FRAME);
  assert.deepEqual(box, [134.4, 72, 64, 96]);
  const larger = nudged(box, [1, 0], true, FRAME);
  assert.ok(larger[2] > box[2] && larger[3] === box[3]);
  for (let press = 0; press < 200; press += 1) box = nudged(box, [1, 1], press % 2 === 0, FRAME);
  const [x, y, width, height] = box;
  assert.ok(x >= 0 && y >= 0 && x + width <= 320.001 && y + height <= 240.001, String(box));
  for (let press = 0; press < 200; press += 1) box = nudged(box, [-1, 1], true, FRAME);
  assert.ok(isLarge(box));
});

test("the panel lies below the box, or above it, and never beyond the view", () => {
  const [panel, view] = [{ width: 300, height: 100 }, { width: 800, height: 500 }];
  assert.deepEqual(beside([350, 100, 100, 100], panel, view), [250, 208]);
  assert.deepEqual(beside([0, 350, 40, 120], panel, view), [8, 242], "above");
  assert.deepEqual(beside([760, 0, 40, 500], panel, view), [492, 392], "over its lower edge");
  assert.deepEqual(beside([0, 0, 40, 40], panel, { width: 200, height: 90 }), [8, 8], "where there is no room at all");
});

test("what is not known is left out of the figures", () => {
  assert.equal(figures({ confidence: 0.914, range_m: 4.23, range_deviation_m: 0.51, lost_s: 0 }), "91 % · 4.2 m ± 0.5 m");
  assert.equal(figures({ confidence: null, range_m: 4.23, range_deviation_m: null, lost_s: 1.26 }), "4.2 m · not seen for 1.3 s");
  assert.equal(figures({}), "");
});

/** As much of an element as a panel uses. */
class FakeElement {
  hidden = false;
  disabled = false;
  textContent = "";
  value = "";
  valueAsNumber = Number.NaN;
  style = { setProperty: () => undefined };
  private readonly attributes = new Map<string, string>();
  private readonly listeners = new Map<string, (event: object) => void>();
  append(): void {}
  contains(other: unknown): boolean { return other === this; }
  closest(): null { return null; }
  focus(): void { Object.assign(document, { activeElement: this }); }
  getAttribute(name: string): string | null { return this.attributes.get(name) ?? null; }
  setAttribute(name: string, value: string): void {
    this.attributes.set(name, value);
    if (name === "hidden") this.hidden = true;
  }
  addEventListener(name: string, act: (event: object) => void): void { this.listeners.set(name, act); }
  tell(name: string, event: object = {}): void { this.listeners.get(name)?.(event); }
}

test("a second quick press on what was marked, under which the panel opens, flies nothing", (context) => {
  context.mock.timers.enable({ apis: ["setTimeout"] });
  const made: FakeElement[] = [];
  const createElement = (): FakeElement => (made.push(new FakeElement()), made.at(-1) as FakeElement);
  Object.assign(globalThis, { document: { activeElement: null, createElement } });
  const went: string[] = [];
  const panel = new FollowPanel({ go: (mode) => went.push(mode), stop: () => went.push("stop") });
  const follow = made.find((one) => one.getAttribute("data-mode") === "follow") as FakeElement;
  const distance = made.find((one) => one.getAttribute("type") === "number") as FakeElement;
  const press = (): void => (follow.disabled ? undefined : follow.tell("click"));
  panel.allow("");
  for (const round of [1, 2]) {
    panel.open(() => [0, 0]);
    context.mock.timers.tick(UNREAD_MS - 1);
    panel.allow("");
    press();
    distance.tell("keydown", { key: "Enter" });
    assert.equal(went.length, round - 1, "nobody can have read it by then");
    assert.equal(document.activeElement, panel.element);
    context.mock.timers.tick(1);
    assert.equal(document.activeElement, follow, "Enter follows");
    press();
    assert.deepEqual(went, Array(round).fill("follow"));
    panel.close();
  }
  panel.open(() => [0, 0]);
  panel.close();
  panel.allow("take control first");
  panel.open(() => [0, 0]);
  context.mock.timers.tick(UNREAD_MS);
  assert.ok(follow.disabled, "there is another reason");
  assert.equal(document.activeElement, panel.element);
});
