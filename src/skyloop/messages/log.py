"""What an application logs itself: text, numbers and arrays, for recorders and for people to plot.

Relayed by the proxy on the ``logs`` topic, from any application.
"""

from __future__ import annotations

from typing import Annotated, Final

import msgspec

from skyloop.messages.fields import Severity
from skyloop.messages.frame import Name
from skyloop.messages.numbers import Count, Finite, TimeNs, shape_fits

MAX_TEXT: Final = 4096  #: characters
MAX_VALUES: Final = 4096  #: numbers of an array
#: The series of poses from motion capture, in world axes: arrays of x, y, z [m], quaternion x, y, z, w, and velocity
#: x, y, z [m/s] if it is known.
MOCAP: Final = "mocap"


class LogEntry(msgspec.Struct, frozen=True, array_like=True):
    """One entry: exactly one of ``text``, ``number`` and ``values`` is given.

    Raises ``ValueError`` for none or several of them, and for a shape that is not that of the values.
    """

    source: Name  #: the application, or the part of it, that logged it
    name: Annotated[str, msgspec.Meta(max_length=64)]  #: of the series; empty for text that belongs to none
    at_ns: TimeNs  #: when it was logged, on the proxy's clock
    text: Annotated[str, msgspec.Meta(max_length=MAX_TEXT)] | None = None
    number: Finite | None = None
    values: Annotated[tuple[Finite, ...], msgspec.Meta(max_length=MAX_VALUES)] | None = None  #: an array, row by row
    shape: Annotated[tuple[Count, ...], msgspec.Meta(max_length=8)] = ()  #: of that array
    severity: Severity = Severity.INFO  #: of a text

    def __post_init__(self) -> None:
        if (self.text is not None) + (self.number is not None) + (self.values is not None) != 1:
            raise ValueError("a log entry has exactly one of text, number and values")
        values = self.values
        if self.shape if values is None else not shape_fits(self.shape, len(values), MAX_VALUES):
            raise ValueError(f"a log entry of {len(values or ())} values can't have the shape {self.shape!r:.200}")
