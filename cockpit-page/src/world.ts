// What map and 3-D view show: where everything is. World axes: x east, y north, z up [m].

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
  /** Where it was, if that is shown. */
  trail?: Trail;
  /** The name of its colour on the map, if it has one of its own. */
  ink?: string;
}

export interface Scene {
  /** The drone that the map is about; null while its position is not known, and on a map of several. */
  own: Body | null;
  /** Where it really is, as the simulator or motion capture reports it. */
  truth: Body | null;
  others: Body[];
  targets: Body[];
  waypoints: { position: Vector; own: boolean }[];
  trail: Trail;
  /** What stands there, where that is known. */
  world?: World | null;
  /** The route that is planned or flown. */
  route?: readonly Vector[];
  /** Where this flight began. */
  start?: Vector | null;
}

/** What else flies, for the map of one of them: what was recorded is no part of what flies now, nor the other way round. */
export const othersOf = (own: { name: string; recorded: boolean }, rows: readonly DroneRow[]): Body[] =>
  rows.flatMap(({ name, uri, position, yaw }) =>
    name === own.name || own.recorded || isRecording({ uri }) || position === null ? [] : [{ name, position, roll: 0, pitch: 0, yaw }],
  );
