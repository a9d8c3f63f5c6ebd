// The map of keys. By position on the keyboard, not by letter, so that it is the same on every layout.

import { t } from "./language/index.js";
import type { Sticks } from "./model.js";
import { type Axis, CENTRED } from "./sticks.js";

export type Deed = "takeoff" | "hover" | "land" | "return" | "take" | "release" | "question" | "follow" | "help";

const STICKS: Readonly<Record<string, [Axis, 1 | -1]>> = {
  KeyW: ["forward", 1],
  KeyS: ["forward", -1],
  KeyA: ["left", 1],
  KeyD: ["left", -1],
  ArrowUp: ["up", 1],
  ArrowDown: ["up", -1],
  ArrowLeft: ["yaw_rate", 1],
  ArrowRight: ["yaw_rate", -1],
};

/** Browsers on macOS do not report key releases while Cmd is held. */
const COMMAND = /^(Meta|OS)(Left|Right)$/;

const DEEDS: Readonly<Record<string, Deed>> = {
  KeyT: "takeoff",
  KeyH: "hover",
  KeyL: "land",
  KeyB: "return",
  KeyC: "take",
  KeyR: "release",
  KeyQ: "question",
  KeyF: "follow",
  Slash: "help",
};

export const KEY_MAP: readonly { keys: string[]; does: string }[] = [
  { keys: [t.keys.ctrl, t.keys.enter], does: t.keys.stop },
  { keys: [t.keys.ctrl, t.keys.shift, t.keys.enter], does: t.keys.stopAll },
  { keys: ["C"], does: t.keys.take },
  { keys: ["R"], does: t.keys.release },
  { keys: ["Q"], does: t.keys.question },
  { keys: ["T"], does: t.keys.takeOff },
  { keys: ["H"], does: t.keys.hover },
  { keys: ["L"], does: t.keys.land },
  { keys: ["B"], does: t.keys.back },
  { keys: ["F"], does: t.keys.follow },
  { keys: ["W", "S"], does: t.keys.along },
  { keys: ["A", "D"], does: t.keys.across },
  { keys: ["↑", "↓"], does: t.keys.vertical },
  { keys: ["←", "→"], does: t.keys.turn },
  { keys: [t.keys.tab], does: t.keys.map },
  { keys: ["?"], does: t.keys.list },
];

export interface Press {
  code: string;
  repeat: boolean;
  /** With Ctrl, Alt or Meta: left to the browser. */
  modified: boolean;
  /** Whether the focused element uses letters and arrows itself: a text field, a list. */
  typing: boolean;
}

export const isEnter = (code: string): boolean => code === "Enter" || code === "NumpadEnter";

/** Ctrl and Enter, held: motors off, whatever has the focus. With Shift, of all drones; null: another key. */
export function stopKeys(event: { code: string; ctrlKey: boolean; shiftKey: boolean; altKey: boolean; metaKey: boolean }): "one" | "all" | null {
  if (!event.ctrlKey || event.altKey || event.metaKey) return null;
  if (!isEnter(event.code)) return null;
  return event.shiftKey ? "all" : "one";
}

/** The keys held, and the meaning of single presses. */
export class Keys {
  /** Counts presses of keys. */
  touches = 0;
  private readonly held = new Set<string>();

  /** The meaning of a press: an action, "stick" for one that flies, or null. */
  down(press: Press): Deed | "stick" | null {
    if (COMMAND.test(press.code)) this.clear();
    if (press.modified || press.typing) return null;
    if (press.code in STICKS) {
      this.touches += 1;
      if (!press.repeat) this.held.add(press.code); // once cleared, a key counts when it is pressed again
      return "stick";
    }
    return press.repeat ? null : (DEEDS[press.code] ?? null);
  }

  up(code: string): void {
    if (COMMAND.test(code)) this.clear();
    this.held.delete(code);
  }

  /** The page lost the focus: releases from now on are not seen. */
  clear(): void {
    this.held.clear();
  }

  sticks(): Sticks {
    const sticks = { ...CENTRED };
    for (const code of this.held) {
      const [axis, sign] = STICKS[code] as [Axis, 1 | -1];
      sticks[axis] += sign;
    }
    return sticks;
  }
}
