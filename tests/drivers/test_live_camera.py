"""Undecoded streams from RTSP, RTP and containers: complete, in order, and with their frames' times."""

from __future__ import annotations

import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest

from skyloop.drivers.h264 import PPS, SPS, START, unit_type, units
from skyloop.drivers.live_camera import LiveCamera, LiveCameraSettings, source_of
from skyloop.drivers.recording_sink import RecordingSink, SeenPicture
from skyloop.errors import UsageError
from skyloop.messages import EventKind, Intrinsics
from skyloop.pyav import new_decoder
from skyloop.transport.testing import wait_until
from skyloop.vehicles.emulation.video import Encoded, Encoder, Format
from tests.support.film import FPS, GROUP, HEIGHT, WIDTH, Film, Projector, number_of, picture_of
from tests.support.rtsp_server import HOST, RtpPacker, RtspServer, free_port

av = pytest.importorskip("av")
PATIENCE_S = 30.0


@contextmanager
def camera(address: str, sink: RecordingSink) -> Iterator[LiveCamera]:
    settings = LiveCameraSettings(source_of(address, "camera"), "front", WIDTH, HEIGHT, FPS)
    running = LiveCamera(settings, sink, lambda width, _height: Intrinsics(float(width), 50.0, 1.0, 2.0))
    running.start()
    try:
        yield running
    finally:
        running.stop()
    assert not sink.problems


def told(sink: RecordingSink) -> list[str]:
    return [event.text for event in sink.events]


def decoded(pictures: list[SeenPicture]) -> list[int]:
    """Return the numbers in forwarded pictures, decoded strictly from the first one."""
    context = new_decoder("h264", "a test")
    return [
        number_of(np.asarray(image.to_ndarray(format="bgr24"), np.uint8))
        for picture in pictures
        for image in context.decode(av.Packet(picture.data))
    ]


def came(sink: RecordingSink, count: int) -> None:
    wanted = len(sink.pictures) + count
    assert sink.wait(lambda: len(sink.pictures) >= wanted, PATIENCE_S), (len(sink.pictures), told(sink))


@pytest.mark.parametrize("way", ["tcp", "udp"])
def test_a_stream_is_forwarded_with_the_times_of_its_frames(way: str) -> None:
    film = Film()
    sent: list[bytes] = []
    sink = RecordingSink(record=True)
    with RtspServer(film.next().payload, ways=(way,)) as server, camera(server.address, sink):

        def send(picture: bytes, stamp_s: float) -> None:
            sent.append(picture)
            server.send(picture, stamp_s)

        with Projector(send, film):
            came(sink, 3 * GROUP)
    pictures = list(sink.pictures)
    assert pictures[0].key
    numbers = decoded(pictures)
    assert numbers == list(range(numbers[0], numbers[0] + len(numbers)))
    assert [units(picture.data) for picture in pictures] == [
        units(sent[number - 1]) for number in numbers
    ]  # the first one was for the server
    assert {(picture.width, picture.height) for picture in pictures} == {(WIDTH, HEIGHT)}
    assert {picture.intrinsics for picture in pictures} == {Intrinsics(float(WIDTH), 50.0, 1.0, 2.0)}
    times = {number_of(frame.pixels): frame.captured_ns for frame in sink.frames}
    both = [
        (times[number], picture.captured_ns)
        for number, picture in zip(numbers, pictures, strict=True)
        if number in times
    ]
    assert len(both) > GROUP
    assert all(of_frame == of_picture for of_frame, of_picture in both)


def test_nothing_is_decoded_for_a_stream_that_can_lose_nothing() -> None:
    sink = RecordingSink(watch=set(), record=True)
    with RtspServer(Film().next().payload, ways=("tcp",)) as server, camera(server.address, sink) as running:
        with Projector(server.send):
            came(sink, GROUP)
        assert running._video._decoder is not None
        assert running._video._decoder.waited == 0
        assert running.telemetry()["camera.frames"] == 0
    assert not sink.frames


def test_a_late_subscriber_starts_with_a_key_picture() -> None:
    sink = RecordingSink(watch=set())
    with RtspServer(Film().next().payload) as server, camera(server.address, sink) as running, Projector(server.send):
        for _ in range(2):
            wanted = int(str(running.telemetry()["camera.received"])) + 5
            wait_until(lambda: int(str(running.telemetry()["camera.received"])) >= wanted, "pictures")  # noqa: B023
            assert not sink.pictures
            sink.record = True
            came(sink, 5)
            assert sink.pictures[0].key
            sink.record = False
            wanted = int(str(running.telemetry()["camera.received"])) + 2
            wait_until(lambda: int(str(running.telemetry()["camera.received"])) >= wanted, "pictures")  # noqa: B023
            sink.pictures.clear()


def test_parameter_sets_from_the_sdp_precede_each_key_picture() -> None:
    sink = RecordingSink(record=True)
    film = Film()
    with RtspServer(film.next().payload) as server, camera(server.address, sink):

        def send(picture: bytes, stamp_s: float) -> None:
            server.send(START + START.join(u for u in units(picture) if unit_type(u) not in (SPS, PPS)), stamp_s)

        with Projector(send, film):
            came(sink, 2 * GROUP)
    keys = [picture for picture in sink.pictures if picture.key]
    assert len(keys) > 1
    for key in keys:
        assert [unit_type(unit) for unit in units(key.data)][:2] == [SPS, PPS]
    assert len(decoded(list(sink.pictures))) == len(sink.pictures)


# RTP without a server ------------------------------------------------------------------------------------------------


class RtpSender:
    """Sends a projector's pictures to a port, in RTP; ``lost`` decides for each packet whether it gets lost."""

    def __init__(self, port: int, lost: Callable[[int], bool] = lambda _: False) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._to = (HOST, port)
        self._packer = RtpPacker(300)
        self._lost = lost
        self.packets = 0

    def send(self, picture: bytes, stamp_s: float) -> None:
        for packet in self._packer.packets(picture, stamp_s):
            self.packets += 1
            if not self._lost(self.packets):
                self._socket.sendto(packet, self._to)

    def close(self) -> None:
        self._socket.close()


def test_rtp_over_udp_is_shown_and_forwarded() -> None:
    port, sink = free_port(), RecordingSink(record=True)
    sender = RtpSender(port)
    with camera(f"rtp://{HOST}:{port}", sink), Projector(sender.send):
        came(sink, 2 * GROUP)
        assert sink.wait(lambda: sink.frame_counts["front"] > GROUP, PATIENCE_S)
    sender.close()
    numbers = decoded(list(sink.pictures))
    assert numbers == list(range(numbers[0], numbers[0] + len(sink.pictures)))


def test_only_whole_pictures_of_lossy_rtp_are_shown_and_forwarded() -> None:
    chance = np.random.default_rng(3)
    port, sink = free_port(), RecordingSink(record=True)
    sender = RtpSender(port, lambda _: bool(chance.random() < 0.01))
    with camera(f"rtp://{HOST}:{port}", sink), Projector(sender.send):
        came(sink, 2 * GROUP)
        assert sink.wait(lambda: sink.frame_counts["front"] > 2 * GROUP, PATIENCE_S)
    sender.close()
    context, film = new_decoder("h264", "a test"), Film()
    right = [
        image.to_ndarray(format="bgr24")
        for _ in range(1 + max(number_of(frame.pixels) for frame in sink.frames))
        for image in context.decode(av.Packet(film.next().payload))
    ]
    for frame in sink.frames:
        assert np.array_equal(frame.pixels, right[number_of(frame.pixels)])
    numbers = decoded(list(sink.pictures))
    assert len(numbers) == len(sink.pictures)
    assert numbers == sorted(set(numbers))


# Streams that can't be forwarded -------------------------------------------------------------------------------------


class TcpFilm:
    """A film in a container, sent in a loop to one client after another until it is closed."""

    def __init__(self, film: bytes) -> None:
        self._film = film
        self._listener = socket.create_server((HOST, 0))
        self.address = f"tcp://{HOST}:{self._listener.getsockname()[1]}"
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._thread.start()

    def _serve(self) -> None:
        while not self._ended.is_set():
            try:
                connection, _ = self._listener.accept()
            except OSError:
                return
            with connection:
                try:
                    connection.sendall(self._film)
                    self._ended.wait(0.3)
                except OSError:
                    continue

    def close(self) -> None:
        self._ended.set()
        self._listener.shutdown(socket.SHUT_RDWR)
        self._listener.close()
        self._thread.join(5.0)


def container(codec: str, form: str, path: Path, b_frames: int = 0, **options: str) -> bytes:
    with av.open(str(path), "w", format=form) as out:
        stream = out.add_stream(codec, rate=25)
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, "yuv420p"
        stream.codec_context.max_b_frames = b_frames
        stream.codec_context.gop_size = GROUP
        stream.options = options
        stream.codec_context.framerate = Fraction(25)
        for number in range(40):
            out.mux(stream.encode(av.VideoFrame.from_ndarray(picture_of(number), format="bgr24")))
        out.mux(stream.encode(None))
    return path.read_bytes()


def test_h264_in_a_container_becomes_a_stream(tmp_path: Path) -> None:
    film = TcpFilm(container("libx264", "flv", tmp_path / "a.flv", tune="zerolatency", preset="ultrafast"))
    sink = RecordingSink(record=True)
    with camera(film.address, sink):
        came(sink, 30)
        assert sink.wait(lambda: sink.frame_counts["front"] > 0, PATIENCE_S), told(sink)
    film.close()
    numbers = decoded(list(sink.pictures)[:30])
    assert numbers == list(range(30))
    assert sink.pictures[0].key
    times = {number_of(frame.pixels): frame.captured_ns for frame in sink.frames}
    assert times
    assert {sink.pictures[0].width} == {WIDTH}


@pytest.mark.parametrize(
    ("codec", "form", "b_frames", "options", "why"),
    [
        ("libx264", "flv", 2, {"x264-params": "b-adapt=0:scenecut=0"}, "pictures refer to later ones (B-frames)"),
        ("mpeg4", "matroska", 0, {}, "the video is mpeg4, not H.264"),
    ],
)
def test_a_stream_that_can_not_be_forwarded_is_reported_once_and_shown(
    tmp_path: Path, codec: str, form: str, b_frames: int, options: dict[str, str], why: str
) -> None:
    film = TcpFilm(container(codec, form, tmp_path / "film", b_frames, **options))
    sink = RecordingSink(record=True)
    with camera(film.address, sink) as running:
        assert sink.wait(lambda: sink.frame_counts["front"] > 5, PATIENCE_S)
        wait_until(lambda: int(str(running.telemetry()["camera.reconnects"])) > 0, "the stream is reopened")
    film.close()
    (text,) = [text for text in told(sink) if "original stream" in text]
    assert why in text
    assert {event.kind for event in sink.events if "original stream" in event.text} == {EventKind.VEHICLE_MESSAGE}
    numbers = [number_of(frame.pixels) for frame in sink.frames]
    assert set(numbers) <= set(range(40))


class Refreshed(Film):
    """A film refreshed stripe by stripe, with its only key picture at the start."""

    def __init__(self, *, without_key: bool) -> None:
        super().__init__()
        context = av.CodecContext.create("libx264", "w")
        context.width, context.height, context.pix_fmt = WIDTH, HEIGHT, "yuv420p"
        context.framerate, context.time_base, context.max_b_frames = Fraction(25), Fraction(1, 25), 0
        refresh = "intra-refresh=1:keyint=10:scenecut=0:repeat-headers=1:sliced-threads=0:threads=1"
        context.options = {"preset": "ultrafast", "tune": "zerolatency", "x264-params": refresh}
        self._context = context
        if without_key:
            self.next()

    def next(self) -> Encoded:
        frame = av.VideoFrame.from_ndarray(picture_of(self.number), format="bgr24").reformat(format="yuv420p")
        frame.pts, frame.time_base = self.number, self._context.time_base
        self.number += 1
        data = b"".join(bytes(packet) for packet in self._context.encode(frame))
        return Encoded(data, self.number == 1)


def test_a_stream_without_key_pictures_is_left_to_ffmpeg_and_reported(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("skyloop.drivers.live_container.STRICT_S", 0.5)
    monkeypatch.setattr("skyloop.drivers.live_video.KEYLESS", 10)
    sink = RecordingSink(record=True)
    with RtspServer(Refreshed(without_key=False).next().payload) as server, camera(server.address, sink):
        with Projector(server.send, Refreshed(without_key=True)):
            assert sink.wait(lambda: sink.frame_counts["front"] > 5, PATIENCE_S), told(sink)
        with Projector(server.send):  # with key pictures, damage is rejected again
            came(sink, GROUP)
    assert any("no flawless key picture arrived" in text for text in told(sink))
    assert any("without a key picture (IDR)" in text for text in told(sink))
    assert not [event for event in sink.events if event.kind is EventKind.DRIVER_ERROR]


def test_another_size_is_shown_and_forwarded_from_its_key_picture_on() -> None:
    small = Film()
    small._encoder = Encoder(Format("h264", WIDTH // 2, HEIGHT // 2, 0), FPS, 2000, group=GROUP)
    sink = RecordingSink(record=True)
    with RtspServer(Film().next().payload) as server, camera(server.address, sink):
        with Projector(server.send):
            came(sink, GROUP)
        with Projector(server.send, small):
            assert sink.wait(lambda: sink.frames[-1].width == WIDTH // 2, PATIENCE_S)
            came(sink, GROUP)
    sizes = [(picture.width, picture.key) for picture in sink.pictures]
    first = sizes.index((WIDTH // 2, True))
    assert {width for width, _ in sizes[:first]} == {WIDTH}
    assert {width for width, _ in sizes[first:]} == {WIDTH // 2}
    intrinsics = sink.pictures[-1].intrinsics
    assert intrinsics is not None
    assert intrinsics.fx == WIDTH // 2


# Addresses -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("address", "message"),
    [
        ("rtp://camera.local:5600", "needs an IP address of this host"),
        ("rtp://:5600?payload=128", "payload is '128' and must be a number from 0 to 127"),
        ("rtp://:5600?codec=vp8", "codec is 'vp8' and must be one of h264, h265"),
        ("rtp://:5600?speed=2", "options codec and payload, got speed"),
        ("rtp://:0", "names no host"),
        ("ftp://here/there", "must be one of rtsp://…, rtp://…"),
        ("clip.mp4", "or a device: /dev/video…"),
    ],
)
def test_bad_addresses_are_refused(address: str, message: str) -> None:
    with pytest.raises(UsageError, match=message):
        source_of(address, "camera")


def test_rtp_is_described_for_ffmpeg() -> None:
    plain = source_of("rtp://", "camera").sdp.splitlines()
    assert "m=video 5600 RTP/AVP 96" in plain
    assert "c=IN IP4 0.0.0.0" in plain
    other = source_of("rtp://[ff02::1]:6000?payload=97&codec=h265", "camera").sdp.splitlines()
    assert "c=IN IP6 ff02::1" in other
    assert "a=rtpmap:97 H265/90000" in other
    assert not any(line.startswith("a=fmtp") for line in other)
