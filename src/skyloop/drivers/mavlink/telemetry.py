"""What was heard of the vehicle last, each with its age. Pure."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass
from typing import Final

from skyloop.clock import nanoseconds, seconds
from skyloop.messages import Value
from skyloop.wire.mavlink.axes import Vector
from skyloop.wire.mavlink.codec import Message
from skyloop.wire.mavlink.modes import Landed, ModeFlag, SystemState

FLOWING_S: Final = 1.0  #: older than this, attitude, place and speed are not known
SLOW_S: Final = 6.0  #: the same for battery, GPS and the like
LANDED_S: Final = 3.0
PREARM: Final = 0x10000000  #: MAV_SYS_STATUS_PREARM_CHECK
AIRBORNE_M: Final = 0.5  #: higher than this it flies, where it does not say so


@dataclass(frozen=True, slots=True)
class View:
    """The vehicle as the pilot looks at it. World axes are MAVLink's: north, east, down."""

    mode: str
    armed: bool
    status: int  #: of the heartbeat
    landed: Landed
    ready: bool | None  #: whether it may be armed; None: it does not tell
    place: Vector | None  #: [m], from its origin
    velocity: Vector | None  #: [m/s]
    yaw: float | None  #: clockwise from north [rad]
    altitude_m: float | None  #: above where it stood, or the nearest to that that it tells
    amsl_m: float | None  #: altitude above mean sea level

    @property
    def airborne(self) -> bool | None:
        """Whether it is off the ground under its own power; None while an armed one tells neither that nor its height,
        as when it was just found again: that is no reason to think that it stands."""
        if not self.armed or self.landed is Landed.ON_GROUND:
            return False
        if self.landed is Landed.UNKNOWN:
            return None if self.altitude_m is None else self.altitude_m > AIRBORNE_M
        return True

    @property
    def failsafe(self) -> bool:
        """Whether the autopilot itself says that something is wrong."""
        return self.status in (SystemState.CRITICAL, SystemState.EMERGENCY, SystemState.TERMINATION)


class Telemetry:
    """The newest message of each kind."""

    def __init__(self) -> None:
        self.counts: Counter[str] = Counter()
        self._newest: dict[str, tuple[Message, int]] = {}
        self._ground_down: float | None = None  # "down" of the ground, from the origin [m]

    def heard(self, message: Message, now_ns: int) -> None:
        """One more, of the vehicle that is flown."""
        kind = message.get_type()
        self._newest[kind] = message, now_ns
        self.counts[kind] += 1
        if kind == "GLOBAL_POSITION_INT":
            local = self.newest("LOCAL_POSITION_NED", now_ns, 0.5)
            if local is not None and math.isfinite(local.z):
                self._ground_down = local.z + message.relative_alt / 1000.0

    def newest(self, kind: str, now_ns: int, max_age_s: float = math.inf) -> Message | None:
        """The newest message of this kind, if it is not older than this."""
        found = self._newest.get(kind)
        if found is None or now_ns - found[1] > nanoseconds(min(max_age_s, 1e9)):
            return None
        return found[0]

    def age_s(self, kind: str, now_ns: int) -> float | None:
        found = self._newest.get(kind)
        return None if found is None else seconds(now_ns - found[1])

    def ages(self, now_ns: int) -> dict[str, Value]:
        """Of every kind, for feedback's ``native``."""
        return {
            f"mavlink.age.{kind.lower()}": round(seconds(now_ns - at_ns), 3)
            for kind, (_, at_ns) in self._newest.items()
            if kind in _AGED
        }

    # What it means -----------------------------------------------------------------------------------------------

    def custom_mode(self) -> int | None:
        """Of whichever tells it newest."""
        heartbeat, current = self._newest.get("HEARTBEAT"), self._newest.get("CURRENT_MODE")
        if heartbeat is None:
            return None
        if current is not None and current[1] > heartbeat[1] and current[0].custom_mode:
            return int(current[0].custom_mode)
        return int(heartbeat[0].custom_mode)

    def armed(self) -> bool:
        heartbeat = self._newest.get("HEARTBEAT")
        return heartbeat is not None and bool(heartbeat[0].base_mode & ModeFlag.ARMED)

    def status(self) -> int:
        heartbeat = self._newest.get("HEARTBEAT")
        return 0 if heartbeat is None else int(heartbeat[0].system_status)

    def landed(self, now_ns: int) -> Landed:
        message = self.newest("EXTENDED_SYS_STATE", now_ns, LANDED_S)
        try:
            return Landed.UNKNOWN if message is None else Landed(message.landed_state)
        except ValueError:
            return Landed.UNKNOWN

    def prearm_good(self, now_ns: int) -> bool | None:
        """None while it is not told, as by a vehicle that has no such check."""
        status = self.newest("SYS_STATUS", now_ns, SLOW_S)
        if status is None:
            return None
        good = bool(status.onboard_control_sensors_health & PREARM)
        return good if good or status.onboard_control_sensors_present & PREARM else None

    def attitude(self, now_ns: int) -> Vector | None:
        """Roll right side down, pitch nose up, yaw clockwise from north [rad]."""
        message = self.newest("ATTITUDE", now_ns, FLOWING_S)
        return None if message is None else finite(message.roll, message.pitch, message.yaw)

    def place(self, now_ns: int) -> Vector | None:
        message = self.newest("LOCAL_POSITION_NED", now_ns, FLOWING_S)
        return None if message is None else finite(message.x, message.y, message.z)

    def velocity(self, now_ns: int) -> Vector | None:
        message = self.newest("LOCAL_POSITION_NED", now_ns, FLOWING_S)
        if message is not None:
            return finite(message.vx, message.vy, message.vz)
        message = self.newest("GLOBAL_POSITION_INT", now_ns, FLOWING_S)
        return None if message is None else (message.vx / 100.0, message.vy / 100.0, message.vz / 100.0)

    def altitude_m(self, now_ns: int) -> float | None:
        """Above the ground below by a sensor that looks down, above home, or above the origin: what there is."""
        sensor = self.newest("DISTANCE_SENSOR", now_ns, FLOWING_S)
        if sensor is not None and sensor.orientation == _DOWN and _in_range(sensor):
            return float(sensor.current_distance) / 100.0
        place = self.place(now_ns)
        if place is not None:
            return (self._ground_down or 0.0) - place[2]
        message = self.newest("GLOBAL_POSITION_INT", now_ns, FLOWING_S)
        return None if message is None else message.relative_alt / 1000.0

    def amsl_m(self, now_ns: int) -> float | None:
        message = self.newest("GLOBAL_POSITION_INT", now_ns, SLOW_S)
        return None if message is None else message.alt / 1000.0

    def view(self, mode: str, ready: bool | None, now_ns: int) -> View:
        attitude = self.attitude(now_ns)
        return View(
            mode=mode,
            armed=self.armed(),
            status=self.status(),
            landed=self.landed(now_ns),
            ready=ready,
            place=self.place(now_ns),
            velocity=self.velocity(now_ns),
            yaw=attitude[2] if attitude is not None else None,
            altitude_m=self.altitude_m(now_ns),
            amsl_m=self.amsl_m(now_ns),
        )


_DOWN: Final = 25  #: MAV_SENSOR_ROTATION_PITCH_270
_AGED: Final = frozenset(
    {
        "HEARTBEAT",
        "ATTITUDE",
        "LOCAL_POSITION_NED",
        "GLOBAL_POSITION_INT",
        "SYS_STATUS",
        "EXTENDED_SYS_STATE",
        "GPS_RAW_INT",
    }
)


def _in_range(sensor: Message) -> bool:
    return bool(sensor.min_distance <= sensor.current_distance <= sensor.max_distance)


def finite(x: float, y: float, z: float) -> Vector | None:
    """The three numbers, or None if one of them is none."""
    return (x, y, z) if math.isfinite(x) and math.isfinite(y) and math.isfinite(z) else None
