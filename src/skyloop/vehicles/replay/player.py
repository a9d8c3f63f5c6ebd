"""Players for recordings: on a thread in real time, or sample by sample for a caller that advances the time.

The vehicle's samples are published unchanged; the recorded proxy's samples become messages about the past. Viewers set
position, speed and pause through parameters.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Final

import msgspec

from skyloop.clock import Clock, monotonic_ns, nanoseconds, seconds
from skyloop.drivers.base import Sink
from skyloop.errors import ParameterError, SkyloopError, UnknownNameError, UsageError
from skyloop.messages import (
    AnyAction,
    Applied,
    Event,
    EventKind,
    Feedback,
    LinkState,
    Parameter,
    ParameterType,
    Refusal,
    Severity,
    Value,
)
from skyloop.recording.pictures import RecordedImage
from skyloop.vehicles.replay.source import Moment, ReplaySource, TimedSample, Timeline

POSITION: Final = "replay.position_s"
SPEED: Final = "replay.speed"
PAUSED: Final = "replay.paused"
SPEEDS: Final = (0.01, 1000.0)  #: minimum and maximum speed, in recorded seconds per second
NAMES: Final = frozenset({POSITION, SPEED, PAUSED})

_IN_STEP: Final = (
    "with speed=max the replay is in step with its application, which must not miss anything: give a number, such as "
    "speed=1, to pause it, move it or slow it down"
)


@dataclass(frozen=True, slots=True)
class Wanted:
    """The player's next task."""

    paused: bool
    speed: float
    position_s: float | None = None  #: position to seek to; None to continue from the current one


class Playback:
    """A replay's position, speed and pause. Thread-safe.

    With ``in_step`` (``speed=max``), the application advances the replay and no parameter can be written.
    """

    def __init__(self, duration_s: float, speed: float = 1.0, *, in_step: bool = False) -> None:
        self.duration_s = duration_s
        self.position_s = 0.0  #: position in the recording, set by the player
        self.over = False  #: whether the end has been reached, set by the player
        self.jumps = 0  #: number of position changes not caused by playing
        self.stopped = False
        self._default_speed = speed
        self._in_step = in_step
        self._lock = threading.Lock()
        self._wanted = Wanted(False, speed)
        self._changed = threading.Event()

    @property
    def paused(self) -> bool:
        """Whether the replay should be paused."""
        return self._wanted.paused

    @property
    def speed(self) -> float:
        """Recorded seconds per second."""
        return self._wanted.speed

    # Viewers ---------------------------------------------------------------------------------------------------

    def parameters(self) -> list[Parameter]:
        """Return the parameters with their current values."""
        with self._lock:
            wanted = self._wanted
        position_s = self.position_s if wanted.position_s is None else wanted.position_s
        return [
            Parameter(PAUSED, ParameterType.BOOL, wanted.paused, default=False, description="pauses the replay"),
            Parameter(
                POSITION,
                ParameterType.FLOAT,
                min(position_s, self.duration_s),
                "s",
                0.0,
                self.duration_s,
                description="position in the recording; write it to seek",
                momentary=True,
            ),
            Parameter(
                SPEED,
                ParameterType.FLOAT,
                wanted.speed,
                "",
                *SPEEDS,
                self._default_speed,
                description="recorded seconds per second",
            ),
        ]

    def set(self, name: str, value: Value) -> Value:
        """Write a parameter, which takes effect at once, and return its new value.

        Resuming at the end starts the replay over.
        """
        if name not in NAMES:
            raise UnknownNameError("parameter of a replay", name, NAMES)
        if self._in_step:
            raise ParameterError(f"{name} can't be written: {_IN_STEP}", code=Refusal.READ_ONLY)
        if name == PAUSED:
            if not isinstance(value, bool):
                raise ParameterError(f"{name} must be true or false, got {value!r}", code=Refusal.WRONG_TYPE)
            at_end = (self.over or self.position_s >= self.duration_s) and self._wanted.position_s is None
            self._want(paused=value, position_s=0.0 if at_end and not value else None)
            return value
        low, high = (0.0, self.duration_s) if name == POSITION else SPEEDS
        if isinstance(value, bool) or not isinstance(value, int | float) or not low <= value <= high:
            raise ParameterError(f"{name} must be from {low:g} to {high:g}, got {value!r}", code=Refusal.OUT_OF_RANGE)
        if name == POSITION:
            self._want(position_s=float(value))
        else:
            self._want(speed=float(value))
        return float(value)

    def stop(self) -> None:
        """Stop the player."""
        self.stopped = True
        self._changed.set()

    # The player ------------------------------------------------------------------------------------------------

    @property
    def changed(self) -> bool:
        """Whether a parameter has been written since :meth:`take`, or the player should end."""
        return self._changed.is_set()

    def wait(self, timeout_s: float | None) -> None:
        """Wait for this long [s], or until a parameter is written."""
        self._changed.wait(timeout_s)

    def take(self) -> Wanted:
        """Return what the player should do now; each position is returned only once."""
        with self._lock:
            wanted, self._wanted = self._wanted, Wanted(self._wanted.paused, self._wanted.speed)
            if wanted.position_s is not None:  # clients may read it back before that moment is shown
                self.position_s = wanted.position_s
            if not self.stopped:
                self._changed.clear()
        return wanted

    def _want(self, *, paused: bool | None = None, speed: float | None = None, position_s: float | None = None) -> None:
        with self._lock:
            now = self._wanted
            self._wanted = Wanted(
                now.paused if paused is None else paused,
                now.speed if speed is None else speed,
                now.position_s if position_s is None else position_s,
            )
            self._changed.set()


# Publishing ----------------------------------------------------------------------------------------------------------

#: Events from the vehicle itself. All other events came from the recorded proxy or an application, and clients must not
#: mistake them for events about their own authority or commands.
_VEHICLES_OWN: Final = frozenset({EventKind.COLLISION, EventKind.VEHICLE_MESSAGE, EventKind.DRIVER_ERROR})
#: Events that the replay's own proxy emits itself.
_PROXYS_OWN: Final = frozenset({EventKind.STATE_CHANGED, EventKind.VEHICLE_LINK})
_LINKS: Final = frozenset({LinkState.UP, LinkState.DEGRADED, LinkState.LOST})
PREFIX: Final = "recorded."  #: prefix of recorded parameters' names


def _nothing(_: int) -> None:
    """Publish nothing, because no client wants this camera's frames."""


class ReplayPublisher:
    """Publishes samples to a sink, stamped on the replay's clock."""

    def __init__(self, sink: Sink, clock: Clock, playback: Playback, first_ns: int) -> None:
        self.frames = 0  #: number of frames published so far, including those without a subscriber
        self.damaged = 0
        self.loops = 0
        self.parameters: dict[str, Parameter] = {}
        self._sink = sink
        self._clock = clock
        self._playback = playback
        self._first_ns = first_ns
        self._link = LinkState.CONNECTING
        self._newest_ns: dict[str, int] = {}  # newest capture time by camera, which never goes backwards
        self._command: dict[str, Value] = {}

    def link(self, state: LinkState, reason: str = "") -> None:
        """Publish the state of the vehicle link if it has changed."""
        if state is not self._link:
            self._link = state
            self._sink.link(state, reason)

    def prepare(self, sample: TimedSample, timeline: Timeline) -> Callable[[], None]:
        """Do the slow work now; return a function that publishes the sample, to be called when it is due."""
        value = sample.value
        if isinstance(value, Feedback):
            return lambda: self.feedback(value, timeline, sample.at_ns)
        if isinstance(value, RecordedImage):
            show = self._decoded(value) if self._sink.wants(value.camera) else _nothing
            return lambda: self._picture(value, show, timeline)
        if isinstance(value, Event):
            return lambda: self._event(value)
        if isinstance(value, Applied):
            return lambda: self._command.update(described(value))
        return lambda: self.parameter(value)

    def parameter(self, parameter: Parameter) -> None:
        """Store a value, to be returned by :attr:`parameters` from now on."""
        name = PREFIX + parameter.name
        self.parameters[name] = msgspec.structs.replace(parameter, name=name, read_only=True)

    def still(self, moment: Moment) -> Callable[[], None]:
        """Return a function that publishes a moment's state and images with a common capture time.

        The function may be called repeatedly while the replay is paused; each image is decoded only once. The moment's
        command and parameters become the current ones.
        """
        self._command = {} if moment.command is None else described(moment.command)
        for parameter in moment.parameters:
            self.parameter(parameter)
        decoded: dict[str, Callable[[int], None]] = {}

        def publish() -> None:
            now_ns = self._clock()
            if moment.state is not None:
                at_capture = Timeline(1.0, moment.state.captured_ns, now_ns)
                self.feedback(moment.state, at_capture, moment.at_ns)
            for name, picture in moment.pictures.items():
                if self._sink.wants(name):
                    if name not in decoded:
                        decoded[name] = self._decoded(picture)
                    decoded[name](self._captured(name, now_ns, Timeline(1.0, now_ns, now_ns)))

        return publish

    def feedback(self, feedback: Feedback, timeline: Timeline, at_ns: int) -> None:
        """Publish the vehicle's feedback with this position, and the proxy's feedback as native telemetry."""
        if feedback.vehicle_link in _LINKS:
            self.link(feedback.vehicle_link, "as recorded")
        playback = self._playback
        playback.position_s = seconds(max(0, at_ns - self._first_ns))
        native: dict[str, Value] = {
            **(feedback.native or {}),
            POSITION: playback.position_s,
            "replay.duration_s": playback.duration_s,
            SPEED: playback.speed,
            PAUSED: playback.paused,
            "replay.jumps": playback.jumps,
            "replay.loops": self.loops,
            "replay.owner": feedback.owner or "",
            "replay.failsafe": feedback.failsafe.value,
            **self._command,
        }
        self._sink.feedback(
            Feedback(
                captured_ns=self._captured("", feedback.captured_ns, timeline),
                state=feedback.state,
                battery=feedback.battery,
                battery_v=feedback.battery_v,
                roll_rad=feedback.roll_rad,
                pitch_rad=feedback.pitch_rad,
                yaw_rad=feedback.yaw_rad,
                altitude_m=feedback.altitude_m,
                velocity_m_s=feedback.velocity_m_s,
                angular_velocity_rad_s=feedback.angular_velocity_rad_s,
                acceleration_m_s2=feedback.acceleration_m_s2,
                position_m=feedback.position_m,
                native=native,
            )
        )

    def _picture(self, picture: RecordedImage, show: Callable[[int], None], timeline: Timeline) -> None:
        self.frames += 1
        show(self._captured(picture.camera, picture.header.captured_ns, timeline))

    def _decoded(self, picture: RecordedImage) -> Callable[[int], None]:
        """Decode an image; return a function that publishes it with a given capture time or, if damaged, an event."""
        try:
            pixels, encoding = picture.as_recorded()
        except SkyloopError as error:
            self.damaged += 1
            text = str(error)
            return lambda _: self._sink.event(EventKind.DRIVER_ERROR, text, Severity.WARNING, where="frame")
        height, width = pixels.shape[:2]
        return lambda captured_ns: self._sink.frame(
            picture.camera,
            pixels,
            captured_ns,
            width=width,
            height=height,
            encoding=encoding,
            intrinsics=picture.header.intrinsics,
        )

    def _event(self, event: Event) -> None:
        if event.kind in _PROXYS_OWN:
            return
        if event.kind in _VEHICLES_OWN:
            self._sink.event(event.kind, event.text, event.severity, **event.data)
            return
        data: dict[str, Value] = {"recorded_kind": event.kind.value, "recorded_app": event.app or ""}
        self._sink.event(EventKind.VEHICLE_MESSAGE, f"recorded: {event.text}", event.severity, **data)

    def _captured(self, channel: str, recorded_ns: int, timeline: Timeline) -> int:
        captured_ns = min(timeline.at(recorded_ns), self._clock())
        captured_ns = max(captured_ns, self._newest_ns.get(channel, captured_ns))
        self._newest_ns[channel] = captured_ns
        return captured_ns


def described(applied: Applied) -> dict[str, Value]:
    """Return a recorded command as native telemetry, both as requested and as applied."""
    return {
        "replay.asked": applied.asked.name,
        "replay.asked.values": numbers(applied.asked),
        "replay.applied": applied.applied.name,
        "replay.applied.values": numbers(applied.applied),
    }


def numbers(action: AnyAction) -> tuple[float, ...]:
    """Return an action's numbers in field order, with NaN for a missing number such as a position's yaw."""
    given = (getattr(action, name) for name in action.__struct_fields__)
    return tuple(math.nan if number is None else float(number) for number in given)


HEARTBEAT_NS: Final = 50_000_000  #: interval at which the first state is repeated while waiting for a viewer
PAUSE_NS: Final = 50_000_000  #: pause between two passes, on the replay's clock
STILL_NS: Final = 200_000_000  #: interval at which the moment shown is repeated while paused
IDLE_S: Final = 3600.0  #: time-out of the wait at the end, which a written parameter ends
LATE_NS: Final = 250_000_000  #: lag beyond which the schedule is postponed instead of rushed through


class Player:
    """Plays in real time on the thread that calls :meth:`run`, controlled by its playback.

    ``wait`` waits for a number of seconds or until the playback changes; None to wait in real time.
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
        self._due: TimedSample | None = None  # the next sample, if a written parameter interrupted playing
        self._still: Callable[[], None] | None = None  # publishes the moment that is shown while paused
        self._damaged = 0  # number of damaged frames in earlier passes

    def run(self, wait_for: tuple[str, ...]) -> None:
        """Play until stopped, starting once a client wants one of these cameras, or at once if no cameras are given.

        At the end the link goes down; it comes up again if a viewer seeks back.
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
        """Apply a written parameter."""
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
        """Show one moment of the recording and continue from there."""
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
        """Publish the same moment again, so that late subscribers see it and the link does not appear to be lost."""
        if self._sleep_until(self._clock() + STILL_NS) and self._still is not None:
            self._still()

    def _play(self) -> None:
        """Publish samples until a parameter is written or the recording ends."""
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
        """Repeat the first state until a client wants a camera's frames or seeks in the replay."""
        first = self._source.first_feedback() or Feedback(captured_ns=self._source.begin_ns)
        while cameras and not any(map(self._sink.wants, cameras)):
            timeline = Timeline(1.0, first.captured_ns, self._clock())
            self.publisher.feedback(first, timeline, self._source.begin_ns)
            if not self._sleep_until(self._clock() + HEARTBEAT_NS):
                return

    def _sleep_until(self, due_ns: int) -> bool:
        """Wait until a given time. Return False at once if a parameter was written or the driver is closing."""
        while not self._playback.changed:
            left_ns = due_ns - self._clock()
            if left_ns <= 0:
                return True
            self._wait(seconds(left_ns))
        return False

    def _publish_damage(self, frames: int) -> None:
        damaged = [*self._source.damaged, *([f"{frames} frames can't be decoded"] if frames else [])]
        if damaged:
            text = f"parts of the recording can't be read: {'; '.join(damaged)}"
            self._sink.event(EventKind.VEHICLE_MESSAGE, text[:1000], Severity.WARNING, damaged=len(damaged))


class StepPlayer:
    """Plays on the recording's own clock, one sample per :meth:`step`, without skipping any."""

    def __init__(self, source: ReplaySource, sink: Sink, clock: Clock, playback: Playback) -> None:
        self._source = source
        self._sink = sink
        self.publisher = ReplayPublisher(sink, clock, playback, source.first_ns)
        self._timeline = Timeline(1.0, 0, 0)  # the replay uses the recording's clock
        self._samples: Iterator[TimedSample] = iter(())
        self._next: TimedSample | None = None

    @property
    def due_ns(self) -> int | None:
        """The time of the next sample [ns]; None after the last one."""
        return None if self._next is None else self._next.at_ns

    def begin(self) -> None:
        """Publish the link state and the first state, before the first sample."""
        for parameter in self._source.parameters():
            self.publisher.parameter(parameter)
        self.publisher.link(LinkState.UP)
        first = self._source.first_feedback()
        if first is not None:
            self.publisher.feedback(first, self._timeline, self._source.begin_ns)
        self._samples = self._source.samples()
        self._next = next(self._samples, None)

    def step(self) -> None:
        """Publish the next sample, which is now due. After the last sample, close the link."""
        sample = self._next
        if sample is None:
            raise UsageError("the recording is over")
        self.publisher.prepare(sample, self._timeline)()
        self._next = next(self._samples, None)
        if self._next is None:
            self._sink.link(LinkState.CLOSED, f"end of the recording after {self.publisher.frames} frames")

    def close(self) -> None:
        close: Callable[[], None] | None = getattr(self._samples, "close", None)
        if close is not None:
            close()
