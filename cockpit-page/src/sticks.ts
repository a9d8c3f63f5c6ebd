// From keys, gamepad and thumbs to one set of sticks. Pure.
//
// Body axes as in Skyloop: forward, left, up, counter-clockwise; each from −1 to 1 until scaled.

import { t } from "./language/index.js";
import type { Sticks } from "./model.js";

export const CENTRED: Readonly<Sticks> = { forward: 0, left: 0, up: 0, yaw_rate: 0 };
/** Share of the full deflection that counts as centred. */
export const DEAD_BAND = 0.12;
/** Time for keys to go from nothing to full [s]: a tap is a nudge. */
export const RAMP_S = 0.3;

const AXES = ["forward", "left", "up", "yaw_rate"] as const;

export type Axis = keyof Sticks;

/** The direction flown by each axis of two sticks, in the modes of remote controls: up and right are positive. */
export const STICK_MODES: Readonly<Record<"1" | "2" | "3" | "4", Readonly<Record<"left" | "right", { x: "left" | "yaw_rate"; y: "forward" | "up" }>>>> = {
  "1": { left: { x: "yaw_rate", y: "forward" }, right: { x: "left", y: "up" } },
  "2": { left: { x: "yaw_rate", y: "up" }, right: { x: "left", y: "forward" } },
  "3": { left: { x: "left", y: "forward" }, right: { x: "yaw_rate", y: "up" } },
  "4": { left: { x: "left", y: "up" }, right: { x: "yaw_rate", y: "forward" } },
};

/** Nothing within the band, the full range beyond it: the output has no step at its edge. */
export function deadBand(value: number, band: number = DEAD_BAND): number {
  if (!Number.isFinite(value)) return 0;
  const size = Math.min(1, Math.abs(value));
  return size <= band ? 0 : (Math.sign(value) * (size - band)) / (1 - band);
}

export const isCentred = (sticks: Sticks): boolean => AXES.every((axis) => sticks[axis] === 0);

/** Of several inputs, the one pushed furthest, axis by axis. */
export function merge(...inputs: Sticks[]): Sticks {
  const merged = { ...CENTRED };
  for (const input of inputs) {
    for (const axis of AXES) if (Math.abs(input[axis]) > Math.abs(merged[axis])) merged[axis] = input[axis];
  }
  return merged;
}

/** Towards `wanted` within `seconds`; back to the centre, and across it, at once. */
export function ramp(now: Sticks, wanted: Sticks, seconds: number): Sticks {
  const next = { ...wanted };
  for (const axis of AXES) {
    const [from, to] = [now[axis] * wanted[axis] > 0 ? now[axis] : 0, wanted[axis]];
    if (Math.abs(to) > Math.abs(from)) next[axis] = Math.sign(to) * Math.min(Math.abs(to), Math.abs(from) + seconds / RAMP_S);
  }
  return next;
}

export interface Pace {
  name: string;
  /** Horizontal [m/s]. */
  speed: number;
  /** Vertical [m/s]. */
  climb: number;
  /** Yaw rate [rad/s]. */
  turn: number;
}

export const PACES: readonly Pace[] = [
  { name: t.help.gentle, speed: 0.4, climb: 0.3, turn: 0.6 },
  { name: t.help.normal, speed: 0.8, climb: 0.5, turn: 1.0 },
  { name: t.help.brisk, speed: 1.6, climb: 0.8, turn: 1.6 },
];

/** Sticks as a velocity: [m/s] and [rad/s]. */
export function scale(sticks: Sticks, pace: Pace): Sticks {
  return {
    forward: sticks.forward * pace.speed,
    left: sticks.left * pace.speed,
    up: sticks.up * pace.climb,
    yaw_rate: sticks.yaw_rate * pace.turn,
  };
}

/** A stick pushed while it does not count (for another drone, before control, on a hidden page) must be centred before it counts. */
export class Latch {
  private open = false;

  /** Require the centre again. */
  reset(): void {
    this.open = false;
  }

  pass(sticks: Sticks, counts = true): Sticks {
    this.open = isCentred(sticks) || (this.open && counts);
    return counts && this.open ? sticks : { ...CENTRED };
  }
}

/** The hands on one drone. Each drone has its own, read each round, whether it is flown or not. */
export class Hands {
  private readonly latches = { keys: new Latch(), pad: new Latch(), thumbs: new Latch() };
  private ramped: Sticks = { ...CENTRED };

  /** Require everything to be centred again. */
  rest(): void {
    for (const latch of Object.values(this.latches)) latch.reset();
  }

  /** `counts`: this drone is the selected one, under control, and the page is visible. */
  read(keys: Sticks, pad: Sticks, thumbs: Sticks, counts: boolean, seconds: number): Sticks {
    const { latches } = this;
    this.ramped = ramp(this.ramped, latches.keys.pass(keys, counts), seconds);
    return merge(this.ramped, latches.pad.pass(pad, counts), latches.thumbs.pass(thumbs, counts));
  }
}
