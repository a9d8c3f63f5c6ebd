// Draws shapes published by controllers and processors over the picture they belong to.

import type { Shape } from "./model.js";

/** Drawings of a frame further away than this belong to another moment [ns]. */
export const REACH_NS = 300_000_000n;
/** Drawings that arrive later than this after their picture are not shown: things have moved on [ns]. */
export const LATEST_NS = 1_000_000_000n;

/** Older drawings are not late: a newly opened page gets the last one ever published [ns]. */
const LEFT_OVER_NS = 10_000_000_000n;

/** Delay of a drawing after its picture; 0 if in time. Pure. */
export function lateness(drawing: { captured_ns: string }, shown: bigint | null): bigint {
  const late = shown === null ? 0n : shown - BigInt(drawing.captured_ns);
  return late < REACH_NS || late > LEFT_OVER_NS ? 0n : late;
}

/** Whether a drawing with this delay belongs over a picture: `live`, over its own; `late`, over a newer one; or not. Pure. */
export function belongs(drawing: { captured_ns: string }, late: bigint, shown: bigint): "live" | "late" | "" {
  const apart = shown - BigInt(drawing.captured_ns);
  if (apart < REACH_NS && apart > -REACH_NS) return "live";
  return late > 0n && late <= LATEST_NS && apart > 0n && apart < late + REACH_NS ? "late" : "";
}

/** From pixels of the frame to pixels of the canvas. */
export interface Fit {
  scale: number;
  x: number;
  y: number;
  width: number;
  height: number;
  density: number;
}

/** The place of a picture in a box that it fills as far as its aspect ratio allows. */
export function contain(width: number, height: number, box: { width: number; height: number }, density: number): Fit {
  const scale = Math.min(box.width / width, box.height / height);
  const [w, h] = [width * scale, height * scale];
  return { scale, x: (box.width - w) / 2, y: (box.height - h) / 2, width: w, height: h, density };
}

const rgb = ([red, green, blue]: readonly number[]): string => `rgb(${red} ${green} ${blue})`;
const EDGE = "rgb(0 0 0 / 55%)"; // below lines and dots, so that they are visible on any picture

export function draw(pen: CanvasRenderingContext2D, shapes: readonly Shape[], fit: Fit): void {
  pen.lineJoin = pen.lineCap = "round";
  const at = ([x, y]: readonly [number, number]): [number, number] => [fit.x + (x + 0.5) * fit.scale, fit.y + (y + 0.5) * fit.scale];
  for (const shape of shapes) {
    if (shape.kind === "text") label(pen, shape.text, at(shape.at), rgb(shape.colour), fit);
    else if (shape.kind === "points") dots(pen, shape.points.map(at), rgb(shape.colour), fit.density);
    else line(pen, shape.points.map(at), shape.closed, rgb(shape.colour), fit.density);
  }
}

function line(pen: CanvasRenderingContext2D, points: [number, number][], closed: boolean, ink: string, density: number): void {
  if (points.length === 0) return;
  pen.beginPath();
  for (const point of points) pen.lineTo(...point);
  if (closed) pen.closePath();
  pen.strokeStyle = EDGE;
  pen.lineWidth = 4.5 * density;
  pen.stroke();
  pen.strokeStyle = ink;
  pen.lineWidth = 2.25 * density;
  pen.stroke();
}

function dots(pen: CanvasRenderingContext2D, points: [number, number][], ink: string, density: number): void {
  pen.fillStyle = ink;
  pen.strokeStyle = EDGE;
  pen.lineWidth = 1.5 * density;
  for (const [x, y] of points) {
    pen.beginPath();
    pen.arc(x, y, 3.5 * density, 0, 2 * Math.PI);
    pen.fill();
    pen.stroke();
  }
}

function label(pen: CanvasRenderingContext2D, text: string, at: [number, number], ink: string, fit: Fit): void {
  const { density } = fit;
  pen.font = `600 ${13 * density}px system-ui, sans-serif`;
  pen.textBaseline = "middle";
  const width = pen.measureText(text).width;
  const inset = 7 * density;
  // Keep the label inside the picture, and below the line that shows the picture's age.
  const within = (value: number, least: number, most: number): number => Math.max(least, Math.min(value, most));
  const x = within(at[0], fit.x + 2 * inset, fit.x + fit.width - width - 2 * inset);
  const y = within(at[1], fit.y + 48 * density, fit.y + fit.height - 15 * density);
  pen.fillStyle = "rgb(6 10 15 / 68%)";
  pen.beginPath();
  pen.roundRect(x - inset, y - 11 * density, width + 2 * inset, 22 * density, 5 * density);
  pen.fill();
  pen.fillStyle = ink;
  pen.fillText(text, x, y + density);
}
