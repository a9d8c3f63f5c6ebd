"""H.264 from the proxy to the application: encoded once per form, decoded, and damaged on the way."""

from __future__ import annotations

import itertools
import queue
import threading
import time
from collections.abc import Iterator
from unittest.mock import Mock

import msgspec
import numpy as np
import pytest

from skyloop.client import Drone, video
from skyloop.client.video import MOST_WAITING, StreamChannel, StreamDecoder
from skyloop.errors import UsageError
from skyloop.messages import EncodedFrame
from skyloop.messages.frame import Chain
from skyloop.proxy.streams import IDLE_S, MAX_FORMS
from skyloop.pyav import H264Encoder
from skyloop.transport.base import Pixels
from skyloop.transport.testing import wait_until
from tests.support.nodes import WAIT_S, Node, far, near_node, node, take

av = pytest.importorskip("av", reason="H.264 needs the extra 'video'")
__all__ = ["far", "node"]


class Watch:
    """Receives the pictures of a stream while it is open, and reports each."""

    def __init__(self, stream: StreamChannel, *, reports: bool = True) -> None:
        self.stream = stream
        self.reports = reports
        self.came: queue.Queue[EncodedFrame] = queue.Queue()

    def __enter__(self) -> Watch:
        self.stream.add(self.put, lambda: 0)
        return self

    def __exit__(self, *_: object) -> None:
        self.stream.remove(self.put)

    def put(self, picture: EncodedFrame) -> None:
        self.came.put(picture)
        if self.reports:
            self.stream.report(picture.seq)

    def take(self, count: int) -> list[EncodedFrame]:
        return [self.came.get(timeout=WAIT_S) for _ in range(count)]


def decoded(pictures: list[EncodedFrame]) -> list[np.ndarray]:
    context = av.CodecContext.create("h264", "r")
    return [
        image.to_ndarray(format="bgr24") for picture in pictures for image in context.decode(av.Packet(picture.data))
    ]


def test_a_stream_begins_with_a_key_and_each_picture_is_one_whole_image(node: Node) -> None:
    with node.connected() as drone, Watch(drone._state.video.stream(kbit_s=500)) as watch:
        pictures = watch.take(10)
        assert [one.key for one in pictures[:2]] == [True, False]
        numbers = [one.seq for one in pictures]
        assert numbers == list(range(numbers[0], numbers[0] + 10))
        assert {(one.width, one.height, one.codec, one.topic) for one in pictures} == {
            (32, 24, "h264", "stream/front?kbit_s=500")
        }
        images = decoded(pictures)
        assert [image.shape for image in images] == [(24, 32, 3)] * 10


def test_frames_arrive_as_h264_from_afar_and_raw_from_near(node: Node) -> None:
    with node.connected() as drone:
        frames = drone.frames(encoding="h264")
        for frame in take(frames, 5):
            assert frame.shape == (24, 32, 3)
            assert np.allclose(frame, frame[0, 0], atol=6)
            assert frame.header.encoding == "bgr8"
            assert 0.0 <= frame.age_s < WAIT_S


def test_the_stamps_and_states_are_those_of_the_frames(far: Node) -> None:
    with far.connected() as drone:
        stamps: set[int] = set()
        with drone.on_frame(lambda frame: stamps.add(frame.captured_ns), encoding="raw", depth=50, inline=True):
            frames = take(drone.frames(encoding="h264"), 10)
            drone.wait(lambda _: sum(frame.captured_ns in stamps for frame in frames) >= 8, WAIT_S)
        assert frames[-1].feedback is not None


def test_smaller_and_fewer_pictures(far: Node) -> None:
    with far.connected() as drone:
        frames = take(drone.frames(encoding="h264", kbit_s=300, scale=0.5, max_fps=10), 5)
        assert frames[0].shape == (12, 16, 3)
        assert frames[-1].captured_ns - frames[0].captured_ns >= 370_000_000


def test_many_subscribers_share_one_encoding(node: Node) -> None:
    with node.connected() as one, node.connected(access="observe") as other:  # noqa: SIM117
        with (
            Watch(one._state.video.stream(kbit_s=400)) as first,
            Watch(other._state.video.stream(kbit_s=400)) as second,
        ):
            first.take(3)
            (late, *_) = second.take(3)
            assert late.key, "a later subscriber starts with a key picture"
            (form,) = node.proxy.publisher.streams.known
            assert form.topic == "stream/front?kbit_s=400"
            same = {picture.seq: picture.data for picture in first.take(10)}
            assert all(same.get(picture.seq, picture.data) == picture.data for picture in second.take(10))


def test_a_subscriber_that_misses_a_picture_requests_a_key(node: Node) -> None:
    with node.connected() as drone, Watch(drone._state.video.stream(kbit_s=400)) as watch:
        last = watch.take(8)[-1]
        watch.stream.report(last.seq, wants_key=True)
        assert any(picture.key for picture in watch.take(40))


def test_lost_packets_cost_pictures_but_are_never_visible(far: Node) -> None:
    with far.connected() as drone:
        frames = drone.frames(encoding="h264", kbit_s=400)
        next(frames)
        stream = drone._state.video.streams["stream/front?kbit_s=400"]
        decoder, received = stream.decoder, stream.receive
        assert decoder is not None
        numbers = itertools.count()
        chain, whole = Chain(), set()

        def lossy(part: EncodedFrame) -> None:
            if next(numbers) % 7 == 3:
                return
            if chain.follows(part.seq, key=part.key):
                whole.add(part.captured_ns)
            received(part)

        stream.receive = lossy  # type: ignore[method-assign]
        chain.restart()
        seen = take(frames, 30)
        later = [frame for frame in seen if frame.captured_ns >= min(whole)]
        assert len(later) > 10
        assert decoder.dropped > 0
        for frame in later:
            assert frame.captured_ns in whole
            assert np.allclose(frame, frame[0, 0], atol=8), "the picture should have one colour: it is smeared"


def test_a_damaged_picture_is_not_shown(far: Node) -> None:
    with far.connected() as drone:
        frames = drone.frames(encoding="h264", kbit_s=400)
        next(frames)
        stream = drone._state.video.streams["stream/front?kbit_s=400"]
        received, numbers, damaged = stream.receive, itertools.count(1), set()

        def flipping(part: EncodedFrame) -> None:
            if next(numbers) % 10 == 0:
                damaged.add(part.captured_ns)
                part = msgspec.structs.replace(part, data=part.data[:8])
            received(part)

        stream.receive = flipping  # type: ignore[method-assign]
        seen = take(frames, 30)
        assert damaged
        assert not damaged & {frame.captured_ns for frame in seen}


def test_a_decoder_that_is_too_slow_continues_with_a_key(far: Node) -> None:
    with far.connected() as drone:
        frames = drone.frames(encoding="h264", kbit_s=400)
        next(frames)
        decoder = drone._state.video.streams["stream/front?kbit_s=400"].decoder
        assert decoder is not None
        before, slow, decode = decoder.dropped, threading.Event(), decoder._decode

        def stuck(picture: EncodedFrame) -> Pixels | None:
            assert slow.wait(WAIT_S)
            return decode(picture)

        decoder._decode = stuck  # type: ignore[method-assign]
        drone.wait(lambda _: decoder.dropped > before, WAIT_S)
        assert len(decoder._waiting) <= MOST_WAITING
        slow.set()
        assert take(frames, 2)


def test_after_a_pause_the_stream_continues_without_a_key(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(video, "_IDLE_S", 0.01)
    encoder, stream = H264Encoder(32, 24, 30.0, 200), Mock(spec=StreamChannel)
    shown: queue.Queue[int] = queue.Queue()
    decoder = StreamDecoder(stream, lambda header, _pixels, _came_ns: shown.put(header.seq), time.monotonic_ns, "d")
    for seq in (1, 2, 3):
        data, key = encoder.encode(np.full((24, 32, 3), 40 * seq, np.uint8), "bgr24", seq * 33_000_000)
        assert key == (seq == 1)
        decoder.put(EncodedFrame("front", seq, seq, seq, 32, 24, "h264", key, data))
        assert shown.get(timeout=WAIT_S) == seq
        wait_until(lambda: not decoder._running, "its thread has ended")
    assert decoder.dropped == 0
    assert all(not call.kwargs for call in stream.report.call_args_list), "a key picture was requested"


def test_the_encoder_ends_with_its_last_subscriber(node: Node) -> None:
    with node.connected() as drone:
        with Watch(drone._state.video.stream(kbit_s=400)) as watch:
            watch.take(3)
        (form,) = node.proxy.publisher.streams.known
        drone.wait(lambda _: form._thread is None, WAIT_S + IDLE_S)
        with Watch(drone._state.video.stream(kbit_s=400)) as watch:
            assert watch.take(2)[0].key


def test_a_stream_without_acknowledgements_stops_and_resumes(near: Drone) -> None:
    with Watch(near._state.video.stream(subscriber="me"), reports=False) as watch:
        few = watch.take(2)
        near.wait(lambda _: watch.came.qsize() == 0, WAIT_S)
        held = len(few)
        for _ in range(20):
            near.next_feedback(WAIT_S)
        held += watch.came.qsize()
        assert held < 20, "of fifty pictures a second for more than 0.4 s"
        watch.reports = True
        watch.stream.report(few[-1].seq)
        assert len(watch.take(20)) == 20


@pytest.fixture
def near() -> Iterator[Drone]:
    made = near_node()
    with made.proxy, made.connected() as drone:
        yield drone


@pytest.mark.parametrize(
    ("options", "why"),
    [
        ({"encoding": "h264", "kbit_s": 1}, "kbit_s is 1 and must be a whole number of kbit/s from 30"),
        ({"encoding": "h264", "kbit_s": 500.0}, "must be a whole number"),
        ({"encoding": "h264", "part": (0, 2)}, "part is not possible"),
        ({"encoding": "h264", "quality": 50}, "the encoding is"),
        ({"kbit_s": 500}, "kbit_s and subscriber need"),
    ],
)
def test_invalid_forms_are_refused(near: Drone, options: dict[str, object], why: str) -> None:
    with pytest.raises(UsageError, match=why):
        next(near.frames(**options))  # type: ignore[arg-type]


def test_a_listener_gets_pictures_that_can_be_decoded(node: Node) -> None:
    with node.connected() as drone:
        came: queue.Queue[EncodedFrame] = queue.Queue()
        with drone.on_encoded(came.put):
            pictures = [came.get(timeout=WAIT_S) for _ in range(20)]
        assert pictures[0].key
        assert len(decoded(pictures)) == 20
        with drone.on_encoded(came.put, kbit_s=200, scale=0.5), pytest.raises(UsageError, match="depth is 0"):
            drone.on_encoded(came.put, depth=0)


def test_the_number_of_forms_is_bounded(near: Drone) -> None:
    streams = [near._state.video.stream(kbit_s=100 + number) for number in range(MAX_FORMS + 1)]
    watches = [Watch(stream) for stream in streams]
    problems: queue.Queue[str] = queue.Queue()
    with near.on_event(lambda event: problems.put(event.text) if event.kind == "packet_malformed" else None):
        for watch in watches:
            watch.__enter__()
        assert f"encodes video in at most {MAX_FORMS} formats" in problems.get(timeout=WAIT_S)
    for watch in watches[:-1]:
        assert watch.take(1)[0].key
    for watch in watches:
        watch.__exit__()


def test_a_form_without_a_rate_or_a_name_is_invalid(near: Drone) -> None:
    problems: queue.Queue[str] = queue.Queue()
    told = near.on_event(lambda event: problems.put(event.text) if event.kind == "packet_malformed" else None)
    with told, Watch(near._state.video.stream(scale=0.5)):
        assert "has no rate: add kbit_s" in problems.get(timeout=WAIT_S)
