// A drone of the overview in words, for tiles, table and list alike. Pure.

import type { Tone } from "./dom.js";
import { named, t } from "./language/index.js";
import type { DroneRow } from "./model.js";
import { isRecording } from "./safety.js";
import { lengthText } from "./units.js";

export interface Described {
  tone: Tone;
  state: string;
  /** The holder of control. */
  holder: string;
  /** Its problems, the most severe first; empty if there are none. */
  alarm: string;
  alarmTone: Tone;
  /** Charge, 0 to 1; null while unknown. */
  battery: number | null;
  /** The links to the proxy and to the vehicle. */
  hops: readonly [Tone, Tone];
  links: string;
  /** It is a recording that is over: standing still is no fault. */
  over: boolean;
  lost: boolean;
}

const LINKS: Readonly<Record<string, Tone>> = { up: "ok", degraded: "warn", connecting: "busy", lost: "bad", closed: "bad" };

/** In the person's unit. */
export const height = (altitude_m: number | null): string => lengthText(altitude_m, 1);

/** Its name; for a replay, whose proxy has a number, the recording's. */
export function titleOf({ name, uri }: { name: string; uri: string }): string {
  const file = uri.startsWith("replay:") ? uri.split("?")[0]?.split("/").at(-1)?.replace(/\.mcap$/, "") : "";
  return file ? t.replay.of(decodeURIComponent(file)) : name;
}

export function describe(row: DroneRow): Described {
  const recorded = isRecording(row);
  const [application, vehicle] = [row.links.application, row.links.vehicle];
  const lost = application === "lost";
  const over = recorded && (lost || vehicle === "closed"); // every recording ends
  const critical = row.alarms.some((alarm) => alarm.severity === "critical");
  const flight = row.airborne && row.altitude !== null ? `${named(t.states, row.state)} · ${height(row.altitude)}` : vehicle === "connecting" && !lost && row.state === "unknown" ? t.waking : named(t.states, row.state);
  return {
    tone: over ? "quiet" : lost || critical ? "bad" : row.alarms.length ? "warn" : row.airborne ? "ok" : "quiet",
    state: over ? t.overview.over : lost ? t.overview.lost : flight,
    holder: recorded ? t.overview.recordedRow : row.owner === null ? t.overview.nobody : t.overview.holder(row.owner),
    alarm: over ? "" : row.alarms.map((alarm) => alarm.text).join(" · "),
    alarmTone: critical || lost ? "bad" : "warn",
    battery: lost ? null : row.battery,
    hops: over ? ["quiet", "quiet"] : [LINKS[application] ?? "quiet", LINKS[vehicle] ?? "quiet"],
    links: t.overview.links(named(t.linkStates, application), named(t.linkStates, vehicle)),
    over,
    lost,
  };
}

const natural = new Intl.Collator("en", { numeric: true });
/** By name, in numeric order: drone2 before drone10. */
export const byName = (a: { name: string }, b: { name: string }): number => natural.compare(a.name, b.name);

/** Whether every typed word appears in its row. */
export function found(row: DroneRow, search: string): boolean {
  const { state, holder, alarm } = describe(row);
  const text = [row.name, row.vehicle, state, holder, alarm].join(" ").toLowerCase();
  return search.toLowerCase().split(/\s+/).every((word) => text.includes(word));
}

export type Column = "name" | "state" | "altitude" | "battery" | "holder" | "alarm";

/** The rows sorted by a column; ties by name, and unknown values last in both directions. */
export function sorted(rows: readonly DroneRow[], column: Column, down: boolean): DroneRow[] {
  const value = (row: DroneRow): string | number | null => {
    if (column === "name") return row.name;
    if (column === "altitude" || column === "battery") return row[column];
    return describe(row)[column] || null;
  };
  const order = (a: DroneRow, b: DroneRow): number => {
    const [x, y] = [value(a), value(b)];
    if (x === null || y === null) return x === y ? byName(a, b) : x === null ? 1 : -1;
    const by = typeof x === "number" && typeof y === "number" ? x - y : natural.compare(String(x), String(y));
    return (down ? -by : by) || byName(a, b);
  };
  return [...rows].sort(order);
}
