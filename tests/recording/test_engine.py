"""A recorder on threads of this process: proxy, application and recording over the memory transport."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import cv2
import numpy as np
import pytest

import skyloop
from skyloop.client import Drone
from skyloop.client.drone import open_drone
from skyloop.errors import LinkError, MissingExtraError, SkyloopError, UnknownNameError, UsageError
from skyloop.extend import join_processor
from skyloop.messages import (
    Annotation,
    Applied,
    Encoding,
    Event,
    EventKind,
    Feedback,
    FrameHeader,
    LogEntry,
    Parameter,
    Polyline,
    Severity,
    Velocity,
)
from skyloop.proxy.proxy import Proxy
from skyloop.recording import layout
from skyloop.recording.layout import META_END, META_RECORDING, End, FrameRecord, ResultRecord, Start
from skyloop.recording.options import CHOICES, Options, RecorderState, channels_of
from skyloop.recording.recorder import Engine
from skyloop.recording.taps import Gaps, Video, encoder
from skyloop.transport.memory import MemoryServer
from tests.recording.disks import Disk
from tests.recording.vehicle import Vehicle, picture
from tests.support import recording_files as files
from tests.support.recording_files import read_image

WAIT_S = 10.0


Fly = Callable[..., Drone]


@pytest.fixture
def fly() -> Iterator[Fly]:
    """Creates proxies in this process, with a pilot each."""
    with ExitStack() as stack:

        def one(name: str = "alpha", encoding: Encoding = Encoding.BGR8) -> Drone:
            server = MemoryServer(name)
            stack.enter_context(Proxy(Vehicle(encoding), server, name=name))
            drone = open_drone(server.dial, app="me", timeout_s=WAIT_S)
            stack.callback(drone.close)
            return drone

        yield one


def test_a_recorder_that_fails_to_start_leaves_no_open_file(
    fly: Fly, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The second drone's connection was gone: file and writing thread stayed open."""
    drones, path = [fly("one"), fly("two")], tmp_path / "flight.mcap"
    monkeypatch.setattr(drones[1], "on_command", Mock(side_effect=LinkError("it is gone")))
    with pytest.raises(LinkError, match="it is gone"):
        skyloop.record(drones, path, min_free_mb=0)
    assert files.is_complete(path), "it is closed and readable"
    assert not [thread.name for thread in threading.enumerate() if thread.name.startswith("skyloop-record")]


def until_has(path: Path, topic: str, count: int = 1) -> None:
    files.until(lambda: len(files.of(path, topic)) >= count, f"{count} of {topic}")


def test_all_channels_are_in_the_file(fly: Fly, tmp_path: Path) -> None:
    drone, path = fly(), tmp_path / "flight.mcap"
    with skyloop.record(drone, path, min_free_mb=0) as recorder:
        assert recorder.state.value == "recording"
        until_has(path, "/alpha/parameters")
        drone.takeoff()
        drone.velocity(forward=0.25)
        frame = drone.next_frame(timeout_s=WAIT_S)
        assert drone.annotate(frame, [Polyline(((1.0, 1.0), (5.0, 5.0)))], source="tracker")
        membership = join_processor(drone, "detector", code="Detector 1")
        assert membership.publish(frame, {"score": 0.5})
        assert drone.log.text("found it", severity="warning")
        assert drone.log.numbers(error=0.25, gain=2)
        assert drone.log.array("grid", np.arange(6).reshape(2, 3))
        drone.config["limits.tilt"] = 0.2
        drone.land()
        for topic in ("annotations", "frames/front", "path", "results"):
            until_has(path, f"/alpha/{topic}")
        until_has(path, "/alpha/logs", 4)
        files.until(lambda: len(tilts(path)) == 2, "the parameter that changed")
    assert recorder.state.value == "closed"
    assert recorder.dropped == {}
    assert files.is_complete(path)
    check_own(path, drone)
    check_for_viewers(path)
    start = layout.from_metadata(files.metadata(path)[META_RECORDING], Start)
    assert (start.drones[0].name, start.drones[0].uri) == ("alpha", "fake://test")
    assert start.drones[0].described == drone.capabilities
    end = layout.from_metadata(files.metadata(path)[META_END], End)
    assert sum(end.written.values()) == len(files.read(path)) == recorder.status.messages
    assert f"{recorder.seconds:.0f} s" in repr(recorder)


def tilts(path: Path) -> list[object]:
    found = [layout.decode(one.data, Parameter) for one in files.of(path, "/alpha/parameters")]
    return [parameter.value for parameter in found if parameter.name == "limits.tilt"]


def check_own(path: Path, drone: Drone) -> None:
    def samples(channel: str, kind: type[Any]) -> list[Any]:
        return [layout.decode(one.data, kind) for one in files.of(path, f"/alpha/{channel}")]

    feedback: list[Feedback] = samples("feedback", Feedback)
    seqs = [sample.seq for sample in feedback]
    assert seqs == list(range(seqs[0], seqs[0] + len(seqs)))
    applied: list[Applied] = samples("commands", Applied)
    assert Velocity(forward=0.25) in [one.asked for one in applied]
    assert {one.app_id for one in applied} == {drone.app_id}
    events: list[Event] = samples("events", Event)
    assert {EventKind.STATE_CHANGED, EventKind.PARAMETER_CHANGED, EventKind.RECORDING} <= {one.kind for one in events}
    (result,) = samples("results", ResultRecord)
    assert (result.processor, result.worker, result.value) == ("detector", drone.app_id, {"score": 0.5})
    (annotation,) = samples("annotations", Annotation)
    assert (annotation.source, annotation.camera) == ("tracker", "front")
    logs: list[LogEntry] = [one for one in samples("logs", LogEntry) if one.name != "recording"]
    assert [(one.name, one.text, one.number, one.values, one.shape) for one in logs] == [
        ("", "found it", None, None, ()),
        ("error", None, 0.25, None, ()),
        ("gain", None, 2.0, None, ()),
        ("grid", None, None, (0.0, 1.0, 2.0, 3.0, 4.0, 5.0), (2, 3)),
    ]
    assert tilts(path)[-1] == 0.2


def check_for_viewers(path: Path) -> None:
    frames = files.of(path, "/alpha/frames/front")
    images = files.of(path, "/alpha/camera/front/image")
    assert [(f.log_ns, f.publish_ns, f.sequence) for f in frames] == [
        (i.log_ns, i.publish_ns, i.sequence) for i in images
    ]
    for frame, image in zip(frames, files.decoded(path, "/alpha/camera/front/image"), strict=True):
        record = layout.decode(frame.data, FrameRecord)
        assert frame.log_ns >= frame.publish_ns
        shown = cv2.imdecode(np.frombuffer(image.data, np.uint8), cv2.IMREAD_COLOR)
        assert shown is not None
        assert np.abs(shown.astype(int) - picture(record.header.captured_ns)).mean() < 8
    (calibration, *_) = files.decoded(path, "/alpha/camera/front/calibration")
    assert calibration.K[0] == 30.0
    assert files.decoded(path, "/alpha/pose")[-1].pose.position.z == 1.0
    assert files.decoded(path, "/alpha/path")[-1].poses[0].position.x > 0.0
    assert {one.child_frame_id for one in files.decoded(path, "/tf")} == {"alpha"}
    assert "found it" in [one.message for one in files.decoded(path, "/log")]
    assert files.decoded(path, "/alpha/camera/front/annotations")[0].points


def test_jpeg_is_kept_unchanged(fly: Fly, tmp_path: Path) -> None:
    drone, path = fly(encoding=Encoding.JPEG), tmp_path / "flight.mcap"
    with skyloop.record(drone, path, channels=["video.front"], min_free_mb=0):
        until_has(path, "/alpha/frames/front", 3)
    vehicle = Vehicle(Encoding.JPEG)
    for frame, image in zip(
        files.of(path, "/alpha/frames/front"), files.of(path, "/alpha/camera/front/image"), strict=True
    ):
        record = layout.decode(frame.data, FrameRecord)
        assert (record.format, record.header.encoding) == ("jpeg", Encoding.JPEG)
        assert read_image(image.data) == (vehicle.shown(record.header.captured_ns), "jpeg")


@pytest.mark.parametrize("encoding", [Encoding.BGR8, Encoding.RGB8, Encoding.MONO8])
def test_png_loses_nothing(fly: Fly, tmp_path: Path, encoding: Encoding) -> None:
    drone, path = fly(encoding=encoding), tmp_path / "flight.mcap"
    with skyloop.record(drone, path, encoding="png", channels=("video",), min_free_mb=0):
        until_has(path, "/alpha/frames/front", 3)
    for frame, image in zip(
        files.of(path, "/alpha/frames/front"), files.of(path, "/alpha/camera/front/image"), strict=True
    ):
        captured_ns = layout.decode(frame.data, FrameRecord).header.captured_ns
        data, format_ = read_image(image.data)
        assert format_ == "png"
        shown = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
        expected = picture(captured_ns)[:, :, 0] if encoding is Encoding.MONO8 else picture(captured_ns)
        assert shown is not None
        assert np.array_equal(shown, expected)


def test_only_the_channels_chosen(fly: Fly, tmp_path: Path) -> None:
    drone, path = fly(), tmp_path / "flight.mcap"
    with skyloop.record(drone, path, channels=("command", "feedback"), min_free_mb=0):
        until_has(path, "/alpha/commands", 2)
        until_has(path, "/alpha/feedback", 2)
    topics = {one.topic for one in files.read(path)}
    assert {"/alpha/commands", "/alpha/feedback"} <= topics
    assert not any("front" in topic and "calibration" not in topic for topic in topics)
    assert topics.isdisjoint({"/alpha/parameters", "/alpha/logs", "/alpha/annotations"})


def test_several_drones_in_one_file(fly: Fly, tmp_path: Path) -> None:
    alpha, beta = fly("alpha"), fly("beta", Encoding.JPEG)
    path = tmp_path / "both.mcap"
    with skyloop.record([alpha, beta], path, min_free_mb=0):
        for name in ("alpha", "beta"):
            until_has(path, f"/{name}/frames/front")
            until_has(path, f"/{name}/feedback", 3)
    start = layout.from_metadata(files.metadata(path)[META_RECORDING], Start)
    assert [drone.name for drone in start.drones] == ["alpha", "beta"]
    with pytest.raises(UsageError, match="different names"):
        skyloop.record([alpha, alpha], tmp_path / "twice.mcap", min_free_mb=0)


def test_a_full_disk_is_reported_and_the_flight_continues(fly: Fly, tmp_path: Path) -> None:
    disk = Disk()
    drone, path = fly(), tmp_path / "flight.mcap"
    events: list[Event] = []
    logs: list[LogEntry] = []
    engine = Engine([drone], path, Options(min_free_mb=0.0), opener=disk.open, free=disk.free)
    with drone.on_event(events.append), drone.on_log(logs.append):
        engine.start()
        until_has(path, "/alpha/feedback", 3)
        disk.room = 0
        files.until(lambda: engine.status.state is RecorderState.PAUSED, "the pause")
        drone.takeoff()
        assert drone.feedback(max_age_s=1.0).state.airborne
        files.until(lambda: any("recording paused" in (entry.text or "") for entry in logs), "the log entry")
        disk.room = 10**9
        files.until(lambda: engine.status.state is RecorderState.RECORDING, "the next file")
        engine.stop()
    assert engine.status.state.value == "closed"
    _, second = engine.status.files
    told = [layout.decode(one.data, Event) for one in files.of(Path(second), "/alpha/events")]
    assert any(event.severity is Severity.ERROR and "No space" in event.text for event in told)
    taken = [layout.decode(one.data, Applied) for one in files.of(Path(second), "/alpha/commands")]
    assert "takeoff" in [applied.asked.name for applied in taken], "kept while the disk was full"


def test_a_slow_encoder_costs_frames_which_are_counted_and_reported(
    fly: Fly, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    gate = threading.Event()

    def slow(options: Options) -> Callable[[FrameHeader, Any], bytes]:
        def encode(header: FrameHeader, image: Any) -> bytes:
            assert gate.wait(WAIT_S)
            return b"picture"

        return encode

    monkeypatch.setattr("skyloop.recording.taps.encoder", slow)
    drone, path = fly(), tmp_path / "flight.mcap"
    events: list[Event] = []
    with drone.on_event(events.append), skyloop.record(drone, path, min_free_mb=0) as recorder:
        files.until(lambda: recorder.dropped.get("alpha", {}).get("video.front", 0) > 3, "drops")
        files.until(lambda: any("leaves out" in event.text for event in events), "the event")
        gate.set()
        until_has(path, "/alpha/drops")
    told = layout.decode(files.of(path, "/alpha/drops")[-1].data, layout.Drops)
    assert told.dropped["video.front"] > 0
    end = layout.from_metadata(files.metadata(path)[META_END], End)
    assert end.dropped == recorder.dropped
    assert [event for event in events if event.kind is EventKind.RECORDING][-1].app == "me"


def test_images_that_can_not_be_encoded_are_counted(fly: Fly, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(self: Video, *_: object) -> None:
        raise SkyloopError("no")

    monkeypatch.setattr(Video, "_done", broken)
    drone = fly()
    with skyloop.record(drone, tmp_path / "f.mcap", min_free_mb=0) as recorder:
        files.until(lambda: recorder.dropped.get("alpha", {}).get("video.front", 0) > 0, "counted")


def test_an_encoder_reports_impossible_images() -> None:
    header = FrameHeader("front", 1, 1, 1, 4, 3, Encoding.BGR8, 36)
    with pytest.raises(SkyloopError, match="frame 1 of front can't be encoded"):
        encoder(Options())(header, np.zeros((0, 0, 3), np.uint8))


def test_a_drone_that_is_closed_first(fly: Fly, tmp_path: Path) -> None:
    drone, path = fly(), tmp_path / "flight.mcap"
    with skyloop.record(drone, path, min_free_mb=0) as recorder:
        until_has(path, "/alpha/feedback")
        drone.close()
    assert recorder.state.value == "closed"
    assert files.is_complete(path)


def test_a_fork_leaves_a_recording_to_the_parent(fly: Fly, tmp_path: Path) -> None:
    drone, path = fly(), tmp_path / "flight.mcap"
    with skyloop.record(drone, path, min_free_mb=0) as recorder:
        until_has(path, "/alpha/feedback")
        engine = recorder._backend
        assert isinstance(engine, Engine)
        engine.forked()
        recorder.close()
        assert recorder.state.value == "recording", "its file is still open"
        engine._ended_ns = None  # the parent's
    assert files.is_complete(path)


def test_gaps_in_numbers() -> None:
    gaps = Gaps()
    for number in (5, 6, 9, 1, 2, 4):
        gaps.follow(number)
    assert gaps.missed == 3


# Options --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "match"),
    [
        ({"channels": ["vidio"]}, "did you mean 'video'"),
        ({"channels": []}, "no channel"),
        ({"channels": ["video.back"]}, "no camera named 'back'"),
        ({"encoding": "gif"}, "jpeg"),
        ({"quality": 0}, "1 to 100"),
        ({"quality": 90.5}, "whole number"),
        ({"rotate_mb": 0.1}, "rotate_mb"),
        ({"rotate_s": float("inf")}, "rotate_s"),
        ({"min_free_mb": -1}, "min_free_mb"),
        ({"buffer_mb": "big"}, "buffer_mb"),
        ({"in_process": False}, "alpha can't be reached from another process"),
        ({"min_free_mb": 1e9}, "MB left"),
    ],
)
def test_wrong_options(fly: Fly, tmp_path: Path, options: dict[str, Any], match: str) -> None:
    with pytest.raises(UsageError, match=match):
        skyloop.record(fly(), tmp_path / "f.mcap", **options)
    assert list(tmp_path.iterdir()) == []


def test_wrong_paths_and_drones(fly: Fly, tmp_path: Path) -> None:
    drone = fly()
    with pytest.raises(UsageError, match="is not a folder"):
        skyloop.record(drone, tmp_path / "nowhere" / "f.mcap")
    (tmp_path / "f.mcap").write_text("precious")
    with pytest.raises(UsageError, match="already exists"):
        skyloop.record(drone, tmp_path / "f")
    for wrong in (7, [], [None]):
        with pytest.raises(UsageError, match="must be a drone"):
            skyloop.record(wrong, tmp_path)  # type: ignore[arg-type]
    with pytest.raises(UnknownNameError, match="nobody"):
        skyloop.record("nobody", tmp_path, in_process=True)
    with skyloop.record(drone, tmp_path / "f.mcap", overwrite=True, min_free_mb=0) as recorder:
        assert recorder.files == [tmp_path / "f.mcap"]
    with skyloop.record(drone, tmp_path, min_free_mb=0) as recorder:
        assert recorder.path.name.startswith("alpha-2")
        assert recorder.path.suffix == ".mcap"


def test_channels_by_their_names() -> None:
    assert channels_of(None) == CHOICES
    assert channels_of("event") == ("events",)
    assert channels_of(("command", "video.front")) == ("commands", "video.front")


def test_the_extra_is_named_when_it_is_missing(fly: Fly, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(MissingExtraError, match="skyloop install record"):
        skyloop.record(fly(), tmp_path)
