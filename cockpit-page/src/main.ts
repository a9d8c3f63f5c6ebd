// The page: who asks, all drones, and those that are opened.

import "uplot/dist/uPlot.min.css";
import "./style/base.css";
import "./style/layout.css";
import "./style/parts.css";
import { post } from "./api.js";
import { h, setAttribute, setDisabled, setHidden, setText } from "./dom.js";
import { Flying, type InputView } from "./flying.js";
import { FleetList } from "./fleet.js";
import { Help } from "./help.js";
import type { Deed } from "./keys.js";
import { session } from "./login.js";
import type { DroneRow, Session, Sticks } from "./model.js";
import { Pane } from "./pane.js";
import { RecordingList } from "./recordings.js";
import { LastingSocket } from "./socket.js";
import { themeButton } from "./theme.js";

const DRAW_MS = 45;

class Page {
  private rows: DroneRow[] = [];
  private readonly panes = new Map<string, Pane>();
  private chosen: string | null = null;
  private readonly fleet = new FleetList((name, alone) => this.open(name, alone));
  private readonly main = h("main", { id: "panes", tabindex: -1, "aria-label": "Opened drones" });
  private readonly empty = h("p", { class: "empty nobody" }, "No drone is opened. Choose one of the list.");
  private readonly lost = h("div", { class: "banner lost", role: "alert", "data-tone": "bad", hidden: true }, "This page lost the cockpit: what it shows is old. Trying again…");
  private readonly stopName = h("span", { class: "stop-name" });
  private readonly stop = h("button", { type: "button", class: "stop", "aria-keyshortcuts": "Escape Escape", onclick: () => this.selected?.act("stop") }, h("span", {}, "Motors off"), this.stopName, h("kbd", { "aria-hidden": "true" }, "Esc Esc"));
  private readonly help: Help;
  private readonly flying: Flying;

  constructor(
    root: HTMLElement,
    private readonly who: Session,
  ) {
    this.help = new Help(() => this.flying);
    const theme = themeButton(() => this.repaint());
    const person = h("span", { class: "person", title: who.name || who.role || "" }, who.name ? `${who.name} · ${who.role}` : (who.role ?? ""));
    const leave = who.login ? h("button", { type: "button", class: "small", onclick: () => void post("/api/logout").finally(() => location.reload()) }, "Log out") : null;
    const brand = h("h1", { class: "brand" }, h("img", { src: "/static/icon.svg", alt: "", width: 24, height: 24 }), "Skyloop");
    const bar = h("header", { class: "bar" }, brand, h("span", { class: "spring" }), person, leave, this.help.chip, theme, who.role === "pilot" ? this.stop : null);
    const recordings = new RecordingList(() => [...this.panes.keys()], (name) => this.open(name, true), who.role === "pilot");
    this.main.append(this.empty);
    root.replaceChildren(bar, this.lost, h("div", { class: "deckhouse" }, this.fleet.element, this.main, recordings.element), this.help.element);
    this.flying = new Flying({
      pilots: () => [...this.panes.values()].flatMap((pane) => pane.pilot ?? []),
      selected: () => this.selected?.pilot ?? null,
      act: (deed) => this.act(deed),
      inputs: (view) => this.inputs(view),
    });
    for (const name of decodeURIComponent(location.hash.slice(1)).split(",")) if (name) this.open(name, false);
    new LastingSocket("/ws/overview", {
      message: (data) => this.see((JSON.parse(data as string) as { drones: DroneRow[] }).drones),
      state: (open, code) => this.linked(open, code),
    });
    // All of them at once, and no faster than the news comes: painting is what costs most.
    let drawn_ms = 0;
    const draw = (now_ms: number): void => {
      requestAnimationFrame(draw);
      if (now_ms - drawn_ms < DRAW_MS) return;
      drawn_ms = now_ms;
      for (const pane of this.panes.values()) pane.tick(now_ms);
    };
    requestAnimationFrame(draw);
  }

  private get selected(): Pane | null {
    return (this.chosen !== null && this.panes.get(this.chosen)) || null;
  }

  private see(rows: DroneRow[]): void {
    this.rows = rows;
    const only = rows[0];
    if (this.panes.size === 0 && rows.length === 1 && only) this.open(only.name, true);
    this.fleet.update(rows, new Set(this.panes.keys()));
  }

  private linked(open: boolean, code: number): void {
    setHidden(this.lost, open);
    if (code === 4401) location.reload(); // the session has ended: log in again
  }

  /** `alone`: instead of those that are open; else beside them, or closed if it is open. */
  private open(name: string, alone: boolean): void {
    if (!alone && this.panes.has(name)) {
      this.close(name);
      return;
    }
    if (alone) for (const other of [...this.panes.keys()]) if (other !== name) this.panes.get(other)?.close();
    if (alone) for (const other of [...this.panes.keys()]) if (other !== name) this.panes.delete(other);
    if (!this.panes.has(name)) {
      const pane = new Pane(name, this.who.role === "pilot", {
        rows: () => this.rows,
        select: (one) => this.select(one),
        close: (one) => this.close(one),
        push: (one, sticks) => this.push(one, sticks),
        help: () => this.help.toggle(),
      });
      this.panes.set(name, pane);
      this.main.append(pane.element);
    }
    this.select(name);
    this.arrange();
  }

  private close(name: string): void {
    this.panes.get(name)?.close();
    this.panes.delete(name);
    if (this.chosen === name) this.select([...this.panes.keys()][0] ?? null);
    this.arrange();
  }

  private arrange(): void {
    setAttribute(this.main, "data-count", String(this.panes.size));
    setHidden(this.empty, this.panes.size > 0);
    history.replaceState(null, "", `#${[...this.panes.keys()].map(encodeURIComponent).join(",")}`);
    this.fleet.update(this.rows, new Set(this.panes.keys()));
    this.select(this.chosen);
  }

  private select(name: string | null): void {
    this.chosen = name;
    for (const pane of this.panes.values()) pane.selected(pane.name === name);
    setText(this.stopName, this.panes.size > 1 && name !== null ? name : "");
    setAttribute(this.stop, "aria-label", name === null ? "Emergency stop" : `Emergency stop: motors of ${name} off`);
  }

  private push(name: string, sticks: Sticks): void {
    if (name === this.chosen) this.flying.thumbs = sticks;
  }

  private act(deed: Deed): void {
    if (deed === "help") this.help.toggle();
    else if (deed === "question") [this.selected, ...this.panes.values()].find((pane) => pane?.isAsked)?.act(deed);
    else this.selected?.act(deed);
  }

  private inputs(view: InputView): void {
    const pilot = this.selected?.pilot ?? null;
    this.help.update(view, pilot?.mine ?? false);
    setDisabled(this.stop, !pilot?.connected);
  }

  private repaint(): void {
    for (const pane of this.panes.values()) pane.repaint();
  }
}

const root = document.getElementById("app") as HTMLElement;
void session(root).then((who) => new Page(root, who));
