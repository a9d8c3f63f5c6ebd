"""The parameters of a simulated drone: its limits, its cameras, its battery, the wind and its radio link."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Final

from skyloop.errors import ParameterError, UnknownNameError
from skyloop.messages import Parameter, ParameterType, Refusal, Value
from skyloop.messages.parameter import WORLD, encode_world
from skyloop.sim.camera import CameraModel
from skyloop.sim.geometry import geometry_of
from skyloop.sim.parameters import LIMIT_RANGES, Limits
from skyloop.sim.world import Room, Wind, World
from skyloop.zones import ROOM, Box

#: Parameter, field of :class:`Limits`, unit, description.
_LIMITS: Final = (
    ("limits.tilt", "tilt_rad", "rad", "greatest roll and pitch"),
    ("limits.climb", "climb_m_s", "m/s", "greatest climb and descent"),
    ("limits.yaw_rate", "yaw_rate_rad_s", "rad/s", "greatest yaw rate"),
    ("limits.altitude", "altitude_m", "m", "ceiling above the floor"),
    ("limits.speed", "speed_m_s", "m/s", "greatest horizontal speed of a velocity set-point"),
    ("limits.takeoff_altitude", "takeoff_altitude_m", "m", "where a take-off ends"),
)
#: Last part of the name, field of :class:`CameraModel`, unit, range, description.
_CAMERA: Final = (
    ("fps", "fps", "1/s", (0.1, 240.0), "pictures a second of simulated time"),
    ("latency", "latency_s", "s", (0.0, 5.0), "from the exposure until the picture is handed out"),
    ("noise", "noise_sigma", "", (0.0, 100.0), "standard deviation of each pixel, in steps of 0 to 255"),
    ("gain", "exposure_gain", "", (0.05, 20.0), "brightness, relative to the scene's own"),
)


@dataclass(frozen=True, slots=True)
class ParameterValues:
    """The values of all parameters of one drone. Its limits are None where its firmware has limits of its own."""

    limits: Limits | None
    cameras: tuple[CameraModel, ...]
    wind: Wind
    battery: float
    link: bool = True


@dataclass(frozen=True, slots=True)
class _Settable:
    parameter: Parameter
    write: Callable[[ParameterValues, Value], ParameterValues]


def describe(state: ParameterValues, standard: ParameterValues) -> list[Parameter]:
    """Return all parameters with their present values; ``standard`` holds the defaults."""
    return [entry.parameter for entry in _table(state, standard).values()]


def names(state: ParameterValues) -> frozenset[str]:
    """Return the names of all parameters."""
    return frozenset(_table(state, state))


def room(room: Room) -> Parameter:
    """Return the parameter that names the room's walls, by which the proxy refuses places beyond them."""
    x, y, z = room.size_m
    walls = str(Box((-x / 2, -y / 2, 0.0), (x / 2, y / 2, z)))
    text = "walls of the simulated room, as a box"
    return Parameter(ROOM, ParameterType.TEXT, walls, "m", default=walls, read_only=True, description=text)


def geometry(world: World) -> Parameter:
    """Return the parameter that says what stands in the world, for maps."""
    text = encode_world(geometry_of(world))
    return Parameter(WORLD, ParameterType.TEXT, text, read_only=True, description="what stands in the world, as JSON")


def with_value(state: ParameterValues, standard: ParameterValues, name: str, value: Value) -> ParameterValues:
    """Return the values after writing one.

    Raises:
        UnknownNameError: There is no such parameter.
        ParameterError: It does not take this value.
    """
    table = _table(state, standard)
    if name not in table:
        raise UnknownNameError("parameter of the simulated drone", name, table)
    _check(table[name].parameter, value)
    return table[name].write(state, value)


def _table(state: ParameterValues, standard: ParameterValues) -> dict[str, _Settable]:
    entries = [*_limit_entries(state, standard), *_camera_entries(state, standard), *_world_entries(state, standard)]
    return {entry.parameter.name: entry for entry in entries}


def _limit_entries(state: ParameterValues, standard: ParameterValues) -> list[_Settable]:
    limits = state.limits
    if limits is None:
        return []

    def entry(name: str, field: str, unit: str, description: str) -> _Settable:
        now, usual = getattr(limits, field), getattr(standard.limits, field)

        def write(before: ParameterValues, value: Value) -> ParameterValues:
            return replace(before, limits=replace(limits, **{field: float(value)}))  # type: ignore[arg-type]

        return _Settable(_number(name, now, usual, unit, LIMIT_RANGES[field], description), write)

    return [entry(*row) for row in _LIMITS]


def _camera_entries(state: ParameterValues, standard: ParameterValues) -> list[_Settable]:
    def entry(at: int, last: str, field: str, unit: str, span: tuple[float, float], description: str) -> _Settable:
        model, usual = state.cameras[at], getattr(standard.cameras[at], field)

        def write(before: ParameterValues, value: Value) -> ParameterValues:
            change: dict[str, Any] = {field: _float(value)}
            changed = replace(before.cameras[at], **change)
            return replace(before, cameras=(*before.cameras[:at], changed, *before.cameras[at + 1 :]))

        name = f"camera.{model.name}.{last}"
        return _Settable(_number(name, getattr(model, field), usual, unit, span, description), write)

    return [entry(at, *row) for at in range(len(state.cameras)) for row in _CAMERA]


def _world_entries(state: ParameterValues, standard: ParameterValues) -> list[_Settable]:
    wind = Parameter(
        name="sim.wind",
        type=ParameterType.VECTOR,
        value=state.wind.mean_m_s,
        unit="m/s",
        minimum=-20.0,
        maximum=20.0,
        default=standard.wind.mean_m_s,
        description="mean wind: where it blows to, east, north and up",
    )
    usual = standard.wind.gust_m_s
    gust = _number("sim.gust", state.wind.gust_m_s, usual, "m/s", (0.0, 10.0), "standard deviation of gusts")
    battery = _number("sim.battery", state.battery, standard.battery, "", (0.0, 1.0), "charge left, 0 to 1")
    link = Parameter(
        name="sim.link",
        type=ParameterType.BOOL,
        value=state.link,
        default=True,
        description="whether the drone's radio works: without it nothing is received, and commands are lost",
    )
    return [
        _Settable(wind, lambda before, value: replace(before, wind=replace(before.wind, mean_m_s=_vector(value)))),
        _Settable(gust, lambda before, value: replace(before, wind=replace(before.wind, gust_m_s=_float(value)))),
        _Settable(battery, lambda before, value: replace(before, battery=_float(value))),
        _Settable(link, lambda before, value: replace(before, link=bool(value))),
    ]


def _float(value: Value) -> float:
    assert isinstance(value, (int, float))  # as checked before
    return float(value)


def _vector(value: Value) -> tuple[float, float, float]:
    assert isinstance(value, tuple)
    x, y, z = value
    return (float(x), float(y), float(z))


def _number(
    name: str, value: float, default: float, unit: str, span: tuple[float, float], description: str
) -> Parameter:
    return Parameter(name, ParameterType.FLOAT, value, unit, span[0], span[1], default, description=description)


def _check(parameter: Parameter, value: Value) -> None:
    kind, name = parameter.type, parameter.name
    if kind is ParameterType.BOOL:
        if not isinstance(value, bool):
            raise ParameterError(f"{name} is a bool, not {value!r}", code=Refusal.WRONG_TYPE)
        return
    numbers = value if isinstance(value, tuple) else (value,)
    count = len(value) if isinstance(value, tuple) else 0
    if count != (3 if kind is ParameterType.VECTOR else 0):
        wanted = "three numbers" if kind is ParameterType.VECTOR else "a number"
        raise ParameterError(f"{name} is {wanted}, not {value!r}", code=Refusal.WRONG_TYPE)
    for number in numbers:
        if isinstance(number, bool) or not isinstance(number, (int, float)):
            raise ParameterError(f"{name} is made of numbers, not {value!r}", code=Refusal.WRONG_TYPE)
        if not (parameter.minimum or 0.0) <= number <= (parameter.maximum or 0.0):
            raise ParameterError(
                f"{name} is from {parameter.minimum:g} to {parameter.maximum:g}, not {number!r}",
                code=Refusal.OUT_OF_RANGE,
            )
