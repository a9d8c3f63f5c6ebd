// A tool of the map: it draws over the map, and gets presses and keys with places in metres. One is in use at a time.

import type { Body } from "./world.js";

/** From metres in world axes to pixels of the map; heights are ignored. */
export type Project = (place: readonly number[]) => [number, number];

/** The page's colours by name. */
export type Ink = Readonly<Record<string, string>>;

/** A place on the map under a pointer or the keyboard's cursor. */
export interface Spot {
  /** East and north [m]. */
  place: [number, number];
  /** The place on the map [pixels]. */
  pixel: [number, number];
  /** Anything within this distance counts as under it [m]. */
  reach_m: number;
  /** The nearest drone or target under it; null if there is none. */
  under: Body | null;
}

export interface MapTool {
  /** The effect of a press now, in a few words: shown below the map. */
  readonly hint: string;
  draw(pen: CanvasRenderingContext2D, project: Project, ink: Ink): void;
  /** A pointer is pressed. True: its movements belong to the tool from now on, and the map keeps its view. */
  press(spot: Spot): boolean;
  /** A pointer taken by the tool moves. */
  move(spot: Spot): void;
  /** A pointer is released: one taken by the tool, or one pressed and released at the same place (`click`). */
  lift(spot: Spot, click: boolean): void;
  /** A key, while the map has the focus; the cursor is at `spot`. True: the tool used it, and the map ignores it. */
  key(event: KeyboardEvent, spot: Spot): boolean;
  /** The cursor of the keyboard has moved. */
  cursor?(spot: Spot): void;
  /** Another tool, or none, is in use from now on. */
  dropped?(): void;
}

/** Keys that the map uses while it has the focus; all others fly, as everywhere. */
export const MAP_KEYS: ReadonlySet<string> = new Set(["ArrowUp", "ArrowDown", "ArrowLeft", "ArrowRight", "Enter", "NumpadEnter", "Equal", "NumpadAdd", "Minus", "NumpadSubtract", "Digit0", "Delete", "Backspace"]);

const ARROWS: Readonly<Record<string, readonly [number, number]>> = { ArrowUp: [0, 1], ArrowDown: [0, -1], ArrowLeft: [-1, 0], ArrowRight: [1, 0] };

/** How far an arrow key moves the cursor, east and north, in steps; null for another key. */
export const arrow = (code: string): readonly [number, number] | null => ARROWS[code] ?? null;

/** The nearest thing to a place within a distance [m]; null if there is none. */
export function nearest<T extends { position: readonly number[] }>(place: readonly [number, number], reach_m: number, all: readonly T[]): T | null {
  let best: T | null = null;
  let least = reach_m;
  for (const one of all) {
    const off = Math.hypot((one.position[0] as number) - place[0], (one.position[1] as number) - place[1]);
    if (off > least) continue;
    [best, least] = [one, off];
  }
  return best;
}
