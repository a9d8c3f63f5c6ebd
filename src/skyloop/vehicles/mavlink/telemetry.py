"""Stores the vehicle's newest messages and converts them to feedback and health events. Pure."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Final

from skyloop.clock import NS_PER_S, nanoseconds, seconds
from skyloop.drivers.vehicle_session import VehicleEvent
from skyloop.messages import EventKind, Feedback, FlightState, Severity, Value
from skyloop.messages.feedback import EarthOrigin
from skyloop.messages.geometry import turned
from skyloop.vehicles.mavlink.wire.axes import Vector, flip, swap, yaw_between
from skyloop.vehicles.mavlink.wire.codec import Landed, Message, ModeFlag, SystemState, Texts

FLOWING_S: Final = 1.0  #: age above which attitude, position and velocity count as unknown
SLOW_S: Final = 6.0  #: corresponding limit for slow messages such as battery and GPS
LANDED_S: Final = 3.0  #: corresponding limit for the landed state
PREARM: Final = 0x10000000  #: MAV_SYS_STATUS_PREARM_CHECK
REMOTE: Final = 0x10000  #: MAV_SYS_STATUS_SENSOR_RC_RECEIVER
AIRBORNE_M: Final = 0.5  #: height above which a vehicle that does not report whether it is flying counts as flying


@dataclass(frozen=True, slots=True)
class VehicleState:
    """The vehicle's state. World axes are MAVLink's: north, east, down."""

    mode: str
    armed: bool
    status: int  #: MAV_STATE from the heartbeat
    landed: Landed
    ready: bool | None  #: whether the vehicle can be armed; None if unknown
    position: Vector | None  #: position relative to the vehicle's origin [m]
    velocity: Vector | None  #: [m/s]
    yaw: float | None  #: clockwise from north [rad]
    altitude_m: float | None  #: height above the vehicle's start, or the closest equivalent that it reports
    amsl_m: float | None  #: altitude above mean sea level
    remote: bool = False  #: whether the vehicle reports that it receives a remote control
    heartbeat_ns: int = 0  #: arrival time of the vehicle's newest heartbeat, which reports whether it is armed
    reports_landed: bool = False  #: whether the vehicle has ever reported being on the ground or in the air

    @property
    def airborne(self) -> bool | None:
        """Whether the vehicle is off the ground under its own power; None if unknown.

        An armed vehicle may be flying if it reports neither flight nor height, for example just after being found
        again, or if it is low and its own report is late.
        """
        if not self.armed or self.landed is Landed.ON_GROUND:
            return False
        if self.landed is Landed.UNKNOWN:
            high = None if self.altitude_m is None else self.altitude_m > AIRBORNE_M
            return None if self.reports_landed and not high else high
        return True

    @property
    def failsafe(self) -> bool:
        """Whether the autopilot itself reports a failure."""
        return self.status in (SystemState.CRITICAL, SystemState.EMERGENCY, SystemState.TERMINATION)


class MavlinkTelemetry:
    """Stores the newest message of each kind, with its age."""

    def __init__(self) -> None:
        self.counts: Counter[str] = Counter()
        self._newest: dict[str, tuple[Message, int]] = {}  # by kind, from the lowest-numbered current instance
        self._instances: dict[str, dict[int, tuple[Message, int]]] = {}  # by kind and number, where there are several
        self._ground_down: float | None = None  # how far the ground is below the origin [m]
        self._on_earth: tuple[Vector, Message] | None = None  # position east, north, up, and the same place on Earth

    def on_message(self, message: Message, now_ns: int) -> None:
        """Store a message from the selected vehicle."""
        kind = message.get_type()
        self.counts[kind] += 1
        self._newest[kind] = message, now_ns
        if message.instance_field is not None:
            self._instances.setdefault(kind, {})[getattr(message, message.instance_field)] = message, now_ns
            self._newest[kind] = next(self._by_number(kind, now_ns, FLOWING_S))
        if kind == "GLOBAL_POSITION_INT":
            local = self.newest("LOCAL_POSITION_NED", now_ns, 0.5)
            if local is not None and math.isfinite(local.z):
                self._ground_down = local.z + message.relative_alt / 1000.0
                self._on_earth = _at_the_same_time(local, message) or self._on_earth

    def newest(self, kind: str, now_ns: int, max_age_s: float = math.inf) -> Message | None:
        """Return the newest message of a kind; None if there is none or it is older than ``max_age_s``."""
        found = self._newest.get(kind)
        if found is None or now_ns - found[1] > max_age_s * NS_PER_S:
            return None
        return found[0]

    def instances(self, kind: str, now_ns: int, max_age_s: float = math.inf) -> Iterator[Message]:
        """Yield the newest message of each instance (each battery, for example), lowest number first."""
        return (message for message, _ in self._by_number(kind, now_ns, max_age_s))

    def _by_number(self, kind: str, now_ns: int, max_age_s: float) -> Iterator[tuple[Message, int]]:
        for _, found in sorted(self._instances.get(kind, {}).items()):
            if now_ns - found[1] <= max_age_s * NS_PER_S:
                yield found

    def age_s(self, kind: str, now_ns: int) -> float | None:
        """Return the age of the newest message of a kind [s]; None if there is none."""
        found = self._newest.get(kind)
        return None if found is None else seconds(now_ns - found[1])

    def ages(self, now_ns: int) -> dict[str, Value]:
        """Return the age of each kind of message [s] for the feedback's ``native``."""
        newest = self._newest
        return {name: round(seconds(now_ns - newest[kind][1]), 3) for kind, name in _AGED.items() if kind in newest}

    # Meaning -----------------------------------------------------------------------------------------------------

    def custom_mode(self) -> int | None:
        """Return the mode number from the newest message that contains a mode."""
        heartbeat, current = self._newest.get("HEARTBEAT"), self._newest.get("CURRENT_MODE")
        if heartbeat is None:
            return None
        if current is not None and current[1] > heartbeat[1] and current[0].custom_mode:
            return int(current[0].custom_mode)
        return int(heartbeat[0].custom_mode)

    def armed(self) -> bool:
        """Return whether the vehicle is armed according to the newest heartbeat."""
        heartbeat = self._newest.get("HEARTBEAT")
        return heartbeat is not None and bool(heartbeat[0].base_mode & _ARMED)

    def status(self) -> int:
        """Return the newest heartbeat's ``MAV_STATE``; 0 if there is none."""
        heartbeat = self._newest.get("HEARTBEAT")
        return 0 if heartbeat is None else int(heartbeat[0].system_status)

    def landed(self, now_ns: int, max_age_s: float = LANDED_S) -> Landed:
        """Return whether the vehicle reports that it is on the ground; unknown if the report is too old."""
        message = self.newest("EXTENDED_SYS_STATE", now_ns, max_age_s)
        return Landed.UNKNOWN if message is None else _LANDED.get(message.landed_state, Landed.UNKNOWN)

    def prearm_good(self, now_ns: int) -> bool | None:
        """Return whether the pre-arm checks pass; None if the vehicle does not report them."""
        status = self.newest("SYS_STATUS", now_ns, SLOW_S)
        if status is None:
            return None
        good = bool(status.onboard_control_sensors_health & PREARM)
        return good if good or status.onboard_control_sensors_present & PREARM else None

    def remote(self, now_ns: int) -> bool:
        """Return whether the vehicle receives a remote control."""
        status = self.newest("SYS_STATUS", now_ns, SLOW_S)
        return status is not None and bool(
            status.onboard_control_sensors_present & status.onboard_control_sensors_health & REMOTE
        )

    def attitude(self, now_ns: int) -> Vector | None:
        """Return roll (positive right side down), pitch (positive nose up) and yaw (clockwise from north) [rad]."""
        message = self.newest("ATTITUDE", now_ns, FLOWING_S)
        return None if message is None else finite(message.roll, message.pitch, message.yaw)

    def position(self, now_ns: int) -> Vector | None:
        """Return the position north, east, down from the origin [m]."""
        message = self.newest("LOCAL_POSITION_NED", now_ns, FLOWING_S)
        return None if message is None else finite(message.x, message.y, message.z)

    def origin(self, radius_m: float, now_ns: int) -> EarthOrigin | None:
        """Return the position on Earth of the axes' origin; None without a 3-D satellite fix and both positions.

        Without a fix, an autopilot's origin may be arbitrary, as with motion capture.
        """
        gps = self.newest("GPS_RAW_INT", now_ns, SLOW_S)
        if gps is None or gps.fix_type < GOOD_FIX or self._on_earth is None:
            return None
        (east, north, up), message = self._on_earth
        here = EarthOrigin(message.lat / 1e7, message.lon / 1e7, message.alt / 1000.0, radius_m)
        return EarthOrigin(*here.place_of((-east, -north, -up)), radius_m)

    def velocity(self, now_ns: int) -> Vector | None:
        """Return the velocity north, east, down [m/s]."""
        message = self.newest("LOCAL_POSITION_NED", now_ns, FLOWING_S)
        if message is not None:
            return finite(message.vx, message.vy, message.vz)
        message = self.newest("GLOBAL_POSITION_INT", now_ns, FLOWING_S)
        return None if message is None else (message.vx / 100.0, message.vy / 100.0, message.vz / 100.0)

    def altitude_m(self, position: Vector | None, now_ns: int) -> float | None:
        """Return the height above the ground from a downward sensor or, failing that, above home or the origin [m]."""
        for sensor in self.instances("DISTANCE_SENSOR", now_ns, FLOWING_S):
            if sensor.orientation == _DOWN and _in_range(sensor):
                return float(sensor.current_distance) / 100.0
        if position is not None:
            return (self._ground_down or 0.0) - position[2]
        message = self.newest("GLOBAL_POSITION_INT", now_ns, FLOWING_S)
        return None if message is None else message.relative_alt / 1000.0

    def amsl_m(self, now_ns: int) -> float | None:
        """Return the altitude above mean sea level [m]."""
        message = self.newest("GLOBAL_POSITION_INT", now_ns, SLOW_S)
        return None if message is None else message.alt / 1000.0

    def state(self, mode: str, ready: bool | None, now_ns: int) -> VehicleState:
        """Return the vehicle's state; ``ready`` is whether the vehicle can be armed, or None if that is unknown."""
        attitude, position = self.attitude(now_ns), self.position(now_ns)
        return VehicleState(
            mode=mode,
            armed=self.armed(),
            status=self.status(),
            landed=self.landed(now_ns),
            ready=ready,
            position=position,
            velocity=self.velocity(now_ns),
            yaw=attitude[2] if attitude is not None else None,
            altitude_m=self.altitude_m(position, now_ns),
            amsl_m=self.amsl_m(now_ns),
            remote=self.remote(now_ns),
            heartbeat_ns=self._newest["HEARTBEAT"][1] if "HEARTBEAT" in self._newest else 0,
            reports_landed=self.landed(now_ns, math.inf) is not Landed.UNKNOWN,
        )


_ARMED: Final = int(ModeFlag.ARMED)  # a plain int, because IntFlag operations are too expensive at this rate
_LANDED: Final = {int(each): each for each in Landed}
_DOWN: Final = 25  #: MAV_SENSOR_ROTATION_PITCH_270
_APART_S: Final = 0.5  #: positions further apart in time than this are not paired
_AGED: Final = {
    kind: f"mavlink.age.{kind.lower()}"
    for kind in (
        "HEARTBEAT",
        "ATTITUDE",
        "LOCAL_POSITION_NED",
        "GLOBAL_POSITION_INT",
        "SYS_STATUS",
        "EXTENDED_SYS_STATE",
        "GPS_RAW_INT",
    )
}


def _at_the_same_time(local: Message, world: Message) -> tuple[Vector, Message] | None:
    """Extrapolate a local position [m] to the time of a position on Earth; return both."""
    later_s = (world.time_boot_ms - local.time_boot_ms) / 1000.0
    if abs(later_s) > _APART_S:
        return None
    there = finite(local.x + local.vx * later_s, local.y + local.vy * later_s, local.z + local.vz * later_s)
    return None if there is None else (swap(*there), world)


def _in_range(sensor: Message) -> bool:
    return bool(sensor.min_distance <= sensor.current_distance <= sensor.max_distance)


def finite(x: float, y: float, z: float) -> Vector | None:
    """Return the three numbers, or None if any of them is not finite."""
    return (x, y, z) if math.isfinite(x) and math.isfinite(y) and math.isfinite(z) else None


STANDARD_GRAVITY: Final = 9.80665  #: m/s²
_UNKNOWN_16: Final = 0xFFFF  #: unknown value of an unsigned 16-bit field
_OTHERS: Final = (3, 4)  #: MAV_BATTERY_FUNCTION of avionics and payload batteries


def feedback_of(
    telemetry: MavlinkTelemetry, state: FlightState, captured_ns: int, now_ns: int, native: Mapping[str, Value]
) -> Feedback:
    """Return the vehicle's state in our units and axes. Values that are outdated or not finite are None."""
    attitude = telemetry.attitude(now_ns)
    position = telemetry.position(now_ns)
    roll, pitch, yaw = (None, None, None) if attitude is None else _to_our_axes(attitude)
    return Feedback(
        captured_ns=captured_ns,
        state=state,
        battery=_charge(telemetry, now_ns),
        battery_v=_volts(telemetry, now_ns),
        roll_rad=roll,
        pitch_rad=pitch,
        yaw_rad=yaw,
        altitude_m=telemetry.altitude_m(position, now_ns),
        velocity_m_s=_velocity(telemetry.velocity(now_ns), yaw),
        angular_velocity_rad_s=_rates(telemetry, now_ns),
        acceleration_m_s2=_force(telemetry, now_ns),
        position_m=None if position is None else swap(*position),
        native={**native, **_native(telemetry, now_ns)},
    )


def _to_our_axes(attitude: Vector) -> Vector:
    """Convert to roll (positive right side down), pitch (positive nose down) and yaw (counter-clockwise from east)."""
    roll, pitch, yaw = attitude
    return math.remainder(roll, math.tau), 0.0 - math.remainder(pitch, math.tau), yaw_between(yaw)


def _velocity(world: Vector | None, yaw: float | None) -> Vector | None:
    """Return the velocity forward, left, up [m/s]."""
    if world is None or yaw is None:
        return None
    east, north, up = swap(*world)
    return (*turned(east, north, -yaw), up)


def _rates(telemetry: MavlinkTelemetry, now_ns: int) -> Vector | None:
    message = telemetry.newest("ATTITUDE", now_ns, FLOWING_S)
    found = None if message is None else finite(message.rollspeed, message.pitchspeed, message.yawspeed)
    return None if found is None else flip(*found)


def _force(telemetry: MavlinkTelemetry, now_ns: int) -> Vector | None:
    """Return the specific force [m/s²]; PX4 reports m/s², ArduPilot thousandths of g."""
    message = telemetry.newest("HIGHRES_IMU", now_ns, FLOWING_S)
    if message is not None:
        found = finite(message.xacc, message.yacc, message.zacc)
        return None if found is None else flip(*found)
    message = telemetry.newest("RAW_IMU", now_ns, FLOWING_S)
    if message is None:
        return None
    unit = STANDARD_GRAVITY / 1000.0
    return flip(message.xacc * unit, message.yacc * unit, message.zacc * unit)


def _charge(telemetry: MavlinkTelemetry, now_ns: int) -> float | None:
    status = telemetry.newest("SYS_STATUS", now_ns, SLOW_S)
    # Always use the lowest-numbered battery, even if it stops reporting, because batteries differ in charge.
    batteries = telemetry.instances("BATTERY_STATUS", now_ns)
    first = next((each for each in batteries if each.battery_function not in _OTHERS), None)
    if first not in telemetry.instances("BATTERY_STATUS", now_ns, SLOW_S):
        first = None
    for message in (status, first):
        if message is not None and 0 <= message.battery_remaining <= 100:
            return float(message.battery_remaining) / 100.0
    return None


def _volts(telemetry: MavlinkTelemetry, now_ns: int) -> float | None:
    message = telemetry.newest("SYS_STATUS", now_ns, SLOW_S)
    if message is None or message.voltage_battery in (0, _UNKNOWN_16):
        return None
    return float(message.voltage_battery) / 1000.0


def _native(telemetry: MavlinkTelemetry, now_ns: int) -> dict[str, Value]:
    native: dict[str, Value] = telemetry.ages(now_ns)
    gps = telemetry.newest("GPS_RAW_INT", now_ns, SLOW_S)
    if gps is not None:
        native["gps.fix"] = int(gps.fix_type)
        if gps.satellites_visible != 0xFF:
            native["gps.satellites"] = int(gps.satellites_visible)
    position = telemetry.newest("GLOBAL_POSITION_INT", now_ns, SLOW_S)
    if position is not None:
        native.update(_geodetic(position))
    return native


def _geodetic(message: Message) -> dict[str, Value]:
    """Return latitude and longitude in degrees, and altitude above mean sea level in metres."""
    return {
        "gps.latitude_deg": message.lat / 1e7,
        "gps.longitude_deg": message.lon / 1e7,
        "gps.altitude_amsl_m": message.alt / 1000.0,
    }


DEBUG: Final = 7  #: MAV_SEVERITY
GOOD_FIX: Final = 3  #: fix type of a three-dimensional position
_PREARM_WORDS: Final = ("prearm:", "arm:", "arming denied", "preflight fail")
_EKF: Final = ("EKF_STATUS_REPORT", "ESTIMATOR_STATUS")
EKF_PLACE: Final = 0x10 | 0x08  #: flags of both: absolute horizontal position, and relative to the origin
EKF_CONSTANT: Final = 0x80  #: flag of both: the position is only assumed to be constant
_RISEN_NS: Final = nanoseconds(1.5)  #: time allowed from lift-off until the vehicle reports it (PX4: once per second)


class HealthMonitor:
    """Reports each change in the vehicle's health once, and passes on the vehicle's own texts."""

    def __init__(self) -> None:
        self._texts = Texts()
        self._reported: dict[str, bool] = {}
        self._reasons: set[str] = set()  # reasons for refusing to arm, already reported during this boot
        self._airborne_ns: int | None = None  # when the vehicle took off

    @property
    def was_ready(self) -> bool:
        """Whether the vehicle has ever been ready to arm."""
        return "was_ready" in self._reported

    def on_text(self, message: Message, *, quiet: bool = False) -> list[VehicleEvent]:
        """Handle a ``STATUSTEXT``; return complete texts, with reasons for refusing to arm marked as such.

        While the vehicle boots (``quiet``), it repeats these reasons, but each reason is reported only once.
        """
        events = []
        for severity, text in self._texts.on_message(message):
            if severity >= DEBUG:
                continue
            weight = Severity.ERROR if severity <= 3 else Severity.WARNING if severity == 4 else Severity.INFO
            reason = "prearm" if text.lower().startswith(_PREARM_WORDS) else "text"
            if quiet and reason == "prearm":
                if text in self._reasons:
                    continue
                self._reasons.add(text)
            data: dict[str, Value] = {"reason": reason, "mav_severity": severity}
            events.append(VehicleEvent(EventKind.VEHICLE_MESSAGE, text, weight, data))
        return events

    def update(self, telemetry: MavlinkTelemetry, vehicle: VehicleState | None, now_ns: int) -> list[VehicleEvent]:
        """Return the changes since the last call."""
        ready = None if vehicle is None else vehicle.ready
        if ready:
            self._reported["was_ready"] = True
        events = self._changed("ready", ready, "the vehicle is ready to arm", "the vehicle can't be armed now")
        gps = telemetry.newest("GPS_RAW_INT", now_ns, SLOW_S)
        if gps is not None:
            good = gps.fix_type >= GOOD_FIX
            events += self._changed("gps", good, "the vehicle's GPS has a fix", "the vehicle's GPS has no fix")
        if vehicle is None or not vehicle.airborne:
            self._airborne_ns = None
        elif self._airborne_ns is None:
            self._airborne_ns = now_ns
        risen = self._airborne_ns is not None and now_ns - self._airborne_ns >= _RISEN_NS
        for kind in _EKF:
            ekf = telemetry.newest(kind, now_ns, SLOW_S)
            if ekf is not None:
                # PX4 reports a constant position while on the ground; in the air that means that the position is lost.
                counts = kind != "ESTIMATOR_STATUS" or risen
                good = bool(ekf.flags & EKF_PLACE) and not (counts and ekf.flags & EKF_CONSTANT)
                events += self._changed(
                    "ekf", good, "the vehicle knows where it is", "the vehicle does not know where it is"
                )
        return events

    def _changed(self, name: str, good: bool | None, yes: str, no: str) -> list[VehicleEvent]:
        if good is None or self._reported.get(name) is good:
            return []
        self._reported[name] = good
        severity = Severity.INFO if good else Severity.WARNING
        return [VehicleEvent(EventKind.VEHICLE_MESSAGE, yes if good else no, severity, {"reason": name, "good": good})]
