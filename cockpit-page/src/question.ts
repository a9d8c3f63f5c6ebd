// A request for this page's control: from whom, for how long, until when, and the person's answer.
//
// It does not take the focus, which may be on a button that flies: a key moves the focus there. Nor can it be answered
// in its first moment: that press was meant for something else.

import { h, setAttribute, setDisabled, setHidden, setText, unique } from "./dom.js";
import { lasting } from "./format.js";
import { t } from "./language/index.js";
import type { Question } from "./model.js";
import type { Pilot } from "./pilot.js";

/** A question can't be answered earlier than this after it appeared. */
export const UNREAD_MS = 600;
const MOST_REASON = 200; // maximum length of a reason

/** Who finally gets control, whatever the answer. */
export const wins = (question: Question, own: number | null): boolean => own !== null && question.priority < own;

/** The questions to show: a declined one only if its higher priority will get control anyway. */
export const pending = (questions: readonly Question[], own: number | null): Question[] =>
  questions.filter((one) => !one.declined || wins(one, own));

/** A question in sentences. `own`: the priority with which this page has control; `more`: how many others ask. */
export function explained(question: Question, own: number | null, more: number): string {
  const others = more > 0 ? [t.question.more(more)] : [];
  if (question.declined) return [t.question.keepForNow, ...others].join(" ");
  const length = question.for_s === null ? t.question.unspecified : t.question.wantedFor(lasting(question.for_s));
  const end = wins(question, own) ? t.question.higher : t.question.notHigher;
  return [t.question.priority(question.priority, String(own ?? "–"), end), length, ...others].join(" ");
}

export class QuestionPanel {
  readonly element: HTMLElement;
  /** For screen readers. */
  readonly voice = h("p", { class: "unseen", "aria-live": "assertive", "aria-atomic": "true" });
  private readonly title = h("h3", { id: unique("asks") });
  private readonly text = h("p", { id: unique("asks-text"), class: "asks-text" });
  private readonly left = h("b", {});
  private readonly reason = h("input", { type: "text", maxlength: MOST_REASON, placeholder: t.question.reasonShort, "aria-label": t.question.reason, autocomplete: "off", enterkeyhint: "send" });
  private readonly keep = h("button", { type: "submit" }, t.question.keep);
  private readonly handOver = h("button", { type: "button", class: "primary", onclick: () => this.reply(true) }, t.question.handOver);
  private shown: Question | null = null;
  private since_ms = 0;

  constructor(private readonly answer: (id: number, grant: boolean, reason: string) => void) {
    const time = h("p", { class: "asks-left", role: "timer", "aria-live": "off" }, this.left, t.question.left);
    const form = h("form", { class: "asks-form", onsubmit: (event: Event) => this.submit(event) }, this.reason, this.keep, this.handOver);
    const marks = { role: "alertdialog", "aria-modal": "false", "aria-labelledby": this.title.id, "aria-describedby": this.text.id, "aria-keyshortcuts": "Q" };
    this.element = h("section", { class: "asks", tabindex: -1, hidden: true, "data-tone": "warn", ...marks }, this.title, time, this.text, form);
  }

  get isOpen(): boolean {
    return !this.element.hidden;
  }

  focus(): void {
    if (this.isOpen) this.element.focus({ preventScroll: true }); // it is visible at any scroll position
  }

  /** `now_ms`: on the clock that measures the time to read. */
  update(pilot: Pilot | null, now_ms: number): void {
    const own = pilot?.authority.priority ?? null;
    const asked = pilot?.mine ? pending(pilot.questions, own) : [];
    // The visible question stays until it is over, whatever other requests arrive.
    const question = asked.find((one) => one.id === this.shown?.id) ?? asked[0] ?? null;
    if (question?.id !== this.shown?.id) {
      this.since_ms = now_ms;
      this.reason.value = "";
    }
    this.shown = question;
    if (question === null) {
      this.close();
      return;
    }
    const text = explained(question, own, asked.length - 1);
    setText(this.title, question.declined ? t.question.stillAsks(question.by) : t.question.asks(question.by));
    setText(this.text, text);
    setText(this.voice, t.question.voice(this.title.textContent, text));
    setHidden(this.reason, question.declined);
    setHidden(this.keep, question.declined);
    setHidden(this.element, false);
    this.count(pilot, now_ms);
  }

  count(pilot: Pilot | null, now_ms: number): void {
    if (this.shown === null || pilot === null) return;
    const left_s = pilot.left_s(this.shown);
    setText(this.left, `${Math.ceil(left_s)} s`);
    setAttribute(this.element, "data-tone", left_s <= 3 ? "bad" : "warn");
    for (const button of [this.keep, this.handOver]) setDisabled(button, now_ms - this.since_ms < UNREAD_MS);
  }

  private close(): void {
    // Otherwise the focus would go nowhere, and a text field would keep the keys.
    if (this.element.contains(document.activeElement)) this.element.closest<HTMLElement>(".pane")?.focus({ preventScroll: true });
    setHidden(this.element, true);
    setText(this.voice, "");
  }

  private submit(event: Event): void {
    event.preventDefault();
    if (!this.keep.disabled) this.reply(false);
  }

  private reply(grant: boolean): void {
    if (this.shown) this.answer(this.shown.id, grant, grant ? "" : this.reason.value.trim());
  }
}
