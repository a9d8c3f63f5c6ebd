"""Rerun's input, with a stand-in for its module; and with its own programs, where installed.

The latter use the Python in SKYLOOP_RERUN, whose environment has rerun-sdk and Skyloop, or this one.
"""

from __future__ import annotations

import math
import os
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path

import pytest

import skyloop
from skyloop.errors import LinkError, MissingExtraError, UnknownNameError, UsageError
from skyloop.messages import (
    Annotation,
    Applied,
    Encoding,
    Feedback,
    FrameHeader,
    LogEntry,
    Points,
    Polyline,
    Position,
    ReturnToStart,
)
from skyloop.messages.frame import H264
from skyloop.messages.relayed import Text
from skyloop.recording import rerun_viewer
from skyloop.recording.backlog import Item, Rank
from skyloop.recording.layout import FrameRecord
from skyloop.recording.reader import Recording
from skyloop.recording.rerun_viewer import RerunLog, RerunViewer, Shown, export_rrd
from skyloop.recording.taps import View
from skyloop.recording.translation import TranslatedImage
from tests.recording.live.conftest import Fly
from tests.recording.streams import film, write_film
from tests.support import fake_rerun
from tests.support.commands import Ended
from tests.support.fake_rerun import Stream
from tests.support.recorded_flights import CAPABILITIES, MS, UNIX_NS

CAMERA = "cameras/alpha/front"  # its mounting is unknown
RERUN = os.environ.get("SKYLOOP_RERUN") or (sys.executable if find_spec("rerun") else "")


@pytest.fixture
def streams(monkeypatch: pytest.MonkeyPatch) -> list[Stream]:
    return fake_rerun.install(monkeypatch)


@pytest.fixture
def drawn(streams: list[Stream]) -> tuple[RerunLog, Stream]:
    made = RerunLog([Shown("alpha", CAPABILITIES, lambda proxy_ns: proxy_ns + UNIX_NS)])
    made.save(Path("flight.rrd"))
    return made, streams[-1]


# Recordings ----------------------------------------------------------------------------------------------------------


def test_a_recording_with_all_channels(flight: Path, tmp_path: Path, streams: list[Stream]) -> None:
    found = export_rrd(Recording.open(flight), tmp_path / "flight.rrd")
    (stream,) = streams
    assert (found.drones, found.pictures, found.left_out) == (("alpha",), 20, 0)
    assert stream.target == str(tmp_path / "flight.rrd")
    assert stream.closed
    poses = stream.of("world/drones/alpha", "Transform3D")
    assert len(poses) == len(stream.of("plots/alpha/attitude", "Scalars")) == 96
    assert poses[0].named["translation"] == (2.0, 2.0, 0.0)
    assert 2 <= len(stream.of("world/paths/alpha")) <= 3
    assert len(stream.of(CAMERA, "EncodedImage")) == 20
    (lens,) = stream.of(CAMERA, "Pinhole")
    assert (lens.named["focal_length"], lens.named["resolution"]) == ((60.0, 60.0), (64, 48))
    (titles,) = stream.of("plots/alpha/set_points/velocity", "SeriesLines")
    assert titles.named["names"] == ["forward", "left", "up", "yaw_rate"]
    assert stream.of("plots/alpha/set_points/velocity", "Scalars")[0].values[0][0] == pytest.approx(0.4)
    assert stream.of("plots/alpha/logs/error", "Scalars")[0].values == ([0.25],)
    texts = [made.values[0] for made in stream.of("log/alpha")]
    assert {"half way", "touched a chair"} <= set(texts)
    warning = next(made for made in stream.of("log/alpha") if made.values[0] == "touched a chair")
    assert warning.named["level"] == "WARN"
    # Everything is at the time of its capture.
    first = next(at_ns for entity, at_ns, made in stream.logged if made.kind == "EncodedImage")
    assert first == UNIX_NS + 5 * MS - 30 * MS


def test_h264_is_unchanged_and_starts_with_a_key_frame(tmp_path: Path, streams: list[Stream]) -> None:
    path = write_film(tmp_path / "flight.mcap", film()[2:])
    found = export_rrd(Recording.open(path), tmp_path / "flight.rrd")
    stream = streams[0]
    codec, *samples = stream.of(CAMERA, "VideoStream")
    assert "codec" in codec.named
    assert [sample.named["sample"] for sample in samples] == [unit.data for unit in film()[5:]]
    assert samples[0].named["is_keyframe"]
    assert (found.pictures, found.left_out) == (15, 3)


def test_by_the_command_line(flight: Path, tmp_path: Path, streams: list[Stream], log: Callable[..., Ended]) -> None:
    target = tmp_path / "x.rrd"
    ended = log("export", flight, "--to", "rrd", "-o", target)
    assert (ended.code, ended.err.strip().split(": ")[:2]) == (0, [str(target), "alpha"])
    assert log("export", flight, "--to", "rrd", "--camera", "front").code == 2
    assert log("export", flight, "--to", "rrd", "--drone", "beta", "-o", target).code == 2


def test_a_missing_drone_and_a_missing_folder(flight: Path, streams: list[Stream]) -> None:
    with pytest.raises(UnknownNameError, match="beta"):
        export_rrd(Recording.open(flight), Path("x.rrd"), drone="beta")
    with pytest.raises(UsageError, match="no such folder"):
        export_rrd(Recording.open(flight), Path("/nowhere/x.rrd"))


# Samples -------------------------------------------------------------------------------------------------------------


def test_unknown_values_are_not_drawn(drawn: tuple[RerunLog, Stream]) -> None:
    log, stream = drawn
    log.add(0, Feedback(captured_ns=1, altitude_m=1.5))
    assert {name for name, at_ns, _ in stream.logged if at_ns is not None} == {"plots/alpha/altitude"}
    log.add(0, Feedback(captured_ns=2, altitude_m=1.5, roll_rad=0.0, pitch_rad=0.0, yaw_rad=0.0))
    assert stream.of("world/drones/alpha", "Transform3D")[0].named["translation"] == (0.0, 0.0, 1.5)
    assert not stream.of("world/paths/alpha")


def test_set_points(drawn: tuple[RerunLog, Stream]) -> None:
    log, stream = drawn
    place = Position(1.0, 2.0, 3.0, speed=0.5)
    log.add(0, Applied(1, 1, 1, 1, 1, place, place))
    (scalars,) = stream.of("plots/alpha/set_points/position", "Scalars")
    assert scalars.values[0][:3] == [1.0, 2.0, 3.0]
    assert math.isnan(scalars.values[0][3])
    home = ReturnToStart(land=True)
    log.add(0, Applied(2, 1, 1, 1, 1, home, home))  # no values given
    assert not stream.of("plots/alpha/set_points/return_to_start")


def test_drawings_of_each_source_replace_its_own(drawn: tuple[RerunLog, Stream]) -> None:
    log, stream = drawn
    box = Polyline(((1.0, 1.0), (5.0, 1.0), (5.0, 5.0)), closed=True)
    shapes = (box, Points(((2.0, 2.0),)), Text("person", (1.0, 1.0)))
    for source in ("my tracker", "other"):
        log.add(0, Annotation(source, "front", 5, 64, 48, shapes))
    base = f"{CAMERA}/drawn/my\\ tracker"
    assert stream.of(f"{base}/lines")[0].values == ([(*box.points, box.points[0])],)
    assert stream.of(f"{base}/points")[0].values == ([(2.0, 2.0)],)
    assert stream.of(f"{base}/texts")[0].named["labels"] == ["person"]
    assert stream.of(f"{CAMERA}/drawn/other/lines")
    log.add(0, Annotation("tracker", "unknown", 5, 64, 48, shapes))
    assert not [name for name, *_ in stream.logged if "unknown" in name]


def test_names_chosen_by_applications_are_limited_in_number(drawn: tuple[RerunLog, Stream]) -> None:
    log, stream = drawn
    for number in range(100):
        log.add(0, LogEntry("me", f"series {number}", 1, number=1.0))
    assert len({name for name, *_ in stream.logged if name.startswith("plots/alpha/logs/")}) == 64


# Live ----------------------------------------------------------------------------------------------------------------


def test_a_flight_live(fly: Fly, tmp_path: Path, streams: list[Stream]) -> None:
    drone = fly()
    viewer = RerunViewer([drone], save=tmp_path / "flight.rrd")
    with View([drone], viewer) as view:
        drone.takeoff()
        end = time.monotonic() + 10.0
        while "logs" not in view.subscribed.get("alpha", ()):
            assert time.monotonic() < end, view.subscribed
            time.sleep(0.01)
        drone.log.text("found it")
        stream = streams[0]
        while not (
            len(stream.of(CAMERA, "EncodedImage")) > 3
            and len(stream.of("world/drones/alpha", "Transform3D")) > 3
            and [one for one in stream.of("log/alpha") if one.values[0] == "found it"]
        ):
            assert time.monotonic() < end, [name for name, *_ in stream.logged[-20:]]
            time.sleep(0.01)
        assert "video.front" in view.subscribed["alpha"]
        assert view.failed == 0, view.failed_why
    assert stream.closed


def test_a_running_viewer_is_used_and_one_that_does_not_start_is_an_error(
    fly: Fly, streams: list[Stream], monkeypatch: pytest.MonkeyPatch
) -> None:
    drone = fly()
    with socket.create_server(("127.0.0.1", 0)) as running:
        port = running.getsockname()[1]
        viewer = RerunViewer([drone], port=port)
        assert viewer.target == streams[0].target == f"rerun+http://127.0.0.1:{port}/proxy"
        streams[0].broken = True
        viewer.close()  # closing without the viewer is not an error
    monkeypatch.setattr(sys, "executable", "/nowhere/python")
    with pytest.raises(LinkError, match="can't be started"):
        RerunViewer([drone], port=0)
    monkeypatch.setattr(sys, "executable", "/bin/false")
    with pytest.raises(LinkError, match="needs a display"):
        RerunViewer([drone], port=0)
    with pytest.raises(UsageError, match="not an address"):
        RerunViewer([drone], connect="here")


def test_a_hanging_viewer_gets_nothing_until_it_continues(
    fly: Fly, streams: list[Stream], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(rerun_viewer, "_CHECK_NS", 0)
    viewer = RerunViewer([fly()], save=tmp_path / "flight.rrd")
    (stream,) = streams

    def show(number: int) -> int:
        unit = film()[number]
        header = FrameHeader("front", number, 1, 2, 64, 48, Encoding.BGR8, 64 * 48 * 3)
        picture = TranslatedImage(FrameRecord(header, 3, H264, unit.key), unit.data)
        viewer.show(Item(0, "video.front", Rank.FRAME, 3, picture, 1000))
        return len(stream.of(CAMERA, "VideoStream")) - 1  # the first is the codec

    assert [show(0), show(1)] == [1, 2]
    stream.broken = True
    assert [show(2), show(3)] == [2, 2]
    assert viewer.left_out == 2
    stream.broken = False
    assert [show(4), show(5), show(6)] == [2, 3, 4]  # continues with the next key frame
    viewer.close()
    assert stream.closed


def test_without_rerun_the_error_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "rerun", None)
    with pytest.raises(MissingExtraError, match=r"skyloop install rerun"):
        rerun_viewer.rerun_sdk()


# Rerun's own programs ------------------------------------------------------------------------------------------------

real = pytest.mark.skipif(not RERUN, reason="rerun-sdk is not installed: skyloop install rerun, or SKYLOOP_RERUN")


def ran(*words: str | Path) -> str:
    done = subprocess.run([RERUN, "-m", *map(str, words)], capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, f"{words}: {done.stdout[-2000:]}\n{done.stderr[-2000:]}"
    return done.stdout + done.stderr


@real
@pytest.mark.process
def test_rerun_reads_the_file_without_a_problem(flight: Path, tmp_path: Path) -> None:
    path = tmp_path / "flight.rrd"
    ran("skyloop", "log", "export", flight, "--to", "rrd", "-o", path)
    assert "verified without error" in ran("rerun_cli", "rrd", "verify", path)
    shown = ran("rerun_cli", "rrd", "print", path)
    for entity in (CAMERA, "/world/drones/alpha", "/world/paths/alpha", "/plots/alpha/attitude", "/log/alpha"):
        assert entity in shown
    film_path = write_film(tmp_path / "film.mcap", film())
    ran("skyloop", "log", "export", film_path, "--to", "rrd", "-o", path)
    assert "verified without error" in ran("rerun_cli", "rrd", "verify", path)


@real
@pytest.mark.process
def test_rerun_checks_our_own_file_without_a_problem(tmp_path: Path, fly: Fly) -> None:
    drone, path = fly(), tmp_path / "flight.mcap"
    with skyloop.record(drone, path, min_free_mb=0):
        drone.takeoff()
        drone.log.array("old", [1.0], at_ns=drone.now_ns - 1_000_000_000)
        drone.next_frame(timeout_s=10.0)
        drone.land()
    said = ran("rerun_cli", "mcap", "check", path)
    assert "warning" not in said.lower(), said
