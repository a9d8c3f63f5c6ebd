// The scene of map and 3-D view: the position of everything. World axes: x east, y north, z up [m].

import type { Trail } from "./history.js";
import type { DroneRow, Vector } from "./model.js";
import { isRecording } from "./safety.js";
import type { World } from "./surroundings.js";

export interface Body {
  name: string;
  position: Vector;
  roll: number;
  pitch: number;
  yaw: number | null;
  /** Its past positions, if shown. */
  trail?: Trail;
  /** The name of its colour on the map, if it has its own. */
  ink?: string;
}

export interface Scene {
  /** The drone of the map; null while its position is unknown, and on a map of several. */
  own: Body | null;
  /** Its true position, as reported by the simulator or motion capture. */
  truth: Body | null;
  others: Body[];
  targets: Body[];
  waypoints: { position: Vector; own: boolean }[];
  trail: Trail;
  /** The scenery, if known. */
  world?: World | null;
  /** The route being planned or flown. */
  route?: readonly Vector[];
  /** The start of this flight. */
  start?: Vector | null;
}

/** The other drones, for the map of one: recordings are not shown among live drones, nor the other way round. */
export const othersOf = (own: { name: string; recorded: boolean }, rows: readonly DroneRow[]): Body[] =>
  rows.flatMap(({ name, uri, position, yaw }) =>
    name === own.name || own.recorded || isRecording({ uri }) || position === null ? [] : [{ name, position, roll: 0, pitch: 0, yaw }],
  );
