// Rates, delays, ages and losses of the channels, as the cockpit receives them.

import { h, setText } from "./dom.js";
import { figure, type Known } from "./format.js";
import { t } from "./language/index.js";
import type { Channel, State } from "./model.js";

const COLUMNS: readonly (readonly [string, string])[] = [
  ["/s", t.channels.rate],
  [t.channels.delayHead, t.channels.delay],
  ["p99", t.channels.p99],
  [t.channels.ageHead, t.channels.age],
  [t.channels.lostHead, t.channels.lost],
  [t.channels.dropHead, t.channels.dropped],
];

export class Channels {
  readonly element: HTMLElement;
  private readonly body = h("tbody");

  constructor() {
    const columns = COLUMNS.map(([name, title]) => h("th", { scope: "col" }, h("abbr", { title }, name)));
    const head = h("tr", {}, h("th", { scope: "col" }, t.channels.channel), ...columns);
    const label = t.channels.label;
    this.element = h("section", { class: "channels scroll", tabindex: 0, "aria-label": label }, h("table", {}, h("thead", {}, head), this.body));
  }

  update(state: State): void {
    const names = Object.keys(state.channels).sort();
    const rows = this.body.rows;
    if (names.join() !== [...rows].map((row) => row.dataset["name"]).join()) {
      this.body.replaceChildren(...names.map((name) => h("tr", { "data-name": name }, h("th", { scope: "row" }, name), ...COLUMNS.map(() => h("td")))));
    }
    names.forEach((name, place) => {
      const cells = cellsOf(state.channels[name] as Channel);
      [...(rows[place] as HTMLTableRowElement).cells].slice(1).forEach((cell, column) => setText(cell, cells[column] as string));
    });
  }
}

/** Milliseconds, with a decimal below 10 ms; seconds from 10 s. */
export function milliseconds(seconds: Known): string {
  if (seconds === null || seconds === undefined) return "–";
  if (Math.abs(seconds) >= 10) return `${figure(seconds, 0)} s`;
  return figure(seconds * 1000, Math.abs(seconds) < 0.01 ? 1 : 0);
}

function cellsOf(channel: Channel): string[] {
  const { rate_hz, delay_s, age_s, lost, dropped } = channel;
  return [figure(rate_hz, 0), milliseconds(delay_s?.median), milliseconds(delay_s?.p99), milliseconds(age_s), String(lost), String(dropped)];
}
