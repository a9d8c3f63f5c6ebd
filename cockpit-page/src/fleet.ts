// All drones that were found, each in a card: a click opens one alone, its second button opens it beside the others.

import { Battery } from "./battery.js";
import { count, figure, words } from "./format.js";
import { h, setAttribute, setHidden, setText, setTone, type Tone } from "./dom.js";
import type { DroneRow } from "./model.js";
import { isRecording } from "./safety.js";

const LINKS: Readonly<Record<string, Tone>> = { up: "ok", degraded: "warn", connecting: "busy", lost: "bad", closed: "bad" };

class Card {
  readonly element: HTMLElement;
  private readonly battery = new Battery();
  private readonly state = h("span", { class: "card-state" });
  private readonly owner = h("span", { class: "card-owner" });
  private readonly hops = [h("i", { class: "dot" }), h("i", { class: "dot" })];
  private readonly linked = h("span", { class: "card-links" }, ...this.hops);
  private readonly recording = h("span", { class: "rec", title: "being recorded" }, "REC");
  private readonly alarms = h("p", { class: "card-alarm" });
  private readonly beside: HTMLButtonElement;
  private readonly main: HTMLButtonElement;

  constructor(name: string, open: (name: string, alone: boolean) => void) {
    this.main = h("button", { type: "button", class: "card-main", onclick: () => open(name, true) }, h("span", { class: "card-top" }, h("b", {}, name), this.recording, this.linked), h("span", { class: "card-bottom" }, this.state, this.battery.element), this.owner);
    this.beside = h("button", { type: "button", class: "card-beside", title: "Show beside the others", onclick: () => open(name, false) }, "+");
    this.element = h("li", { class: "card", "data-drone": name }, this.main, this.beside, this.alarms);
  }

  update(row: DroneRow, open: boolean): void {
    const recorded = isRecording(row);
    const lost = row.links.application === "lost";
    const over = recorded && (lost || row.links.vehicle === "closed"); // as every recording is some time
    setTone(this.element, over ? "quiet" : lost ? "bad" : row.alarms.some((alarm) => alarm.severity === "critical") ? "bad" : row.alarms.length ? "warn" : row.airborne ? "ok" : "quiet");
    setText(this.state, over ? "recording over" : lost ? "lost" : row.airborne && row.altitude !== null ? `${words(row.state)} · ${figure(row.altitude, 1)} m` : words(row.state));
    this.battery.show(lost ? null : row.battery, row.alarms);
    setText(this.owner, recorded ? "recording, nothing flies" : row.owner === null ? "nobody has control" : `${row.owner} has control`);
    const [application, vehicle] = [row.links.application, row.links.vehicle];
    setTone(this.hops[0] as Element, over ? "quiet" : (LINKS[application] ?? "quiet"));
    setTone(this.hops[1] as Element, over ? "quiet" : (LINKS[vehicle] ?? "quiet"));
    const links = `link to the proxy ${application}, to the vehicle ${vehicle}`;
    setAttribute(this.linked, "title", links);
    setHidden(this.recording, !row.recording);
    setText(this.alarms, over ? "" : row.alarms.map((alarm) => alarm.text).join(" · "));
    setHidden(this.alarms, over || row.alarms.length === 0);
    setAttribute(this.main, "aria-label", `Open ${row.name}: ${this.state.textContent}, ${this.owner.textContent}, ${links}`);
    setAttribute(this.element, "data-open", String(open));
    setAttribute(this.beside, "aria-pressed", String(open));
    setAttribute(this.beside, "aria-label", open ? `Close ${row.name}` : `Show ${row.name} beside the others`);
    setText(this.beside, open ? "−" : "+");
  }
}

export class FleetList {
  readonly element: HTMLElement;
  private readonly list = h("ul", { class: "cards" });
  private readonly none = h("p", { class: "empty" }, "No drone found yet. ", h("span", {}, "Start one: "), h("code", {}, "skyloop sim"));
  private readonly counted = h("span", { class: "count" });
  private readonly cards = new Map<string, Card>();

  constructor(private readonly open: (name: string, alone: boolean) => void) {
    this.element = h("nav", { class: "fleet", "aria-label": "Drones" }, h("h2", {}, "Drones", this.counted), this.list, this.none);
  }

  update(rows: readonly DroneRow[], opened: ReadonlySet<string>): void {
    const names = new Set(rows.map((row) => row.name));
    for (const [name, card] of this.cards) {
      if (names.has(name)) continue;
      card.element.remove();
      this.cards.delete(name);
    }
    rows.forEach((row, place) => {
      let card = this.cards.get(row.name);
      if (!card) {
        card = new Card(row.name, this.open);
        this.cards.set(row.name, card);
      }
      if (this.list.children[place] !== card.element) this.list.insertBefore(card.element, this.list.children[place] ?? null);
      card.update(row, opened.has(row.name));
    });
    setText(this.counted, rows.length ? String(rows.length) : "");
    setAttribute(this.counted, "aria-label", count(rows.length, "drone"));
    setHidden(this.none, rows.length > 0);
  }
}
