// What map and 3-D view show: where everything is. World axes: x east, y north, z up [m].

import type { Trail } from "./history.js";
import type { Vector } from "./model.js";

export interface Body {
  name: string;
  position: Vector;
  roll: number;
  pitch: number;
  yaw: number | null;
}

export interface Scene {
  /** The drone of this pane; null while its position is not known. */
  own: Body | null;
  /** Where it really is, as the simulator or motion capture tells. */
  truth: Body | null;
  others: Body[];
  targets: Body[];
  waypoints: { position: Vector; own: boolean }[];
  trail: Trail;
}
