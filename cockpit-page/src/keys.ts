// The map of keys. By place on the keyboard, not by letter: the same on every layout.

import type { Sticks } from "./model.js";
import { CENTRED } from "./sticks.js";

export type Deed = "takeoff" | "hover" | "land" | "stop" | "take" | "release" | "question" | "help";

type Axis = keyof Sticks;

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

const DEEDS: Readonly<Record<string, Deed>> = {
  KeyT: "takeoff",
  KeyH: "hover",
  KeyL: "land",
  KeyC: "take",
  KeyR: "release",
  KeyQ: "question",
  Slash: "help",
};

/** Two presses of Escape within this time cut the motors [ms]. The first one hovers. */
export const TWICE_MS = 1000;

export const KEY_MAP: readonly { keys: string[]; does: string }[] = [
  { keys: ["Esc", "Esc"], does: "Motors off, at once. The first Esc hovers." },
  { keys: ["C"], does: "Take control" },
  { keys: ["R"], does: "Release, or stop waiting for control" },
  { keys: ["Q"], does: "To the question of who asks for control" },
  { keys: ["T"], does: "Take off" },
  { keys: ["H"], does: "Hover" },
  { keys: ["L"], does: "Land" },
  { keys: ["W", "S"], does: "Forward, back" },
  { keys: ["A", "D"], does: "Left, right" },
  { keys: ["↑", "↓"], does: "Up, down" },
  { keys: ["←", "→"], does: "Turn left, right" },
  { keys: ["?"], does: "This list" },
];

export const GAMEPAD_MAP: readonly { keys: string[]; does: string }[] = [
  { keys: ["LB", "RB"], does: "Both together: motors off" },
  { keys: ["Start"], does: "Take off" },
  { keys: ["A"], does: "Hover" },
  { keys: ["B"], does: "Land" },
  { keys: ["Right stick"], does: "Forward, back, left, right" },
  { keys: ["Left stick"], does: "Up, down, turn" },
];

export interface Press {
  code: string;
  repeat: boolean;
  /** With Ctrl, Alt or Meta: the browser's own. */
  modified: boolean;
  /** What has the focus takes letters and arrows itself: a text field, a list. */
  typing: boolean;
  at_ms: number;
}

/** Keys that are held, and what single presses mean. */
export class Keys {
  private readonly held = new Set<string>();
  private escaped_ms = Number.NEGATIVE_INFINITY;

  /** What a press means: a deed, "stick" for one that flies, or null. */
  down(press: Press): Deed | "stick" | null {
    if (press.code === "Escape") {
      if (press.repeat) return null;
      const twice = press.at_ms - this.escaped_ms <= TWICE_MS;
      this.escaped_ms = press.at_ms;
      return twice ? "stop" : "hover";
    }
    if (press.modified || press.typing) return null;
    if (press.code in STICKS) {
      this.held.add(press.code);
      return "stick";
    }
    return press.repeat ? null : (DEEDS[press.code] ?? null);
  }

  up(code: string): void {
    this.held.delete(code);
  }

  /** The page lost the focus: releases that come now are not seen. */
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
