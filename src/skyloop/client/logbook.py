"""``drone.log``: text and numbers that an application publishes beside the flight, for plots and recordings."""

from __future__ import annotations

import math
import numbers
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from skyloop.client.connection import ProxyConnection
from skyloop.errors import UsageError
from skyloop.messages import LogEntry, Severity, encode
from skyloop.messages.fields import LATEST_NS
from skyloop.messages.relayed import MAX_LOG_TEXT as MAX_TEXT
from skyloop.messages.relayed import MAX_VALUES

MAX_DIMENSIONS = 8


class Logbook:
    """Publishes text, numbers and arrays. Any thread; nothing waits.

    Each method returns whether everything was handed to the transport, and raises :class:`UsageError` for what can't be
    logged. Names of series have 1 to 64 characters.
    """

    def __init__(self, connection: ProxyConnection, source: str) -> None:
        self._connection = connection
        self._source = source

    def text(self, text: str, *, name: str = "", severity: Severity | str = Severity.INFO) -> bool:
        """Publish a line for people.

        Args:
            text: At most 4096 characters.
            name: Of the series that it belongs to, if any.
            severity: How serious it is, or its name.
        """
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
        """Publish one finite value of the series ``name``."""
        return self._send(_named(name), number=_finite(name, value))

    def numbers(self, **values: float) -> bool:
        """Publish one finite value of each series named: ``drone.log.numbers(range_m=1.2, bearing=0.1)``."""
        known = [(_named(name), _finite(name, value)) for name, value in values.items()]
        return sum(self._send(name, number=value) for name, value in known) == len(known)

    def array(self, name: str, values: ArrayLike, *, at_ns: int | None = None) -> bool:
        """Publish an array of the series ``name``.

        Args:
            name: Of the series.
            values: At most 4096 finite real numbers in up to 8 dimensions.
            at_ns: When it was measured, on the proxy's clock [ns]; None: now.
        """
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
        known_ns = self._connection.now_ns if at_ns is None else checked_time(at_ns)
        return self._connection.transmit(encode(LogEntry(self._source, name, known_ns, **fields)))


def checked_time(at_ns: object) -> int:
    """Return ``at_ns`` if it can be a time on the proxy's clock [ns].

    Raises:
        UsageError: If it is no int or out of range.
    """
    if not isinstance(at_ns, int) or not -LATEST_NS <= at_ns <= LATEST_NS:
        raise UsageError(
            f"at_ns is {at_ns!r:.80} and must be a time on the proxy's clock, whole ns within ±{LATEST_NS}"
        )
    return at_ns


def _named(name: object) -> str:
    if not isinstance(name, str) or not 1 <= len(name) <= 64:
        raise UsageError(f"the name of a series has 1 to 64 characters, not {name!r:.80}")
    return name


def _finite(name: str, value: object) -> float:
    if not isinstance(value, numbers.Real) or not math.isfinite(value):
        raise UsageError(f"{name} can't be {value!r:.80}: a finite number is needed")
    return float(value)
