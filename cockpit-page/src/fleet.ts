// All drones found, each as a card: a click opens one alone, its second button opens it beside the others.

import { Battery } from "./battery.js";
import { h, setAttribute, setHidden, setText, setTone } from "./dom.js";
import { t } from "./language/index.js";
import type { DroneRow } from "./model.js";
import { byName, describe, titleOf } from "./row.js";

class Card {
  readonly element: HTMLElement;
  private readonly battery = new Battery();
  private readonly title = h("b");
  private readonly state = h("span", { class: "card-state" });
  private readonly owner = h("span", { class: "card-owner" });
  private readonly hops = [h("i", { class: "dot" }), h("i", { class: "dot" })];
  private readonly linked = h("span", { class: "card-links" }, ...this.hops);
  private readonly linkText = h("span", { class: "unseen" });
  private readonly recording = h("span", { class: "rec", title: t.overview.recorded }, t.overview.recordedShort);
  private readonly alarms = h("p", { class: "card-alarm" });
  private readonly beside: HTMLButtonElement;
  private readonly main: HTMLButtonElement;

  constructor(name: string, open: (name: string, alone: boolean) => void) {
    this.main = h("button", { type: "button", class: "card-main", onclick: () => open(name, true) }, h("span", { class: "unseen" }, t.overview.open), h("span", { class: "card-top" }, this.title, this.recording, this.linked), h("span", { class: "card-bottom" }, this.state, this.battery.element), this.owner, this.linkText);
    this.beside = h("button", { type: "button", class: "card-beside", title: t.overview.beside, onclick: () => open(name, false) }, "+");
    this.element = h("li", { class: "card", "data-drone": name }, this.main, this.beside, this.alarms);
  }

  update(row: DroneRow, open: boolean): void {
    const { tone, state, holder, alarm, battery, hops, links } = describe(row);
    setTone(this.element, tone);
    setText(this.title, titleOf(row));
    setText(this.state, state);
    this.battery.show(battery, row.alarms);
    setText(this.owner, holder);
    this.hops.forEach((hop, place) => setTone(hop, hops[place] ?? "quiet"));
    setAttribute(this.linked, "title", links);
    setHidden(this.recording, !row.recording);
    setText(this.alarms, alarm);
    setAttribute(this.alarms, "title", alarm);
    setHidden(this.alarms, alarm === "");
    setText(this.linkText, links);
    setAttribute(this.element, "data-open", String(open));
    setAttribute(this.beside, "aria-pressed", String(open));
    setAttribute(this.beside, "aria-label", open ? t.overview.close(row.name) : t.overview.openBeside(row.name));
    setText(this.beside, open ? "−" : "+");
  }
}

export class FleetList {
  readonly element: HTMLElement;
  private readonly list = h("ul", { class: "cards" });
  private readonly none = h("p", { class: "empty" }, t.overview.none, h("span", {}, t.overview.start), h("code", {}, "skyloop sim"));
  private readonly counted = h("span", { class: "count" });
  private readonly cards = new Map<string, Card>();

  constructor(private readonly open: (name: string, alone: boolean) => void) {
    this.element = h("nav", { class: "fleet", "aria-label": t.overview.drones }, h("h2", {}, t.overview.drones, this.counted), this.list, this.none);
  }

  update(rows: readonly DroneRow[], opened: ReadonlySet<string>): void {
    const names = new Set(rows.map((row) => row.name));
    for (const [name, card] of this.cards) {
      if (names.has(name)) continue;
      card.element.remove();
      this.cards.delete(name);
    }
    [...rows].sort(byName).forEach((row, place) => {
      let card = this.cards.get(row.name);
      if (!card) {
        card = new Card(row.name, this.open);
        this.cards.set(row.name, card);
      }
      if (this.list.children[place] !== card.element) this.list.insertBefore(card.element, this.list.children[place] ?? null);
      card.update(row, opened.has(row.name));
    });
    setText(this.counted, rows.length ? String(rows.length) : "");
    setAttribute(this.counted, "aria-label", t.overview.count(rows.length));
    setHidden(this.none, rows.length > 0);
  }
}
