"""Plays a recording: on a thread by the clock, or sample by sample for a caller that moves the time."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from typing import Final

from skyloop.clock import Clock, monotonic_ns, seconds
from skyloop.drivers.base import Sink
from skyloop.drivers.replay.publisher import ReplayPublisher
from skyloop.drivers.replay.source import ReplaySource, TimedSample, Timeline
from skyloop.errors import UsageError
from skyloop.messages import EventKind, Feedback, LinkState, Severity

HEARTBEAT_NS: Final = 50_000_000  #: between repeats of the first state, while somebody is waited for
PAUSE_NS: Final = 50_000_000  #: between two passes, on the clock of the replay
LATE_NS: Final = 250_000_000  #: further behind than this, the schedule is put off instead of rushed through


class Player:
    """Plays by the clock, on the thread that calls :meth:`run`.

    Args:
        source: The recording.
        sink: The proxy's.
        stop: Set when the driver is closed.
        speed: Seconds of the recording in a second.
        loop: Whether it starts over at the end.
    """

    def __init__(self, source: ReplaySource, sink: Sink, stop: threading.Event, *, speed: float, loop: bool) -> None:
        self.publisher = ReplayPublisher(sink, monotonic_ns)
        self._source = source
        self._sink = sink
        self._stop = stop
        self._speed = speed
        self._loop = loop

    def run(self, wait_for: tuple[str, ...]) -> None:
        """Play until the end, or until stopped.

        Args:
            wait_for: Cameras of which one must be wanted before it begins; empty: begin at once.
        """
        publisher = self.publisher
        for parameter in self._source.parameters():
            publisher.parameter(parameter)
        publisher.link(LinkState.UP)
        self._wait_for_viewer(wait_for)
        while not self._stop.is_set():
            before = publisher.damaged
            self._pass()
            if self._stop.is_set():
                return
            self._publish_damage(publisher.damaged - before)
            if not self._loop:
                self._sink.link(LinkState.CLOSED, f"end of the recording after {publisher.frames} frames")
                return
            publisher.loops += 1

    def _pass(self) -> None:
        begin_ns = self._source.begin_ns
        timeline = Timeline(self._speed, begin_ns, monotonic_ns())
        for sample in self._source.samples():
            publish = self.publisher.prepare(sample, timeline, begin_ns)
            late_ns = monotonic_ns() - timeline.at(sample.at_ns)
            if late_ns > LATE_NS:
                timeline.put_off(late_ns)
            if not self._sleep_until(timeline.at(sample.at_ns)):
                return
            publish()
        self._sleep_until(monotonic_ns() + PAUSE_NS)

    def _wait_for_viewer(self, cameras: tuple[str, ...]) -> None:
        """Publish the first state again and again until somebody wants a camera's frames."""
        first = self._source.first_feedback() or Feedback(captured_ns=self._source.begin_ns)
        while cameras and not any(map(self._sink.wants, cameras)):
            timeline = Timeline(1.0, first.captured_ns, monotonic_ns())
            self.publisher.feedback(first, timeline, 0.0)
            if not self._sleep_until(monotonic_ns() + HEARTBEAT_NS):
                return

    def _sleep_until(self, due_ns: int) -> bool:
        """Wait until a time. Return False if the driver is being closed."""
        while (left_ns := due_ns - monotonic_ns()) > 0:
            if self._stop.wait(seconds(left_ns)):
                return False
        return not self._stop.is_set()

    def _publish_damage(self, frames: int) -> None:
        damaged = [*self._source.damaged, *([f"{frames} frames can't be decoded"] if frames else [])]
        if damaged:
            text = f"not all of the recording can be read: {'; '.join(damaged)}"
            self._sink.event(EventKind.VEHICLE_MESSAGE, text[:1000], Severity.WARNING, damaged=len(damaged))


class StepPlayer:
    """Plays sample by sample on the recording's own clock, each when :meth:`step` is called: nothing is left out.

    Args:
        source: The recording.
        sink: Receives the samples, in the call of :meth:`step`.
        clock: The replay's.
    """

    def __init__(self, source: ReplaySource, sink: Sink, clock: Clock) -> None:
        self._source = source
        self._sink = sink
        self.publisher = ReplayPublisher(sink, clock)
        self._timeline = Timeline(1.0, 0, 0)  # the replay's clock is the recording's
        self._samples: Iterator[TimedSample] = iter(())
        self._next: TimedSample | None = None

    @property
    def due_ns(self) -> int | None:
        """The time of the next sample [ns]; None after the last one."""
        return None if self._next is None else self._next.at_ns

    def begin(self) -> None:
        """Publish the link and the first state, before the first sample."""
        for parameter in self._source.parameters():
            self.publisher.parameter(parameter)
        self.publisher.link(LinkState.UP)
        first = self._source.first_feedback()
        if first is not None:
            self.publisher.feedback(first, self._timeline, 0.0)
        self._samples = self._source.samples()
        self._next = next(self._samples, None)

    def step(self) -> None:
        """Publish the next sample; its time is now. After the last one the link is closed.

        Raises:
            UsageError: The recording is over.
        """
        sample = self._next
        if sample is None:
            raise UsageError("the recording is over")
        self.publisher.prepare(sample, self._timeline, self._source.begin_ns)()
        self._next = next(self._samples, None)
        if self._next is None:
            self._sink.link(LinkState.CLOSED, f"end of the recording after {self.publisher.frames} frames")

    def close(self) -> None:
        """Close the file."""
        close: Callable[[], None] | None = getattr(self._samples, "close", None)
        if close is not None:
            close()
