// The events of a drone.

import { h, type Tone } from "./dom.js";
import { words } from "./format.js";
import { t } from "./language/index.js";
import type { DroneEvent } from "./model.js";

const MOST_EVENTS = 300;
const TONES: Readonly<Record<string, Tone>> = { info: "quiet", warning: "warn", error: "bad" };

/** The list of events, newest first, filtered by words and severity. */
export class Events {
  readonly element: HTMLElement;
  private readonly list = h("ol", { class: "events", tabindex: 0, "aria-label": t.events.label });
  private readonly words = h("input", { type: "search", placeholder: t.events.filter, "aria-label": t.events.filterLong, oninput: () => this.filter() });
  private readonly severity = h("select", { "aria-label": t.events.severity, onchange: () => this.filter() }, h("option", { value: "" }, t.events.all), h("option", { value: "warning" }, t.events.warnings), h("option", { value: "error" }, t.events.errors));
  private readonly none = h("p", { class: "empty" }, t.events.none);
  private readonly shown: { event: DroneEvent; row: HTMLElement }[] = [];
  private newest = 0;

  constructor() {
    this.element = h("div", { class: "filling" }, h("div", { class: "filters" }, this.words, this.severity), this.list, this.none);
  }

  /** Add events that are not listed yet; returns them. */
  add(events: readonly DroneEvent[]): DroneEvent[] {
    const fresh = events.filter((event) => event.n > this.newest);
    for (const event of fresh) {
      this.newest = event.n;
      const row = rowOf(event);
      this.list.prepend(row);
      this.shown.push({ event, row });
      if (this.shown.length > MOST_EVENTS) this.shown.shift()?.row.remove();
    }
    if (fresh.length) this.filter();
    return fresh;
  }

  /** The cockpit was restarted and counts from 1 again. */
  restart(): void {
    this.newest = 0;
    this.shown.length = 0;
    this.list.replaceChildren();
  }

  private filter(): void {
    const needle = this.words.value.trim().toLowerCase();
    let any = false;
    for (const { event, row } of this.shown) {
      row.hidden = !passes(event, needle, this.severity.value);
      any ||= !row.hidden;
    }
    this.none.hidden = any;
  }
}

/** Whether an event passes the filter. */
export function passes(event: DroneEvent, needle: string, severity: string): boolean {
  const grades = ["info", "warning", "error"];
  if (grades.indexOf(event.severity) < grades.indexOf(severity || "info")) return false;
  return !needle || `${event.kind} ${words(event.kind)} ${event.text} ${event.app}`.toLowerCase().includes(needle);
}

function rowOf(event: DroneEvent): HTMLElement {
  const at = new Date(Date.now() - event.age_s * 1000);
  const time = h("time", { datetime: at.toISOString() }, at.toLocaleTimeString("en-GB"));
  const text = h("span", { class: "what" }, event.text || words(event.kind), event.app ? h("span", { class: "who" }, ` ${event.app}`) : null);
  return h("li", { "data-tone": TONES[event.severity] ?? "quiet", "data-kind": event.kind, title: words(event.kind) }, time, h("i", { class: "dot" }), text);
}
