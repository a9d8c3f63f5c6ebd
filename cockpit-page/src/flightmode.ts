// The flight mode: one drone's picture on the whole screen, with its sticks, state and controls on top. It is the same pane
// with another layout (style/flightmode.css), so the rules for flying are the same.

import { h, setAttribute, setText, setTone, svg, type Tone } from "./dom.js";
import { named, t } from "./language/index.js";
import { isModalOpen } from "./modal.js";
import type { State } from "./model.js";
import { lengthText, speedText } from "./units.js";

/** A touch screen of a phone's size: flight mode starts there automatically. */
const TELEPHONE = "(pointer: coarse) and (max-width: 600px), (pointer: coarse) and (max-height: 500px)";
const LINKS: Readonly<Record<string, Tone>> = { up: "ok", degraded: "warn", connecting: "busy", lost: "bad", closed: "bad" };

export interface FlightPane {
  readonly element: HTMLElement;
  /** Lay it out for flight, or as usual. */
  arrange(flight: boolean): void;
  notify(text: string, tone: Tone): void;
}

export class FlightMode {
  private pane: FlightPane | null = null;
  /** It has an entry in the browser's history, so that Back leaves it. */
  private pushed = false;
  private isFull = false;
  private lock: WakeLockSentinel | null = null;

  /** @param rest Makes held keys and sticks count for nothing, because everything under a finger has moved. */
  constructor(private readonly rest: () => void) {
    window.addEventListener("popstate", () => {
      this.pushed = false;
      this.end();
    });
    window.addEventListener("keydown", (event) => {
      if (event.code === "Escape" && this.pane && !isModalOpen() && !event.defaultPrevented) this.leave();
    });
    window.matchMedia("(orientation: portrait)").addEventListener("change", () => this.pane && this.rest());
    document.addEventListener("visibilitychange", () => !document.hidden && this.pane && void this.keepAwake());
    document.addEventListener("fullscreenchange", () => {
      // Escape, and Back on a phone, end the full screen without an event of their own: the person means both.
      if (this.isFull && document.fullscreenElement === null) this.leave();
      this.isFull = this.pane !== null && document.fullscreenElement === document.documentElement;
      this.show();
    });
  }

  /** Enter flight mode. Only if a person pressed for it does the browser allow full screen. */
  enter(pane: FlightPane, byPerson: boolean): void {
    if (this.pane === pane) return;
    this.end();
    this.rest();
    this.pane = pane;
    pane.arrange(true);
    this.show();
    if (!this.pushed) history.pushState(null, "", location.href);
    this.pushed = true;
    if (byPerson) this.fillScreen();
    void this.keepAwake();
  }

  /** A drone was opened: on a phone, enter flight mode. */
  offer(pane: FlightPane): void {
    if (this.pane === null && window.matchMedia(TELEPHONE).matches) this.enter(pane, false);
  }

  toggle(pane: FlightPane): void {
    if (this.pane === pane) this.leave();
    else this.enter(pane, true);
  }

  leave(): void {
    if (this.pane === null) return;
    this.end();
    if (this.pushed) history.back();
  }

  /** The pane was closed. */
  gone(pane: FlightPane): void {
    if (this.pane === pane) this.end();
  }

  /** Hide the browser's bars, where the browser supports it; Safari on an iPhone keeps them. */
  fillScreen(): void {
    void document.documentElement.requestFullscreen?.({ navigationUI: "hide" }).catch(() => undefined);
  }

  private end(): void {
    const { pane } = this;
    if (pane === null) return;
    this.rest();
    this.pane = null;
    pane.arrange(false);
    this.show();
    void this.lock?.release();
    this.lock = null;
    if (document.fullscreenElement) void document.exitFullscreen();
    pane.element.scrollIntoView({ block: "start" });
  }

  private show(): void {
    setAttribute(document.documentElement, "data-flight", String(this.pane !== null));
    setAttribute(document.documentElement, "data-full", String(document.fullscreenElement !== null || !document.fullscreenEnabled));
  }

  /** Keep the screen on: when it turns off, the page is hidden and the drone hovers, which is safe but surprising. */
  private async keepAwake(): Promise<void> {
    const { pane } = this;
    try {
      const lock = await navigator.wakeLock.request("screen");
      if (this.pane === null) await lock.release();
      else this.lock = lock;
    } catch {
      // Browsers offer it only on this machine or over https, and not with a low battery.
      pane?.notify(t.flight.mayTurnOff, "quiet");
    }
  }
}

/** The full-screen icon: four corners. */
export const corners = (): Element =>
  svg("svg", { viewBox: "0 0 20 20", width: 20, height: 20, "aria-hidden": "true" }, svg("path", { d: "M3 7V3h4M13 3h4v4M17 13v4h-4M7 17H3v-4", fill: "none", stroke: "currentColor", "stroke-width": 1.8 }));

/** The instruments of the flight mode, in a line. */
export class FlightHud {
  readonly element: HTMLElement;
  private readonly altitude = h("b", { "data-hud": "altitude" }, "–");
  private readonly speed = h("b", { "data-hud": "speed" }, "–");
  private readonly hops = [h("i", { class: "dot" }), h("i", { class: "dot" }), h("i", { class: "dot" })];
  private readonly trip = h("span", {});
  private readonly links = h("span", { class: "hud-links", role: "img" }, ...this.hops, this.trip);

  constructor() {
    this.element = h("p", { class: "hud" }, h("span", {}, this.altitude), h("span", {}, this.speed), this.links);
  }

  update(state: State | null, connected: boolean, round_trip_s: number | null): void {
    setText(this.altitude, lengthText(state?.altitude, 1));
    setText(this.speed, speedText(state?.speed, 1));
    const links: [string, string, string] = [connected ? "up" : "lost", state?.links.application ?? "lost", state?.links.vehicle ?? "lost"];
    this.hops.forEach((hop, place) => setTone(hop, LINKS[links[place] as string] ?? "quiet"));
    const worst = links.find((link) => link !== "up");
    setText(this.trip, worst ? named(t.linkStates, worst) : (round_trip_s === null ? t.flight.up : t.flight.milliseconds(Math.max(1, Math.round(round_trip_s * 1000)))));
    setAttribute(this.links, "aria-label", t.flight.links(...(links.map((link) => named(t.linkStates, link)) as typeof links)));
  }
}
