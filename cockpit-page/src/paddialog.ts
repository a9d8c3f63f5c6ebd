// The functions of a gamepad's sticks and buttons: shown as they move, and changed. While this dialog is open, the gamepad
// commands nothing at all, not even the emergency stop, which has keys and a button on the screen.

import { h, memory, setAttribute, setHidden, setText, svg } from "./dom.js";
import { type Pad, plugged, pressedOf, sources } from "./gamepad.js";
import { t } from "./language/index.js";
import { Modal } from "./modal.js";
import { AXES, Chord, DEAD_ZONES, movedAxis, PAD_DEEDS, type PadDeed, type PadMap, PadMaps, shaped, type Source, STANDARD_MAP, withButtons, withSource } from "./padmap.js";
import { settings } from "./settings.js";
import type { Axis } from "./sticks.js";

const ROUND_MS = 40;
const [WIDE, HIGH] = [72, 44];
const UNKNOWN: PadMap = { ...STANDARD_MAP, buttons: { stop: [], takeoff: [], hover: [], land: [], take: [], release: [] } };

/** For the dialog, and for the part that flies. */
export const padMaps = new PadMaps(memory);

const mapOf = (pad: Pad): PadMap => padMaps.get(pad.id) ?? (pad.mapping === "standard" ? STANDARD_MAP : UNKNOWN);
const buttonNames = (pad: Pad, buttons: readonly number[]): string[] => buttons.map((button) => (pad.mapping === "standard" && t.pad.buttons[button]) || t.pad.button(button + 1));
/** For both directions of an axis, or for that of `sign`. */
function axisName(pad: Pad, axis: number, sign: Source["sign"] | 0): string {
  const stick = pad.mapping === "standard" ? t.pad.standard[axis] : undefined;
  const arrows = stick === undefined ? "−±+" : axis % 2 === 0 ? "←↔→" : "↑↕↓";
  return `${stick ?? t.pad.axis(axis + 1)} ${arrows[sign + 1]}`;
}

/** A gamepad's functions for the list of keys: of the connected one, or the defaults. */
export function padRows(pad: Pad | null): { keys: string[]; does: string }[] {
  const shown = pad ?? { id: "", mapping: "standard", connected: false, axes: [], buttons: [] };
  const map = mapOf(shown);
  const deeds = PAD_DEEDS.filter((deed) => map.buttons[deed].length > 0).map((deed) => ({ keys: buttonNames(shown, map.buttons[deed]), does: t.pad.does[deed] }));
  const found = sources(shown, map, settings.get("mode"));
  const sticks = AXES.flatMap((axis) => (found[axis] ? [{ keys: [axisName(shown, found[axis].axis, 0)], does: t.settings.stick[axis] }] : []));
  return [...deeds, ...sticks];
}

type Waiting = { axis: Axis; rest: readonly number[] } | { deed: PadDeed; chord: Chord };

export class PadDialog {
  readonly modal: Modal;
  private readonly picture = new PadPicture();
  private readonly name = h("p", { class: "pad-name", role: "status" });
  private readonly asked = h("p", { class: "note pad-asked", role: "status", "aria-live": "assertive" });
  private readonly sticks = Object.fromEntries(AXES.map((axis) => [axis, new StickRow(axis, () => this.waitForAxis(axis), (curve) => this.change((map) => ({ ...map, curves: { ...map.curves, [axis]: curve } })))])) as Record<Axis, StickRow>;
  private readonly deeds = Object.fromEntries(PAD_DEEDS.map((deed) => [deed, new DeedRow(deed, () => this.waitForButtons(deed))])) as Record<PadDeed, DeedRow>;
  private readonly mapped = h("div", {});
  private waiting: Waiting | null = null;
  private round: ReturnType<typeof setInterval> | undefined;

  /** `silence`: called with whether the gamepad commands nothing. */
  constructor(private readonly silence: (silent: boolean) => void) {
    const reset = h("button", { type: "button", onclick: () => this.reset() }, t.pad.reset);
    this.mapped.append(
      h("h3", {}, t.pad.sticks),
      ...AXES.map((axis) => this.sticks[axis].element),
      h("h3", {}, t.pad.deeds),
      h("div", { class: "pad-deeds" }, ...PAD_DEEDS.map((deed) => this.deeds[deed].element)),
      reset,
    );
    this.modal = new Modal(t.pad.title, "gamepad", [this.name, this.picture.element, this.asked, this.mapped, h("p", { class: "note" }, t.pad.note)], () => this.closed());
  }

  open(): void {
    this.silence(true);
    this.modal.open();
    clearInterval(this.round);
    this.round = setInterval(() => this.update(), ROUND_MS);
    this.update();
  }

  private closed(): void {
    clearInterval(this.round);
    this.waiting = null;
    this.silence(false);
  }

  private get pad(): Pad | null {
    return plugged()[0] ?? null;
  }

  private change(changed: (map: PadMap) => PadMap): void {
    const { pad } = this;
    if (pad) padMaps.set(pad.id, changed(mapOf(pad)));
  }

  private reset(): void {
    this.waiting = null;
    setText(this.asked, "");
    if (this.pad) padMaps.set(this.pad.id, null);
  }

  private waitForAxis(axis: Axis): void {
    const { pad } = this;
    const again = this.waiting && "axis" in this.waiting && this.waiting.axis === axis;
    this.waiting = again || !pad ? null : { axis, rest: [...pad.axes] };
    setText(this.asked, this.waiting ? t.pad.moveNow(t.pad.directions[axis]) : "");
  }

  private waitForButtons(deed: PadDeed): void {
    const again = this.waiting && "deed" in this.waiting && this.waiting.deed === deed;
    this.waiting = again ? null : { deed, chord: new Chord() };
    setText(this.asked, this.waiting ? t.pad.pressNow(t.pad.does[deed]) : "");
  }

  private update(): void {
    const { pad } = this;
    this.picture.update(pad);
    setText(this.name, pad ? pad.id : t.pad.none);
    setHidden(this.mapped, pad === null);
    if (pad === null) return;
    this.assign(pad);
    const map = mapOf(pad);
    const found = sources(pad, map, settings.get("mode"));
    for (const axis of AXES) {
      const source = found[axis];
      const value = source ? source.sign * (pad.axes[source.axis] ?? 0) : 0;
      const isWaiting = this.waiting !== null && "axis" in this.waiting && this.waiting.axis === axis;
      this.sticks[axis].show(source ? axisName(pad, source.axis, source.sign) : t.pad.unassigned, map.curves[axis], value, isWaiting);
    }
    for (const deed of PAD_DEEDS) {
      const isWaiting = this.waiting !== null && "deed" in this.waiting && this.waiting.deed === deed;
      this.deeds[deed].show(buttonNames(pad, map.buttons[deed]), isWaiting);
    }
  }

  /** Check whether the requested input has arrived. */
  private assign(pad: Pad): void {
    const { waiting } = this;
    if (waiting === null) return;
    const mode = settings.get("mode");
    if ("axis" in waiting) {
      const source = movedAxis(waiting.rest, pad.axes);
      if (source === null) return;
      this.change((map) => ({ ...map, sources: withSource(sources(pad, map, mode), waiting.axis, source) }));
    } else {
      const pressed = waiting.chord.update(pressedOf(pad));
      if (pressed === null) return;
      const buttons = withButtons(mapOf(pad).buttons, waiting.deed, waiting.deed === "stop" ? pressed : pressed.slice(0, 1));
      if (buttons === null) {
        setText(this.asked, t.pad.kept);
        waiting.chord = new Chord();
        return;
      }
      this.change((map) => ({ ...map, buttons }));
    }
    this.waiting = null;
    setText(this.asked, "");
  }
}

class StickRow {
  readonly element: HTMLElement;
  private readonly source = h("span", { class: "facts" });
  private readonly assign: HTMLButtonElement;
  private readonly deadZone: HTMLInputElement;
  private readonly expo: HTMLInputElement;
  private readonly line = svg("path", { class: "curve-line" });
  private readonly dot = svg("circle", { class: "curve-dot", r: 3.2 });

  constructor(axis: Axis, assign: () => void, changed: (curve: PadMap["curves"][Axis]) => void) {
    const change = (): void => changed({ deadZone: Number(this.deadZone.value), expo: Number(this.expo.value) });
    const slider = (label: string, minimum: number, maximum: number): HTMLInputElement => h("input", { type: "range", min: minimum, max: maximum, step: 0.01, "aria-label": t.pad.of(label, t.pad.directions[axis]), oninput: change });
    this.deadZone = slider(t.pad.deadZone, DEAD_ZONES.minimum, DEAD_ZONES.maximum);
    this.expo = slider(t.pad.expo, 0, 1);
    this.assign = h("button", { type: "button", class: "small", "aria-pressed": "false", "aria-label": t.pad.of(t.pad.assign, t.pad.directions[axis]), onclick: assign }, t.pad.assign);
    const curve = svg("svg", { class: "curve", viewBox: `${-WIDE / 2} ${-HIGH / 2} ${WIDE} ${HIGH}`, role: "img", "aria-label": t.pad.of(t.pad.curve, t.pad.directions[axis]) }, svg("path", { class: "curve-axes", d: `M${-WIDE / 2} 0 H${WIDE / 2} M0 ${-HIGH / 2} V${HIGH / 2}` }), this.line, this.dot);
    this.element = h(
      "div",
      { class: "pad-row", "data-axis": axis },
      h("div", { class: "about" }, h("b", {}, t.pad.directions[axis]), this.source),
      this.assign,
      h("label", {}, h("span", {}, t.pad.deadZone), this.deadZone),
      h("label", {}, h("span", {}, t.pad.expo), this.expo),
      curve,
    );
  }

  show(source: string, curve: PadMap["curves"][Axis], value: number, waiting: boolean): void {
    setText(this.source, source);
    setAttribute(this.assign, "aria-pressed", String(waiting));
    if (document.activeElement !== this.deadZone) this.deadZone.value = String(curve.deadZone);
    if (document.activeElement !== this.expo) this.expo.value = String(curve.expo);
    const at = (x: number): string => `${((x * WIDE) / 2).toFixed(1)} ${((-shaped(x, curve) * HIGH) / 2).toFixed(1)}`;
    setAttribute(this.line, "d", `M${Array.from({ length: 41 }, (_, place) => at(place / 20 - 1)).join(" L")}`);
    const [x, y] = at(value).split(" ") as [string, string];
    setAttribute(this.dot, "cx", x);
    setAttribute(this.dot, "cy", y);
  }
}

class DeedRow {
  readonly element: HTMLElement;
  private readonly keys = h("span", { class: "pad-keys" });
  private readonly assign: HTMLButtonElement;

  constructor(deed: PadDeed, assign: () => void) {
    this.assign = h("button", { type: "button", class: "small", "aria-pressed": "false", "aria-label": t.pad.of(t.pad.assign, t.pad.does[deed]), onclick: assign }, t.pad.assign);
    this.element = h("div", { class: "pad-deed", "data-deed": deed }, h("b", {}, t.pad.does[deed]), this.keys, this.assign);
  }

  show(buttons: readonly string[], waiting: boolean): void {
    const shown = buttons.length ? buttons.join(" + ") : t.pad.unassigned;
    if (this.keys.textContent !== shown) this.keys.replaceChildren(shown);
    setAttribute(this.assign, "aria-pressed", String(waiting));
  }
}

const TRAVEL = 13; // how far the picture's sticks move
/** The position of each button of the standard layout: x, y and radius, or width for bars. */
const BUTTONS: readonly { x: number; y: number; radius?: number; width?: number }[] = [
  { x: 244, y: 92, radius: 9 }, { x: 264, y: 73, radius: 9 }, { x: 224, y: 73, radius: 9 }, { x: 244, y: 54, radius: 9 },
  { x: 46, y: 22, width: 54 }, { x: 220, y: 22, width: 54 }, { x: 52, y: 6, width: 42 }, { x: 226, y: 6, width: 42 },
  { x: 134, y: 66, radius: 6 }, { x: 186, y: 66, radius: 6 },
  { x: 112, y: 118, radius: 21 }, { x: 208, y: 118, radius: 21 },
  { x: 76, y: 58, radius: 7 }, { x: 76, y: 90, radius: 7 }, { x: 60, y: 74, radius: 7 }, { x: 92, y: 74, radius: 7 },
  { x: 160, y: 50, radius: 8 },
];
const LABELLED = 8; // number of buttons with a label: those in front

export class PadPicture {
  readonly element: HTMLElement;
  private readonly drawing: SVGSVGElement;
  private readonly buttons: SVGElement[];
  private readonly labels: SVGElement[];
  private readonly knobs = [10, 11].map((button) => svg("circle", { class: "pad-knob", cx: BUTTONS[button]?.x ?? 0, cy: BUTTONS[button]?.y ?? 0, r: 13 }));
  private readonly bars = h("div", { class: "pad-bars", hidden: true });

  constructor() {
    this.buttons = BUTTONS.map(({ x, y, radius, width }) =>
      width ? svg("rect", { class: "pad-button", x, y, width, height: 12, rx: 5 }) : svg("circle", { class: "pad-button", cx: x, cy: y, r: radius ?? 0 }),
    );
    this.labels = BUTTONS.slice(0, LABELLED).map(({ x, y, width }, button) => svg("text", { class: "pad-label", x: x + (width ?? 0) / 2, y: y + (width ? 6.5 : 0.5), "text-anchor": "middle", "dominant-baseline": "central" }, t.pad.buttons[button] ?? ""));
    const body = svg("path", { class: "pad-body", d: "M70 36 H250 C292 36 308 96 310 146 C311 178 286 188 266 166 C250 148 238 146 222 146 H98 C82 146 70 148 54 166 C34 188 9 178 10 146 C12 96 28 36 70 36 Z" });
    this.drawing = svg("svg", { class: "pad-picture", viewBox: "0 0 320 186", role: "img", "aria-label": t.pad.picture }, body, ...this.buttons, ...this.knobs, ...this.labels);
    this.element = h("div", { class: "pad-shown" }, this.drawing, this.bars);
  }

  update(pad: Pad | null): void {
    const standard = pad === null || pad.mapping === "standard";
    this.drawing.classList.toggle("absent", !standard);
    this.bars.hidden = standard;
    setAttribute(this.drawing, "data-there", String(pad !== null));
    const pressed = pad ? pressedOf(pad) : [];
    for (const drawn of [this.buttons, this.labels]) drawn.forEach((one, number) => setAttribute(one, "data-pressed", String(pressed.includes(number))));
    this.knobs.forEach((knob, stick) => {
      const [x, y] = [pad?.axes[2 * stick] ?? 0, pad?.axes[2 * stick + 1] ?? 0];
      setAttribute(knob, "transform", `translate(${(x * TRAVEL).toFixed(1)} ${(y * TRAVEL).toFixed(1)})`);
    });
    if (!standard) this.axes(pad, pressed);
  }

  private axes(pad: Pad, pressed: readonly number[]): void {
    if (this.bars.children.length !== pad.axes.length + 1) {
      this.bars.replaceChildren(...pad.axes.map((_, axis) => h("label", {}, t.pad.axis(axis + 1), h("meter", { min: -1, max: 1 }))), h("p", { class: "note" }));
    }
    pad.axes.forEach((value, axis) => ((this.bars.children[axis] as HTMLElement).querySelector("meter") as HTMLMeterElement).value = value);
    (this.bars.lastElementChild as HTMLElement).textContent = pressed.map((button) => t.pad.button(button + 1)).join(", ");
  }
}
