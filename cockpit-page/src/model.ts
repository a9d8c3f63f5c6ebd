// The messages to and from the cockpit's server: docs/cockpit.md. SI units and radians; unknown values are null.

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

/** A present problem of a drone. */
export interface Alarm {
  /** Its subject, constant while it lasts: `battery`, `vehicle_link`, `video_age.front`, … */
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
  /** Replayed by this cockpit. */
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
  /** When the cockpit made it, on the cockpit's clock. */
  now_s: number;
  links: Links;
  feedback: { age_s: number | null; failsafe: string } | null;
  attitude: { roll: number | null; pitch: number | null; yaw: number | null } | null;
  altitude: number | null;
  velocity: Vector | null;
  speed: number | null;
  position: Vector | null;
  /** The place of take-off. */
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
  /** Writing it acts once, such as a flip: it keeps no value. */
  momentary: boolean;
  description: string;
}

export interface Authority {
  type: "authority";
  state: "none" | "queued" | "held" | "preempted";
  holder: string | null;
  priority: number | null;
  mine: boolean;
  /** How this page lost control; null if it did not. */
  why: string | null;
  /** This page handed it over on request. */
  given: boolean;
  /** The name under which this page flies, as others see it; empty until the cockpit has sent it. */
  app: string;
  /** This page's place in the queue; null while it is not waiting. */
  line: QueuePosition | null;
  /** Those that wait for control, by the names that others see: this cockpit's pages, and another application if it is first. */
  waiting: readonly string[];
}

export interface QueuePosition {
  /** 1 is next. */
  position: number | null;
  /** Expected wait at the time of sending. */
  wait_s: number | null;
  /** Whether the holder was asked first. */
  asked: boolean;
  /** The holder's reason for keeping control, which may be empty; null if it did not decline. */
  declined: string | null;
}

/** A request for the control that this page has. */
export interface Question {
  id: number;
  by: string;
  priority: number;
  /** How long control is wanted. */
  for_s: number | null;
  /** Time left to answer when it was sent; then a higher priority gets control. */
  left_s: number;
  /** Whether this page declined it. */
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
  /** By drone and channel: samples received and left out, and samples never received. */
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
  /** The beginning of its note. */
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
  /** The cockpit's time of sending. */
  now_s: number;
  width: number;
  height: number;
  /** For a picture other than JPEG. */
  h264?: Encoding;
}
