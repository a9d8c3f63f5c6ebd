// A gamepad of the standard mapping (https://w3c.github.io/gamepad/#remapping), read once per round. Pure but for
// `connected`.

import type { Deed } from "./keys.js";
import type { Sticks } from "./model.js";
import { CENTRED, deadBand, Latch } from "./sticks.js";

/** As much of a Gamepad as is read. */
export interface Pad {
  id: string;
  mapping: string;
  connected: boolean;
  axes: readonly number[];
  buttons: readonly { pressed: boolean }[];
}

export interface PadReading {
  sticks: Sticks;
  deeds: Deed[];
  /** Its name; null without one. */
  name: string | null;
  /** Both bumpers are pressed, which is to be held. */
  stops: boolean;
  /** It was there a moment ago. */
  lost: boolean;
}

const [A, B, LEFT_BUMPER, RIGHT_BUMPER, START] = [0, 1, 4, 5, 9];

/** The first gamepad that browsers know how to read. */
export function connected(): Pad | null {
  // Without a secure context there may be no such function.
  return navigator.getGamepads?.().find((pad) => pad?.connected && pad.mapping === "standard") ?? null;
}

export class GamepadReader {
  private readonly latch = new Latch();
  private before: Deed[] = [];
  private there = false;

  /** Ask for centred sticks before they count, as when control begins. */
  reset(): void {
    this.latch.reset();
  }

  read(pad: Pad | null): PadReading {
    const lost = pad === null && this.there;
    this.there = pad !== null;
    if (pad === null) {
      this.before = [];
      this.latch.reset();
      return { sticks: { ...CENTRED }, deeds: [], name: null, stops: false, lost };
    }
    const pressed = this.pressed(pad);
    const deeds = pressed.filter((deed) => !this.before.includes(deed));
    this.before = pressed;
    const axis = (number: number): number => deadBand(-(pad.axes[number] ?? 0));
    // Axes of sticks: right and down are positive.
    const sticks = { yaw_rate: axis(0), up: axis(1), left: axis(2), forward: axis(3) };
    for (const name of Object.keys(sticks) as (keyof Sticks)[]) sticks[name] += 0; // no negative zero
    return { sticks: this.latch.pass(sticks), deeds, name: pad.id, stops: this.is(pad, LEFT_BUMPER) && this.is(pad, RIGHT_BUMPER), lost: false };
  }

  private is(pad: Pad, button: number): boolean {
    return pad.buttons[button]?.pressed ?? false;
  }

  private pressed(pad: Pad): Deed[] {
    const is = (button: number): boolean => this.is(pad, button);
    const deeds: Deed[] = [];
    if (is(START)) deeds.push("takeoff");
    if (is(A)) deeds.push("hover");
    if (is(B)) deeds.push("land");
    return deeds;
  }
}
