// The map of one drone with its tools: flying to a place, routes, and zones.

import { h, setAttribute, setHidden } from "./dom.js";
import { t } from "./language/index.js";
import { MapView } from "./map.js";
import type { Vector } from "./model.js";
import { type RouteDeed, RoutePanel } from "./routepanel.js";
import { Surroundings } from "./surroundings.js";
import { WaypointTool } from "./waypoint.js";
import type { Scene } from "./world.js";
import { boundsOf } from "./zones.js";
import { ZoneTool } from "./zonetool.js";

export interface MapHost {
  scene(): Scene;
  /** The drone's position; null while unknown. */
  own(): Vector | null;
  stands(): boolean;
  goTo(x: number, y: number, z: number): void;
  /** Fly along a checked route, and control that flight. */
  flyRoute(id: string): void;
  steerRoute(deed: RouteDeed): void;
  /** Write a parameter; returns the reason for a refusal, empty if it was written. */
  write(name: string, value: string | number): Promise<string>;
}

export class MapPanel {
  readonly element: HTMLElement;
  /** Other tools can be used on it: `map.use(tool)`. */
  readonly map: MapView;
  readonly surroundings: Surroundings;
  readonly route: RoutePanel;
  private readonly waypoint: WaypointTool;
  private readonly zones: ZoneTool;
  private readonly edit = h("button", { type: "button", class: "small", "aria-pressed": "false", onclick: () => this.map.use(this.map.used === this.zones ? null : this.zones) }, t.map.zones);
  private readonly plan = h("button", { type: "button", class: "small", "aria-pressed": "false", onclick: () => this.map.use(this.map.used === this.route ? null : this.route) }, t.map.route);
  private recording = false;
  private why = { fly: "", write: "" };

  constructor(
    drone: string,
    host: MapHost,
    private readonly pilots: boolean,
  ) {
    this.surroundings = new Surroundings(drone, () => this.zones.update());
    this.waypoint = new WaypointTool({
      own: host.own,
      stands: host.stands,
      speeds: () => {
        const { speed = null, climb = null } = this.surroundings.world?.limits ?? {};
        return speed && climb ? { along: speed, up: climb } : null;
      },
      problem: (place) => this.surroundings.problem(place),
      goTo: host.goTo,
    });
    this.zones = new ZoneTool({
      bounds: () => boundsOf(this.surroundings.world),
      ceiling: () => this.surroundings.world?.limits.altitude ?? null,
      write: host.write,
      reload: () => this.surroundings.reload(0),
    });
    this.route = new RoutePanel(drone, { own: host.own, fly: host.flyRoute, act: host.steerRoute });
    this.map = new MapView(host.scene, this.waypoint, this.waypoint.element, this.zones.element, this.route.element);
    this.map.corner.append(this.plan, this.edit);
    this.element = this.map.element;
    this.arrange();
  }

  /** Nothing flies: it is a recording. */
  watchOnly(only: boolean): void {
    this.recording = only;
    if (only) this.map.use(null);
  }

  /** Set why the drone can't be flown to a place now, and why no zone can be written; each is empty if it can. */
  allow(fly: string, write: string): void {
    this.why = { fly, write };
    this.waypoint.allow(fly === "");
    this.zones.allow(write === "");
    this.route.allow(fly);
  }

  draw(now_ms: number): void {
    this.arrange();
    this.map.draw(now_ms);
  }

  repaint(): void {
    this.map.repaint();
  }

  close(): void {
    this.surroundings.close();
  }

  /** Show the fields of the tool in use. */
  private arrange(): void {
    const used = this.map.used;
    setHidden(this.edit, this.recording);
    setAttribute(this.edit, "aria-pressed", String(used === this.zones));
    setHidden(this.plan, this.recording || !this.pilots);
    setAttribute(this.plan, "aria-pressed", String(used === this.route));
    this.route.shown(used === this.route);
    setHidden(this.zones.element, used !== this.zones);
    setHidden(this.waypoint.element, used !== this.waypoint || this.recording);
    this.map.allow(used === this.zones ? this.why.write : used === this.waypoint ? this.why.fly : "");
  }
}
