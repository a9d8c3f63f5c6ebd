// The layers of the map, from bottom to top: grid, paths, waypoints, drones, names.

import { figure } from "./format.js";
import { t } from "./language/index.js";
import type { Ink, Project } from "./maptool.js";
import { unit } from "./units.js";
import { gridStep, type Size, toMetres, toPixels, type View } from "./view.js";
import { drawBounds, drawView, drawWorld, home } from "./worldlayer.js";
import type { Body, Scene } from "./world.js";

export interface Chart {
  pen: CanvasRenderingContext2D;
  view: View;
  size: Size;
  ink: Ink;
  at: Project;
}

/** Everything of a scene. */
export function drawScene(chart: Chart, scene: Scene): void {
  grid(chart);
  if (scene.world) drawWorld(chart, scene.world);
  if (scene.world) drawBounds(chart, scene.world.box, scene.world.zones);
  if (scene.own) for (const camera of scene.world?.cameras ?? []) drawView(chart, scene.own, camera);
  if (scene.start) home(chart, scene.start, "accent");
  for (const other of scene.others) if (other.trail) path(chart, other.trail.points.map((point) => point.place), other, "muted");
  const end = scene.own ?? scene.truth;
  path(chart, scene.trail.points.map((point) => point.place), end, scene.own ? "accent" : "ok");
  way(chart, scene);
  for (const other of scene.others) body(chart, other, other.ink ?? "muted", other.name);
  for (const target of scene.targets) diamond(chart, target);
  scene.waypoints.forEach((waypoint, number) => flag(chart, waypoint.position, String(number + 1), waypoint.own ? "accent" : "warn"));
  if (scene.truth && !scene.own) body(chart, scene.truth, "ok", t.map.truth);
  else if (scene.truth) ghost(chart, scene.truth);
  if (scene.own) body(chart, scene.own, "accent", "");
}

export function caption({ pen, ink, size }: Omit<Chart, "view" | "at">, text: string): void {
  pen.font = "13px system-ui, sans-serif";
  pen.textAlign = "center";
  pen.textBaseline = "middle";
  pen.fillStyle = ink["muted"] ?? "";
  pen.fillText(text, size.width / 2, size.height / 2);
}

/** The keyboard's cursor. */
export function crosshair({ pen, ink, at }: Chart, place: readonly number[]): void {
  const [x, y] = at(place);
  pen.beginPath();
  for (const [dx, dy] of [[1, 0], [-1, 0], [0, 1], [0, -1]] as const) {
    pen.moveTo(x + 4 * dx, y + 4 * dy);
    pen.lineTo(x + 14 * dx, y + 14 * dy);
  }
  pen.strokeStyle = ink["text"] ?? "";
  pen.lineWidth = 2;
  pen.stroke();
}

export function flag({ pen, ink, at }: Pick<Chart, "pen" | "ink" | "at">, place: readonly number[], number: string, tone: string): void {
  const [x, y] = at(place);
  pen.beginPath();
  pen.arc(x, y, 8, 0, 2 * Math.PI);
  pen.fillStyle = ink["well"] ?? "";
  pen.strokeStyle = ink[tone] ?? "";
  pen.lineWidth = 2;
  pen.fill();
  pen.stroke();
  pen.fillStyle = ink["text"] ?? "";
  pen.font = "600 10px system-ui, sans-serif";
  pen.textAlign = "center";
  pen.textBaseline = "middle";
  pen.fillText(number, x, y + 0.5);
}

function grid({ pen, view, size, ink }: Chart): void {
  const { factor, name } = unit("length");
  const step = gridStep(view.scale / factor); // in the displayed unit
  const [west, north] = toMetres(view, size, 0, 0);
  const [east, south] = toMetres(view, size, size.width, size.height);
  pen.lineWidth = 1;
  pen.strokeStyle = ink["line"] ?? "";
  pen.fillStyle = ink["muted"] ?? "";
  pen.font = "10px system-ui, sans-serif";
  pen.textBaseline = "alphabetic";
  pen.beginPath();
  const decimals = step < 1 ? 1 : 0;
  const scale = t.map.grid(`${figure(step, decimals)} ${name}`);
  const free = size.width - 8 - pen.measureText(scale).width - 14; // keep numbers clear of the caption
  for (let x = Math.ceil((west * factor) / step) * step; x <= east * factor; x += step) {
    const px = Math.round(toPixels(view, size, x / factor, 0)[0]) + 0.5;
    pen.moveTo(px, 0);
    pen.lineTo(px, size.height);
    pen.textAlign = "center";
    if (px > 30 && px < free) pen.fillText(figure(x, decimals), px, size.height - 5);
  }
  for (let y = Math.ceil((south * factor) / step) * step; y <= north * factor; y += step) {
    const py = Math.round(toPixels(view, size, 0, y / factor)[1]) + 0.5;
    pen.moveTo(0, py);
    pen.lineTo(size.width, py);
    pen.textAlign = "left";
    if (py > 14 && py < size.height - 18) pen.fillText(figure(y, decimals), 5, py - 3);
  }
  pen.stroke();
  pen.textAlign = "right";
  pen.fillText(scale, size.width - 8, size.height - 5);
}

function path({ pen, ink, at }: Chart, places: readonly (readonly number[])[], end: Body | null, tone: string): void {
  pen.beginPath();
  for (const place of places) pen.lineTo(...at(place));
  if (end) pen.lineTo(...at(end.position));
  pen.strokeStyle = ink[tone] ?? "";
  pen.lineWidth = 1.75;
  pen.globalAlpha = 0.7;
  pen.lineJoin = "round";
  pen.stroke();
  pen.globalAlpha = 1;
}

/** The way from the drone via its waypoints. */
function way({ pen, ink, at }: Chart, scene: Scene): void {
  if (!scene.own || !scene.waypoints.length) return;
  pen.beginPath();
  pen.moveTo(...at(scene.own.position));
  for (const waypoint of scene.waypoints) pen.lineTo(...at(waypoint.position));
  pen.setLineDash([4, 4]);
  pen.strokeStyle = ink["warn"] ?? "";
  pen.lineWidth = 1.25;
  pen.stroke();
  pen.setLineDash([]);
}

function body(chart: Chart, body: Body, tone: string, name: string): void {
  const { pen, ink } = chart;
  const [x, y] = chart.at(body.position);
  pen.save();
  pen.translate(x, y);
  pen.fillStyle = ink[tone] ?? "";
  pen.strokeStyle = ink["well"] ?? "";
  pen.lineWidth = 1.5;
  pen.beginPath();
  if (body.yaw === null) pen.arc(0, 0, 6, 0, 2 * Math.PI);
  else {
    pen.rotate(-body.yaw); // the screen's y points down
    pen.moveTo(12, 0);
    pen.lineTo(-8, 7.5);
    pen.lineTo(-4, 0);
    pen.lineTo(-8, -7.5);
    pen.closePath();
  }
  pen.fill();
  pen.stroke();
  pen.restore();
  if (name) label(chart, x + 12, y, name);
}

function ghost({ pen, ink, at }: Chart, body: Body): void {
  pen.beginPath();
  pen.arc(...at(body.position), 13, 0, 2 * Math.PI);
  pen.setLineDash([3, 3]);
  pen.strokeStyle = ink["ok"] ?? "";
  pen.lineWidth = 1.25;
  pen.stroke();
  pen.setLineDash([]);
}

function diamond(chart: Chart, target: Body): void {
  const { pen, ink } = chart;
  const [x, y] = chart.at(target.position);
  pen.beginPath();
  for (const [dx, dy] of [[0, -7], [7, 0], [0, 7], [-7, 0]] as const) pen.lineTo(x + dx, y + dy);
  pen.closePath();
  pen.fillStyle = ink["target"] ?? "";
  pen.fill();
  label(chart, x + 12, y, target.name);
}

export function label({ pen, ink }: Pick<Chart, "pen" | "ink">, x: number, y: number, text: string, tone = "text"): void {
  pen.font = "11px system-ui, sans-serif";
  pen.textAlign = "left";
  pen.textBaseline = "middle";
  pen.fillStyle = ink[tone] ?? "";
  pen.fillText(text, x, y);
}
