"""The vehicle's clock on this host's: by ``TIMESYNC`` where that fits its stamps, else by the smallest delay. Pure."""

from __future__ import annotations

from collections import deque
from typing import Final

from skyloop.clock import nanoseconds, seconds
from skyloop.drivers.live_clock import LiveClock
from skyloop.wire.mavlink.codec import Message
from skyloop.wire.mavlink.codec import dialect as m

ASK_NS: Final = nanoseconds(1.0)
HURRY_NS: Final = nanoseconds(0.1)  #: the pace of the first few
FIRST: Final = 5
KEEP_NS: Final = nanoseconds(10.0)
PLAUSIBLE_NS: Final = nanoseconds(1.0)  #: a stamp that would be older than this when it comes is of another clock
REBOOT_MS: Final = 1000  #: stamps that go back by more say that the vehicle was started anew
_HALF: Final = 1 << 31
_WRAP: Final = 1 << 32  #: of stamps in ms: 49 days


class VehicleClock:
    """One vehicle since it was heard."""

    def __init__(self) -> None:
        self.round_trip_s: float | None = None  #: of the best answer lately
        self.restarted = False  #: its clock was set back; to be looked at and cleared by the owner
        self._samples: deque[tuple[int, int, int]] = deque()  # when, round trip, their clock minus ours
        self._asked_ns = 0
        self._asked = 0
        self._live = LiveClock()
        self._stamp_ms: int | None = None
        self._captured_ns = 0

    def step(self, now_ns: int) -> list[Message]:
        """The question that is due now. Stamps are those of our clock."""
        if now_ns - self._asked_ns < (HURRY_NS if self._asked < FIRST else ASK_NS):
            return []
        self._asked_ns, self._asked = now_ns, self._asked + 1
        return [m.MAVLink_timesync_message(0, now_ns)]

    def heard(self, message: Message, now_ns: int) -> list[Message]:
        """A ``TIMESYNC``; the answer, if it is a question."""
        if message.tc1 == 0:
            return [m.MAVLink_timesync_message(now_ns, message.ts1)]
        round_trip_ns = now_ns - message.ts1
        if 0 <= round_trip_ns <= PLAUSIBLE_NS and self._asked:
            self._samples.append((now_ns, round_trip_ns, message.tc1 - (message.ts1 + round_trip_ns // 2)))
            while now_ns - self._samples[0][0] > KEEP_NS:
                self._samples.popleft()
            self.round_trip_s = seconds(min(each[1] for each in self._samples))
        return []

    def captured_ns(self, boot_ms: int, now_ns: int) -> int:
        """When the state of this stamp was so; neither later than now nor earlier than the one before."""
        before, self._stamp_ms = self._stamp_ms, boot_ms
        if before is not None:
            step = (boot_ms - before + _HALF) % _WRAP - _HALF
            if step < -REBOOT_MS and boot_ms < before:
                self.restarted = True
        live_ns = self._live.captured_ns(boot_ms / 1000.0, now_ns)
        if self._samples:
            _, _, offset_ns = min(self._samples, key=lambda each: each[1])
            synced_ns = boot_ms * 1_000_000 - offset_ns
            # Stamps are cut to whole milliseconds, so they may be that much too early.
            if 0 <= now_ns - synced_ns <= PLAUSIBLE_NS:
                live_ns = synced_ns
        self._captured_ns = max(self._captured_ns, min(now_ns, live_ns))
        return self._captured_ns

    def now(self, now_ns: int) -> int:
        """For a state without a stamp."""
        self._captured_ns = max(self._captured_ns, now_ns)
        return self._captured_ns
