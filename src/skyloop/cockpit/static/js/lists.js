// The list of events, newest first, and the table of channels.

import { byId, duration, figure, setText, setTone } from "./dom.js";

const KEPT = 120;
const TONES = { info: "quiet", warning: "warn", error: "bad" };
const clock = new Intl.DateTimeFormat(undefined, { hour: "2-digit", minute: "2-digit", second: "2-digit", hour12: false });

export class Events {
  constructor() {
    this.list = byId("events");
    this.clear();
  }

  clear() {
    this.empty = true;
    const nothing = document.createElement("li");
    nothing.className = "muted";
    nothing.textContent = "None yet.";
    this.list.replaceChildren(nothing);
  }

  add(events) {
    if (events.length === 0) return;
    if (this.empty) this.list.replaceChildren();
    this.empty = false;
    for (const event of events) this.list.prepend(this.entry(event));
    while (this.list.children.length > KEPT) this.list.lastElementChild.remove();
  }

  entry(event) {
    const item = document.createElement("li");
    item.dataset.kind = event.kind;
    setTone(item, TONES[event.severity] ?? "quiet");
    const at = new Date(Date.now() - event.age_s * 1000);
    const time = document.createElement("time");
    time.dateTime = at.toISOString();
    time.textContent = clock.format(at);
    const dot = document.createElement("span");
    dot.className = "dot";
    dot.setAttribute("role", "img");
    dot.setAttribute("aria-label", event.severity);
    const text = document.createElement("span");
    text.className = "text";
    text.textContent = event.text;
    if (event.app) {
      const who = document.createElement("span");
      who.className = "who";
      who.textContent = ` · ${event.app}`;
      text.append(who);
    }
    item.append(time, dot, text);
    return item;
  }
}

export class Channels {
  constructor() {
    this.body = byId("channels");
    this.rows = new Map();
  }

  update(channels) {
    for (const [name, stats] of Object.entries(channels)) {
      if (!stats.count && !stats.delay_s && !this.rows.has(name)) continue; // nobody asked for it yet
      const cells = this.rows.get(name) ?? this.row(name);
      const values = [
        stats.count ? `${figure(stats.rate_hz, 1)} Hz` : "–",
        duration(stats.delay_s?.median),
        duration(stats.delay_s?.p99),
        duration(stats.age_s),
        String(stats.lost),
      ];
      values.forEach((value, index) => setText(cells[index], value));
    }
  }

  row(name) {
    const row = document.createElement("tr");
    const title = document.createElement("th");
    title.scope = "row";
    title.textContent = name;
    const cells = Array.from({ length: 5 }, () => document.createElement("td"));
    row.append(title, ...cells);
    this.body.append(row);
    this.rows.set(name, cells);
    return cells;
  }
}
