"""Decides which AT commands are new. Pure."""

from __future__ import annotations

from typing import Final

from skyloop.clock import nanoseconds
from skyloop.vehicles.ardrone.wire.at import SILENCE_RESET_S

RESTART: Final = 1  #: the sequence number with which a client restarts


class CommandSequence:
    """Accepts a command only if its number is greater than that of the last one accepted, or 1, which restarts.

    After two seconds without an accepted command any number greater than 0 is new again. The Developer Guide asks
    clients to begin with 1; a drone that insisted on it would never again obey a client whose first datagram got lost,
    so this one doesn't.
    """

    def __init__(self) -> None:
        self._last = 0
        self._taken_ns: int | None = None

    def takes(self, number: int, now_ns: int) -> bool:
        """Return whether the command with this number, received now, is to be executed."""
        if self._taken_ns is not None and now_ns - self._taken_ns > nanoseconds(SILENCE_RESET_S):
            self._last = 0
        if number != RESTART and number <= self._last:
            return False
        self._last, self._taken_ns = number, now_ns
        return True
