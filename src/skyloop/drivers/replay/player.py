"""Plays a tape: on a thread of its own by the clock, or step by step for whoever moves the time himself."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from typing import Final

from skyloop.clock import Clock, monotonic_ns, seconds
from skyloop.drivers.base import Sink
from skyloop.drivers.replay.tape import Moment, Tape, Timeline
from skyloop.drivers.replay.telling import Teller
from skyloop.errors import UsageError
from skyloop.messages import EventKind, Feedback, LinkState, Severity

HEARTBEAT_NS: Final = 50_000_000  #: between repeats of the first state, while somebody is waited for
PAUSE_NS: Final = 50_000_000  #: between two passes, on the clock of the replay
LATE_NS: Final = 250_000_000  #: further behind than this, the schedule is put off instead of rushed through


class Player:
    """Plays once, or with ``loop`` again and again."""

    def __init__(self, tape: Tape, sink: Sink, stop: threading.Event, *, speed: float, loop: bool) -> None:
        self.teller = Teller(sink, monotonic_ns)
        self._tape = tape
        self._sink = sink
        self._stop = stop
        self._speed = speed
        self._loop = loop

    def run(self, wait_for: tuple[str, ...]) -> None:
        """Until the end, or until it is stopped; begins when somebody looks at one of the cameras of ``wait_for``."""
        teller = self.teller
        for parameter in self._tape.parameters():
            teller.parameter(parameter)
        teller.link(LinkState.UP)
        self._await(wait_for)
        while not self._stop.is_set():
            before = teller.damaged
            self._pass()
            if self._stop.is_set():
                return
            self._tell_damage(teller.damaged - before)
            if not self._loop:
                self._sink.link(LinkState.CLOSED, f"end of the recording after {teller.frames} frames")
                return
            teller.loops += 1

    def _pass(self) -> None:
        begin_ns = self._tape.begin_ns
        timeline = Timeline(self._speed, begin_ns, monotonic_ns())
        for moment in self._tape.moments():
            tell = self.teller.prepare(moment, timeline, begin_ns)
            late_ns = monotonic_ns() - timeline.at(moment.at_ns)
            if late_ns > LATE_NS:
                timeline.put_off(late_ns)
            if not self._sleep_until(timeline.at(moment.at_ns)):
                return
            tell()
        self._sleep_until(monotonic_ns() + PAUSE_NS)

    def _await(self, cameras: tuple[str, ...]) -> None:
        """Tell the first state until somebody looks."""
        first = self._tape.first_feedback() or Feedback(captured_ns=self._tape.begin_ns)
        while cameras and not any(map(self._sink.wants, cameras)):
            timeline = Timeline(1.0, first.captured_ns, monotonic_ns())
            self.teller.feedback(first, timeline, 0.0)
            if not self._sleep_until(monotonic_ns() + HEARTBEAT_NS):
                return

    def _sleep_until(self, due_ns: int) -> bool:
        """False if it is to stop."""
        while (left_ns := due_ns - monotonic_ns()) > 0:
            if self._stop.wait(seconds(left_ns)):
                return False
        return not self._stop.is_set()

    def _tell_damage(self, frames: int) -> None:
        damaged = [*self._tape.damaged, *([f"{frames} frames can't be decoded"] if frames else [])]
        if damaged:
            text = f"not all of the recording can be read: {'; '.join(damaged)}"
            self._sink.event(EventKind.VEHICLE_MESSAGE, text[:1000], Severity.WARNING, damaged=len(damaged))


class Steps:
    """A tape that is moved by hand, moment by moment, on the recording's own clock: nothing is left out."""

    def __init__(self, tape: Tape, sink: Sink, clock: Clock) -> None:
        self._tape = tape
        self._sink = sink
        self._teller = Teller(sink, clock)
        self._timeline = Timeline(1.0, 0, 0)  # the replay's clock is the recording's
        self._moments: Iterator[Moment] = iter(())
        self._next: Moment | None = None

    @property
    def due_ns(self) -> int | None:
        """When the next moment is; None after the last one."""
        return None if self._next is None else self._next.at_ns

    @property
    def teller(self) -> Teller:
        return self._teller

    def begin(self) -> None:
        """Tell the link and the first state; the tape stands at its start."""
        for parameter in self._tape.parameters():
            self._teller.parameter(parameter)
        self._teller.link(LinkState.UP)
        first = self._tape.first_feedback()
        if first is not None:
            self._teller.feedback(first, self._timeline, 0.0)
        self._moments = self._tape.moments()
        self._next = next(self._moments, None)

    def step(self) -> None:
        """Tell the next moment, whose time it is now, and at the end that it is the end."""
        moment = self._next
        if moment is None:
            raise UsageError("the recording is over")
        self._teller.prepare(moment, self._timeline, self._tape.begin_ns)()
        self._next = next(self._moments, None)
        if self._next is None:
            self._sink.link(LinkState.CLOSED, f"end of the recording after {self._teller.frames} frames")

    def close(self) -> None:
        """Give the file back."""
        close: Callable[[], None] | None = getattr(self._moments, "close", None)
        if close is not None:
            close()
