// A gamepad, read once per round. Pure but for `plugged`.

import type { Deed } from "./keys.js";
import type { Sticks } from "./model.js";
import { PAD_DEEDS, type PadDeed, type PadMap, type PadMaps, type Source, sourcesOf, STANDARD_MAP, sticksOf } from "./padmap.js";
import type { Values } from "./settings.js";
import { type Axis, CENTRED, Latch } from "./sticks.js";

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
  /** The buttons of the emergency stop are pressed, which is to be held. */
  stops: boolean;
  /** It was there a moment ago. */
  lost: boolean;
}

/** The gamepads that are there: the one that flies first. */
export function plugged(): Pad[] {
  // Without a secure context there may be no such function.
  return (navigator.getGamepads?.() ?? []).filter((pad): pad is Gamepad => pad?.connected ?? false).sort((a, b) => Number(b.mapping === "standard") - Number(a.mapping === "standard"));
}

/** What its axes fly: as they were assigned, else by the mode if browsers know its layout, else nothing. */
export function sources(pad: Pad, map: PadMap, mode: Values["mode"]): Readonly<Record<Axis, Source | null>> {
  const none = { forward: null, left: null, up: null, yaw_rate: null };
  return map.sources ?? (pad.mapping === "standard" ? sourcesOf(mode) : none);
}

export const pressedOf = (pad: Pad): number[] => pad.buttons.flatMap(({ pressed }, button) => (pressed ? [button] : []));

export class GamepadReader {
  private readonly latch = new Latch();
  private before: PadDeed[] = [];
  private there = false;

  constructor(private readonly maps: Pick<PadMaps, "get">) {}

  /** Ask for centred sticks before they count, as when control begins. */
  reset(): void {
    this.latch.reset();
  }

  read(pad: Pad | null, mode: Values["mode"]): PadReading {
    const map = pad && (this.maps.get(pad.id) ?? (pad.mapping === "standard" ? STANDARD_MAP : null));
    const lost = pad === null && this.there;
    this.there = pad !== null;
    if (pad === null || map === null) {
      this.before = [];
      this.latch.reset();
      return { sticks: { ...CENTRED }, deeds: [], name: null, stops: false, lost };
    }
    const pressed = PAD_DEEDS.filter((deed) => map.buttons[deed].length > 0 && map.buttons[deed].every((button) => pad.buttons[button]?.pressed));
    const deeds = pressed.filter((deed): deed is Exclude<PadDeed, "stop"> => deed !== "stop" && !this.before.includes(deed));
    this.before = pressed;
    const sticks = sticksOf(pad.axes, sources(pad, map, mode), map.curves);
    return { sticks: this.latch.pass(sticks), deeds, name: pad.id, stops: pressed.includes("stop"), lost: false };
  }
}
