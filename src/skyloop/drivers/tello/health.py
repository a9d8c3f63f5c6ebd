"""What the drone's state says of its health and of mission pads: each change told once. Pure."""

from __future__ import annotations

from typing import Final

from skyloop.drivers.notices import Notice, message
from skyloop.messages import Severity
from skyloop.wire.tello.state import Pad, State

HOT_C: Final = 90.0  #: estimate: people report that the motors are refused somewhat above
COOL_C: Final = 85.0
PAD_LOST: Final = 5  #: states in a row without it, before a pad counts as out of view


class Health:
    """Remembers what was told."""

    def __init__(self) -> None:
        self._hot = False
        self._pad = 0
        self._without = 0

    def notices(self, state: State) -> list[Notice]:
        """What changed since the last call."""
        return self._temperature(state.temperature_c) + self._mission_pad(state)

    def _temperature(self, range_c: tuple[float, float] | None) -> list[Notice]:
        if range_c is None:
            return []
        highest = range_c[1]
        hot = highest >= (COOL_C if self._hot else HOT_C)
        if hot is self._hot:
            return []
        self._hot = hot
        text = f"the drone is hot: {highest:g} °C" if hot else "no longer: the drone is hot"
        return [message(text, "hot", Severity.WARNING if hot else Severity.INFO, active=hot, celsius=highest)]

    def _mission_pad(self, state: State) -> list[Notice]:
        number = state.pad.number if state.pad is not None else 0
        self._without = 0 if number else self._without + 1
        if number == self._pad or (not number and self._without < PAD_LOST):
            return []
        before, self._pad = self._pad, number
        if state.pad is not None:
            return [_seen(state.pad)]
        return [message(f"mission pad m{before} is out of view", "mission_pad", pad=before, in_view=False)]


def _seen(pad: Pad) -> Notice:
    """Its place in metres: the drone's in the pad's axes."""
    text = f"mission pad m{pad.number} is in view"
    if pad.place_cm is None:
        return message(text, "mission_pad", pad=pad.number, in_view=True)
    x, y, z = (part / 100 for part in pad.place_cm)
    return message(text, "mission_pad", pad=pad.number, in_view=True, place=(x, y, z))
