// Orders on their way: each carries when it was asked for, and what became of it is known until it no longer matters.
//
// The cockpit does nothing that may be older than 0.5 s. So an order that can't be sent now is never sent, except an
// emergency stop: that one is tried for two seconds, while the page shows it as pending.

import type { ServerClock } from "./clock.js";
import type { Handlers } from "./socket.js";

/** An order that is older is not done [ms]. */
export const LATE_MS = 500;
/** Nor is an emergency stop that is older than this. */
export const STOP_LATE_MS = 2000;
/** Without a pong for so long nothing is known to arrive, and what is shown is old. */
export const STALE_MS = 1000;
/** The answer may be under way for as long again. */
const ANSWER_MS = 1000;
const SENT_SHOWN_MS = 2500;
const FAILED_SHOWN_MS = 8000;
const STOPS: ReadonlySet<string> = new Set(["stop", "stop_all"]);

/** As much of a socket as is used. */
export interface Line {
  readonly isOpen: boolean;
  send(message: object): boolean;
  close(): void;
}

/** `sent`: the cockpit passed it on. `refused`: by the cockpit or the drone, with a reason. `not sent`: it never left, or
 *  came too late to count. `no answer`: it left in time, and nobody said what became of it. */
export type Fate = "pending" | "sent" | "refused" | "not sent" | "no answer";

/** What became of the newest order of its kind. */
export interface Result {
  fate: Fate;
  why: string;
}

interface Pending {
  order: { do: string };
  n: number;
  pressed_ms: number;
  /** It went over the connection that is open now. */
  on_its_way: boolean;
  /** It went over any. */
  went: boolean;
}

export interface Answer {
  type: string;
  do?: string;
  n?: number;
  why?: string;
  now_s?: number;
}

export interface OrderListener {
  /** The connection is there, or gone. */
  linked(open: boolean): void;
  /** What else the cockpit says. */
  told(message: Answer): void;
  /** An order will not be done: by the cockpit's words, or by this page's. */
  refused(order: string, why: string): void;
  /** What became of an order is known, or is no longer shown. */
  changed(): void;
}

export class OrderLine {
  /** There and back to the cockpit [s]; null while not known. */
  round_trip_s: number | null = null;
  private readonly line: Line;
  private number = 0;
  private pinged_ms = Number.NEGATIVE_INFINITY;
  private answered_s: number | null = null;
  private readonly pings = new Map<number, number>();
  private readonly pending = new Map<string, Pending>();
  private readonly settled = new Map<string, number>(); // numbers of the newest ones
  private readonly results = new Map<string, Result & { since_ms: number }>();

  constructor(
    connect: (handlers: Handlers) => Line,
    readonly clock: ServerClock,
    private readonly listener: OrderListener,
    private readonly now_ms: () => number,
  ) {
    this.line = connect({ message: (data) => this.hear(data), state: (open) => this.linked(open) });
  }

  /** How old the newest answer is [ms]; null before the first one of this connection. */
  age_ms(now_ms = this.now_ms()): number | null {
    const age_s = this.answered_s === null ? null : this.clock.age_s(this.answered_s, now_ms);
    return age_s === null ? null : age_s * 1000;
  }

  /** What is sent now is known to arrive in time, as far as can be known. */
  get isLive(): boolean {
    const age_ms = this.age_ms();
    return this.line.isOpen && age_ms !== null && age_ms <= STALE_MS;
  }

  /** What became of the newest order of this kind; null if that does not matter any more. */
  result(what: string): Result | null {
    return this.results.get(what) ?? null;
  }

  /** Whether it is on its way; if not, that was told. */
  order(order: { do: string }): boolean {
    const now_ms = this.now_ms();
    this.number += 1;
    const pending: Pending = { order, n: this.number, pressed_ms: now_ms, on_its_way: false, went: false };
    const stop = STOPS.has(order.do);
    if (!stop && !this.isLive) {
      this.end(order.do, "not sent", this.unheard(now_ms));
      return false;
    }
    this.pending.set(order.do, pending);
    this.show(order.do, "pending", "");
    return this.transmit(pending) || stop;
  }

  /** Sticks: what does not go now is forgotten. */
  steer(order: { do: string }): boolean {
    const stamp = this.isLive ? this.clock.at(this.now_ms()) : null;
    return stamp !== null && this.line.send({ ...order, ...stamp });
  }

  /** Called many times a second; `pause_ms` between two pings. */
  tick(pause_ms: number): void {
    const now_ms = this.now_ms();
    if (now_ms - this.pinged_ms >= pause_ms) this.ping(now_ms);
    for (const pending of [...this.pending.values()]) {
      const late_ms = this.late_ms(pending);
      const age_ms = now_ms - pending.pressed_ms;
      if (!pending.on_its_way && age_ms < late_ms) this.transmit(pending);
      if (age_ms >= late_ms && !pending.went) this.end(pending.order.do, "not sent", this.unheard(now_ms));
      else if (age_ms >= late_ms + (STOPS.has(pending.order.do) ? 0 : ANSWER_MS)) this.end(pending.order.do, "no answer", `${this.unheard(now_ms)}; it is not done any more if it has not been by now`);
    }
    for (const [what, { fate, since_ms }] of [...this.results]) {
      const shown_ms = fate === "sent" ? SENT_SHOWN_MS : FAILED_SHOWN_MS;
      if (fate !== "pending" && now_ms - since_ms > shown_ms) {
        this.results.delete(what);
        this.listener.changed();
      }
    }
  }

  close(): void {
    this.line.close();
  }

  private late_ms = (pending: Pending): number => (STOPS.has(pending.order.do) ? STOP_LATE_MS : LATE_MS);

  private unheard(now_ms: number): string {
    const age_ms = this.age_ms(now_ms);
    if (!this.line.isOpen || age_ms === null) return "this page has no connection to the cockpit";
    return `no answer from the cockpit for ${(age_ms / 1000).toFixed(1)} s`;
  }

  private transmit(pending: Pending): boolean {
    const stamp = this.clock.at(pending.pressed_ms);
    if (stamp === null || !this.line.isOpen) return false;
    pending.on_its_way = this.line.send({ ...pending.order, n: pending.n, ...stamp });
    pending.went ||= pending.on_its_way;
    return pending.on_its_way;
  }

  private ping(now_ms: number): void {
    this.pinged_ms = now_ms;
    this.number += 1;
    if (this.pings.size >= 60) this.pings.clear(); // no answers: an old one says nothing any more
    const seen = this.answered_s === null ? {} : { seen_s: this.answered_s };
    if (this.line.send({ do: "ping", n: this.number, ...seen, ...this.clock.at(now_ms) })) this.pings.set(this.number, now_ms);
  }

  private linked(open: boolean): void {
    this.clock.reset();
    this.answered_s = this.round_trip_s = null;
    this.pings.clear();
    for (const pending of this.pending.values()) pending.on_its_way = false;
    this.listener.linked(open);
    if (open) this.ping(this.now_ms());
  }

  private hear(data: string | ArrayBuffer): void {
    if (typeof data !== "string") return;
    const told = JSON.parse(data) as Answer;
    if (told.type === "pong") this.pong(told);
    else {
      if (told.type === "sent") this.settle(told, "sent");
      if (told.type === "refused") {
        this.settle(told, "refused");
        this.listener.refused(told.do ?? "", told.why ?? "");
      }
      this.listener.told(told);
    }
  }

  private pong(told: Answer): void {
    const sent_ms = this.pings.get(told.n ?? -1);
    this.pings.delete(told.n ?? -1);
    if (sent_ms === undefined || told.now_s === undefined) return;
    const now_ms = this.now_ms();
    const first = this.answered_s === null;
    this.clock.pong(sent_ms, now_ms, told.now_s);
    this.round_trip_s = (now_ms - sent_ms) / 1000;
    this.answered_s = told.now_s;
    if (first) this.tick(Number.POSITIVE_INFINITY); // an emergency stop may wait for it
    if (first) this.listener.changed();
  }

  /** The cockpit's answer to an order: it may also come after this page has given up on it. */
  private settle(told: Answer, fate: Fate): void {
    const what = told.do ?? "";
    const pending = this.pending.get(what);
    if (told.n && told.n !== (pending?.n ?? this.settled.get(what))) return; // of an earlier one
    this.pending.delete(what);
    if (pending) this.settled.set(what, pending.n);
    this.show(what, fate, told.why ?? "");
  }

  /** This page gives up on it. */
  private end(what: string, fate: Fate, why: string): void {
    const pending = this.pending.get(what);
    this.pending.delete(what);
    if (pending) this.settled.set(what, pending.n);
    this.show(what, fate, why);
    this.listener.refused(what, `${fate}: ${why}`);
  }

  private show(what: string, fate: Fate, why: string): void {
    this.results.set(what, { fate, why, since_ms: this.now_ms() });
    this.listener.changed();
  }
}
