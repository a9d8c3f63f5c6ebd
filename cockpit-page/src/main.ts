// The page: log-in, all drones, and the open ones.

import "uplot/dist/uPlot.min.css";
import "./style/base.css";
import "./style/layout.css";
import "./style/parts.css";
import "./style/route.css";
import "./style/overview.css";
import "./style/alarms.css";
import "./style/replay.css";
import "./style/follow.css";
import "./style/picture.css";
import "./style/touch.css";
import "./style/flightmode.css";
import { hashOf, namesOf, OVERVIEW } from "./address.js";
import { AlarmBook } from "./alarms.js";
import { AlarmSound } from "./alarmsound.js";
import { post } from "./api.js";
import { ServerClock } from "./clock.js";
import { h, memory, setAttribute, setHidden, setText } from "./dom.js";
import { type Flown, Flying, type InputView } from "./flying.js";
import { FleetList } from "./fleet.js";
import { FlightMode } from "./flightmode.js";
import { Help } from "./help.js";
import { Countdown } from "./hold.js";
import type { Deed } from "./keys.js";
import { named, t } from "./language/index.js";
import { session } from "./login.js";
import type { DroneRow, Session } from "./model.js";
import { OverviewView } from "./overview.js";
import { Pane } from "./pane.js";
import { keepInReach } from "./reach.js";
import { RecordingList } from "./recordings.js";
import { isRecording, Safety } from "./safety.js";
import { SettingsDialog } from "./settingsdialog.js";
import { LastingSocket } from "./socket.js";
import { followTheme } from "./settings.js";
import type { Own } from "./tile.js";

const DRAW_MS = 45; // interval between drawings
/** The list of drones arrives twice a second; when older than this it is grey [ms]. */
const OLD_LIST_MS = 2000;
/** In windows lower than this, such as a page enlarged to 400 %, only the safety controls of the bar stay in sight. */
const LOW_PX = 500;

const isFlown = (pane: Pane): pane is Pane & Flown => pane.pilot !== null;

class Page {
  private rows: DroneRow[] = [];
  private readonly panes = new Map<string, Pane>();
  private chosen: string | null = null;
  private readonly fleet = new FleetList((name, alone) => this.open(name, alone));
  private readonly main = h("main", { id: "panes", tabindex: -1, "aria-label": t.page.opened });
  private readonly overview = new OverviewView((name) => this.enter(name), (name) => this.own(name));
  /** Back to the overview. */
  private readonly all = h("button", { type: "button", class: "small all-drones", onclick: () => this.leave() }, t.overview.all);
  private readonly deckhouse: HTMLElement;
  private readonly bar: HTMLElement;
  /** Nobody has chosen a view yet: a single drone is opened automatically. */
  private undecided = namesOf(location.hash).length === 0 && location.hash !== OVERVIEW;
  /** Consecutive overviews with the same single drone. */
  private lonely = 0;
  private readonly lostAge = h("span", { "aria-hidden": "true" });
  private readonly lost = h("div", { class: "banner lost", role: "alert", "data-tone": "bad", hidden: true }, t.page.lost, this.lostAge);
  /** Messages about all drones, in a line of the visible view that exists anyway. */
  private readonly said = h("div", { class: "page-said" }, this.lost);
  private readonly countdown = new Countdown();
  private readonly safety: Safety | null;
  private readonly clock = new ServerClock();
  /** Of the whole list: sounded in the overview, once each. */
  private readonly listed = new AlarmBook();
  private readonly sound = new AlarmSound(() => [
    { name: "", raised: this.listed.raised, loudest: this.inOverview ? this.listed.loudest : null, repeats: false },
    ...[...this.panes.values()].map((pane) => pane.alarmSource),
  ]);
  private listed_ms = performance.now();
  private readonly recordings: RecordingList;
  /** The visible area of each pane [pixels²]. */
  private readonly seen = new Map<string, number>();
  private readonly sight = new IntersectionObserver((entries) => this.look(entries), { threshold: [0, 0.05, 0.25, 0.5, 0.75, 1] });
  private readonly help: Help;
  private readonly flying: Flying;
  private readonly flight = new FlightMode(() => this.flying.rest());

  constructor(
    root: HTMLElement,
    private readonly who: Session,
  ) {
    this.help = new Help(() => this.flying);
    this.safety = who.role === "pilot" ? new Safety((handlers) => new LastingSocket("/ws/control", handlers), new ServerClock(), this.countdown) : null;
    this.recordings = new RecordingList(() => this.recorded, (name) => this.enter(name), who.role === "pilot", () => this.showRecorded());
    const role = named(t.roles, who.role ?? "");
    const settings = new SettingsDialog(who.role === "pilot" ? who.name : role, () => this.panes.forEach((pane) => pane.rename()));
    followTheme(() => this.repaint());
    for (const element of [this.safety?.element, this.safety?.message, this.countdown.element]) keepInReach(element ?? null);
    const person = h("span", { class: "person", title: who.name || role }, who.name ? `${who.name} · ${role}` : role);
    const leave = who.login ? h("button", { type: "button", class: "small", onclick: () => void post("/api/logout").finally(() => location.reload()) }, t.page.logOut) : null;
    const brand = h("h1", { class: "brand" }, h("img", { src: "/static/icon.svg", alt: "", width: 24, height: 24 }), "Skyloop");
    const usual = h("div", { class: "bar-usual" }, brand, this.all, h("span", { class: "spring" }), person, leave, this.sound.button, this.help.chip, settings.button);
    this.bar = h("header", { class: "bar" }, usual, this.safety?.element ?? null);
    if (this.safety) this.said.append(this.safety.message);
    new ResizeObserver(() => this.measure()).observe(this.bar);
    window.addEventListener("resize", () => this.measure());
    this.deckhouse = h("div", { class: "deckhouse" }, this.fleet.element, this.overview.element, this.main, this.overview.side, this.recordings.element);
    root.replaceChildren(this.bar, this.deckhouse, this.help.modal.element, this.help.mapping.modal.element, settings.modal.element, this.countdown.element);
    this.flying = new Flying({
      flown: () => [...this.panes.values()].filter(isFlown),
      selected: () => (this.selected && isFlown(this.selected) ? this.selected : null),
      act: (deed) => this.act(deed),
      hold: (which) => this.safety?.hold(which),
      inputs: (view) => this.inputs(view),
    });
    this.route();
    window.addEventListener("popstate", () => this.route());
    // The address selects the view, so a link within the page must not change it.
    document.querySelector<HTMLElement>(".skip")?.addEventListener("click", (event) => {
      event.preventDefault();
      (this.inOverview ? this.overview.element : this.main).focus();
    });
    new LastingSocket("/ws/overview", {
      message: (data) => this.see(JSON.parse(data as string) as { now_s: number; drones: DroneRow[] }),
      state: (open, code) => this.linked(open, code),
    });
    // Draw everything at once, and hardly more often than states arrive: painting is the largest cost.
    let drawn_ms = 0;
    const draw = (now_ms: number): void => {
      requestAnimationFrame(draw);
      if (now_ms - drawn_ms < DRAW_MS) return;
      drawn_ms = now_ms;
      this.age(now_ms);
      this.overview.tick(now_ms);
      for (const pane of this.panes.values()) pane.tick(now_ms);
    };
    requestAnimationFrame(draw);
  }

  private get selected(): Pane | null {
    return (this.chosen !== null && this.panes.get(this.chosen)) || null;
  }

  private see({ now_s, drones: rows }: { now_s: number; drones: DroneRow[] }): void {
    const now_ms = performance.now();
    this.clock.received(now_ms, now_s);
    this.listed_ms = now_ms - (this.clock.age_s(now_s, now_ms) ?? 0) * 1000;
    this.rows = rows;
    this.safety?.know(rows);
    const alarms = rows.filter((row) => !isRecording(row)).flatMap(({ name, alarms }) => alarms.map((alarm) => ({ ...alarm, id: `${name}/${alarm.id}` })));
    this.listed.update(alarms, now_ms);
    this.overview.update(rows, now_s);
    this.fleet.update(rows, new Set(this.panes.keys()));
    this.openOnly(rows);
  }

  /** Open the single drone, unless others follow at once; Back leads to the overview. */
  private openOnly(rows: readonly DroneRow[]): void {
    const only = rows[0];
    if (!this.undecided || !only) return;
    this.lonely = rows.length === 1 ? this.lonely + 1 : 0;
    if (rows.length > 1) this.undecided = false;
    else if (this.lonely > 1 || this.first) this.enter(only.name);
    this.first = false;
  }
  private first = true;

  /** The list of drones is grey when it is old. */
  private age(now_ms: number): void {
    const old_ms = now_ms - this.listed_ms;
    setHidden(this.lost, old_ms <= OLD_LIST_MS || !this.inOverview); // an open drone shows it itself
    for (const part of [this.fleet.element, this.overview.element, this.overview.side]) setAttribute(part, "data-old", String(old_ms > OLD_LIST_MS));
    if (old_ms > OLD_LIST_MS) setText(this.lostAge, `${(old_ms / 1000).toFixed(0)} s`);
  }

  /** The share of the window for the bar; in a low window only the buttons that stop and land remain. */
  private measure(): void {
    const safety = this.safety?.element;
    const away_px = window.innerHeight < LOW_PX && safety?.parentElement === this.bar ? Math.max(0, safety.offsetTop - 4) : 0;
    const { style } = document.documentElement;
    style.setProperty("--bar-away", `${away_px}px`);
    style.setProperty("--bar", `${this.bar.offsetHeight - away_px}px`);
  }

  /** A single drone gets the whole window for its picture, unless the person wants the panels beside it. */
  private frame(): void {
    const alone = this.panes.size === 1;
    const panels = memory.get("panels") === "true";
    for (const pane of this.panes.values()) pane.frame(alone, panels);
    setAttribute(this.deckhouse, "data-picture", String(alone && !panels && !this.inOverview));
  }

  private linked(open: boolean, code: number): void {
    if (open) this.clock.reset();
    if (code === 4401) location.reload(); // the session has ended: log in again
  }

  private get inOverview(): boolean {
    return this.deckhouse.dataset["view"] === "overview";
  }

  /** The drones that a recording started now would record. */
  private get recorded(): string[] {
    return this.inOverview ? this.rows.filter((row) => !isRecording(row)).map((row) => row.name) : [...this.panes.keys()];
  }

  private showRecorded(): void {
    for (const pane of this.panes.values()) pane.recorded(this.recordings.of(pane.name));
  }

  /** This page's own relation to a drone. */
  private own(name: string): Own {
    const pane = this.panes.get(name);
    return pane?.isAsked ? "asked" : pane?.pilot?.mine ? "held" : "";
  }

  /** From the overview to one drone; the browser's Back leads back. */
  private enter(name: string): void {
    if (this.inOverview) {
      history.replaceState(null, "", OVERVIEW);
      history.pushState(null, "", hashOf([name]));
    }
    this.open(name, true);
  }

  /** To the overview. */
  private leave(): void {
    if (!this.inOverview) history.pushState(null, "", OVERVIEW);
    this.route();
  }

  /** Show the view in the address: some drones, or all. */
  private route(): void {
    const names = namesOf(location.hash);
    if (names.length === 0) this.showAll();
    else names.forEach((name, place) => (place === 0 || !this.panes.has(name)) && this.open(name, place === 0));
  }

  /** Flights of this page continue meanwhile, and no key flies an invisible drone. */
  private showAll(): void {
    for (const [name, pane] of [...this.panes]) if (!pane.pilot?.mine) this.drop(name, pane);
    this.view(true);
    this.select(null);
  }

  private view(overview: boolean): void {
    setAttribute(this.deckhouse, "data-view", overview ? "overview" : "panes");
    this.overview.shown = overview;
    setHidden(this.main, overview);
    setHidden(this.fleet.element, overview);
    setHidden(this.all, overview);
    this.frame();
  }

  /** `alone`: in place of the open ones; else beside them, or closed if it is open. */
  private open(name: string, alone: boolean): void {
    this.undecided = false;
    if (!alone && this.panes.has(name)) {
      this.close(name);
      return;
    }
    // A drone flown from this page stays open: looking at another is no reason to close it.
    if (alone) for (const [other, pane] of [...this.panes]) if (other !== name && !pane.pilot?.mine) this.drop(other, pane);
    if (!this.panes.has(name)) {
      const pane = new Pane(name, this.who.role === "pilot", {
        rows: () => this.rows,
        select: (one) => this.select(one),
        close: (one) => this.close(one),
        help: () => this.help.open(),
        fly: (one) => this.flight.toggle(one),
        known: (one) => {
          one.recorded(this.recordings.of(one.name));
          if (this.panes.size === 1) this.flight.offer(one);
        },
        fillScreen: () => this.flight.fillScreen(),
        record: async (one) => {
          const { text, tone } = await this.recordings.toggle(one.name);
          one.notify(text, tone);
        },
        panels: (shown) => {
          memory.set("panels", String(shown));
          this.frame();
        },
        aimed: (one) => one === this.chosen && this.aim(),
        countdown: this.countdown,
      });
      this.panes.set(name, pane);
      this.sight.observe(pane.element);
      this.main.append(pane.element);
      pane.recorded(this.recordings.of(name));
    }
    this.select(name);
    this.arrange();
  }

  private close(name: string): void {
    const pane = this.panes.get(name);
    if (pane) this.drop(name, pane);
    if (this.chosen === name) this.select([...this.panes.keys()][0] ?? null);
    if (this.panes.size > 0) this.arrange();
    else {
      history.replaceState(null, "", OVERVIEW);
      this.showAll();
    }
  }

  private drop(name: string, pane: Pane): void {
    this.flight.gone(pane);
    this.sight.unobserve(pane.element);
    this.seen.delete(name);
    pane.close();
    this.panes.delete(name);
  }

  /** Keys and the emergency stop act on visible drones: one that is scrolled away is deselected. */
  private look(entries: readonly IntersectionObserverEntry[]): void {
    for (const entry of entries) {
      const name = (entry.target as HTMLElement).dataset["drone"] ?? "";
      const { width, height } = entry.intersectionRect;
      if (this.panes.has(name)) this.seen.set(name, entry.isIntersecting ? width * height : 0);
    }
    if (this.chosen === null || this.seen.get(this.chosen) !== 0) return;
    const [most, area] = [...this.seen].reduce((best, one) => (one[1] > best[1] ? one : best), ["", 0]);
    if (area > 0) this.select(most);
  }

  private arrange(): void {
    setAttribute(this.main, "data-count", String(this.panes.size));
    this.view(false);
    history.replaceState(null, "", hashOf([...this.panes.keys()]));
    this.fleet.update(this.rows, new Set(this.panes.keys()));
    this.select(this.chosen);
  }

  private select(name: string | null): void {
    this.chosen = name;
    const place = this.inOverview ? this.overview.said : (this.selected ?? [...this.panes.values()][0])?.said;
    if (place && this.said.parentElement !== place) place.prepend(this.said);
    for (const pane of this.panes.values()) pane.selected(pane.name === name);
    this.aim();
  }

  private aim(): void {
    this.safety?.aim(this.selected?.target ?? null);
  }

  private act(deed: Deed): void {
    if (deed === "help") this.help.open();
    else if (deed === "question") [this.selected, ...this.panes.values()].find((pane) => pane?.isAsked)?.act(deed);
    else this.selected?.act(deed);
  }

  private inputs(view: InputView): void {
    const pilot = this.selected?.pilot ?? null;
    this.help.update(view, (pilot?.mine ?? false) && (pilot?.isLive ?? false));
  }

  private repaint(): void {
    this.overview?.repaint();
    for (const pane of this.panes.values()) pane.repaint();
  }
}

const root = document.getElementById("app") as HTMLElement;
void session(root).then((who) => new Page(root, who));
