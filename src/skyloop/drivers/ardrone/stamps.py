"""The stamps of the drone's video, mapped to this host's clock. Pure.

A PaVE header carries the drone's own time in milliseconds, 32 bits (``video_encapsulation.h`` of the AR.Drone SDK
2.0.1). Which moment of the picture it names is written nowhere; it is taken for the capture. Its offset to this host's
clock is taken to be the smallest one seen in the last 5 to 10 s, as if the fastest picture had come without delay: the
part of the delay that all pictures have in common (encoding, and the shortest way through the air) stays unknown.
"""

from __future__ import annotations

from typing import Final

from skyloop.drivers.live_clock import LiveClock

_WRAP: Final = 1 << 32


class DroneStamps:
    """Capture times of one connection's frames. Follows a drift of the drone's clock and the wrap of its stamps.

    Stamps that go back (a drone that was started again) void what was learned.
    """

    def __init__(self) -> None:
        self._clock = LiveClock()
        self._stamp_ms = 0  # of the frame before, as the drone wrote it
        self._time_ms = 0  # the same without wraps

    def captured_ns(self, stamp_ms: int, arrived_ns: int) -> int:
        """When the picture of this stamp, which came at ``arrived_ns``, was taken; never later than that."""
        step_ms = (stamp_ms - self._stamp_ms + _WRAP // 2) % _WRAP - _WRAP // 2
        self._stamp_ms = stamp_ms
        self._time_ms += step_ms
        return self._clock.captured_ns(self._time_ms / 1000.0, arrived_ns)
