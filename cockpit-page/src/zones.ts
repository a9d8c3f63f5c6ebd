// Editing of the safety box and no-fly zones: their text, their fields, their corners. Pure.

import { t } from "./language/index.js";
import type { Vector } from "./model.js";
import type { SafetyBox, World, Zone } from "./surroundings.js";

export const ZONES = "safety.zones";
export const MAX_ZONES = 32;
/** A wall of the safety box this far away counts as absent [m]: docs/proxy.md. */
export const FAR_M = 10_000;
/** The smallest extent of a zone. */
const LEAST_M = 0.05;

/** What is edited: the safety box, or the zone with a number. */
export type Edited = "box" | number;

export interface Field {
  label: string;
  value: number | null;
  /** The same with another value; the drone refuses nonsense, with its reason. */
  with: (value: number | null) => Bounds;
}

export interface Bounds {
  box: SafetyBox | null;
  zones: readonly Zone[];
}

export const boundsOf = (world: World | null): Bounds => ({ box: world?.box ?? null, zones: world?.zones ?? [] });

const cm = (value: number): number => Math.round(value * 100) / 100;

export function zoneText(zone: Zone, rounded = cm): string {
  const numbers = zone.kind === "box" ? [...zone.low, ...zone.high] : [...zone.centre, zone.radius, zone.low, zone.high];
  return `${zone.name ? `${zone.name}: ` : ""}${zone.kind} ${numbers.map(rounded).join(" ")}`;
}

/** A zone's name; without one as in refusals, by values to six digits. */
export const zoneName = (zone: Zone): string => zone.name || zoneText(zone, (value) => Number(value.toPrecision(6)));

/** The first unused name. */
export function freeName(zones: readonly Zone[]): string {
  let number = 1;
  while (zones.some((zone) => zone.name === `Z${number}`)) number += 1;
  return `Z${number}`;
}

export const zonesText = (zones: readonly Zone[]): string => zones.map((zone) => zoneText(zone)).join("; ");

/** The writes, in this order, to get from one state to the other: a wall never passes the opposite one. */
export function writes(from: Bounds, to: Bounds): { name: string; value: string | number }[] {
  const made: { name: string; value: string | number }[] = [];
  const text = zonesText(to.zones);
  if (text !== zonesText(from.zones)) made.push({ name: ZONES, value: text });
  const open: SafetyBox = { low: [null, null, null], high: [null, null, null] };
  const [before, after] = [from.box ?? open, to.box ?? open];
  ["x", "y", "z"].forEach((axis, place) => {
    const wall = (box: SafetyBox, end: "low" | "high"): number => box[end][place] ?? (end === "low" ? -FAR_M : FAR_M);
    const change = (end: "low" | "high"): { name: string; value: number }[] =>
      wall(before, end) === wall(after, end) ? [] : [{ name: `safety.box.${axis}_${end}`, value: cm(wall(after, end)) }];
    const [low, high] = [change("low"), change("high")];
    made.push(...(wall(after, "low") >= wall(before, "high") ? [...high, ...low] : [...low, ...high]));
  });
  return made;
}

/** The corners and the centre, for dragging. */
export function handles(bounds: Bounds, edited: Edited): { place: [number, number]; drag: (to: readonly [number, number]) => Bounds }[] {
  if (edited === "box") {
    const { box } = bounds;
    if (!box) return [];
    return pairs(box).map(([ex, ey, x, y]) => ({
      place: [x, y],
      drag: ([east, north]) => ({ ...bounds, box: walled(walled(box, ex, 0, east), ey, 1, north) }),
    }));
  }
  const zone = bounds.zones[edited];
  if (!zone) return [];
  const put = (changed: Zone): Bounds => ({ ...bounds, zones: bounds.zones.map((one, number) => (number === edited ? changed : one)) });
  if (zone.kind === "cylinder") {
    const [x, y] = zone.centre;
    return [
      { place: [x, y], drag: ([east, north]) => put({ ...zone, centre: [cm(east), cm(north)] }) },
      { place: [x + zone.radius, y], drag: ([east, north]) => put({ ...zone, radius: Math.max(LEAST_M, cm(Math.hypot(east - x, north - y))) }) },
    ];
  }
  const { low, high } = zone;
  const corner = (x: number, y: number) => ({
    place: [x, y] as [number, number],
    drag: ([east, north]: readonly [number, number]) => put(same(zone, rectangle([x === low[0] ? high[0] : low[0], y === low[1] ? high[1] : low[1]], [east, north], low[2], high[2]))),
  });
  const [cx, cy] = [(low[0] + high[0]) / 2, (low[1] + high[1]) / 2];
  const moved = ([east, north]: readonly [number, number]): Bounds => {
    const [dx, dy] = [cm(east - cx), cm(north - cy)];
    return put({ ...zone, low: [cm(low[0] + dx), cm(low[1] + dy), low[2]], high: [cm(high[0] + dx), cm(high[1] + dy), high[2]] });
  };
  return [corner(low[0], low[1]), corner(high[0], low[1]), corner(high[0], high[1]), corner(low[0], high[1]), { place: [cx, cy], drag: moved }];
}

const same = (before: Zone, after: Zone): Zone => (before.name ? { ...after, name: before.name } : after);

/** An upright box over the rectangle between two corners; never thinner than a few centimetres. */
export function rectangle(one: readonly [number, number], other: readonly [number, number], low: number, high: number): Zone {
  const [west, east] = apart(one[0], other[0]);
  const [south, north] = apart(one[1], other[1]);
  return { kind: "box", low: [west, south, low], high: [east, north, high] };
}

/** A cylinder about a place, out to another. */
export function round(centre: readonly [number, number], edge: readonly [number, number], low: number, high: number): Zone {
  return { kind: "cylinder", centre: [cm(centre[0]), cm(centre[1])], radius: Math.max(LEAST_M, cm(Math.hypot(edge[0] - centre[0], edge[1] - centre[1]))), low, high };
}

/** The smallest zone that contains a place of the map; null if there is none. */
export function zoneAt(zones: readonly Zone[], [x, y]: readonly [number, number]): number | null {
  const sizes = zones.map((zone) => {
    if (zone.kind === "cylinder") return Math.hypot(x - zone.centre[0], y - zone.centre[1]) <= zone.radius ? zone.radius * zone.radius * Math.PI : Number.POSITIVE_INFINITY;
    const inside = x >= zone.low[0] && x <= zone.high[0] && y >= zone.low[1] && y <= zone.high[1];
    return inside ? (zone.high[0] - zone.low[0]) * (zone.high[1] - zone.low[1]) : Number.POSITIVE_INFINITY;
  });
  const least = Math.min(...sizes);
  return Number.isFinite(least) ? sizes.indexOf(least) : null;
}

/** The names of the ends of each axis: x east, y north, z up. */
const WALLS = [[t.zones.west, t.zones.east], [t.zones.south, t.zones.north], [t.zones.bottom, t.zones.top]] as const;

/** All its numbers. */
export function fields(bounds: Bounds, edited: Edited): Field[] {
  if (edited === "box") {
    const box = bounds.box ?? { low: [null, null, null], high: [null, null, null] };
    return WALLS.flatMap(([low, high], axis) => [
      { label: low, value: box.low[axis] ?? null, with: (value: number | null) => ({ ...bounds, box: closed(walled(box, "low", axis, value)) }) },
      { label: high, value: box.high[axis] ?? null, with: (value: number | null) => ({ ...bounds, box: closed(walled(box, "high", axis, value)) }) },
    ]);
  }
  const zone = bounds.zones[edited];
  if (!zone) return [];
  const put = (changed: Zone): Bounds => ({ ...bounds, zones: bounds.zones.map((one, number) => (number === edited ? changed : one)) });
  if (zone.kind === "cylinder") {
    const { centre, radius, low, high } = zone;
    return [
      { label: t.zones.centreEast, value: centre[0], with: (value) => put({ ...zone, centre: [value ?? centre[0], centre[1]] }) },
      { label: t.zones.centreNorth, value: centre[1], with: (value) => put({ ...zone, centre: [centre[0], value ?? centre[1]] }) },
      { label: t.zones.radius, value: radius, with: (value) => put({ ...zone, radius: value ?? radius }) },
      { label: t.zones.bottom, value: low, with: (value) => put({ ...zone, low: value ?? low }) },
      { label: t.zones.top, value: high, with: (value) => put({ ...zone, high: value ?? high }) },
    ];
  }
  const set = (end: "low" | "high", axis: number, value: number | null): Bounds => put({ ...zone, [end]: zone[end].map((one, place) => (place === axis ? (value ?? one) : one)) as Vector });
  return WALLS.flatMap(([low, high], axis) => [
    { label: low, value: zone.low[axis] ?? null, with: (value: number | null) => set("low", axis, value) },
    { label: high, value: zone.high[axis] ?? null, with: (value: number | null) => set("high", axis, value) },
  ]);
}

/** The existing corners of the safety box, by the ends of x and y that meet there. */
function pairs(box: SafetyBox): ["low" | "high", "low" | "high", number, number][] {
  const ends = ["low", "high"] as const;
  return ends.flatMap((ex) =>
    ends.flatMap((ey): ["low" | "high", "low" | "high", number, number][] => {
      const [x, y] = [box[ex][0], box[ey][1]];
      return x === null || y === null ? [] : [[ex, ey, x, y]];
    }),
  );
}

const walled = (box: SafetyBox, end: "low" | "high", axis: number, value: number | null): SafetyBox => ({
  ...box,
  [end]: box[end].map((one, place) => (place === axis ? (value === null ? null : cm(value)) : one)) as SafetyBox["low"],
});

const closed = (box: SafetyBox): SafetyBox | null => ([...box.low, ...box.high].every((wall) => wall === null) ? null : box);

function apart(one: number, other: number): [number, number] {
  const [low, high] = [cm(Math.min(one, other)), cm(Math.max(one, other))];
  return high - low < LEAST_M ? [low, cm(low + LEAST_M)] : [low, high];
}
