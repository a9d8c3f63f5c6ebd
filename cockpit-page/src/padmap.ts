// The functions of a gamepad's sticks and buttons, remembered by its id. Pure except for the store.

import type { Sticks } from "./model.js";
import type { Values } from "./settings.js";
import { type Axis, DEAD_BAND, STICK_MODES } from "./sticks.js";

export type PadDeed = "stop" | "takeoff" | "hover" | "land" | "take" | "release";

/** An axis of the gamepad (right and down are positive) and its direction. */
export interface Source {
  axis: number;
  sign: 1 | -1;
}

/** Nothing within `deadZone`; `expo` from 0, a straight line, to 1, a cube: fine near the centre. */
export interface Curve {
  deadZone: number;
  expo: number;
}

export interface PadMap {
  /** Null: by the stick mode, on a gamepad with the standard layout. */
  sources: Readonly<Record<Axis, Source | null>> | null;
  curves: Readonly<Record<Axis, Curve>>;
  /** All of an action's buttons pressed together; none: not on this gamepad. */
  buttons: Readonly<Record<PadDeed, readonly number[]>>;
}

export const AXES: readonly Axis[] = ["forward", "left", "up", "yaw_rate"];
export const PAD_DEEDS: readonly PadDeed[] = ["stop", "takeoff", "hover", "land", "take", "release"];
/** Without a dead zone a worn stick would never be at rest. */
export const DEAD_ZONES = { minimum: 0.05, maximum: 0.5 } as const;
const MOST = 64; // axes and buttons of a gamepad
const MOVED = 0.6; // a smaller movement of an axis may be an accident

const CURVE: Curve = { deadZone: DEAD_BAND, expo: 0 };
export const STANDARD_MAP: PadMap = {
  sources: null,
  curves: { forward: CURVE, left: CURVE, up: CURVE, yaw_rate: CURVE },
  buttons: { stop: [4, 5], takeoff: [9], hover: [0], land: [1], take: [], release: [] },
};

/** The axes of a standard gamepad (https://w3c.github.io/gamepad/#remapping): 0, 1 the left stick, 2, 3 the right one. */
export function sourcesOf(mode: Values["mode"]): Record<Axis, Source> {
  const { left, right } = STICK_MODES[mode];
  const sources = {} as Record<Axis, Source>;
  [left.x, left.y, right.x, right.y].forEach((flies, axis) => (sources[flies] = { axis, sign: -1 }));
  return sources;
}

/** Input and output from −1 to 1. */
export function shaped(value: number, { deadZone, expo }: Curve): number {
  if (!Number.isFinite(value)) return 0;
  const size = Math.min(1, Math.abs(value));
  if (size <= deadZone) return 0;
  const beyond = (size - deadZone) / (1 - deadZone);
  return Math.sign(value) * ((1 - expo) * beyond + expo * beyond ** 3);
}

export function sticksOf(axes: readonly number[], sources: Readonly<Record<Axis, Source | null>>, curves: PadMap["curves"]): Sticks {
  const of = (name: Axis): number => {
    const source = sources[name];
    return source ? shaped(source.sign * (axes[source.axis] ?? 0), curves[name]) : 0;
  };
  return { forward: of("forward"), left: of("left"), up: of("up"), yaw_rate: of("yaw_rate") };
}

/** With this axis for that direction; the direction that had it gets the axis that becomes free. */
export function withSource(sources: Readonly<Record<Axis, Source | null>>, name: Axis, source: Source): Record<Axis, Source | null> {
  const changed = { ...sources, [name]: source };
  for (const other of AXES) if (other !== name && sources[other]?.axis === source.axis) changed[other] = sources[name];
  return changed;
}

/** With these buttons for that action, taken from others; null if one belongs to the emergency stop, which keeps its own. */
export function withButtons(buttons: PadMap["buttons"], deed: PadDeed, pressed: readonly number[]): PadMap["buttons"] | null {
  if (deed !== "stop" && pressed.some((button) => buttons.stop.includes(button))) return null;
  const changed = { ...buttons };
  for (const other of PAD_DEEDS) if (changed[other].some((button) => pressed.includes(button))) changed[other] = [];
  return { ...changed, [deed]: pressed };
}

/** The axis that moved furthest from its start, if far enough to be on purpose. */
export function movedAxis(rest: readonly number[], axes: readonly number[]): Source | null {
  let [most, found] = [MOVED, null as Source | null];
  axes.forEach((value, axis) => {
    const moved = value - (rest[axis] ?? 0);
    if (Math.abs(moved) > most) [most, found] = [Math.abs(moved), { axis, sign: moved > 0 ? 1 : -1 }];
  });
  return found;
}

/** Collects the buttons pressed together, until all are released. */
export class Chord {
  private readonly held = new Set<number>();
  private free = false;

  /** Called with the buttons pressed now; returns them all once none is left. */
  update(pressed: readonly number[]): number[] | null {
    if (!this.free) {
      this.free = pressed.length === 0; // buttons held before don't count
      return null;
    }
    for (const button of pressed) this.held.add(button);
    return pressed.length === 0 && this.held.size > 0 ? [...this.held].sort((a, b) => a - b) : null;
  }
}

/** The stored map, or null if it is invalid: other writers of the storage can't inject anything strange. */
export function parsed(text: string | null): PadMap | null {
  try {
    const { sources, curves, buttons } = JSON.parse(text ?? "") as PadMap;
    const isIndex = (value: unknown): boolean => Number.isInteger(value) && (value as number) >= 0 && (value as number) < MOST;
    const isSource = (one: Source | null): boolean => one === null || (isIndex(one.axis) && (one.sign === 1 || one.sign === -1));
    const isCurve = ({ deadZone, expo }: Curve): boolean => deadZone >= DEAD_ZONES.minimum && deadZone <= DEAD_ZONES.maximum && expo >= 0 && expo <= 1;
    const good = (sources === null || AXES.every((name) => isSource(sources[name]))) && AXES.every((name) => isCurve(curves[name]))
      && PAD_DEEDS.every((deed) => Array.isArray(buttons[deed]) && buttons[deed].every(isIndex));
    return good ? { sources, curves, buttons } : null;
  } catch {
    return null;
  }
}

interface Store {
  get(name: string): string | null;
  set(name: string, value: string): void;
}

/** The maps remembered by this browser. */
export class PadMaps {
  private readonly known = new Map<string, PadMap | null>();

  constructor(private readonly store: Store) {}

  /** Null: the default. */
  get(id: string): PadMap | null {
    if (!this.known.has(id)) this.known.set(id, parsed(this.store.get(`gamepad ${id}`)));
    return this.known.get(id) ?? null;
  }

  set(id: string, map: PadMap | null): void {
    this.known.set(id, map);
    this.store.set(`gamepad ${id}`, JSON.stringify(map));
  }
}
