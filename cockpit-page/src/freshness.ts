// The age of a pane's data: of the newest state, and of the cockpit's newest answer. A banner shows it once it is old.

import type { ServerClock } from "./clock.js";
import { STALE_MS } from "./commands.js";
import { h, setHidden, setText } from "./dom.js";
import { t } from "./language/index.js";
import type { State } from "./model.js";

export class Freshness {
  readonly element: HTMLElement;
  isOld = false;
  /** When the newest state of the drone was true, and when the cockpit last answered, on this page's clock. */
  private fresh_ms: number | null = null;
  private answered_ms = performance.now();
  private readonly age = h("b", { "aria-hidden": "true" });
  private readonly what = h("span", {});
  private readonly seen: HTMLButtonElement;

  constructor(
    private readonly name: string,
    private readonly clock: ServerClock,
    acknowledge: () => void,
  ) {
    this.seen = h("button", { type: "button", class: "small", "aria-label": t.pane.acknowledgeOld, onclick: acknowledge }, t.alarms.ok);
    this.element = h("p", { class: "banner old", role: "alert", "data-tone": "warn", hidden: true }, h("span", {}, t.pane.old), this.age, this.what, this.seen);
  }

  /** When the state was true: it may have been long on its way, and old when sent. */
  received(state: State, isRecording: boolean): void {
    const now_ms = performance.now();
    this.clock.received(now_ms, state.now_s);
    if (state.links.application === "lost") return;
    const feedback_s = isRecording ? 0 : (state.feedback?.age_s ?? 0); // a recording is always old
    this.fresh_ms = now_ms - ((this.clock.age_s(state.now_s, now_ms) ?? 0) + feedback_s) * 1000;
  }

  /**
   * Show the age if the data is old.
   *
   * @param answer_ms Age of the cockpit's newest answer; null if there is none, undefined for an observer.
   * @returns Whether it has become old, or fresh again.
   */
  update(now_ms: number, answer_ms: number | null | undefined): boolean {
    if (typeof answer_ms === "number") this.answered_ms = now_ms - answer_ms;
    const silent_ms = answer_ms === undefined ? 0 : now_ms - this.answered_ms;
    const old_ms = this.fresh_ms === null ? 0 : now_ms - this.fresh_ms;
    const age_ms = Math.max(silent_ms, old_ms);
    const isOld = age_ms > STALE_MS;
    if (isOld) {
      setText(this.age, `${(age_ms / 1000).toFixed(1)} s`);
      // A stalled cockpit ends both, and either may have come last.
      setText(this.what, silent_ms > STALE_MS ? t.pane.cockpitSilent : t.pane.nothingNew(this.name));
    }
    if (isOld === this.isOld) return false;
    this.isOld = isOld;
    setHidden(this.element, !isOld);
    return true;
  }

  /** Whether it can be acknowledged. */
  offer(can: boolean): void {
    setHidden(this.seen, !can);
  }
}
