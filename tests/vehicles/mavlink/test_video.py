"""A camera beside the autopilot: over RTSP, and as a device as far as possible without a camera."""

from __future__ import annotations

import os
import socket
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from skyloop.clock import monotonic_ns
from skyloop.drivers import live_camera as camera
from skyloop.drivers.recording_sink import RecordingSink
from skyloop.drivers.uri import parse_uri
from skyloop.errors import UsageError
from skyloop.messages import EventKind
from skyloop.transport.testing import wait_until
from skyloop.vehicles.mavlink import emulator
from skyloop.vehicles.mavlink.driver import MavlinkDriver
from skyloop.vehicles.mavlink.emulator import Kind, Ports, TransportStream
from tests.support.film import FPS, HEIGHT, WIDTH, Film, Projector, number_of, picture_of
from tests.support.rtsp_server import HOST, RtspServer
from tests.vehicles.ardrone.video_ports import TcpPort

PATIENCE_S = 30.0
CLOSE_S = 6.0  #: closing waits 4 s at most; the rest is for a busy machine


def key_picture() -> bytes:
    return Film().next().payload


@contextmanager
def watching(source: str, sink: RecordingSink | None = None) -> Iterator[tuple[MavlinkDriver, RecordingSink]]:
    """Watch a camera of a vehicle that is never received. Closing must be quick, and nothing reported afterwards."""
    sink = sink or RecordingSink()
    nobody = f"mavlink://udpin:127.0.0.1:{Ports.free(Kind.PX4).remote}"
    driver = MavlinkDriver(parse_uri(f"{nobody}?camera={source}"))
    driver.open(sink)
    try:
        yield driver, sink
    finally:
        begun_ns = monotonic_ns()
        driver.close()
        took_s = (monotonic_ns() - begun_ns) / 1e9
    calls = sink.calls
    assert took_s < CLOSE_S
    assert not sink.problems
    threading.Event().wait(0.05)
    assert sink.calls == calls, "it reported something after it was closed"


def told(sink: RecordingSink) -> list[str]:
    return [event.text for event in list(sink.events) if event.data.get("where") == "camera"]


def states(sink: RecordingSink) -> list[str]:
    return [text.split(":")[0] for text in told(sink)]


def is_told(sink: RecordingSink, text: str) -> None:
    assert sink.wait(lambda: any(text in each for each in told(sink)), PATIENCE_S), told(sink)


def shows(sink: RecordingSink, count: int) -> None:
    wanted = sink.frame_counts["front"] + count
    assert sink.wait(lambda: sink.frame_counts["front"] >= wanted, PATIENCE_S), (sink.frame_counts, told(sink))


# RTSP ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("way", ["tcp", "udp"])
def test_images_arrive_in_order_with_their_capture_times(way: str) -> None:
    with (
        RtspServer(key_picture(), ways=(way,)) as server,
        watching(server.address) as (_, sink),
        Projector(server.send) as projector,
    ):
        shows(sink, 40)
    numbers = [number_of(frame.pixels) for frame in sink.frames]
    assert numbers == sorted(set(numbers))
    assert len(numbers) > 0.8 * (numbers[-1] - numbers[0])  # a busy machine skips some
    late_s = [(frame.captured_ns - projector.taken_ns[number_of(frame.pixels)]) / 1e9 for frame in sink.frames]
    assert min(late_s) > -0.01, "no image arrives before its capture"
    assert float(np.median(late_s)) < 0.05
    ages_s = [(frame.arrived_ns - frame.captured_ns) / 1e9 for frame in sink.frames]
    assert 1 / FPS * 0.8 < float(np.median(ages_s)) < 0.5
    assert {(frame.width, frame.height) for frame in sink.frames} == {(WIDTH, HEIGHT)}
    assert states(sink) == ["camera streaming"]


def test_unwatched_images_are_not_decoded_and_a_new_viewer_gets_the_newest() -> None:
    sink = RecordingSink(watch=set())
    with RtspServer(key_picture()) as server, watching(server.address, sink) as (driver, _), Projector(server.send):
        wait_until(lambda: counts(driver)["camera.received"] > 25, "images arrive")
        assert counts(driver)["camera.frames"] == 0
        looked_ns = monotonic_ns()
        sink.watch = None
        shows(sink, 5)
        assert counts(driver)["camera.skipped"] == 0
    assert all(frame.captured_ns > looked_ns - 0.5e9 for frame in sink.frames)


def counts(driver: MavlinkDriver) -> dict[str, int]:
    return {name: int(value) for name, value in driver._camera_telemetry().items()}  # type: ignore[arg-type]


class SlowSink(RecordingSink):
    """Keeps the first image until it is released."""

    def __init__(self) -> None:
        super().__init__()
        self.begun, self.gate = threading.Event(), threading.Event()

    def frame(self, *given: object, **named: object) -> None:
        super().frame(*given, **named)  # type: ignore[arg-type]
        self.begun.set()
        self.gate.wait(PATIENCE_S)


def test_a_slow_reader_gets_the_newest_images() -> None:
    sink = SlowSink()
    with (
        RtspServer(key_picture()) as server,
        watching(server.address, sink) as (driver, _),
        Projector(server.send) as projector,
    ):
        try:
            assert sink.begun.wait(PATIENCE_S)
            before = counts(driver)["camera.received"]
            wait_until(lambda: counts(driver)["camera.received"] > before + 30, "images arrive meanwhile")
        finally:
            sink.gate.set()
        shows(sink, 10)
        skipped = counts(driver)["camera.skipped"]
    numbers = [number_of(frame.pixels) for frame in sink.frames]
    assert numbers[1] - numbers[0] > 25
    assert numbers == sorted(set(numbers))
    assert skipped > 25
    assert sink.frames[1].arrived_ns - projector.taken_ns[numbers[1]] < 1e9


@pytest.mark.parametrize("abruptly", [False, True])
def test_a_server_that_ends_and_returns_is_found_again(abruptly: bool) -> None:
    with RtspServer(key_picture()) as server, watching(server.address) as (_, sink), Projector(server.send):
        shows(sink, 5)
        server.stop(abruptly=abruptly)
        assert sink.wait(lambda: "camera lost" in states(sink), PATIENCE_S), told(sink)
        is_told(sink, "Connection refused")
        server.start()
        shows(sink, 5)
        seen = states(sink)
    assert seen[0] == seen[-1] == "camera streaming"
    assert set(seen[1:-1]) == {"camera lost"}
    lost = [event for event in sink.events if event.text.startswith("camera lost")]
    assert {str(event.kind) for event in lost} == {"vehicle_message"}
    assert len({event.text for event in lost}) == len(lost), "each reason is reported once"


def test_a_silent_server_is_reported_and_found_again() -> None:
    with (
        RtspServer(key_picture()) as server,
        watching(server.address) as (_, sink),
        Projector(server.send) as projector,
    ):
        shows(sink, 3)
        projector.paused.set()
        is_told(sink, "nothing received for 1.5 s")
        projector.paused.clear()
        shows(sink, 3)


def test_a_wrong_path_is_reported() -> None:
    with RtspServer(key_picture()) as server, watching(f"rtsp://{HOST}:{server.port}/dead") as (_, sink):
        is_told(sink, "404 Not Found")
        wait_until(lambda: server.requests.count("DESCRIBE") > 2, "it tries again")
        assert len(told(sink)) == 1
    assert sink.events[-1].kind is EventKind.VEHICLE_MESSAGE


def test_a_password_is_used_and_never_shown() -> None:
    with RtspServer(key_picture(), user="admin:s3cret") as server:
        with watching(server.address) as (_, sink):
            is_told(sink, "401 Unauthorized")
        address = server.address.replace("://", "://admin:s3cret@")
        with watching(address) as (_, sink), Projector(server.send):
            shows(sink, 2)
            server.stop()
            is_told(sink, "camera lost")
        assert not [event for event in sink.events if "s3cret" in event.text]
        assert server.address in told(sink)[0]


def test_a_port_without_a_server_is_reported() -> None:
    with watching(f"rtsp://{HOST}:{Ports.free(Kind.PX4).remote}/live") as (_, sink):
        is_told(sink, "Connection refused")


def test_a_host_that_does_not_answer_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(camera, "OPEN_S", 1.0)
    with socket.create_server((HOST, 0), backlog=0) as full, socket.socket() as first, socket.socket() as second:
        for each in (first, second):  # the kernel drops connection requests beyond its backlog
            each.setblocking(False)
            each.connect_ex(full.getsockname())
        with watching(f"rtsp://{HOST}:{full.getsockname()[1]}/live") as (_, sink):
            is_told(sink, "no answer, or no frame, within 1 s")


def test_a_host_without_an_address_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    def nobody(*_: object, **__: object) -> None:
        raise socket.gaierror(socket.EAI_NONAME, "Name or service not known")

    monkeypatch.setattr("socket.getaddrinfo", nobody)
    with watching("rtsp://camera.invalid/live") as (_, sink):
        is_told(sink, "rtsp://camera.invalid/live: Name or service not known")


def test_a_server_that_never_answers_is_reported_and_does_not_delay_closing(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    asked = threading.Event()

    def silent(connection: socket.socket) -> None:
        connection.recv(1)
        asked.set()
        while connection.recv(4096):
            pass

    with TcpPort(silent) as port:
        with watching(f"rtsp://{HOST}:{port.port}/live") as (_, sink):
            assert asked.wait(PATIENCE_S)
        assert not told(sink)
        monkeypatch.setattr(camera, "OPEN_S", 1.0)
        with watching(f"rtsp://{HOST}:{port.port}/live") as (_, sink):
            is_told(sink, "no answer, or no frame, within 1 s")


def test_noise_in_place_of_answers_is_reported() -> None:
    def noise(connection: socket.socket) -> None:
        connection.recv(4096)
        connection.sendall(np.random.default_rng(2).bytes(20_000))

    with TcpPort(noise) as port, watching(f"rtsp://{HOST}:{port.port}/live") as (_, sink):
        is_told(sink, "camera lost")
        assert "camera streaming" not in states(sink)


def test_a_stream_that_is_noise_from_the_start_is_reported() -> None:
    with RtspServer() as server, watching(server.address) as (_, sink), Projector(server.send) as projector:
        projector.spoilt.set()
        assert sink.wait(lambda: bool(told(sink)), PATIENCE_S)
        assert states(sink) == ["camera lost"]
        projector.spoilt.clear()
        shows(sink, 3)


def test_a_stream_that_becomes_noise_is_reported_and_shown_again_afterwards() -> None:
    with (
        RtspServer(key_picture()) as server,
        watching(server.address) as (_, sink),
        Projector(server.send) as projector,
    ):
        shows(sink, 3)
        projector.spoilt.set()
        is_told(sink, "nothing received could be decoded")
        projector.spoilt.clear()
        shows(sink, 3)
        numbers = [number_of(frame.pixels) for frame in sink.frames]
    assert numbers == sorted(numbers)
    (event,) = [event for event in sink.events if "could be decoded" in event.text]
    assert event.kind is EventKind.DRIVER_ERROR


@pytest.mark.parametrize("source", ["rtsp://", "rtsp:///live", "rtsp://[::1/live", "rtsp://here:port/live", "tcp://:5"])
def test_an_address_without_a_host_is_refused(source: str) -> None:
    with pytest.raises(UsageError, match="names no host"):
        MavlinkDriver(parse_uri(f"mavlink://udpin:127.0.0.1:14540?camera={source}"))


def test_images_close_together_get_different_stamps() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as listener:
        listener.bind((HOST, 0))
        stream = TransportStream(HOST, listener.getsockname()[1])
        for number in range(12):  # FFmpeg refuses a second image with the same stamp
            stream.pack(picture_of(number), emulator._SETTINGS, number * 20_000_000)
        stream.close()
        assert listener.recv(2048)[0] == 0x47


# Devices ---------------------------------------------------------------------------------------------------------

needs_dev = pytest.mark.skipif(not Path("/dev/shm").is_dir(), reason="a file that looks like a device needs /dev/shm")


@pytest.fixture
def device(monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A pipe below /dev to read raw images from, with the options that a camera needs."""
    monkeypatch.setattr(camera, "DEVICE_FORMAT", "rawvideo")
    with tempfile.TemporaryDirectory(dir="/dev/shm", prefix="skyloop-") as folder:
        yield Path(folder) / "video0"


def feed(device: Path, ended: Callable[[], bool]) -> None:
    """Write grey images, 64×48, as yuv420p, at 25 a second."""
    os.mkfifo(device)
    pause = threading.Event()
    with device.open("wb", buffering=0) as pipe:
        number = 0
        while not ended():
            try:
                pipe.write(bytes([40 + number % 160]) * (64 * 48) + b"\x80" * (64 * 48 // 2))
            except BrokenPipeError:
                break
            number += 1
            pause.wait(1 / FPS)
    device.unlink()


@needs_dev
def test_a_device_is_set_to_its_size_shown_missed_and_found_again(device: Path) -> None:
    sink = RecordingSink()
    asked = f"{device}&camera_width=64&camera_height=48&camera_fps=25"
    with watching(asked, sink):
        is_told(sink, "there is no such device")
        for _ in range(2):
            wanted = sink.frame_counts["front"] + 10
            begun = time.monotonic()
            thread = threading.Thread(
                target=feed,
                args=(device, lambda: sink.frame_counts["front"] >= wanted or time.monotonic() > begun + PATIENCE_S),  # noqa: B023
            )
            thread.start()
            shows(sink, 10)
            thread.join(PATIENCE_S)
            is_told(sink, "the stream ended")
        seen = states(sink)
    assert seen.count("camera streaming") == 2
    assert {(frame.width, frame.height) for frame in sink.frames} == {(64, 48)}
    levels = [float(frame.pixels.mean()) for frame in list(sink.frames)[:10]]
    assert levels == sorted(levels)


def test_the_tests_images_carry_their_numbers() -> None:
    assert [number_of(picture_of(number)) for number in (0, 1, 77, 4095)] == [0, 1, 77, 4095]
