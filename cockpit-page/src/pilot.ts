// This page's controls of one drone: sends commands, and handles their outcome.
//
// While this page holds the authority it pings the cockpit several times a second, and sends sticks that are off the
// centre 20 times a second. The vehicle hovers when sticks return to the centre, the page loses the focus, or a gamepad
// disconnects; if the connection breaks, the cockpit makes it hover.

import type { ServerClock } from "./clock.js";
import { CommandSender, type CommandSocket, type Result } from "./commands.js";
import type { FollowMessage, FollowMode, Mark } from "./follow.js";
import { t } from "./language/index.js";
import type { Authority, Command, PilotMessage, Question, Sticks, Value } from "./model.js";
import type { RouteProgress } from "./route.js";
import type { Handlers } from "./socket.js";
import { isCentred } from "./sticks.js";

/** Interval between stick commands. */
export const STEER_MS = 50;
const ALIVE_MS = 150; // interval between pings while this page has control
const WATCH_MS = 300; // interval between other pings; often enough to notice data older than a second

export interface PilotListener {
  /** The holder of control, its applicants, or the connection has changed. */
  changed(): void;
  refused(command: string, why: string): void;
  done(command: string, name?: string, value?: Value): void;
  /** Progress of a flight along a route. */
  route?(progress: RouteProgress | null): void;
  /** The state of a marked target; null: the connection is gone, and the target with it. */
  follow?(message: FollowMessage | null): void;
}

const NOBODY: Authority = { type: "authority", state: "none", holder: null, priority: null, mine: false, why: null, given: false, app: "", line: null, waiting: [] };

export class Pilot {
  authority: Authority = NOBODY;
  /** The applications that ask for this page's control; the next in line comes first. */
  questions: readonly Question[] = [];
  connected = false;
  /** On the way to a place chosen on this page. */
  going = false;
  /** Following a target marked on this page. */
  following = false;
  /** How this page lost control; kept until the person takes control or dismisses it. */
  ended = "";
  private flight = 0; // number of the command that replaced this page's previous flight
  private replaced: { going: boolean; following: boolean } | null = null; // that flight, which continues if the command is refused; null once the cockpit has the command
  private steering = false;
  private stopping = false; // the vehicle does not show the emergency stop yet, or no round of the sticks has seen it
  private stopped = false; // answered: the next round ends it
  private readonly commands: CommandSender;
  private received_ms = 0; // when the authority was received
  private questioned_ms = 0; // and the questions

  constructor(
    connect: (handlers: Handlers) => CommandSocket,
    clock: ServerClock,
    private readonly listener: PilotListener,
    private readonly now_ms: () => number = () => performance.now(),
  ) {
    this.commands = new CommandSender(
      connect,
      clock,
      { linked: (open) => this.linked(open), received: (message) => this.onMessage(message as PilotMessage), refused: (command, why, n) => this.refused(command, why, n), changed: () => listener.changed() },
      now_ms,
    );
  }

  /** Round trip to the cockpit [s]; null while unknown. */
  get round_trip_s(): number | null {
    return this.commands.round_trip_s;
  }

  /** The cockpit has answered on this connection. */
  get isReady(): boolean {
    return this.connected && this.commands.age_ms() !== null;
  }

  /** A command sent now should arrive in time. */
  get isLive(): boolean {
    return this.commands.isLive;
  }

  /** Age of the cockpit's newest answer [ms]; null if there was none. */
  age_ms(now_ms: number): number | null {
    return this.commands.age_ms(now_ms);
  }

  /** The outcome of the newest command of this kind. */
  result(what: string): Result | null {
    return this.commands.result(what);
  }

  /** As of the cockpit's newest message. */
  get mine(): boolean {
    return this.connected && this.authority.mine;
  }

  /** Sticks count: this page has control, its data is fresh, and the motors are not being stopped. */
  get isFlyable(): boolean {
    return this.mine && this.isLive && !this.stopping;
  }

  /** Whether it waits in line, or to get control back after a pre-emption. */
  get waits(): boolean {
    return this.connected && (this.authority.state === "queued" || this.authority.state === "preempted");
  }

  /** The expected wait from now; null if unknown, or not waiting. */
  get wait_s(): number | null {
    const wait_s = this.waits ? (this.authority.line?.wait_s ?? null) : null;
    return wait_s === null ? null : Math.max(0, wait_s - (this.now_ms() - this.received_ms) / 1000);
  }

  /** The time left to answer. */
  left_s(question: Question): number {
    return Math.max(0, question.left_s - (this.now_ms() - this.questioned_ms) / 1000);
  }

  /** `ask`: ask the holder first. */
  take(priority: number, ask: boolean): void {
    this.send({ do: "take", priority, ask });
  }

  /** Answer an applicant: hand control over now, or keep it, for a reason that may be empty. */
  answer(id: number, grant: boolean, reason: string): void {
    this.send({ do: "answer", id, grant, reason });
  }

  release(): void {
    this.replace({ do: "release" });
  }

  /** Take-off, landing, hover, return, emergency stop and its reset. */
  act(deed: "takeoff" | "hover" | "land" | "return" | "stop" | "reset"): void {
    const sent = this.replace({ do: deed });
    this.going = sent && deed === "return";
    if (sent && deed === "stop") [this.stopping, this.stopped] = [true, false];
  }

  goTo(x: number, y: number, z: number): void {
    this.going = this.replace({ do: "goto", x, y, z });
  }

  /** Fly along a checked route. */
  flyRoute(id: string): void {
    this.going = this.replace({ do: "route", id });
  }

  steerRoute(deed: "route_pause" | "route_resume" | "route_skip" | "route_stop"): void {
    this.send({ do: deed });
  }

  /** A box is about to be drawn on a frame of this camera; null if no longer. */
  selectTarget(camera: string | null): void {
    this.send({ do: "follow_select", camera });
  }

  /** Track a target without flying. */
  markTarget(mark: Mark): void {
    this.send({ do: "follow", ...mark });
  }

  /** Follow the tracked target, or change the mode. */
  flyAfter(mode: FollowMode, distance_m: number | null): void {
    this.following = this.replace({ do: "follow_mode", mode, ...(distance_m === null ? {} : { distance_m }) });
  }

  stopFollowing(): void {
    this.send({ do: "follow_stop" });
  }

  write(name: string, value: Value): void {
    this.send({ do: "set", name, value });
  }

  /** The person has read how control was lost. */
  understood(): void {
    this.ended = "";
    this.listener.changed();
  }

  /** Called every STEER_MS with the sticks as velocities. `touches`: counts movements by hands. */
  steer(sticks: Sticks, touches = 0): void {
    // A vehicle may show a stop within one round: a stick held throughout must still be centred first.
    if (this.stopped) this.stopping = this.stopped = false;
    if (this.mine && !isCentred(sticks)) {
      if (this.commands.steer({ do: "fly", ...sticks, touches } satisfies Command)) [this.steering, this.going, this.following] = [true, false, false];
      else this.rest();
    } else if (this.steering) {
      this.rest();
    }
    this.commands.tick(this.mine ? ALIVE_MS : WATCH_MS);
  }

  /** Hover if this page has it under way: when the page loses the focus, or its input device. */
  rest(): void {
    const moving = this.steering || this.going || this.following;
    this.end();
    // Even without answers: the message may still arrive long before the cockpit counts this page as gone.
    if (moving && this.mine) this.commands.attempt({ do: "hover", automatic: true } satisfies Command);
  }

  close(): void {
    this.commands.close();
  }

  private send(command: Command): boolean {
    return this.commands.send(command);
  }

  /** Send a command that replaces this page's flight, which ends even if the command can't be sent. */
  private replace(command: Command): boolean {
    const { going, following } = this;
    const can = this.commands.canSend(command);
    if (can) this.end();
    else this.rest();
    this.replaced = null;
    const sent = this.send(command);
    this.flight = this.commands.newest;
    if (can) this.replaced = { going, following };
    return sent;
  }

  /** Whether an answer concerns this page's present flight, not one that it replaced; true if the answer has no number. */
  private isNewest(n?: number): boolean {
    return !n || !this.flight || n === this.flight;
  }

  private end(): void {
    this.steering = this.going = this.following = false;
  }

  private linked(open: boolean): void {
    if (!open && this.mine) this.ended = t.pilot.broke;
    this.connected = open;
    this.stopping = this.stopped = false;
    this.replaced = null;
    this.end();
    this.authority = NOBODY;
    this.questions = [];
    this.listener.follow?.(null);
    this.listener.route?.(null);
    this.listener.changed();
  }

  private refused(command: string, why: string, n: number): void {
    if (command === "stop") this.stopped = true;
    if (["goto", "route", "return", "follow_mode"].includes(command) && this.isNewest(n)) this.end(); // sticks continue to fly until released
    if (n === this.flight && this.replaced) {
      this.going ||= this.replaced.going;
      this.following ||= this.replaced.following;
      this.replaced = null;
    }
    this.listener.refused(command, why);
  }

  private onMessage(message: PilotMessage): void {
    if (message.type === "authority") {
      const waited = this.waits;
      this.authority = message;
      this.received_ms = this.now_ms();
      if (message.mine || message.given) this.ended = "";
      else if (message.why) this.ended = message.why;
      if (message.given && message.why) this.listener.done("given", message.holder ?? "");
      if (message.mine && waited) this.listener.done("granted");
      if (!message.mine) this.end();
      if (!message.mine) this.questions = [];
      this.listener.changed();
    } else if (message.type === "asked") {
      this.questions = message.questions;
      this.questioned_ms = this.now_ms();
      this.listener.changed();
    } else if (message.type === "route") {
      this.going = message.state === "flying" || message.state === "acting";
      this.listener.route?.(message);
    } else if (message.type === "follow") {
      this.following = message.state === "flying" || message.state === "waiting";
      this.listener.follow?.(message);
    } else if (message.type === "sent") {
      if (message.n === this.flight) this.replaced = null;
    } else if (message.type === "done") {
      if (message.do === "stop") this.stopped = true;
      if ((message.do === "goto" || message.do === "return") && this.isNewest(message.n)) this.going = false;
      this.listener.done(message.do, message.name, message.value);
    }
  }
}
