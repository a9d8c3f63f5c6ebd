"""Define parameters. Two of them are read-only and contain structured text: a vehicle's checkup and its world.

A parameter has a type, a unit, a range and a default, which lets both people and web pages edit it.
"""

from __future__ import annotations

from enum import StrEnum
from typing import Annotated, Final

import msgspec

from skyloop.messages.fields import Finite, Value

_encode_json = msgspec.json.Encoder().encode

ParameterName = Annotated[str, msgspec.Meta(min_length=1, max_length=128)]


class ParameterType(StrEnum):
    """The type of a parameter's value."""

    BOOL = "bool"
    INT = "int"
    FLOAT = "float"
    TEXT = "text"
    VECTOR = "vector"  #: a fixed number of floats


class Parameter(msgspec.Struct, frozen=True, array_like=True):
    """One parameter: its current value, and the rules for a new value."""

    name: ParameterName
    type: ParameterType
    value: Value
    unit: str = ""  #: SI symbol of the unit, e.g. ``rad``; empty if there is none
    minimum: float | None = None
    maximum: float | None = None
    default: Value | None = None
    choices: tuple[Value, ...] = ()  #: the only allowed values; empty: any value of the type and range
    read_only: bool = False
    description: str = ""
    momentary: bool = False  #: whether writing it triggers an action, such as a flip; it has no lasting value


# What a driver learns about its vehicle before a flight.

CHECKUP: Final = "vehicle.checkup"  #: name of the parameter
MAX_CHECKUP_TEXT: Final = 7000  #: maximum length of the text [characters], which fits into a parameter's packet

_Text = Annotated[str, msgspec.Meta(max_length=600)]


class Diagnostic(msgspec.Struct, frozen=True, array_like=True):
    """A finding about a vehicle or its settings that matters before a flight."""

    what: _Text  #: subject of the examination
    good: bool  #: whether the result is good
    detail: _Text  #: the result
    advice: _Text = ""  #: what to do about it; empty if no action is needed
    severe: bool = False  #: whether it is dangerous or certain to fail, rather than just a disabled safety net


_checkup_decoder = msgspec.json.Decoder(list[Diagnostic])


def encode_checkup(diagnostics: list[Diagnostic]) -> str:
    """Encode diagnostics as a parameter's text; if the text gets too long, drop good diagnostics first."""
    kept = list(diagnostics)
    while len(text := _encode_json(kept).decode()) > MAX_CHECKUP_TEXT:
        kept.remove(next((one for one in reversed(kept) if one.good), kept[-1]))
    return text


def decode_checkup(text: str) -> list[Diagnostic]:
    """Decode diagnostics from a parameter's text. Raises ``ValueError`` if the text contains none."""
    return _checkup_decoder.decode(text.encode())


# The world around a vehicle, for maps: walls, solids, gates, markers and start positions. Drivers that know their
# surroundings publish it in a parameter. The world axes are those of `Feedback.position_m`: x east, y north, z up [m];
# yaw is counter-clockwise [rad], and 0 faces east. It is only for display, never for control.

WORLD: Final = "world.geometry"  #: the parameter's name
MAX_WORLD_TEXT: Final = 8000  #: maximum length of the text [characters], which fits into a parameter's packet
MAX_THINGS: Final = 256  #: maximum number of objects of each kind

_Name = Annotated[str, msgspec.Meta(max_length=64)]
_Vec = tuple[Finite, Finite, Finite]


class Solid(msgspec.Struct, frozen=True, array_like=True):
    """An upright box: its centre, its extents along its own x, y and z axes, and its yaw."""

    name: _Name
    position: _Vec
    size: _Vec
    yaw: Finite = 0.0


class Opening(msgspec.Struct, frozen=True, array_like=True):
    """A gate: the centre, width and height of its opening, the direction of flight, and the thickness of its bars."""

    name: _Name
    position: _Vec
    size: tuple[Finite, Finite]
    yaw: Finite = 0.0
    frame: Finite = 0.08


class Card(msgspec.Struct, frozen=True, array_like=True):
    """A marker: its centre, its edge length, and the heading and elevation of its outward normal."""

    name: _Name
    position: _Vec
    size: Finite
    yaw: Finite = 0.0
    elevation: Finite = 0.0


class Start(msgspec.Struct, frozen=True, array_like=True):
    """The position and heading at which a vehicle starts."""

    name: _Name
    position: _Vec
    yaw: Finite = 0.0


class WorldGeometry(msgspec.Struct, frozen=True):
    """A whole world. ``low`` and ``high`` are corners of the room; ``enclosed``: whether it has visible walls."""

    name: _Name = ""
    low: _Vec | None = None
    high: _Vec | None = None
    enclosed: bool = True
    solids: Annotated[tuple[Solid, ...], msgspec.Meta(max_length=MAX_THINGS)] = ()
    gates: Annotated[tuple[Opening, ...], msgspec.Meta(max_length=MAX_THINGS)] = ()
    markers: Annotated[tuple[Card, ...], msgspec.Meta(max_length=MAX_THINGS)] = ()
    starts: Annotated[tuple[Start, ...], msgspec.Meta(max_length=MAX_THINGS)] = ()
    left_out: int = 0  #: number of objects omitted because the text has no space for them


_world_decoder = msgspec.json.Decoder(WorldGeometry)


def encode_world(world: WorldGeometry) -> str:
    """Encode a world as a parameter's text; while the text is too long, omit the last quarter of the commonest kind."""
    while len(text := _encode_json(world).decode()) > MAX_WORLD_TEXT:
        kind = max(("solids", "markers", "gates", "starts"), key=lambda one: len(getattr(world, one)))
        things = getattr(world, kind)
        kept = things[: len(things) * 3 // 4]
        left_out = world.left_out + len(things) - len(kept)
        world = msgspec.structs.replace(world, **{kind: kept}, left_out=left_out)
    return text


def decode_world(text: str) -> WorldGeometry:
    """Decode a world from a parameter's text. Raises ``ValueError`` if the text doesn't describe one."""
    return _world_decoder.decode(text.encode())
