"""What stands in a vehicle's world, for maps: walls, solids, gates, markers, starts; as text in one parameter.

A driver that knows its surroundings lists a read-only parameter :data:`WORLD` with :func:`encode_world`'s text. World
axes are those of ``Feedback.position_m``: x east, y north, z up [m]; yaw 0 faces east, counter-clockwise [rad].
It is for people's eyes: nothing is steered by it.
"""

from __future__ import annotations

from typing import Annotated, Final

import msgspec

from skyloop.messages.numbers import Finite

WORLD: Final = "world.geometry"  #: the parameter's name
MAX_TEXT: Final = 8000  #: characters of the text: a parameter's packet has to hold it
MAX_THINGS: Final = 256  #: of one kind

_Name = Annotated[str, msgspec.Meta(max_length=64)]
_Vec = tuple[Finite, Finite, Finite]


class Solid(msgspec.Struct, frozen=True, array_like=True):
    """An upright box: its centre, its extents along its own x, y, z, and its yaw."""

    name: _Name
    position: _Vec
    size: _Vec
    yaw: Finite = 0.0


class Opening(msgspec.Struct, frozen=True, array_like=True):
    """A gate: the centre, width and height of its opening, the heading of the way through, thickness of its bars."""

    name: _Name
    position: _Vec
    size: tuple[Finite, Finite]
    yaw: Finite = 0.0
    frame: Finite = 0.08


class Card(msgspec.Struct, frozen=True, array_like=True):
    """A marker: its centre, its edge, and its outward normal's heading and angle above the horizon."""

    name: _Name
    position: _Vec
    size: Finite
    yaw: Finite = 0.0
    elevation: Finite = 0.0


class Start(msgspec.Struct, frozen=True, array_like=True):
    """Where a vehicle stands at the start."""

    name: _Name
    position: _Vec
    yaw: Finite = 0.0


class WorldGeometry(msgspec.Struct, frozen=True):
    """The whole of it. ``low`` and ``high`` are corners of the room; ``enclosed``: it has walls to see."""

    name: _Name = ""
    low: _Vec | None = None
    high: _Vec | None = None
    enclosed: bool = True
    solids: Annotated[tuple[Solid, ...], msgspec.Meta(max_length=MAX_THINGS)] = ()
    gates: Annotated[tuple[Opening, ...], msgspec.Meta(max_length=MAX_THINGS)] = ()
    markers: Annotated[tuple[Card, ...], msgspec.Meta(max_length=MAX_THINGS)] = ()
    starts: Annotated[tuple[Start, ...], msgspec.Meta(max_length=MAX_THINGS)] = ()
    left_out: int = 0  #: things that the text has no room for


_encode = msgspec.json.Encoder().encode
_decoder = msgspec.json.Decoder(WorldGeometry)


def encode_world(world: WorldGeometry) -> str:
    """Return a world as a parameter's text; of a world that is too large the last solids and markers are left out."""
    while len(text := _encode(world).decode()) > MAX_TEXT:
        kind = max(("solids", "markers", "gates", "starts"), key=lambda one: len(getattr(world, one)))
        things = getattr(world, kind)
        kept = things[: len(things) * 3 // 4]
        left_out = world.left_out + len(things) - len(kept)
        world = msgspec.structs.replace(world, **{kind: kept}, left_out=left_out)
    return text


def decode_world(text: str) -> WorldGeometry:
    """Return the world of a parameter's text.

    Raises:
        ValueError: It is none.
    """
    return _decoder.decode(text.encode())
