// A route as in its file, and its editing. Pure.

export interface RouteAction {
  do: "look" | "wait" | "photo";
  yaw?: number;
  at?: [number, number];
  seconds?: number;
  camera?: string;
}

export interface RouteWaypoint {
  x: number;
  y: number;
  z: number;
  speed?: number;
  yaw?: number;
  look_at?: [number, number];
  actions?: RouteAction[];
}

export type RouteEnd = "hover" | "land" | "return";

export interface Route {
  version: 1;
  name: string;
  speed: number;
  end: RouteEnd;
  waypoints: RouteWaypoint[];
}

export interface Finding {
  /** Counted from 1; null for the whole route. */
  waypoint: number | null;
  severity: "error" | "warning";
  reason: string;
}

export interface RouteCheck {
  /** The id to fly it by. */
  id: string;
  ok: boolean;
  findings: Finding[];
  length_m: number;
  seconds: number;
  battery_left: number | null;
}

/** The progress of a flight along a route. */
export interface RouteProgress {
  type: "route";
  state: "ready" | "flying" | "acting" | "paused" | "done" | "stopped";
  kind: string;
  waypoint: number;
  of: number;
  text: string;
  problem: string;
}

export const emptyRoute = (): Route => ({ version: 1, name: "", speed: 0.5, end: "hover", waypoints: [] });

/** With all optional fields of a file. */
export const whole = (route: Partial<Route>): Route => ({ ...emptyRoute(), ...route });

export const waitOf = (one: RouteWaypoint): number => (one.actions ?? []).reduce((sum, action) => sum + (action.do === "wait" ? (action.seconds ?? 0) : 0), 0);

export const hasPhoto = (one: RouteWaypoint): boolean => (one.actions ?? []).some((action) => action.do === "photo");

/** With this wait and with or without a photo; turns are kept, and come first. */
export function withActions(one: RouteWaypoint, wait_s: number, photo: boolean): RouteWaypoint {
  const photos = (one.actions ?? []).filter((action) => action.do === "photo");
  const looks = (one.actions ?? []).filter((action) => action.do === "look");
  const waits: RouteAction[] = wait_s > 0 ? [{ do: "wait", seconds: wait_s }] : [];
  const actions = [...looks, ...waits, ...(photo ? (photos.length > 0 ? photos : [{ do: "photo" } as const]) : [])];
  const { actions: _, ...rest } = one;
  return actions.length > 0 ? { ...rest, actions } : rest;
}

/** The direction to look: a heading [rad], or a point (x, y) [m]. */
export interface Direction {
  yaw?: number;
  at?: [number, number];
}

const DEGREES = 180 / Math.PI;

/** A direction as typed: degrees, or a point as "x, y"; empty for none. */
export function directionText({ yaw, at }: Direction): string {
  return at ? at.join(", ") : yaw === undefined ? "" : String(Math.round(yaw * DEGREES));
}

/** The direction typed; null if invalid. */
export function parseDirection(text: string): Direction | null {
  const numbers = text.trim().split(/\s*[,;]\s*|\s+/).filter(Boolean).map(Number);
  if (numbers.length > 2 || !numbers.every(Number.isFinite)) return null;
  const [first, second] = numbers;
  if (first === undefined) return {};
  return second === undefined ? { yaw: first / DEGREES } : { at: [first, second] };
}

/** The heading on arrival. */
export const headingOf = ({ yaw, look_at }: RouteWaypoint): Direction => ({ ...(yaw === undefined ? {} : { yaw }), ...(look_at ? { at: look_at } : {}) });

export function withHeading(one: RouteWaypoint, { yaw, at }: Direction): RouteWaypoint {
  const { yaw: _, look_at: __, ...rest } = one;
  return { ...rest, ...(at ? { look_at: at } : yaw === undefined ? {} : { yaw }) };
}

/** The turn after arrival: the first action of that kind; others are kept. */
export const turnOf = (one: RouteWaypoint): Direction => (one.actions ?? []).find((action) => action.do === "look") ?? {};

export function withTurn(one: RouteWaypoint, { yaw, at }: Direction): RouteWaypoint {
  const old = (one.actions ?? []).find((action) => action.do === "look");
  const rest = (one.actions ?? []).filter((action) => action !== old);
  const turn: RouteAction[] = at ? [{ do: "look", at }] : yaw === undefined ? [] : [{ do: "look", yaw }];
  const { actions: _, ...place } = one;
  return turn.length + rest.length ? { ...place, actions: [...turn, ...rest] } : place;
}

/** With a waypoint moved to another position in the order. */
export function moved<T>(all: readonly T[], from: number, to: number): T[] {
  if (to < 0 || to >= all.length) return [...all];
  const rest = all.filter((_, number) => number !== from);
  return [...rest.slice(0, to), all[from] as T, ...rest.slice(to)];
}

/** The colour of a waypoint, by the worst problem of it or of the leg to it. */
export function toneOf(check: RouteCheck | null, number: number): "accent" | "warn" | "bad" {
  const own = (check?.findings ?? []).filter((one) => one.waypoint === number);
  return own.some((one) => one.severity === "error") ? "bad" : own.length > 0 ? "warn" : "accent";
}
