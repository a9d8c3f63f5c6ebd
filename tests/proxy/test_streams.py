"""The proxy's encoded video, with a vehicle and a clock moved by the test."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Iterator
from typing import Any

import msgspec
import numpy as np
import pytest

from skyloop.clock import ManualClock
from skyloop.errors import MissingExtraError, UsageError
from skyloop.messages import (
    CameraInfo,
    EncodedFrame,
    Encoding,
    EventKind,
    FrameHeader,
    Intrinsics,
    Role,
    StreamReport,
    VideoRequest,
    encode,
)
from skyloop.proxy import streams
from skyloop.proxy.streams import KEY_NS, StreamForm
from skyloop.pyav import H264Encoder
from tests.support.proxy_bench import WAIT_S, App, Bench

av = pytest.importorskip("av", reason="H.264 needs the extra 'video'")
TOPIC = "stream/front?kbit_s=300"
MINE = "stream/front?subscriber=me"
CAMERA = CameraInfo("front", 64, 48, 30.0)
LENS = Intrinsics(60.0, 60.0, 31.5, 23.5)


def shoot(bench: Bench, value: int = 90, size: tuple[int, int] = (64, 48), **fields: Any) -> None:
    """Let the vehicle send a picture, a thirtieth of a second after the last."""
    bench.clock.advance(0.033)
    width, height = size
    pixels = np.full((height, width, 3), value, np.uint8)
    assert bench.driver.sink is not None
    bench.driver.sink.frame("front", pixels, bench.clock(), width=width, height=height, **fields)


def watcher(bench: Bench, topic: str = TOPIC, name: str = "watcher") -> App:
    app = bench.join(name, Role.OBSERVER)
    app.end.subscribe(topic)
    app.sync()
    return app


def pictures(app: App) -> list[EncodedFrame]:
    return [one for one in app.others if isinstance(one, EncodedFrame)]


def wait_for(app: App, count: int) -> list[EncodedFrame]:
    deadline = time.monotonic() + WAIT_S
    while len(pictures(app)) < count:
        assert time.monotonic() < deadline, f"{len(pictures(app))} of {count} pictures came"
        time.sleep(0.002)
    return pictures(app)


def shown(bench: Bench, app: App, count: int, **fields: Any) -> list[EncodedFrame]:
    """Send ``count`` pictures, each encoded before the next."""
    for _ in range(count):
        before = len(pictures(app))
        shoot(bench, **fields)
        wait_for(app, before + 1)
    return pictures(app)[-count:]


def image(picture: EncodedFrame) -> np.ndarray:
    (decoded,) = av.CodecContext.create("h264", "r").decode(av.Packet(picture.data)) or [None]
    found: np.ndarray = decoded.to_ndarray(format="bgr24")
    return found


def test_a_picture_has_the_stamps_of_its_frame(bench: Bench) -> None:
    app = watcher(bench)
    (first, second) = shown(bench, app, 2, intrinsics=LENS)
    assert (first.key, second.key) == (True, False)
    assert second.captured_ns == bench.clock()
    assert second.intrinsics == LENS
    assert np.allclose(image(first), 90, atol=4)


def test_the_vehicle_knows_how_many_frames_are_used(bench: Bench) -> None:
    publisher = bench.proxy.publisher
    assert publisher.wanted_fps("front") == 0.0
    watcher(bench, f"{TOPIC}&max_fps=10", "ten")
    five = watcher(bench, f"{TOPIC}&max_fps=5", "five")
    assert publisher.wanted_fps("front") == pytest.approx(10.0)
    five.end.subscribe("video/front")
    five.sync()
    assert publisher.wanted_fps("front") == math.inf


def test_nothing_is_encoded_without_viewers(bench: Bench) -> None:
    app = watcher(bench)
    assert bench.proxy.publisher.wants("front")
    shown(bench, app, 1)
    app.end.subscribe(TOPIC, False)
    app.sync()
    assert not bench.proxy.publisher.wants("front")
    shoot(bench)
    app.sync()
    assert len(pictures(app)) == 1


@pytest.mark.parametrize(("encoding", "channels"), [(Encoding.RGB8, 3), (Encoding.MONO8, 1)])
def test_other_formats_of_pixels(bench: Bench, encoding: Encoding, channels: int) -> None:
    app = watcher(bench)
    pixels = np.full((48, 64, channels), 30, np.uint8)
    pixels[..., 0] = 200  # red, in colour formats
    assert bench.driver.sink is not None
    bench.driver.sink.frame("front", pixels, bench.clock(), width=64, height=48, encoding=encoding)
    (picture,) = wait_for(app, 1)
    expected = (30, 30, 200) if channels == 3 else (200, 200, 200)
    assert np.allclose(image(picture).mean(axis=(0, 1)), expected, atol=12)


def test_jpeg_frames_are_encoded_and_damaged_ones_reported(bench: Bench) -> None:
    cv2 = pytest.importorskip("cv2", reason="JPEG needs OpenCV")
    app = watcher(bench)
    _, jpeg = cv2.imencode(".jpg", np.full((48, 64, 3), 120, np.uint8))
    header: dict[str, Any] = {"width": 64, "height": 48, "encoding": Encoding.JPEG}
    sink = bench.driver.sink
    assert sink is not None
    sink.frame("front", jpeg.reshape(-1), bench.clock(), **header)
    assert np.allclose(image(wait_for(app, 1)[0]), 120, atol=6)
    sink.frame("front", jpeg.reshape(-1)[:20].copy(), bench.clock(), **header)
    deadline = time.monotonic() + WAIT_S
    while not bench.published(EventKind.DRIVER_ERROR):
        assert time.monotonic() < deadline
        time.sleep(0.002)
    assert "can't be encoded" in bench.published(EventKind.DRIVER_ERROR)[0].text
    assert shown(bench, app, 1)[0].key, "it restarts"


def test_a_camera_that_changes_its_size(bench: Bench) -> None:
    app = watcher(bench)
    shown(bench, app, 2)
    (larger,) = shown(bench, app, 1, size=(80, 61))
    assert larger.key
    assert image(larger).shape == (60, 80, 3), "both are even"


def test_key_pictures_are_made_on_request_and_not_too_often(bench: Bench) -> None:
    app = watcher(bench)
    shown(bench, app, 2)
    bench.clock.advance(KEY_NS / 1e9)

    def ask(seq: int) -> None:
        assert app.end.send(encode(StreamReport(TOPIC, seq, wants_key=True)))
        app.sync()

    ask(1)
    assert [one.key for one in shown(bench, app, 2)] == [True, False]
    ask(2)
    assert not shown(bench, app, 1)[0].key
    bench.clock.advance(KEY_NS / 1e9)
    assert shown(bench, app, 1)[0].key


def test_reports_on_unknown_streams_are_malformed(bench: Bench) -> None:
    app = watcher(bench)
    for topic in ("feedback", "stream/front?kbit_s=77"):
        assert app.end.send(encode(StreamReport(topic, 1)))
    (event,) = app.told(EventKind.PACKET_MALFORMED)
    assert "a report of 'feedback'" in event.text


def test_a_form_for_one_subscriber_follows_its_acknowledgements(bench: Bench) -> None:
    app = watcher(bench, MINE)
    (form,) = bench.proxy.publisher.streams.known
    for _ in range(60):
        (picture,) = shown(bench, app, 1)
        assert app.end.send(encode(StreamReport(MINE, picture.seq)))
        app.sync()
    assert form._kbit_s >= form._rate.kbit_s > 90  # type: ignore[union-attr]
    before = len(pictures(app))
    for _ in range(20):  # nothing is acknowledged
        shoot(bench)
        time.sleep(0.002)
    assert len(pictures(app)) <= before + 8
    assert form.skipped >= 12


def test_a_returning_subscriber_gets_a_key_picture_at_once(bench: Bench) -> None:
    app = watcher(bench, MINE)
    for _ in range(20):  # the link is lost: nothing is acknowledged
        shoot(bench)
        time.sleep(0.002)
    (form,) = bench.proxy.publisher.streams.known
    wait_for(app, 20 - form.skipped)  # the encoder has nothing left
    skipped = form.skipped
    assert skipped
    app.end.subscribe(MINE, False)
    app.sync()
    again = watcher(bench, MINE, "again")  # no frame was sent without a subscriber
    bench.clock.advance(KEY_NS / 1e9)
    (picture,) = shown(bench, again, 1)
    assert picture.key
    assert form.skipped == skipped


def test_a_slow_path_gets_smaller_pictures_and_larger_ones_only_later(bench: Bench) -> None:
    app = watcher(bench, MINE)
    (form,) = bench.proxy.publisher.streams.known
    form._kbit_s = 5000  # the pictures are larger than the camera announced
    rate = form._rate
    assert rate is not None
    rate.acknowledged = lambda *_: None  # type: ignore[method-assign]
    rate.may_send = lambda now_ns: True  # type: ignore[method-assign]

    def sizes(kbit_s: float, count: int = 2) -> list[int]:
        rate.kbit_s = kbit_s
        return [one.width for one in shown(bench, app, count, size=(640, 480))]

    assert sizes(3000) == [640, 640]
    assert sizes(100)[-1] == 320
    assert sizes(3000)[-1] == 320
    bench.clock.advance(4.0)
    assert sizes(3000)[-1] == 640


@pytest.fixture
def form() -> Iterator[tuple[StreamForm, list[EncodedFrame], list[str]]]:
    came: list[EncodedFrame] = []
    failed: list[str] = []
    request = VideoRequest.parse(TOPIC)
    made = StreamForm(TOPIC, request, CAMERA, came.append, failed.append, time.monotonic_ns)
    yield made, came, failed
    made.end()


def header(seq: int) -> FrameHeader:
    return FrameHeader("front", seq, seq * 33_000_000, 0, 64, 48, Encoding.BGR8, 64 * 48 * 3)


def test_the_newest_frame_replaces_a_waiting_one(
    form: tuple[StreamForm, list[EncodedFrame], list[str]], monkeypatch: pytest.MonkeyPatch
) -> None:
    made, came, _ = form
    busy, begun = threading.Event(), threading.Event()
    encoding = H264Encoder.encode

    def slowly(self: H264Encoder, *args: Any, **named: Any) -> tuple[bytes, bool]:
        begun.set()
        assert busy.wait(WAIT_S)
        return encoding(self, *args, **named)

    monkeypatch.setattr(H264Encoder, "encode", slowly)
    pixels = np.zeros(64 * 48 * 3, np.uint8)
    made.put(header(1), pixels)
    assert begun.wait(WAIT_S)
    for seq in (2, 3, 4):
        made.put(header(seq), pixels)
    busy.set()
    deadline = time.monotonic() + WAIT_S
    while len(came) < 2:
        assert time.monotonic() < deadline
        time.sleep(0.002)
    assert [one.captured_ns // 33_000_000 for one in came] == [1, 4]
    assert made.skipped == 2


def test_a_failed_encoder_is_reported_and_replaced(
    form: tuple[StreamForm, list[EncodedFrame], list[str]], monkeypatch: pytest.MonkeyPatch
) -> None:
    made, came, failed = form
    told = threading.Event()
    made._fail = lambda why: (failed.append(why), told.set())  # type: ignore[assignment, func-returns-value]
    with monkeypatch.context() as broken:
        broken.setattr(streams, "H264Encoder", lambda *_, **__: (_ for _ in ()).throw(ValueError("no encoder today")))
        made.put(header(1), np.zeros(64 * 48 * 3, np.uint8))
        assert told.wait(WAIT_S)
    assert "no encoder today" in failed[0]
    made.put(header(2), np.zeros(64 * 48 * 3, np.uint8))
    deadline = time.monotonic() + WAIT_S
    while not came:
        assert time.monotonic() < deadline
        time.sleep(0.002)
    assert came[0].key


def test_without_pyav_a_form_is_refused_with_the_package_to_install(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    def missing(purpose: str) -> None:
        raise MissingExtraError(purpose, "video")

    monkeypatch.setattr(streams, "require_pyav", missing)
    app = watcher(bench)
    (event,) = app.told(EventKind.PACKET_MALFORMED)
    assert "skyloop install video" in event.text


def test_large_pictures_of_the_vehicle_are_split(bench: Bench) -> None:
    app = watcher(bench, "stream/front")
    sink = bench.driver.sink
    assert sink is not None
    data = bytes(range(256)) * 600
    assert sink.wants_stream("front")
    sink.stream("front", data, 5, width=4, height=3, key=True)
    app.sync()
    parts = pictures(app)
    assert [(one.piece, one.pieces) for one in parts] == [(0, 3), (1, 3), (2, 3)]
    assert b"".join(one.data for one in parts) == data
    assert msgspec.structs.asdict(parts[0]) | {"data": b"", "piece": 0} == msgspec.structs.asdict(parts[2]) | {
        "data": b"",
        "piece": 0,
    }


@pytest.mark.parametrize(
    "topic",
    [
        "stream/front?kbit_s=nan",
        "stream/front?kbit_s=1",
        "stream/front?subscriber=a/b",
        "stream/front?encoding=jpeg",
        "stream/nose?kbit_s=300",
        "stream/front?part=0/2&kbit_s=300",
        "video/front?encoding=h264&kbit_s=3000000",
    ],
)
def test_nonsensical_topics_are_malformed(bench: Bench, topic: str) -> None:
    app = watcher(bench, topic)
    assert len(app.told(EventKind.PACKET_MALFORMED)) == 1
    assert bench.proxy.publisher.streams.known == ()


def test_a_request_is_refused_with_its_fault() -> None:
    with pytest.raises(UsageError, match="1 to 32 letters"):
        VideoRequest("front", encoding="h264", subscriber="x" * 33)


class OwnStream:
    """A camera that sends its own H.264, 15 pictures a second with a key each second, over a scripted path."""

    def __init__(self, kbit_s: int) -> None:
        self.clock = ManualClock(10**12)
        self.kbit_s = kbit_s
        self.seq = 0
        self.sent: list[EncodedFrame] = []
        camera = CameraInfo("front", 640, 360, 15.0, stream="h264")
        request = VideoRequest.parse(MINE)
        self.form = StreamForm(MINE, request, camera, lambda _: None, lambda _: None, self.clock)
        assert self.form.takes_own
        assert self.form._rate is not None
        self.rate = self.form._rate

    def play(self, seconds: float, *, round_trip_s: float = 0.02, path_kbit_s: float = 1e9) -> list[EncodedFrame]:
        """Let the vehicle send for some time; return its forwarded pictures."""
        before = len(self.sent)
        for _ in range(round(seconds * 15)):
            self.clock.advance(1 / 15)
            self.seq += 1
            size = self.kbit_s * 1000 // 8 // 15
            one = EncodedFrame("front", self.seq, 1, 2, 640, 360, "h264", self.seq % 15 == 0, bytes(size))
            handed = self.form.own(one, 1)
            if handed is not None:
                self.sent.append(handed)
                self.rate.acknowledged(
                    handed.seq, self.clock() + round(1e9 * (round_trip_s + size * 8e-3 / path_kbit_s))
                )
        return self.sent[before:]


def test_the_vehicles_own_pictures_are_forwarded_from_a_key_picture_on_while_the_path_carries_them() -> None:
    camera = OwnStream(1000)
    assert camera.play(3.0) == [], "the rate is not known to be enough"
    camera.rate.kbit_s = 2000
    handed = camera.play(3.0)
    assert handed[0].key
    assert camera.form.passing
    assert [one.seq for one in handed] == list(range(handed[0].seq, handed[0].seq + len(handed)))
    assert {(one.topic, len(one.data)) for one in handed} == {(MINE, 1000 * 1000 // 8 // 15)}
    assert not camera.form.wants(header(1), 1), "nothing is encoded at that time"


def test_pictures_beyond_the_paths_rate_are_encoded_and_retried_later_and_later() -> None:
    camera = OwnStream(1000)
    camera.play(3.0)
    camera.rate.kbit_s = 2000
    camera.play(2.0)
    assert camera.form.passing
    camera.rate.kbit_s = 300
    assert camera.play(0.2) == []
    assert camera.form._needs_encoder, "the next encoded picture is a key picture"
    camera.rate.kbit_s = 2000
    assert camera.play(4.0) == []
    assert camera.play(3.0)
    camera.rate.kbit_s = 300
    camera.play(0.2)
    camera.rate.kbit_s = 2000
    assert camera.play(8.0) == []
    assert camera.play(4.0)


def test_a_subscriber_that_needs_a_key_picture_gets_encoded_ones_until_the_vehicles_next() -> None:
    camera = OwnStream(1000)
    camera.play(3.0)
    camera.rate.kbit_s = 2000
    camera.play(2.2)
    camera.form.report(StreamReport(MINE, 0, wants_key=True), camera.clock())
    assert camera.play(0.1) == []
    assert camera.form.wants(header(1), 1)
    assert camera.play(1.5)[0].key


def test_a_vehicle_that_stops_sending_its_own_pictures_has_its_frames_encoded() -> None:
    camera = OwnStream(1000)
    camera.play(3.0)
    camera.rate.kbit_s = 2000
    assert camera.play(2.0)
    assert camera.form.passing
    camera.clock.advance(1.1)
    assert not camera.form.passing
    assert camera.form.wants(header(1), 1)
    assert camera.form._needs_encoder, "the next encoded picture is a key picture"


def test_only_a_form_for_all_pictures_at_full_size_forwards_the_vehicles_own() -> None:
    camera = CameraInfo("front", 640, 360, 30.0, stream="h264")
    for options in ("subscriber=me&scale=0.5", "max_fps=5&subscriber=me", "kbit_s=500"):
        topic = f"stream/front?{options}"
        request = VideoRequest.parse(topic)
        assert not StreamForm(topic, request, camera, lambda _: None, lambda _: None, time.monotonic_ns).takes_own
