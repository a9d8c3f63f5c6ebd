// Turning, projecting and outlining, for map and 3-D view. World axes: x east, y north, z up [m]. Pure.

import type { Vector } from "./model.js";

export type Point = readonly [number, number];

/** From body to world axes: Rz(yaw) Ry(pitch) Rx(roll), as ROS REP 103 has them [rad]. */
export function turned([x, y, z]: readonly [number, number, number], roll: number, pitch: number, yaw: number): Vector {
  const [cr, sr, cp, sp, cy, sy] = [Math.cos(roll), Math.sin(roll), Math.cos(pitch), Math.sin(pitch), Math.cos(yaw), Math.sin(yaw)];
  return [
    cy * cp * x + (cy * sp * sr - sy * cr) * y + (cy * sp * cr + sy * sr) * z,
    sy * cp * x + (sy * sp * sr + cy * cr) * y + (sy * sp * cr - cy * sr) * z,
    -sp * x + cp * sr * y + cp * cr * z,
  ];
}

/** The smallest convex outline of points of the plane, counter-clockwise. */
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

/** Where a ray from a place ends: on the floor (z = 0), or after so many metres. */
export function rayEnd(from: Vector, ray: Vector, length_m: number): Vector {
  const down = ray[2] < 0 && from[2] > 0 ? from[2] / -ray[2] : Number.POSITIVE_INFINITY;
  const far = Math.min(length_m, down);
  return [from[0] + ray[0] * far, from[1] + ray[1] * far, from[2] + ray[2] * far];
}

/** The corners of a rectangle about its centre, turned by a yaw [rad]. */
export function corners(x: number, y: number, along: number, across: number, yaw: number): Point[] {
  const [c, s] = [Math.cos(yaw), Math.sin(yaw)];
  return ([[1, 1], [-1, 1], [-1, -1], [1, -1]] as const).map(([a, b]) => {
    const [dx, dy] = [(a * along) / 2, (b * across) / 2];
    return [x + c * dx - s * dy, y + s * dx + c * dy];
  });
}
