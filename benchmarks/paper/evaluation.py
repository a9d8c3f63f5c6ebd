"""Evaluate the recording of the experiment."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import msgspec
import numpy as np
from numpy.typing import NDArray

from benchmarks.measuring.contenders import OURS
from benchmarks.measuring.delays import Cell, Delays, Series
from benchmarks.measuring.schedule import COMMAND, FEEDBACK, FRAME_PERIOD_S, PACKET_PERIOD_S, VIDEO, Size
from benchmarks.measuring.statistics import summarize
from benchmarks.paper.marks import APPLICATION, CORNERS, FEEDBACK_HEARD, TARGET, VIDEO_HEARD
from skyloop.bench import Machine
from skyloop.clock import NS_PER_S
from skyloop.errors import FileFormatError
from skyloop.files import MAX_RESULTS, read_json
from skyloop.messages import Applied, Event, EventKind, Feedback, Idle, LogEntry
from skyloop.messages.relayed import MOCAP
from skyloop.recording.layout import Channel, FrameRecord
from skyloop.recording.reader import Item, Progress, Recording

Floats = NDArray[np.float64]
RECORDER: Final = "recorder"  #: the name of the recorder's own delays beside ours
_PERIODS_S: Final = {COMMAND: PACKET_PERIOD_S, FEEDBACK: PACKET_PERIOD_S, VIDEO: FRAME_PERIOD_S}
_CHANNELS: Final = (Channel.FEEDBACK, Channel.COMMANDS, Channel.EVENTS, Channel.FRAMES, Channel.LOGS)


class Tracking(msgspec.Struct, frozen=True):
    """The true accuracy along the path [m], excluding the time in which others flew."""

    samples: int
    rms_m: float  #: RMS distance from the planned position at that time
    largest_m: float
    across_rms_m: float  #: RMS distance to the nearest point of the round
    across_largest_m: float
    waypoints: int  #: number of waypoints reached


class Way(msgspec.Struct, frozen=True):
    """The path from above, and the error over time, for the diagrams."""

    at_s: list[float]  #: since the beginning
    x: list[float]  #: true position, world axes [m]
    y: list[float]
    off_at_s: list[float]
    off_m: list[float]


class Experiment(msgspec.Struct, frozen=True, tag_field="what", tag="paper"):
    """All figures of a run, as in ``results.json``."""

    vehicle: str  #: the vehicle's address
    seconds: float  #: of the experiment, between the first and the last stamp
    delays: Delays  #: at the controller (named ``skyloop``) and at the recorder
    deviation_us: dict[str, float]  #: standard deviation of the controller's delays, by channel
    tracking: Tracking | None  #: None if the drone never flew the path
    way: Way
    takeovers: int  #: number of takeovers by others
    load: float | None = None  #: load average in the last minute


@dataclass(slots=True)
class DelaySamples:
    """The sending time, delay and number of each sample of one channel."""

    sent_ns: list[int] = field(default_factory=list)
    delay_ns: list[int] = field(default_factory=list)
    seq: list[int] = field(default_factory=list)

    def add(self, sent_ns: float, delay_ns: float, seq: float) -> None:
        """Add a sample."""
        self.sent_ns.append(int(sent_ns))
        self.delay_ns.append(int(delay_ns))
        self.seq.append(int(seq))

    def within(self, first_ns: int, last_ns: int) -> DelaySamples:
        """Return the samples sent between two times [ns]."""
        found = DelaySamples()
        for row in zip(self.sent_ns, self.delay_ns, self.seq, strict=True):
            if first_ns <= row[0] <= last_ns:
                found.add(*row)
        return found


@dataclass(slots=True)
class _Gathered:
    """The samples found in one pass through the recording."""

    application: int | None = None
    received: dict[str, DelaySamples] = field(
        default_factory=lambda: {name: DelaySamples() for name in (COMMAND, FEEDBACK, VIDEO)}
    )
    recorded: dict[str, DelaySamples] = field(default_factory=lambda: {FEEDBACK: DelaySamples(), VIDEO: DelaySamples()})
    echoes: list[Applied] = field(default_factory=list)
    targets: list[tuple[int, tuple[float, ...]]] = field(default_factory=list)
    poses: list[tuple[int, tuple[float, ...]]] = field(default_factory=list)
    size: Size | None = None
    preempted: list[Any] = field(default_factory=list)


def evaluate(
    path: str | Path, machine: Machine | None = None, load: float | None = None, progress: Progress | None = None
) -> Experiment:
    """Evaluate a recorded experiment.

    Args:
        path: The recording.
        machine: The machine that the experiment ran on (default: this one).
        load: The machine's load at the end.
        progress: Called while the recording is read.

    Raises:
        FileFormatError: The file is not a recording of the experiment, or lacks the application's log.
    """
    recording = Recording.open(path)
    known = recording.drone()
    found = _gather(recording, known.name, known.clock_offset_ns, progress)
    received = found.received
    if found.application is None or found.size is None or not received[FEEDBACK].sent_ns:
        raise FileFormatError(
            f"{path} is not a recording of the paper's experiment: python -m benchmarks.paper makes one"
        )
    for echo in found.echoes:
        if echo.app_id == found.application and not isinstance(echo.asked, Idle):
            received[COMMAND].add(echo.sent_ns, echo.applied_ns - echo.sent_ns, echo.seq)
    first_ns, last_ns = received[FEEDBACK].sent_ns[0], received[FEEDBACK].sent_ns[-1]
    received = {name: samples.within(first_ns, last_ns) for name, samples in received.items()}
    recorded = {name: samples.within(first_ns, last_ns) for name, samples in found.recorded.items()}
    size = str(found.size)
    delays = Delays(
        machine=machine or Machine.here(),
        seconds=(last_ns - first_ns) / NS_PER_S,
        sizes=[size],
        contenders={OURS.name: "at the controller", RECORDER: "at the recorder"},
        versions={},
        skipped={},
        cells=[*_cells(OURS.name, size, received), *_cells(RECORDER, size, recorded)],
        series=[_series(name, samples, first_ns) for name, samples in received.items() if samples.delay_ns],
    )
    way, tracking = _track(found, first_ns, last_ns)
    return Experiment(
        vehicle=known.uri,
        seconds=delays.seconds,
        delays=delays,
        deviation_us={one.channel: float(np.std(one.delay_us)) for one in delays.series},
        tracking=tracking,
        way=way,
        takeovers=sum(data.get("app_id") == found.application for data in found.preempted),
        load=load,
    )


def load(path: Path) -> Experiment:
    """Read ``results.json``.

    Raises:
        FileFormatError: The file has another format.
    """
    return read_json(path, Experiment, "the results of the experiment", MAX_RESULTS)


# Reading ---------------------------------------------------------------------------------------------------------


def _gather(recording: Recording, drone: str, offset_ns: int, progress: Progress | None) -> _Gathered:
    found = _Gathered()

    def received_ns(item: Item) -> int:
        return recording.clock.monotonic(item.entry.log_ns, offset_ns)

    for item in recording.items(drone, _CHANNELS, progress=progress):
        value = item.value
        if isinstance(value, Applied):
            found.echoes.append(value)
        elif isinstance(value, Feedback):
            delay_ns = received_ns(item) - value.published_ns
            found.recorded[FEEDBACK].add(value.published_ns, delay_ns, value.seq)
        elif isinstance(value, FrameRecord):
            header = value.header
            found.size = Size(header.width, header.height)
            found.recorded[VIDEO].add(header.published_ns, received_ns(item) - header.published_ns, header.seq)
        elif isinstance(value, Event):
            if value.kind is EventKind.AUTHORITY_PREEMPTED:
                found.preempted.append(value.data)
        elif isinstance(value, LogEntry):
            _logged(found, value)
    return found


def _logged(found: _Gathered, entry: LogEntry) -> None:
    if entry.name == APPLICATION and entry.number is not None:
        found.application = int(entry.number)
    elif entry.values is None:
        return
    elif entry.name in (FEEDBACK_HEARD, VIDEO_HEARD):
        channel = FEEDBACK if entry.name == FEEDBACK_HEARD else VIDEO
        for row in np.reshape(entry.values, (-1, 3)):
            found.received[channel].add(*row)
    elif entry.name == TARGET:
        found.targets.append((entry.at_ns, entry.values))
    elif entry.name == MOCAP:
        found.poses.append((entry.at_ns, entry.values))


# Delays ----------------------------------------------------------------------------------------------------------


def _cells(name: str, size: str, received: dict[str, DelaySamples]) -> list[Cell]:
    cells = []
    for channel, samples in received.items():
        if samples.delay_ns:
            summary = summarize(samples.delay_ns, sent=numbered(samples.seq, channel), period_s=_PERIODS_S[channel])
            cells.append(Cell(name, size, channel, summary))
    return cells


def numbered(seq: Sequence[int], channel: str) -> int:
    """Return the number of samples sent, judging by their numbers.

    For commands, return the number that arrived, because their numbers also count keep-alive packets.
    """
    return len(seq) if channel == COMMAND else max(seq) - min(seq) + 1


def _series(channel: str, samples: DelaySamples, first_ns: int) -> Series:
    at_s = [round((sent_ns - first_ns) / NS_PER_S, 3) for sent_ns in samples.sent_ns]
    return Series(channel, at_s, [round(delay_ns / 1e3, 1) for delay_ns in samples.delay_ns])


# The path --------------------------------------------------------------------------------------------------------


def _track(found: _Gathered, first_ns: int, last_ns: int) -> tuple[Way, Tracking | None]:
    poses = sorted((at_ns, values) for at_ns, values in found.poses if first_ns <= at_ns <= last_ns)
    pose_s = _seconds([at_ns for at_ns, _ in poses], first_ns)
    places = np.array([values[:3] for _, values in poses]).reshape(-1, 3)
    targets = sorted((at_ns, values) for at_ns, values in found.targets if first_ns <= at_ns <= last_ns)
    if not poses or not targets:
        return Way(_rounded(pose_s), *_columns(places), [], []), None
    at_s = _seconds([at_ns for at_ns, _ in targets], first_ns)
    wanted = np.array([values for _, values in targets])
    truth = np.column_stack([np.interp(at_s, pose_s, places[:, axis]) for axis in range(3)])
    off_m = np.linalg.norm(truth - wanted[:, :3], axis=1)
    on_round = truth[wanted[:, 3] >= 1.0]
    across_m = distances_to_round(on_round) if len(on_round) else np.zeros(1)
    tracking = Tracking(
        samples=len(off_m),
        rms_m=_rms(off_m),
        largest_m=float(off_m.max()),
        across_rms_m=_rms(across_m),
        across_largest_m=float(across_m.max()),
        waypoints=int(wanted[:, 3].max()),
    )
    return Way(_rounded(pose_s), *_columns(places), _rounded(at_s), _rounded(off_m)), tracking


def distances_to_round(places: Floats) -> Floats:
    """Return the distances from positions to the closed line through the corners [m].

    Args:
        places: Shape (n, 3), in world axes [m].

    Returns:
        Shape (n,), float64.
    """
    corners = np.array(CORNERS)
    legs = zip(corners, np.roll(corners, -1, axis=0), strict=True)
    distances: Floats = np.min([_to_leg(places, begin, end) for begin, end in legs], axis=0)
    return distances


def _to_leg(places: Floats, begin: Floats, end: Floats) -> Floats:
    along = end - begin
    share = np.clip((places - begin) @ along / (along @ along), 0.0, 1.0)
    distances: Floats = np.linalg.norm(places - (begin + share[:, None] * along), axis=1)
    return distances


def _seconds(times_ns: Iterable[int], first_ns: int) -> Floats:
    return np.array([(at_ns - first_ns) / NS_PER_S for at_ns in times_ns])


def _rms(values: Floats) -> float:
    return math.sqrt(float((values**2).mean()))


def _columns(places: Floats) -> tuple[list[float], list[float]]:
    return _rounded(places[:, 0]), _rounded(places[:, 1])


def _rounded(values: Floats) -> list[float]:
    rounded: list[float] = np.round(values, 4).tolist()
    return rounded
