"""Manage the parameters of a proxy and its driver in one typed store, and answer requests about them.

Checking is a pure function (:func:`check`). If proxy and driver have a parameter with the same name, the driver's
is shown and written, and the proxy uses its value. An example is ``limits.tilt`` for a vehicle with its own limit.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import fields, replace
from typing import Any, Final

import msgspec

from skyloop.clock import NS_PER_S, Clock, nanoseconds, seconds
from skyloop.drivers.base import Driver
from skyloop.errors import DriverError, ParameterError, UnknownNameError
from skyloop.messages import (
    AnyReply,
    EventKind,
    GetParameter,
    ListParameters,
    Parameter,
    ParameterPage,
    ParameterType,
    ParameterValue,
    Refusal,
    Refused,
    Role,
    SetParameter,
    Severity,
    Value,
)
from skyloop.messages.codec import MAX_BODY
from skyloop.messages.parameter import CHECKUP, encode_checkup
from skyloop.proxy.core.airspace import AirspaceSettings, Limits
from skyloop.proxy.core.autopilot import AutopilotSettings, ReturnSettings
from skyloop.proxy.core.failsafe import FailsafeSettings
from skyloop.proxy.events import EventPublisher
from skyloop.proxy.handler import CommandHandler, FlightSettings
from skyloop.proxy.publisher import VehiclePublisher
from skyloop.proxy.requests import Session
from skyloop.zones import BOX, FAR_M, ROOM, ZONES, check_written, space_of

MAX_TEXT: Final = 1024  #: maximum number of characters in a text value
MAX_PARAMETER: Final = 8192  #: maximum number of bytes in an encoded parameter; larger driver parameters are left out
PAGE_BYTES: Final = MAX_BODY - 256  #: total bytes of encoded parameters in one reply
#: A momentary parameter, such as a flip, is written within this time or not at all, as its writer waits no longer.
MOMENT_NS: Final = 2 * NS_PER_S

_GIVEN_NAMES: Final = {bool: "a bool", int: "an int", float: "a float", str: "text", tuple: "a vector"}
_TYPE_NAMES: Final = {
    ParameterType.BOOL: "a bool",
    ParameterType.INT: "an int",
    ParameterType.FLOAT: "a float",
    ParameterType.TEXT: "text",
    ParameterType.VECTOR: "a vector",
}
_encoded = msgspec.msgpack.Encoder().encode


def described(driver: Driver) -> list[Parameter]:
    """Return a driver's parameters, plus one that contains the findings of its check. Raises the driver's errors."""
    parameters = list(driver.parameters())
    try:
        diagnostics = driver.checkup()
    except DriverError:
        return parameters  # not open
    if not diagnostics:
        return parameters
    text = "the driver's findings before a flight, as JSON; shown by skyloop preflight"
    value = encode_checkup(diagnostics)
    return [*parameters, Parameter(CHECKUP, ParameterType.TEXT, value, read_only=True, description=text)]


def _own(name: str, value: float, unit: str, minimum: float, maximum: float, description: str) -> Parameter:
    return Parameter(name, ParameterType.FLOAT, value, unit, minimum, maximum, value, description=description)


def _other(name: str, value: bool | str, description: str, *, read_only: bool = False) -> Parameter:
    kind = ParameterType.BOOL if isinstance(value, bool) else ParameterType.TEXT
    return Parameter(name, kind, value, default=value, read_only=read_only, description=description)


#: The proxy's own parameters. ``docs/proxy.md`` shows them as a table.
OWN: Final[tuple[Parameter, ...]] = (
    _own("alarms.battery_critical", 0.15, "", 0.0, 1.0, "Charge below which the cockpit's alarm is critical; 0: never"),
    _own("alarms.feedback_age_s", 1.0, "s", 0.0, 60.0, "Age of feedback that triggers an alarm; 0: never"),
    _own("alarms.link_degraded_s", 0.5, "s", 0.0, 60.0, "Time of a degraded link that triggers an alarm; 0: never"),
    _own("alarms.video_age_s", 1.0, "s", 0.0, 60.0, "Age of shown video that triggers an alarm; 0: never"),
    _own("authority.ask_s", 10.0, "s", 0.0, 600.0, "Time after which a request of higher priority wins"),
    _own(
        "authority.timeout_s", 2.0, "s", 0.1, 3600.0, "A holder without a valid command for this long loses the lease"
    ),
    _own("autopilot.climb", 0.5, "m/s", 0.1, 3.0, "Climb rate of a software take-off, and maximum in a software hover"),
    _own("autopilot.descent", 0.4, "m/s", 0.1, 2.0, "Rate of descent of a software landing"),
    _own("autopilot.takeoff_altitude", 1.0, "m", 0.3, 20.0, "Altitude of a software take-off, below limits.altitude"),
    _own("autopilot.velocity_i", 0.05, "rad/m", 0.0, 1.0, "Integral gain of the software velocity loop"),
    _own("autopilot.velocity_p", 0.15, "rad s/m", 0.0, 1.0, "Proportional gain of the software velocity loop"),
    _own("battery.flight_time", 600.0, "s", 10.0, 36000.0, "Flight time of a full battery, for the check of routes"),
    _own("battery.land", 0.1, "", 0.0, 1.0, "Charge below which the vehicle lands and accepts no set-points; 0: never"),
    _own(
        "battery.return", 0.0, "", 0.0, 1.0, "Charge below which the vehicle returns to its start and lands; 0: never"
    ),
    _own("battery.warn", 0.2, "", 0.0, 1.0, "Charge below which a low battery is reported; 0: never"),
    _own("command.max_age_s", 0.25, "s", 0.01, 10.0, "Older commands are refused as stale"),
    _own("failsafe.hover_after_s", 0.5, "s", 0.05, 3600.0, "A flying vehicle hovers after this time without a command"),
    _own("failsafe.land_after_s", 5.0, "s", 0.1, 3600.0, "A flying vehicle lands after this time without a command"),
    _own(
        "failsafe.retry_s",
        0.25,
        "s",
        0.02,
        10.0,
        "Interval at which a failsafe step is retried until the vehicle executes it",
    ),
    _other(
        "failsafe.return",
        False,
        "Whether a vehicle without a pilot returns to its start to land, rather than landing in place",
    ),
    _own("limits.altitude", 5.0, "m", 0.3, 500.0, "Maximum height above ground"),
    _own("limits.climb", 1.0, "m/s", 0.05, 10.0, "Maximum vertical speed"),
    _own("limits.speed", 2.0, "m/s", 0.05, 30.0, "Maximum horizontal speed of a velocity set-point"),
    _own("limits.tilt", 0.35, "rad", 0.02, 1.0, "Maximum tilt of an attitude set-point, roll and pitch together"),
    _own("limits.yaw_rate", 1.75, "rad/s", 0.05, 10.0, "Maximum yaw rate"),
    _own("return.height", 2.0, "m", 0.0, 500.0, "Minimum height above the start on the way back"),
    _other("return.land", True, "Land at the end of a return, or hover there"),
    _own("return.speed", 1.0, "m/s", 0.1, 30.0, "Maximum speed of a return, within the limits"),
    *(
        _own(f"{BOX}.{axis}_{end}", value, "m", -FAR_M, FAR_M, f"{side} wall of the safety box; {value:g}: none")
        for axis, sides in (("x", ("West", "East")), ("y", ("South", "North")), ("z", ("Lower", "Upper")))
        for end, value, side in zip(("high", "low"), (FAR_M, -FAR_M), reversed(sides), strict=True)
    ),
    _own("safety.deceleration", 1.0, "m/s²", 0.1, 10.0, "Deceleration that the vehicle reliably achieves"),
    _own("safety.reaction_s", 0.3, "s", 0.0, 3.0, "Delay before the vehicle starts to brake"),
    _other(ROOM, "", "Walls of the room as a box, if the vehicle knows them (simulated ones do)", read_only=True),
    _other(ZONES, "", "No-fly zones: boxes and cylinders"),
)


def check(parameter: Parameter, value: Value) -> Value:
    """Return the value to write, checked for type, finiteness, range and choices.

    An int counts as a float, but a bool does not count as a number. Raises :class:`ParameterError`, which names the
    allowed values and has the :class:`Refusal` as its code.
    """
    if parameter.read_only:
        raise ParameterError(f"{parameter.name} can only be read", code=Refusal.READ_ONLY)
    kind, is_bool = parameter.type, isinstance(value, bool)
    if not is_bool and (
        (kind is ParameterType.FLOAT and isinstance(value, int | float))
        or (kind is ParameterType.INT and isinstance(value, int))
    ):
        value = _number(parameter, value)
    elif kind is ParameterType.VECTOR and isinstance(value, tuple):
        length = len(parameter.value) if isinstance(parameter.value, tuple) else len(value)
        if len(value) != length:
            raise ParameterError(f"{parameter.name} takes {length} numbers, not {len(value)}", code=Refusal.WRONG_TYPE)
        value = tuple(_number(parameter, number) for number in value)
    elif not ((kind is ParameterType.BOOL and is_bool) or (kind is ParameterType.TEXT and isinstance(value, str))):
        given = _GIVEN_NAMES.get(type(value), type(value).__name__)
        unit = f" in {parameter.unit}" if parameter.unit else ""
        raise ParameterError(
            f"{parameter.name} takes {_TYPE_NAMES[kind]}{unit}, not {given} ({value!r:.60})", code=Refusal.WRONG_TYPE
        )
    if parameter.choices and value not in parameter.choices:
        choices = ", ".join(repr(choice) for choice in parameter.choices)
        raise ParameterError(f"{parameter.name} must be one of {choices}, not {value!r}", code=Refusal.OUT_OF_RANGE)
    if isinstance(value, str) and len(value) > MAX_TEXT:
        raise ParameterError(
            f"{parameter.name} takes at most {MAX_TEXT} characters, not {len(value)}", code=Refusal.OUT_OF_RANGE
        )
    return value


def _number(parameter: Parameter, number: float) -> float:
    """Return a number to write, alone or in a vector, after checking that it is finite and within the range."""
    if parameter.type is not ParameterType.INT:
        try:
            number = float(number)
        except OverflowError:
            raise ParameterError(f"{parameter.name} cannot be that large", code=Refusal.OUT_OF_RANGE) from None
        if not math.isfinite(number):
            raise ParameterError(f"{parameter.name} must be finite, not {number}", code=Refusal.NON_FINITE)
    low, high = parameter.minimum, parameter.maximum
    if (low is not None and number < low) or (high is not None and number > high):
        unit = f" {parameter.unit}" if parameter.unit else ""
        allowed = " and ".join(
            f"{word} {bound:g}{unit}" for word, bound in (("at least", low), ("at most", high)) if bound is not None
        )
        raise ParameterError(f"{parameter.name} must be {allowed}, not {number!r}", code=Refusal.OUT_OF_RANGE)
    return number


def check_presets(values: Mapping[str, Value]) -> dict[str, Value]:
    """Check values for the proxy's own parameters and return them. Raises :class:`UnknownNameError` for other names."""
    own = {parameter.name: parameter for parameter in OWN}
    checked: dict[str, Value] = {}

    def number(name: str) -> float:
        value = checked.get(name, own[name].value)
        return float(value) if isinstance(value, int | float) else math.nan

    for name, value in values.items():
        if name not in own:
            raise UnknownNameError("parameter of a proxy", name, own)
        checked[name] = check(own[name], value)
    for name, value in checked.items():
        check_written(name, value, number)
    return checked


def updated_settings(before: FlightSettings, value: Mapping[str, Any], changed: Collection[str]) -> FlightSettings:
    """Return the settings with new values. Parts whose parameters have not changed stay the same object.

    ``value``: the effective values by name; ``changed``: prefixes of the changed names, such as ``limits``. Raises
    :class:`ParameterError` if the no-fly zones can't be parsed.
    """
    new: dict[str, Any] = {}
    limits, space = before.airspace.limits, before.airspace.space
    if "limits" in changed:
        limits = Limits(**{each.name: value[f"limits.{each.name}"] for each in fields(Limits)})
    if "safety" in changed:
        space = space_of(value.__getitem__, value.__getitem__)
    if not {"limits", "safety"}.isdisjoint(changed):
        new["airspace"] = AirspaceSettings(limits, space, value["safety.deceleration"], value["safety.reaction_s"])
    if not {"limits", "autopilot"}.isdisjoint(changed):
        new["autopilot"] = AutopilotSettings(
            takeoff_altitude=min(value["autopilot.takeoff_altitude"], limits.altitude),
            climb=min(value["autopilot.climb"], limits.climb),
            descent=min(value["autopilot.descent"], limits.climb),
            velocity_p=value["autopilot.velocity_p"],
            velocity_i=value["autopilot.velocity_i"],
            tilt=limits.tilt,
        )
    if not {"failsafe", "battery"}.isdisjoint(changed):
        new["failsafe"] = FailsafeSettings(
            hover_after_s=value["failsafe.hover_after_s"],
            land_after_s=value["failsafe.land_after_s"],
            retry_s=value["failsafe.retry_s"],
            battery_warn=value["battery.warn"],
            battery_land=value["battery.land"],
            battery_return=value["battery.return"],
            returns=value["failsafe.return"],
        )
    if "return" in changed:
        new["returns"] = ReturnSettings(value["return.height"], value["return.speed"], value["return.land"])
    if "command" in changed:
        new["max_age_ns"] = nanoseconds(value["command.max_age_s"])
    if "authority" in changed:
        new["authority_timeout_ns"] = nanoseconds(value["authority.timeout_s"])
        new["authority_ask_ns"] = nanoseconds(value["authority.ask_s"])
    return replace(before, **new) if new else before


class Parameters:
    """The store. Thread-safe. The driver is called on the caller's thread, outside the lock of this object."""

    def __init__(
        self,
        read_driver: Callable[[], Iterable[Parameter]] = tuple,
        write_driver: Callable[[str, Value], Value] | None = None,
    ) -> None:
        self._read_driver = read_driver
        self._write_driver = write_driver
        self._lock = threading.Lock()
        self._own = {parameter.name: parameter for parameter in OWN}
        self._driver: dict[str, Parameter] = {}
        self._presets: dict[str, Value] = {}  # preset values that have not yet been written to the driver
        self.left_out: tuple[str, ...] = ()  #: names of the driver's parameters that are too large to send
        self._in_force: dict[str, Any] = {}  # values of the proxy's own parameters
        self._changed: set[str] = set()  # prefixes of parameter names whose changes are not in the settings yet
        self._settings = FlightSettings()
        self._apply(OWN)

    def preset(self, values: Mapping[str, Value]) -> None:
        """Set the proxy's own parameters before it starts; :meth:`write_presets` sets the vehicle's."""
        for name, value in check_presets(values).items():
            self._own[name] = msgspec.structs.replace(self._own[name], value=value)
            self._presets[name] = value
        with self._lock:
            self._apply(OWN)

    def write_presets(self) -> list[tuple[str, str]]:
        """Write presets to the vehicle's parameters. Return which presets failed, with the reasons."""
        problems = []
        for name in [name for name in self._presets if name in self._driver]:
            try:
                self.set(name, self._presets[name])
            except Exception as error:  # noqa: BLE001  a driver may raise anything; it is retried on the next occasion
                problems.append((name, str(error)))
            else:
                del self._presets[name]  # pilots may change it from now on
        return problems

    def refresh(self) -> None:
        """Read the driver's parameters again. Raises the driver's errors."""
        read = {parameter.name: parameter for parameter in self._read_driver()}
        large = tuple(name for name, parameter in read.items() if len(_encoded(parameter)) > MAX_PARAMETER)
        with self._lock:
            self._driver = {name: parameter for name, parameter in read.items() if name not in large}
            self.left_out = large
            self._apply(OWN)

    def get(self, name: str) -> Parameter:
        """Return the last known state of a parameter. Raises :class:`UnknownNameError`."""
        with self._lock:
            parameter = self._driver.get(name) or self._own.get(name)
            if parameter is None:
                raise UnknownNameError("parameter", name, {*self._own, *self._driver})
            return parameter

    def number(self, name: str) -> float:
        """Return the value in force for one of the proxy's own parameters (the driver's value if it has one)."""
        value: float = self._in_force[name]
        return value

    def _apply(self, parameters: Iterable[Parameter]) -> None:
        """Apply values of the proxy's own parameters, and record which have changed. The caller holds the lock."""
        for standard in parameters:
            name, kind = standard.name, standard.type
            own = self._own[name].value
            value = self._driver[name].value if name in self._driver else own
            if kind is ParameterType.TEXT:
                value = value if isinstance(value, str) else ""
            elif kind is ParameterType.BOOL:
                value = value if isinstance(value, bool) else own
            else:  # the driver uses the name for something else, so the proxy keeps its own value
                value = float(value) if isinstance(value, int | float) and math.isfinite(value) else own
            if self._in_force.get(name) != value:
                self._in_force[name] = value
                self._changed.add(name.partition(".")[0])

    def flight_settings(self) -> FlightSettings:
        """Return the flight settings that follow from the effective values; see :func:`updated_settings`."""
        with self._lock:
            self._settings = updated_settings(self._settings, self._in_force, self._changed)
            self._changed = set()
            return self._settings

    def set(self, name: str, value: Value, known: Parameter | None = None) -> Parameter:
        """Write one parameter and return its new state. ``known``: its state as just returned by :meth:`get`."""
        parameter = known or self.get(name)
        value = check(parameter, value)
        with self._lock:
            is_driver = name in self._driver
        if not is_driver:
            check_written(name, value, self.number)
        if is_driver and self._write_driver is not None:
            value = self._write_driver(name, value)
        written = msgspec.structs.replace(parameter, value=value)
        with self._lock:
            (self._driver if is_driver else self._own)[name] = written
            if name in self._own:
                self._apply((self._own[name],))
        return written

    def page(self, first: int) -> ParameterPage:
        """Return as many parameters as fit into one reply, sorted by name, from index ``first`` on."""
        with self._lock:
            everything = sorted({**self._own, **self._driver}.values(), key=lambda parameter: parameter.name)
        chosen: list[Parameter] = []
        size = 0
        for parameter in everything[first:]:
            size += len(_encoded(parameter))
            if size > PAGE_BYTES:
                break
            chosen.append(parameter)
        return ParameterPage(len(everything), first, tuple(chosen))


class ParameterRequests:
    """Answers applications' requests about parameters, and applies new values. May wait for the vehicle.

    ``free``: parameters that any pilot may write without the authority. They also change without being written, so they
    are read from the driver whenever they are requested, and writing them causes no event.
    """

    def __init__(
        self,
        parameters: Parameters,
        handler: CommandHandler,
        publisher: VehiclePublisher,
        events: EventPublisher,
        clock: Clock,
        free: frozenset[str] = frozenset(),
    ) -> None:
        self._free = free
        self._parameters = parameters
        self._handler = handler
        self._publisher = publisher
        self._events = events
        self._clock = clock

    def read_driver(self) -> None:
        """Read the driver's parameters, keeping the old ones if that fails, write waiting presets, and apply both."""
        try:
            self._parameters.refresh()
        except Exception as error:  # noqa: BLE001  it is reported, and the flight continues
            self._publisher.driver_failed("parameters", error)
        if self._parameters.left_out:
            names = ", ".join(self._parameters.left_out)[:200]
            text = f"parameters too large to send: {names}"
            self._publisher.event(EventKind.DRIVER_ERROR, text, Severity.WARNING)
        for name, why in self._parameters.write_presets():
            if self._publisher.link_up:  # without a link it can't write them, and will retry once the link is up
                text = f"{name} could not be preset: {why}"
                self._publisher.event(EventKind.DRIVER_ERROR, text, Severity.WARNING, where="preset")
        self._handler.configure(self._parameters.flight_settings())

    def get(self, _session: Session, request: GetParameter, _now_ns: int) -> AnyReply:
        """Answer with the last known state of one parameter. Raises :class:`UnknownNameError`."""
        if request.name in self._free:
            self.read_driver()
        return ParameterValue(self._parameters.get(request.name))

    def page(self, _session: Session, request: ListParameters, _now_ns: int) -> AnyReply:
        """Read the driver's parameters again, and answer with one page of all parameters."""
        self.read_driver()
        return self._parameters.page(request.first)

    def set(self, session: Session, request: SetParameter, now_ns: int) -> AnyReply:
        """Write a parameter on behalf of the holder of the authority. Raises the errors of :meth:`Parameters.set`."""
        name, value = request.name, request.value
        waited_ns, known = self._clock() - now_ns, self._parameters.get(name)
        if known.momentary and waited_ns > MOMENT_NS:
            why = f"{name} waited {seconds(waited_ns):.1f} s for the vehicle and was dropped as too late: try again"
            return Refused(Refusal.STALE, why)
        if name in self._free and session.role is Role.PILOT:
            return ParameterValue(self._parameters.set(name, value, known))
        if not self._handler.holds(session, request.lease):
            code = Refusal.FOREIGN_LEASE if request.lease else Refusal.NO_AUTHORITY
            return Refused(code, "writing a parameter needs the authority: request it, and name its lease")
        if known.momentary and (problem := self._handler.problem_with_moment()):
            return Refused(Refusal.WRONG_STATE, f"{name} is not possible now: {problem}")
        if name == "limits.altitude" and isinstance(value, int | float):
            problem = self._handler.problem_with_ceiling(float(value))
            if problem:
                return Refused(Refusal.OUT_OF_RANGE, f"{name} can't be {value:g} m now: {problem}")
        parameter = self._parameters.set(name, value, known)
        self._handler.configure(self._parameters.flight_settings())
        unit = f" {parameter.unit}" if parameter.unit else ""
        text = f"{session.name} set {parameter.name} to {parameter.value!r}{unit}"
        data: dict[str, Value] = {"name": parameter.name, "value": parameter.value, "app_id": session.app_id}
        self._events.publish(EventKind.PARAMETER_CHANGED, text, app=session.name, data=data)
        return ParameterValue(parameter)
