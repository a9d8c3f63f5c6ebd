"""The video of an AR.Drone 1, which arrives as datagrams: pictures from the emulated drone's encoder."""

from __future__ import annotations

import socket
import threading
from collections.abc import Iterator

import numpy as np
import pytest
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from skyloop.clock import ManualClock
from skyloop.drivers.live_video import Coded, VideoEvent
from skyloop.vehicles.ardrone.emulator.video import encode
from skyloop.vehicles.ardrone.video import WAKE, UvlcVideo
from skyloop.vehicles.ardrone.wire.uvlc import UvlcDecoder, is_intra, is_p264
from tests.vehicles.ardrone.video_ports import HOST, PATIENCE_S, Viewer, digest, receiver_of

P264 = bytes.fromhex("00020100") + bytes(60)  # 15 zeros, then 1000000


def picture(n: int) -> NDArray[np.uint8]:
    y, x = np.mgrid[0:240, 0:320]
    return np.stack([(x + 40 * n) % 256, (y * n) % 256, (x + y) % 256], axis=-1).astype(np.uint8)


@pytest.fixture(scope="module")
def packets() -> list[bytes]:
    return [encode(picture(n), n) for n in range(1, 9)]


class UdpPort:
    """Waits for a request, as the drone does."""

    def __init__(self) -> None:
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.bind((HOST, 0))
        self.socket.settimeout(PATIENCE_S)
        self.port: int = self.socket.getsockname()[1]
        self.asker: tuple[str, int] = (HOST, 0)

    def wait(self) -> bytes:
        data, self.asker = self.socket.recvfrom(100)
        return data

    def send(self, data: bytes) -> None:
        self.socket.sendto(data, self.asker)


@pytest.fixture
def port() -> Iterator[UdpPort]:
    port = UdpPort()
    yield port
    port.socket.close()


def test_it_is_woken_up_and_its_pictures_are_shown(port: UdpPort, packets: list[bytes]) -> None:
    viewer, clock = Viewer(), ManualClock()
    receiver = receiver_of(viewer, port.port, version=1, clock=clock)
    receiver.start()
    try:
        assert port.wait() == WAKE
        for n, packet in enumerate(packets, start=1):
            clock.advance(1 / 15)
            port.send(packet)
            viewer.wait(lambda n=n: len(viewer.seen) == n, f"picture {n}")  # type: ignore[misc]
        counters = receiver.counters
    finally:
        receiver.stop()
    decoder = UvlcDecoder()
    true = [(n, digest(decoder.decode(packet).pixels.tobytes())) for n, packet in enumerate(packets, start=1)]
    assert [(number, content) for number, _, content in viewer.seen] == true
    assert viewer.sizes == {(320, 240)}
    assert np.diff([taken_ns for _, taken_ns, _ in viewer.seen]) == pytest.approx(1e9 / 15, abs=1)
    assert (counters.received, counters.frames, counters.damaged) == (8, 8, 0)


def test_the_request_is_repeated(port: UdpPort) -> None:
    viewer, clock = Viewer(), ManualClock()
    receiver = receiver_of(viewer, port.port, version=1, clock=clock)
    receiver.start()
    try:
        for _ in range(3):
            assert port.wait() == WAKE
            clock.advance(0.6)
        clock.advance(5.0)
        viewer.wait(lambda: viewer.texts(VideoEvent.LOST), "the report of silence")
        assert port.wait() == WAKE
    finally:
        receiver.stop()
    assert viewer.texts(VideoEvent.LOST) == [f"{HOST}:{port.port}: no frame arrived for 3 s"]


def test_datagrams_of_others_are_ignored(port: UdpPort, packets: list[bytes]) -> None:
    viewer = Viewer()
    receiver = receiver_of(viewer, port.port, version=1)
    receiver.start()
    try:
        port.wait()
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
            stranger.sendto(packets[0], port.asker)
        port.send(packets[1])
        viewer.wait(lambda: viewer.seen, "a picture")
    finally:
        receiver.stop()
    assert viewer.numbers == [2]


def test_p264_is_refused_with_one_notice(port: UdpPort, packets: list[bytes]) -> None:
    viewer = Viewer()
    receiver = receiver_of(viewer, port.port, version=1)
    receiver.start()
    try:
        port.wait()
        for _ in range(8):
            port.send(P264)
        while receiver.counters.refused < 8:
            threading.Event().wait(0.001)
        port.send(packets[0])
        viewer.wait(lambda: viewer.seen, "a picture after the codec was set")
    finally:
        receiver.stop()
    (text,) = viewer.texts(VideoEvent.UNSUPPORTED)
    assert text.startswith("the drone sends video in P264")
    assert "video:video_codec" in text


def through(packets: list[bytes]) -> tuple[list[int], UvlcVideo]:
    decoder = UvlcVideo()
    shown = []
    for packet in packets:
        decoded = decoder.decode(Coded(packet, is_intra(packet), 0, 0, 0), show=True)
        shown += [decoded[0]] if decoded else []
    return shown, decoder


def test_late_and_repeated_pictures_are_dropped(packets: list[bytes]) -> None:
    shown, decoder = through([packets[n - 1] for n in (1, 3, 2, 3, 4, 4, 6, 5)])
    assert shown == [1, 3, 4, 6]
    assert (decoder.waited, decoder.damaged) == (4, 0)


def test_a_restarted_drone_starts_a_new_count() -> None:
    far = encode(picture(1), 5000)
    shown, _ = through([far, encode(picture(2), 1), far])
    assert shown == [5000, 1, 5000]


def test_a_quickly_restarted_drone_starts_a_new_count_after_a_few_pictures(packets: list[bytes]) -> None:
    shown, decoder = through([encode(picture(1), 40), *packets])
    assert shown == [40, 4, 5, 6, 7, 8]
    assert decoder.waited == 3


@settings(max_examples=40, deadline=None)
@given(st.data())
def test_truncated_datagrams_show_nothing_and_are_counted(draw: st.DataObject) -> None:
    packet = encode(picture(1), 1)
    shown, decoder = through([packet[: draw.draw(st.integers(1, len(packet) - 1))]])
    assert (shown, decoder.damaged) == ([], 1)


@settings(deadline=None)
@given(st.binary(min_size=1, max_size=500))
@example(b"\0\0\1")
def test_noise_shows_nothing_and_is_counted(noise: bytes) -> None:
    assume(not is_p264(noise))  # which is refused with a message
    shown, decoder = through([noise])
    assert (shown, decoder.damaged) == ([], 1)
