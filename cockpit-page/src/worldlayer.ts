// The map's lowest layers: the room and its contents, the safety box, no-fly zones, and the cameras' views.

import { short } from "./format.js";
import { t } from "./language/index.js";
import { type Chart, label } from "./maplayers.js";
import type { Vector } from "./model.js";
import type { CameraView, SafetyBox, World, Zone } from "./surroundings.js";
import { inUnit, unit } from "./units.js";
import type { Body } from "./world.js";
import { zoneName } from "./zones.js";

export type Point = readonly [number, number];

/** From body to world axes: Rz(yaw) Ry(pitch) Rx(roll), as in ROS REP 103 [rad]. */
export function turned([x, y, z]: readonly [number, number, number], roll: number, pitch: number, yaw: number): Vector {
  const [cr, sr, cp, sp, cy, sy] = [Math.cos(roll), Math.sin(roll), Math.cos(pitch), Math.sin(pitch), Math.cos(yaw), Math.sin(yaw)];
  return [
    cy * cp * x + (cy * sp * sr - sy * cr) * y + (cy * sp * cr + sy * sr) * z,
    sy * cp * x + (sy * sp * sr + cy * cr) * y + (sy * sp * cr - cy * sr) * z,
    -sp * x + cp * sr * y + cp * cr * z,
  ];
}

/** The convex hull of points in the plane, counter-clockwise. */
export function hull(points: readonly Point[]): Point[] {
  const sorted = [...points].sort((a, b) => a[0] - b[0] || a[1] - b[1]);
  const turnsLeft = (a: Point, b: Point, c: Point): boolean => (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0]) > 0;
  const half = (all: readonly Point[]): Point[] => {
    const kept: Point[] = [];
    for (const point of all) {
      while (kept.length > 1 && !turnsLeft(kept.at(-2) as Point, kept.at(-1) as Point, point)) kept.pop();
      kept.push(point);
    }
    return kept.slice(0, -1);
  };
  return sorted.length < 3 ? sorted : [...half(sorted), ...half(sorted.reverse())];
}

/** The end of a ray from a place: on the floor (z = 0), or after this many metres. */
export function rayEnd(from: Vector, ray: Vector, length_m: number): Vector {
  const down = ray[2] < 0 && from[2] > 0 ? from[2] / -ray[2] : Number.POSITIVE_INFINITY;
  const far = Math.min(length_m, down);
  return [from[0] + ray[0] * far, from[1] + ray[1] * far, from[2] + ray[2] * far];
}

/** The corners of a rectangle about its centre, rotated by a yaw [rad]. */
export function corners(x: number, y: number, along: number, across: number, yaw: number): Point[] {
  const [c, s] = [Math.cos(yaw), Math.sin(yaw)];
  return ([[1, 1], [-1, 1], [-1, -1], [1, -1]] as const).map(([a, b]) => {
    const [dx, dy] = [(a * along) / 2, (b * across) / 2];
    return [x + c * dx - s * dy, y + s * dx + c * dy];
  });
}

const SEEN_M = 3; // how far a camera's field of view is drawn

export function drawWorld(chart: Chart, world: World): void {
  const { pen, ink } = chart;
  if (world.room) {
    const { low, high } = world.room;
    outline(chart, [[low[0], low[1]], [high[0], low[1]], [high[0], high[1]], [low[0], high[1]]]);
    pen.strokeStyle = ink["muted"] ?? "";
    pen.lineWidth = world.room.enclosed ? 3 : 1;
    pen.stroke();
  }
  for (const { position, size, yaw } of world.solids) {
    outline(chart, corners(position[0], position[1], size[0], size[1], yaw));
    fill(chart, "muted", 0.35);
    pen.strokeStyle = ink["muted"] ?? "";
    pen.lineWidth = 1;
    pen.stroke();
  }
  for (const gate of world.gates) drawGate(chart, gate);
  for (const { position, size, yaw, elevation } of world.markers) {
    outline(chart, corners(position[0], position[1], Math.max(0.03, size * Math.sin(Math.abs(elevation))), size, yaw));
    fill(chart, "text", 0.75);
  }
  for (const start of world.starts) home(chart, start.position, "muted");
}

/** Where it may not fly. */
export function drawBounds(chart: Chart, box: SafetyBox | null, zones: readonly Zone[]): void {
  const { pen, ink } = chart;
  zones.forEach((zone) => {
    zoneOutline(chart, zone);
    fill(chart, "bad", 0.16);
    pen.strokeStyle = ink["bad"] ?? "";
    pen.lineWidth = 1.5;
    pen.stroke();
    const [x, y] = chart.at(zoneCentre(zone));
    label(chart, x - 8, y, zoneName(zone), "bad");
  });
  if (box) drawBox(chart, box);
}

export function zoneOutline(chart: Pick<Chart, "pen" | "at">, zone: Zone): void {
  if (zone.kind === "box") {
    const { low, high } = zone;
    outline(chart, [[low[0], low[1]], [high[0], low[1]], [high[0], high[1]], [low[0], high[1]]]);
    return;
  }
  const [x, y] = chart.at(zone.centre);
  const [edge] = chart.at([zone.centre[0] + zone.radius, zone.centre[1]]);
  chart.pen.beginPath();
  chart.pen.arc(x, y, edge - x, 0, 2 * Math.PI);
}

export const zoneCentre = (zone: Zone): Point => (zone.kind === "box" ? [(zone.low[0] + zone.high[0]) / 2, (zone.low[1] + zone.high[1]) / 2] : zone.centre);

/** The ground, or the next metres, seen by a camera of a drone whose attitude is known. */
export function drawView(chart: Chart, body: Body, camera: CameraView): void {
  const { pen, ink } = chart;
  if (!camera.rays || body.yaw === null) return;
  const turn = (ray: Vector): Vector => turned(ray, body.roll, body.pitch, body.yaw ?? 0);
  const offset = turn(camera.position ?? [0, 0, 0]);
  const eye = body.position.map((value, axis) => value + (offset[axis] as number)) as Vector;
  const ends = camera.rays.map((ray) => rayEnd(eye, turn(ray), SEEN_M));
  outline(chart, hull([eye, ...ends].map(([x, y]) => [x, y] as const)));
  fill(chart, "accent", 0.1);
  pen.strokeStyle = ink["accent"] ?? "";
  pen.globalAlpha = 0.45;
  pen.lineWidth = 1;
  pen.stroke();
  pen.globalAlpha = 1;
}

function drawGate(chart: Chart, { position, size, yaw, frame }: World["gates"][number]): void {
  const { pen, ink } = chart;
  const [across, c, s] = [size[0] / 2 + frame, Math.cos(yaw), Math.sin(yaw)];
  pen.beginPath();
  pen.moveTo(...chart.at([position[0] - s * across, position[1] + c * across]));
  pen.lineTo(...chart.at([position[0] + s * across, position[1] - c * across]));
  pen.strokeStyle = ink["warn"] ?? "";
  pen.lineWidth = 4;
  pen.stroke();
  pen.beginPath(); // the way through
  pen.moveTo(...chart.at([position[0] - c * 0.3, position[1] - s * 0.3]));
  pen.lineTo(...chart.at([position[0] + c * 0.3, position[1] + s * 0.3]));
  pen.lineWidth = 1;
  pen.stroke();
}

/** Two rings at a drone's start. */
export function home({ pen, ink, at }: Chart, place: readonly number[], tone: string): void {
  const [x, y] = at(place);
  pen.strokeStyle = ink[tone] ?? "";
  pen.lineWidth = 1.5;
  for (const radius of [4, 9]) {
    pen.beginPath();
    pen.arc(x, y, radius, 0, 2 * Math.PI);
    pen.stroke();
  }
}

/** A missing wall is left open: its corner is beyond the edge of the map. */
function drawBox(chart: Chart, box: SafetyBox): void {
  const { pen, ink, at } = chart;
  const [west, south] = [box.low[0] ?? -1e4, box.low[1] ?? -1e4];
  const [east, north] = [box.high[0] ?? 1e4, box.high[1] ?? 1e4];
  outline(chart, [[west, south], [east, south], [east, north], [west, north]]);
  pen.setLineDash([8, 4]);
  pen.strokeStyle = ink["ok"] ?? "";
  pen.lineWidth = 2;
  pen.stroke();
  pen.setLineDash([]);
  const heights = [box.low[2], box.high[2]].map((value) => (value === null ? "…" : short(inUnit("length", value))));
  const [x, y] = at([west, north]);
  if (box.low[0] !== null && box.high[1] !== null) label(chart, x + 4, y - 8, t.map.box(heights[0] as string, heights[1] as string, unit("length").name), "ok");
}

function outline({ pen, at }: Pick<Chart, "pen" | "at">, points: readonly Point[]): void {
  pen.beginPath();
  for (const point of points) pen.lineTo(...at(point));
  pen.closePath();
}

function fill({ pen, ink }: Chart, tone: string, alpha: number): void {
  pen.fillStyle = ink[tone] ?? "";
  pen.globalAlpha = alpha;
  pen.fill();
  pen.globalAlpha = 1;
}
