// Commands under way: each carries the time of the press, and its outcome is kept for as long as it matters.
//
// The cockpit refuses commands that may be older than 0.5 s. A command that can't be sent now is therefore never sent,
// except an emergency stop: the page retries it for two seconds and shows it as pending.

import type { ServerClock } from "./clock.js";
import { t } from "./language/index.js";
import type { Handlers } from "./socket.js";

/** An older command is not executed [ms]. */
export const LATE_MS = 500;
/** An emergency stop older than this is not executed. */
export const STOP_LATE_MS = 2000;
/** After this long without a pong, the link counts as dead and the data shown as old. */
export const STALE_MS = 1000;
/** How long to wait for an answer once a command is too old to be executed. */
const ANSWER_MS = 1000;
// How long an outcome is shown.
const SENT_SHOWN_MS = 2500;
const FAILED_SHOWN_MS = 8000;
const STOPS: ReadonlySet<string> = new Set(["stop", "stop_all"]);

/** The part of a socket used here. */
export interface CommandSocket {
  readonly isOpen: boolean;
  send(message: object): boolean;
  close(): void;
}

/** `sent`: the cockpit passed it on. `refused`: by the cockpit or the drone, with a reason. `not_sent`: it never left, or
 *  was too late to count. `no_answer`: it left in time, without an answer. */
export type Fate = "pending" | "sent" | "refused" | "not_sent" | "no_answer";

/** The outcome of the newest command of its kind. */
export interface Result {
  fate: Fate;
  why: string;
}

interface Pending {
  command: { do: string };
  n: number;
  pressed_ms: number;
  /** Sent over the connection that is open now. */
  on_its_way: boolean;
  /** Sent over any connection. */
  went: boolean;
}

export interface Answer {
  type: string;
  do?: string;
  n?: number;
  why?: string;
  now_s?: number;
}

export interface CommandListener {
  /** The connection has opened or closed. */
  linked(open: boolean): void;
  /** Any other message of the cockpit. */
  received(message: Answer): void;
  /** A command will not be executed: the cockpit refused it, or this page gave up on it. */
  refused(command: string, why: string, n: number): void;
  /** The outcome of a command has become known, or is no longer shown. */
  changed(): void;
}

export class CommandSender {
  /** Round trip to the cockpit [s]; null while unknown. */
  round_trip_s: number | null = null;
  private readonly socket: CommandSocket;
  private number = 0;
  private sent = 0;
  private pinged_ms = Number.NEGATIVE_INFINITY;
  private answered_s: number | null = null;
  private readonly pings = new Map<number, number>();
  private readonly pending = new Map<string, Pending>();
  private readonly settled = new Map<string, number>(); // number of the newest settled command of each kind
  private readonly results = new Map<string, Result & { since_ms: number }>();

  constructor(
    connect: (handlers: Handlers) => CommandSocket,
    readonly clock: ServerClock,
    private readonly listener: CommandListener,
    private readonly now_ms: () => number,
  ) {
    this.socket = connect({ message: (data) => this.onMessage(data), state: (open) => this.linked(open) });
  }

  /** Age of the newest answer [ms]; null before the first on this connection. */
  age_ms(now_ms = this.now_ms()): number | null {
    const age_s = this.answered_s === null ? null : this.clock.age_s(this.answered_s, now_ms);
    return age_s === null ? null : age_s * 1000;
  }

  /** A command sent now should arrive in time. */
  get isLive(): boolean {
    const age_ms = this.age_ms();
    return this.socket.isOpen && age_ms !== null && age_ms <= STALE_MS;
  }

  /** The outcome of the newest command of this kind; null if it no longer matters. */
  result(what: string): Result | null {
    return this.results.get(what) ?? null;
  }

  /** The number of the last command sent, as used in the cockpit's answers. */
  get newest(): number {
    return this.sent;
  }

  /** Only an emergency stop waits for a connection. */
  canSend(command: { do: string }): boolean {
    return this.isLive || STOPS.has(command.do);
  }

  /** Send a command. False if it can't be sent; the listener has then been called. */
  send(command: { do: string }): boolean {
    const now_ms = this.now_ms();
    this.sent = this.number += 1;
    const pending: Pending = { command, n: this.number, pressed_ms: now_ms, on_its_way: false, went: false };
    if (!this.canSend(command)) {
      this.end(command.do, "not_sent", this.silence(now_ms));
      return false;
    }
    this.pending.set(command.do, pending);
    this.show(command.do, "pending", "");
    return this.transmit(pending) || STOPS.has(command.do);
  }

  /** Sticks: a command that can't be sent now is dropped. */
  steer<Message extends { do: string }>(command: Message): boolean {
    return this.isLive && this.attempt(command);
  }

  /** Sent even over a dead link: for commands that only end a flight and are useless later. */
  attempt<Message extends { do: string }>(command: Message): boolean {
    const stamp = this.clock.at(this.now_ms());
    return stamp !== null && this.socket.send({ ...command, ...stamp });
  }

  /** Called many times per second; `pause_ms` between two pings. */
  tick(pause_ms: number): void {
    const now_ms = this.now_ms();
    if (now_ms - this.pinged_ms >= pause_ms) this.ping(now_ms);
    for (const pending of [...this.pending.values()]) {
      const late_ms = this.late_ms(pending);
      const age_ms = now_ms - pending.pressed_ms;
      if (!pending.on_its_way && age_ms < late_ms) this.transmit(pending);
      if (age_ms >= late_ms && !pending.went) this.end(pending.command.do, "not_sent", this.silence(now_ms));
      else if (age_ms >= late_ms + (STOPS.has(pending.command.do) ? 0 : ANSWER_MS)) this.end(pending.command.do, "no_answer", t.commands.late(this.silence(now_ms)));
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
    this.socket.close();
  }

  private late_ms = (pending: Pending): number => (STOPS.has(pending.command.do) ? STOP_LATE_MS : LATE_MS);

  private silence(now_ms: number): string {
    const age_ms = this.age_ms(now_ms);
    if (!this.socket.isOpen || age_ms === null) return t.commands.noConnection;
    return t.commands.silent((age_ms / 1000).toFixed(1));
  }

  private transmit(pending: Pending): boolean {
    const stamp = this.clock.at(pending.pressed_ms);
    if (stamp === null || !this.socket.isOpen) return false;
    pending.on_its_way = this.socket.send({ ...pending.command, n: pending.n, ...stamp });
    pending.went ||= pending.on_its_way;
    return pending.on_its_way;
  }

  private ping(now_ms: number): void {
    this.pinged_ms = now_ms;
    this.number += 1;
    if (this.pings.size >= 60) this.pings.clear(); // no answers: an old one is meaningless by now
    const seen = this.answered_s === null ? {} : { seen_s: this.answered_s };
    if (this.socket.send({ do: "ping", n: this.number, ...seen, ...this.clock.at(now_ms) })) this.pings.set(this.number, now_ms);
  }

  private linked(open: boolean): void {
    this.clock.reset();
    this.answered_s = this.round_trip_s = null;
    this.pings.clear();
    for (const pending of this.pending.values()) pending.on_its_way = false;
    this.listener.linked(open);
    if (open) this.ping(this.now_ms());
  }

  private onMessage(data: string | ArrayBuffer): void {
    if (typeof data !== "string") return;
    const message = JSON.parse(data) as Answer;
    if (message.type === "pong") this.pong(message);
    else {
      if (message.type === "sent") this.settle(message, "sent");
      if (message.type === "refused") {
        this.settle(message, "refused");
        this.listener.refused(message.do ?? "", message.why ?? "", message.n ?? 0);
      }
      this.listener.received(message);
    }
  }

  private pong(answer: Answer): void {
    const sent_ms = this.pings.get(answer.n ?? -1);
    this.pings.delete(answer.n ?? -1);
    if (sent_ms === undefined || answer.now_s === undefined) return;
    const now_ms = this.now_ms();
    const first = this.answered_s === null;
    this.clock.pong(sent_ms, now_ms, answer.now_s);
    this.round_trip_s = (now_ms - sent_ms) / 1000;
    this.answered_s = answer.now_s;
    if (first) this.tick(Number.POSITIVE_INFINITY); // an emergency stop may wait for it
    if (first) this.listener.changed();
  }

  /** The cockpit's answer to a command: it may also arrive after this page has given up on it. */
  private settle(answer: Answer, fate: Fate): void {
    const what = answer.do ?? "";
    const pending = this.pending.get(what);
    if (answer.n && answer.n !== (pending?.n ?? this.settled.get(what))) return; // answers an earlier one
    this.pending.delete(what);
    if (pending) this.settled.set(what, pending.n);
    this.show(what, fate, answer.why ?? "");
  }

  /** This page gives up on it. */
  private end(what: string, fate: Fate, why: string): void {
    const pending = this.pending.get(what);
    this.pending.delete(what);
    if (pending) this.settled.set(what, pending.n);
    this.show(what, fate, why);
    this.listener.refused(what, `${t.commands.fates[fate]}: ${why}`, pending?.n ?? this.sent);
  }

  private show(what: string, fate: Fate, why: string): void {
    this.results.set(what, { fate, why, since_ms: this.now_ms() });
    this.listener.changed();
  }
}
