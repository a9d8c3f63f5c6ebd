// Marking a target: pointers to pixels of the frame, boxes, and detections. Pure.

import { type Fit, REACH_NS } from "./drawing.js";
import type { Drawing, Shape } from "./model.js";

/** x, y of the upper left corner, width, height, in pixels of a frame: edges, so that 0 is the left edge of the first column. */
export type Box = readonly [number, number, number, number];
export type Point = readonly [number, number];
export interface Size {
  readonly width: number;
  readonly height: number;
}

export type FollowMode = "follow" | "orbit" | "look";
export const FOLLOW_MODES: readonly FollowMode[] = ["follow", "orbit", "look"];

/** The cockpit's report on a target (docs/cockpit.md). */
export interface FollowMessage {
  type: "follow";
  /** `selecting`: frames are kept since `since_ns`. `tracking`: not flying. `waiting`: hovering, for the reason in `problem`. */
  state: "selecting" | "tracking" | "flying" | "waiting" | "ended";
  camera: string;
  since_ns?: string;
  mode?: FollowMode | null;
  phase?: string;
  problem?: string;
  /** Of the frames [pixels]. */
  size?: readonly [number, number] | null;
  box?: Box | null;
  confidence?: number | null;
  range_m?: number | null;
  range_deviation_m?: number | null;
  lost_s?: number | null;
  /** The distance to keep. */
  distance_m?: number | null;
}

/** A box on the frame with this capture time. */
export interface Mark {
  camera: string;
  captured_ns: string;
  box: Box;
  /** Size of the picture under it [pixels]. */
  size: [number, number];
  class_name?: string;
}

/** A processor's detection. */
export interface Found {
  box: Box;
  name: string;
  captured_ns: string;
}

/** A smaller box has too little content to track [pixels of the frame]. */
export const LEAST_PX = 6;
/** The name of the target's own drawing. */
export const SOURCE = "follow";
const NAMED = /^(.+) [01]?\.\d+$/;

const within = (value: number, low: number, high: number): number => Math.max(low, Math.min(high, value));

/** A place in the view, in the pixels of the fit, as a place in the frame, clamped to the picture. */
export const toFrame = (fit: Fit, [x, y]: Point): Point => [within((x - fit.x) / fit.scale, 0, fit.width / fit.scale), within((y - fit.y) / fit.scale, 0, fit.height / fit.scale)];

/** A box of the frame, in the view. */
export const toView = (fit: Fit, [x, y, width, height]: Box): Box => [fit.x + x * fit.scale, fit.y + y * fit.scale, width * fit.scale, height * fit.scale];

/** The box between two corners, to tenths of a pixel. */
export function between([x0, y0]: Point, [x1, y1]: Point): Box {
  const tenth = (value: number): number => Math.round(value * 10) / 10;
  const [x, y] = [tenth(Math.min(x0, x1)), tenth(Math.min(y0, y1))];
  return [x, y, tenth(Math.max(x0, x1) - x), tenth(Math.max(y0, y1) - y)];
}

export const isLarge = ([, , width, height]: Box): boolean => width >= LEAST_PX && height >= LEAST_PX;

/** The detections in a frame of this size, or another of the same moment: closed outlines of four corners, each followed by its text. */
export function foundIn(drawings: Iterable<Drawing>, captured_ns: string, size: Size): Found[] {
  const found: Found[] = [];
  for (const drawing of drawings) {
    const apart = BigInt(captured_ns) - BigInt(drawing.captured_ns);
    if (drawing.source === SOURCE || apart > REACH_NS || apart < -REACH_NS) continue;
    const scale = [size.width / drawing.width, size.height / drawing.height] as const;
    drawing.shapes.forEach((shape, place) => {
      if (shape.kind !== "line" || !shape.closed || shape.points.length !== 4) return;
      const [xs, ys] = [shape.points.map(([x]) => x * scale[0]), shape.points.map(([, y]) => y * scale[1])];
      const [left, top] = [within(Math.min(...xs), 0, size.width), within(Math.min(...ys), 0, size.height)];
      const [right, bottom] = [within(Math.max(...xs), 0, size.width), within(Math.max(...ys), 0, size.height)];
      const box = between([left, top], [right, bottom]);
      if (isLarge(box)) found.push({ box, name: nameIn(drawing.shapes[place + 1]), captured_ns: drawing.captured_ns });
    });
  }
  return found;
}

/** `person` for the text `person 0.87`; empty for any other text. */
function nameIn(shape: Shape | undefined): string {
  return shape?.kind === "text" ? (NAMED.exec(shape.text)?.[1] ?? "") : "";
}

/** The smallest detection that contains a place; null if there is none. */
export function foundAt(all: readonly Found[], [px, py]: Point): Found | null {
  const hit = all.filter(({ box: [x, y, width, height] }) => px >= x && px <= x + width && py >= y && py <= y + height);
  return hit.reduce<Found | null>((best, one) => (best === null || one.box[2] * one.box[3] < best.box[2] * best.box[3] ? one : best), null);
}

/** A box moved, or resized around its centre, within the frame; without a box, one in the centre. */
export function nudged(box: Box | null, [right, down]: Point, grows: boolean, { width, height }: Size): Box {
  if (box === null) return [width * 0.4, height * 0.3, width * 0.2, height * 0.4];
  const [dx, dy] = [right * width * 0.02, down * height * 0.02];
  if (!grows) return [within(box[0] + dx, 0, width - box[2]), within(box[1] + dy, 0, height - box[3]), box[2], box[3]];
  const [w, h] = [within(box[2] + 2 * dx, LEAST_PX, width), within(box[3] - 2 * dy, LEAST_PX, height)];
  return [within(box[0] - (w - box[2]) / 2, 0, width - w), within(box[1] - (h - box[3]) / 2, 0, height - h), w, h];
}

/** The place for a panel beside a box in the view: below, else above, else over its lower edge; never beyond the view. */
export function beside([x, y, width, height]: Box, panel: Size, view: Size, gap = 8): Point {
  const left = within(x + width / 2 - panel.width / 2, gap, Math.max(gap, view.width - panel.width - gap));
  const below = y + height + gap;
  const above = y - panel.height - gap;
  const lowest = Math.max(gap, view.height - panel.height - gap);
  return [left, below <= lowest ? below : above >= gap ? above : lowest];
}
