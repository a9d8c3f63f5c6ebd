"""What a processor may return besides a plain value."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from skyloop.messages.relayed import Shape


class Output:
    """A value, and shapes to draw over the frame for people: ``return Output(boxes, [Polyline(…)])``."""

    __slots__ = ("shapes", "value")

    def __init__(self, value: Any, shapes: Iterable[Shape] = ()) -> None:
        """Combine a value with shapes.

        Args:
            value: The result; None publishes none.
            shapes: In the frame's pixels.
        """
        self.value = value
        self.shapes = tuple(shapes)
