"""Foxglove's server, with our own viewer that reads its protocol: topics, subscriptions, parameters."""

from __future__ import annotations

import logging
import socket
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from typing import Any

import pytest

from skyloop.client import Drone
from skyloop.drivers.base import Sink
from skyloop.errors import LinkError, MissingExtraError, UsageError
from skyloop.messages import CameraInfo, Capabilities, Encoding, Feedback, FrameHeader, Polyline
from skyloop.recording import foxglove as schemas
from skyloop.recording import foxglove_server as module
from skyloop.recording import layout, taps
from skyloop.recording.backlog import Item, Rank
from skyloop.recording.foxglove_server import MAX_HEAD, OriginGuard, ParameterAccess, hidden_host
from skyloop.recording.layout import FrameRecord
from skyloop.recording.translation import TranslatedImage
from tests.recording.live.conftest import WAIT_S, Fly
from tests.recording.live.viewer import Viewer
from tests.recording.streams import film
from tests.support.fake_vehicle import PERIOD_S, FakeVehicle
from tests.support.nodes import Node, far
from tests.support.recording_files import read_image
from tests.support.systems import PLATFORM

pytest.importorskip("foxglove", reason="foxglove-sdk is not installed: skyloop install foxglove")

import itertools

from skyloop.recording.foxglove_server import WAITING, FoxgloveServer
from skyloop.recording.taps import View

__all__ = ["far"]
Show = Callable[..., tuple[View, FoxgloveServer]]
VIDEO, IMAGE, FRAMES = (f"/alpha/{name}" for name in ("camera/front/video", "camera/front/image", "frames/front"))


@pytest.fixture
def show() -> Iterator[Show]:
    """Serves drones on a free port; what tests show there takes turns with the view's thread.

    Two threads at once would deadlock the process: the SDK logs to Python, with a lock held, about a viewer whose
    messages are dropped; Python may switch to another thread meanwhile that waits for that lock while it holds the
    interpreter's.
    """
    with ExitStack() as stack:

        def one(*drones: Drone, **options: Any) -> tuple[View, FoxgloveServer]:
            server, turn = FoxgloveServer(drones, port=0, **options), threading.Lock()
            server.show = in_turn(server.show, turn)  # type: ignore[method-assign]
            server.wanted = in_turn(server.wanted, turn)  # type: ignore[method-assign]
            return stack.enter_context(View(drones, server)), server

        yield one


def in_turn(function: Callable[..., Any], turn: threading.Lock) -> Callable[..., Any]:
    def call(*args: Any) -> Any:
        with turn:
            return function(*args)

    return call


def until(done: Callable[[], object], what: str) -> None:
    end = time.monotonic() + WAIT_S
    while not done():
        assert time.monotonic() < end, f"not so after {WAIT_S} s: {what}"
        time.sleep(0.01)


class Encoded(FakeVehicle):
    """Sends only H.264, with every fifth image a key frame."""

    def capabilities(self) -> Capabilities:
        able = super().capabilities()
        return Capabilities(able.vehicle, able.actions, (CameraInfo("front", 64, 48, 25.0, stream="h264"),))

    def _run(self, sink: Sink) -> None:
        number = 0
        while not self._ended.wait(PERIOD_S):
            now_ns = time.monotonic_ns()
            sink.feedback(Feedback(captured_ns=now_ns, state=self.state))
            unit = film()[number % len(film())]
            number += 1
            sink.stream("front", unit.data, now_ns, width=64, height=48, key=unit.key)


# Topics --------------------------------------------------------------------------------------------------------------


def test_only_watched_topics_are_subscribed_to(fly: Fly, show: Show) -> None:
    view, server = show(fly())
    with Viewer(server.url) as viewer:
        viewer.until(lambda one: IMAGE in one.topics)
        assert VIDEO not in viewer.topics  # this vehicle encodes nothing
        assert {topic.partition("/camera")[0] for topic in viewer.topics} >= {"/tf", "/log", "/alpha", "/alpha/pose"}
        assert view.subscribed == {}
        viewer.subscribe("/alpha/pose")
        viewer.until(lambda one: one.of("/alpha/pose"))
        assert view.subscribed == {"alpha": ["feedback"]}
        viewer.subscribe(IMAGE)
        viewer.until(lambda one: one.of(IMAGE))
        assert view.subscribed == {"alpha": ["feedback", "video.front"]}
        viewer.unsubscribe("/alpha/pose")
        until(lambda: view.subscribed == {"alpha": ["video.front"]}, "the feedback is let go")
    until(lambda: view.subscribed == {}, "all is let go with the viewer")


def test_messages_are_those_of_a_recording(fly: Fly, show: Show) -> None:
    drone = fly()
    _, server = show(drone)
    own, calibration = "/alpha/feedback", "/alpha/camera/front/calibration"
    with Viewer(server.url) as viewer:
        viewer.subscribe(own, IMAGE, calibration, "/tf", "/log", "/alpha/logs", "/alpha/camera/front/annotations")
        viewer.until(lambda one: all(one.of(topic) for topic in (own, IMAGE, calibration, "/tf")))
        drone.log.text("found it")
        drone.annotate(drone.next_frame(timeout_s=WAIT_S), [Polyline(((1.0, 1.0), (5.0, 5.0)))])
        viewer.until(lambda one: one.of("/log") and one.of("/alpha/logs") and one.of("/alpha/camera/front/annotations"))
        assert (viewer.topics[own]["encoding"], viewer.topics[own]["schemaName"]) == ("json", "skyloop.Feedback")
        assert viewer.topics[IMAGE]["schemaName"] == "foxglove.CompressedImage"
        sample = layout.decode(viewer.of(own)[0], Feedback)
        assert sample.position_m is not None
        data, form = read_image(viewer.of(IMAGE)[0])
        assert (form, data[:2]) == ("jpeg", b"\xff\xd8")
        assert schemas.CameraCalibration.FromString(viewer.of(calibration)[0]).K[0] == 30.0
        assert schemas.Log.FromString(viewer.of("/log")[0]).message == "found it"
        times = [log_ns for topic, log_ns, _ in viewer.messages if topic == own]
        assert times == sorted(times)
        assert abs(times[-1] - time.time_ns()) < 60e9


def test_late_subscribers_get_the_known_state(fly: Fly, show: Show) -> None:
    _, server = show(fly())
    known = "/alpha/parameters"
    with Viewer(server.url) as first, Viewer(server.url) as second:
        first.subscribe(known)
        first.until(lambda one: len(one.of(known)) > 10)
        second.subscribe(known)
        second.until(lambda one: len(one.of(known)) > 10, "the parameters, once more")


def test_two_drones_on_one_server(fly: Fly, show: Show) -> None:
    view, server = show(fly("alpha"), fly("beta"))
    with Viewer(server.url) as viewer:
        viewer.subscribe("/tf")
        viewer.until(lambda one: len(one.of("/tf")) > 10)
        found = {schemas.FrameTransform.FromString(data).child_frame_id for data in viewer.of("/tf")}
        assert found == {"alpha", "beta"}
        assert view.subscribed == {"alpha": ["feedback"], "beta": ["feedback"]}


def test_two_drones_of_the_same_name_are_refused(fly: Fly, show: Show) -> None:
    drone = fly()
    with pytest.raises(UsageError, match="different names, got alpha, alpha"):
        show(drone, drone)


def test_h264_starts_with_a_key_frame_each_time(fly: Fly, show: Show) -> None:
    _, server = show(fly(vehicle=Encoded()))
    keys = {unit.data for unit in film() if unit.key}
    with Viewer(server.url) as viewer:
        for _ in range(2):
            viewer.messages.clear()
            viewer.subscribe(VIDEO, FRAMES)
            viewer.until(lambda one: len(one.of(VIDEO)) > 6)
            pictures = [schemas.CompressedVideo.FromString(data) for data in viewer.of(VIDEO)]
            assert pictures[0].data in keys
            assert {(one.format, one.frame_id) for one in pictures} == {("h264", "alpha/front")}
            units = [unit.data for unit in film()]
            order = [units.index(one.data) for one in pictures]
            assert all(after == (before + 1) % len(units) for before, after in itertools.pairwise(order))
            viewer.unsubscribe(VIDEO)
            viewer.unsubscribe(FRAMES)


def test_frames_in_an_unexpected_format_get_a_topic(fly: Fly, show: Show) -> None:
    _, server = show(fly(vehicle=Encoded()))
    with Viewer(server.url) as viewer:
        viewer.until(lambda one: VIDEO in one.topics)
        assert IMAGE not in viewer.topics
        server.show(frame_item(1, b"\xff\xd8"))
        viewer.until(lambda one: IMAGE in one.topics)


def test_over_a_network_frames_arrive_as_h264_or_else_in_their_own_format(
    far: Node, show: Show, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("av", reason="H.264 needs the extra 'video'")
    with far.connected(access="observe") as drone:
        video, image = (f"/{drone.name}/camera/front/{kind}" for kind in ("video", "image"))
        _, server = show(drone)
        with Viewer(server.url) as viewer:
            viewer.subscribe(video)
            viewer.until(lambda one: len(one.of(video)) > 5)
            assert image not in viewer.topics
            first = schemas.CompressedVideo.FromString(viewer.of(video)[0]).data
            assert first.split(b"\x00\x00\x01")[1][0] & 31 == 7  # a key frame with its parameters
            viewer.unsubscribe(video)
            # A proxy that can't encode sends nothing: JPEG is shown instead.
            monkeypatch.setattr(taps, "_STREAM_GONE_NS", 1)
            monkeypatch.setattr(
                drone._state.video.stream("front", subscriber="x").__class__, "receive", lambda *_: None
            )
            viewer.subscribe(video)
            viewer.until(lambda one: image in one.topics)


# Slow viewers --------------------------------------------------------------------------------------------------------


def frame_item(seq: int, data: bytes) -> Item:
    header = FrameHeader("front", seq, 1, 2, 32, 24, Encoding.BGR8, 32 * 24 * 3)
    record = FrameRecord(header, 3, "jpeg")
    return Item(0, "video.front", Rank.FRAME, time.monotonic_ns(), TranslatedImage(record, data), len(data))


def test_only_a_hanging_viewer_loses_messages(fly: Fly, show: Show) -> None:
    drone = fly()
    _, server = show(drone)
    count, size = 2 * WAITING, 50_000  # more than the server and the sockets can hold
    with Viewer(server.url) as stalled, Viewer(server.url) as healthy:
        for viewer in (stalled, healthy):
            viewer.subscribe(FRAMES, IMAGE)
        until(lambda: server.viewers == {FRAMES: 2, IMAGE: 2}, "both have subscribed")
        stalled.until(lambda one: one.of(FRAMES))
        sent = range(10_000, 10_000 + count)
        for seq in sent:  # as the view's thread does; it must not wait for the viewer
            server.show(frame_item(seq, bytes(size)))
            if seq % 50 == 0 or seq == sent[-1]:
                healthy.until(lambda one, seq=seq: newest(one) >= seq)  # type: ignore[misc]
        assert set(sent) <= sequences(healthy)
        drone.takeoff()  # the pilot is unaffected
        stalled.until(lambda one: newest(one) >= sent[-1], "the newest, once it reads again")
        lost = set(sent) - sequences(stalled)
        assert lost
        assert max(lost) < sent[-WAITING // 8]  # the oldest ones were dropped, not the newest


def test_the_sdk_never_asks_pythons_logging(fly: Fly, show: Show, monkeypatch: pytest.MonkeyPatch) -> None:
    """It did with a viewer's lock held: a thread waiting for that lock held the interpreter, a deadlock."""
    asked: list[str] = []
    plain = logging.Logger.isEnabledFor

    def enabled(self: logging.Logger, level: int) -> bool:
        asked.append(self.name)
        return plain(self, level)

    _, server = show(fly())
    monkeypatch.setattr(logging.Logger, "isEnabledFor", enabled)
    with Viewer(server.url) as stalled:
        stalled.subscribe(FRAMES)
        until(lambda: server.viewers == {FRAMES: 1}, "it has subscribed")
        for seq in range(2 * WAITING):
            server.show(frame_item(seq, bytes(50_000)))
    assert not [name for name in asked if name.startswith("foxglove")]


def newest(viewer: Viewer) -> int:
    frames = next((data for topic, _, data in reversed(viewer.messages) if topic == FRAMES), None)
    return 0 if frames is None else layout.decode(frames, FrameRecord).header.seq


def sequences(viewer: Viewer) -> set[int]:
    return {layout.decode(data, FrameRecord).header.seq for data in viewer.of(FRAMES)}


# Parameters ----------------------------------------------------------------------------------------------------------


def test_parameters_are_read_and_followed(fly: Fly, show: Show) -> None:
    drone = fly()
    _, server = show(drone)
    tilt = "alpha/limits.tilt"
    with Viewer(server.url) as viewer:
        every = {each["name"]: each.get("value") for each in viewer.get_parameters()}
        assert every[tilt] == drone.config["limits.tilt"]
        assert len(every) == len(drone.config)
        assert [each["name"] for each in viewer.get_parameters([tilt])] == [tilt]
        viewer.follow_parameters([tilt])
        drone.config["limits.tilt"] = 0.2
        viewer.until(lambda one: one.parameters.get(tilt) == 0.2, "the new value")


def test_a_read_only_view_refuses_writes_with_the_reason(fly: Fly, show: Show) -> None:
    drone = fly()
    _, server = show(drone)
    before = drone.config["limits.tilt"]
    with Viewer(server.url) as viewer:
        (answer,) = viewer.set_parameter("alpha/limits.tilt", 0.2)
        assert answer["value"] == before == drone.config["limits.tilt"]
        viewer.until(lambda one: one.status)
        assert viewer.status == [
            "alpha/limits.tilt was not written: this view is read-only: start it with --write to write parameters"
        ]


@pytest.fixture
def lent(monkeypatch: pytest.MonkeyPatch, fly: Fly) -> Drone:
    """A drone whose writes use the pilot's connection: its proxy has no name outside this process."""

    class Lent:
        def __init__(self, drone: Drone) -> None:
            self.config = drone.config

        def __enter__(self) -> Lent:
            return self

        def __exit__(self, *_: object) -> None: ...

    drone = fly()
    monkeypatch.setattr(module, "connect", lambda target, **options: Lent(drone))
    return drone


def test_parameters_are_written_if_allowed(lent: Drone, show: Show) -> None:
    _, server = show(lent, priority=31)
    with Viewer(server.url) as viewer:
        (answer,) = viewer.set_parameter("alpha/limits.tilt", 0.2)
        assert answer["value"] == lent.config["limits.tilt"] == 0.2
        (answer,) = viewer.set_parameter("alpha/limits.tilt", 1000)
        assert answer["value"] == lent.config["limits.tilt"] == 0.2
        viewer.until(lambda one: one.status)
        assert "alpha/limits.tilt was not written: limits.tilt" in viewer.status[0]


@pytest.mark.parametrize(
    ("name", "value", "why"),
    [
        ("alpha/limits.tlit", 0.2, "did you mean 'limits.tilt'"),
        ("beta/limits.tilt", 0.2, "no drone in this view named 'beta'"),
        ("alpha/limits.tilt", "much", "limits.tilt"),
    ],
)
def test_impossible_writes_are_refused_with_the_reason(lent: Drone, name: str, value: object, why: str) -> None:
    written = ParameterAccess([lent], 31).write(name, value)
    assert why in written.refused
    assert written.value == (lent.config["limits.tilt"] if name == "alpha/limits.tilt" else None)


def test_whole_numbers_are_written_as_the_parameter_s_type(lent: Drone) -> None:
    desk = ParameterAccess([lent], 31)
    whole = [each for each in lent.config.parameters() if each.type.value == "float" and not each.read_only]
    taken = next(each for each in whole if (each.minimum or 0) <= 1 <= (each.maximum or 1))
    assert desk.write(f"alpha/{taken.name}", 1).value == 1.0
    assert isinstance(lent.config[taken.name], float)


# Refusals ------------------------------------------------------------------------------------------------------------


def test_a_taken_port(fly: Fly) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(LinkError, match=rf"can't listen on 127\.0\.0\.1:{port}: .*choose another --port"):
            FoxgloveServer([fly()], port=port)


def test_only_this_machine_can_write(fly: Fly) -> None:
    with pytest.raises(UsageError, match="no passwords"):
        FoxgloveServer([fly()], host="0.0.0.0", port=0, priority=31)


@pytest.mark.parametrize(
    ("origin", "answer"),
    [
        (None, b"101"),
        ("https://app.foxglove.dev", b"101"),
        ("file://", b"101"),
        ("http://localhost:8080", b"101"),
        ("http://[::1]:8080", b"101"),
        ("https://evil.example", b"403"),
        ("https://foxglove.dev.evil.example", b"403"),
        ("http://app.foxglove.dev", b"403"),
        ("null", b"403"),
        ("http://127.0.0.1.evil.example", b"403"),
    ],
)
def test_pages_of_other_origins_can_not_write(lent: Drone, show: Show, origin: str | None, answer: bytes) -> None:
    """With ``--write`` any web page in a browser of this machine could write parameters."""
    _, server = show(lent, priority=31)
    head = (
        f"GET / HTTP/1.1\r\nHost: 127.0.0.1:{server.port}\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
        "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\nSec-WebSocket-Version: 13\r\n"
        "Sec-WebSocket-Protocol: foxglove.sdk.v1\r\n" + (f"Origin: {origin}\r\n" if origin else "") + "\r\n"
    )
    with socket.create_connection(("127.0.0.1", server.port), timeout=WAIT_S) as page:
        page.sendall(head.encode())
        assert page.recv(12) == b"HTTP/1.1 " + answer


def test_the_guard_closes_connections_with_too_long_or_no_requests() -> None:
    door = OriginGuard("127.0.0.1", 0)
    try:
        with socket.create_connection(("127.0.0.1", door.port), timeout=WAIT_S) as page:
            page.sendall(b"GET / HTTP/1.1\r\nX: " + b"x" * MAX_HEAD)
            assert page.recv(12) == b"HTTP/1.1 403"
        with socket.create_connection(("127.0.0.1", door.port), timeout=WAIT_S) as page:
            page.shutdown(socket.SHUT_WR)
            assert page.recv(12) == b""
    finally:
        door.close()
    assert hidden_host() != hidden_host() or PLATFORM != "linux"


def test_without_the_sdk_the_error_says_what_to_install(fly: Fly, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "foxglove", None)
    with pytest.raises(MissingExtraError, match=r"skyloop install foxglove"):
        FoxgloveServer([fly()], port=0)


def test_a_sample_that_can_not_be_shown_is_counted_and_the_view_continues(fly: Fly) -> None:
    class Broken:
        def wanted(self) -> frozenset[tuple[int, str]]:
            return frozenset({(0, "feedback")})

        def show(self, item: Item) -> None:
            raise ValueError(item.channel)

        def close(self) -> None: ...

    with View([fly()], Broken()) as view:
        until(lambda: view.failed > 2, "it goes on")
        assert view.failed_why == "feedback: ValueError('feedback')"
        assert view.dropped == 0
