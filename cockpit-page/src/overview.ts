// All drones: a tile for each, or a row in a table if there are many, and one map of them all.

import { Battery } from "./battery.js";
import { h, memory, setAttribute, setHidden, setText, setTone } from "./dom.js";
import { Trail } from "./history.js";
import { t } from "./language/index.js";
import { MapView } from "./map.js";
import type { DroneRow } from "./model.js";
import { byName, type Column, describe, found, height, sorted } from "./row.js";
import { isRecording } from "./safety.js";
import { SmallVideo } from "./smallvideo.js";
import { Surroundings } from "./surroundings.js";
import { type Own, OWN_WORDS, Tile } from "./tile.js";
import type { Scene } from "./world.js";
import { zoneText } from "./zones.js";

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

/** Up to this many have a tile each; more are a table, unless the user chose otherwise. */
export const MOST_TILES = 12;
const SEARCH_FROM = 7;
/** Positions arrive twice a second: drawing the map more often is wasted. */
const MAP_MS = 240;
const AGE_MS = 240;
const MARGIN = "80px";
/** Anyone may change zones: they are read again this often. */
const AROUND_MS = 10_000;

type Kind = "tiles" | "table";

export class OverviewView {
  readonly element: HTMLElement;
  /** The map and the other elements beside the drones. */
  readonly side: HTMLElement;
  /** The place for messages about all drones: always present, so that nothing moves when one appears. */
  readonly said: HTMLElement;
  private readonly video = new SmallVideo();
  private readonly tiles = new Map<string, Tile>();
  private readonly list = h("ul", { class: "tiles" });
  private readonly table: DroneTable;
  private readonly map = new MapView(() => this.scene());
  private readonly trails = new Map<string, Trail>();
  /** Scenery and limits of as many drones as have a tile, read while they are visible. */
  private readonly surroundings = new Map<string, Surroundings>();
  private readonly none = h("p", { class: "empty nobody" }, t.overview.none, h("span", {}, t.overview.start), h("code", {}, "skyloop sim"));
  private readonly unfound = h("p", { class: "empty" }, t.overview.unfound);
  private readonly counted = h("span", { class: "count" });
  private readonly search = h("input", { type: "search", placeholder: t.overview.search, "aria-label": t.overview.searchLong, oninput: () => this.show() });
  private readonly kinds: Readonly<Record<Kind, HTMLButtonElement>>;
  private readonly sight = new IntersectionObserver((entries) => this.look(entries), { rootMargin: MARGIN });
  private rows: readonly DroneRow[] = [];
  private visible = false;
  private drawn_ms = 0;
  private around_ms = 0;
  private aged_ms = 0;

  constructor(
    private readonly open: (name: string) => void,
    private readonly own: (name: string) => Own,
  ) {
    this.table = new DroneTable(open, () => this.show());
    const choice = (kind: Kind, title: string): HTMLButtonElement => h("button", { type: "button", class: "tab", onclick: () => this.choose(kind) }, title);
    this.kinds = { tiles: choice("tiles", t.overview.tiles), table: choice("table", t.overview.table) };
    const kinds = h("span", { class: "tabs", role: "group", "aria-label": t.overview.shownAs }, ...Object.values(this.kinds));
    this.said = h("div", { class: "overview-said" }, h("h2", {}, t.overview.drones, this.counted));
    this.element = h("main", { class: "overview", id: "overview", tabindex: -1, "aria-label": t.overview.all }, h("header", { class: "overview-head" }, this.said, this.search, kinds), this.list, this.table.element, this.none, this.unfound);
    this.side = h("section", { class: "overview-map", "aria-label": t.overview.map }, this.map.element);
    this.map.allow("");
    window.addEventListener("resize", () => this.visible && this.tiles.forEach((tile) => tile.look()));
  }

  /** Whether it is the visible view; if not, it requests no pictures and draws nothing. */
  set shown(shown: boolean) {
    this.visible = shown;
    setHidden(this.element, !shown);
    setHidden(this.side, !shown);
    this.video.run(shown);
    this.lookAround();
    if (shown) this.show();
  }

  update(rows: readonly DroneRow[], now_s: number): void {
    this.rows = [...rows].sort(byName);
    for (const name of this.trails.keys()) if (!rows.some((row) => row.name === name)) this.trails.delete(name);
    for (const { name, position } of rows) {
      if (!this.trails.has(name)) this.trails.set(name, new Trail());
      if (position) this.trails.get(name)?.add(now_s, position);
    }
    this.lookAround();
    if (this.visible) this.show();
  }

  private lookAround(): void {
    const wanted = new Set(this.visible ? this.rows.filter((row) => !isRecording(row)).slice(0, MOST_TILES).map((row) => row.name) : []);
    for (const [name, one] of this.surroundings) {
      if (wanted.has(name)) continue;
      one.close();
      this.surroundings.delete(name);
    }
    const again = performance.now() - this.around_ms > AROUND_MS;
    if (again) this.around_ms = performance.now();
    for (const name of wanted) {
      const known = this.surroundings.get(name);
      const one = known ?? new Surroundings(name, () => this.map.repaint());
      this.surroundings.set(name, one);
      if (again || !known) one.reload();
    }
  }

  tick(now_ms: number): void {
    if (!this.visible) return;
    if (now_ms - this.drawn_ms >= MAP_MS) {
      this.drawn_ms = now_ms;
      this.map.draw(now_ms);
    }
    if (now_ms - this.aged_ms < AGE_MS) return;
    this.aged_ms = now_ms;
    for (const tile of this.tiles.values()) tile.age(now_ms);
  }

  /** The colours have changed. */
  repaint(): void {
    this.map.repaint();
  }

  private get kind(): Kind {
    const chosen = memory.get("overview");
    return chosen === "tiles" || chosen === "table" ? chosen : this.rows.length > MOST_TILES ? "table" : "tiles";
  }

  private choose(kind: Kind): void {
    memory.set("overview", kind);
    this.show();
  }

  private show(): void {
    const { kind, rows } = this;
    const wanted = rows.length >= SEARCH_FROM && this.search.value ? rows.filter((row) => found(row, this.search.value)) : rows;
    setText(this.counted, rows.length ? String(rows.length) : "");
    setAttribute(this.counted, "aria-label", t.overview.count(rows.length));
    setHidden(this.search, rows.length < SEARCH_FROM);
    setHidden(this.none, rows.length > 0);
    setHidden(this.unfound, rows.length === 0 || wanted.length > 0);
    for (const [name, button] of Object.entries(this.kinds)) setAttribute(button, "aria-pressed", String(name === kind));
    setHidden(this.list, kind !== "tiles" || wanted.length === 0);
    setHidden(this.table.element, kind !== "table" || wanted.length === 0);
    setAttribute(this.list, "data-count", String(Math.min(wanted.length, MOST_TILES)));
    if (kind === "table") this.table.update(wanted, this.own);
    this.arrange(kind === "tiles" ? wanted : []);
  }

  private arrange(rows: readonly DroneRow[]): void {
    const names = new Set(rows.map((row) => row.name));
    for (const [name, tile] of this.tiles) {
      if (names.has(name)) continue;
      this.sight.unobserve(tile.element);
      tile.close();
      this.tiles.delete(name);
    }
    rows.forEach((row, place) => {
      let tile = this.tiles.get(row.name);
      if (!tile) {
        tile = new Tile(row.name, this.video, () => this.open(row.name));
        this.tiles.set(row.name, tile);
        this.sight.observe(tile.element);
      }
      if (this.list.children[place] !== tile.element) this.list.insertBefore(tile.element, this.list.children[place] ?? null);
      tile.update(row, this.own(row.name));
    });
  }

  private look(entries: readonly IntersectionObserverEntry[]): void {
    for (const entry of entries) this.tiles.get((entry.target as HTMLElement).dataset["drone"] ?? "")?.sight(entry.isIntersecting);
  }

  private scene(): Scene {
    const others = this.rows.flatMap((row) => {
      const { name, position, yaw } = row;
      const trail = this.trails.get(name);
      return position === null || isRecording(row) ? [] : [{ name, position, roll: 0, pitch: 0, yaw, ink: "accent", ...(trail ? { trail } : {}) }];
    });
    const known = [...this.surroundings.values()].flatMap(({ world }) => world ?? []);
    const zones = new Map(known.flatMap((world) => world.zones).map((zone) => [zoneText(zone), zone]));
    const place = known.find((world) => world.source !== null) ?? known[0];
    const world = place ? { ...place, zones: [...zones.values()], box: known.length === 1 ? place.box : null } : null;
    return { own: null, truth: null, others, targets: [], waypoints: [], trail: new Trail(), world };
  }
}
