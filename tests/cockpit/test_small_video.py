"""Small video of many drones over one socket: encoded once per size, at a limited rate; slow pages delay no others."""

from __future__ import annotations

import asyncio
from collections.abc import Iterator
from contextlib import ExitStack
from typing import Any

import cv2
import msgspec
import numpy as np
import pytest

from skyloop.cockpit.encoded_feed import FPS, WIDTHS, CameraFeed, SmallFeed, rounded_width
from skyloop.cockpit.small_video import MAX_SHOWN
from skyloop.messages import CameraInfo
from tests.support.cockpit import FakeDrone, cockpit, fake_fleet, open_socket, until
from tests.support.testclient import TestClient, WebSocketTestSession

SIZE = (640, 480)


@pytest.fixture
def drones() -> dict[str, FakeDrone]:
    return {name: FakeDrone(*SIZE) for name in ("alpha", "beta")}


@pytest.fixture
def client(drones: dict[str, FakeDrone]) -> Iterator[TestClient]:
    with cockpit(fake_fleet(drones)) as client:
        yield client


def video(client: TestClient) -> WebSocketTestSession:
    return open_socket(client, "video")


def show(socket: WebSocketTestSession, drone: str, width: int = 160, camera: str = "front") -> None:
    socket.send_json({"show": {"drone": drone, "camera": camera}, "width": width})


def unpack(message: bytes) -> tuple[dict[str, Any], list[np.ndarray]]:
    length = int.from_bytes(message[:4], "big")
    head = msgspec.json.decode(message[4 : 4 + length])
    pictures, at = [], 4 + length
    for frame in head["frames"]:
        picture = cv2.imdecode(np.frombuffer(message[at : at + frame["bytes"]], np.uint8), cv2.IMREAD_COLOR)
        assert picture is not None
        pictures.append(picture)
        at += frame["bytes"]
    assert at == len(message)
    return head, pictures


def subscribed(drone: FakeDrone, count: int = 1) -> None:
    until(lambda: len(drone.processors["front"]) == count)


@pytest.mark.parametrize(("wish", "width"), [(0, 160), (160, 160), (161, 240), (250, 320), (480, 480), (5000, 480)])
def test_a_width_is_rounded_up_to_a_shared_size(wish: int, width: int) -> None:
    assert rounded_width(wish) == width


def test_all_cameras_that_a_page_shows_come_in_one_message(client: TestClient, drones: dict[str, FakeDrone]) -> None:
    with video(client) as socket:
        for name, drone in drones.items():
            show(socket, name, 160)
            subscribed(drone)
            assert drone.requests == [("front", {"inline": True, "encoding": "jpeg", "max_fps": FPS, "scale": 0.25})]
        seen: dict[str, int] = {}
        for shade, drone in enumerate(drones.values(), 1):
            drone.show(shade * 80)
        while len(seen) < 2:  # one message, unless the second frame came just after it
            head, pictures = unpack(socket.receive_bytes())
            for frame, picture in zip(head["frames"], pictures, strict=True):
                seen[frame["drone"]] = round(float(picture.mean()))
                assert (frame["camera"], frame["seq"]) == ("front", 1)
                assert 0.0 <= frame["age_s"] < 5.0
            socket.send_json({"ack": head["ack"]})
        assert seen == {"alpha": pytest.approx(80, abs=2), "beta": pytest.approx(160, abs=2)}


def test_each_frame_is_encoded_once_per_size(client: TestClient, drones: dict[str, FakeDrone]) -> None:
    alpha = drones["alpha"]
    with ExitStack() as stack:
        pages = [stack.enter_context(video(client)) for _ in range(4)]
        for page, width in zip(pages, (150, 160, 300, 320), strict=True):
            show(page, "alpha", width)
        subscribed(alpha, 2)  # sizes, not pages
        alpha.show(9)
        for page in pages:
            unpack(page.receive_bytes())
        assert client.get("/api/statistics").json()["frames_encoded"] == 2


def test_a_page_that_stops_drawing_gets_no_more_and_delays_no_others(
    client: TestClient, drones: dict[str, FakeDrone]
) -> None:
    alpha = drones["alpha"]
    with video(client) as slow, video(client) as quick:
        for page in (slow, quick):
            show(page, "alpha")
        subscribed(alpha)
        drawn = 0
        for shade in (10, 60, 110):
            alpha.show(shade)
            head, (picture,) = unpack(quick.receive_bytes())
            assert picture.mean() == pytest.approx(shade, abs=2)
            quick.send_json({"ack": head["ack"]})
            if not drawn:
                head, (picture,) = unpack(slow.receive_bytes())
                drawn = head["ack"]
        slow.send_json({"ack": drawn + 7})  # for a message it never received
        slow.send_json({"ack": drawn})
        head, (picture,) = unpack(slow.receive_bytes())
        assert picture.mean() == pytest.approx(110, abs=2), "the newest, and none between"


def test_hidden_cameras_are_not_encoded(client: TestClient, drones: dict[str, FakeDrone]) -> None:
    alpha, beta = drones.values()
    with video(client) as socket:
        for name, drone in drones.items():
            show(socket, name)
            subscribed(drone)
        socket.send_json({"hide": {"drone": "alpha", "camera": "front"}})
        subscribed(alpha, 0)
        beta.show(5)
        assert [frame["drone"] for frame in unpack(socket.receive_bytes())[0]["frames"]] == ["beta"]
    subscribed(beta, 0)


def test_a_drone_appears_when_it_is_found(client: TestClient, drones: dict[str, FakeDrone]) -> None:
    with video(client) as socket:
        show(socket, "gamma")
        show(socket, "alpha", camera="none of that name")
        show(socket, "beta")
        subscribed(drones["beta"])
        drones["beta"].show(5)
        assert [frame["drone"] for frame in unpack(socket.receive_bytes())[0]["frames"]] == ["beta"]


@pytest.mark.parametrize("message", ["", "[]", '{"show":3}', '{"show":{"drone":"a"}}', '{"look":1}', '{"ack":"x"}'])
def test_nonsense_ends_the_connection(client: TestClient, message: str) -> None:
    with video(client) as socket:
        socket.send_text(message)
        closed = socket.receive()
        assert (closed["type"], closed["code"]) == ("websocket.close", 1008)
        assert "not understood" in closed["reason"]


def test_the_number_of_cameras_on_a_page_is_limited(client: TestClient) -> None:
    with video(client) as socket:
        for number in range(MAX_SHOWN + 1):
            show(socket, f"drone{number}")
        closed = socket.receive()
        assert (closed["code"], f"at most {MAX_SHOWN}" in closed["reason"]) == (1008, True)


def test_a_small_camera_is_not_made_larger() -> None:
    drone = FakeDrone()
    feed = SmallFeed(drone, CameraInfo("front", 64, 48, 15.0), WIDTHS[0])  # type: ignore[arg-type]
    feed.subscribe()
    assert drone.requests[0][1]["scale"] == 1.0
    feed.unsubscribe()
    assert drone.processors["front"] == []


def test_video_has_an_age_from_its_first_picture_on() -> None:
    async def watch() -> None:
        drone, now_ns = FakeDrone(), 0
        small = SmallFeed(drone, CameraInfo("front", 64, 48, 15.0), WIDTHS[0], lambda: now_ns)  # type: ignore[arg-type]
        large = CameraFeed(drone, "front", lambda: now_ns)  # type: ignore[arg-type]

        def woken() -> None: ...

        small.subscribe()
        large.subscribe(woken)
        now_ns = 20_000_000_000
        assert (small.age_s, large.age_s) == (None, None), "the vehicle is starting"
        drone.show()
        await asyncio.sleep(0)  # the frame is handed over on the loop
        assert small.age_s is not None
        assert large.age_s is not None
        small.unsubscribe()
        large.unsubscribe(woken)
        small.subscribe()
        large.subscribe(woken)
        now_ns = 23_000_000_000
        assert (small.age_s, large.age_s) == (3.0, 3.0), "it sent pictures before"

    asyncio.run(watch())
