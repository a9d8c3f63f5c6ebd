"""H.264 on pages: relayed unchanged, in a form shared by similar panes; a page that falls behind gets its own."""

from __future__ import annotations

import asyncio
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from skyloop.cockpit.commands import TrackTarget
from skyloop.cockpit.encoded_feed import FPS, KEPT, RATES, SCALES, EncodedFeed, FeedFormat, form_for
from skyloop.cockpit.follow_session import in_frame
from skyloop.cockpit.station import Station
from skyloop.cockpit.stream import (
    FALLS_BEHIND_S,
    LATE_S,
    MOST_BYTES,
    MOST_UNDER_WAY,
    QUIET_S,
    RETRY_S,
    SILENT_S,
    PagePath,
    PageStream,
)
from skyloop.cockpit.telemetry import TelemetryView
from skyloop.messages import CameraInfo, Encoding, FrameHeader
from tests.support.cockpit import FakeDrone, FakeStream, cockpit, fake_fleet, open_socket, until
from tests.support.testclient import TestClient, WebSocketTestSession

CAMERA = CameraInfo("front", 640, 480, 30.0)
LATE_NS = round(LATE_S * 1e9) + 1


class Clock:
    def __init__(self) -> None:
        self.now_ns = 10**9

    def __call__(self) -> int:
        return self.now_ns

    def pass_s(self, seconds: float) -> None:
        self.now_ns += round(seconds * 1e9)


@pytest.fixture
def drone() -> FakeDrone:
    return FakeDrone()


@pytest.fixture
def client(drone: FakeDrone) -> Iterator[TestClient]:
    with cockpit(fake_fleet({"alpha": drone})) as client:
        yield client


def unpack(message: bytes) -> tuple[dict[str, Any], bytes]:
    length = int.from_bytes(message[:4], "big")
    return msgspec.json.decode(message[4 : 4 + length]), message[4 + length :]


# Forms -------------------------------------------------------------------------------------------------------------


def test_similar_panes_share_a_form() -> None:
    forms = {form_for(CAMERA, width) for width in (321, 400, 470, 480)}
    assert forms == {FeedFormat(750, 0.75)}
    assert form_for(CAMERA, 0).scale == form_for(CAMERA, 5000).scale == 1.0


@given(st.integers(1, 4000), st.integers(1, 4000), st.integers(0, 4000), st.none() | st.floats(1, 60))
def test_forms_are_few_and_at_least_as_large_as_their_pane(
    width: int, height: int, pane: int, max_fps: float | None
) -> None:
    form = form_for(CameraInfo("front", width, height, 0.0), pane, max_fps)
    assert form.kbit_s in RATES
    assert form.scale in SCALES
    assert form.scale == 1.0 or form.scale * width >= pane


def test_the_vehicles_encoding_is_relayed_if_it_fits() -> None:
    sends = CameraInfo("front", 640, 480, 30.0, stream="h264")
    assert [form_for(sends, width).kind for width in (0, 640, 320)] == ["vehicle", "vehicle", "shared"]
    assert form_for(sends, 640, 12.0).kind == "shared"


def test_a_box_on_a_smaller_picture_is_of_the_frame() -> None:
    header = FrameHeader("front", 1, 1, 1, 640, 480, Encoding.BGR8, 640 * 480 * 3)
    command = TrackTarget(n=1, at_s=0.0, camera="front", captured_ns="1", box=(10, 20, 30, 40), size=(320, 240))
    assert in_frame(command, header) == (20, 40, 60, 80)
    assert in_frame(msgspec.structs.replace(command, size=None), header) == (10, 20, 30, 40)


# Who keeps up ------------------------------------------------------------------------------------------------------


def test_a_page_late_for_a_second_is_behind_until_it_has_been_on_time_for_a_while() -> None:
    path, now_ns, number = PagePath(), 0, 0

    def frames(seconds: float, trip_s: float) -> bool:
        nonlocal now_ns, number
        until_ns = now_ns + round(seconds * 1e9)
        while now_ns < until_ns:
            number += 1
            path.sent(number, 1000, now_ns)
            now_ns += round(trip_s * 1e9)
            path.acknowledged(number, now_ns)
            path.update(now_ns)
        return path.behind

    assert not frames(3.0, 0.03)
    assert not frames(0.9, 0.3)
    assert not frames(0.2, 0.03), "it was late for less than a second"
    assert frames(FALLS_BEHIND_S + 0.5, 0.3)
    assert frames(QUIET_S - 1.0, 0.03)
    assert not frames(2.0, 0.03)
    assert frames(FALLS_BEHIND_S + 0.5, 0.3), "a relapse"
    assert frames(2 * QUIET_S - 1.0, 0.03), "takes twice as long"
    assert not frames(2.0, 0.03)


def test_a_stalled_or_distant_page_is_behind() -> None:
    silent, far = PagePath(), PagePath()
    silent.sent(1, 10, 0)
    for at_s in (0.0, 0.2, 0.3, 1.0, 1.2, 1.4):
        behind = silent.update(round(at_s * 1e9)), far.update(round(at_s * 1e9), 2 * LATE_S)
    assert behind == (True, True)
    assert (silent.late_here, far.late_here) == (False, True), "who is to blame"


def test_data_under_way_is_bounded() -> None:
    path = PagePath()
    for number in range(MOST_UNDER_WAY):
        assert path.free
        path.sent(number, 10, 0)
    assert not path.free
    assert path.acknowledged(MOST_UNDER_WAY - 1, 5) == MOST_UNDER_WAY
    path.sent(50, MOST_BYTES, 5)
    assert not path.free, "one large picture fills it"


# Pictures of a form ------------------------------------------------------------------------------------------------


def test_pictures_follow_one_another_or_begin_with_a_key() -> None:
    async def watch() -> None:
        drone = FakeDrone()
        feed = EncodedFeed(drone, "front", FeedFormat(150))  # type: ignore[arg-type]
        feed.subscribe("page", None)
        (stream,) = drone.streams

        def after(serial: int, follows: bool = True) -> tuple[list[int], int]:
            pictures, missed = feed.after(serial, follows=follows)
            return [one.picture.seq for one in pictures], missed

        stream.encode()
        assert after(0) == ([], 1), "not without a key"
        stream.encode(key=True)
        stream.encode()
        assert after(0)[0] == [102, 103]
        first = feed.after(0, follows=True)[0][-1].serial
        stream.encode()
        assert after(first) == ([104], 0)
        assert after(first, follows=False) == ([], 1), "the page can't decode it"
        stream.encode(lost=2)
        assert after(first)[0] == []
        stream.encode(key=True)
        stream.encode()
        assert after(first)[0] == [108, 109]
        assert after(0)[0] == [108, 109]
        stream.seq = 5  # the proxy restarted
        stream.encode(key=True)
        assert after(feed.after(0, follows=True)[0][-1].serial - 1)[0] == [6]
        for _ in range(2 * KEPT):
            stream.encode()
        assert after(0) == ([], KEPT), "the key is no longer kept"
        feed.unsubscribe("page")
        assert (stream.consumers, feed.wanted) == ([], False)

    asyncio.run(watch())


# One camera on one page --------------------------------------------------------------------------------------------


class OnPage:
    """One camera on one page, with its own clock."""

    def __init__(self, drone: FakeDrone) -> None:
        self.clock = Clock()
        self.station = Station(SimpleNamespace(name="alpha"), drone)  # type: ignore[arg-type]
        self.stream = PageStream(self.station, CAMERA, 320, None, None, self.clock)
        self.number = 0

    def take(self, acknowledge: bool = True) -> list[int]:
        taken = self.stream.take()
        for one in taken:
            self.number += 1
            self.stream.sent(self.number, one)
        if acknowledge:
            self.stream.acknowledged(self.number)
        return [one.picture.seq for one in taken]


def test_a_page_that_falls_behind_gets_its_own_stream_that_it_acknowledges(drone: FakeDrone) -> None:
    async def watch() -> None:
        page = OnPage(drone)
        page.clock.now_ns = 0  # pictures carry the machine's time, which is later
        page.take()
        shared = drone.streams[0]
        shared.encode(key=True)
        assert page.take(acknowledge=False) == [101]
        for _ in range(8):
            shared.encode()
            page.clock.pass_s(0.2)
            page.take(acknowledge=False)
        own = drone.streams[1]
        assert (own.request.subscriber != "", own.request.kbit_s, own.request.scale) == (True, None, 0.5)
        own.encode(key=True)
        page.take(acknowledge=False)
        assert shared.consumers == [], "nobody else watches"
        page.stream.acknowledged(page.number)
        own.encode()
        assert page.take() == [101, 102]
        assert own.reports[-1] == (102, False)
        assert page.station.feeds == [
            page.station.encoded("front", FeedFormat(None, 0.5, None, own.request.subscriber))
        ]
        assert page.station.feeds[0].age_s is None, "a slow page is no fault of the camera"
        for _ in range(60):
            page.clock.pass_s(0.2)
            own.encode()
            page.take()
        shared.encode(key=True)
        page.take()
        assert (own.consumers, len(shared.consumers)) == ([], 1), "it keeps up again"
        page.stream.close()
        assert shared.consumers == []
        assert page.station.own_name() == own.request.subscriber, "the next page that is slow gets the name"

    asyncio.run(watch())


def test_a_silent_form_is_abandoned_and_retried(drone: FakeDrone) -> None:
    async def watch() -> None:
        page = OnPage(drone)
        page.clock.now_ns = 0
        page.take()
        (stream,) = drone.streams
        assert (len(stream.consumers), page.stream.shows) == (1, False)
        for feed in page.station.streams.values():
            feed._clock = page.clock
            feed._came_ns = 0
        page.clock.pass_s(SILENT_S + 0.1)
        page.take()
        assert stream.consumers == [], "an older proxy, or one without PyAV"
        page.clock.pass_s(RETRY_S - 1.0)
        page.take()
        assert stream.consumers == []
        page.clock.pass_s(1.1)
        page.take()
        assert len(stream.consumers) == 1
        for feed in page.station.streams.values():
            feed._clock = page.clock
            feed._came_ns = page.clock.now_ns
        page.clock.pass_s(SILENT_S + 0.1)
        page.take()
        page.clock.pass_s(RETRY_S + 1.0)
        page.take()
        assert stream.consumers == [], "the second time later"
        page.clock.pass_s(RETRY_S)
        page.take()
        stream.encode(key=True)
        assert page.take() == [101]
        assert page.stream.shows

    asyncio.run(watch())


def test_a_key_picture_is_requested_after_a_gap(drone: FakeDrone) -> None:
    async def watch() -> None:
        page = OnPage(drone)
        page.clock.now_ns = 0
        page.take()
        (stream,) = drone.streams
        stream.encode(key=True)
        assert page.take() == [101]
        stream.encode(lost=1)
        assert page.take() == []
        assert stream.reports[-1] == (0, True)
        stream.encode(key=True)
        assert page.take() == [104]
        assert page.stream.skipped == 2
        stream.encode()
        page.stream.restart()  # the page's decoder failed
        assert page.take() == []
        stream.encode(key=True)
        assert page.take() == [106]

    asyncio.run(watch())


# Pages -------------------------------------------------------------------------------------------------------------


def video(client: TestClient) -> WebSocketTestSession:
    return open_socket(client, "drones/alpha/video/front")


def stream_of(drone: FakeDrone, number: int = 0) -> FakeStream:
    until(lambda: len(drone.streams) > number and drone.streams[number].consumers, "it is subscribed to")
    return drone.streams[number]


def test_a_page_that_decodes_h264_gets_it_and_first_a_jpeg(client: TestClient, drone: FakeDrone) -> None:
    with video(client) as socket:
        until(lambda: drone.processors["front"])
        socket.send_json({"h264": True, "width": 640})
        stream = stream_of(drone)
        drone.show(50)
        head, data = unpack(socket.receive_bytes())
        assert ("h264" in head, data[:2]) == (False, b"\xff\xd8")
        key = stream.encode(key=True)
        head, data = unpack(socket.receive_bytes())
        assert (head["seq"], head["captured_ns"], data) == (key.seq, str(key.captured_ns), key.data)
        assert head["h264"] == {"key": True, "kind": "shared", "kbit_s": stream.request.kbit_s}
        until(lambda: not drone.processors["front"], "JPEGs are no longer made")
        for _ in range(MOST_UNDER_WAY + 3):
            stream.encode()
        heads = [unpack(socket.receive_bytes())[0] for _ in range(MOST_UNDER_WAY - 1)]
        socket.send_json({"ack": heads[-1]["ack"]})
        assert unpack(socket.receive_bytes())[0]["seq"] == heads[-1]["seq"] + 1, "no more before it was acknowledged"
        socket.send_json({"h264": False})
        until(lambda: drone.processors["front"], "it can't decode it after all")
        drone.show(60)
        while "h264" in (head := unpack(socket.receive_bytes())[0]):
            pass
        assert head["width"] == 64
    until(lambda: not drone.processors["front"])
    assert stream.consumers == []


def test_a_key_for_a_page_that_has_lost_its_place(client: TestClient, drone: FakeDrone) -> None:
    with video(client) as socket:
        socket.send_json({"h264": True, "width": 0})
        stream = stream_of(drone)
        stream.encode(key=True)
        unpack(socket.receive_bytes())
        socket.send_json({"key": True})
        until(lambda: (stream.encode(), stream.reports)[1], "the proxy is asked")
        key = stream.encode(key=True)
        while (head := unpack(socket.receive_bytes())[0])["seq"] != key.seq:
            socket.send_json({"ack": head["ack"]})


def test_small_video_as_h264_in_one_message(client: TestClient, drone: FakeDrone) -> None:
    place = {"drone": "alpha", "camera": "front"}
    with open_socket(client, "video") as socket:
        socket.send_json({"show": place, "width": 300, "h264": True})
        stream = stream_of(drone)
        assert stream.request.max_fps == FPS
        pictures = [stream.encode(key=True), stream.encode()]
        frames: list[dict[str, Any]] = []
        while len(frames) < 2:
            head, data = unpack(socket.receive_bytes())
            frames += head["frames"]
            socket.send_json({"ack": head["ack"]})
        assert [frame["seq"] for frame in frames] == [one.seq for one in pictures]
        assert [frame["h264"]["key"] for frame in frames] == [True, False]
        assert data.endswith(pictures[-1].data)
        socket.send_json({"key": place})
        until(lambda: (stream.encode(), stream.reports)[1], "the proxy is asked")
        socket.send_json({"hide": place})
        until(lambda: not stream.consumers, "nobody sees it")


def test_a_stalled_page_does_not_affect_the_others(client: TestClient, drone: FakeDrone) -> None:
    with video(client) as stalled, video(client) as quick:
        for socket in (stalled, quick):
            socket.send_json({"h264": True, "width": 0})
        stream = stream_of(drone)
        sent = [stream.encode(key=True).seq]
        head = unpack(quick.receive_bytes())[0]
        for _ in range(40):
            quick.send_json({"ack": head["ack"]})
            sent.append(stream.encode().seq)
            head = unpack(quick.receive_bytes())[0]
            assert head["seq"] == sent[-1]
            assert head["age_s"] < 1.0


def test_the_age_of_the_video_is_known_to_alarms(drone: FakeDrone) -> None:
    async def watch() -> None:
        page = OnPage(drone)
        page.clock.now_ns = 0
        page.take()
        drone.streams[0].encode(key=True, captured_ns=1)
        page.take()
        assert (page.station.feeds[0].age_s or 0.0) > 1.0
        await page.station.view._read_channels()
        shown = page.station.view._channels["video/front"]
        assert (shown["count"], shown["lost"]) == (1, 0)
        found = TelemetryView(page.station).alarms(None)
        assert "video_age.front" in {alarm.id for alarm in found}

    asyncio.run(watch())
