"""The samples that a recording holds of one drone, in order, and their times in a replay."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import takewhile
from typing import Final

from skyloop.clock import nanoseconds
from skyloop.logfile.layout import Channel, DroneRecord
from skyloop.logfile.pictures import Picture
from skyloop.logfile.reader import Item, Recording
from skyloop.logfile.times import Course
from skyloop.messages import Applied, CameraInfo, Capabilities, Encoding, Event, Feedback, Parameter

#: What is replayed. Annotations and logs are an application's own: it makes new ones.
CHANNELS: Final = (Channel.FEEDBACK, Channel.FRAMES, Channel.EVENTS, Channel.COMMANDS, Channel.PARAMETERS)

Sample = Feedback | Picture | Event | Applied | Parameter


@dataclass(frozen=True, slots=True)
class TimedSample:
    """A sample, and when the recorded proxy knew of it, on that proxy's clock [ns]."""

    at_ns: int
    value: Sample


class ReplaySource:
    """A drone's recording, from ``start_s`` after its begin on."""

    def __init__(self, recording: Recording, drone: DroneRecord, start_s: float = 0.0) -> None:
        self._recording = recording
        self._drone = drone
        self.begin_ns = 0  #: on the clock of the recorded proxy
        timed = (sample.at_ns for sample in self.samples() if not isinstance(sample.value, Parameter))
        first_ns = next(timed, None)
        if first_ns is not None:
            self.begin_ns = first_ns + nanoseconds(start_s)

    @property
    def empty(self) -> bool:
        """Whether it holds nothing after :attr:`begin_ns`."""
        return not any(sample.at_ns > self.begin_ns for sample in self.samples())

    @property
    def damaged(self) -> list[str]:
        """What of it could not be read, for people."""
        cut = self._recording.cut
        return [*([f"the file was cut off: {cut}"] if cut else []), *self._recording.damaged]

    def first_feedback(self) -> Feedback | None:
        """Return the first state; None if the recording holds none."""
        return next((sample.value for sample in self.samples() if isinstance(sample.value, Feedback)), None)

    def parameters(self) -> list[Parameter]:
        """Return the parameters known at :attr:`begin_ns`."""
        early = takewhile(lambda sample: sample.at_ns <= self.begin_ns, self.samples())
        return [sample.value for sample in early if isinstance(sample.value, Parameter)]

    def samples(self) -> Iterator[TimedSample]:
        """Yield everything in the order in which it was received; times never go backwards."""
        course = Course()
        for found in self._recording.items_and_pictures(self._drone.name, CHANNELS):
            value = found.value if isinstance(found, Item) else found
            at_ns = course.follow(value)
            if isinstance(value, Parameter):  # those from before the begin are still in force
                yield TimedSample(max(at_ns, self.begin_ns), value)
            elif at_ns >= self.begin_ns:
                yield TimedSample(at_ns, value)


def capabilities_of(recording: Recording, drone: DroneRecord) -> Capabilities:
    """Describe a replay as a vehicle.

    It has the cameras of which frames were recorded, and accepts every command if the recorded vehicle accepted any,
    natively or through the software autopilot.
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
    """Maps the clock of the recording to the clock of its replay. Pure.

    Args:
        speed: Seconds of the recording in a second.
        begin_ns: Where the replay begins, on the recording's clock.
        origin_ns: The same on the replay's clock.
    """

    def __init__(self, speed: float, begin_ns: int, origin_ns: int) -> None:
        """Store the arguments."""
        self._speed = speed
        self._begin_ns = begin_ns
        self._origin_ns = origin_ns

    def at(self, recorded_ns: int) -> int:
        """Return the time on the replay's clock [ns]."""
        passed_ns = recorded_ns - self._begin_ns
        return self._origin_ns + (passed_ns if self._speed == 1.0 else round(passed_ns / self._speed))

    def put_off(self, ns: int) -> None:
        """Delay everything still to come [ns]."""
        self._origin_ns += ns
