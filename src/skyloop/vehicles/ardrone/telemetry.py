"""Convert navdata to feedback: order and time of datagrams, units, axes, signs and state bits. Pure.

The drone's body axes are x forward, y right, z down: positive ``theta`` is nose up, positive ``phi`` right side down,
positive ``psi`` clockwise seen from above, and ``vy`` points right. A datagram from a real, tilted AR.Drone 2 confirmed
the same axes for the accelerometers and gyros.
"""

from __future__ import annotations

import math
import re
from collections import Counter, deque
from collections.abc import Mapping
from typing import Any, Final

from skyloop.clock import LiveClock, nanoseconds, seconds
from skyloop.drivers.vehicle_session import PacketOrder, RestartWatch, VehicleEvent, message
from skyloop.errors import DecodeError
from skyloop.messages import EventKind, Feedback, FlightState, Severity, Value
from skyloop.messages.geometry import wrap_angle
from skyloop.messages.parameter import Diagnostic
from skyloop.vehicles.ardrone.wire.configuration import NO_CEILING_MM
from skyloop.vehicles.ardrone.wire.navdata import (
    LAYOUTS,
    ControlState,
    Demo,
    Navdata,
    PhysMeasures,
    RawMeasures,
    State,
    Time,
    VisionDetect,
    decode,
)

# Reception -----------------------------------------------------------------------------------------------------------

#: Period of the drone's datagrams: in demo mode, as before its set-up (True), and with all options (False).
PERIODS_NS: Final = {True: nanoseconds(1 / 15), False: nanoseconds(1 / 200)}
RESTART_SILENCE_NS: Final = nanoseconds(0.2)  #: gap after which a lower number means a restart, not a late datagram
_MICROSECOND_BITS: Final = 21  #: lower bits of the option ``time``; the others are seconds
_TIME_WRAP_S: Final = 1 << 11  #: the 11 bits of seconds wrap around at this value


class Reception:
    """Decodes navdata, accepting only datagrams that are complete and newer than the last.

    ``counts`` has ``received``, ``damaged`` (not navdata, or a wrong checksum), ``late`` (repeated or out of order),
    ``missed`` (gaps in the sequence), ``restarts`` of the sequence and ``unknown`` options.
    """

    def __init__(self) -> None:
        self.counts = Counter(dict.fromkeys(("received", "damaged", "late", "missed", "restarts", "unknown"), 0))
        self.passed_ns = 0  #: the drone's own time between the two newest accepted datagrams, from their numbers
        self._sequence = 0
        self._accepted_ns = 0
        self._watch = RestartWatch()

    def receive(self, datagram: bytes, now_ns: int) -> Navdata | None:
        """Return a datagram's content; None if the datagram is damaged or late. Never raises."""
        try:
            navdata = decode(datagram)
        except DecodeError:
            self.counts["damaged"] += 1
            return None
        before = self._sequence
        if not self._is_new(navdata.sequence, now_ns):
            self.counts["late"] += 1
            return None
        few = bool(navdata.state & (State.DEMO | State.BOOTSTRAP))
        self.passed_ns = max(0, navdata.sequence - before) * PERIODS_NS[few]
        self.counts["received"] += 1
        self.counts["unknown"] += len(navdata.unknown)
        return navdata

    def expect_restart(self) -> None:
        """Accept any sequence number next, because the drone was silent or lost contact with us."""
        self._accepted_ns = 0

    def telemetry(self) -> dict[str, Value]:
        """Return the counts under their names in ``Feedback.native``."""
        return {f"navdata.{name}": count for name, count in self.counts.items()}

    def _is_new(self, sequence: int, now_ns: int) -> bool:
        if sequence == self._sequence:
            return False
        if now_ns - self._accepted_ns >= RESTART_SILENCE_NS:
            self._watch.forget()
        if self._watch.update(sequence, now_ns) is PacketOrder.LATE:
            return False
        if sequence < self._sequence:
            self.counts["restarts"] += 1
        elif self._sequence:
            self.counts["missed"] += sequence - self._sequence - 1
        self._sequence, self._accepted_ns = sequence, now_ns
        return True


class NavdataClock:
    """Determines the capture time of a datagram's state on this host's clock.

    This is the stamp in the option ``time``, taking the smallest recent delay as zero, or without that option the
    datagram's arrival time. Times never go backwards.
    """

    def __init__(self) -> None:
        self._live = LiveClock()
        self._stamp_s: float | None = None
        self._turns = 0
        self._captured_ns = 0

    def captured_ns(self, navdata: Navdata, arrived_ns: int) -> int:
        """Return the capture time of the state in a datagram that arrived at ``arrived_ns``."""
        time = navdata.get(Time)
        captured_ns = arrived_ns if time is None else self._live.captured_ns(self._unwrapped(time.time), arrived_ns)
        self._captured_ns = max(self._captured_ns, captured_ns)
        return self._captured_ns

    def _unwrapped(self, time: int) -> float:
        stamp_s = (time >> _MICROSECOND_BITS) + (time & ((1 << _MICROSECOND_BITS) - 1)) / 1e6
        before_s = self._stamp_s
        self._stamp_s = stamp_s
        if before_s is not None and stamp_s < before_s - _TIME_WRAP_S / 2:
            self._turns += 1
        return self._turns * _TIME_WRAP_S + stamp_s


# Feedback in SI ------------------------------------------------------------------------------------------------------

STANDARD_GRAVITY: Final = 9.80665  #: m/s²
CLIMB_WINDOW_NS: Final = nanoseconds(0.3)  #: time over which the slope of the altitude is measured
Vector = tuple[float, float, float]

_FLIGHT_STATES: Final = {
    ControlState.FLYING: FlightState.FLYING,
    ControlState.HOVERING: FlightState.HOVERING,
    ControlState.TAKING_OFF: FlightState.TAKING_OFF,
    ControlState.GOING_TO_FIX: FlightState.FLYING,
    ControlState.LANDING: FlightState.LANDING,
    ControlState.LOOPING: FlightState.FLYING,
}


def control_state(demo: Demo) -> ControlState | None:
    """Return the drone's control state; None for a number that no known firmware sends."""
    try:
        return ControlState(demo.ctrl_state >> 16)
    except ValueError:
        return None


def flight_state(state: State, control: ControlState | None) -> FlightState:
    """Return the flight state that follows from the state bits and the control state."""
    if state & State.EMERGENCY:
        return FlightState.EMERGENCY
    resting = FlightState.FLYING if state & State.FLYING else FlightState.LANDED
    return resting if control is None else _FLIGHT_STATES.get(control, resting)


class ClimbMeter:
    """Measures climb as the slope of the altitude over the last 0.3 s, because the firmware leaves ``demo.vz`` at 0."""

    def __init__(self) -> None:
        self._samples: deque[tuple[int, float]] = deque()

    def climb(self, altitude_m: float, at_ns: int) -> float | None:
        """Add a sample and return the climb [m/s], positive up; None for the first sample and after a gap."""
        samples = self._samples
        samples.append((at_ns, altitude_m))
        while len(samples) > 2 and at_ns - samples[1][0] >= CLIMB_WINDOW_NS:
            samples.popleft()
        begun_ns, begun_m = samples[0]
        if at_ns - begun_ns > 4 * CLIMB_WINDOW_NS:  # a slope across a gap is out of date
            samples.popleft()
            return None
        return (altitude_m - begun_m) / seconds(at_ns - begun_ns) if at_ns > begun_ns else None


def feedback_of(
    navdata: Navdata, demo: Demo, captured_ns: int, climb_m_s: float | None, native: dict[str, Value]
) -> Feedback:
    """Return the drone's state in SI units and our axes.

    Values that are missing or impossible are None, and so is the velocity if the climb is unknown.
    """
    measured, raw = navdata.get(PhysMeasures), navdata.get(RawMeasures)
    yaw = _angle(demo.psi)
    pitch = _angle(demo.theta)
    return Feedback(
        captured_ns=captured_ns,
        state=flight_state(navdata.state, control_state(demo)),
        battery=demo.battery / 100 if demo.battery <= 100 else None,
        battery_v=raw.vbat / 1000 if raw is not None and raw.vbat else None,
        roll_rad=_angle(demo.phi),
        pitch_rad=-pitch if pitch is not None else None,
        yaw_rad=wrap_angle(-yaw) if yaw is not None else None,
        altitude_m=demo.altitude / 1000,
        velocity_m_s=_vector(demo.vx / 1000, -demo.vy / 1000, climb_m_s),
        angular_velocity_rad_s=_flipped(measured.gyros, math.radians(1.0)) if measured is not None else None,
        acceleration_m_s2=_flipped(measured.accs, STANDARD_GRAVITY / 1000) if measured is not None else None,
        native=native,
    )


def _angle(millidegrees: float) -> float | None:
    return math.radians(millidegrees / 1000) if abs(millidegrees) <= 180_000 else None


def _flipped(forward_right_down: tuple[float, ...], factor: float) -> Vector | None:
    """Convert a vector from forward, right, down axes to forward, left, up axes."""
    x, y, z = forward_right_down
    return _vector(x * factor, -y * factor, -z * factor)


def _vector(x: float, y: float, z: float | None) -> Vector | None:
    if z is None or not (math.isfinite(x) and math.isfinite(y) and math.isfinite(z)):
        return None
    return x, y, z


# Native telemetry ----------------------------------------------------------------------------------------------------


def _name(kind: type[Any]) -> str:
    return re.sub(r"(?<!^)(?=[A-Z])", "_", kind.__name__).lower()


#: Names of each option's fields.
_FIELDS: Final = {kind: tuple(f"{_name(kind)}.{field}" for field in kind._fields) for kind in LAYOUTS}
#: Tags by option name, as in an address's ``navdata_options``.
OPTION_TAGS: Final = {_name(kind): layout.tag for kind, layout in LAYOUTS.items()}
#: Number of useful fields in the demo option: its matrices are deprecated, and most tag fields are empty.
_DEMO_FIELDS: Final = len(Demo._fields) - 6


def native_of(navdata: Navdata, *, everything: bool) -> dict[str, Value]:
    """Return all options in a datagram as telemetry, except for numbers that are not finite.

    Unless ``everything`` is True, omit the demo option's deprecated matrices and an empty list of tags.
    """
    native: dict[str, Value] = {"state": int(navdata.state), "sequence": navdata.sequence}
    for kind, option in navdata.options.items():
        names: tuple[str, ...] = _FIELDS[kind]
        fields: tuple[Value, ...] = option
        if not everything and kind is Demo:
            names = names[:_DEMO_FIELDS]
        elif not everything and isinstance(option, VisionDetect) and not option.detected:
            names = names[:1]
        for name, value in zip(names, fields, strict=False):
            if type(value) is int or _finite(value):
                native[name] = value
    return native


def _finite(value: Any) -> bool:
    return all(map(math.isfinite, value)) if type(value) is tuple else math.isfinite(value)


# Health --------------------------------------------------------------------------------------------------------------

#: Bits, each with its name in the events' data and its meaning while set.
_CONDITIONS: Final = (
    (State.COMMUNICATION_LOST, "communication_lost", "the drone reports that it lost its link to us", Severity.WARNING),
    (State.BATTERY_LOW, "battery_low", "the drone's battery is low", Severity.WARNING),
    (State.ULTRASOUND_DEAF, "ultrasound", "the drone's ultrasound receives no echo", Severity.WARNING),
    (State.MOTORS_PROBLEM, "motors", "the drone has a problem with its motors", Severity.ERROR),
    (State.SOFTWARE_FAULT, "software", "the drone detected a software fault", Severity.ERROR),
    (State.ANGLES_OUT_OF_RANGE, "angles", "the drone tilted too far", Severity.WARNING),
    (State.CUTOUT, "cutout", "a motor of the drone was blocked", Severity.WARNING),
    (State.WIND, "wind", "the wind is too strong for the drone", Severity.WARNING),
    (State.MAGNETOMETER_UNCALIBRATED, "magnetometer", "the drone's magnetometer needs calibration", Severity.INFO),
    (State.TIMER_ELAPSED, "timer", "the drone's timer elapsed", Severity.WARNING),
)
#: State bits that say why the motors were cut.
_REASONS: Final = (
    (State.USER_EMERGENCY, "user"),
    (State.ANGLES_OUT_OF_RANGE, "angles"),
    (State.CUTOUT, "cutout"),
    (State.MOTORS_PROBLEM, "motors"),
    (State.ULTRASOUND_DEAF, "ultrasound"),
    (State.BATTERY_LOW, "battery"),
    (State.SOFTWARE_FAULT, "software"),
    (State.COMMUNICATION_LOST, "communication_lost"),
)


def emergency_reason(state: State) -> str:
    """Return the reasons why the motors are cut, separated by commas, or ``unknown``."""
    return ",".join(name for bit, name in _REASONS if state & bit) or "unknown"


class ArdroneHealth:
    """Reports each change in the drone's health bits once."""

    def __init__(self) -> None:
        self._reported = State(0)

    def changes(self, state: State) -> list[VehicleEvent]:
        """Return events for the changes since the last call."""
        before, self._reported = self._reported, state
        changed = before ^ state
        found = []
        if changed & State.EMERGENCY:
            found.append(_emergency(state))
        for bit, name, text, severity in _CONDITIONS:
            if not changed & bit:
                continue
            if state & bit:
                found.append(message(text, name, severity, active=True))
            else:
                found.append(message(f"no longer: {text}", name, active=False))
        return found


def _emergency(state: State) -> VehicleEvent:
    if not state & State.EMERGENCY:
        return message("the drone left the emergency", "reset")
    reason = emergency_reason(state)
    text = f"the drone cut its motors ({reason}); reset the emergency once it is lying safely on the ground"
    return VehicleEvent(EventKind.EMERGENCY, text, Severity.ERROR, {"reason": reason})


#: Preflight findings, each with its bit, topic, meaning, remedy, and whether it prevents a take-off.
_BITS: Final = (
    (State.MOTORS_PROBLEM, "motors", "a motor does not answer: it won't take off", "turn each rotor by hand", True),
    (State.SOFTWARE_FAULT, "firmware", "the drone reports a fault: it may not fly", "switch it off and on", True),
    (State.ANGLES_OUT_OF_RANGE, "angles", "it is tilted too far: it won't take off", "put it level", True),
    (State.ULTRASOUND_DEAF, "height", "its ultrasound is deaf: its height is unknown", "clean the sensor", True),
    (
        State.MAGNETOMETER_UNCALIBRATED,
        "compass",
        "its compass is not calibrated: absolute headings are wrong",
        "in flight, write true to ardrone.calibrate_magnetometer",
        False,
    ),
    (State.WIND, "wind", "too much wind: it may not hold its place", "fly indoors, or later", False),
)


def diagnose(state: State | None, values: Mapping[str, str]) -> list[Diagnostic]:
    """Return findings based on the newest bits and the configuration, which is empty until it has been read."""
    found = [
        Diagnostic(what, False, detail, advice, severe)
        for bit, what, detail, advice, severe in _BITS
        if state is not None and state & bit
    ]
    if not values:
        return [*found, Diagnostic("configuration", False, "not read yet: its limits are unknown", "wait")]
    ceiling_mm = _number(values.get("control:altitude_max"))
    if ceiling_mm is not None:
        high = ceiling_mm >= NO_CEILING_MM
        detail = "none: it can climb out of reach" if high else f"{ceiling_mm / 1000:g} m"
        found.append(Diagnostic("ceiling", not high, detail, "write limits.altitude, in metres" if high else ""))
    outdoor, bare = (values.get(f"control:{key}") == "TRUE" for key in ("outdoor", "flight_without_shell"))
    if outdoor or bare:
        detail = f"outdoor limits {'on' if outdoor else 'off'}, outdoor hull {'on' if bare else 'off'}: " + (
            "it flies faster than indoors" if outdoor else "its rotors are not guarded"
        )
        found.append(Diagnostic("indoors", False, detail, "for a flight indoors write false to both, and use the hull"))
    return found


def _number(text: str | None) -> float | None:
    try:
        return None if text is None else float(text)
    except ValueError:
        return None
