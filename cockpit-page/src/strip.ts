// The row of a drone's flight controls.

import { h, memory, setAttribute, setDisabled, setHidden, setText, setTone } from "./dom.js";
import { lasting } from "./format.js";
import { type Countdown, type Deadly, holdButton } from "./hold.js";
import { holderText, oldHolderText } from "./instruments.js";
import type { Deed } from "./keys.js";
import { t } from "./language/index.js";
import type { Authority, Question, State, Vehicle } from "./model.js";
import type { Pilot } from "./pilot.js";
import { QuestionPanel } from "./question.js";
import { showFate } from "./safety.js";

const USUAL_PRIORITY = 8; // higher than 16, which controllers usually have

/** A button with its key beside it, and the outcome of its command on it. */
function keyed(name: string, key: string, kind: string, act: () => void): HTMLButtonElement {
  const keys = key ? h("kbd", { "aria-hidden": "true" }, key) : null;
  return h("button", { type: "button", class: kind, onclick: act, ...(key ? { "aria-keyshortcuts": key } : {}) }, h("span", {}, name), keys, h("span", { class: "fate", role: "status" }));
}

/** This page's place in the queue, in words; empty while it is not waiting. */
export function lineText({ state, holder, line }: Authority): string {
  if (state === "none" || state === "held" || line === null) return "";
  const who = holder ?? t.strip.theHolder;
  const answer = line.declined !== null ? t.strip.keeps(who, line.declined) : line.asked ? t.strip.asked(who) : "";
  const place = line.position === null ? t.strip.inLine : t.strip.number(line.position);
  return answer ? t.strip.answered(answer, place) : t.strip.you(place);
}

/** One sentence: who has control, who waits for it, and what this page can do about it. `asks`: it would ask first. */
export function nowText(authority: Authority, questions: readonly Question[], asks: boolean, priority: number): string {
  const { app, holder, mine, state } = authority;
  const names = [...new Set([...authority.waiting.filter((name) => name !== app), ...questions.map(({ by }) => by)])];
  if (mine) return t.strip.now.mine(names.length ? t.strip.now.wait(names, false) : t.strip.now.nobody, questions.some(({ declined }) => !declined));
  if (state === "queued" || state === "preempted") return t.strip.now.inLine(holder ?? t.strip.theHolder, t.strip.now.wait(names, true), state === "preempted");
  if (holder === null) return t.strip.now.free(names.length ? t.strip.now.wait(names, false) : "");
  const wins = authority.priority !== null && priority < authority.priority;
  const may = !wins ? t.strip.now.noHigher(priority) : asks ? t.strip.now.ask : t.strip.now.higher(priority);
  return t.strip.now.others(holder, names.length ? t.strip.now.wait(names, false) : t.strip.now.nobody, may);
}

export class Strip {
  readonly element: HTMLElement;
  readonly question: QuestionPanel;
  private readonly who = h("b", { class: "who" });
  private readonly more = h("span", { class: "more" });
  private readonly holder: HTMLElement;
  private readonly priority = h("input", { type: "number", class: "priority", min: 0, max: 31, step: 1, title: t.strip.priorityShort, "aria-label": t.strip.priority });
  private readonly ask = h("button", { type: "button", class: "small", title: t.strip.askLong, onclick: () => this.choose(!this.asks) }, t.strip.ask);
  private readonly line = h("span", { role: "status", "aria-label": t.strip.line });
  private readonly wait = h("span", { class: "wait", role: "timer", "aria-live": "off" });
  private readonly waiting = h("p", { class: "waiting" }, this.line, this.wait);
  private readonly now = h("p", { class: "now" });
  private readonly take: HTMLButtonElement;
  private readonly release: HTMLButtonElement;
  private readonly takeOff: HTMLButtonElement;
  private readonly hover: HTMLButtonElement;
  private readonly land: HTMLButtonElement;
  private readonly back: HTMLButtonElement;
  private readonly reset: HTMLButtonElement;
  private readonly stop: HTMLButtonElement;
  private readonly why = h("p", { class: "note" });
  private readonly endedText = h("span", {});
  private readonly ended: HTMLElement;
  private readonly buttons: readonly [string, HTMLButtonElement][];
  private free = true;
  private mustAsk = false; // another has control, with a priority that the chosen one is no higher than

  constructor(
    drone: string,
    act: (deed: Deed | "reset") => void,
    answer: (id: number, grant: boolean, reason: string) => void,
    stop: { countdown: Countdown; deadly: () => Deadly | null; understood: () => void },
  ) {
    this.question = new QuestionPanel(answer);
    this.holder = h("div", { class: "holder", role: "status", "aria-live": "polite", "aria-label": t.strip.control }, this.who, this.more);
    this.priority.value = memory.get("priority") ?? String(USUAL_PRIORITY);
    this.priority.addEventListener("change", () => memory.set("priority", this.priority.value));
    this.take = keyed(t.strip.take, "C", "primary", () => act("take"));
    this.choose(memory.get("ask-first") === "true");
    this.release = keyed(t.strip.release, "R", "", () => act("release"));
    this.takeOff = keyed(t.strip.takeOff, "T", "", () => act("takeoff"));
    this.hover = keyed(t.strip.hover, "H", "", () => act("hover"));
    this.land = keyed(t.strip.land, "L", "land", () => act("land"));
    this.back = keyed(t.strip.back, "B", "", () => act("return"));
    this.reset = keyed(t.strip.reset, "", "", () => act("reset"));
    this.stop = holdButton(stop.countdown, stop.deadly, { class: "stop", title: t.safety.hold }, h("span", {}, t.safety.off), h("span", { class: "stop-name" }, drone), h("span", { class: "fate" }));
    this.ended = h("p", { class: "ended", role: "alert", "data-tone": "bad", hidden: true }, this.endedText, h("button", { type: "button", class: "small", onclick: stop.understood }, t.strip.understood));
    this.buttons = [["take", this.take], ["release", this.release], ["takeoff", this.takeOff], ["hover", this.hover], ["land", this.land], ["return", this.back], ["reset", this.reset], ["stop", this.stop]];
    this.element = h("div", { class: "strip", role: "group", "aria-label": t.strip.label }, this.question.voice, this.question.element, this.ended, this.waiting, this.now, this.holder, h("span", { class: "taking" }, this.priority, this.ask, this.take, this.release), h("span", { class: "deeds" }, this.takeOff, this.hover, this.land, this.back, this.reset), this.why, this.stop);
  }

  /** The chosen priority, within its range. */
  get wanted(): number {
    const value = Math.round(Number(this.priority.value));
    return Number.isFinite(value) && this.priority.value !== "" ? Math.max(0, Math.min(31, value)) : USUAL_PRIORITY;
  }

  /** Whether to ask the holder first: the person wants it, or control can't be taken otherwise. */
  get asks(): boolean {
    return this.mustAsk || this.ask.getAttribute("aria-pressed") === "true";
  }

  /** `pilot` is null for an observer; `old`: the newest state is out of date. A recording has no flight controls. */
  update(vehicle: Vehicle | null, state: State | null, pilot: Pilot | null, old: boolean, recording: boolean): void {
    setHidden(this.element, recording);
    const { who, more, tone } = old ? oldHolderText(pilot?.mine ?? false) : holderText(state, pilot?.authority ?? null);
    setTone(this.holder, tone);
    setText(this.who, who);
    setText(this.more, more);
    const flies = vehicle?.can_fly ?? true;
    const [can, mine] = [flies && (pilot?.isReady ?? false), pilot?.mine ?? false];
    const emergency = state?.flight === "emergency";
    const { holder = null, priority = null } = pilot?.authority ?? {};
    this.free = holder === null;
    this.mustAsk = !this.free && !mine && (priority === null || this.wanted >= priority);
    for (const choice of [this.take, this.priority]) setHidden(choice, mine || pilot === null || !flies);
    setHidden(this.ask, this.take.hidden || this.free || this.mustAsk); // nobody to ask, or no choice
    this.nameTake();
    setHidden(this.release, !mine && !(pilot?.waits ?? false));
    setText(this.release.firstElementChild as Element, pilot?.waits ? t.strip.stopWaiting : t.strip.release);
    setText(this.line, pilot?.waits ? lineText(pilot.authority) : "");
    setHidden(this.waiting, !this.line.textContent);
    const known = pilot !== null && pilot.isReady && flies && !old && state?.links.application !== "lost";
    setText(this.now, known ? nowText(pilot.authority, pilot.questions, this.asks, this.wanted) : "");
    setHidden(this.now, pilot === null || !flies); // otherwise its place is kept even while nothing is known
    this.question.update(pilot, performance.now());
    this.count(pilot);
    setDisabled(this.take, !can);
    for (const button of [this.takeOff, this.hover, this.land, this.back]) {
      setHidden(button, pilot === null || !flies || emergency);
      setDisabled(button, !mine);
    }
    setHidden(this.reset, !emergency || pilot === null);
    setDisabled(this.reset, !mine);
    setHidden(this.stop, pilot === null || !flies);
    setText(this.why, vehicle && !flies ? t.strip.cantFly(vehicle.why_not) : pilot === null ? t.strip.watch : "");
    setHidden(this.why, !this.why.textContent);
    setAttribute(this.element, "data-mine", String(mine && !old));
    setText(this.endedText, pilot?.ended ? t.strip.lost(`${pilot.ended[0]?.toUpperCase()}${pilot.ended.slice(1)}`) : "");
    setHidden(this.ended, !this.endedText.textContent);
    for (const [what, button] of this.buttons) showFate(button, button.lastElementChild as HTMLElement, pilot?.result(what) ?? null);
  }

  /** Update the remaining times. */
  count(pilot: Pilot | null): void {
    this.question.count(pilot, performance.now());
    if (this.waiting.hidden || pilot === null) return;
    const wait_s = pilot.wait_s;
    setText(this.wait, wait_s === null ? t.strip.unknownWait : t.strip.wait(lasting(wait_s)));
  }

  private choose(asks: boolean): void {
    memory.set("ask-first", String(asks));
    setAttribute(this.ask, "aria-pressed", String(asks));
    this.nameTake();
  }

  private nameTake(): void {
    setText(this.take.firstElementChild as Element, this.asks && !this.free ? t.strip.askForControl : t.strip.take);
  }
}
