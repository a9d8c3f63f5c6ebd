// The map from above: north is up. A click is a waypoint, where the position is known and this page has control.

import { colour, fit, h, setDisabled, setHidden, setText } from "./dom.js";
import { figure } from "./format.js";
import type { Vector } from "./model.js";
import { around, gridStep, type Size, toMetres, toPixels, type View, zoomed } from "./view.js";
import type { Body, Scene } from "./world.js";

const PERIOD_MS = 80;
const CLICK_PX = 5;
const EASE = 0.15; // of the way to the wanted view, each time that it is drawn

interface Ink {
  [name: string]: string;
}

export class MapView {
  readonly element: HTMLElement;
  private readonly canvas = h("canvas", { class: "map", role: "img", "aria-label": "Map from above" });
  private readonly note = h("p", { class: "note" });
  private readonly inputs = ["x", "y", "z"].map((name) => h("input", { type: "number", step: "0.1", "aria-label": `Waypoint ${name} in metres`, placeholder: name }));
  private readonly go = h("button", { type: "submit", class: "small" }, "Fly there");
  private readonly follow = h("button", { type: "button", class: "small", "aria-pressed": "true", onclick: () => this.refit() }, "Fit");
  private readonly form: HTMLElement;
  private view: View | null = null;
  private fitted = true;
  private drag: { x: number; y: number; view: View; moved: boolean } | null = null;
  private ink: Ink = {};
  private drawn_ms = 0;
  private can = false;

  constructor(
    private readonly scene: () => Scene,
    private readonly goTo: (x: number, y: number, z: number) => void,
  ) {
    const zoom = (sign: string, factor: number): HTMLElement => h("button", { type: "button", class: "small", "aria-label": factor > 1 ? "Zoom in" : "Zoom out", onclick: () => this.zoom(factor) }, sign);
    const form = (this.form = h("form", { class: "waypoint", "aria-label": "Waypoint", onsubmit: (event: Event) => this.submit(event) }, ...this.inputs, this.go));
    const buttons = h("div", { class: "map-buttons" }, zoom("+", 1.4), zoom("−", 1 / 1.4), this.follow);
    this.element = h("div", { class: "filling mapping" }, h("div", { class: "map-box" }, this.canvas, buttons), form, this.note);
    this.canvas.addEventListener("pointerdown", (event) => this.press(event));
    this.canvas.addEventListener("pointermove", (event) => this.move(event));
    this.canvas.addEventListener("pointerup", (event) => this.lift(event));
    this.canvas.addEventListener("pointercancel", () => (this.drag = null));
    this.canvas.addEventListener("wheel", (event) => this.wheel(event), { passive: false });
    this.repaint();
  }

  /** Colours have changed. */
  repaint(): void {
    const names = ["well", "line", "muted", "text", "accent", "ok", "warn", "bad", "target"];
    this.ink = Object.fromEntries(names.map((name) => [name, colour(name)]));
  }

  /** Nothing can be flown to: it is a recording. */
  watchOnly(only: boolean): void {
    setHidden(this.form, only);
  }

  /** Whether a click is a waypoint now; `why` not. */
  allow(can: boolean, why: string): void {
    this.can = can;
    this.canvas.classList.toggle("clickable", can);
    setDisabled(this.go, !can);
    setText(this.note, can ? "Click on the map to fly there, at the present height." : why);
  }

  draw(now_ms: number): void {
    if (now_ms - this.drawn_ms < PERIOD_MS || !this.canvas.clientWidth) return;
    this.drawn_ms = now_ms;
    const density = fit(this.canvas);
    const size = { width: this.canvas.clientWidth, height: this.canvas.clientHeight };
    const pen = this.canvas.getContext("2d");
    if (!pen) return;
    const scene = this.scene();
    this.ease(scene, size);
    pen.setTransform(density, 0, 0, density, 0, 0);
    pen.fillStyle = this.ink["well"] ?? "";
    pen.fillRect(0, 0, size.width, size.height);
    const view = this.view;
    if (!view) {
      this.caption(pen, "Nothing here has a known position", size);
      return;
    }
    this.grid(pen, view, size);
    const at = (place: readonly number[]): [number, number] => toPixels(view, size, place[0] as number, place[1] as number);
    this.path(pen, scene, at);
    for (const other of scene.others) this.body(pen, other, at, this.ink["muted"] ?? "", other.name);
    for (const target of scene.targets) this.diamond(pen, at(target.position), this.ink["target"] ?? "", target.name);
    scene.waypoints.forEach((waypoint, number) => this.flag(pen, at(waypoint.position), String(number + 1), waypoint.own));
    if (scene.truth && !scene.own) this.body(pen, scene.truth, at, this.ink["ok"] ?? "", "truth");
    else if (scene.truth) this.ghost(pen, scene.truth, at);
    if (scene.own) this.body(pen, scene.own, at, this.ink["accent"] ?? "", "");
  }

  private ease(scene: Scene, size: Size): void {
    if (!this.fitted && this.view) return;
    const places = [scene.own, scene.truth, ...scene.others, ...scene.targets].flatMap((body) => (body ? [body.position] : []));
    const wanted = around([...places, ...scene.waypoints.map((one) => one.position), ...scene.trail.points.map((point) => point.place as Vector)], size);
    if (!wanted) return;
    const { view } = this;
    const mix = (from: number, to: number): number => from + (to - from) * EASE;
    this.view = view ? { east: mix(view.east, wanted.east), north: mix(view.north, wanted.north), scale: mix(view.scale, wanted.scale) } : wanted;
  }

  private grid(pen: CanvasRenderingContext2D, view: View, size: Size): void {
    const step = gridStep(view.scale);
    const [west, north] = toMetres(view, size, 0, 0);
    const [east, south] = toMetres(view, size, size.width, size.height);
    pen.lineWidth = 1;
    pen.strokeStyle = this.ink["line"] ?? "";
    pen.fillStyle = this.ink["muted"] ?? "";
    pen.font = "10px system-ui, sans-serif";
    pen.textBaseline = "alphabetic";
    pen.beginPath();
    const decimals = step < 1 ? 1 : 0;
    for (let x = Math.ceil(west / step) * step; x <= east; x += step) {
      const px = Math.round(toPixels(view, size, x, 0)[0]) + 0.5;
      pen.moveTo(px, 0);
      pen.lineTo(px, size.height);
      pen.textAlign = "center";
      if (px > 30 && px < size.width - 60) pen.fillText(figure(x, decimals), px, size.height - 5);
    }
    for (let y = Math.ceil(south / step) * step; y <= north; y += step) {
      const py = Math.round(toPixels(view, size, 0, y)[1]) + 0.5;
      pen.moveTo(0, py);
      pen.lineTo(size.width, py);
      pen.textAlign = "left";
      if (py > 14 && py < size.height - 18) pen.fillText(figure(y, decimals), 5, py - 3);
    }
    pen.stroke();
    pen.textAlign = "right";
    pen.fillText(`N ↑  grid ${step < 1 ? figure(step, 1) : step} m`, size.width - 8, size.height - 5);
  }

  private path(pen: CanvasRenderingContext2D, scene: Scene, at: (place: readonly number[]) => [number, number]): void {
    pen.beginPath();
    for (const { place } of scene.trail.points) pen.lineTo(...at(place));
    const end = scene.own ?? scene.truth;
    if (end) pen.lineTo(...at(end.position));
    pen.strokeStyle = this.ink[scene.own ? "accent" : "ok"] ?? "";
    pen.lineWidth = 1.75;
    pen.globalAlpha = 0.7;
    pen.lineJoin = "round";
    pen.stroke();
    pen.globalAlpha = 1;
    if (!scene.own || !scene.waypoints.length) return;
    pen.beginPath();
    pen.moveTo(...at(scene.own.position));
    for (const waypoint of scene.waypoints) pen.lineTo(...at(waypoint.position));
    pen.setLineDash([4, 4]);
    pen.strokeStyle = this.ink["warn"] ?? "";
    pen.lineWidth = 1.25;
    pen.stroke();
    pen.setLineDash([]);
  }

  private body(pen: CanvasRenderingContext2D, body: Body, at: (place: readonly number[]) => [number, number], ink: string, name: string): void {
    const [x, y] = at(body.position);
    pen.save();
    pen.translate(x, y);
    pen.fillStyle = ink;
    pen.strokeStyle = this.ink["well"] ?? "";
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
    if (name) this.name(pen, x, y, name);
  }

  private ghost(pen: CanvasRenderingContext2D, body: Body, at: (place: readonly number[]) => [number, number]): void {
    pen.beginPath();
    pen.arc(...at(body.position), 13, 0, 2 * Math.PI);
    pen.setLineDash([3, 3]);
    pen.strokeStyle = this.ink["ok"] ?? "";
    pen.lineWidth = 1.25;
    pen.stroke();
    pen.setLineDash([]);
  }

  private diamond(pen: CanvasRenderingContext2D, [x, y]: [number, number], ink: string, name: string): void {
    pen.beginPath();
    for (const [dx, dy] of [[0, -7], [7, 0], [0, 7], [-7, 0]] as const) pen.lineTo(x + dx, y + dy);
    pen.closePath();
    pen.fillStyle = ink;
    pen.fill();
    this.name(pen, x, y, name);
  }

  private flag(pen: CanvasRenderingContext2D, [x, y]: [number, number], number: string, own: boolean): void {
    pen.beginPath();
    pen.arc(x, y, 8, 0, 2 * Math.PI);
    pen.fillStyle = this.ink["well"] ?? "";
    pen.strokeStyle = this.ink[own ? "accent" : "warn"] ?? "";
    pen.lineWidth = 2;
    pen.fill();
    pen.stroke();
    pen.fillStyle = this.ink["text"] ?? "";
    pen.font = "600 10px system-ui, sans-serif";
    pen.textAlign = "center";
    pen.textBaseline = "middle";
    pen.fillText(number, x, y + 0.5);
  }

  private name(pen: CanvasRenderingContext2D, x: number, y: number, name: string): void {
    pen.font = "11px system-ui, sans-serif";
    pen.textAlign = "left";
    pen.textBaseline = "middle";
    pen.fillStyle = this.ink["text"] ?? "";
    pen.fillText(name, x + 12, y);
  }

  private caption(pen: CanvasRenderingContext2D, text: string, size: Size): void {
    pen.font = "13px system-ui, sans-serif";
    pen.textAlign = "center";
    pen.textBaseline = "middle";
    pen.fillStyle = this.ink["muted"] ?? "";
    pen.fillText(text, size.width / 2, size.height / 2);
  }

  // Moving about and clicking

  private free(): void {
    this.fitted = false;
    this.follow.setAttribute("aria-pressed", "false");
  }

  private refit(): void {
    this.fitted = !this.fitted;
    this.follow.setAttribute("aria-pressed", String(this.fitted));
  }

  private zoom(factor: number, x = this.canvas.clientWidth / 2, y = this.canvas.clientHeight / 2): void {
    if (!this.view) return;
    this.free();
    this.view = zoomed(this.view, { width: this.canvas.clientWidth, height: this.canvas.clientHeight }, factor, x, y);
  }

  private wheel(event: WheelEvent): void {
    event.preventDefault();
    this.zoom(Math.exp(-event.deltaY / 400), event.offsetX, event.offsetY);
  }

  private press(event: PointerEvent): void {
    if (!this.view || event.button !== 0) return;
    this.canvas.setPointerCapture(event.pointerId);
    this.drag = { x: event.offsetX, y: event.offsetY, view: this.view, moved: false };
  }

  private move(event: PointerEvent): void {
    const { drag } = this;
    if (!drag) return;
    const [dx, dy] = [event.offsetX - drag.x, event.offsetY - drag.y];
    if (!drag.moved && Math.hypot(dx, dy) < CLICK_PX) return;
    drag.moved = true;
    this.free();
    this.view = { ...drag.view, east: drag.view.east - dx / drag.view.scale, north: drag.view.north + dy / drag.view.scale };
  }

  private lift(event: PointerEvent): void {
    const { drag, view } = this;
    this.drag = null;
    const own = this.scene().own;
    if (!drag || drag.moved || !view || !this.can || !own) return;
    const size = { width: this.canvas.clientWidth, height: this.canvas.clientHeight };
    this.goTo(...toMetres(view, size, event.offsetX, event.offsetY), own.position[2]);
  }

  private submit(event: Event): void {
    event.preventDefault();
    const own = this.scene().own;
    if (!this.can || !own) return;
    // What is left empty stays as it is.
    const [x, y, z] = this.inputs.map((input, axis) => (input.value === "" ? own.position[axis] : Number(input.value))) as Vector;
    this.go.blur();
    this.goTo(x, y, z);
  }
}
