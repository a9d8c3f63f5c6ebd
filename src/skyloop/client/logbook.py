"""``drone.log``: what the application itself wants to be seen and recorded beside the flight."""

from __future__ import annotations

import math
import numbers
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from skyloop.client.link import Link
from skyloop.errors import UsageError
from skyloop.messages import LogEntry, Severity, encode
from skyloop.messages.log import MAX_TEXT, MAX_VALUES

MAX_DIMENSIONS = 8


class Logbook:
    """Tells text, numbers and arrays to whoever listens: recorders, plots. Any thread; nothing waits.

    Each method returns whether it was handed over; raises :class:`UsageError` for what can't be logged.
    """

    def __init__(self, link: Link, source: str, now_ns: Callable[[], int]) -> None:
        """``now_ns``: the time on the proxy's clock."""
        self._link = link
        self._source = source
        self._now_ns = now_ns

    def text(self, text: str, *, name: str = "", severity: Severity | str = Severity.INFO) -> bool:
        """A line for people, of at most 4096 characters. ``name`` of a series, if it belongs to one."""
        if name != "":
            _named(name)
        if not isinstance(text, str) or len(text) > MAX_TEXT:
            raise UsageError(f"a text of at most {MAX_TEXT} characters can be logged, not {text!r:.80}")
        try:
            known = Severity(severity)
        except ValueError:
            wanted = ", ".join(one.value for one in Severity)
            raise UsageError(f"severity is {severity!r} and must be one of {wanted}") from None
        return self._send(name, text=text, severity=known)

    def number(self, name: str, value: float) -> bool:
        """One value of the series ``name``."""
        return self._send(_named(name), number=_finite(name, value))

    def numbers(self, **values: float) -> bool:
        """One value of each series named: ``drone.log.numbers(range_m=1.2, bearing=0.1)``."""
        known = [(_named(name), _finite(name, value)) for name, value in values.items()]
        return sum(self._send(name, number=value) for name, value in known) == len(known)

    def array(self, name: str, values: ArrayLike, *, at_ns: int | None = None) -> bool:
        """An array of at most 4096 real numbers in up to 8 dimensions, of the series ``name``; ``at_ns``: when it was
        so, on the proxy's clock (default: now)."""
        try:
            array = np.asarray(values, dtype=np.float64)
        except (TypeError, ValueError):
            raise UsageError(f"{name} can't be {values!r:.80}: an array of real numbers is needed") from None
        if array.size > MAX_VALUES or array.ndim > MAX_DIMENSIONS:
            raise UsageError(
                f"{name} has {array.size} numbers in {array.ndim} dimensions; at most {MAX_VALUES} in {MAX_DIMENSIONS} "
                "can be logged"
            )
        if not np.isfinite(array).all():
            raise UsageError(f"{name} holds numbers that are not finite")
        return self._send(_named(name), at_ns, values=tuple(array.ravel().tolist()), shape=array.shape)

    def _send(self, name: str, at_ns: int | None = None, **fields: Any) -> bool:
        known_ns = self._now_ns() if at_ns is None else at_ns
        return self._link.transmit(encode(LogEntry(self._source, name, known_ns, **fields)))


def _named(name: object) -> str:
    if not isinstance(name, str) or not 1 <= len(name) <= 64:
        raise UsageError(f"the name of a series has 1 to 64 characters, not {name!r:.80}")
    return name


def _finite(name: str, value: object) -> float:
    if not isinstance(value, numbers.Real) or not math.isfinite(value):
        raise UsageError(f"{name} can't be {value!r:.80}: a finite number is needed")
    return float(value)
