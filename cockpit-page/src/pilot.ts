// One drone's controls, as this page has them: orders go out, and what became of them comes back.
//
// While this page holds the authority it tells the cockpit several times a second that it is alive; sticks that are off
// the centre are sent twenty times a second. Sticks that come back to the centre, a page that loses the focus and a
// gamepad that goes away make the vehicle hover; a connection that breaks makes the cockpit do that.

import type { Authority, Order, Question, Sticks, Told, Value } from "./model.js";
import type { Handlers } from "./socket.js";
import { isCentred } from "./sticks.js";

export const STEER_MS = 50;
const ALIVE_MS = 150;

/** As much of a socket as is used. */
export interface Line {
  readonly isOpen: boolean;
  send(message: object): boolean;
  close(): void;
}

export interface PilotListener {
  /** Who has control or asks for it, or the connection, has changed. */
  changed(): void;
  refused(order: string, why: string): void;
  done(order: string, name?: string, value?: Value): void;
}

const NOBODY: Authority = { type: "authority", state: "none", holder: null, priority: null, mine: false, line: null };

export class Pilot {
  authority: Authority = NOBODY;
  /** Who asks for the control that this page has; who would get it first is the first. */
  questions: readonly Question[] = [];
  /** There and back to the cockpit [s]; null while not known. */
  round_trip_s: number | null = null;
  connected = false;
  /** On the way to a place that was chosen on this page. */
  going = false;
  private steering = false;
  private wanted = false;
  private readonly line: Line;
  private told_ms = 0; // when the authority was told
  private questioned_ms = 0; // and the questions
  private number = 0;
  private asked_ms = Number.NEGATIVE_INFINITY;
  private readonly pings = new Map<number, number>();

  constructor(
    connect: (handlers: Handlers) => Line,
    private readonly listener: PilotListener,
    private readonly now_ms: () => number = () => performance.now(),
  ) {
    this.line = connect({ message: (data) => this.hear(data), state: (open) => this.linked(open) });
  }

  get mine(): boolean {
    return this.connected && this.authority.mine;
  }

  /** Waits in line, or was overruled and waits to have it back. */
  get waits(): boolean {
    return this.connected && (this.authority.state === "queued" || this.authority.state === "preempted");
  }

  /** How long it is expected to wait, now; null if that is not known, or it does not wait. */
  get wait_s(): number | null {
    const wait_s = this.waits ? (this.authority.line?.wait_s ?? null) : null;
    return wait_s === null ? null : Math.max(0, wait_s - (this.now_ms() - this.told_ms) / 1000);
  }

  /** What is left of the time to answer, now. */
  left_s(question: Question): number {
    return Math.max(0, question.left_s - (this.now_ms() - this.questioned_ms) / 1000);
  }

  /** `ask`: who has control is asked first. */
  take(priority: number, ask: boolean): void {
    this.wanted = true;
    this.order({ do: "take", priority, ask });
  }

  /** To who asks: hand it over now, or keep it, for a reason that may be empty. */
  answer(id: number, grant: boolean, reason: string): void {
    this.order({ do: "answer", id, grant, reason });
  }

  release(): void {
    this.wanted = false;
    this.end();
    this.order({ do: "release" });
  }

  /** Take-off, landing, hover, emergency stop and its end. */
  act(deed: "takeoff" | "hover" | "land" | "stop" | "reset"): void {
    this.end();
    this.order({ do: deed });
  }

  goTo(x: number, y: number, z: number): void {
    this.end();
    this.going = this.order({ do: "goto", x, y, z });
  }

  write(name: string, value: Value): void {
    this.order({ do: "set", name, value });
  }

  /** Called every STEER_MS with the sticks as they are, as velocities. */
  steer(sticks: Sticks): void {
    if (this.mine && !isCentred(sticks)) {
      this.going = false;
      this.steering = this.line.send({ do: "fly", ...sticks } satisfies Order);
    } else if (this.steering) {
      this.rest();
    }
    const pause_ms = this.mine ? ALIVE_MS : 10 * ALIVE_MS;
    if (this.now_ms() - this.asked_ms >= pause_ms) this.ping();
  }

  /** Hover if this page has it under way: when it loses the focus, or what it is flown with. */
  rest(): void {
    const moving = this.steering || this.going;
    this.end();
    if (moving && this.mine) this.line.send({ do: "hover" } satisfies Order);
  }

  close(): void {
    this.line.close();
  }

  private order(order: Order): boolean {
    const sent = this.line.send(order);
    if (!sent) this.listener.refused(order.do, "not sent: this page has no connection to the cockpit");
    return sent;
  }

  private end(): void {
    this.steering = this.going = false;
  }

  private ping(): void {
    this.asked_ms = this.now_ms();
    this.number += 1;
    if (this.pings.size >= 20) this.pings.clear(); // no answers: an old one says nothing any more
    if (this.line.send({ do: "ping", n: this.number } satisfies Order)) this.pings.set(this.number, this.asked_ms);
  }

  private linked(open: boolean): void {
    const lost = !open && this.mine;
    this.connected = open;
    this.end();
    this.authority = NOBODY;
    this.questions = [];
    this.round_trip_s = null;
    this.pings.clear();
    if (lost) this.listener.refused("", "the connection to the cockpit broke: it makes the vehicle hover; take control again");
    this.listener.changed();
  }

  private hear(data: string | ArrayBuffer): void {
    if (typeof data !== "string") return;
    const told = JSON.parse(data) as Told;
    if (told.type === "authority") {
      const lost = this.authority.mine && !told.mine && this.wanted;
      this.authority = told;
      this.told_ms = this.now_ms();
      if (!told.mine) this.end();
      if (!told.mine) this.questions = [];
      if (lost) this.listener.refused("", `${told.holder ?? "somebody else"} has control now`);
      this.listener.changed();
    } else if (told.type === "asked") {
      this.questions = told.questions;
      this.questioned_ms = this.now_ms();
      this.listener.changed();
    } else if (told.type === "refused") {
      if (told.do === "goto" || told.do === "fly") this.end();
      this.listener.refused(told.do, told.why);
    } else if (told.type === "done") {
      if (told.do === "goto") this.going = false;
      this.listener.done(told.do, told.name, told.value);
    } else {
      const sent_ms = this.pings.get(told.n);
      this.pings.delete(told.n);
      if (sent_ms !== undefined) this.round_trip_s = (this.now_ms() - sent_ms) / 1000;
    }
  }
}
