// The panel of a marked target: how to follow it, its state, and Stop.

import { h, setAttribute, setDisabled, setHidden, setText, setTone } from "./dom.js";
import { FOLLOW_MODES, type FollowMessage, type FollowMode, type Point, type Size } from "./follow.js";
import { figure } from "./format.js";
import { named, t } from "./language/index.js";
import { UNREAD_MS } from "./question.js";
import { lengthText } from "./units.js";

export interface FollowDeeds {
  go(mode: FollowMode, distance_m: number | null): void;
  /** Stop, or forget the target. */
  stop(): void;
}

/** Confidence, distance and its certainty, in a line; unknown values are omitted. Pure. */
export function figures({ confidence = null, range_m = null, range_deviation_m = null, lost_s = null }: Partial<FollowMessage>): string {
  const range = range_m === null ? "" : `${lengthText(range_m, 1)}${range_deviation_m === null ? "" : ` ± ${lengthText(range_deviation_m, 1)}`}`;
  return [confidence === null ? "" : t.follow.sure(Math.round(confidence * 100)), range, lost_s ? t.follow.lostFor(figure(lost_s, 1)) : ""].filter(Boolean).join(" · ");
}

export class FollowPanel {
  readonly element: HTMLElement;
  private readonly state = h("b", { class: "follow-phase", role: "status" });
  private readonly figures = h("span", { class: "follow-figures" });
  private readonly why = h("p", { class: "note", role: "status", "data-tone": "warn" });
  private readonly modes: Record<FollowMode, HTMLButtonElement>;
  private readonly distance = h("input", { type: "number", min: 0, max: 100, step: 0.5, "aria-label": t.follow.distance, title: t.follow.distance });
  private readonly stop = h("button", { type: "button", class: "follow-stop", onclick: () => this.deeds.stop() });
  private problem = "";
  private can = "";
  /** It opens under the finger that marked the target: a second press meant for the picture is no choice. */
  private unread: ReturnType<typeof setTimeout> | null = null;
  private at: ((size: Size) => Point) | null = null;
  private height = 0;

  constructor(private readonly deeds: FollowDeeds) {
    const button = (mode: FollowMode): HTMLButtonElement => h("button", { type: "button", "data-mode": mode, title: t.follow.explained[mode], "aria-pressed": "false", onclick: () => this.go(mode) }, t.follow.modes[mode]);
    this.modes = { follow: button("follow"), orbit: button("orbit"), look: button("look") };
    this.distance.addEventListener("keydown", (event) => event.key === "Enter" && this.go(this.mode ?? "follow"));
    const choices = h("div", { class: "choices", role: "group", "aria-label": t.follow.what }, ...Object.values(this.modes));
    const distance = h("label", { class: "follow-distance" }, this.distance, t.follow.metres);
    const head = h("div", { class: "follow-head" }, h("p", {}, this.state, this.figures), distance);
    this.element = h("section", { class: "follow-panel", tabindex: -1, hidden: true, "aria-label": t.follow.label }, head, choices, this.stop, this.why);
  }

  get isOpen(): boolean {
    return !this.element.hidden;
  }

  /** The target is being tracked; nothing flies. `at`: the place for a panel of that size in the view. */
  open(at: (size: Size) => Point): void {
    this.at = at;
    this.distance.value = "";
    this.show({ type: "follow", state: "tracking", camera: "", phase: "starting" });
    this.unread = setTimeout(() => this.read(), UNREAD_MS);
    this.allow(this.can);
    this.element.focus({ preventScroll: true });
  }

  close(): void {
    this.read();
    // Otherwise the focus would go nowhere, and a text field would keep the keys.
    if (this.element.contains(document.activeElement)) this.element.closest<HTMLElement>(".pane")?.focus({ preventScroll: true });
    setHidden(this.element, true);
    this.height = 0;
  }

  /** Set the reason why nothing can be flown now; empty if it can. */
  allow(why: string): void {
    this.can = why;
    for (const mode of FOLLOW_MODES) setDisabled(this.modes[mode], why !== "" || this.unread !== null);
    this.explain();
  }

  /** Modes can be chosen from now on, also by Enter unless the focus has moved meanwhile. */
  private read(): void {
    if (this.unread === null) return;
    clearTimeout(this.unread);
    this.unread = null;
    this.allow(this.can);
    if (document.activeElement === this.element && !this.modes.follow.disabled) this.modes.follow.focus({ preventScroll: true });
  }

  show(message: FollowMessage): void {
    const flies = message.state === "flying" || message.state === "waiting";
    setHidden(this.element, false);
    setAttribute(this.element, "data-state", flies ? "flying" : "tracking");
    const lost = (message.lost_s ?? 0) > 0.5 || (message.state === "tracking" && message.phase !== "starting" && !message.box);
    setTone(this.element, message.state === "waiting" || lost ? "warn" : flies ? "busy" : "quiet");
    setText(this.state, message.state === "waiting" ? t.follow.waiting : message.phase === "starting" ? t.follow.starting : flies ? named(t.follow.phases, message.phase ?? "") : lost ? t.follow.lost : t.follow.tracked);
    setText(this.figures, figures(message));
    for (const mode of FOLLOW_MODES) setAttribute(this.modes[mode], "aria-pressed", String(flies && message.mode === mode));
    setText(this.stop, flies ? t.follow.stop : t.follow.cancel);
    setAttribute(this.stop, "aria-keyshortcuts", flies ? "F" : "Escape");
    if (message.distance_m) this.distance.placeholder = String(message.distance_m);
    this.problem = message.problem ?? "";
    this.explain();
  }

  /** Place the panel; it stays where it is until its height changes. */
  private place(): void {
    const { offsetWidth: width, offsetHeight: height } = this.element;
    if (this.at === null || height === this.height) return;
    this.height = height;
    const [x, y] = this.at({ width, height });
    this.element.style.setProperty("--x", `${x}px`);
    this.element.style.setProperty("--y", `${y}px`);
  }

  private get mode(): FollowMode | null {
    return FOLLOW_MODES.find((mode) => this.modes[mode].getAttribute("aria-pressed") === "true") ?? null;
  }

  private explain(): void {
    setText(this.why, this.problem || this.can);
    setHidden(this.why, !this.why.textContent);
    if (this.isOpen) this.place();
  }

  private go(mode: FollowMode): void {
    const distance = this.distance.valueAsNumber;
    if (!this.can && this.unread === null) this.deeds.go(mode, Number.isFinite(distance) ? distance : null);
  }
}
