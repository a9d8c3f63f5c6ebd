"""What is known of some of the autopilots' parameters: units, ranges, and which of them have names of ours. Pure.

Units and ranges are those of the autopilots' own parameter references (ardupilot.org and docs.px4.io).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

_DEG: Final = math.pi / 180.0


@dataclass(frozen=True, slots=True)
class Meaning:
    """Of one parameter, in the autopilot's own unit."""

    unit: str = ""
    low: float | None = None
    high: float | None = None
    text: str = ""


@dataclass(frozen=True, slots=True)
class Common:
    """A name that all drivers share. The autopilot's number times ``factor`` is SI; 0 stands for no limit there."""

    name: str
    native: str
    unit: str
    factor: float
    text: str
    needs: str = ""  #: a parameter that must not be 0, or this one has no effect


MEANINGS: Final = {
    # ArduCopter
    "ANGLE_MAX": Meaning("cdeg", 1000, 8000, "greatest lean angle"),
    "ATC_ANGLE_MAX": Meaning("deg", 10, 80, "greatest lean angle"),
    "BATT_FS_LOW_ACT": Meaning("", 0, 7, "what happens with a low battery: 0 nothing, 1 land, 2 return"),
    "BATT_FS_CRT_ACT": Meaning("", 0, 7, "what happens with a critical battery: 0 nothing, 1 land, 2 return"),
    "BATT_LOW_VOLT": Meaning("V", 0, None, "voltage of a low battery; 0: not watched"),
    "DISARM_DELAY": Meaning("s", 0, 127, "armed on the ground for so long, it disarms"),
    "FENCE_ALT_MAX": Meaning("m", 10, 1000, "ceiling of the fence"),
    "FENCE_ENABLE": Meaning("", 0, 1, "whether the fence works"),
    "FS_EKF_ACTION": Meaning("", 0, 3, "what happens when it does not know where it is"),
    "FS_GCS_ENABLE": Meaning("", 0, 8, "what happens when no ground station is heard: 0 nothing, 5 land, 7 brake"),
    "FS_GCS_TIMEOUT": Meaning("s", 2, 120, "silence of the ground station that is a failure"),
    "FS_THR_ENABLE": Meaning("", 0, 7, "what happens when the remote control is lost"),
    "GUID_OPTIONS": Meaning("", 0, None, "bit 3: thrust is thrust, and no climb rate"),
    "GUID_TIMEOUT": Meaning("s", 0.1, 5, "silence after which a set-point is dropped"),
    "LAND_SPEED": Meaning("cm/s", 30, 200, "speed of the last part of a landing"),
    "MAV_GCS_SYSID": Meaning("", 1, 255, "the ground station whose heartbeats count"),
    "RTL_ALT": Meaning("cm", 30, 300_000, "altitude of the way home"),
    "WPNAV_SPEED": Meaning("cm/s", 10, 2000, "horizontal speed"),
    "WPNAV_SPEED_DN": Meaning("cm/s", 10, 500, "speed of descent"),
    "WPNAV_SPEED_UP": Meaning("cm/s", 10, 1000, "speed of climb, also of the thrust field"),
    # PX4
    "COM_DISARM_LAND": Meaning("s", None, 20, "standing for so long after a landing, it disarms"),
    "COM_DISARM_PRFLT": Meaning("s", None, 60, "armed on the ground for so long, it disarms"),
    "COM_DL_LOSS_T": Meaning("s", 5, 300, "silence of the ground station that is a failure"),
    "COM_LOW_BAT_ACT": Meaning("", 0, 3, "what happens with a low battery: 0 a warning, 2 land, 3 return"),
    "COM_OBL_RC_ACT": Meaning("", 0, 7, "what happens without set-points: 0 position mode, 5 hold"),
    "COM_OF_LOSS_T": Meaning("s", 0, 60, "silence after which set-points are missing"),
    "GF_ACTION": Meaning("", 0, 5, "what happens at the fence"),
    "GF_MAX_VER_DIST": Meaning("m", 0, 10_000, "height of the fence; 0: none"),
    "MIS_TAKEOFF_ALT": Meaning("m", 0, None, "height of a take-off that names none"),
    "MPC_MAN_Y_MAX": Meaning("deg/s", 0, 400, "greatest yaw rate"),
    "MPC_THR_HOVER": Meaning("", 0.1, 0.8, "thrust that carries the weight"),
    "MPC_TILTMAX_AIR": Meaning("deg", 20, 89, "greatest tilt"),
    "MPC_XY_VEL_MAX": Meaning("m/s", 0, 20, "greatest horizontal speed"),
    "MPC_Z_VEL_MAX_DN": Meaning("m/s", 0.5, 4, "greatest speed of descent"),
    "MPC_Z_VEL_MAX_UP": Meaning("m/s", 0.5, 8, "greatest speed of climb"),
    "NAV_DLL_ACT": Meaning("", 0, 6, "what happens when no ground station is heard: 0 nothing, 1 hold, 3 land"),
    "NAV_RCL_ACT": Meaning("", 1, 6, "what happens when the remote control is lost"),
}

#: The first that the autopilot has is taken.
COMMON: Final = (
    Common("limits.tilt", "ATC_ANGLE_MAX", "rad", _DEG, "greatest tilt"),
    Common("limits.tilt", "ANGLE_MAX", "rad", _DEG / 100, "greatest tilt"),
    Common("limits.tilt", "MPC_TILTMAX_AIR", "rad", _DEG, "greatest tilt"),
    Common("limits.climb", "WP_SPD_UP", "m/s", 1.0, "greatest speed of climb"),
    Common("limits.climb", "WPNAV_SPEED_UP", "m/s", 0.01, "greatest speed of climb"),
    Common("limits.climb", "MPC_Z_VEL_MAX_UP", "m/s", 1.0, "greatest speed of climb"),
    Common("limits.speed", "WP_SPD", "m/s", 1.0, "greatest horizontal speed"),
    Common("limits.speed", "WPNAV_SPEED", "m/s", 0.01, "greatest horizontal speed"),
    Common("limits.speed", "MPC_XY_VEL_MAX", "m/s", 1.0, "greatest horizontal speed"),
    Common("limits.yaw_rate", "MPC_MAN_Y_MAX", "rad/s", _DEG, "greatest yaw rate"),
    Common("limits.altitude", "FENCE_ALT_MAX", "m", 1.0, "ceiling of the fence", needs="FENCE_ENABLE"),
    Common("limits.altitude", "GF_MAX_VER_DIST", "m", 1.0, "height of the fence", needs="GF_MAX_VER_DIST"),
)
