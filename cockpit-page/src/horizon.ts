// The flight display: artificial horizon, speed and altitude beside it, heading below.
// Angles come in radians with REP 103's signs: roll positive right side down, pitch positive nose down.

import { setAttribute, setText, svg, unique } from "./dom.js";
import { degrees, figure, type Known, heading, headingText, plain } from "./format.js";
import { t } from "./language/index.js";
import type { State } from "./model.js";
import { unit } from "./units.js";

const PITCH = 3.1; // units of the drawing per degree of pitch
const [LEFT, RIGHT, TOP, BOTTOM] = [56, 264, 6, 186];
const [MID_X, MID_Y] = [(LEFT + RIGHT) / 2, (TOP + BOTTOM) / 2];
const DESCRIBED_MS = 2000; // interval between descriptions for screen readers

/** A scale that moves behind a mark. Its few labels are reused. */
class Tape {
  readonly group = svg("g", { class: "tape" });
  private readonly box: SVGTextElement;
  private readonly caption: SVGTextElement;
  private readonly labels: { text: SVGTextElement; line: SVGLineElement }[] = [];

  constructor(
    private readonly vertical: boolean,
    private readonly from: { x: number; y: number; width: number; height: number },
    private readonly step: number,
    private readonly unit_px: number,
    private readonly name: (value: number) => string,
    /** For lengths and speeds: the scale is in the person's units. */
    private readonly of: "length" | "speed" | null = null,
  ) {
    const { x, y, width, height } = from;
    const id = unique("tape");
    const marks = svg("g", { "clip-path": `url(#${id})` });
    for (let number = 0; number < 11; number += 1) {
      const one = { text: svg("text", { "text-anchor": "middle", "dominant-baseline": "central" }), line: svg("line") };
      this.labels.push(one);
      marks.append(one.text, one.line);
    }
    const [midX, midY] = [x + width / 2, y + height / 2];
    const well = vertical
      ? { x: x + 1, y: midY - 12, width: width - 2, height: 24, rx: 4, class: "tape-box" }
      : { x: midX - 22, y: y + 1, width: 44, height: height - 2, rx: 4, class: "tape-box" };
    this.box = svg("text", { x: midX, y: midY + 0.5, class: "tape-value", "text-anchor": "middle", "dominant-baseline": "central" });
    this.caption = svg("text", { x: midX, y: y + height + 11, class: "tape-caption", "text-anchor": "middle" });
    this.group.append(
      svg("defs", {}, svg("clipPath", { id }, svg("rect", { x, y, width, height, rx: 5 }))),
      svg("rect", { x, y, width, height, rx: 5, class: "tape-well" }),
      marks,
      svg("rect", well),
      this.box,
      this.caption,
    );
  }

  /** `value` in SI units or degrees, shown in the person's units with this many decimals, or as `text`. */
  show(si: Known, decimals: number, text?: string): void {
    const { factor, name } = this.of ? unit(this.of) : { factor: 1, name: "" };
    const value = si === null || si === undefined ? si : si * factor;
    const [step, unit_px] = factor === 1 ? [this.step, this.unit_px] : [4 * this.step, this.unit_px / 4];
    setText(this.box, text ?? figure(value, decimals));
    setText(this.caption, name);
    this.group.classList.toggle("unknown", value === null || value === undefined);
    if (value === null || value === undefined) return;
    const { x, y, width, height } = this.from;
    const base = Math.round(value / step);
    this.labels.forEach(({ text: label, line }, number) => {
      const at = (base + number - 5) * step;
      const away = (at - value) * unit_px;
      const [px, py] = this.vertical ? [x + width / 2, y + height / 2 - away] : [x + width / 2 + away, y + height / 2];
      label.setAttribute("transform", `translate(${px.toFixed(1)} ${py.toFixed(1)})`);
      setText(label, this.name(at));
      const half = (step * unit_px) / 2; // one line between two labels
      const ends = this.vertical ? [x + width / 2 - 5, py - half, x + width / 2 + 5, py - half] : [px + half, y + height / 2 - 4, px + half, y + height / 2 + 4];
      ["x1", "y1", "x2", "y2"].forEach((key, place) => line.setAttribute(key, (ends[place] as number).toFixed(1)));
    });
  }
}

const POINTS: Readonly<Record<number, string>> = { 0: "N", 90: "E", 180: "S", 270: "W" };

function compassName(value: number): string {
  const at = ((Math.round(value) % 360) + 360) % 360;
  return POINTS[at] ?? String(at);
}

export class Horizon {
  readonly element: SVGSVGElement;
  private readonly roll = svg("g", { class: "roll" });
  private readonly pitch = svg("g", { class: "pitch" });
  private readonly pointer = svg("path", { class: "roll-pointer", d: `M${MID_X} ${TOP + 13} l5 9 h-10 z` });
  private readonly speed: Tape;
  private readonly altitude: Tape;
  private readonly heading: Tape;
  private described_ms = Number.NEGATIVE_INFINITY;

  constructor() {
    const glass = unique("glass");
    const sky = svg("rect", { class: "sky", x: -600, y: -900, width: 1200, height: 900 });
    const ground = svg("rect", { class: "ground", x: -600, y: 0, width: 1200, height: 900 });
    this.pitch.append(sky, ground, svg("line", { class: "horizon-line", x1: -600, x2: 600, y1: 0, y2: 0 }), ...ladder());
    this.roll.append(this.pitch);
    const box = { x: LEFT, y: TOP, width: RIGHT - LEFT, height: BOTTOM - TOP, rx: 8 };
    const middle = svg("g", { transform: `translate(${MID_X} ${MID_Y})` }, this.roll);
    this.speed = new Tape(true, { x: 0, y: TOP, width: 50, height: BOTTOM - TOP }, 0.5, 64, plain, "speed");
    this.altitude = new Tape(true, { x: 270, y: TOP, width: 50, height: BOTTOM - TOP }, 0.5, 64, plain, "length");
    this.heading = new Tape(false, { x: LEFT, y: BOTTOM + 6, width: RIGHT - LEFT, height: 24 }, 15, 2.4, compassName);
    this.element = svg(
      "svg",
      { class: "horizon", viewBox: "0 0 320 218", role: "img", "aria-label": t.instruments.horizonUnknown },
      svg("defs", {}, svg("clipPath", { id: glass }, svg("rect", box))),
      svg("g", { "clip-path": `url(#${glass})` }, middle, ...rollScale(), this.pointer),
      svg("path", { class: "own", d: `M${MID_X - 58} ${MID_Y} h34 l7 9 M${MID_X + 58} ${MID_Y} h-34 l-7 9` }),
      svg("circle", { class: "own-dot", cx: MID_X, cy: MID_Y, r: 2.8 }),
      this.speed.group,
      this.altitude.group,
      this.heading.group,
    );
  }

  update(state: State | null): void {
    const { roll = null, pitch = null, yaw = null } = state?.attitude ?? {};
    const known = roll !== null && pitch !== null;
    this.element.classList.toggle("unknown", !known);
    if (known) {
      this.roll.setAttribute("transform", `rotate(${(-degrees(roll)).toFixed(2)})`);
      this.pitch.setAttribute("transform", `translate(0 ${(-degrees(pitch) * PITCH).toFixed(2)})`);
      this.pointer.setAttribute("transform", `rotate(${(-degrees(roll)).toFixed(2)} ${MID_X} ${MID_Y})`);
    }
    this.speed.show(state?.speed, 1);
    this.altitude.show(state?.altitude, 2);
    this.heading.show(yaw === null ? null : heading(yaw), 0, headingText(yaw));
    this.describe(roll, pitch, yaw);
  }

  /** For screen readers, at a bounded rate. */
  private describe(roll: number | null, pitch: number | null, yaw: number | null): void {
    const now = performance.now();
    if (now - this.described_ms < DESCRIBED_MS) return;
    this.described_ms = now;
    const tilt =
      roll === null || pitch === null
        ? t.instruments.attitudeUnknown
        : t.instruments.tilted(roll >= 0, figure(Math.abs(degrees(roll)), 0), pitch > 0, figure(Math.abs(degrees(pitch)), 0));
    setAttribute(this.element, "aria-label", t.instruments.horizon(tilt, yaw === null ? t.instruments.notKnown : headingText(yaw)));
  }
}

function ladder(): SVGElement[] {
  const marks: SVGElement[] = [];
  for (const angle of [-40, -30, -20, -10, 10, 20, 30, 40]) {
    const y = -angle * PITCH;
    marks.push(svg("line", { class: "rung", x1: -26, x2: 26, y1: y, y2: y }));
    for (const x of [-36, 36]) marks.push(svg("text", { class: "rung-text", x, y, "text-anchor": "middle", "dominant-baseline": "central" }, String(Math.abs(angle))));
  }
  for (const angle of [-15, -5, 5, 15]) marks.push(svg("line", { class: "rung", x1: -12, x2: 12, y1: -angle * PITCH, y2: -angle * PITCH }));
  return marks;
}

function rollScale(): SVGElement[] {
  return [-60, -45, -30, -20, -10, 0, 10, 20, 30, 45, 60].map((angle) =>
    svg("line", { class: "roll-mark", x1: MID_X, x2: MID_X, y1: TOP + (angle % 30 === 0 ? 3 : 6), y2: TOP + 11, transform: `rotate(${angle} ${MID_X} ${MID_Y})` }),
  );
}
