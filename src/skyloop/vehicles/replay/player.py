"""Plays a recording: on a thread by the clock, or sample by sample for a caller that moves the time."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Final

from skyloop.clock import Clock, monotonic_ns, nanoseconds, seconds
from skyloop.drivers.base import Sink
from skyloop.errors import UsageError
from skyloop.messages import EventKind, Feedback, LinkState, Severity
from skyloop.vehicles.replay.playback import Playback, Wanted
from skyloop.vehicles.replay.publisher import ReplayPublisher
from skyloop.vehicles.replay.source import ReplaySource, TimedSample, Timeline

HEARTBEAT_NS: Final = 50_000_000  #: between repeats of the first state, while somebody is waited for
PAUSE_NS: Final = 50_000_000  #: between two passes, on the clock of the replay
STILL_NS: Final = 200_000_000  #: between repeats of what is shown while it is paused
IDLE_S: Final = 3600.0  #: a wait that only a change ends
LATE_NS: Final = 250_000_000  #: further behind than this, the schedule is put off instead of rushed through


class Player:
    """Plays by the clock, on the thread that calls :meth:`run`, and goes where its playback says.

    Args:
        source: The recording.
        sink: The proxy's.
        playback: Position, speed and pause.
        loop: Whether it starts over at the end.
        clock: The monotonic clock [ns].
        wait: Waits for so many seconds, or until the playback has changed; None: that long, in real time.
    """

    def __init__(
        self,
        source: ReplaySource,
        sink: Sink,
        playback: Playback,
        *,
        loop: bool,
        clock: Clock = monotonic_ns,
        wait: Callable[[float], None] | None = None,
    ) -> None:
        self.publisher = ReplayPublisher(sink, clock, playback, source.first_ns)
        self._source = source
        self._sink = sink
        self._playback = playback
        self._loop = loop
        self._clock = clock
        self._wait = wait or playback.wait
        self._timeline = Timeline(playback.speed, source.begin_ns, clock())
        self._samples = source.samples()
        self._due: TimedSample | None = None  # was to come next when something was written
        self._still: Callable[[], None] | None = None  # publishes what is shown while it is paused
        self._damaged = 0  # frames, in the passes before

    def run(self, wait_for: tuple[str, ...]) -> None:
        """Play until stopped. At the end the link is closed, and up again if somebody goes back from there.

        Args:
            wait_for: Cameras of which one must be wanted before it begins; empty: begin at once.
        """
        playback = self._playback
        for parameter in self._source.parameters():
            self.publisher.parameter(parameter)
        self.publisher.link(LinkState.UP)
        self._wait_for_viewer(wait_for)
        self._timeline.restart(self._source.begin_ns, self._clock())
        while not playback.stopped:
            self._follow(playback.take())
            if playback.over:
                self._wait(IDLE_S)
            elif playback.paused:
                self._hold()
            else:
                self._play()

    def _follow(self, wanted: Wanted) -> None:
        """Do what was written meanwhile."""
        self._timeline.set_speed(wanted.speed, self._clock())
        if wanted.position_s is not None:
            self._playback.jumps += 1
            self._playback.over = False
            self._go_to(self._source.first_ns + nanoseconds(wanted.position_s))
        elif wanted.paused and self._still is None and not self._playback.over:
            self._go_to(self._timeline.recorded(self._clock()))
        elif not wanted.paused and self._still is not None:
            self._timeline.restart(self._position_ns, self._clock())
            self._still = None

    def _go_to(self, at_ns: int) -> None:
        """Show one moment of the recording, and go on from there."""
        at_ns = max(self._source.first_ns, min(at_ns, self._source.end_ns))
        moment = self._source.moment(at_ns)
        self._samples, self._due = moment.following, None
        self.publisher.link(LinkState.UP)
        show = self.publisher.still(moment)
        show()
        self._playback.position_s = seconds(at_ns - self._source.first_ns)
        self._still = show if self._playback.paused else None
        self._timeline.restart(at_ns, self._clock())

    @property
    def _position_ns(self) -> int:
        return self._source.first_ns + nanoseconds(self._playback.position_s)

    def _hold(self) -> None:
        """Show the moment again and again: whoever comes sees it, and nobody takes the silence for a lost link."""
        if self._sleep_until(self._clock() + STILL_NS) and self._still is not None:
            self._still()

    def _play(self) -> None:
        """Publish what comes next, until something is written or the recording is over."""
        while (sample := self._next()) is not None:
            publish = self.publisher.prepare(sample, self._timeline)
            late_ns = self._clock() - self._timeline.at(sample.at_ns)
            if late_ns > LATE_NS:
                self._timeline.put_off(late_ns)
            if not self._sleep_until(self._timeline.at(sample.at_ns)):
                self._due = sample
                return
            publish()
        if self._sleep_until(self._clock() + PAUSE_NS):
            self._end()

    def _next(self) -> TimedSample | None:
        due, self._due = self._due, None
        return due or next(self._samples, None)

    def _end(self) -> None:
        publisher, playback = self.publisher, self._playback
        self._publish_damage(publisher.damaged - self._damaged)
        self._damaged = publisher.damaged
        if not self._loop:
            playback.over = True
            publisher.link(LinkState.CLOSED, f"end of the recording after {publisher.frames} frames")
            return
        publisher.loops += 1
        playback.jumps += 1
        self._samples = self._source.samples()
        self._timeline.restart(self._source.begin_ns, self._clock())

    def _wait_for_viewer(self, cameras: tuple[str, ...]) -> None:
        """Publish the first state again and again until somebody wants a camera's frames, or moves the replay."""
        first = self._source.first_feedback() or Feedback(captured_ns=self._source.begin_ns)
        while cameras and not any(map(self._sink.wants, cameras)):
            timeline = Timeline(1.0, first.captured_ns, self._clock())
            self.publisher.feedback(first, timeline, self._source.begin_ns)
            if not self._sleep_until(self._clock() + HEARTBEAT_NS):
                return

    def _sleep_until(self, due_ns: int) -> bool:
        """Wait until a time. Return False, at once, if something was written or the driver is being closed."""
        while not self._playback.changed:
            left_ns = due_ns - self._clock()
            if left_ns <= 0:
                return True
            self._wait(seconds(left_ns))
        return False

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
        playback: Gets the position.
    """

    def __init__(self, source: ReplaySource, sink: Sink, clock: Clock, playback: Playback) -> None:
        self._source = source
        self._sink = sink
        self.publisher = ReplayPublisher(sink, clock, playback, source.first_ns)
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
            self.publisher.feedback(first, self._timeline, self._source.begin_ns)
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
        self.publisher.prepare(sample, self._timeline)()
        self._next = next(self._samples, None)
        if self._next is None:
            self._sink.link(LinkState.CLOSED, f"end of the recording after {self.publisher.frames} frames")

    def close(self) -> None:
        """Close the file."""
        close: Callable[[], None] | None = getattr(self._samples, "close", None)
        if close is not None:
            close()
