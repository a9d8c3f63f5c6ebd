// Two sticks on the screen, for thumbs and mice.

import { h, setAttribute, setText } from "./dom.js";
import { t } from "./language/index.js";
import type { Sticks } from "./model.js";
import { settings } from "./settings.js";
import { CENTRED, deadBand, STICK_MODES } from "./sticks.js";

const CENTRE: readonly [number, number] = [0, 0];

interface Stick {
  pad: HTMLElement;
  call(label: string): void;
  /** From −1 to 1, right and up positive: the position of the finger that holds it, else the centre. */
  read(): readonly [number, number];
  /** Centre the stick; it must be pressed again. */
  release(): void;
}

function stick(touched: () => void): Stick {
  const knob = h("i", { class: "knob" });
  const name = h("span", {});
  const pad = h("div", { class: "thumb", role: "img" }, knob, name);
  let [finger, at]: [number | null, readonly [number, number]] = [null, CENTRE];
  // Ask the browser each time: the event of a release may be lost, as for a hidden element.
  const isHeld = (): boolean => finger !== null && pad.hasPointerCapture(finger);
  const put = (x: number, y: number): void => {
    at = [x, y];
    knob.style.setProperty("translate", `calc(${x} * var(--travel)) calc(${-y} * var(--travel))`);
  };
  const follow = (event: PointerEvent): void => {
    if (event.pointerId !== finger || !isHeld()) return;
    touched();
    const box = pad.getBoundingClientRect();
    const [x, y] = [((event.clientX - box.left) / box.width) * 2 - 1, 1 - ((event.clientY - box.top) / box.height) * 2];
    const size = Math.max(1, Math.hypot(x, y));
    put(x / size, y / size);
  };
  const release = (): void => {
    if (finger !== null && pad.hasPointerCapture(finger)) pad.releasePointerCapture(finger);
    finger = null;
    put(...CENTRE);
  };
  pad.addEventListener("pointerdown", (event) => {
    if (isHeld()) return; // a second finger moves nothing
    pad.setPointerCapture(event.pointerId);
    finger = event.pointerId;
    follow(event);
  });
  pad.addEventListener("pointermove", follow);
  for (const end of ["pointerup", "pointercancel", "lostpointercapture"] as const) pad.addEventListener(end, (event) => event.pointerId === finger && release());
  return {
    pad,
    call: (label) => {
      setText(name, label);
      setAttribute(pad, "aria-label", label);
    },
    read: () => (isHeld() ? at : CENTRE),
    release,
  };
}

/** The commands of both sticks now, by the person's stick mode. Pure. */
export function thumbed(mode: keyof typeof STICK_MODES, place: "left" | "right", x: number, y: number): Partial<Sticks> {
  const axes = STICK_MODES[mode][place];
  return { [axes.x]: deadBand(-x) + 0, [axes.y]: deadBand(y) }; // to the left is positive
}

export class Thumbs {
  readonly element: HTMLElement;
  /** Counts movements of fingers. */
  touches = 0;
  private readonly sides = (["left", "right"] as const).map((place) => ({ place, stick: stick(() => (this.touches += 1)) }));

  constructor() {
    const label = (): void => {
      this.release(); // a held stick has another meaning now
      for (const { place, stick } of this.sides) {
        const { x, y } = STICK_MODES[settings.get("mode")][place];
        stick.call(t.thumbs.label(t.thumbs.axes[y], t.thumbs.axes[x]));
      }
    };
    this.element = h("div", { class: "thumbs" }, ...this.sides.map(({ stick }) => stick.pad));
    label();
    this.forget = settings.on("mode", label);
  }

  /** As held by fingers now. */
  get sticks(): Sticks {
    return Object.assign({ ...CENTRED }, ...this.sides.map(({ place, stick }) => thumbed(settings.get("mode"), place, ...stick.read()))) as Sticks;
  }

  /** Centre both sticks; they must be pressed again. */
  release(): void {
    for (const { stick } of this.sides) stick.release();
  }

  /** Call this when it is no longer shown. */
  readonly forget: () => void;
}
