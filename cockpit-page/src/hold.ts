// The emergency stop's gesture: press and hold. It hardly happens by accident, and shows a countdown.

import { h, setAttribute, setText } from "./dom.js";
import { t } from "./language/index.js";

/** How long the emergency stop must be held. */
export const HOLD_MS = 800;
/** How long the hint is shown after an early release. */
const HINT_MS = 1500;

/** The outcome of a held press. Pure. */
export class Hold {
  private since_ms: number | null = null;

  get isHeld(): boolean {
    return this.since_ms !== null;
  }

  press(now_ms: number): void {
    this.since_ms ??= now_ms;
  }

  release(): void {
    this.since_ms = null;
  }

  /** From 0 to 1; null while nothing is held. */
  share(now_ms: number): number | null {
    return this.since_ms === null ? null : Math.min(1, (now_ms - this.since_ms) / HOLD_MS);
  }

  /** Whether it has been held long enough; true only once. */
  isDone(now_ms: number): boolean {
    if (this.since_ms === null || now_ms - this.since_ms < HOLD_MS) return false;
    this.since_ms = null;
    return true;
  }
}

/** What happens after holding, and whose motors it concerns, in words. */
export interface Deadly {
  what: string;
  act: () => void;
}

/** Shows the countdown of a hold, wherever that began, in the middle of the screen and above everything else. */
export class Countdown {
  readonly element: HTMLElement;
  private readonly what = h("b", {});
  private readonly how = h("span", { class: "counting-how" });
  private readonly left = h("span", { class: "counting-left", "aria-hidden": "true" });
  private readonly bar = h("i", {});
  private readonly hold = new Hold();
  private held: Deadly | null = null;
  private button: Element | null = null;
  private hint: ReturnType<typeof setTimeout> | undefined;

  constructor() {
    this.element = h("div", { class: "counting", hidden: true, role: "alert" }, this.what, this.how, this.left, h("span", { class: "counting-bar" }, this.bar));
    window.addEventListener("blur", () => this.release());
    document.addEventListener("visibilitychange", () => document.hidden && this.release());
  }

  get isHeld(): boolean {
    return this.hold.isHeld;
  }

  /** Whether this hold is under way, not one that began elsewhere: only its own origin may end a hold. */
  holds(deadly: Deadly | null): boolean {
    return deadly !== null && this.held === deadly;
  }

  /** A hold under way continues. `button`: where it is held; if that disappears, the release would go unseen. */
  press(deadly: Deadly, button: Element | null = null): void {
    if (this.hold.isHeld) return;
    clearTimeout(this.hint);
    [this.held, this.button] = [deadly, button];
    this.hold.press(performance.now());
    this.tick();
    requestAnimationFrame(this.round);
  }

  /** Released too early: nothing is done, and the hint says how to do it. */
  release(): void {
    if (!this.hold.isHeld) return;
    this.end();
    this.element.hidden = false;
    setText(this.how, t.hold.tooEarly(HOLD_MS / 1000));
    setText(this.left, "");
    this.bar.style.setProperty("width", "0");
    this.hint = setTimeout(() => (this.element.hidden = true), HINT_MS);
  }

  private end(): void {
    this.hold.release();
    this.element.hidden = true;
    this.held = null;
  }

  private readonly round = (): void => {
    if (this.button?.isConnected === false) this.release();
    if (!this.hold.isHeld) return;
    this.tick();
    requestAnimationFrame(this.round);
  };

  private tick(): void {
    const now_ms = performance.now();
    const { held } = this;
    if (held === null) return;
    const share = this.hold.share(now_ms) ?? 0;
    this.element.hidden = false;
    setText(this.what, held.what);
    setText(this.how, t.hold.keep);
    setText(this.left, `${(((1 - share) * HOLD_MS) / 1000).toFixed(1)} s`);
    this.bar.style.setProperty("width", `${share * 100}%`);
    if (!this.hold.isDone(now_ms)) return;
    this.end();
    held.act();
  }
}

/** A button to hold: by pointer, or by the space bar or Enter. `deadly` is called when the press begins. */
export function holdButton(countdown: Countdown, deadly: () => Deadly | null, attributes: Record<string, string>, ...children: (Node | string)[]): HTMLButtonElement {
  const button = h("button", { type: "button", ...attributes }, ...children);
  let pressed: { by: number | string; meant: Deadly } | null = null; // the finger or key: releasing another one ends nothing
  const press = (by: number | string): void => {
    const meant = deadly();
    if (meant === null || button.disabled) return;
    countdown.press(meant, button);
    if (!countdown.holds(meant)) return; // something else is held
    pressed = { by, meant };
    setAttribute(button, "data-held", "true");
  };
  const release = (by: number | string): void => {
    if (by !== pressed?.by) return;
    const { meant } = pressed;
    pressed = null;
    setAttribute(button, "data-held", "false");
    if (countdown.holds(meant)) countdown.release(); // otherwise it is done, and the present hold began elsewhere
  };
  button.addEventListener("pointerdown", (event) => {
    if (event.button !== 0) return;
    button.setPointerCapture(event.pointerId);
    press(event.pointerId);
  });
  for (const end of ["pointerup", "pointercancel", "lostpointercapture"] as const) button.addEventListener(end, (event) => release(event.pointerId));
  // Keys are then released elsewhere. A finger is captured: its release is seen wherever the focus goes.
  button.addEventListener("blur", () => typeof pressed?.by === "string" && release(pressed.by));
  button.addEventListener("contextmenu", (event) => event.preventDefault()); // a long press on a touch screen
  button.addEventListener("keydown", (event) => {
    if (event.code !== "Space" && event.code !== "Enter" && event.code !== "NumpadEnter") return;
    event.preventDefault();
    if (!event.repeat && !event.ctrlKey) press(event.code);
  });
  button.addEventListener("keyup", (event) => release(event.code));
  return button;
}
