"""An AR.Drone 2's H.264 relayed without decoding: which pictures, and when."""

from __future__ import annotations

import dataclasses
import socket

import pytest

from skyloop.clock import ManualClock
from skyloop.drivers.live_video import Coded
from skyloop.drivers.recording_sink import RecordingSink
from skyloop.messages import Intrinsics
from skyloop.vehicles.ardrone.video import EncodedStream, VideoReceiver
from skyloop.vehicles.ardrone.wire.pave import Codec, FrameType
from tests.vehicles.ardrone.video_ports import HOST, LONG, PATIENCE_S, SHORT, TcpPort, Viewer, frames, recording

INTRINSICS = Intrinsics(1.0, 2.0, 3.0, 4.0)


class Bench:
    """Frames as seen by the reading thread."""

    def __init__(self) -> None:
        self.sink = RecordingSink(record=True)
        self.camera = "front"
        self.connection = 0
        self.stream = EncodedStream(self.sink, lambda: self.camera, lambda *_: INTRINSICS)

    def take(self, *numbers: int, **changes: int) -> list[int]:
        """Take frames of the recording by their index; return those that were relayed."""
        handed_on = []
        for n in numbers:
            before = self.sink.calls
            frame = dataclasses.replace(frames(LONG)[n], **changes)  # type: ignore[arg-type]
            self.stream.take(Coded(frame, frame.is_key, n, n, self.connection))
            if self.sink.calls > before:
                handed_on.append(n)
        return handed_on


@pytest.fixture
def bench() -> Bench:
    return Bench()


def test_it_begins_with_a_key_and_continues_with_the_next_frames(bench: Bench) -> None:
    assert bench.take(13, 14, 15, 16, 17) == [15, 16, 17]
    first, second, _ = bench.sink.pictures
    assert (first.camera, first.data, first.captured_ns) == ("front", frames(LONG)[15].payload, 15)
    assert (first.width, first.height, first.intrinsics) == (640, 360, INTRINSICS)
    assert (first.key, second.key) == (True, False)
    assert not bench.sink.problems


def test_a_gap_damage_or_another_connection_or_camera_needs_a_new_key(bench: Bench) -> None:
    assert bench.take(0, 1, 3, 4, 15, 16) == [0, 1, 15, 16]
    assert bench.take(17, after_damage=True) == []
    assert bench.take(18, 30, 31) == [30, 31]
    bench.connection = 1
    assert bench.take(32, 33, 45, 46) == [45, 46]
    bench.camera = "bottom"
    assert bench.take(47, 60, 61) == [60, 61]
    assert {seen.camera for seen in bench.sink.pictures} == {"front", "bottom"}


def test_only_h264_pictures_with_a_subscriber(bench: Bench) -> None:
    bench.sink.record = False
    assert bench.take(0, 1) == []
    bench.sink.record = True
    assert bench.take(2, 3, 15) == [15]
    bench.sink.record = False
    assert bench.take(16) == []
    bench.sink.record = True
    assert bench.take(17, 30, 31) == [30, 31]
    assert bench.take(32, type=int(FrameType.HEADERS)) == []
    assert bench.take(33) == [33]
    assert bench.take(34, codec=int(Codec.MPEG4_VISUAL)) == []
    assert bench.take(35, 36, 45) == [45]
    bench.stream.take(Coded(b"a picture of an AR.Drone 1", True, 0, 0, 0))
    assert len(bench.sink.pictures) == 5


@pytest.mark.parametrize(("name", "first"), [(LONG, 0), (SHORT, 3)])
@pytest.mark.parametrize("looks", [True, False])
def test_recordings_of_real_drones_are_relayed_byte_by_byte(name: str, first: int, looks: bool) -> None:
    sink, viewer = RecordingSink(record=True), Viewer()
    viewer.looks = looks
    stream = EncodedStream(sink, lambda: "front", lambda *_: None)
    expected = [frame.payload for frame in frames(name)][first:]

    def play(connection: socket.socket) -> None:
        connection.sendall(recording(name))
        connection.recv(1)

    with TcpPort(play) as port:
        receiver = VideoReceiver(
            HOST,
            port.port,
            version=2,
            show=viewer.show,
            on_event=viewer.on_event,
            wants=lambda: viewer.looks,
            came=stream.take,
            clock=ManualClock(),
        )
        receiver.start()
        assert sink.wait(lambda: len(sink.pictures) == len(expected), PATIENCE_S), len(sink.pictures)
        last = frames(name)[-1].number
        if looks:  # decoding may drop some that arrive too fast, which does not matter here
            viewer.wait(lambda: viewer.numbers[-1:] == [last], "the last picture")
        receiver.stop()
    assert [seen.data for seen in sink.pictures] == expected
    assert bool(viewer.seen) is looks
