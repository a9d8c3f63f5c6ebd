"""The video of both drones from a socket to a picture: recorded streams, slow viewers, lost connections."""

from __future__ import annotations

import socket
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import pytest

from skyloop.clock import ManualClock
from skyloop.drivers.live_video import LATE_NS, VideoCounters, VideoEvent
from skyloop.errors import MissingExtraError, UsageError
from skyloop.vehicles.ardrone.video import VideoReceiver
from tests.support.recordings import needs_recordings
from tests.vehicles.ardrone.video_ports import (
    HOST,
    LONG,
    SHORT,
    TcpPort,
    Viewer,
    frames,
    pieces,
    receiver_of,
    true_pictures,
)

pytestmark = needs_recordings

MS = 1_000_000


@contextmanager
def receiving(viewer: Viewer, port: int, version: int = 2, clock: ManualClock | None = None) -> Iterator[VideoReceiver]:
    receiver = receiver_of(viewer, port, version, clock)
    receiver.start()
    try:
        yield receiver
    finally:
        viewer.gate.set()
        receiver.stop()


def accounted(counters: VideoCounters) -> int:
    return counters.frames + counters.waited + counters.damaged + counters.refused + counters.skipped


Step = Callable[[int], None]


def in_step(name: str, receiver: list[VideoReceiver], before: Step = lambda n: None) -> Callable[[socket.socket], None]:
    """Send a recording frame by frame, each after all earlier ones were processed; then keep the connection."""

    def play(connection: socket.socket) -> None:
        until = threading.Event()
        for n, piece in enumerate(pieces(name)):
            while n > 1 and accounted(receiver[0].counters) < n:
                until.wait(0.001)
            before(n)
            connection.sendall(piece)
        connection.recv(1)

    return play


@pytest.mark.parametrize(("name", "shown", "waited", "damaged"), [(LONG, 240, 0, 0), (SHORT, 17, 2, 1)])
def test_the_recordings_of_real_drones(name: str, shown: int, waited: int, damaged: int) -> None:
    viewer = Viewer()
    clock = ManualClock(0)
    stamps = [frame.timestamp_ms for frame in frames(name)]
    ours: list[VideoReceiver] = []

    def tick(n: int) -> None:
        clock.now_ns = max(0, stamps[n] - stamps[1]) * MS

    with TcpPort(in_step(name, ours, tick)) as port:
        ours.append(receiver_of(viewer, port.port, clock=clock))
        ours[0].start()
        viewer.wait(lambda: len(viewer.seen) == shown, f"{shown} pictures")
        ours[0].stop()
    counters = ours[0].counters
    assert counters == VideoCounters(received=len(stamps) - damaged, frames=shown, waited=waited, damaged=damaged)
    assert {number: content for number, _, content in viewer.seen} == true_pictures(name)
    assert viewer.numbers == sorted(viewer.numbers)
    assert viewer.sizes == {(640, 360)}
    assert viewer.notices[0] == (VideoEvent.STREAMING, f"{HOST}:{port.port}")
    # Each frame's capture time is that of its stamp, except for the very first one.
    came_ns = [(stamp - stamps[1]) * MS for stamp in stamps[-shown:]]
    assert [taken_ns for _, taken_ns, _ in viewer.seen][1:] == came_ns[1:]


def test_one_stream_in_small_pieces() -> None:
    viewer = Viewer()
    data = b"".join(pieces(LONG)[:60])

    def play(connection: socket.socket) -> None:
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        for start in range(0, len(data), 997):
            connection.sendall(data[start : start + 997])
        connection.recv(1)

    with TcpPort(play) as port, receiving(viewer, port.port) as receiver:
        viewer.wait(lambda: len(viewer.seen) == 60, "60 pictures")
        assert receiver.counters.lost_bytes == 0
    assert all(true_pictures(LONG)[number] == content for number, _, content in viewer.seen)


def test_a_slow_viewer_gets_the_newest() -> None:
    """The first picture is displayed for long; the newest one that arrived meanwhile follows."""
    viewer = Viewer()
    viewer.gate.clear()
    clock = ManualClock()
    sent = threading.Event()

    def play(connection: socket.socket) -> None:
        connection.sendall(b"".join(pieces(LONG)[:50]))
        sent.set()
        connection.recv(1)

    with TcpPort(play) as port, receiving(viewer, port.port, clock=clock) as receiver:
        viewer.wait(lambda: viewer.seen, "the first picture")
        assert sent.wait(10)
        while receiver.counters.received < 50:
            threading.Event().wait(0.001)
        clock.advance((LATE_NS + MS) / 1e9)
        viewer.gate.set()
        viewer.wait(lambda: len(viewer.seen) == 2, "the newest picture")
        counters = receiver.counters
    first, last = frames(LONG)[0].number, frames(LONG)[49].number
    assert viewer.numbers == [first, last]
    assert viewer.seen[1][2] == true_pictures(LONG)[last]
    assert (counters.frames, counters.skipped, counters.waited, counters.damaged) == (2, 48, 0, 0)


def test_nothing_is_decoded_without_viewers_and_the_next_frame_shows_a_picture_to_a_new_one() -> None:
    viewer = Viewer()
    viewer.looks = False
    clock = ManualClock()
    go_on = threading.Event()

    def play(connection: socket.socket) -> None:
        connection.sendall(b"".join(pieces(LONG)[:40]))
        go_on.wait(10)
        connection.sendall(pieces(LONG)[40])
        connection.recv(1)

    with TcpPort(play) as port, receiving(viewer, port.port, clock=clock) as receiver:
        while receiver.counters.received < 40:
            threading.Event().wait(0.001)
        assert receiver.counters.frames == 0
        viewer.looks = True
        clock.advance(2.0)
        go_on.set()
        viewer.wait(lambda: viewer.seen, "a picture")
        assert receiver.counters.skipped == 0
    number, _, content = viewer.seen[0]
    assert number == frames(LONG)[40].number
    assert content == true_pictures(LONG)[number]


def test_a_lost_connection_is_restored_and_reported_once() -> None:
    viewer = Viewer()
    lost = list(pieces(LONG)[:10])
    lost[9] = lost[9][:1000]

    def torn(connection: socket.socket) -> None:
        connection.sendall(b"".join(lost))
        viewer.wait(lambda: len(viewer.seen) == 9, "nine pictures")

    def again(connection: socket.socket) -> None:  # the numbers continue where they were torn, which must not matter
        connection.sendall(b"".join(pieces(LONG)[9:20]))
        connection.recv(1)

    with TcpPort(torn, again) as port, receiving(viewer, port.port) as receiver:
        viewer.wait(lambda: len(viewer.seen) == 14, "pictures of the second connection")
        counters = receiver.counters
    first = frames(LONG)[0].number
    assert viewer.numbers == [first + n for n in (*range(9), *range(15, 20))]
    assert [notice for notice, _ in viewer.notices] == [VideoEvent.STREAMING, VideoEvent.LOST, VideoEvent.STREAMING]
    assert "the drone ended the stream" in viewer.notices[1][1]
    assert (counters.reconnects, counters.waited, counters.damaged) == (1, 6, 1)
    assert counters.lost_bytes == 1000


def test_an_absent_drone_is_reported_once_and_retried() -> None:
    viewer = Viewer()
    with socket.create_server((HOST, 0)) as taken:
        port = taken.getsockname()[1]
    with receiving(viewer, port):
        viewer.wait(lambda: viewer.notices, "the report of its absence")

        def play(connection: socket.socket) -> None:
            connection.sendall(b"".join(pieces(LONG)[:3]))
            connection.recv(1)

        with TcpPort(play, port=port):
            viewer.wait(lambda: len(viewer.seen) == 3, "pictures")
    refused = f"{HOST}:{port}: Connection refused"
    assert viewer.notices[:2] == [(VideoEvent.LOST, refused), (VideoEvent.STREAMING, f"{HOST}:{port}")]


def test_the_connection_to_a_silent_drone_is_retried() -> None:
    viewer = Viewer()
    clock = ManualClock()

    def play(connection: socket.socket) -> None:
        connection.sendall(b"".join(pieces(LONG)[:3]))
        viewer.wait(lambda: len(viewer.seen) % 3 == 0 and viewer.seen, "pictures")
        clock.advance(3.5)
        connection.sendall(b"not a frame")
        connection.recv(1)

    with TcpPort(play) as port, receiving(viewer, port.port, clock=clock) as receiver:
        viewer.wait(lambda: len(viewer.texts(VideoEvent.STREAMING)) == 2, "a second connection")
        assert receiver.counters.lost_bytes > 0
    assert viewer.texts(VideoEvent.LOST)[0].endswith("no frame arrived for 3 s")


def test_an_unsupported_codec_is_reported_once() -> None:
    viewer = Viewer()
    data = b"".join(piece[:5] + b"\x02" + piece[6:] for piece in pieces(LONG)[:10])

    def play(connection: socket.socket) -> None:
        connection.sendall(data)
        connection.recv(1)

    with TcpPort(play) as port, receiving(viewer, port.port) as receiver:
        while receiver.counters.refused < 10:
            threading.Event().wait(0.001)
    assert [text.split(",")[0] for text in viewer.texts(VideoEvent.UNSUPPORTED)] == [
        "the drone sends video in codec P264"
    ]
    assert not viewer.seen


def test_a_failing_viewer_is_reported_and_continues() -> None:
    viewer = Viewer()
    tries = []

    def fail(picture: object) -> None:
        tries.append(picture)
        raise RuntimeError("no screen")

    def play(connection: socket.socket) -> None:
        connection.sendall(b"".join(pieces(LONG)[:45]))
        connection.recv(1)

    with TcpPort(play) as port:
        receiver = VideoReceiver(HOST, port.port, version=2, show=fail, on_event=viewer.on_event, clock=ManualClock())
        receiver.start()
        while len(tries) < 3:
            threading.Event().wait(0.001)
        receiver.stop()
    assert viewer.texts(VideoEvent.FAULT) == ["RuntimeError('no screen')"]


def test_stopping_is_quick_with_or_without_a_drone_and_repeatable() -> None:
    for play in (lambda connection: connection.recv(1), lambda connection: None):
        viewer = Viewer()
        with TcpPort(play) as port:
            receiver = receiver_of(viewer, port.port)
            receiver.start()
            receiver.stop()
            receiver.stop()
    assert not [thread for thread in threading.enumerate() if thread.name.startswith("ardrone-")]


def test_misuse_is_refused() -> None:
    viewer = Viewer()
    with pytest.raises(UsageError, match=r"must be 1 or 2, got 3"):
        receiver_of(viewer, 1, version=3)
    with receiving(viewer, 1, version=1) as receiver, pytest.raises(UsageError, match="already been started"):
        receiver.start()


def test_without_pyav_the_error_names_the_package(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in [
        name
        for name in sys.modules
        if name == "av" or name.startswith(("av.", "skyloop.vehicles.ardrone.pave_decoder", "skyloop.vehicles.video"))
    ]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "av", None)
    with pytest.raises(MissingExtraError, match=r"the video of an AR.Drone 2 needs .* skyloop install video"):
        receiver_of(Viewer(), 1).start()
    receiver = receiver_of(Viewer(), 1, version=1)  # decodes without it
    receiver.start()
    receiver.stop()
