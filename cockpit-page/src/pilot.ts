// One drone's controls, as this page has them: orders go out, and what became of them comes back.
//
// While this page holds the authority it tells the cockpit several times a second that it is there and hears; sticks that
// are off the centre are sent twenty times a second. Sticks that come back to the centre, a page that loses the focus and a
// gamepad that goes away make the vehicle hover; a connection that breaks makes the cockpit do that.

import type { ServerClock } from "./clock.js";
import type { Authority, Order, Question, Sticks, Told, Value } from "./model.js";
import { type Line, OrderLine, type Result } from "./orders.js";
import type { Handlers } from "./socket.js";
import { isCentred } from "./sticks.js";

export const STEER_MS = 50;
const ALIVE_MS = 150;
const WATCH_MS = 300; // so that what is older than a second is known to be

export interface PilotListener {
  /** Who has control or asks for it, or the connection, has changed. */
  changed(): void;
  refused(order: string, why: string): void;
  done(order: string, name?: string, value?: Value): void;
}

const NOBODY: Authority = { type: "authority", state: "none", holder: null, priority: null, mine: false, why: null, line: null };

export class Pilot {
  authority: Authority = NOBODY;
  /** Who asks for the control that this page has; who would get it first is the first. */
  questions: readonly Question[] = [];
  connected = false;
  /** On the way to a place that was chosen on this page. */
  going = false;
  /** How this page lost the control that it had; it stays until the person takes control or puts it away. */
  ended = "";
  private steering = false;
  private readonly orders: OrderLine;
  private told_ms = 0; // when the authority was told
  private questioned_ms = 0; // and the questions

  constructor(
    connect: (handlers: Handlers) => Line,
    clock: ServerClock,
    private readonly listener: PilotListener,
    private readonly now_ms: () => number = () => performance.now(),
  ) {
    this.orders = new OrderLine(
      connect,
      clock,
      { linked: (open) => this.linked(open), told: (message) => this.hear(message as Told), refused: (order, why) => this.refused(order, why), changed: () => listener.changed() },
      now_ms,
    );
  }

  /** There and back to the cockpit [s]; null while not known. */
  get round_trip_s(): number | null {
    return this.orders.round_trip_s;
  }

  /** The cockpit has answered on this connection. */
  get isReady(): boolean {
    return this.connected && this.orders.age_ms() !== null;
  }

  /** What is sent now is known to arrive in time, as far as can be known. */
  get isLive(): boolean {
    return this.orders.isLive;
  }

  /** How old the cockpit's newest answer is [ms]; null while there was none. */
  age_ms(now_ms: number): number | null {
    return this.orders.age_ms(now_ms);
  }

  /** What became of the newest order of this kind. */
  result(what: string): Result | null {
    return this.orders.result(what);
  }

  /** As far as the cockpit said last. */
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
    this.order({ do: "take", priority, ask });
  }

  /** To who asks: hand it over now, or keep it, for a reason that may be empty. */
  answer(id: number, grant: boolean, reason: string): void {
    this.order({ do: "answer", id, grant, reason });
  }

  release(): void {
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

  /** The person has read how control was lost. */
  understood(): void {
    this.ended = "";
    this.listener.changed();
  }

  /** Called every STEER_MS with the sticks as they are, as velocities. */
  steer(sticks: Sticks): void {
    if (this.mine && !isCentred(sticks)) {
      this.going = false;
      this.steering = this.orders.steer({ do: "fly", ...sticks } satisfies Order);
    } else if (this.steering) {
      this.rest();
    }
    this.orders.tick(this.mine ? ALIVE_MS : WATCH_MS);
  }

  /** Hover if this page has it under way: when it loses the focus, or what it is flown with. */
  rest(): void {
    const moving = this.steering || this.going;
    this.end();
    if (moving && this.mine) this.orders.steer({ do: "hover" } satisfies Order);
  }

  close(): void {
    this.orders.close();
  }

  private order(order: Order): boolean {
    return this.orders.order(order);
  }

  private end(): void {
    this.steering = this.going = false;
  }

  private linked(open: boolean): void {
    if (!open && this.mine) this.ended = "the connection to the cockpit broke while you had control: it hovers, and nobody has control";
    this.connected = open;
    this.end();
    this.authority = NOBODY;
    this.questions = [];
    this.listener.changed();
  }

  private refused(order: string, why: string): void {
    if (order === "goto" || order === "fly") this.end();
    this.listener.refused(order, why);
  }

  private hear(told: Told): void {
    if (told.type === "authority") {
      this.authority = told;
      this.told_ms = this.now_ms();
      if (told.mine) this.ended = "";
      else if (told.why) this.ended = told.why;
      if (!told.mine) this.end();
      if (!told.mine) this.questions = [];
      this.listener.changed();
    } else if (told.type === "asked") {
      this.questions = told.questions;
      this.questioned_ms = this.now_ms();
      this.listener.changed();
    } else if (told.type === "done") {
      if (told.do === "goto") this.going = false;
      this.listener.done(told.do, told.name, told.value);
    }
  }
}
