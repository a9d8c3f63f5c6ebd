"""What a processor may return beside a plain value."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from skyloop.messages.annotation import Shape


class Output:
    """A value, and what is to be drawn over the frame for people: ``return Output(boxes, [Polyline(…)])``.

    ``shapes`` are in the frame's pixels. A value of None publishes no result.
    """

    __slots__ = ("shapes", "value")

    def __init__(self, value: Any, shapes: Iterable[Shape] = ()) -> None:
        self.value = value
        self.shapes = tuple(shapes)
