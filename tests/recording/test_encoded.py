"""H.264 kept unchanged: the file holds the sent stream and shows the decoder's images."""

from __future__ import annotations

import functools
import re
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest
from numpy.typing import NDArray

import skyloop
from skyloop.client.drone import open_drone
from skyloop.drivers.base import Driver, Sink
from skyloop.drivers.registry import make_driver
from skyloop.errors import FileFormatError, MissingExtraError, UnknownNameError, UsageError
from skyloop.messages import CameraInfo, Capabilities, Feedback, LinkState
from skyloop.proxy.proxy import Proxy
from skyloop.recording import layout, taps
from skyloop.recording.layout import FrameRecord
from skyloop.recording.options import Options
from skyloop.recording.pictures import FrameGroup, Groups
from skyloop.recording.reader import Recording
from skyloop.recording.review.report import write_report
from skyloop.recording.review.summary import summarise
from skyloop.recording.review.video import export_mp4
from skyloop.sim.host import SimHost
from skyloop.sim.options import SimOptions
from skyloop.transport.memory import MemoryServer
from skyloop.vehicles.ardrone.emulator import ArdroneFirmware, Ports, with_ardrones
from skyloop.vehicles.ardrone.pave_decoder import PaveDecoder
from skyloop.vehicles.ardrone.wire.pave import PaveFrame, PaveParser
from tests.support import recording_files as files
from tests.support.fake_vehicle import FakeVehicle
from tests.support.recordings import recorded

WAIT_S = 20.0
IMAGE, VIDEO, FRAMES = (f"/alpha/{name}" for name in ("camera/front/image", "camera/front/video", "frames/front"))
Log = Callable[..., Any]


def stream() -> Path:
    return recorded("ardrone2/video-8s.pave")


@functools.cache
def sent() -> tuple[PaveFrame, ...]:
    return tuple(PaveParser().feed(stream().read_bytes()))


@functools.cache
def shown() -> tuple[NDArray[np.uint8], ...]:
    """The images of the driver's own decoder."""
    decoder = PaveDecoder()
    images = [decoder.decode(frame) for frame in sent()]
    return tuple(np.asarray(image.to_ndarray(format="bgr24"), np.uint8) for image in images if image is not None)


def record_stream(path: Path, **options: Any) -> skyloop.recording.Recorder:
    """Play the drone's eight seconds at twenty times the speed to a recorder only."""
    server = MemoryServer("alpha")
    with Proxy(make_driver(f"video://{stream()}?speed=20"), server, name="alpha"):
        drone = open_drone(server.dial, app="me", timeout_s=WAIT_S)
        with drone, skyloop.record(drone, path, min_free_mb=0, **options) as recorder:
            drone.wait(lambda feedback: feedback.vehicle_link is LinkState.CLOSED, timeout_s=WAIT_S)
    return recorder


@pytest.fixture(scope="module")
def kept(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording of the stream; do not modify."""
    path = tmp_path_factory.mktemp("encoded") / "flight.mcap"
    recorder = record_stream(path)
    assert (recorder.dropped, recorder.missed) == ({}, {})
    return path


# Into the file -------------------------------------------------------------------------------------------------------


def test_each_image_is_in_the_file_as_sent(kept: Path) -> None:
    videos = files.decoded(kept, VIDEO)
    assert [video.data for video in videos] == [frame.payload for frame in sent()]
    assert {(video.format, video.frame_id) for video in videos} == {("h264", "alpha/front")}
    records = [layout.decode(one.data, FrameRecord) for one in files.of(kept, FRAMES)]
    assert [record.key for record in records] == [frame.is_key for frame in sent()]
    assert {record.format for record in records} == {"h264"}
    assert [record.header.seq for record in records] == list(range(1, len(sent()) + 1))
    pairs = zip(files.of(kept, FRAMES), files.of(kept, VIDEO), strict=True)
    assert all((a.sequence, a.log_ns, a.publish_ns) == (b.sequence, b.log_ns, b.publish_ns) for a, b in pairs)
    assert IMAGE not in {one.topic for one in files.read(kept)}
    assert files.is_complete(kept)


def test_key_frames_carry_their_parameters_as_viewers_require(kept: Path) -> None:
    for video, frame in zip(files.decoded(kept, VIDEO), sent(), strict=True):
        units = [unit[0] & 31 for unit in re.split(rb"\x00{2,3}\x01", video.data) if unit]
        assert units == ([7, 8, 5] if frame.is_key else [1])


@pytest.mark.parametrize(("encoding", "format_"), [("jpeg", "jpeg"), ("png", "png")])
def test_frames_are_re_encoded_on_request(tmp_path: Path, encoding: str, format_: str) -> None:
    record_stream(tmp_path / "flight.mcap", encoding=encoding)
    topics = {one.topic for one in files.read(tmp_path / "flight.mcap")}
    assert IMAGE in topics
    assert VIDEO not in topics
    assert layout.decode(files.of(tmp_path / "flight.mcap", FRAMES)[0].data, FrameRecord).format == format_


def test_an_unknown_encoding_is_refused() -> None:
    with pytest.raises(UsageError, match='"auto", "jpeg" or, lossless, "png"'):
        Options(encoding="h264")  # type: ignore[arg-type]


class Announcing(FakeVehicle):
    """Announces H.264 and sends frames, and while ``encoded`` is set also images that pass for H.264."""

    def __init__(self) -> None:
        super().__init__()
        self.encoded = threading.Event()

    def capabilities(self) -> Capabilities:
        able = super().capabilities()
        return Capabilities(able.vehicle, able.actions, (CameraInfo("front", 32, 24, 50.0, stream="h264"),))

    def _run(self, sink: Sink) -> None:
        pixels = np.zeros((24, 32, 3), np.uint8)
        while not self._ended.wait(0.01):
            now_ns = time.monotonic_ns()
            sink.feedback(Feedback(captured_ns=now_ns, state=self.state))
            if self.encoded.is_set() and sink.wants_stream("front"):
                sink.stream("front", b"\0\0\1\x65", now_ns, width=32, height=24, key=True)
            if sink.wants("front"):
                sink.frame("front", pixels, now_ns, width=32, height=24)


def test_frames_are_recorded_while_the_announced_stream_does_not_arrive(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(taps, "_STREAM_GONE_NS", 200_000_000)
    server, vehicle, path = MemoryServer("alpha"), Announcing(), tmp_path / "flight.mcap"
    with Proxy(vehicle, server, name="alpha"), open_drone(server.dial, app="me", timeout_s=WAIT_S) as drone:
        with skyloop.record(drone, path, min_free_mb=0, channels=["video"]) as recorder:
            files.until(lambda: len(files.of(path, IMAGE)) > 2, "frames")
            vehicle.encoded.set()
            files.until(lambda: len(files.of(path, VIDEO)) > 2, "the stream")
            files.until(lambda: not server.subscribers("video/front"), "frames are asked for no longer")
            before = len(files.of(path, IMAGE))
            vehicle.encoded.clear()
            files.until(lambda: len(files.of(path, IMAGE)) > before, "frames again")
        assert not server.subscribers("video/front")
        assert not server.subscribers("stream/front")
    assert recorder.missed == {}
    formats = [layout.decode(one.data, FrameRecord).format for one in files.of(path, FRAMES)]
    assert [one for n, one in enumerate(formats) if n == 0 or formats[n - 1] != one] == ["jpeg", "h264", "jpeg"]
    pictures = list(Recording.open(path).pictures("alpha", "front"))
    assert [picture.record.format for picture in pictures] == formats


# Out of the file -----------------------------------------------------------------------------------------------------


def test_images_match_the_decoders(kept: Path) -> None:
    pictures = list(Recording.open(kept).pictures("alpha", "front"))
    assert len(pictures) == len(shown()) == 240
    for picture, expected in zip(pictures, shown(), strict=True):
        assert np.array_equal(picture.pixels(), expected)
    # In any order, as for thumbnails; each is decoded starting from its key frame.
    for index in (100, 99, 100, 7, 239, 120):
        assert np.array_equal(pictures[index].pixels(), shown()[index])
        image, encoding = pictures[index].as_recorded()
        assert (encoding.value, image.shape) == ("bgr8", (360, 640, 3))


def replayed(path: Path, query: str) -> list[tuple[int, NDArray[np.uint8]]]:
    seen = []
    with skyloop.connect(f"replay://{path}?speed=max{query}", on_exit="hover") as drone:
        drone.on_frame(lambda frame: seen.append((frame.captured_ns, np.array(frame))), inline=True)
        drone.wait(lambda feedback: feedback.vehicle_link is LinkState.CLOSED, timeout_s=1e3)
    return seen


def test_a_replay_in_step_shows_every_image(kept: Path) -> None:
    seen = replayed(kept, "")
    assert len(seen) == len(shown())
    assert all(np.array_equal(frame, expected) for (_, frame), expected in zip(seen, shown(), strict=True))
    records = [layout.decode(one.data, FrameRecord) for one in files.of(kept, FRAMES)]
    assert [captured_ns for captured_ns, _ in seen] == [record.header.captured_ns for record in records]


def test_a_replay_from_between_two_key_frames_shows_whole_images_at_once(kept: Path) -> None:
    seen = replayed(kept, "&start=0.2")  # of 0.4 s in all
    records = [layout.decode(one.data, FrameRecord) for one in files.of(kept, FRAMES)]
    first = next(n for n, record in enumerate(records) if record.header.captured_ns == seen[0][0])
    assert first > 20
    if records[first].key:  # by chance
        del seen[0]
        first += 1
    assert all(np.array_equal(frame, expected) for (_, frame), expected in zip(seen, shown()[first:], strict=True))


def test_a_truncated_file_shows_its_content_and_can_be_recovered(kept: Path, tmp_path: Path, log: Log) -> None:
    cut = tmp_path / "cut.mcap"
    data = kept.read_bytes()
    cut.write_bytes(data[: len(data) * 2 // 3])
    assert log("recover", cut, "-o", tmp_path / "mended.mcap").code == 0
    for path in (cut, tmp_path / "mended.mcap"):
        pictures = list(Recording.open(path).pictures("alpha", "front"))
        assert 20 < len(pictures) < 240
        assert np.array_equal(pictures[-1].pixels(), shown()[len(pictures) - 1])


def test_commands_on_the_recording(kept: Path, tmp_path: Path, log: Log) -> None:
    rows = {row.topic: row for row in summarise(Recording.open(kept)).rows}
    assert (rows[FRAMES].count, rows[VIDEO].count, rows[FRAMES].missing) == (240, 240, 0)
    assert rows[VIDEO].schema == "foxglove.CompressedVideo"
    ended = log("info", kept)
    assert ended.code == 0
    assert "CompressedVideo" in ended.out or VIDEO in ended.out
    write_report(Recording.open(kept), "alpha", tmp_path / "report.html", pictures=4)
    assert (tmp_path / "report.html").read_text().count("data:image/jpeg") == 4
    assert export_mp4(Recording.open(kept), "alpha", "front", tmp_path / "front.mp4").frames == 240
    with av.open(str(tmp_path / "front.mp4")) as container:
        copied = [frame.to_ndarray(format="bgr24") for frame in container.decode(video=0)]
    assert len(copied) == 240
    assert all(np.array_equal(image, expected) for image, expected in zip(copied, shown(), strict=True))


def test_without_pyav_the_rest_of_a_recording_can_be_read(
    kept: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "av", None)
    picture = next(Recording.open(kept).pictures("alpha", "front"))
    assert picture.compressed == sent()[0].payload
    with pytest.raises(MissingExtraError, match="skyloop install video"):
        picture.pixels()
    write_report(Recording.open(kept), "alpha", tmp_path / "report.html")
    assert "data:image" not in (tmp_path / "report.html").read_text()


def test_images_that_depend_on_missing_or_damaged_ones_are_not_shown() -> None:
    groups = Groups()
    found = [groups.add(n, frame.payload, key=frame.is_key) for n, frame in enumerate(sent()[:40]) if n not in (0, 18)]
    whole = [n for n in range(1, 40) if n != 18]
    lost = [n for n, place in zip(whole, found, strict=True) if place is None]
    assert lost == [*range(1, 15), *range(19, 30)]  # keys are 0, 15, 30
    group = FrameGroup()
    for n, frame in enumerate(sent()[:5]):
        group.add(frame.payload[: len(frame.payload) // 2] if n == 2 else frame.payload)
    assert np.array_equal(group.pixels(1, "it"), shown()[1])
    for index in (2, 3, 4):
        with pytest.raises(FileFormatError, match="it can't be decoded"):
            group.pixels(index, "it")
    assert np.array_equal(group.pixels(0, "it"), shown()[0])


def test_a_missing_key_frame_is_reported(kept: Path, tmp_path: Path) -> None:
    recording = Recording.open(kept)
    pictures = list(recording.pictures("alpha", "front"))
    broken = type(pictures[1])(**{f: getattr(pictures[1], f) for f in pictures[1].__slots__} | {"group": None})
    with pytest.raises(FileFormatError, match="frame 2 of front can't be decoded: frames that it depends on"):
        broken.pixels()
    with pytest.raises(UnknownNameError):
        recording.pictures("alpha", "bottom")


# From a drone --------------------------------------------------------------------------------------------------------


@pytest.fixture
def emulated() -> Iterator[Driver]:
    host = SimHost(with_ardrones(SimOptions(world="room", seed=1)))
    with ArdroneFirmware(host, version=2, ports=Ports.free()) as firmware:
        ports = firmware.ports
        yield make_driver(
            f"ardrone://127.0.0.1?navdata_port={ports.navdata}&at_port={ports.at}&video_port={ports.video}"
            f"&control_port={ports.control}"
        )


def test_an_emulated_drone_is_recorded_as_sent_and_as_shown(emulated: Driver, tmp_path: Path) -> None:
    server, path = MemoryServer("alpha"), tmp_path / "flight.mcap"
    live: dict[int, NDArray[np.uint8]] = {}
    with Proxy(emulated, server, name="alpha"), open_drone(server.dial, app="me", timeout_s=WAIT_S) as drone:
        assert [camera.stream for camera in drone.capabilities.cameras] == ["h264", "h264"]
        with skyloop.record(drone, path, min_free_mb=0) as recorder:
            files.until(lambda: len(files.of(path, VIDEO)) > 20, "pictures that nobody looks at", WAIT_S)
            with drone.on_frame(lambda frame: live.update({frame.captured_ns: np.array(frame)}), inline=True):
                files.until(lambda: len(live) > 20, "frames", WAIT_S)
            at_ns = max(live)
            files.until(
                lambda: layout.decode(files.of(path, FRAMES)[-1].data, FrameRecord).header.captured_ns >= at_ns,
                "the last of those frames in the file",
                WAIT_S,
            )
    assert recorder.dropped == {}
    recorded = list(Recording.open(path).pictures("alpha", "front"))
    assert recorded[0].record.key
    pictures = {picture.header.captured_ns: picture for picture in recorded}
    assert set(live) <= set(pictures)
    assert all(np.array_equal(pictures[at_ns].pixels(), frame) for at_ns, frame in live.items())
    assert all(picture.header.intrinsics is not None for picture in pictures.values())
