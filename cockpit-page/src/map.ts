// The map from above, with north up. It shows a scene and leaves interaction to its tool.

import { colour, fit, h, setText } from "./dom.js";
import { t } from "./language/index.js";
import { caption, crosshair, drawScene } from "./maplayers.js";
import { arrow, type Ink, MAP_KEYS, type MapTool, nearest, type Project, type Spot } from "./maptool.js";
import type { Vector } from "./model.js";
import { lengthText } from "./units.js";
import { apart, around, gridStep, type Size, toMetres, toPixels, type View, zoomed } from "./view.js";
import type { Scene } from "./world.js";

const PERIOD_MS = 80; // interval between drawings
const CLICK_PX = 5; // a press that moves less is a click
const REACH_PX = 12; // things this close count as under the pointer
const EASE = 0.15; // share of the way to the desired view, per drawing
const STILL = 0.01; // share of the view's extent: a smaller distance counts as no movement
const ZOOM = 1.4; // factor of a press or key
const INKS = ["well", "line", "muted", "text", "accent", "ok", "warn", "bad", "target"];

interface Shown {
  view: View;
  size: Size;
}

export class MapView {
  readonly element: HTMLElement;
  /** For buttons of tools, over the map. */
  readonly corner = h("div", { class: "map-buttons left" });
  private readonly canvas = h("canvas", { class: "map", role: "application", tabindex: 0, "data-keys": [...MAP_KEYS].join(" "), "aria-label": t.map.label });
  private readonly spoken = h("p", { class: "unseen", role: "status" });
  private readonly note = h("p", { class: "note" });
  private readonly follow = h("button", { type: "button", class: "small", "aria-pressed": "true", onclick: () => this.refit() }, t.map.fit);
  private tool: MapTool | null = null;
  private view: View | null = null;
  /** The scene on the screen: a press refers to what is visible, even if the layout has changed since. */
  private drawn: Shown | null = null;
  private room = "";
  private fitted = true;
  private drag: { x: number; y: number; shown: Shown; moved: boolean; taken: boolean } | null = null;
  /** The keyboard's cursor, while the map has the focus; east and north [m]. */
  private cursor: [number, number] | null = null;
  private ink: Ink = {};
  private drawn_ms = 0;
  private why = "";

  /**
   * `standard` is the tool while no other is used; null for a map without interaction. `below` is shown under the map.
   */
  constructor(
    private readonly scene: () => Scene,
    private readonly standard: MapTool | null = null,
    ...below: HTMLElement[]
  ) {
    const zoom = (sign: string, factor: number): HTMLElement => h("button", { type: "button", class: "small", "aria-label": factor > 1 ? t.map.zoomIn : t.map.zoomOut, onclick: () => this.zoom(factor) }, sign);
    const buttons = h("div", { class: "map-buttons" }, zoom("+", ZOOM), zoom("−", 1 / ZOOM), this.follow);
    this.element = h("div", { class: "filling mapping" }, h("div", { class: "map-box" }, this.canvas, this.corner, buttons), ...below, this.note, this.spoken);
    // A press leaves the focus where it is: the focused element may fly, and only a person who comes by Tab wants the map's keys.
    this.canvas.addEventListener("mousedown", (event) => event.preventDefault());
    this.canvas.addEventListener("pointerdown", (event) => this.press(event));
    this.canvas.addEventListener("pointermove", (event) => this.move(event));
    this.canvas.addEventListener("pointerup", (event) => this.lift(event));
    this.canvas.addEventListener("pointercancel", () => (this.drag = null));
    this.canvas.addEventListener("wheel", (event) => this.wheel(event), { passive: false });
    this.canvas.addEventListener("keydown", (event) => this.key(event));
    this.canvas.addEventListener("blur", () => (this.cursor = null));
    this.repaint();
    this.hint();
  }

  /** Presses and keys now go to this tool; null: to the standard one. */
  use(tool: MapTool | null): void {
    if (tool === this.tool) return;
    this.used?.dropped?.();
    this.tool = tool;
    this.drag = null;
    this.hint();
  }

  /** The tool in use; null for a map without interaction. */
  get used(): MapTool | null {
    return this.tool ?? this.standard;
  }

  /** The colours have changed. */
  repaint(): void {
    this.ink = Object.fromEntries(INKS.map((name) => [name, colour(name)]));
  }

  /** The reason why nothing can be flown from here now, shown in place of the tool's hint; empty: it can. */
  allow(why: string): void {
    this.why = why;
    this.canvas.classList.toggle("clickable", why === "");
    this.hint();
  }

  draw(now_ms: number): void {
    if (now_ms - this.drawn_ms < PERIOD_MS || !this.canvas.clientWidth) return;
    this.drawn_ms = now_ms;
    const density = fit(this.canvas);
    const { size, ink } = this;
    const pen = this.canvas.getContext("2d");
    if (!pen) return;
    const scene = this.scene();
    this.ease(scene, size);
    pen.setTransform(density, 0, 0, density, 0, 0);
    pen.fillStyle = ink["well"] ?? "";
    pen.fillRect(0, 0, size.width, size.height);
    const view = this.view;
    this.drawn = view && { view, size };
    if (!view) {
      caption({ pen, ink, size }, t.map.nowhere);
      return;
    }
    const at: Project = (place) => toPixels(view, size, place[0] as number, place[1] as number);
    const chart = { pen, view, size, ink, at };
    drawScene(chart, scene);
    this.used?.draw(pen, at, ink);
    if (this.cursor) crosshair(chart, this.cursor);
    this.hint(); // a tool's hint follows what it does
  }

  private get size(): Size {
    return { width: this.canvas.clientWidth, height: this.canvas.clientHeight };
  }

  private hint(): void {
    setText(this.note, this.why || (this.used?.hint ?? ""));
  }

  private ease(scene: Scene, size: Size): void {
    if (!this.fitted && this.view) return;
    const bodies = [scene.own, scene.truth, ...scene.others, ...scene.targets].flatMap((body) => (body ? [body.position] : []));
    const room = scene.world?.room ? [scene.world.room.low, scene.world.room.high] : [];
    const wanted = around([...room, ...bodies, ...scene.waypoints.map((one) => one.position), ...scene.trail.points.map((point) => point.place as Vector)], size);
    if (!wanted) return;
    const { view } = this;
    const known = room.flat().join();
    const jumps = !view || known !== this.room; // show a newly known room at once, without easing
    this.room = known;
    const mix = (from: number, to: number): number => from + (to - from) * EASE;
    this.view = jumps ? wanted : { east: mix(view.east, wanted.east), north: mix(view.north, wanted.north), scale: mix(view.scale, wanted.scale) };
    this.canvas.dataset["still"] = String(room.length > 0 && (jumps || apart(this.view, wanted, size) < STILL));
  }

  // Moving about

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
    this.view = zoomed(this.view, this.size, factor, x, y);
  }

  private wheel(event: WheelEvent): void {
    event.preventDefault();
    this.zoom(Math.exp(-event.deltaY / 400), event.offsetX, event.offsetY);
  }

  // Pointers and keys, for the tool

  /** Convert a pixel of the canvas to one of the picture on it, which is stretched until the next drawing. */
  private pixel(event: PointerEvent): [number, number] {
    const { size, drawn } = this;
    return drawn ? [(event.offsetX * drawn.size.width) / size.width, (event.offsetY * drawn.size.height) / size.height] : [event.offsetX, event.offsetY];
  }

  private spot({ view, size }: Shown, x: number, y: number): Spot {
    const place = toMetres(view, size, x, y);
    const { own, others, targets } = this.scene();
    const reach_m = REACH_PX / view.scale;
    return { place, pixel: [x, y], reach_m, under: nearest(place, reach_m, [...(own ? [own] : []), ...others, ...targets]) };
  }

  private press(event: PointerEvent): void {
    const shown = this.drawn;
    if (!shown || event.button !== 0) return;
    this.canvas.setPointerCapture(event.pointerId);
    const [x, y] = this.pixel(event);
    const taken = this.used?.press(this.spot(shown, x, y)) ?? false;
    if (taken) this.free(); // keep the view while dragging
    this.drag = { x, y, shown, moved: false, taken };
  }

  private move(event: PointerEvent): void {
    const { drag } = this;
    if (!drag) return;
    const [x, y] = this.pixel(event);
    const [dx, dy] = [x - drag.x, y - drag.y];
    if (!drag.moved && Math.hypot(dx, dy) < CLICK_PX) return;
    drag.moved = true;
    const { view } = drag.shown;
    if (drag.taken) {
      this.used?.move(this.spot(this.drawn ?? drag.shown, x, y));
      return;
    }
    this.free();
    this.view = { ...view, east: view.east - dx / view.scale, north: view.north + dy / view.scale };
  }

  private lift(event: PointerEvent): void {
    const { drag } = this;
    this.drag = null;
    if (!drag || (drag.moved && !drag.taken)) return;
    // A click refers to the scene at the time of the press, although the view may have moved since.
    const shown = drag.moved ? (this.drawn ?? drag.shown) : drag.shown;
    this.used?.lift(this.spot(shown, ...this.pixel(event)), !drag.moved);
  }

  private key(event: KeyboardEvent): void {
    const { view, size } = this;
    if (!view || event.ctrlKey || event.altKey || event.metaKey || !MAP_KEYS.has(event.code)) return;
    event.preventDefault();
    const step = arrow(event.code);
    const from = (this.cursor ??= [view.east, view.north]);
    if (this.used?.key(event, this.spot({ view, size }, ...toPixels(view, size, ...from)))) return;
    if (step) this.moveCursor(view, step, gridStep(view.scale) / (event.shiftKey ? 50 : 5));
    else if (event.code === "Equal" || event.code === "NumpadAdd") this.zoom(ZOOM);
    else if (event.code === "Minus" || event.code === "NumpadSubtract") this.zoom(1 / ZOOM);
    else if (event.code === "Digit0" && !this.fitted) this.refit();
  }

  private moveCursor(view: View, [east, north]: readonly [number, number], step_m: number): void {
    this.free();
    const [x, y] = this.cursor ?? [view.east, view.north];
    const place: [number, number] = [snapped(x + east * step_m, step_m), snapped(y + north * step_m, step_m)];
    this.cursor = place;
    const { size } = this;
    const [px, py] = toPixels(view, size, ...place);
    if (px < 0 || py < 0 || px > size.width || py > size.height) this.view = { ...view, east: place[0], north: place[1] };
    const now = { view: this.view ?? view, size };
    this.used?.cursor?.(this.spot(now, ...toPixels(now.view, size, ...place)));
    setText(this.spoken, t.map.cursor(lengthText(place[0], 2), lengthText(place[1], 2)));
  }
}

const snapped = (metres: number, step_m: number): number => Math.round(metres / step_m) * step_m;
