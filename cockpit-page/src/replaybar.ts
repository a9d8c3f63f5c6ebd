// The bar of a replay, below its pictures: position, pause, speed, marks. It shows the position that the replay reports, so
// that all pages agree; only while it is dragged it shows the hand's position.

import { errorText, get, post } from "./api.js";
import { h, setAttribute, setDisabled, setHidden, setText, svg, unique } from "./dom.js";
import { t } from "./language/index.js";
import { clamped, fine, type Mark, nearest, next, type Playback, type Replayed, SPEEDS, step, type Tick, ticksOf, type Timeline } from "./replaytime.js";

// A mark or event this close is meant by a pointer.
const NEAR_PX = 7;
const NEAR_TOUCH_PX = 16;
const APART_S = 0.3; // nearer marks and events count as the present position
const KEPT_MS = 900; // how long a requested position is shown before the replay confirms it
const NOTES_MS = 5000; // interval between reads of marks that other pages made
const KEYS = "ArrowLeft ArrowRight ArrowUp ArrowDown Home End PageUp PageDown Space Comma Period";

/** Drawn, because not every system's fonts have these symbols. */
const ICONS: Readonly<Record<"play" | "pause" | "again" | "earlier" | "later", string>> = {
  play: "M5 3l12 7-12 7z",
  pause: "M5 3h3.6v14H5zM11.4 3H15v14h-3.6z",
  again: "M10 4V1L5 5l5 4V6a5 5 0 1 1-5 5H3a7 7 0 1 0 7-7z",
  earlier: "M4 4h2.2v12H4zM16 4v12L7 10z",
  later: "M13.8 4H16v12h-2.2zM4 4l9 6-9 6z",
};
const icon = (name: keyof typeof ICONS): SVGElement => svg("svg", { viewBox: "0 0 20 20", class: "replay-icon", "aria-hidden": "true" }, svg("path", { d: ICONS[name] }));

export interface ReplayHost {
  /** The recording's flight is known now, or no longer. */
  known(timeline: Timeline | null): void;
  notify(text: string): void;
}

export class ReplayBar {
  readonly element: HTMLElement;
  private playback: Playback | null = null;
  private over = false;
  private replayed: Replayed | null = null;
  private ticks: Tick[] = [];
  private asked: { position_s: number; until_ms: number } | null = null;
  private dragging = false;
  private gone = false;
  private wanted: object | null = null; // to be sent after the request under way
  private sending = false;
  private notes_ms = 0;
  private marking_s = 0;
  private drawn = "";

  private readonly fill = h("i", { class: "replay-fill" });
  private readonly head = h("i", { class: "replay-head" });
  private readonly marks = h("div", { class: "replay-ticks", "aria-hidden": "true" });
  private readonly hint = h("span", { class: "replay-hint", hidden: true, "aria-hidden": "true" });
  private readonly rail = h("div", { class: "replay-rail" }, h("i", { class: "replay-line" }), this.fill, this.marks, this.head, this.hint);
  private readonly slider: HTMLElement;
  private readonly play = h("button", { type: "button", class: "replay-play", onclick: () => this.toggle() });
  private readonly earlier = h("button", { type: "button", class: "small square", "aria-label": t.replay.earlier, title: t.replay.earlier, onclick: () => this.hop(-1) }, icon("earlier"));
  private readonly later = h("button", { type: "button", class: "small square", "aria-label": t.replay.later, title: t.replay.later, onclick: () => this.hop(1) }, icon("later"));
  private readonly now = h("b", {}, "0:00.0");
  private readonly total = h("span", {});
  private readonly speed = h("select", { class: "replay-speed", "aria-label": t.replay.speed, onchange: () => this.setSpeed() });
  private readonly mark = h("button", { type: "button", class: "small", onclick: () => this.markHere() }, t.replay.mark);
  private readonly text = h("input", { id: unique("mark"), type: "text", maxlength: 200, placeholder: t.replay.markText, "aria-label": t.replay.markText, autocomplete: "off", enterkeyhint: "done" });
  private readonly form = h("form", { class: "replay-form", hidden: true, onsubmit: (event: Event) => void this.saveMark(event) }, this.text, h("button", { type: "submit", class: "small primary" }, t.replay.save), h("button", { type: "button", class: "small", onclick: () => this.closeForm() }, t.replay.cancel));

  constructor(
    private readonly name: string,
    private readonly pilots: boolean,
    private readonly host: ReplayHost,
  ) {
    this.speed.append(...SPEEDS.map((speed) => h("option", { value: speed }, `${speed}×`)));
    this.slider = h("div", { class: "replay-slider", role: "slider", tabindex: 0, "data-keys": KEYS, "aria-label": t.replay.position, "aria-valuemin": 0, "aria-disabled": !pilots ? "true" : "false" }, this.rail);
    this.listen();
    const row = h("div", { class: "replay-row" }, this.play, this.earlier, this.later, h("p", { class: "replay-time" }, this.now, this.total), h("span", { class: "spring" }), this.mark, this.speed);
    this.element = h("section", { class: "replay", hidden: true, "aria-label": t.replay.bar }, this.slider, this.form, row);
    for (const button of [this.play, this.earlier, this.later, this.mark]) setHidden(button, !pilots);
    setDisabled(this.speed, !pilots);
    if (!pilots) this.element.title = t.replay.watch;
    void this.load();
  }

  /** `over`: whether the replay has reached its end. */
  update(playback: Playback | null, over: boolean, now_ms: number): void {
    this.playback = playback ?? this.playback;
    this.over = over;
    setHidden(this.element, this.playback === null);
    if (this.playback === null) return;
    this.paint(now_ms);
    if (now_ms - this.notes_ms > NOTES_MS && this.replayed && !document.hidden) void this.refresh(now_ms);
  }

  private get shown_s(): number {
    if (this.asked) return this.asked.position_s;
    return this.over ? (this.playback?.duration_s ?? 0) : (this.playback?.position_s ?? 0);
  }

  private paint(now_ms: number): void {
    const { duration_s, speed, paused, position_s } = this.playback as Playback;
    if (this.asked && !this.dragging && (now_ms > this.asked.until_ms || Math.abs(position_s - this.asked.position_s) < 0.05)) this.asked = null;
    const at_s = clamped(this.shown_s, duration_s);
    const share = `${duration_s > 0 ? (at_s / duration_s) * 100 : 0}%`;
    this.fill.style.width = share;
    this.head.style.left = share;
    setText(this.now, fine(at_s));
    setText(this.total, ` / ${fine(duration_s)}`);
    setAttribute(this.slider, "aria-valuemax", duration_s.toFixed(1));
    setAttribute(this.slider, "aria-valuenow", at_s.toFixed(1));
    setAttribute(this.slider, "aria-valuetext", t.replay.at(fine(at_s), fine(duration_s)));
    const plays = !paused && !this.over;
    const sign = plays ? "pause" : this.over ? "again" : "play";
    if (this.play.dataset["sign"] !== sign) this.play.replaceChildren(icon(sign));
    setAttribute(this.play, "data-sign", sign);
    setAttribute(this.play, "aria-label", plays ? t.replay.pause : this.over ? t.replay.again : t.replay.play);
    setAttribute(this.element, "data-paused", String(paused));
    setAttribute(this.element, "data-position", position_s.toFixed(3));
    if (document.activeElement !== this.speed) this.showSpeed(speed);
    setText(this.mark, this.here() ? t.replay.unmark : t.replay.mark);
    setDisabled(this.mark, this.replayed === null);
    setDisabled(this.earlier, next(this.ticks, at_s, -1, APART_S) === null);
    setDisabled(this.later, next(this.ticks, at_s, 1, APART_S) === null);
    this.drawTicks(duration_s);
  }

  private showSpeed(speed: number): void {
    if (!SPEEDS.includes(speed) && ![...this.speed.options].some((one) => Number(one.value) === speed)) this.speed.append(h("option", { value: speed }, `${speed}×`));
    this.speed.value = String(speed);
  }

  private drawTicks(duration_s: number): void {
    const key = JSON.stringify([this.ticks, duration_s]);
    if (key === this.drawn) return;
    this.drawn = key;
    this.marks.replaceChildren(
      ...this.ticks.map((tick) => {
        const one = h("i", { "data-kind": tick.kind });
        one.style.left = `${(clamped(tick.at_s, duration_s) / duration_s) * 100}%`;
        return one;
      }),
    );
  }

  // By hand ------------------------------------------------------------------------------------------------------------

  private listen(): void {
    const { slider } = this;
    slider.addEventListener("pointermove", (event) => this.point(event));
    slider.addEventListener("pointerleave", () => setHidden(this.hint, !this.dragging));
    if (!this.pilots) return;
    slider.addEventListener("pointerdown", (event) => {
      if (event.button !== 0) return;
      slider.setPointerCapture(event.pointerId);
      this.dragging = true;
      this.point(event);
      this.seek(this.pointed(event, true));
    });
    const end = (event: PointerEvent): void => {
      if (!this.dragging) return;
      this.dragging = false;
      setHidden(this.hint, true);
      if (event.type === "pointerup") this.seek(this.pointed(event, true));
    };
    slider.addEventListener("pointerup", end);
    slider.addEventListener("pointercancel", end);
    slider.addEventListener("keydown", (event) => this.key(event));
    this.form.addEventListener("keydown", (event) => event.key === "Escape" && this.closeForm());
  }

  /** The position under the pointer; `snap`: of the mark or event there. */
  private pointed(event: PointerEvent, snap: boolean): number {
    const duration_s = this.playback?.duration_s ?? 0;
    const box = this.rail.getBoundingClientRect();
    const at_s = clamped(((event.clientX - box.left) / Math.max(1, box.width)) * duration_s, duration_s);
    return snap ? (this.near(event, at_s)?.at_s ?? at_s) : at_s;
  }

  private near(event: PointerEvent, at_s: number): Tick | null {
    const pixels = event.pointerType === "touch" ? NEAR_TOUCH_PX : NEAR_PX;
    return nearest(this.ticks, at_s, (pixels * (this.playback?.duration_s ?? 0)) / Math.max(1, this.rail.clientWidth));
  }

  private point(event: PointerEvent): void {
    const at_s = this.pointed(event, false);
    const tick = this.near(event, at_s);
    const duration_s = this.playback?.duration_s ?? 1;
    setText(this.hint, tick ? `${fine(tick.at_s)} · ${tick.text || t.replay.marked}` : fine(at_s));
    const share = Math.min(0.9, Math.max(0.1, (tick?.at_s ?? at_s) / duration_s));
    this.hint.style.left = `${share * 100}%`;
    setHidden(this.hint, false);
    if (this.dragging) this.seek(at_s);
  }

  private key(event: KeyboardEvent): void {
    if (event.ctrlKey || event.altKey || event.metaKey || this.playback === null) return;
    const by = event.key === "," || event.key === "." ? (event.key === "," ? -0.1 : 0.1) : step(event.key, event.shiftKey);
    if (event.key === " ") {
      if (!event.repeat) this.toggle();
    } else if (by === null) return;
    else this.seek(clamped(this.shown_s + by, this.playback.duration_s));
    event.preventDefault();
  }

  private toggle(): void {
    if (this.playback) this.send({ paused: !this.playback.paused && !this.over });
  }

  private hop(side: 1 | -1): void {
    const tick = next(this.ticks, this.shown_s, side, APART_S);
    if (tick) this.seek(tick.at_s);
  }

  private setSpeed(): void {
    this.send({ speed: Number(this.speed.value) });
    this.speed.blur();
  }

  private seek(position_s: number): void {
    const rounded = Math.round(position_s * 1000) / 1000;
    this.asked = { position_s: rounded, until_ms: performance.now() + KEPT_MS };
    this.send({ position_s: Math.min(rounded, this.playback?.duration_s ?? rounded) });
    this.paint(performance.now());
  }

  /** The replay is gone, so its position can't be changed any more; or it is back. */
  end(gone: boolean): void {
    this.gone = gone;
    this.element.inert = gone;
  }

  /** Send one request at a time; changes wanted meanwhile are merged into the next one. */
  private send(wanted: object): void {
    if (this.gone) return;
    this.wanted = { ...this.wanted, ...wanted };
    if (!this.sending) void this.transmit();
  }

  private async transmit(): Promise<void> {
    this.sending = true;
    while (this.wanted !== null) {
      const wanted = this.wanted;
      this.wanted = null;
      try {
        await post(`/api/replays/${encodeURIComponent(this.name)}`, wanted);
      } catch (error) {
        this.asked = null;
        this.host.notify(errorText(error));
      }
      if (this.asked) this.asked.until_ms = performance.now() + KEPT_MS;
    }
    this.sending = false;
  }

  // Marks --------------------------------------------------------------------------------------------------------------

  private async load(): Promise<void> {
    try {
      this.know(await get<Replayed>(`/api/replays/${encodeURIComponent(this.name)}`));
      this.host.known(this.replayed?.timeline ?? null);
    } catch {
      // started elsewhere: it can be moved, but its file is unknown
    }
  }

  private know(replayed: Replayed): void {
    this.replayed = replayed;
    this.ticks = ticksOf(replayed);
  }

  private get path(): string {
    return `/api/recordings/${encodeURIComponent(this.replayed?.recording ?? "")}`;
  }

  /** Marks made by other pages. */
  private async refresh(now_ms: number): Promise<void> {
    this.notes_ms = now_ms;
    try {
      await this.change(get(`${this.path}/notes`));
    } catch {
      // the next time
    }
  }

  private async change(answer: Promise<unknown>): Promise<void> {
    const notes = (await answer) as Replayed["notes"];
    if (this.replayed) this.know({ ...this.replayed, notes });
  }

  /** The mark at the position shown; null if there is none. */
  private here(): Mark | null {
    return this.replayed?.notes.marks.find((mark) => Math.abs(mark.at_s - this.shown_s) < APART_S / 2) ?? null;
  }

  private markHere(): void {
    const mark = this.here();
    if (mark) {
      void this.change(post(`${this.path}/marks/remove`, mark)).catch((error: unknown) => this.host.notify(errorText(error)));
      return;
    }
    this.marking_s = clamped(this.shown_s, this.playback?.duration_s ?? 0);
    setHidden(this.form, false);
    this.text.focus();
  }

  private async saveMark(event: Event): Promise<void> {
    event.preventDefault();
    try {
      await this.change(post(`${this.path}/marks`, { at_s: this.marking_s, text: this.text.value.trim() }));
      this.closeForm();
    } catch (error) {
      this.host.notify(errorText(error));
    }
  }

  private closeForm(): void {
    this.text.value = "";
    setHidden(this.form, true);
    this.mark.focus();
  }
}
