// What the cockpit's server sends and receives: docs/cockpit.md. SI units and radians; what is not known is null.

import type { FollowMessage, FollowMode, Mark } from "./follow.js";
import type { Encoding } from "./h264.js";
import type { RouteProgress } from "./route.js";

export type Vector = [number, number, number];

export interface Camera {
  name: string;
  width: number;
  height: number;
}

export interface Links {
  application: string;
  vehicle: string;
  reason: string;
}

/** Something that is wrong with a drone now. */
export interface Alarm {
  /** What it is about, the same while it lasts: `battery`, `vehicle_link`, `video_age.front`, … */
  id: string;
  /** It may rise while it lasts. */
  severity: "warning" | "critical";
  text: string;
}

/** A row of the overview. */
export interface DroneRow {
  name: string;
  uri: string;
  vehicle: string;
  transport: string;
  state: string;
  airborne: boolean;
  battery: number | null;
  owner: string | null;
  me: boolean;
  links: Links;
  alarms: Alarm[];
  cameras: Camera[];
  can_fly: boolean;
  why_not: string;
  recording: boolean;
  position: Vector | null;
  altitude: number | null;
  yaw: number | null;
  /** Played by this cockpit. */
  replay: boolean;
}

export interface Vehicle {
  type: "vehicle";
  name: string;
  uri: string;
  transport: string;
  vehicle: string;
  description: string;
  can_fly: boolean;
  why_not: string;
  cameras: Camera[];
  priorities: [number, number];
}

export interface Channel {
  count: number;
  rate_hz: number | null;
  lost: number;
  dropped: number;
  malformed: number;
  age_s: number | null;
  delay_s: { median: number | null; p99: number | null } | null;
}

export interface DroneEvent {
  n: number;
  kind: string;
  severity: string;
  text: string;
  app: string;
  age_s: number;
}

export interface Place {
  position: Vector;
  yaw: number | null;
}

export interface State {
  type: "state";
  /** When it was made, on the cockpit's clock. */
  now_s: number;
  links: Links;
  feedback: { age_s: number | null; failsafe: string } | null;
  attitude: { roll: number | null; pitch: number | null; yaw: number | null } | null;
  altitude: number | null;
  velocity: Vector | null;
  speed: number | null;
  position: Vector | null;
  /** Where it took off. */
  start: Vector | null;
  battery: number | null;
  flight: string;
  airborne: boolean;
  owner: string | null;
  authority: { holder: string | null; priority: number | null; lease: number; me: boolean };
  channels: Record<string, Channel>;
  alarms: Alarm[];
  values: Record<string, number | null>;
  set_points: { action: string; values: Record<string, number | null>; age_s: number | null } | null;
  truth: Place | null;
  targets: (Place & { name: string })[];
  waypoints: (Place & { app: string | null })[];
  events: DroneEvent[];
}

export type Value = boolean | number | string | number[];

export interface Parameter {
  name: string;
  type: string;
  value: Value | null;
  unit: string;
  minimum: number | null;
  maximum: number | null;
  default: Value | null;
  choices: Value[];
  read_only: boolean;
  /** Writing it does something once, as a flip: it keeps no value. */
  momentary: boolean;
  description: string;
}

export interface Authority {
  type: "authority";
  state: "none" | "queued" | "held" | "preempted";
  holder: string | null;
  priority: number | null;
  mine: boolean;
  /** How this page lost the control that it had; null if it did not. */
  why: string | null;
  /** This page has given it to who asked for it. */
  given: boolean;
  /** The name under which this page flies, as others see it; empty until the cockpit has said it. */
  app: string;
  /** Where this page waits; null while it does not. */
  line: QueuePosition | null;
  /** The pages of this cockpit that wait for control, by the names under which others see them; this one, too. */
  waiting: readonly string[];
}

export interface QueuePosition {
  /** 1 is next. */
  position: number | null;
  /** Expected when it was sent. */
  wait_s: number | null;
  /** The one who has control was asked first, */
  asked: boolean;
  /** and keeps it for this reason, which may be empty. */
  declined: string | null;
}

/** Somebody asks for the control that this page has. */
export interface Question {
  id: number;
  by: string;
  priority: number;
  /** For how long it is wanted. */
  for_s: number | null;
  /** Left of the time to answer when it was sent; then a higher priority has it. */
  left_s: number;
  /** By this page. */
  declined: boolean;
}

export type PilotMessage =
  | Authority
  | { type: "asked"; questions: Question[] }
  | { type: "done"; do: string; n?: number; name?: string; value?: Value }
  | RouteProgress
  | FollowMessage
  | { type: "sent"; do: string; n: number }
  | { type: "refused"; do: string; n: number; why: string }
  | { type: "pong"; n: number; now_s: number };

export interface Sticks {
  forward: number;
  left: number;
  up: number;
  yaw_rate: number;
}

export type Command =
  | { do: "take"; priority: number; ask: boolean }
  | { do: "answer"; id: number; grant: boolean; reason: string }
  | { do: "release" | "takeoff" | "hover" | "land" | "return" | "stop" | "reset" }
  | { do: "hover"; automatic: true }
  | ({ do: "fly"; touches: number } & Sticks)
  | { do: "goto"; x: number; y: number; z: number; yaw?: number }
  | { do: "route"; id: string }
  | { do: "route_pause" | "route_resume" | "route_skip" | "route_stop" }
  | { do: "follow_select"; camera: string | null }
  | ({ do: "follow" } & Mark)
  | { do: "follow_mode"; mode: FollowMode; distance_m?: number }
  | { do: "follow_stop" }
  | { do: "set"; name: string; value: Value };

export interface Session {
  role: "pilot" | "observer" | null;
  name: string;
  login: boolean;
  hint: string;
}

export interface RunningRecording {
  id: string;
  drones: string[];
  path: string;
  state: string;
  reason: string;
  seconds: number;
  bytes: number;
  /** By drone and channel: what was received and left out, and what never came. */
  dropped: Record<string, Record<string, number>>;
  missed: Record<string, Record<string, number>>;
}

export interface PastRecording {
  name: string;
  size: number;
  started: number | null;
  drones: string[];
  seconds: number | null;
  problem: string | null;
  /** The beginning of what people wrote about it. */
  note: string;
  marks: number;
}

export interface Recordings {
  folder: string;
  running: RunningRecording[];
  past: PastRecording[];
  trash: { count: number; bytes: number };
}

export type Shape =
  | { kind: "line"; points: [number, number][]; closed: boolean; colour: Vector }
  | { kind: "points"; points: [number, number][]; colour: Vector }
  | { kind: "text"; text: string; at: [number, number]; colour: Vector };

export interface Drawing {
  type: "drawing";
  source: string;
  captured_ns: string;
  width: number;
  height: number;
  shapes: Shape[];
}

export interface FrameHead {
  ack: number;
  camera: string;
  seq: number;
  captured_ns: string;
  age_s: number;
  /** The cockpit's time when it was sent. */
  now_s: number;
  width: number;
  height: number;
  /** Of a picture that is no JPEG. */
  h264?: Encoding;
}
