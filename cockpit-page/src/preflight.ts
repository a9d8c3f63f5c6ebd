// Pre-flight: the cockpit's checklist for a drone, and the question before a take-off despite a finding.

import { errorText, get } from "./api.js";
import { h, setText, setTone } from "./dom.js";
import { t } from "./language/index.js";

export interface Finding {
  check: string;
  level: "ok" | "warn" | "fail";
  detail: string;
  why: string;
  remedy: string;
}

/** Older findings say nothing about now. */
const OLD_MS = 45_000;
/** Interval between checks before a flight. */
const AGAIN_MS = 15_000;
/** A second take-off within this time answers the question. */
const ANSWER_MS = 8000;
/** A sooner press is no answer: it leaves no time to read the question. */
const READ_MS = 600;
const MARKS = { ok: "✓", warn: "!", fail: "✗" } as const;
const TONES = { ok: "ok", warn: "warn", fail: "bad" } as const;

/** Asks for confirmation of a take-off despite findings. The pilot decides. Pure. */
export class TakeOffQuestion {
  private asked_ms = Number.NEGATIVE_INFINITY;
  private asked = "";

  /** The question, in words; empty if the drone should take off now. */
  ask(findings: readonly Finding[], age_ms: number, now_ms: number): string {
    const against = age_ms > OLD_MS ? [] : findings.filter(({ level }) => level === "fail");
    const words = against.map(({ check, detail, why }) => `${check}: ${detail}${why ? ` – ${why}` : ""}`).join("; ");
    const since_ms = now_ms - this.asked_ms;
    const answered = words === this.asked && since_ms <= ANSWER_MS;
    if (!words || (answered && since_ms >= READ_MS)) {
      this.asked = "";
      return "";
    }
    if (!answered) this.asked_ms = now_ms;
    this.asked = words;
    return t.preflight.notReadyAsk(words, ANSWER_MS / 1000);
  }
}

export class Preflight {
  readonly element: HTMLElement;
  private findings: readonly Finding[] = [];
  private read_ms = Number.NEGATIVE_INFINITY;
  private tried_ms = Number.NEGATIVE_INFINITY;
  private reading = false;
  private readonly question = new TakeOffQuestion();
  private readonly list = h("ul", { class: "preflight", tabindex: 0, "aria-label": t.preflight.label });
  private readonly sum = h("p", { class: "note preflight-sum", role: "status" }, t.preflight.unchecked);

  constructor(private readonly drone: string) {
    const again = h("button", { type: "button", class: "small", onclick: () => void this.load() }, t.preflight.again);
    this.element = h("div", { class: "filling" }, h("div", { class: "filters" }, this.sum, again), this.list);
  }

  /** Check periodically while it is about to be flown from here. */
  watch(about: boolean, now_ms: number): void {
    if (about && now_ms - this.tried_ms > AGAIN_MS) void this.load();
  }

  /** The question before a take-off; see `TakeOffQuestion.ask`. */
  ask(now_ms: number): string {
    return this.question.ask(this.findings, now_ms - this.read_ms, now_ms);
  }

  async load(): Promise<void> {
    if (this.reading) return;
    this.reading = true;
    this.tried_ms = performance.now();
    try {
      this.findings = await get<Finding[]>(`/api/drones/${encodeURIComponent(this.drone)}/preflight`);
      this.read_ms = performance.now();
      this.show();
    } catch (error) {
      this.findings = [];
      this.list.replaceChildren();
      setTone(this.sum, "warn");
      setText(this.sum, t.preflight.notChecked(errorText(error)));
    } finally {
      this.reading = false;
    }
  }

  private show(): void {
    const count = (level: Finding["level"]): number => this.findings.filter((one) => one.level === level).length;
    const [bad, warn] = [count("fail"), count("warn")];
    setTone(this.sum, bad ? "bad" : warn ? "warn" : "ok");
    setText(this.sum, bad ? t.preflight.notReady(bad, this.findings.length, warn) : warn ? t.preflight.readyBut(warn) : t.preflight.ready);
    const rank = { fail: 0, warn: 1, ok: 2 } as const;
    const sorted = [...this.findings].sort((a, b) => rank[a.level] - rank[b.level]);
    this.list.replaceChildren(...sorted.map(row));
  }
}

function row({ check, level, detail, why, remedy }: Finding): HTMLElement {
  return h(
    "li",
    { "data-tone": TONES[level] },
    h("span", { class: "mark", role: "img", "aria-label": t.preflight.levels[level] }, MARKS[level]),
    h("div", {}, h("b", {}, check), ` ${detail}`, why ? h("p", {}, why) : null, remedy ? h("p", { class: "remedy" }, `→ ${remedy}`) : null),
  );
}
