// A gamepad, read once per round. Pure but for `plugged`.

import type { Deed } from "./keys.js";
import type { Sticks } from "./model.js";
import { PAD_DEEDS, type PadDeed, type PadMap, type PadMaps, type Source, sourcesOf, STANDARD_MAP, sticksOf } from "./padmap.js";
import type { Values } from "./settings.js";
import { type Axis, CENTRED, Latch } from "./sticks.js";

/** The part of a Gamepad that is read. */
export interface Pad {
  id: string;
  index?: number | undefined;
  mapping: string;
  connected: boolean;
  axes: readonly number[];
  buttons: readonly { pressed: boolean }[];
}

export interface PadReading {
  sticks: Sticks;
  deeds: Deed[];
  /** The gamepad's name; null without a gamepad. */
  name: string | null;
  /** The buttons of the emergency stop are pressed; it must be held. */
  stops: boolean;
  /** The gamepad that was there a moment ago is gone or was replaced. */
  lost: boolean;
  /** Counts movements by hands. */
  touches: number;
}

/** The connected gamepads, the one that flies first. */
export function plugged(): Pad[] {
  // Without a secure context this function may be missing.
  return (navigator.getGamepads?.() ?? []).filter((pad): pad is Gamepad => pad?.connected ?? false).sort((a, b) => Number(b.mapping === "standard") - Number(a.mapping === "standard"));
}

/** The axes that fly each direction: as assigned, or by the mode if browsers know the gamepad's layout, or none. */
export function sources(pad: Pad, map: PadMap, mode: Values["mode"]): Readonly<Record<Axis, Source | null>> {
  const none = { forward: null, left: null, up: null, yaw_rate: null };
  return map.sources ?? (pad.mapping === "standard" ? sourcesOf(mode) : none);
}

const isSame = (one: Pad | null, other: Pad | null): boolean => one?.id === other?.id && one?.index === other?.index;

/** The gamepad that flies: in flight no other one replaces it while it is connected. */
export const chosen = (pads: readonly Pad[], before: Pad | null, inFlight: boolean): Pad | null => (inFlight && pads.find((pad) => isSame(pad, before))) || (pads[0] ?? null);

export const pressedOf = (pad: Pad): number[] => pad.buttons.flatMap(({ pressed }, button) => (pressed ? [button] : []));

export class GamepadReader {
  /** As last read. */
  pad: Pad | null = null;
  private readonly latch = new Latch();
  private before: PadDeed[] | null = null;
  private touches = 0;

  constructor(private readonly maps: Pick<PadMaps, "get">) {}

  /** Require centred sticks and released buttons before they count, as when control begins. */
  reset(): void {
    this.latch.reset();
    this.before = null;
  }

  read(pad: Pad | null, mode: Values["mode"]): PadReading {
    const map = pad && (this.maps.get(pad.id) ?? (pad.mapping === "standard" ? STANDARD_MAP : null));
    const { pad: last } = this;
    const lost = last !== null && !isSame(pad, last);
    if (pad?.axes.some((value, axis) => value !== last?.axes[axis])) this.touches += 1;
    this.pad = pad && { id: pad.id, index: pad.index, mapping: pad.mapping, connected: true, axes: [...pad.axes], buttons: [] };
    if (lost || pad === null || map === null) this.reset();
    if (pad === null || map === null) return { sticks: { ...CENTRED }, deeds: [], name: null, stops: false, lost, touches: this.touches };
    const pressed = PAD_DEEDS.filter((deed) => map.buttons[deed].length > 0 && map.buttons[deed].every((button) => pad.buttons[button]?.pressed));
    // Browsers reveal a gamepad at its first press, which therefore only means "here I am". The emergency stop must be held anyway.
    const { before } = this;
    const deeds = pressed.filter((deed): deed is Exclude<PadDeed, "stop"> => deed !== "stop" && before !== null && !before.includes(deed));
    this.before = pressed;
    const sticks = this.latch.pass(sticksOf(pad.axes, sources(pad, map, mode), map.curves));
    return { sticks, deeds, name: pad.id, stops: pressed.includes("stop"), lost, touches: this.touches };
  }
}
