"""One drone's samples in a recording, in order, and their times in a replay."""

from __future__ import annotations

from bisect import bisect_right
from collections import deque
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from itertools import chain, takewhile
from typing import Final

from skyloop.clock import nanoseconds, seconds
from skyloop.messages import Applied, CameraInfo, Capabilities, Encoding, Event, Feedback, Parameter
from skyloop.recording.layout import Channel, DroneRecord
from skyloop.recording.pictures import RecordedImage
from skyloop.recording.plain import TimeCourse, shifted
from skyloop.recording.reader import Item, Recording

#: Channels that are replayed. Annotations and logs are not replayed, because applications create new ones.
CHANNELS: Final = (Channel.FEEDBACK, Channel.FRAMES, Channel.EVENTS, Channel.COMMANDS, Channel.PARAMETERS)

_SAME_CLOCK_NS: Final = nanoseconds(5.0)  #: tolerance within which two clocks that were not reset advance equally
Sample = Feedback | RecordedImage | Event | Applied | Parameter


@dataclass(frozen=True, slots=True)
class TimedSample:
    """A sample, and the time at which the recorded proxy received it, on that proxy's clock [ns]."""

    at_ns: int
    value: Sample


@dataclass(slots=True)
class Moment:
    """A drone's state at a given time in its recording, and the samples that follow."""

    at_ns: int
    state: Feedback | None = None  #: state when the images were captured, or the newest state if there are no images
    pictures: dict[str, RecordedImage] = field(default_factory=dict)  #: the newest image from each camera
    command: Applied | None = None
    parameters: list[Parameter] = field(default_factory=list)  #: parameters received shortly before the moment
    following: Iterator[TimedSample] = field(default_factory=lambda: iter(()))

    def shows(self, cameras: list[str]) -> bool:
        """Return whether there is a state, and a decodable image from each camera."""
        found = {name for name, picture in self.pictures.items() if picture.can_be_decoded}
        return self.state is not None and found.issuperset(cameras)


#: Numbers of parts of the file (about half a second each) to read before the time sought. They are tried in turn until
#: each camera has an image. A camera that has no image in any of these parts stays blank.
_PARTS_BEFORE: Final = (1, 4, 16)
_KEPT_STATES: Final = 500  #: number of states kept before the time sought, to find the one that matches the images


class ReplaySource:
    """A drone's recording, replayed from ``start_s`` after its beginning."""

    def __init__(self, recording: Recording, drone: DroneRecord, start_s: float = 0.0) -> None:
        self._recording = recording
        self._drone = drone
        self._cameras = recording.cameras(drone.name)
        self._known_ns: dict[int, int] = {}  # time of the first sample in each part of the file known so far
        self.begin_ns = 0  #: start of the replay, on the recorded proxy's clock
        timed = (sample.at_ns for sample in self.samples() if not isinstance(sample.value, Parameter))
        self.first_ns = next(timed, 0)  #: start of the recording itself
        if self.first_ns:
            self.begin_ns = self.first_ns + nanoseconds(start_s)

    @property
    def seconds(self) -> float:
        """Duration of the recording from this drone's first sample to its last [s]."""
        return seconds(max(0, self.end_ns - self.first_ns))

    @cached_property
    def end_ns(self) -> int:
        """Time of the last sample."""
        parts = self._recording.found.pieces
        for back in (1, 4, 16, 256, len(parts)):
            newest_ns = max((sample.at_ns for sample in self._timed(self._log_ns(len(parts) - back))), default=0)
            if newest_ns or back >= len(parts):
                return max(newest_ns, self.first_ns)
        return self.first_ns

    def moment(self, at_ns: int) -> Moment:
        """Return the moment at a time on the recorded proxy's clock, reading only the nearby parts of the file."""
        parts = range(len(self._recording.found.pieces))
        part = bisect_right(parts, at_ns, key=self._first_known_ns) - 1
        moment = Moment(at_ns)
        for back in _PARTS_BEFORE:
            moment = self._moment(at_ns, self._log_ns(part - back))
            if moment.shows(self._cameras) or part <= back:
                break
        return moment

    @property
    def empty(self) -> bool:
        """Whether there are no samples after :attr:`begin_ns`."""
        return not any(sample.at_ns > self.begin_ns for sample in self.samples())

    @property
    def damaged(self) -> list[str]:
        """Descriptions of the unreadable parts."""
        cut = self._recording.cut
        return [*([f"the file was cut off: {cut}"] if cut else []), *self._recording.damaged]

    def first_feedback(self) -> Feedback | None:
        """Return the first state; None if there is none."""
        return next((sample.value for sample in self.samples() if isinstance(sample.value, Feedback)), None)

    def parameters(self) -> list[Parameter]:
        """Return the parameters known at :attr:`begin_ns`."""
        early = takewhile(lambda sample: sample.at_ns <= self.begin_ns, self.samples())
        return [sample.value for sample in early if isinstance(sample.value, Parameter)]

    def samples(self) -> Iterator[TimedSample]:
        """Yield all samples in order of arrival; their times never go backwards."""
        for sample in self._timed(0):
            if isinstance(sample.value, Parameter):  # earlier parameters still apply
                yield TimedSample(max(sample.at_ns, self.begin_ns), sample.value)
            elif sample.at_ns >= self.begin_ns:
                yield sample

    # Internals -------------------------------------------------------------------------------------------------

    def _timed(self, log_ns: int) -> Iterator[TimedSample]:
        """Yield the samples received at the given log time or later."""
        resets = self._resets if log_ns else []  # when reading from the beginning, restarts are found along the way
        earlier = bisect_right(resets, log_ns, key=lambda reset: reset[0])
        course = TimeCourse(resets[earlier - 1][1] if earlier else 0)
        for found in self._recording.items_and_pictures(self._drone.name, CHANNELS, from_ns=log_ns):
            value, at_log_ns = (found.value, found.entry.log_ns) if isinstance(found, Item) else (found, found.log_ns)
            at_ns = course.follow(value, at_log_ns)
            yield TimedSample(at_ns, shifted(value, course.shift_ns) if course.shift_ns else value)

    @cached_property
    def _resets(self) -> list[tuple[int, int]]:
        """Log times at which the proxy's clock restarted, each with the clock's offset from then on."""
        last_part = self._log_ns(len(self._recording.found.pieces) - 1)
        first, last = (
            next(self._recording.items(self._drone.name, (Channel.FEEDBACK,), from_ns=at_ns), None)
            for at_ns in (0, last_part)
        )
        if first is None or last is None:
            return []
        passed_ns = last.value.published_ns - first.value.published_ns
        if abs(passed_ns - (last.entry.log_ns - first.entry.log_ns)) < _SAME_CLOCK_NS:
            return []  # avoids reading the whole file
        found, course = [], TimeCourse()
        for item in self._recording.items(self._drone.name, (Channel.FEEDBACK,)):
            before_ns = course.shift_ns
            course.follow(item.value, item.entry.log_ns)
            if course.shift_ns != before_ns:
                found.append((item.entry.log_ns, course.shift_ns))
        return found

    def _log_ns(self, part: int) -> int:
        """Return the log time at which a part of the file starts."""
        return self._recording.found.pieces[part].start_ns if part > 0 else 0

    def _first_known_ns(self, part: int) -> int:
        """Return the time of the first timed sample in or after a part of the file."""
        if part not in self._known_ns:
            timed = (sample.at_ns for sample in self._timed(self._log_ns(part)) if sample.at_ns)
            self._known_ns[part] = next(timed, _NEVER_NS)
        return self._known_ns[part]

    def _moment(self, at_ns: int, log_ns: int) -> Moment:
        """Build the moment at a given time from the samples received since ``log_ns``."""
        moment = Moment(at_ns)
        states: deque[Feedback] = deque(maxlen=_KEPT_STATES)
        samples = self._timed(log_ns)
        for sample in samples:
            value = sample.value
            if sample.at_ns > at_ns:
                moment.following = chain((sample,), samples)
                break
            if isinstance(value, Feedback):
                states.append(value)
            elif isinstance(value, RecordedImage):
                moment.pictures[value.camera] = value
            elif isinstance(value, Applied):
                moment.command = value
            elif isinstance(value, Parameter):
                moment.parameters.append(value)
        moment.state = _state_of(states, moment.pictures)
        return moment


_NEVER_NS: Final = 1 << 63  # later than any time of a sample


def _state_of(states: Collection[Feedback], pictures: Mapping[str, RecordedImage]) -> Feedback | None:
    """Return the state when the newest image was captured, so that state and image match."""
    if not states:
        return None
    newest_ns = max(state.captured_ns for state in states)
    seen_ns = max((picture.header.captured_ns for picture in pictures.values()), default=newest_ns)
    return min(states, key=lambda state: abs(state.captured_ns - seen_ns))


def capabilities_of(recording: Recording, drone: DroneRecord) -> Capabilities:
    """Return the capabilities of a replay.

    The vehicle's cameras are those with recorded frames. A replay accepts every command if the recorded vehicle
    accepted any, natively or through the software autopilot.
    """
    was = drone.described
    known = {camera.name: camera for camera in was.cameras}
    return Capabilities(
        vehicle="replay",
        actions=was.actions and frozenset(_ACTIONS),
        cameras=tuple(_camera(recording, drone.name, name, known.get(name)) for name in recording.cameras(drone.name)),
        description=f"recording of {drone.name}: {was.description or was.vehicle}",
        why_not=was.why_not,
    )


_ACTIONS: Final = (
    *("takeoff", "land", "hover", "velocity", "attitude", "position"),
    *("emergency_stop", "reset_emergency"),
)


def _camera(recording: Recording, drone: str, name: str, known: CameraInfo | None) -> CameraInfo:
    first = next(recording.pictures(drone, name), None)
    if first is None:
        return known or CameraInfo(name, 1, 1, 1.0)
    header = first.header
    encoding = header.encoding if header.encoding in (Encoding.RGB8, Encoding.MONO8) else Encoding.BGR8
    return CameraInfo(
        name,
        header.width,
        header.height,
        known.fps if known is not None else 30.0,
        encoding,
        header.intrinsics or (known.intrinsics if known is not None else None),
        known.rotation if known is not None else None,
        known.position_m if known is not None else None,
    )


class Timeline:
    """Converts between the recording's clock and the replay's. Pure."""

    def __init__(self, speed: float, begin_ns: int, origin_ns: int) -> None:
        """Make ``begin_ns`` on the recording's clock correspond to ``origin_ns`` on the replay's clock."""
        self._speed = speed
        self._begin_ns = begin_ns
        self._origin_ns = origin_ns

    def at(self, recorded_ns: int) -> int:
        """Return the time on the replay's clock [ns]."""
        passed_ns = recorded_ns - self._begin_ns
        return self._origin_ns + (passed_ns if self._speed == 1.0 else round(passed_ns / self._speed))

    def recorded(self, now_ns: int) -> int:
        """Return the time on the recording's clock [ns]; this is the inverse of :meth:`at`."""
        passed_ns = now_ns - self._origin_ns
        return self._begin_ns + (passed_ns if self._speed == 1.0 else round(passed_ns * self._speed))

    def put_off(self, ns: int) -> None:
        """Delay everything that follows by ``ns``."""
        self._origin_ns += ns

    def set_speed(self, speed: float, now_ns: int) -> None:
        """Change the speed from now on."""
        self._begin_ns, self._origin_ns = self.recorded(now_ns), now_ns
        self._speed = speed

    def restart(self, begin_ns: int, origin_ns: int) -> None:
        """Continue from another time in the recording at the same speed."""
        self._begin_ns, self._origin_ns = begin_ns, origin_ns
