// A replay's time: its position, its marks, and the flight before it. Pure.

import type { State } from "./model.js";

/** A replay's position, from its state. */
export interface Playback {
  position_s: number;
  duration_s: number;
  speed: number;
  paused: boolean;
  /** Changes when the position changed other than by playing. */
  jumps: number;
}

export interface Mark {
  at_s: number;
  text: string;
}

export interface Tick extends Mark {
  kind: "own" | "mark" | "event" | "alarm";
}

export interface Timeline {
  events: { at_s: number; kind: string; severity: string; text: string }[];
  marks: Mark[];
  times: number[];
  track: ([number, number, number] | null)[];
  values: Record<string, (number | null)[]>;
}

/** The cockpit's data on the recording of a replay. */
export interface Replayed {
  recording: string;
  notes: { text: string; marks: Mark[] };
  timeline: Timeline;
}

export const SPEEDS: readonly number[] = [0.25, 0.5, 1, 2, 4, 8];

const NAME = "native.replay.";

/** Null for other drones, or a replay by an older proxy. */
export function playbackOf(values: State["values"]): Playback | null {
  const value = (name: string): number | null => values[NAME + name] ?? null;
  const [position_s, duration_s, speed] = [value("position_s"), value("duration_s"), value("speed")];
  if (position_s === null || duration_s === null || speed === null) return null;
  return { position_s, duration_s, speed, paused: value("paused") === 1, jumps: value("jumps") ?? 0 };
}

/** Changes where the recorded surroundings may: with each jump, and each second of the recording. */
export const momentOf = ({ jumps, position_s }: Playback): string => `${jumps} ${Math.floor(position_s)}`;

export const clamped = (position_s: number, duration_s: number): number => Math.min(duration_s, Math.max(0, position_s));

/** Everything shown on the bar, by time. */
export function ticksOf({ notes, timeline }: Replayed): Tick[] {
  const events = timeline.events.map(({ at_s, severity, text }): Tick => ({ at_s, text, kind: severity === "info" ? "event" : "alarm" }));
  const marks = timeline.marks.map((mark): Tick => ({ ...mark, kind: "mark" }));
  const own = notes.marks.map((mark): Tick => ({ ...mark, kind: "own" }));
  return [...events, ...marks, ...own].sort((one, other) => one.at_s - other.at_s);
}

/** The tick meant by a finger, if one is near enough; marks come before events. */
export function nearest(ticks: readonly Tick[], at_s: number, within_s: number): Tick | null {
  const weight = (tick: Tick): number => Math.abs(tick.at_s - at_s) + (tick.kind === "event" ? within_s / 2 : 0);
  const near = ticks.filter((tick) => Math.abs(tick.at_s - at_s) <= within_s);
  return near.reduce<Tick | null>((best, tick) => (best === null || weight(tick) < weight(best) ? tick : best), null);
}

/** The next mark or event on one side; null if there is none. `apart_s`: nearer ones count as the present position. */
export function next(ticks: readonly Tick[], at_s: number, side: 1 | -1, apart_s: number): Tick | null {
  const beyond = ticks.filter((tick) => (tick.at_s - at_s) * side > apart_s);
  return (side > 0 ? beyond[0] : beyond.at(-1)) ?? null;
}

/** By how much a key moves the position [s]; Infinity for the ends; null for other keys. */
export function step(key: string, shift: boolean): number | null {
  const steps: Readonly<Record<string, number>> = { ArrowLeft: -1, ArrowDown: -1, ArrowRight: 1, ArrowUp: 1, PageDown: -10, PageUp: 10, Home: -Infinity, End: Infinity };
  const found = steps[key];
  return found === undefined ? null : shift && Math.abs(found) === 1 ? found / 10 : found;
}

/** Minutes, seconds and tenths. */
export function fine(seconds: number): string {
  const tenths = Math.round(seconds * 10);
  return `${Math.floor(tenths / 600)}:${String(Math.floor(tenths / 10) % 60).padStart(2, "0")}.${tenths % 10}`;
}

export interface Past {
  at_s: number;
  values: Record<string, number | null>;
  place: readonly [number, number, number] | null;
}

/** The flight up to a position, as far back as is kept: for plots and trail after a jump. */
export function before({ times, track, values }: Timeline, position_s: number, kept_s: number): Past[] {
  const found: Past[] = [];
  times.forEach((at_s, row) => {
    if (at_s > position_s || at_s < position_s - kept_s) return;
    const then = Object.fromEntries(Object.entries(values).map(([name, column]) => [name, column[row] ?? null]));
    found.push({ at_s, values: then, place: track[row] ?? null });
  });
  return found;
}
