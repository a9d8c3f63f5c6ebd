// Two sticks on the screen, for thumbs and mice.

import { h } from "./dom.js";
import type { Sticks } from "./model.js";
import { CENTRED, deadBand } from "./sticks.js";

type Push = (x: number, y: number) => void;

/** One stick: pushes from −1 to 1, right and up positive; back to the centre when it is released. */
function stick(label: string, push: Push): HTMLElement {
  const knob = h("i", { class: "knob" });
  const pad = h("div", { class: "thumb", role: "img", "aria-label": label }, knob, h("span", {}, label));
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
  return pad;
}

export class Thumbs {
  readonly element: HTMLElement;
  private sticks: Sticks = { ...CENTRED };

  constructor(push: (sticks: Sticks) => void) {
    const update = (change: Partial<Sticks>): void => {
      this.sticks = { ...this.sticks, ...change };
      push(this.sticks);
    };
    this.element = h(
      "div",
      { class: "thumbs" },
      stick("up · turn", (x, y) => update({ up: deadBand(y), yaw_rate: deadBand(-x) + 0 })),
      stick("forward · side", (x, y) => update({ forward: deadBand(y), left: deadBand(-x) + 0 })),
    );
  }
}
