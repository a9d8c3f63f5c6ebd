// The map's standard tool: a press chooses a place, and "Fly there" flies to it.
//
// Choosing moves nothing: it first shows the place, distance, time and problems.

import { h, setDisabled, setHidden, setText, setTone } from "./dom.js";
import { lasting } from "./format.js";
import { t } from "./language/index.js";
import { flag, label } from "./maplayers.js";
import type { Ink, MapTool, Project, Spot } from "./maptool.js";
import type { Vector } from "./model.js";
import { lengthText } from "./units.js";

/** Maximum speeds of the drone [m/s]. */
export interface Speeds {
  along: number;
  up: number;
}

export interface Leg {
  distance_m: number;
  /** At maximum speed; null if unknown. */
  time_s: number | null;
}

/** The straight way between two places. */
export function leg(from: Vector, to: Vector, speeds: Speeds | null): Leg {
  const [along, up] = [Math.hypot(to[0] - from[0], to[1] - from[1]), Math.abs(to[2] - from[2])];
  return { distance_m: Math.hypot(along, up), time_s: speeds && Math.max(along / speeds.along, up / speeds.up) };
}

const AGAIN_MS = 1000; // interval between questions whether the drone may fly there
const ABOVE_GROUND_M = 1; // height of a place chosen before take-off

export interface WaypointHost {
  /** The drone's position; null while unknown. */
  own(): Vector | null;
  /** Whether the drone is on the ground: a place at its height can't be flown to. */
  stands(): boolean;
  speeds(): Speeds | null;
  /** The reason why it may not fly to a place; empty if it may. */
  problem(place: Vector): Promise<string>;
  goTo(x: number, y: number, z: number): void;
}

export class WaypointTool implements MapTool {
  readonly element: HTMLElement;
  readonly hint = t.waypoint.hint;
  private readonly inputs = ["x", "y", "z"].map((name) => h("input", { type: "number", step: "0.1", "aria-label": t.waypoint.inMetres(name), placeholder: `${name} m`, oninput: () => this.typed() }));
  private readonly go = h("button", { type: "submit", class: "small primary" }, t.waypoint.fly);
  private readonly clear = h("button", { type: "button", class: "small", "aria-label": t.waypoint.forget, hidden: true, onclick: () => this.choose(null) }, "×");
  private readonly preview = h("p", { class: "note preview", role: "status", hidden: true });
  private chosen: Vector | null = null;
  private problem = "";
  private asked_ms = 0;
  private asked: Vector | null = null;
  private can = false;

  constructor(private readonly host: WaypointHost) {
    const form = h("form", { class: "waypoint", "aria-label": t.waypoint.label, novalidate: true, onsubmit: (event: Event) => this.submit(event) }, ...this.inputs, this.go, this.clear);
    this.element = h("div", {}, form, this.preview);
  }

  /** Whether the drone could fly somewhere now. */
  allow(can: boolean): void {
    this.can = can;
    this.show();
  }

  draw(pen: CanvasRenderingContext2D, project: Project, ink: Ink): void {
    const { chosen } = this;
    if (!chosen) return;
    const own = this.host.own();
    if (performance.now() - this.asked_ms > AGAIN_MS) void this.ask(); // the drone moves, and zones are changed
    const tone = this.problem ? "bad" : "accent";
    const [x, y] = project(chosen);
    if (own) {
      pen.beginPath();
      pen.moveTo(...project(own));
      pen.lineTo(x, y);
      pen.setLineDash([2, 4]);
      pen.strokeStyle = ink[tone] ?? "";
      pen.lineWidth = 2;
      pen.stroke();
      pen.setLineDash([]);
    }
    flag({ pen, ink, at: project }, chosen, tone === "bad" ? "×" : "?", tone);
    label({ pen, ink }, x + 13, y, t.waypoint.high(lengthText(chosen[2], 1)));
    this.show();
  }

  press(): boolean {
    return false;
  }

  move(): void {}

  lift(spot: Spot, click: boolean): void {
    const own = this.host.own();
    if (!click || !own) return;
    const height = this.chosen?.[2] ?? own[2] + (this.host.stands() ? ABOVE_GROUND_M : 0);
    this.choose([round(spot.place[0]), round(spot.place[1]), round(height)]);
    if (this.can) this.go.focus({ preventScroll: true }); // Enter flies there now; the keys that fly still do
  }

  key(event: KeyboardEvent, spot: Spot): boolean {
    if (event.code === "Delete" || event.code === "Backspace") this.choose(null);
    else if (event.code === "Enter" || event.code === "NumpadEnter") this.lift(spot, true);
    else return false;
    return true;
  }

  dropped(): void {
    this.choose(null);
  }

  private choose(place: Vector | null): void {
    this.chosen = place;
    this.inputs.forEach((input, axis) => (input.value = place ? String(place[axis]) : ""));
    void this.ask();
  }

  /** Ask whether it may fly there; until the answer it is assumed to, as the drone checks it too. */
  private async ask(): Promise<void> {
    const place = this.chosen;
    this.asked_ms = performance.now();
    if (this.asked?.join() !== place?.join()) this.problem = "";
    this.asked = place;
    this.show();
    if (!place) return;
    const problem = await this.host.problem(place);
    if (this.asked !== place) return; // another one has been chosen
    this.problem = problem;
    this.show();
  }

  /** A field was edited; an empty one stands for the drone's own coordinate. */
  private typed(): void {
    const own = this.host.own();
    const some = this.inputs.some((input) => input.value !== "");
    this.chosen = own && some ? (this.inputs.map((input, axis) => (input.value === "" ? round(own[axis] as number) : Number(input.value))) as Vector) : null;
    void this.ask();
  }

  private show(): void {
    const [own, place] = [this.host.own(), this.chosen];
    setHidden(this.preview, !place);
    setHidden(this.clear, !place);
    const { problem } = this;
    setDisabled(this.go, !this.can || !place || !own || problem !== "");
    if (!own || !place) return;
    const { distance_m, time_s } = leg(own, place, this.host.speeds());
    const climb = place[2] - own[2];
    const height = Math.abs(climb) < 0.1 ? t.waypoint.same : t.waypoint.climb(lengthText(Math.abs(climb), 1), climb > 0);
    const time = time_s === null ? "" : t.waypoint.time(lasting(Math.max(1, time_s)));
    setTone(this.preview, problem ? "bad" : "quiet");
    setText(this.preview, problem ? t.waypoint.not(problem) : t.waypoint.way(lengthText(distance_m, 1), height, time));
  }

  private submit(event: Event): void {
    event.preventDefault();
    const place = this.chosen;
    if (!place || this.go.disabled) return;
    this.go.blur();
    this.choose(null);
    this.host.goTo(...place);
  }
}

const round = (metres: number): number => Math.round(metres * 100) / 100;
