// The controls that are always present: motors off for the visible drone, land all, stop all; and their outcome.

import type { ServerClock } from "./clock.js";
import { type Answer, CommandSender, type CommandSocket, type Result } from "./commands.js";
import { h, setAttribute, setHidden, setText, setTone } from "./dom.js";
import { type Countdown, type Deadly, holdButton } from "./hold.js";
import { t } from "./language/index.js";
import type { DroneRow } from "./model.js";
import { STEER_MS } from "./pilot.js";
import type { Handlers } from "./socket.js";

const WATCH_MS = 300; // interval between pings
const SHOWN_MS = 15_000; // how long an outcome is shown

/** The drone that a key or the gamepad would stop. */
export interface Target {
  name: string;
  /** Of the emergency stop. */
  result: Result | null;
  stop: () => void;
}

type Deed = "land_all" | "stop_all";
interface Each extends Answer {
  drone: string;
  state: "sent" | "done" | "refused";
}

export const WORDS: Readonly<Record<Deed, string>> = { land_all: t.safety.landAll, stop_all: t.safety.stopAll };

/** The outcome of a command to all drones, in words, the worst first. Pure. */
export function outcome(deed: Deed, drones: readonly string[], each: ReadonlyMap<string, { state: string; why: string }>): { text: string; bad: boolean } {
  const of = (state: string): string[] => drones.filter((name) => (each.get(name)?.state ?? "pending") === state);
  const failed = of("refused").map((name) => `${name}: ${each.get(name)?.why}`);
  const parts = [
    failed.length ? t.safety.failed[deed](failed.join("; ")) : "",
    of("pending").length ? t.safety.pending(of("pending").join(", ")) : "",
    of("sent").length ? t.safety.sent(of("sent").join(", ")) : "",
    of("done").length ? t.safety.done[deed](of("done").join(", ")) : "",
  ].filter(Boolean);
  return { text: drones.length ? `${WORDS[deed]} · ${parts.join(" · ")}` : t.safety.none(WORDS[deed]), bad: failed.length > 0 };
}

export class Safety {
  readonly element: HTMLElement;
  /** The outcome; below the bar. */
  readonly message = h("p", { class: "banner safety-message", role: "status", hidden: true });
  private readonly name = h("span", { class: "stop-name" });
  private readonly fate = h("span", { class: "fate" });
  private readonly own: HTMLButtonElement;
  private readonly all: Record<Deed, { button: HTMLButtonElement; fate: HTMLElement }>;
  private readonly commands: CommandSender;
  private target: Target | null = null;
  private asked: { deed: Deed; drones: readonly string[]; each: Map<string, { state: string; why: string }>; since_ms: number } | null = null;
  private flying = 0;
  /** The last hold that concerned only the drone aimed at. */
  private aimed: Deadly | null = null;
  /** The last hold by keys or the gamepad. */
  private keyed: Deadly | null = null;

  constructor(
    connect: (handlers: Handlers) => CommandSocket,
    clock: ServerClock,
    private readonly countdown: Countdown,
  ) {
    this.own = holdButton(countdown, () => this.one(), { class: "stop own", "aria-keyshortcuts": "Control+Enter", title: t.safety.hold }, h("span", {}, t.safety.off), this.name, h("kbd", { "aria-hidden": "true" }, t.safety.holdShort), this.fate);
    const button = (deed: Deed, kind: string, keys: string): { button: HTMLButtonElement; fate: HTMLElement } => {
      const fate = h("span", { class: "fate" });
      return { button: holdButton(countdown, () => this.every(deed), { class: kind, ...(keys ? { "aria-keyshortcuts": keys } : {}), title: t.safety.holdAll }, h("span", {}, WORDS[deed]), h("kbd", { "aria-hidden": "true" }, t.safety.holdShort), fate), fate };
    };
    this.all = { land_all: button("land_all", "land-all", ""), stop_all: button("stop_all", "stop", "Control+Shift+Enter") };
    this.element = h("div", { class: "safety", role: "group", "aria-label": t.safety.emergency }, this.own, this.all.land_all.button, this.all.stop_all.button);
    this.commands = new CommandSender(
      connect,
      clock,
      { linked: () => this.show(), received: (message) => this.onMessage(message), refused: (command, why) => this.refused(command as Deed, why), changed: () => this.show() },
      () => performance.now(),
    );
    setInterval(() => this.commands.tick(WATCH_MS), STEER_MS);
  }

  /** Set the drone that its own button, keys and the gamepad stop; null if no drone to fly is visible. */
  aim(target: Target | null): void {
    if (target?.name !== this.target?.name && this.countdown.holds(this.aimed)) this.countdown.release(); // the hold was meant for another drone
    this.target = target;
    this.show();
  }

  /** Handle the newest overview. */
  know(rows: readonly DroneRow[]): void {
    this.flying = rows.filter((row) => row.can_fly && !isRecording(row)).length;
    setAttribute(this.element, "data-flying", String(this.flying));
    this.show();
  }

  /** Keys or the gamepad are held, or released. */
  hold(which: "one" | "all" | null): void {
    if (which === null) {
      if (this.countdown.holds(this.keyed)) this.countdown.release();
      return;
    }
    const meant = which === "one" ? this.one() : this.every("stop_all");
    if (meant === null) {
      this.notify(t.safety.aimless, true);
      return;
    }
    this.countdown.press(meant);
    if (this.countdown.holds(meant)) this.keyed = meant;
  }

  private one(): Deadly | null {
    const { target } = this;
    const meant = target && { what: t.safety.motorsOff(target.name), act: () => target.stop() };
    if (!this.countdown.isHeld) this.aimed = meant;
    return meant;
  }

  private every(deed: Deed): Deadly {
    const count = this.flying;
    // A person may hold it before this page knows any drone: the cockpit knows them, and reports if there are none.
    const which = count === 0 ? t.safety.every : count === 1 ? t.safety.theOnly : t.safety.allOf(count);
    return { what: deed === "land_all" ? t.safety.landThese(which) : t.safety.motorsOff(which), act: () => this.send(deed) };
  }

  private send(deed: Deed): void {
    this.asked = { deed, drones: [], each: new Map(), since_ms: performance.now() };
    this.commands.send({ do: deed });
    if (this.commands.result(deed)?.fate === "pending") this.notify(`${WORDS[deed]} · ${t.commands.fates.pending}`, false);
  }

  private onMessage(message: Answer): void {
    const { asked } = this;
    if (!asked || message.do !== asked.deed) return;
    if (message.type === "sent") asked.drones = (message as Answer & { drones?: string[] }).drones ?? [];
    else if (message.type === "each") asked.each.set((message as Each).drone, { state: (message as Each).state, why: message.why ?? "" });
    else return;
    const { text, bad } = outcome(asked.deed, asked.drones, asked.each);
    this.notify(text, bad);
  }

  private refused(deed: Deed, why: string): void {
    if (deed in WORDS) this.notify(`${WORDS[deed]} · ${why}`, true);
  }

  private notify(text: string, bad: boolean): void {
    setTone(this.message, bad ? "bad" : "busy");
    setText(this.message, text);
    setHidden(this.message, false);
    const now_ms = performance.now();
    this.shown_ms = now_ms;
    setTimeout(() => this.shown_ms === now_ms && setHidden(this.message, true), SHOWN_MS);
  }
  private shown_ms = 0;

  private show(): void {
    if (!this.all) return; // still being constructed
    const { target } = this;
    setHidden(this.own, target === null);
    setText(this.name, target?.name ?? "");
    showFate(this.own, this.fate, target?.result ?? null);
    for (const deed of Object.keys(this.all) as Deed[]) {
      const { button, fate } = this.all[deed];
      showFate(button, fate, this.commands.result(deed));
    }
  }
}

/** Show the outcome of a command on its control: pending, sent, refused, not sent. */
export function showFate(button: HTMLElement, place: HTMLElement, result: Result | null): void {
  setAttribute(button, "data-fate", result?.fate ?? "");
  setText(place, result ? t.commands.fates[result.fate] : "");
  setAttribute(place, "title", result?.why ?? "");
}

/** Nothing flies there: it is a recording. */
export const isRecording = ({ uri }: { uri: string }): boolean => uri.startsWith("replay:") || uri.startsWith("video:");
