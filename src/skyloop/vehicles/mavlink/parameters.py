"""Access to the autopilot's parameters over MAVLink, and their types and names under ``mavlink.``. Pure."""

from __future__ import annotations

import math
import re
import struct
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Final

from skyloop.clock import nanoseconds
from skyloop.drivers.base import checked_value
from skyloop.errors import DecodeError, ParameterError, UnknownNameError
from skyloop.messages import Parameter, ParameterType, Refusal, Value
from skyloop.vehicles.mavlink.options import OWN_LIMITS
from skyloop.vehicles.mavlink.wire.codec import Message, bounds, from_field, is_integer, to_field
from skyloop.vehicles.mavlink.wire.codec import dialect as m

QUIET_NS: Final = nanoseconds(0.7)  #: time without a new parameter after which the missing parameters are requested
AT_ONCE: Final = 20  #: number of missing parameters requested at once
LIST_NS: Final = nanoseconds(3.0)  #: time between requests for the list while nothing arrives
GIVE_UP_NS: Final = nanoseconds(20.0)  #: stop reading after this long without a new parameter
WRITE_NS: Final = nanoseconds(0.25)  #: time between repeats of an unconfirmed write
NO_INDEX: Final = 0xFFFF  #: index of a PARAM_VALUE that is not part of the list, such as a reply to a write
MOST: Final = 8192  #: longest plausible list; a greater count is ignored


@dataclass(frozen=True, slots=True)
class ReportedParameter:
    """A parameter as reported by the vehicle."""

    name: str
    value: float
    kind: int  #: MAV_PARAM_TYPE


@dataclass(slots=True)
class _PendingWrite:
    name: str
    value: float
    deadline_ns: int
    done: Callable[[str | None], None]
    sent_ns: int | None = None


class ParameterExchange:
    """Reads and writes one vehicle's parameters. ``bytewise``: whether integers are encoded bytewise."""

    def __init__(self) -> None:
        self.target = (1, 1)
        self.bytewise = False
        self.reported: dict[str, ReportedParameter] = {}
        self.count: int | None = None
        self.complete = False
        self.given_up = False
        self._wanted = False
        self._indices: set[int] = set()
        self._progress_ns = 0  # when the last new parameter arrived
        self._asked_ns: int | None = None
        self._writes: list[_PendingWrite] = []

    def request_all(self, now_ns: int) -> None:
        """Start reading all parameters from the beginning."""
        self._wanted, self.complete, self.given_up = True, False, False
        self._indices.clear()
        self.count, self._asked_ns, self._progress_ns = None, None, now_ns

    def fail_writes(self, reason: str) -> None:
        """Fail all pending writes because the link was lost."""
        writes, self._writes = self._writes, []
        for write in writes:
            write.done(reason)

    def write(self, name: str, value: float, deadline_ns: int, done: Callable[[str | None], None]) -> None:
        """Write a parameter in the autopilot's unit; call ``done`` by the deadline with the failure or None."""
        self._writes.append(_PendingWrite(name, value, deadline_ns, done))

    @property
    def values(self) -> dict[str, float]:
        return {name: held.value for name, held in self.reported.items()}

    @property
    def busy(self) -> bool:
        """Whether parameters are being read or written."""
        return bool(self._writes) or (self._wanted and not self.complete and not self.given_up)

    def on_value(self, message: Message, now_ns: int) -> None:
        name, kind = message.param_id, message.param_type
        try:
            value = from_field(message.param_value, kind, bytewise=self.bytewise)
        except DecodeError:
            value = math.nan
        index, count = message.param_index, message.param_count
        if index != NO_INDEX and 0 < count <= MOST and index < count:
            self.count = count
            if index not in self._indices:
                self._indices.add(index)
                self._progress_ns = now_ns
            self.complete = self._wanted and len(self._indices) >= count
        if name and not math.isnan(value):
            self.reported[name] = ReportedParameter(name, value, kind)
            self._end_writes(name, value)

    def poll(self, now_ns: int) -> list[Message]:
        """Return the messages to send now."""
        return self._pending_messages(now_ns) + self._ask(now_ns)

    def _ask(self, now_ns: int) -> list[Message]:
        if not self._wanted or self.complete or self.given_up:
            return []
        if self.count is None:
            if now_ns - self._progress_ns > GIVE_UP_NS:
                self.given_up = True
            elif self._asked_ns is None or now_ns - self._asked_ns > LIST_NS:
                self._asked_ns = now_ns
                return [m.MAVLink_param_request_list_message(*self.target)]
            return []
        if now_ns - self._progress_ns > GIVE_UP_NS:
            self.given_up = True
            return []
        if now_ns - max(self._progress_ns, self._asked_ns or 0) < QUIET_NS:
            return []
        self._asked_ns = now_ns
        missing = [index for index in range(self.count) if index not in self._indices][:AT_ONCE]
        return [m.MAVLink_param_request_read_message(*self.target, b"", index) for index in missing]

    def _pending_messages(self, now_ns: int) -> list[Message]:
        messages = []
        for write in list(self._writes):
            if now_ns >= write.deadline_ns:
                self._writes.remove(write)
                reported = self.reported[write.name].value
                write.done(f"the vehicle did not confirm it; it last reported {reported:g}")
            elif write.sent_ns is None or now_ns - write.sent_ns >= WRITE_NS:
                write.sent_ns = now_ns
                kind = self.reported[write.name].kind
                try:
                    field = to_field(write.value, kind, bytewise=self.bytewise)
                except struct.error as error:  # the parameter's type has changed since the request
                    self._writes.remove(write)
                    write.done(f"{write.value:g} does not fit: {error}")
                    continue
                messages.append(m.MAVLink_param_set_message(*self.target, write.name.encode(), field, kind))
        return messages

    def _end_writes(self, name: str, value: float) -> None:
        for write in list(self._writes):
            exact = self.bytewise and is_integer(self.reported[name].kind)
            if write.name == name and write.sent_ns is not None and is_confirmed(write.value, value, exact=exact):
                self._writes.remove(write)
                write.done(None)


def is_confirmed(wanted: float, reported: float, *, exact: bool) -> bool:
    """Return whether the vehicle reports the written value, comparing in single precision unless ``exact`` is True."""
    return wanted == reported if exact else math.isclose(wanted, reported, rel_tol=1e-6, abs_tol=1e-9)


@dataclass(frozen=True, slots=True)
class ParameterInfo:
    """A known parameter's unit, range and meaning, in the autopilot's own unit."""

    unit: str = ""
    low: float | None = None
    high: float | None = None
    text: str = ""


#: Units and ranges from the autopilots' parameter references (ardupilot.org and docs.px4.io).
PARAMETER_INFO: Final = {
    # ArduCopter
    "ANGLE_MAX": ParameterInfo("cdeg", 1000, 8000, "maximum lean angle"),
    "ATC_ANGLE_MAX": ParameterInfo("deg", 10, 80, "maximum lean angle"),
    "BATT_FS_LOW_ACT": ParameterInfo("", 0, 7, "low battery action: 0 nothing, 1 land, 2 return"),
    "BATT_FS_CRT_ACT": ParameterInfo("", 0, 7, "critical battery action: 0 nothing, 1 land, 2 return"),
    "BATT_LOW_VOLT": ParameterInfo("V", 0, None, "low battery voltage; 0: disabled"),
    "DISARM_DELAY": ParameterInfo("s", 0, 127, "time armed on the ground until it disarms"),
    "FENCE_ALT_MAX": ParameterInfo("m", 10, 1000, "ceiling of the fence"),
    "FENCE_ENABLE": ParameterInfo("", 0, 1, "whether the fence is enabled"),
    "FS_EKF_ACTION": ParameterInfo("", 0, 3, "action when the position estimate is lost"),
    "FS_GCS_ENABLE": ParameterInfo("", 0, 8, "on loss of a ground station's heartbeat: 0 nothing, 5 land, 7 brake"),
    "FS_GCS_TIMEOUT": ParameterInfo("s", 2, 120, "ground station silence that triggers the failsafe"),
    "FS_THR_ENABLE": ParameterInfo("", 0, 7, "action on loss of the remote control"),
    "GUID_OPTIONS": ParameterInfo("", 0, None, "bit 3: the thrust field is thrust, not climb rate"),
    "GUID_TIMEOUT": ParameterInfo("s", 0.1, 5, "silence after which a set-point is dropped"),
    "LAND_SPEED": ParameterInfo("cm/s", 30, 200, "final landing speed"),
    "MAV_GCS_SYSID": ParameterInfo("", 1, 255, "the ground station whose heartbeats count"),
    "RTL_ALT": ParameterInfo("cm", 30, 300_000, "return altitude"),
    "WPNAV_SPEED": ParameterInfo("cm/s", 10, 2000, "horizontal speed"),
    "WPNAV_SPEED_DN": ParameterInfo("cm/s", 10, 500, "descent speed"),
    "WPNAV_SPEED_UP": ParameterInfo("cm/s", 10, 1000, "climb speed, also scales the thrust field"),
    # PX4
    "COM_DISARM_LAND": ParameterInfo("s", None, 20, "time on the ground after a landing until it disarms"),
    "COM_DISARM_PRFLT": ParameterInfo("s", None, 60, "time armed on the ground until it disarms"),
    "COM_DL_LOSS_T": ParameterInfo("s", 5, 300, "ground station silence that triggers the failsafe"),
    "COM_LOW_BAT_ACT": ParameterInfo("", 0, 3, "low battery action: 0 warning, 2 land, 3 return"),
    "COM_OBL_RC_ACT": ParameterInfo("", 0, 7, "action on loss of set-points: 0 position mode, 5 hold"),
    "COM_OF_LOSS_T": ParameterInfo("s", 0, 60, "time without set-points until they count as lost"),
    "GF_ACTION": ParameterInfo("", 0, 5, "action at the fence"),
    "GF_MAX_VER_DIST": ParameterInfo("m", 0, 10_000, "height of the fence; 0: none"),
    "MIS_TAKEOFF_ALT": ParameterInfo("m", 0, None, "default take-off height"),
    "MPC_MAN_Y_MAX": ParameterInfo("deg/s", 0, 400, "maximum yaw rate"),
    "MPC_THR_HOVER": ParameterInfo("", 0.1, 0.8, "hover thrust"),
    "MPC_TILTMAX_AIR": ParameterInfo("deg", 20, 89, "maximum tilt"),
    "MPC_XY_VEL_MAX": ParameterInfo("m/s", 0, 20, "maximum horizontal speed"),
    "MPC_Z_VEL_MAX_DN": ParameterInfo("m/s", 0.5, 4, "maximum descent speed"),
    "MPC_Z_VEL_MAX_UP": ParameterInfo("m/s", 0.5, 8, "maximum climb speed"),
    "NAV_DLL_ACT": ParameterInfo("", 0, 6, "on loss of a ground station's heartbeat: 0 nothing, 1 hold, 3 land"),
    "NAV_RCL_ACT": ParameterInfo("", 1, 6, "action on loss of the remote control"),
}


PREFIX: Final = "mavlink."
EXACT: Final = 1 << 24  #: single precision represents every whole number up to this one exactly
_NAME: Final = re.compile(r"[A-Za-z0-9_]{1,16}\Z")


@dataclass(frozen=True, slots=True)
class VehicleParameter:
    """A parameter, with the autopilot's name for it."""

    parameter: Parameter
    native: str

    def to_native(self, value: Value) -> float:
        """Convert a value to the autopilot's representation; raise an error if the autopilot would not accept it."""
        value = checked_value(self.parameter, value)
        assert isinstance(value, int | float)
        return value

    def from_native(self, number: float) -> Value:
        """Convert a value reported by the autopilot."""
        return int(number) if self.parameter.type is ParameterType.INT else rounded(number)


def vehicle_parameters(held: Mapping[str, ReportedParameter]) -> dict[str, VehicleParameter]:
    """Return all parameters reported by the vehicle, with our own names as keys."""
    found: dict[str, VehicleParameter] = {}
    for name, each in held.items():
        entry = _own(each) if _NAME.match(name) else None
        if entry is not None:
            found[entry.parameter.name] = entry
    return found


def writable_parameter(entries: Mapping[str, VehicleParameter], name: str) -> VehicleParameter:
    """Return a parameter to be written; raise an error if the parameter is unknown or read-only."""
    entry = entries.get(name)
    if entry is None:
        raise UnknownNameError("parameter of the vehicle", name, entries)
    if entry.parameter.read_only:
        raise ParameterError(f"{name} is read-only", code=Refusal.READ_ONLY)
    return entry


def check_exact(name: str, number: int, *, bytewise: bool) -> int:
    """Return a whole number if the vehicle would receive it exactly; raise an error otherwise.

    ArduPilot encodes whole numbers as single-precision floats, which round some numbers of more than 24 bits.
    """
    if bytewise:
        return number
    received = struct.unpack("<f", struct.pack("<f", number))[0]
    if received != number:
        raise ParameterError(
            f"{name}: the vehicle takes whole numbers in single precision and would receive {received:.0f} "
            f"instead of {number}: beyond ±{EXACT} only some can be written; use a ground station",
            code=Refusal.OUT_OF_RANGE,
        )
    return number


def rounded(number: float) -> float:
    """Return a number rounded to 7 digits, as many as single precision holds."""
    return float(f"{number:.7g}")


def _own(held: ReportedParameter) -> VehicleParameter | None:
    meaning = PARAMETER_INFO.get(held.name, ParameterInfo())
    name = PREFIX + held.name.lower()
    if not math.isfinite(held.value):
        parameter = Parameter(name, ParameterType.TEXT, str(held.value), read_only=True, description="not a number")
        return VehicleParameter(parameter, held.name)
    if is_integer(held.kind):
        least, most = map(float, bounds(held.kind))
        value: float = int(held.value)
        kind = ParameterType.INT
    else:
        least, most = -math.inf, math.inf
        value, kind = rounded(held.value), ParameterType.FLOAT
    # A reported value outside this range means that the vehicle itself allows a wider range.
    low = _bound(min(meaning.low if meaning.low is not None else least, value))
    high = _bound(max(meaning.high if meaning.high is not None else most, value))
    text = meaning.text or f"the autopilot's {held.name}"
    return VehicleParameter(Parameter(name, kind, value, meaning.unit, low, high, description=text), held.name)


def _bound(value: float) -> float | None:
    return value if math.isfinite(value) else None


def limit_parameters(values: Mapping[str, float]) -> list[Parameter]:
    """Return the driver's own limits as parameters with their current values."""
    return [limit.parameter(values[limit.name]) for limit in OWN_LIMITS]


def with_limit(values: Mapping[str, float], name: str, value: Value) -> dict[str, float]:
    """Return the driver's limits with one changed; raise an error if the number is not finite or out of range."""
    parameter = next(each for each in limit_parameters(values) if each.name == name)
    value = checked_value(parameter, value)
    assert isinstance(value, float)
    return {**values, name: value}
