// Beside the pictures: the flight display, figures, the holder of control, and the links from this page to the vehicle.

import { h, setHidden, setText, setTone, type Tone } from "./dom.js";
import { degrees, duration, figure, headingText, words } from "./format.js";
import { Horizon } from "./horizon.js";
import { named, t } from "./language/index.js";
import type { Authority, State } from "./model.js";
import { inUnit, unit } from "./units.js";

const LINK_TONES: Readonly<Record<string, Tone>> = { up: "ok", degraded: "warn", connecting: "busy", lost: "bad", closed: "bad" };
const FIGURES = ["altitude", "climb", "speed", "heading", "roll", "pitch"] as const;
/** A longer round trip to the cockpit is shown as a warning. */
const SLOW_S = 0.25;

class Hop {
  readonly element: HTMLElement;
  private readonly text = h("span", {}, "–");

  constructor(name: string) {
    this.element = h("li", { class: "hop", "data-tone": "quiet", "data-hop": name }, h("i", { class: "wire" }), this.text);
  }

  show(text: string, tone: Tone): void {
    setTone(this.element, tone);
    setText(this.text, text);
  }
}

export class Instruments {
  readonly element: HTMLElement;
  private readonly horizon = new Horizon();
  private readonly outputs = FIGURES.map((name) => h("output", { "data-figure": name }, "–"));
  private readonly units = FIGURES.map(() => h("span", {}));
  private readonly page = new Hop("page");
  private readonly application = new Hop("application");
  private readonly vehicle = new Hop("vehicle");
  private readonly reason = h("p", { class: "note" });
  private readonly command = h("p", { class: "note command" });

  constructor() {
    const node = (name: string): HTMLElement => h("li", { class: "node" }, name);
    this.element = h(
      "section",
      { class: "side", "aria-label": t.instruments.label },
      this.horizon.element,
      h("dl", { class: "figures" }, ...FIGURES.map((name, place) => h("div", {}, h("dt", {}, t.instruments.figures[name]), h("dd", {}, this.outputs[place] as Node, this.units[place] as Node)))),
      this.command,
      h("ol", { class: "hops", "aria-label": t.instruments.links }, node(t.instruments.page), this.page.element, node(t.instruments.cockpit), this.application.element, node(t.instruments.proxy), this.vehicle.element, node(t.instruments.vehicle)),
      this.reason,
    );
  }

  update(state: State | null, connected: boolean, round_trip_s: number | null): void {
    this.horizon.update(state);
    const [roll, pitch] = [state?.attitude?.roll ?? null, state?.attitude?.pitch ?? null];
    const values = [
      figure(inUnit("length", state?.altitude), 2),
      figure(inUnit("speed", state?.velocity?.[2]), 2),
      figure(inUnit("speed", state?.speed), 2),
      headingText(state?.attitude?.yaw),
      figure(roll === null ? null : degrees(roll), 1),
      figure(pitch === null ? null : -degrees(pitch), 1),
    ];
    const [length, speed] = [unit("length").name, unit("speed").name];
    [length, speed, speed, "°", "°", "°"].forEach((name, place) => setText(this.units[place] as Element, name));
    this.outputs.forEach((output, place) => setText(output, values[place] as string));
    setText(this.command, commandText(state));
    this.links(state, connected, round_trip_s);
  }

  /** The proxy does not answer: only the reason is known. */
  lost(state: State): void {
    this.links(state, true, null);
  }

  private links(state: State | null, connected: boolean, round_trip_s: number | null): void {
    const slow = round_trip_s !== null && round_trip_s > SLOW_S;
    this.page.show(connected ? (round_trip_s === null ? named(t.linkStates, "up") : t.flight.milliseconds(Math.max(1, Math.round(round_trip_s * 1000)))) : named(t.linkStates, "lost"), connected ? (slow ? "warn" : "ok") : "bad");
    const hop = (name: string | undefined): [string, Tone] => (connected && name ? [named(t.linkStates, name), LINK_TONES[name] ?? "quiet"] : ["–", "quiet"]);
    const over = state?.links.vehicle === "closed"; // a recording that has ended
    this.application.show(...hop(state?.links.application));
    this.vehicle.show(...(over && connected ? ([t.linkStates["over"], "quiet"] as [string, Tone]) : hop(state?.links.vehicle)));
    setText(this.reason, connected ? (state?.links.reason ?? "") : "");
    setHidden(this.reason, !this.reason.textContent);
  }
}

/** The last command applied, in words. */
export function commandText(state: State | null): string {
  const applied = state?.set_points;
  if (!applied) return t.instruments.noCommand;
  const values = Object.entries(applied.values).filter(([, value]) => value !== null && value !== 0);
  const shown = values.map(([name, value]) => `${words(name)} ${figure(value, 2)}`).join(", ");
  const age_s = applied.age_s ?? 0;
  return t.instruments.applied(`${words(applied.action)}${shown ? ` · ${shown}` : ""}`, age_s > 1 ? duration(age_s) : "");
}

/** The holder of control, in words, when the newest state is too old to be sure. */
export function oldHolderText(mine: boolean): { who: string; more: string; tone: Tone } {
  return { who: t.instruments.unknownHolder, more: mine ? t.instruments.youHad : t.instruments.whoHas, tone: "quiet" };
}

/** The holder of control, in words; `authority` is the state of this page's own connection, if any. */
export function holderText(state: State | null, authority: Authority | null): { who: string; more: string; tone: Tone } {
  if (authority?.mine) return { who: t.instruments.youAs(authority.app), more: t.instruments.youHave(String(authority.priority ?? "–")), tone: "busy" };
  const { holder = null, priority = null } = authority?.holder ? authority : (state?.authority ?? {});
  const down = state?.links.application === "lost";
  if (!holder) return { who: t.instruments.nobody, more: down ? t.instruments.nobodyDown : t.instruments.nobodyHas, tone: "quiet" };
  const waits = authority?.state === "queued" || authority?.state === "preempted" ? t.instruments.inLine : "";
  return { who: holder, more: t.instruments.has(String(priority ?? "–"), waits), tone: "ok" };
}
