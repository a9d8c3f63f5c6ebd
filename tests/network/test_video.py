"""The transport server's video: encoding, receivers, and slow readers."""

from __future__ import annotations

import threading
from collections.abc import Hashable, Iterator

import numpy as np
import pytest

from skyloop.clock import ManualClock
from skyloop.messages import Encoding, FrameHeader, Intrinsics
from skyloop.messages.subscription import VideoRequest
from skyloop.network.frames import LOST_NS, WINDOW, FramePublisher, FrameVariant
from skyloop.transport import frame_encoding
from skyloop.transport.testing import header, picture, wait_until

cv2 = pytest.importorskip("cv2", reason="encoded video needs the extra 'network'")
PLAIN = "video/front"
SMALL = VideoRequest("front", scale=0.5).topic
JPEG = VideoRequest("front", encoding="jpeg").topic


class Network:
    """Records sends: topic, frame, and receivers (None: all)."""

    def __init__(self) -> None:
        self.sent: list[tuple[str, int, tuple[Hashable, ...] | None]] = []
        self.numbers: list[int] = []
        self.headers: list[FrameHeader] = []
        self.gate = threading.Event()
        self.gate.set()
        self.clock = ManualClock()
        self.video = FramePublisher(self.send, "alpha", self.clock)

    def send(
        self, variant: FrameVariant, number: int, head: FrameHeader, data: bytes, to: tuple[Hashable, ...] | None
    ) -> None:
        self.gate.wait(5.0)
        assert len(data) == head.size
        self.headers.append(head)
        self.numbers.append(number)
        self.sent.append((variant.request.topic, head.seq, to))

    def publish(self, seq: int) -> int:
        return self.video.publish(header(seq), picture(header(seq)))

    def sends(self, count: int) -> list[tuple[str, int, tuple[Hashable, ...] | None]]:
        wait_until(lambda: len(self.sent) >= count, f"{count} frames were sent")
        return self.sent


@pytest.fixture
def network() -> Iterator[Network]:
    made = Network()
    yield made
    made.gate.set()
    made.video.end()


def test_without_readers_nothing_is_sent(network: Network) -> None:
    assert network.publish(1) == 0
    assert network.video.readers("front") == 0
    assert not network.video.subscribe("a", "video/front?scale=7")
    network.video.unsubscribe("a", "video/front?scale=7")
    network.video.taken("a", PLAIN, 1)
    network.video.leave("a")


def test_one_send_serves_all_readers_of_one_form(network: Network) -> None:
    for key in "abc":
        assert network.video.subscribe(key, PLAIN)
    assert network.publish(1) == 0
    assert network.sends(1) == [(PLAIN, 1, None)]


def test_a_slow_reader_misses_frames_while_others_continue_and_gets_the_newest(network: Network) -> None:
    network.video.subscribe("fast", PLAIN)
    network.video.subscribe("slow", PLAIN)
    for seq in range(WINDOW):
        assert network.publish(seq) == 0
        network.sends(seq + 1)
        network.video.taken("fast", PLAIN, network.numbers[-1])
    for seq in range(WINDOW, 5):
        assert network.publish(seq) == 1
        assert network.sends(seq + 1)[-1] == (PLAIN, seq, ("fast",))
        network.video.taken("fast", PLAIN, network.numbers[-1])
    network.video.taken("slow", PLAIN, network.numbers[0])
    assert network.sends(6)[-1] == (PLAIN, 4, ("slow",))


def test_the_newest_replaces_a_waiting_one(network: Network) -> None:
    network.gate.clear()  # encoding and sending take long
    network.video.subscribe("a", PLAIN)
    assert network.publish(0) == 0
    wait_until(lambda: not network.video._variants["front"][PLAIN].readers["a"].due, "it is being sent")
    assert [network.publish(seq) for seq in range(1, 10)] == [0] * (WINDOW - 1) + [1] * (10 - WINDOW)
    network.gate.set()
    assert network.sends(2) == [(PLAIN, 0, None), (PLAIN, 9, None)]


def test_an_unacknowledged_frame_counts_as_lost(network: Network) -> None:
    network.video.subscribe("a", PLAIN)
    for seq in range(WINDOW):
        network.publish(seq)
        network.sends(seq + 1)
    assert network.publish(WINDOW) == 1
    network.clock.advance(LOST_NS / 1e9 + 0.1)
    assert network.publish(WINDOW + 1) == 0
    assert network.sends(WINDOW + 1)[-1] == (PLAIN, WINDOW + 1, None)


def test_each_form_is_encoded_once_and_readers_that_leave_cost_nothing(network: Network) -> None:
    for key in "ab":
        network.video.subscribe(key, SMALL)
        network.video.subscribe(key, JPEG)
    assert network.video.readers("front") == 4
    network.publish(1)
    assert sorted(network.sends(2)) == [(JPEG, 1, None), (SMALL, 1, None)]
    network.video.unsubscribe("a", SMALL)
    network.video.leave("b")
    assert network.video.readers("front") == 1
    network.publish(2)
    assert network.sends(3)[2:] == [(JPEG, 2, None)]


def test_without_an_encoder_frames_are_sent_unencoded_and_that_is_logged_once(
    network: Network, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setitem(__import__("sys").modules, "cv2", None)
    network.video.subscribe("a", JPEG)
    for seq in range(2):
        network.publish(seq)
        network.sends(seq + 1)
        assert network.headers[-1].encoding is Encoding.BGR8
        network.video.taken("a", JPEG, network.numbers[-1])
    assert len([record for record in caplog.records if "is sent unencoded" in record.getMessage()]) == 1


def test_a_failed_send_costs_one_frame(caplog: pytest.LogCaptureFixture) -> None:
    sent: list[int] = []

    def send(variant: FrameVariant, number: int, head: FrameHeader, data: bytes, to: object) -> None:
        if head.seq == 0:
            raise OSError("on purpose")
        sent.append(head.seq)

    video = FramePublisher(send, "alpha")
    video.subscribe("a", PLAIN)
    for seq in range(2):
        video.publish(header(seq), picture(header(seq)))
        wait_until(lambda: not video._variants["front"][PLAIN].readers["a"].due, "it is being sent")
    wait_until(lambda: sent == [1], "the next one was sent")
    video.end()
    assert "could not be sent" in caplog.text


# --- images ---


def test_jpeg_of_each_encoding() -> None:
    gradient = np.linspace(0, 255, 32 * 24, dtype=np.uint8).reshape(24, 32)
    for encoding, pixels in (
        (Encoding.BGR8, np.dstack([gradient, gradient // 2, gradient // 4])),
        (Encoding.RGB8, np.dstack([gradient // 4, gradient // 2, gradient])),
        (Encoding.MONO8, gradient),
    ):
        head = FrameHeader("front", 1, 1, 1, 32, 24, encoding, pixels.size)
        made, data = frame_encoding.encode_frame(
            head, np.ascontiguousarray(pixels), VideoRequest("front", encoding="jpeg")
        )
        assert made.encoding is Encoding.JPEG
        assert made.size == len(data) < pixels.size
        shown = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
        expected = (
            np.dstack([gradient] * 3)
            if encoding is Encoding.MONO8
            else np.dstack([gradient, gradient // 2, gradient // 4])
        )
        assert np.abs(shown.astype(int) - expected).max() < 24


def test_quality_is_selectable_and_jpeg_is_not_encoded_again() -> None:
    noise = np.random.default_rng(1).integers(0, 255, (48, 64, 3), np.uint8)
    head = FrameHeader("front", 1, 1, 1, 64, 48, Encoding.BGR8, noise.size)
    sizes = [
        frame_encoding.encode_frame(head, noise, VideoRequest("front", encoding="jpeg", quality=quality))[0].size
        for quality in (10, 50, 95)
    ]
    assert sizes == sorted(sizes)
    made, data = frame_encoding.encode_frame(head, noise, VideoRequest("front", encoding="jpeg"))
    again = frame_encoding.encode_frame(made, np.frombuffer(data, np.uint8), VideoRequest("front", scale=0.5))
    assert again == (made, data)


def test_intrinsics_follow_the_size() -> None:
    lens = Intrinsics(300.0, 300.0, 159.5, 119.5)
    head = FrameHeader("front", 1, 1, 1, 320, 240, Encoding.BGR8, 320 * 240 * 3, lens)
    small = frame_encoding.scaled_header(head, 0.5)
    assert (small.width, small.height, small.size) == (160, 120, 160 * 120 * 3)
    assert small.intrinsics == Intrinsics(150.0, 150.0, 79.5, 59.5)
    assert frame_encoding.scaled_header(head, 0.001).width == 1
