// The map's tool for the safety box and no-fly zones: drawn and dragged on the map, or typed into fields.
//
// Each change is written to the drone at once, as parameters; a refused one leaves the old value, and shows why.

import { h, setDisabled, setText, setTone } from "./dom.js";
import { t } from "./language/index.js";
import type { Ink, MapTool, Project, Spot } from "./maptool.js";
import type { Zone } from "./surroundings.js";
import { zoneOutline } from "./worldlayer.js";
import { type Bounds, type Edited, fields, freeName, handles, MAX_ZONES, rectangle, round, writes, zoneAt, zoneName } from "./zones.js";

const DEFAULT_TOP_M = 3; // height of new zones while the drone's ceiling is unknown

export interface ZoneHost {
  bounds(): Bounds;
  /** The ceiling of the drone [m], as the height of new zones; null if unknown. */
  ceiling(): number | null;
  /** Returns the reason for a refusal; empty if it was written. */
  write(name: string, value: string | number): Promise<string>;
  /** The written or refused values are to be read again. */
  reload(): void;
}

export class ZoneTool implements MapTool {
  readonly element: HTMLElement;
  private readonly list = h("select", { "aria-label": t.zones.zone, onchange: () => this.edit(this.list.value === "box" ? "box" : Number(this.list.value)) });
  private readonly numbers = h("div", { class: "zone-fields", role: "group", "aria-label": t.zones.edges });
  private readonly answer = h("p", { class: "answer", role: "status" });
  private readonly buttons: HTMLButtonElement[];
  private edited: Edited = "box";
  private adding: { kind: Zone["kind"]; from: readonly [number, number] | null } | null = null;
  private grabbed: ((to: readonly [number, number]) => Bounds) | null = null;
  /** The zone being dragged, before it is written. */
  private draft: Bounds | null = null;
  private can = false;
  private busy = false;
  private shown = "";

  constructor(private readonly host: ZoneHost) {
    const button = (text: string, act: () => void): HTMLButtonElement => h("button", { type: "button", class: "small", onclick: act }, text);
    this.buttons = [button(t.zones.addBox, () => this.add("box")), button(t.zones.addCylinder, () => this.add("cylinder")), button(t.zones.delete, () => this.remove())];
    this.element = h("div", { class: "zones" }, h("div", { class: "zone-row" }, this.list, ...this.buttons), this.numbers, this.answer);
    this.show();
  }

  get hint(): string {
    if (!this.adding) return t.zones.hint;
    if (this.adding.kind === "cylinder") return this.adding.from ? t.zones.nowEdge : t.zones.pressCentre;
    return this.adding.from ? t.zones.nowCorner : t.zones.pressCorner;
  }

  /** Whether zones can be written now. */
  allow(can: boolean): void {
    if (can === this.can) return;
    this.can = can;
    this.show();
  }

  /** The values in force were read again. */
  update(): void {
    if (!this.busy) this.draft = null;
    this.show();
  }

  draw(pen: CanvasRenderingContext2D, project: Project, ink: Ink): void {
    const bounds = this.draft ?? this.host.bounds();
    const zone = this.edited === "box" ? null : bounds.zones[this.edited];
    if (zone) {
      zoneOutline({ pen, at: project }, zone);
      pen.strokeStyle = ink["text"] ?? "";
      pen.lineWidth = 2;
      pen.setLineDash(this.draft ? [5, 4] : []);
      pen.stroke();
      pen.setLineDash([]);
    }
    if (!this.can) return;
    for (const { place } of handles(bounds, this.edited)) {
      const [x, y] = project(place);
      pen.beginPath();
      pen.rect(x - 5, y - 5, 10, 10);
      pen.fillStyle = ink["well"] ?? "";
      pen.strokeStyle = ink["text"] ?? "";
      pen.lineWidth = 2;
      pen.fill();
      pen.stroke();
    }
  }

  press(spot: Spot): boolean {
    if (!this.can || this.busy) return false;
    if (this.adding) {
      if (!this.adding.from) this.begin(spot.place);
      return true;
    }
    return this.grab(spot);
  }

  move(spot: Spot): void {
    if (this.grabbed) this.draft = this.grabbed(spot.place);
    this.show();
  }

  lift(spot: Spot, click: boolean): void {
    if (this.adding?.from && this.grabbed) {
      // A press and release at one place is its first corner: the next press is the other one.
      const far = Math.hypot(spot.place[0] - this.adding.from[0], spot.place[1] - this.adding.from[1]);
      if (far > spot.reach_m / 2) this.finish(spot.place);
      return;
    }
    if (this.grabbed && !click) {
      this.finish(spot.place);
      return;
    }
    this.grabbed = null;
    const chosen = zoneAt(this.host.bounds().zones, spot.place);
    if (click && chosen !== null) this.edit(chosen);
  }

  key(event: KeyboardEvent, spot: Spot): boolean {
    if (!this.can || this.busy) return false;
    if (event.code === "Delete" || event.code === "Backspace") this.remove();
    else if (event.code !== "Enter" && event.code !== "NumpadEnter") return false;
    else if (this.grabbed) this.finish(spot.place);
    else if (this.adding) this.begin(spot.place);
    else if (!this.grab(spot)) this.lift(spot, true);
    return true;
  }

  cursor(spot: Spot): void {
    this.move(spot);
  }

  /** Forget what is being drawn or dragged. */
  dropped(): void {
    this.adding = this.grabbed = this.draft = null;
    this.show();
  }

  private grab(spot: Spot): boolean {
    const near = handles(this.host.bounds(), this.edited)
      .map((handle) => ({ ...handle, off: Math.hypot(handle.place[0] - spot.place[0], handle.place[1] - spot.place[1]) }))
      .sort((a, b) => a.off - b.off)[0];
    if (!near || near.off > spot.reach_m) return false;
    this.grabbed = near.drag;
    return true;
  }

  private edit(edited: Edited): void {
    this.edited = edited;
    this.adding = this.grabbed = this.draft = null;
    setText(this.answer, "");
    this.show();
  }

  private add(kind: Zone["kind"]): void {
    if (this.host.bounds().zones.length >= MAX_ZONES) {
      this.say(t.zones.tooMany(MAX_ZONES), "bad");
      return;
    }
    this.edit(this.edited);
    this.adding = { kind, from: null };
  }

  private begin(from: readonly [number, number]): void {
    const { adding } = this;
    if (!adding) return;
    adding.from = from;
    const bounds = this.host.bounds();
    const top = this.host.ceiling() ?? DEFAULT_TOP_M;
    const made = adding.kind === "box" ? rectangle : round;
    this.edited = bounds.zones.length;
    this.grabbed = (to) => ({ ...bounds, zones: [...bounds.zones, { ...made(from, to, 0, top), name: freeName(bounds.zones) }] });
  }

  private finish(place: readonly [number, number]): void {
    const bounds = this.grabbed?.(place);
    this.adding = this.grabbed = null;
    if (bounds) void this.commit(bounds);
  }

  private remove(): void {
    const bounds = this.host.bounds();
    const { edited } = this;
    if (edited === "box") void this.commit({ ...bounds, box: null });
    else if (bounds.zones[edited]) void this.commit({ ...bounds, zones: bounds.zones.filter((_, number) => number !== edited) });
  }

  private async commit(to: Bounds): Promise<void> {
    this.draft = to;
    this.busy = true;
    this.say("…", "busy");
    let why = "";
    for (const { name, value } of writes(this.host.bounds(), to)) {
      why = await this.host.write(name, value);
      if (why) break;
    }
    this.busy = false;
    if (why) {
      this.draft = null; // show the values in force again, also in the edited field
      this.shown = "";
    }
    this.say(why ? t.zones.refused(why) : t.parameters.written, why ? "bad" : "ok");
    this.host.reload();
    this.show();
  }

  /** The field for the name of a zone. */
  private naming(bounds: Bounds): HTMLElement[] {
    const { edited } = this;
    const zone = edited === "box" ? undefined : bounds.zones[edited];
    if (!zone) return [];
    const input = h("input", { type: "text", maxlength: 24, value: zone.name ?? "", placeholder: t.zones.none, "aria-label": t.zones.nameLong, disabled: !this.can });
    input.addEventListener("change", () => void this.commit({ ...bounds, zones: bounds.zones.map((one) => (one === zone ? { ...one, name: input.value.trim() } : one)) }));
    return [h("label", {}, h("span", {}, t.zones.name), input)];
  }

  private say(text: string, tone: "ok" | "bad" | "busy"): void {
    setTone(this.answer, tone);
    setText(this.answer, text);
  }

  /** The list and the fields; written only where something has changed, so that a field keeps its focus. */
  private show(): void {
    const bounds = this.draft ?? this.host.bounds();
    if (this.edited !== "box" && this.edited >= bounds.zones.length) this.edited = bounds.zones.length ? bounds.zones.length - 1 : "box";
    const state = JSON.stringify([bounds, this.edited, this.can]);
    if (state === this.shown) return;
    this.shown = state;
    const option = (value: string, text: string): HTMLElement => h("option", { value }, text);
    this.list.replaceChildren(option("box", bounds.box ? t.zones.box : t.zones.noBox), ...bounds.zones.map((zone, number) => option(String(number), zone.name ? t.zones.named(zone.name, t.zones.kinds[zone.kind]) : zoneName(zone))));
    this.list.value = String(this.edited);
    for (const button of this.buttons) setDisabled(button, !this.can);
    const has = this.edited === "box" ? bounds.box !== null : bounds.zones[this.edited] !== undefined;
    setDisabled(this.buttons[2] as HTMLButtonElement, !this.can || !has);
    this.numbers.replaceChildren(
      ...this.naming(bounds),
      ...fields(bounds, this.edited).map(({ label, value, with: changed }) => {
        const input = h("input", { type: "number", step: "0.1", value: value ?? "", placeholder: t.zones.none, "aria-label": t.zones.inMetres(label), disabled: !this.can });
        input.addEventListener("change", () => void this.commit(changed(input.value === "" ? null : Number(input.value))));
        return h("label", {}, h("span", {}, `${label} m`), input);
      }),
    );
  }
}
