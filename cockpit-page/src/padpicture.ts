// A gamepad of the standard layout, drawn: sticks move, buttons light up. Of another one, its axes as bars.

import { h, setAttribute, svg } from "./dom.js";
import { type Pad, pressedOf } from "./gamepad.js";
import { t } from "./language/index.js";

const TRAVEL = 13;
/** Where each button of the standard layout is: x, y and radius, or width for those that are bars. */
const BUTTONS: readonly { x: number; y: number; radius?: number; width?: number }[] = [
  { x: 244, y: 92, radius: 9 }, { x: 264, y: 73, radius: 9 }, { x: 224, y: 73, radius: 9 }, { x: 244, y: 54, radius: 9 },
  { x: 46, y: 22, width: 54 }, { x: 220, y: 22, width: 54 }, { x: 52, y: 6, width: 42 }, { x: 226, y: 6, width: 42 },
  { x: 134, y: 66, radius: 6 }, { x: 186, y: 66, radius: 6 },
  { x: 112, y: 118, radius: 21 }, { x: 208, y: 118, radius: 21 },
  { x: 76, y: 58, radius: 7 }, { x: 76, y: 90, radius: 7 }, { x: 60, y: 74, radius: 7 }, { x: 92, y: 74, radius: 7 },
  { x: 160, y: 50, radius: 8 },
];
const LABELLED = 8;

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
