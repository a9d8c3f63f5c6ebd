"""Which messages are sent on a link, and how often. Pure. Settings belong to the link and outlive its connections."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

MAX_INTERVAL_US: Final = 2**31 - 1  #: the greatest that ``MESSAGE_INTERVAL`` has room for


class Streams:
    """The messages of one link. Times are the autopilot's [s].

    Args:
        rates: By message number, from the start [1/s].
    """

    def __init__(self, rates: Mapping[int, float]) -> None:
        self._usual = dict(rates)
        self._periods = {number: 1.0 / rate for number, rate in rates.items()}
        self._due = dict.fromkeys(self._periods, 0.0)

    def reset(self) -> None:
        """Begin anew: the autopilot was switched on again, and its clock with it."""
        self._periods = {number: 1.0 / rate for number, rate in self._usual.items()}
        self._due = dict.fromkeys(self._periods, 0.0)

    def set_interval(self, number: int, interval_us: float) -> None:
        """Set a message's interval, as ``SET_MESSAGE_INTERVAL`` has it: -1 stops it, 0 is its usual rate."""
        if interval_us < 0:
            self._periods.pop(number, None)
        elif interval_us == 0:
            if number in self._usual:
                self._periods[number] = 1.0 / self._usual[number]
            else:
                self._periods.pop(number, None)
        else:
            self._periods[number] = interval_us / 1e6
        self._due[number] = 0.0

    def interval_us(self, number: int) -> int:
        """Return a message's interval; -1 if it is not sent."""
        period_s = self._periods.get(number)
        return -1 if period_s is None else round(period_s * 1e6)

    def due(self, time_s: float) -> list[int]:
        """Return the messages to send now, each once however late it is."""
        found = []
        for number, period_s in self._periods.items():
            due_s = self._due[number]
            if time_s >= due_s:
                found.append(number)
                following_s = due_s + period_s
                self._due[number] = following_s if following_s > time_s else time_s + period_s
        return found
