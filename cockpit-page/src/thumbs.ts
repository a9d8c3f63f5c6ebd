// Two sticks on the screen, for thumbs and mice.

import { h, setAttribute, setText } from "./dom.js";
import { t } from "./language/index.js";
import type { Sticks } from "./model.js";
import { settings } from "./settings.js";
import { CENTRED, deadBand, STICK_MODES } from "./sticks.js";

type Push = (x: number, y: number) => void;

/** One stick: pushes from −1 to 1, right and up positive; back to the centre when it is released. */
function stick(push: Push): { pad: HTMLElement; call: (label: string) => void } {
  const knob = h("i", { class: "knob" });
  const name = h("span", {});
  const pad = h("div", { class: "thumb", role: "img" }, knob, name);
  const put = (x: number, y: number): void => {
    knob.style.setProperty("translate", `calc(${x} * var(--travel)) calc(${-y} * var(--travel))`);
    push(x, y);
  };
  const follow = (event: PointerEvent): void => {
    if (!pad.hasPointerCapture(event.pointerId)) return;
    const box = pad.getBoundingClientRect();
    const [x, y] = [((event.clientX - box.left) / box.width) * 2 - 1, 1 - ((event.clientY - box.top) / box.height) * 2];
    const size = Math.max(1, Math.hypot(x, y));
    put(x / size, y / size);
  };
  pad.addEventListener("pointerdown", (event) => {
    pad.setPointerCapture(event.pointerId);
    follow(event);
  });
  pad.addEventListener("pointermove", follow);
  for (const end of ["pointerup", "pointercancel", "lostpointercapture"] as const) pad.addEventListener(end, () => put(0, 0));
  const call = (label: string): void => {
    setText(name, label);
    setAttribute(pad, "aria-label", label);
  };
  return { pad, call };
}

/** What both sticks do now, by the mode that the person chose. Pure. */
export function thumbed(mode: keyof typeof STICK_MODES, place: "left" | "right", x: number, y: number): Partial<Sticks> {
  const axes = STICK_MODES[mode][place];
  return { [axes.x]: deadBand(-x) + 0, [axes.y]: deadBand(y) }; // to the left is positive
}

export class Thumbs {
  readonly element: HTMLElement;
  private sticks: Sticks = { ...CENTRED };

  constructor(push: (sticks: Sticks) => void) {
    const sides = (["left", "right"] as const).map((place) => ({
      place,
      ...stick((x, y) => {
        this.sticks = { ...this.sticks, ...thumbed(settings.get("mode"), place, x, y) };
        push(this.sticks);
      }),
    }));
    const label = (): void => {
      this.sticks = { ...CENTRED }; // what a thumb held has another meaning now
      push(this.sticks);
      for (const { place, call } of sides) {
        const { x, y } = STICK_MODES[settings.get("mode")][place];
        call(t.thumbs.label(t.thumbs.axes[y], t.thumbs.axes[x]));
      }
    };
    this.element = h("div", { class: "thumbs" }, ...sides.map(({ pad }) => pad));
    label();
    this.forget = settings.on("mode", label);
  }

  /** To be called when it is not shown any more. */
  readonly forget: () => void;
}
