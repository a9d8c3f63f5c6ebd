"""Annotations: what a controller or processor saw in a frame, for people and recorders to look at.

Relayed by the proxy on the ``annotations`` topic; newest wins. Coordinates are pixels of the frame named.
"""

from __future__ import annotations

from typing import Annotated

import msgspec

from skyloop.messages.frame import Name, Pixels
from skyloop.messages.numbers import Finite, TimeNs

Point = tuple[Finite, Finite]
Channel = Annotated[int, msgspec.Meta(ge=0, le=255)]
Colour = tuple[Channel, Channel, Channel]  #: red, green, blue, 0 to 255
GREEN: Colour = (64, 220, 100)


class Polyline(msgspec.Struct, frozen=True, array_like=True, tag=1):
    """A line through points; closed: a polygon (a box has four points)."""

    points: Annotated[tuple[Point, ...], msgspec.Meta(max_length=512)]
    closed: bool = False
    colour: Colour = GREEN


class Points(msgspec.Struct, frozen=True, array_like=True, tag=2):
    """Single points."""

    points: Annotated[tuple[Point, ...], msgspec.Meta(max_length=1024)]
    colour: Colour = GREEN


class Text(msgspec.Struct, frozen=True, array_like=True, tag=3):
    """A text beside a point."""

    text: Annotated[str, msgspec.Meta(max_length=256)]
    at: Point
    colour: Colour = GREEN


Shape = Polyline | Points | Text


class Annotation(msgspec.Struct, frozen=True, array_like=True):
    source: Name  #: which tracker or controller drew it; the newest per source and camera counts
    camera: Name
    captured_ns: TimeNs  #: of the frame that it belongs to
    width: Pixels  #: of that frame
    height: Pixels
    shapes: Annotated[tuple[Shape, ...], msgspec.Meta(max_length=256)] = ()
