"""A simulated drone's parameters: limits, cameras, battery, wind and radio link."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Final, NamedTuple

from skyloop.errors import ParameterError, UnknownNameError
from skyloop.messages import Parameter, ParameterType, Refusal, Value
from skyloop.messages.parameter import WORLD, encode_world
from skyloop.sim.camera import CameraModel
from skyloop.sim.parameters import LIMIT_RANGES, Limits
from skyloop.sim.world import Room, Wind, World, geometry_of
from skyloop.zones import ROOM, Box

#: Each limit's parameter, field in :class:`Limits`, unit and description.
_LIMITS: Final = (
    ("limits.tilt", "tilt_rad", "rad", "greatest roll and pitch"),
    ("limits.climb", "climb_m_s", "m/s", "greatest climb and descent"),
    ("limits.yaw_rate", "yaw_rate_rad_s", "rad/s", "greatest yaw rate"),
    ("limits.altitude", "altitude_m", "m", "maximum height above the floor"),
    ("limits.speed", "speed_m_s", "m/s", "greatest horizontal speed of a velocity set-point"),
    ("limits.takeoff_altitude", "takeoff_altitude_m", "m", "height at which a take-off ends"),
)
#: For each camera parameter: last part of the name, field in :class:`CameraModel`, unit, range and description.
_CAMERA: Final = (
    ("fps", "fps", "1/s", (0.1, 240.0), "frames per second of simulated time"),
    ("latency", "latency_s", "s", (0.0, 5.0), "time from exposure to delivery"),
    ("noise", "noise_sigma", "", (0.0, 100.0), "standard deviation of each pixel, in steps of 0 to 255"),
    ("gain", "exposure_gain", "", (0.05, 20.0), "brightness, relative to the scene's own"),
)


@dataclass(frozen=True, slots=True)
class ParameterValues:
    """The values of one drone's parameters. Limits are None if the firmware has its own limits."""

    limits: Limits | None
    cameras: tuple[CameraModel, ...]
    wind: Wind
    battery: float
    link: bool = True


class _Settable(NamedTuple):
    parameter: Parameter
    write: Callable[[ParameterValues, Any], ParameterValues]  #: called with a value from :func:`_checked`


def describe(state: ParameterValues, standard: ParameterValues) -> list[Parameter]:
    """Return all parameters with their present values; ``standard`` provides the defaults."""
    return [entry.parameter for entries in _GROUPS.values() for entry in entries(state, standard)]


def names(state: ParameterValues) -> frozenset[str]:
    """Return the names of all parameters."""
    return frozenset(parameter.name for parameter in describe(state, state))


def room(room: Room) -> Parameter:
    """Return the parameter that describes the room's walls, beyond which the proxy refuses positions."""
    x, y, z = room.size_m
    walls = str(Box((-x / 2, -y / 2, 0.0), (x / 2, y / 2, z)))
    text = "walls of the simulated room, as a box"
    return Parameter(ROOM, ParameterType.TEXT, walls, "m", default=walls, read_only=True, description=text)


def geometry(world: World) -> Parameter:
    """Return the parameter that describes the objects in the world, for maps."""
    text = encode_world(geometry_of(world))
    return Parameter(WORLD, ParameterType.TEXT, text, read_only=True, description="objects in the world, as JSON")


def with_value(state: ParameterValues, name: str, value: Value) -> tuple[ParameterValues, Value]:
    """Return the values after writing one of them, and the written value; raise if the name or value is invalid."""
    group = _GROUPS.get(name.partition(".")[0])
    for entry in group(state, state) if group is not None else ():
        if entry.parameter.name == name:
            written = _checked(entry.parameter, value)
            return entry.write(state, written), written
    raise UnknownNameError("parameter of the simulated drone", name, names(state))


def _limit_entries(state: ParameterValues, standard: ParameterValues) -> list[_Settable]:
    limits, usual = state.limits, standard.limits
    if limits is None:
        return []
    return [
        _Settable(
            Parameter(
                name,
                ParameterType.FLOAT,
                getattr(limits, field),
                unit,
                *LIMIT_RANGES[field],
                default=getattr(usual, field),
                description=description,
            ),
            partial(_with_limit, field),
        )
        for name, field, unit, description in _LIMITS
    ]


def _with_limit(field: str, before: ParameterValues, value: Any) -> ParameterValues:
    assert before.limits is not None
    return replace(before, limits=replace(before.limits, **{field: value}))


def _camera_entries(state: ParameterValues, standard: ParameterValues) -> list[_Settable]:
    return [
        _Settable(
            Parameter(
                f"camera.{model.name}.{last}",
                ParameterType.FLOAT,
                getattr(model, field),
                unit,
                *span,
                default=getattr(standard.cameras[at], field),
                description=description,
            ),
            partial(_with_camera, at, field),
        )
        for at, model in enumerate(state.cameras)
        for last, field, unit, span, description in _CAMERA
    ]


def _with_camera(at: int, field: str, before: ParameterValues, value: Any) -> ParameterValues:
    changed = replace(before.cameras[at], **{field: value})
    return replace(before, cameras=(*before.cameras[:at], changed, *before.cameras[at + 1 :]))


def _world_entries(state: ParameterValues, standard: ParameterValues) -> list[_Settable]:
    now, usual = state.wind, standard.wind
    text = "mean wind, as the direction it blows to: east, north and up"
    wind = Parameter(
        "sim.wind", ParameterType.VECTOR, now.mean_m_s, "m/s", -20.0, 20.0, usual.mean_m_s, description=text
    )
    text = "standard deviation of gusts"
    gust = Parameter("sim.gust", ParameterType.FLOAT, now.gust_m_s, "m/s", 0.0, 10.0, usual.gust_m_s, description=text)
    text = "remaining charge, 0 to 1"
    battery = Parameter(
        "sim.battery", ParameterType.FLOAT, state.battery, "", 0.0, 1.0, standard.battery, description=text
    )
    text = "whether the drone's radio works; without it no data arrives and commands are lost"
    link = Parameter("sim.link", ParameterType.BOOL, state.link, default=True, description=text)
    return [
        _Settable(wind, lambda before, value: replace(before, wind=replace(before.wind, mean_m_s=value))),
        _Settable(gust, lambda before, value: replace(before, wind=replace(before.wind, gust_m_s=value))),
        _Settable(battery, lambda before, value: replace(before, battery=value)),
        _Settable(link, lambda before, value: replace(before, link=value)),
    ]


#: Functions that list the parameters of a group, keyed by the first part of their names.
_GROUPS: Final = {"limits": _limit_entries, "camera": _camera_entries, "sim": _world_entries}


def _checked(parameter: Parameter, value: Value) -> Value:
    """Return a value as it is written: a bool, a float, or a tuple of three."""
    kind, name = parameter.type, parameter.name
    if kind is ParameterType.BOOL:
        if not isinstance(value, bool):
            raise ParameterError(f"{name} is a bool, not {value!r}", code=Refusal.WRONG_TYPE)
        return value
    numbers = value if isinstance(value, tuple) else (value,)
    count = len(value) if isinstance(value, tuple) else 0
    if count != (3 if kind is ParameterType.VECTOR else 0):
        wanted = "three numbers" if kind is ParameterType.VECTOR else "a number"
        raise ParameterError(f"{name} is {wanted}, not {value!r}", code=Refusal.WRONG_TYPE)
    written: list[float] = []
    for number in numbers:
        if isinstance(number, bool) or not isinstance(number, (int, float)):
            raise ParameterError(f"{name} must consist of numbers, not {value!r}", code=Refusal.WRONG_TYPE)
        if not (parameter.minimum or 0.0) <= number <= (parameter.maximum or 0.0):
            raise ParameterError(
                f"{name} must be from {parameter.minimum:g} to {parameter.maximum:g}, not {number!r}",
                code=Refusal.OUT_OF_RANGE,
            )
        written.append(float(number))
    return tuple(written) if isinstance(value, tuple) else written[0]
