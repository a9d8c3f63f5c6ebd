"""Measure the time to open, inspect, seek and export a recording of ten minutes.

The video is H.264 of a simulated flight, 640×360, with 30 pictures and one key picture a second. Half a minute of it is
drawn and encoded; the recording repeats that with the times of a whole flight.
"""

from __future__ import annotations

import math
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Final

import msgspec

from benchmarks.measuring.tables import Table
from skyloop.bench import BenchFlight, Machine
from skyloop.clock import NS_PER_S
from skyloop.messages import (
    Applied,
    CameraInfo,
    Capabilities,
    Encoding,
    Feedback,
    FlightState,
    FrameHeader,
    LinkState,
    Velocity,
)
from skyloop.messages.frame import H264
from skyloop.recording.backlog import Item, Rank
from skyloop.recording.layout import VERSION, Channel, ClockPair, DroneRecord, End, FrameRecord, Start, to_plain
from skyloop.recording.reader import Recording
from skyloop.recording.review.report import write_report
from skyloop.recording.review.summary import summarise
from skyloop.recording.review.tables import export_csv, read
from skyloop.recording.review.video import export_mp4
from skyloop.recording.translation import TranslatedImage, Translator
from skyloop.recording.writer import RecordingFile
from skyloop.sim.camera import FRONT_CAMERA
from skyloop.vehicles.ardrone.emulator.video import H264_360P
from skyloop.vehicles.emulation.video import Encoded, Encoder
from skyloop.vehicles.replay.source import ReplaySource

FPS: Final = 30
FEEDBACK_HZ: Final = 50
COMMAND_HZ: Final = 32
DRAWN_S: Final = 30  #: duration of the drawn video
BITRATE_KBPS: Final = 2000
EXPORT_TARGET_S: Final = 5.0  #: target for a flight of ten minutes
DRONE: Final = "alpha"
CAMERA: Final = "front"

Progress = Callable[[float], None]
_CAPABILITIES: Final = Capabilities(
    "sim",
    frozenset({"takeoff", "land", "velocity"}),
    (CameraInfo(CAMERA, H264_360P.width, H264_360P.height, float(FPS), stream=H264),),
    "a simulated quadrotor",
)


class RecordingRow(msgspec.Struct, frozen=True):
    """An operation on the recording. ``target_s`` applies to elapsed time."""

    what: str
    passed_s: float
    processor_s: float
    target_s: float | None = None


class Recordings(msgspec.Struct, frozen=True):
    """A whole run, as in ``recordings.json``."""

    machine: Machine
    seconds: float  #: duration of the recorded flight
    frames: int
    bytes: int  #: size of the file
    rows: list[RecordingRow]


def measure(seconds: float, *, encode: bool = True, progress: Progress = lambda _: None) -> Recordings:
    """Write a recording to a temporary folder, and measure operations on it in the calling thread.

    Args:
        seconds: Duration of the recorded flight [s].
        encode: Whether to also measure the export that decodes and encodes each picture.
        progress: Called with the fraction done, 0 to 1.
    """
    machine = Machine.here()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "flight.mcap"
        write_recording(path, seconds, drawn(min(seconds, DRAWN_S)))
        progress(0.2)
        recording = Recording.open(path)
        drone = recording.drone(DRONE)
        middle_ns = round(seconds / 2 * NS_PER_S)

        def seek() -> None:
            source = ReplaySource(recording, drone)
            moment = source.moment(source.first_ns + middle_ns)
            next(moment.following)
            moment.pictures[CAMERA].pixels()

        mp4 = Path(folder) / "front.mp4"
        work: list[tuple[str, Callable[[], object], float | None]] = [
            ("open", lambda: Recording.open(path), None),
            ("a replay's seek to the middle", seek, None),
            ("log info", lambda: summarise(recording), None),
            ("log report", lambda: write_report(recording, DRONE, Path(folder) / "report.html"), None),
            ("log export --to csv", lambda: export_csv(read(recording, DRONE, None), Path(folder) / "csv"), None),
            (
                "log export --to mp4",
                lambda: export_mp4(recording, DRONE, CAMERA, mp4),
                EXPORT_TARGET_S * seconds / 600,
            ),
        ]
        if encode:
            burn = lambda: export_mp4(recording, DRONE, CAMERA, mp4, burn_time=True)  # noqa: E731
            work.append(("log export --to mp4 --burn-time", burn, None))
        rows = []
        for number, (what, call, target_s) in enumerate(work, 1):
            rows.append(_timed(what, call, target_s))
            progress(0.2 + 0.8 * number / len(work))
        return Recordings(machine, seconds, round(seconds * FPS), path.stat().st_size, rows)


def drawn(seconds: float) -> list[Encoded]:
    """Draw and encode the view of a circling drone's camera."""
    flight = BenchFlight(1, [(0, FRONT_CAMERA.scaled(2.0))])
    encoder = Encoder(H264_360P, FPS, BITRATE_KBPS, group=FPS)
    units = []
    for _ in range(max(FPS, round(seconds) * FPS)):
        flight.draw(0)
        unit = encoder.encode(flight.picture[: flight.picture.shape[1] * H264_360P.height // H264_360P.width])
        assert unit is not None  # the encoder has no delay, so each picture yields one at once
        units.append(unit)
    return units


def write_recording(path: Path, seconds: float, units: Sequence[Encoded]) -> None:
    """Write a flight as the recorder does: the same messages, and a chunk every half second.

    Args:
        path: The file.
        seconds: Duration of the flight [s].
        units: The encoded pictures, repeated as needed. The first is a key picture.
    """
    clock = ClockPair(NS_PER_S, 1_760_000_000 * NS_PER_S, 1)
    translator = Translator(DRONE, _CAPABILITIES, clock)
    start = Start(VERSION, "benchmark", (DroneRecord(DRONE, "sim://", to_plain(_CAPABILITIES)),), clock.unix_ns)
    file = RecordingFile(path, start, clock)
    commit_ns = 0
    for item in _items(clock.monotonic_ns, seconds, units):
        for message in translator.messages(item):
            file.write(message)
        if item.received_ns >= commit_ns:
            commit_ns = item.received_ns + NS_PER_S // 2
            file.commit()
    file.close(End("closed", clock.unix_ns + round(seconds * NS_PER_S), dict(file.written)))


def _items(begin_ns: int, seconds: float, units: Sequence[Encoded]) -> Iterator[Item]:
    """Yield a flight's samples in order of time."""
    times = [
        (number * NS_PER_S // rate, kind, number)
        for kind, rate in ((Channel.FEEDBACK, FEEDBACK_HZ), (Channel.COMMANDS, COMMAND_HZ), (Channel.FRAMES, FPS))
        for number in range(round(seconds * rate))
    ]
    for passed_ns, kind, number in sorted(times):
        at_ns = begin_ns + passed_ns
        if kind is Channel.FEEDBACK:
            yield Item(0, "feedback", Rank.STATE, at_ns, _feedback(at_ns, number), 400)
        elif kind is Channel.COMMANDS:
            wanted = Velocity(0.5, 0.1 * math.sin(number / 50), 0.0, 0.2)
            yield Item(0, "commands", Rank.KEPT, at_ns, Applied(number, 2, 1, at_ns, at_ns, wanted, wanted), 400)
        else:
            unit = units[number % len(units)]
            form = H264_360P
            size = form.width * form.height * 3
            header = FrameHeader(CAMERA, number + 1, at_ns, at_ns, form.width, form.height, Encoding.BGR8, size)
            picture = TranslatedImage(FrameRecord(header, at_ns, H264, unit.key), unit.payload)
            yield Item(0, f"video.{CAMERA}", Rank.FRAME, at_ns, picture, len(unit.payload))


def _feedback(at_ns: int, number: int) -> Feedback:
    angle = number / FEEDBACK_HZ * 0.5
    return Feedback(
        captured_ns=at_ns,
        state=FlightState.FLYING,
        battery=0.8,
        roll_rad=0.1 * math.sin(angle),
        pitch_rad=0.1 * math.cos(angle),
        yaw_rad=math.remainder(angle, math.tau),
        altitude_m=1.2,
        velocity_m_s=(0.5, 0.1 * math.sin(angle), 0.0),
        position_m=(math.cos(angle), math.sin(angle), 1.2),
        seq=number + 1,
        published_ns=at_ns,
        vehicle_link=LinkState.UP,
    )


def _timed(what: str, call: Callable[[], object], target_s: float | None) -> RecordingRow:
    begin, processor = time.perf_counter(), time.process_time()
    call()
    return RecordingRow(what, time.perf_counter() - begin, time.process_time() - processor, target_s)


def table(results: Recordings) -> Table:
    """Return the figures as a table."""
    rows = [
        [
            row.what,
            f"{row.passed_s:.2f}",
            f"{row.processor_s:.2f}",
            "" if row.target_s is None else f"< {row.target_s:.0f} s",
        ]
        for row in results.rows
    ]
    title = f"{results.seconds:.0f} s of flight, {results.frames} frames of H.264, {results.bytes / 1e6:.0f} MB"
    return Table(title, ["", "passed, s", "processor, s", "target"], rows)


if __name__ == "__main__":
    from benchmarks.command import main

    main("recordings")
