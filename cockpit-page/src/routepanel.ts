// Routes on the map: planned by presses and in a table, checked by the cockpit, flown with pause, skip and resume.

import { errorText, get, post } from "./api.js";
import { h, setAttribute, setDisabled, setHidden, setText, setTone } from "./dom.js";
import { lasting } from "./format.js";
import { t } from "./language/index.js";
import { flag } from "./maplayers.js";
import { type Ink, type MapTool, nearest, type Project, type Spot } from "./maptool.js";
import type { Vector } from "./model.js";
import { type Direction, directionText, emptyRoute, hasPhoto, headingOf, moved, parseDirection, type Route, type RouteCheck, type RouteEnd, type RouteProgress, type RouteWaypoint, toneOf, turnOf, waitOf, whole, withActions, withHeading, withTurn } from "./route.js";
import { lengthText } from "./units.js";

export type RouteDeed = "route_pause" | "route_resume" | "route_skip" | "route_stop";

export interface RouteHost {
  /** The drone's position; null while unknown. */
  own(): Vector | null;
  fly(id: string): void;
  act(deed: RouteDeed): void;
}

const CHECK_MS = 400; // a route is checked once it has not changed for this long
const HEIGHT_M = 1; // minimum height of the first waypoint chosen on the map
const HEADS = ["x m", "y m", "z m", "m/s", t.route.yawHead, t.route.turnHead, t.route.wait, t.route.photo] as const;

export class RoutePanel implements MapTool {
  readonly element: HTMLElement;
  readonly hint = t.route.hint;
  private readonly files = h("select", { class: "small", "aria-label": t.route.saved, onchange: () => void this.load() });
  private readonly title = h("input", { type: "text", maxlength: 48, placeholder: t.route.nameShort, "aria-label": t.route.name, oninput: () => (this.route.name = this.title.value.trim()) });
  private readonly speed = h("input", { type: "number", min: 0.05, max: 30, step: 0.1, "aria-label": t.route.speed, oninput: () => this.typed() });
  private readonly end = h("select", { class: "small", "aria-label": t.route.end, onchange: () => this.typed() }, ...Object.entries(t.route.ends).map(([value, text]) => h("option", { value }, text)));
  private readonly upload = h("input", { type: "file", accept: ".json", hidden: true, onchange: () => void this.read() });
  private readonly rows = h("tbody");
  private readonly table = h("table", { class: "route-table" }, h("thead", {}, h("tr", {}, ...["", ...HEADS, ""].map((text) => (text ? h("th", { scope: "col" }, text) : h("td"))))), this.rows);
  private readonly summary = h("p", { class: "note", role: "status" });
  private readonly said = h("p", { class: "note", role: "alert", "data-tone": "warn" });
  private readonly found = h("ul", { class: "route-findings", "aria-label": t.route.against });
  private readonly progress = h("p", { class: "note route-progress", role: "status" });
  private readonly go = h("button", { type: "button", class: "small primary", onclick: () => this.fly() }, t.route.fly);
  private readonly deeds = { route_pause: this.deed("route_pause", t.route.pause), route_resume: this.deed("route_resume", t.route.resume), route_skip: this.deed("route_skip", t.route.skip), route_stop: this.deed("route_stop", t.route.stop) };
  private readonly body: HTMLElement;
  private route: Route = emptyRoute();
  private check: RouteCheck | null = null;
  private flying: RouteProgress | null = null;
  private chosen: number | null = null;
  private dragged = false;
  private can = "";
  private timer = 0;
  private asked = 0;

  constructor(
    private readonly drone: string,
    private readonly host: RouteHost,
  ) {
    const button = (text: string, act: () => void): HTMLElement => h("button", { type: "button", class: "small", onclick: act }, text);
    const kept = h("div", { class: "route-line" }, this.files, this.title, button(t.route.save, () => void this.save()), button(t.route.new, () => this.edit(emptyRoute())), button(t.route.delete, () => void this.remove()), button(t.route.download, () => this.download()), button(t.route.upload, () => this.upload.click()), this.upload);
    const wishes = h("div", { class: "route-line" }, h("label", {}, "m/s ", this.speed), h("label", {}, t.route.endShort, this.end));
    const flight = h("div", { class: "route-line" }, this.go, ...Object.values(this.deeds));
    this.body = h("div", { class: "route-body", hidden: true }, kept, this.said, wishes, this.table, this.summary, this.found, flight);
    this.element = h("section", { class: "route", "aria-label": t.route.label }, this.progress, this.body);
    this.edit(emptyRoute());
  }

  /** Set the reason why nothing can be flown now; empty if it can. */
  allow(why: string): void {
    if (why === this.can) return;
    this.can = why;
    this.show();
  }

  /** Show the progress of the flight. */
  update(progress: RouteProgress): void {
    this.flying = progress;
    const words = progress.kind.replace("route.", "").replaceAll("_", " ");
    setTone(this.progress, progress.problem ? "warn" : progress.state === "done" ? "ok" : "busy");
    setText(this.progress, t.route.progress(progress.waypoint, progress.of, progress.state, words, progress.text));
    this.show();
  }

  /** The connection that flew it is gone. */
  forget(): void {
    if (!this.flying) return;
    this.flying = null;
    setText(this.progress, "");
    this.show();
  }

  /** Its path, for other views; empty unless it is flown or edited. */
  get places(): Vector[] {
    return this.body.hidden && this.flying === null ? [] : this.route.waypoints.map(({ x, y, z }) => [x, y, z]);
  }

  /** It is the map's tool now, or not. */
  shown(shown: boolean): void {
    if (shown && this.body.hidden) void this.list();
    setHidden(this.body, !shown);
  }

  // On the map

  draw(pen: CanvasRenderingContext2D, at: Project, ink: Ink): void {
    const own = this.host.own();
    let before: readonly number[] | null = own;
    this.route.waypoints.forEach((one, index) => {
      const place: Vector = [one.x, one.y, one.z];
      const tone = toneOf(this.check, index + 1);
      if (before) {
        pen.beginPath();
        pen.moveTo(...at(before));
        pen.lineTo(...at(place));
        pen.setLineDash(index === 0 ? [2, 4] : []);
        pen.strokeStyle = ink[tone] ?? "";
        pen.lineWidth = 2;
        pen.stroke();
        pen.setLineDash([]);
      }
      before = place;
    });
    this.route.waypoints.forEach((one, index) => flag({ pen, ink, at }, [one.x, one.y, one.z], String(index + 1), index === this.chosen ? "text" : toneOf(this.check, index + 1)));
  }

  press(spot: Spot): boolean {
    this.chosen = this.under(spot);
    this.dragged = false;
    this.mark();
    return this.chosen !== null;
  }

  move(spot: Spot): void {
    if (this.chosen === null) return;
    this.dragged = true;
    this.change(this.chosen, { x: round(spot.place[0]), y: round(spot.place[1]) });
  }

  lift(spot: Spot, click: boolean): void {
    if (click && !this.dragged && this.under(spot) === null) this.add(spot);
  }

  key(event: KeyboardEvent, spot: Spot): boolean {
    const here = this.under(spot);
    if (event.code === "Enter" || event.code === "NumpadEnter") {
      if (here === null) this.add(spot);
      else this.choose(here);
    } else if (event.code === "Delete" || event.code === "Backspace") this.drop(here ?? this.chosen);
    else return false;
    return true;
  }

  private under(spot: Spot): number | null {
    const all = this.route.waypoints.map((one, index) => ({ position: [one.x, one.y], index }));
    return nearest(spot.place, spot.reach_m, all)?.index ?? null;
  }

  // Editing

  private add(spot: Spot): void {
    const height = this.route.waypoints.at(-1)?.z ?? Math.max(HEIGHT_M, round(this.host.own()?.[2] ?? 0));
    this.chosen = this.route.waypoints.length;
    this.edit({ ...this.route, waypoints: [...this.route.waypoints, { x: round(spot.place[0]), y: round(spot.place[1]), z: height }] });
  }

  private choose(index: number): void {
    this.chosen = index;
    this.mark();
    this.rows.rows[index]?.querySelector("input")?.focus();
  }

  private drop(index: number | null): void {
    if (index === null) return;
    this.chosen = null;
    this.edit({ ...this.route, waypoints: this.route.waypoints.filter((_, number) => number !== index) });
  }

  /** Apply a change made on the map; the table keeps its fields, and the focus. */
  private change(index: number, changes: Partial<RouteWaypoint>): void {
    const one = { ...(this.route.waypoints[index] as RouteWaypoint), ...changes };
    this.put(index, one);
    const row = this.rows.rows[index];
    for (const field of ["x", "y"] as const) {
      const input = row?.querySelector<HTMLInputElement>(`[data-field="${field}"]`);
      if (input && document.activeElement !== input) input.value = String(one[field]);
    }
  }

  private put(index: number, one: RouteWaypoint): void {
    this.route.waypoints = this.route.waypoints.map((before, number) => (number === index ? one : before));
    this.later();
  }

  private edit(route: Route): void {
    this.route = route;
    this.title.value = route.name;
    this.speed.value = String(route.speed);
    this.end.value = route.end;
    this.rows.replaceChildren(...route.waypoints.map((one, index) => this.row(one, index)));
    this.mark();
    this.later();
  }

  private row(one: RouteWaypoint, index: number): HTMLTableRowElement {
    const number = index + 1;
    const latest = (): RouteWaypoint => this.route.waypoints[index] as RouteWaypoint;
    const field = (name: string, value: number | string, label: string, step: number, set: (value: number | null) => RouteWaypoint | null): HTMLElement => {
      const input = h("input", { type: "number", step, value, "data-field": name, "aria-label": t.route.ofWaypoint(label, number), onfocus: () => this.mark((this.chosen = index)) });
      input.addEventListener("input", () => {
        const next = set(input.value === "" || !Number.isFinite(input.valueAsNumber) ? null : input.valueAsNumber);
        if (next) this.put(index, next);
      });
      return h("td", {}, input);
    };
    const direction = (name: string, value: Direction, label: string, set: (to: Direction) => RouteWaypoint): HTMLElement => {
      const input = h("input", { type: "text", value: directionText(value), "data-field": name, "aria-label": t.route.ofWaypoint(label, number), title: t.route.direction, autocomplete: "off", onfocus: () => this.mark((this.chosen = index)) });
      input.addEventListener("input", () => {
        const to = parseDirection(input.value);
        setAttribute(input, "aria-invalid", String(to === null));
        if (to) this.put(index, set(to));
      });
      return h("td", {}, input);
    };
    const axis = (name: "x" | "y" | "z"): HTMLElement => field(name, one[name], t.route.inMetres(name), 0.1, (value) => (value === null ? null : { ...latest(), [name]: value }));
    const photo = h("input", { type: "checkbox", "aria-label": t.route.photoAt(number) });
    photo.checked = hasPhoto(one);
    photo.addEventListener("change", () => this.put(index, withActions(latest(), waitOf(latest()), photo.checked)));
    const act = (text: string, label: string, run: () => void, off = false): HTMLElement => h("button", { type: "button", class: "small bare", "aria-label": t.route.actOn(label, number), disabled: off, onclick: run }, text);
    const shift = (to: number): void => this.edit({ ...this.route, waypoints: moved(this.route.waypoints, index, to) });
    const cells = [
      axis("x"),
      axis("y"),
      axis("z"),
      field("speed", one.speed ?? "", t.route.speedIn, 0.1, (value) => without(latest(), "speed", value)),
      direction("yaw", headingOf(one), t.route.yawIn, (to) => withHeading(latest(), to)),
      direction("turn", turnOf(one), t.route.turnIn, (to) => withTurn(latest(), to)),
      field("wait", waitOf(one) || "", t.route.waitIn, 1, (value) => withActions(latest(), value ?? 0, hasPhoto(latest()))),
      h("td", {}, photo),
    ];
    cells.forEach((cell, place) => setAttribute(cell, "data-head", HEADS[place] as string)); // in a narrow table, each waypoint is a card
    return h(
      "tr",
      {},
      h("th", { scope: "row" }, String(number)),
      ...cells,
      h("td", { class: "route-acts" }, act("↑", t.route.up, () => shift(index - 1), index === 0), act("↓", t.route.down, () => shift(index + 1), index === this.route.waypoints.length - 1), act("×", t.route.delete, () => this.drop(index))),
    );
  }

  private typed(): void {
    if (Number.isFinite(this.speed.valueAsNumber)) this.route.speed = this.speed.valueAsNumber;
    this.route.end = this.end.value as RouteEnd;
    this.later();
  }

  private mark(_ = this.chosen): void {
    [...this.rows.rows].forEach((row, index) => row.classList.toggle("chosen", index === this.chosen));
  }

  // Checking

  /** The findings are of another route: check again once nothing has changed for a moment. */
  private later(): void {
    this.check = null;
    this.asked += 1;
    clearTimeout(this.timer);
    if (this.route.waypoints.length > 0) this.timer = window.setTimeout(() => void this.ask(), CHECK_MS);
    this.show();
  }

  private async ask(): Promise<void> {
    const asked = this.asked;
    try {
      const check = await post<RouteCheck>(`/api/drones/${encodeURIComponent(this.drone)}/route/check`, this.route);
      if (asked === this.asked) this.check = check;
      this.show();
    } catch (error) {
      if (asked === this.asked) this.say(errorText(error), true);
    }
  }

  private show(): void {
    const { check, flying } = this;
    const active = flying !== null && ["flying", "acting", "paused"].includes(flying.state);
    setHidden(this.table, this.route.waypoints.length === 0);
    setDisabled(this.go, active || !check?.ok || this.can !== "");
    this.go.title = this.can;
    for (const [deed, button] of Object.entries(this.deeds)) {
      setHidden(button, !active || (deed === "route_pause" && flying.state === "paused") || (deed === "route_resume" && flying.state !== "paused"));
    }
    this.found.replaceChildren(...(check?.findings ?? []).map((one) => h("li", { class: one.severity === "error" ? "bad" : "warn" }, `${one.waypoint === null ? "" : t.route.waypointFound(one.waypoint)}${one.reason}`)));
    if (this.route.waypoints.length === 0) this.say(t.route.none);
    else if (!check) this.say(t.route.checking);
    else this.say(t.route.summary(lengthText(check.length_m, 1), lasting(Math.max(1, check.seconds)), check.battery_left === null ? null : Math.round(check.battery_left * 100), check.ok), !check.ok);
  }

  private say(text: string, bad = false): void {
    setTone(this.summary, bad ? "bad" : "quiet");
    setText(this.summary, text);
  }

  // Files, on the cockpit's host and here

  private async list(): Promise<void> {
    try {
      const { routes } = await get<{ routes: { name: string; problem: string | null }[] }>("/api/routes");
      this.files.replaceChildren(h("option", { value: "" }, routes.length > 0 ? t.route.load : t.route.noneSaved), ...routes.map((one) => h("option", { value: one.name, disabled: one.problem !== null }, one.name)));
    } catch (error) {
      setText(this.said, errorText(error));
    }
  }

  private async load(): Promise<void> {
    const name = this.files.value;
    this.files.value = "";
    if (name) await this.doing(async () => this.edit(whole(await get<Partial<Route>>(`/api/routes/${encodeURIComponent(name)}`))));
  }

  private async save(): Promise<void> {
    await this.doing(() => post(`/api/routes/${encodeURIComponent(this.route.name || "route")}`, this.route), t.route.savedAs(this.route.name || "route"));
    await this.list();
  }

  private async remove(): Promise<void> {
    if (!this.route.name) return setText(this.said, t.route.nameToDelete);
    await this.doing(() => post(`/api/routes/${encodeURIComponent(this.route.name)}/delete`), t.route.deleted(this.route.name));
    await this.list();
  }

  private download(): void {
    const link = h("a", { href: URL.createObjectURL(new Blob([JSON.stringify(this.route, null, 1)], { type: "application/json" })), download: `${this.route.name || "route"}.route.json` });
    link.click();
    URL.revokeObjectURL(link.href);
  }

  private async read(): Promise<void> {
    const file = this.upload.files?.[0];
    this.upload.value = "";
    if (!file) return;
    await this.doing(async () => {
      if (file.size > 65536) throw new Error(t.route.tooLarge(file.name));
      const read: unknown = JSON.parse(await file.text());
      const checked = await post<RouteCheck>(`/api/drones/${encodeURIComponent(this.drone)}/route/check`, read as object); // reports its problems
      this.edit(whole(read as Partial<Route>));
      this.check = checked;
    });
  }

  private async doing(work: () => Promise<unknown>, done = ""): Promise<void> {
    try {
      await work();
      setText(this.said, done);
    } catch (error) {
      setText(this.said, errorText(error));
    }
  }

  // Flying

  private fly(): void {
    if (this.check?.ok) this.host.fly(this.check.id);
    this.go.blur(); // keys fly again
  }

  private deed(deed: RouteDeed, text: string): HTMLButtonElement {
    return h("button", { type: "button", class: "small", "aria-label": t.route.actOnRoute(text), hidden: true, onclick: () => this.host.act(deed) }, text);
  }
}

const round = (metres: number): number => Math.round(metres * 100) / 100;

function without(one: RouteWaypoint, key: "speed", value: number | null): RouteWaypoint {
  const { [key]: _, ...rest } = one;
  return value === null ? (rest as RouteWaypoint) : ({ ...rest, [key]: value } as RouteWaypoint);
}
