// Many drones, one in each line: sorted by a column, opened by a click.

import { Battery } from "./battery.js";
import { h, setAttribute, setText, setTone } from "./dom.js";
import { t } from "./language/index.js";
import type { DroneRow } from "./model.js";
import { type Column, describe, height, sorted } from "./row.js";
import { OWN_WORDS, type Own } from "./tile.js";

const COLUMNS: readonly { key: Column; title: string }[] = [
  { key: "name", title: t.overview.drone },
  { key: "state", title: t.overview.state },
  { key: "altitude", title: t.overview.height },
  { key: "battery", title: t.overview.battery },
  { key: "holder", title: t.overview.control },
  { key: "alarm", title: t.overview.alarms },
];

class Line {
  readonly element: HTMLElement;
  private readonly battery = new Battery();
  private readonly hops = [h("i", { class: "dot" }), h("i", { class: "dot" })];
  private readonly links = h("span", { class: "card-links" }, ...this.hops);
  private readonly cells = { state: h("td", {}), altitude: h("td", { class: "number" }), holder: h("td", {}), alarm: h("td", { class: "line-alarm" }) };

  constructor(name: string, open: () => void) {
    const { state, altitude, holder, alarm } = this.cells;
    const button = h("button", { type: "button", class: "line-name", "aria-label": t.overview.openDrone(name) }, name);
    this.element = h("tr", { "data-drone": name, onclick: open }, h("th", { scope: "row" }, button, this.links), state, altitude, h("td", {}, this.battery.element), holder, alarm);
  }

  update(row: DroneRow, own: Own): void {
    const { tone, state, holder, alarm, alarmTone, battery, hops, links } = describe(row);
    setTone(this.element, tone);
    setText(this.cells.state, state.split(" · ")[0] ?? "");
    setText(this.cells.altitude, height(row.altitude));
    this.battery.show(battery, row.alarms);
    setText(this.cells.holder, OWN_WORDS[own] || holder);
    setText(this.cells.alarm, alarm);
    setTone(this.cells.alarm, alarmTone);
    this.hops.forEach((hop, place) => setTone(hop, hops[place] ?? "quiet"));
    setAttribute(this.links, "title", links);
  }
}

export class DroneTable {
  readonly element: HTMLElement;
  private readonly body = h("tbody");
  private readonly heads: HTMLElement[];
  private readonly lines = new Map<string, Line>();
  private order: { column: Column; down: boolean } = { column: "name", down: false };

  constructor(
    private readonly open: (name: string) => void,
    private readonly changed: () => void,
  ) {
    this.heads = COLUMNS.map(({ key, title }) => h("th", { scope: "col", "data-column": key }, h("button", { type: "button", class: "bare", onclick: () => this.sort(key) }, title)));
    this.element = h("div", { class: "lines", tabindex: 0, role: "region", "aria-label": t.overview.lines }, h("table", {}, h("thead", {}, h("tr", {}, ...this.heads)), this.body));
    this.mark();
  }

  update(rows: readonly DroneRow[], own: (name: string) => Own): void {
    const wanted = new Set(rows.map((row) => row.name));
    for (const [name, line] of this.lines) {
      if (wanted.has(name)) continue;
      line.element.remove();
      this.lines.delete(name);
    }
    sorted(rows, this.order.column, this.order.down).forEach((row, place) => {
      let line = this.lines.get(row.name);
      if (!line) {
        line = new Line(row.name, () => this.open(row.name));
        this.lines.set(row.name, line);
      }
      if (this.body.children[place] !== line.element) this.body.insertBefore(line.element, this.body.children[place] ?? null);
      line.update(row, own(row.name));
    });
  }

  private sort(column: Column): void {
    this.order = { column, down: column === this.order.column && !this.order.down };
    this.mark();
    this.changed();
  }

  private mark(): void {
    for (const head of this.heads) setAttribute(head, "aria-sort", head.dataset["column"] !== this.order.column ? "none" : this.order.down ? "descending" : "ascending");
  }
}
