"""The page and its two streams, with a drone that is not there."""

from __future__ import annotations

import json
import struct
import threading
import time
from collections.abc import Iterator
from typing import Any

import cv2
import numpy as np
import pytest
from starlette.websockets import WebSocketDisconnect

from skyloop.cockpit.app import STATIC, create_app
from skyloop.cockpit.security import own_names
from skyloop.messages import Annotation, LinkState, Points, Polyline, Severity, Text
from tests.cockpit.fake import FakeDrone, flying
from tests.cockpit.testclient import TestClient, WebSocketTestSession

OWN = "http://127.0.0.1:8123"
SOCKETS = "ws://127.0.0.1:8123/ws/drones"
ORIGIN = {"origin": OWN}


@pytest.fixture
def drone() -> FakeDrone:
    return FakeDrone()


@pytest.fixture
def client(drone: FakeDrone) -> Iterator[TestClient]:
    app = create_app({"alpha": drone}, own_names("127.0.0.1", 8123))  # type: ignore[dict-item]
    with TestClient(app, base_url=OWN) as client:
        yield client


def telemetry(client: TestClient) -> WebSocketTestSession:
    return client.websocket_connect(f"{SOCKETS}/alpha/telemetry", headers=ORIGIN)


def video(client: TestClient, camera: str = "front") -> WebSocketTestSession:
    return client.websocket_connect(f"{SOCKETS}/alpha/video/{camera}", headers=ORIGIN)


def until(condition: Any, timeout_s: float = 5.0) -> None:
    deadline = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < deadline, "it did not happen in time"
        time.sleep(0.002)


def frame(message: bytes) -> tuple[dict[str, Any], np.ndarray]:
    (length,) = struct.unpack_from(">I", message)
    head = json.loads(message[4 : 4 + length])
    image = cv2.imdecode(np.frombuffer(message[4 + length :], np.uint8), cv2.IMREAD_COLOR)
    assert image is not None
    return head, image


def statistics(client: TestClient) -> dict[str, Any]:
    answer: dict[str, Any] = client.get("/api/statistics").json()
    return answer


def test_page_and_everything_that_it_names_is_served(client: TestClient) -> None:
    page = client.get("/")
    assert page.status_code == 200
    assert "Skyloop" in page.text
    for file in STATIC.rglob("*.*"):
        answer = client.get(f"/static/{file.relative_to(STATIC).as_posix()}")
        assert answer.status_code == 200
        if file.suffix == ".js":
            assert "javascript" in answer.headers["content-type"]
    assert client.get("/static/../app.py").status_code == 404
    assert client.get("/nothing").status_code == 404


def test_safety_states_are_labelled_for_screen_readers(client: TestClient) -> None:
    page = client.get("/").text
    for label in ('role="alert"', 'aria-label="Flight state"', 'aria-label="Battery"', "Who holds the authority"):
        assert label in page


def test_drones_are_listed(client: TestClient) -> None:
    assert client.get("/api/drones").json() == [
        {"name": "alpha", "uri": "sim://?seed=1", "cameras": ["front", "bottom"]}
    ]


def test_telemetry_flows(client: TestClient, drone: FakeDrone) -> None:
    drone.tell("authority to demo", app="demo")
    with telemetry(client) as socket:
        vehicle = socket.receive_json()
        assert (vehicle["type"], vehicle["name"], vehicle["can_fly"]) == ("vehicle", "alpha", True)
        first = socket.receive_json()
        assert first["feedback"] is None
        assert first["channels"]["feedback"]["delay_s"]["median"] == pytest.approx(0.0002)
        drone.newest = flying(battery=float("nan"))
        drone.link.vehicle = LinkState.LOST
        drone.tell("vehicle link lost", severity=Severity.ERROR)
        told = [event["text"] for event in first["events"]]
        state = first
        while state["feedback"] is None or len(told) < 2:
            state = socket.receive_json()
            told += [event["text"] for event in state["events"]]
        assert told == ["authority to demo", "vehicle link lost"]
        feedback = state["feedback"]
        assert feedback["state"] == "flying"
        assert feedback["owner"] == "demo"
        assert feedback["battery"] is None, "NaN is no JSON"
        assert feedback["altitude"] == pytest.approx(1.25)
        assert feedback["age_s"] >= 0
        assert state["link"]["vehicle"] == "lost"


def test_telemetry_comes_steadily(client: TestClient, drone: FakeDrone) -> None:
    drone.newest = flying()
    with telemetry(client) as socket:
        socket.receive_json()
        socket.receive_json()
        started = time.monotonic()
        for _ in range(10):
            socket.receive_json()
        rate = 10 / (time.monotonic() - started)
        assert 6 < rate < 20, "about 18 a second; fewer on a busy machine, never a flood"


def test_video_one_frame_until_acknowledged_then_the_newest(client: TestClient, drone: FakeDrone) -> None:
    with video(client) as socket:
        until(lambda: drone.processors["front"])
        drone.show(10)
        head, image = frame(socket.receive_bytes())
        assert (head["width"], head["height"], head["camera"]) == (64, 48, "front")
        assert 0 <= head["age_s"] < 5
        assert image.mean() == pytest.approx(10, abs=2)
        for shade in (60, 110, 160):  # nothing of these is sent: the first is not acknowledged
            drone.show(shade)
        until(lambda: statistics(client)["frames_sent"] == 1)
        assert statistics(client)["frames_sent"] == 1
        socket.send_json({"ack": head["ack"]})
        head, image = frame(socket.receive_bytes())
        assert image.mean() == pytest.approx(160, abs=2), "the newest, not the next"
        until(lambda: statistics(client)["frames_skipped"] == 2)
        socket.send_json({"ack": head["ack"]})
        until(lambda: statistics(client)["frames_acknowledged"] == 2)
        assert statistics(client)["frames_sent"] == 2, "the same frame is not sent twice"


def test_old_acknowledgement_counts_for_nothing(client: TestClient, drone: FakeDrone) -> None:
    with video(client) as socket:
        until(lambda: drone.processors["front"])
        drone.show(10)
        head, _ = frame(socket.receive_bytes())
        socket.send_json({"ack": head["ack"]})
        until(lambda: statistics(client)["frames_acknowledged"] == 1)
        drone.show(60)
        frame(socket.receive_bytes())
        socket.send_json({"ack": head["ack"]})
        drone.show(90)
        socket.send_json({"ack": head["ack"]})
        assert statistics(client)["frames_sent"] == 2
        assert statistics(client)["frames_acknowledged"] == 1


def test_pages_are_independent_and_the_camera_rests_without_them(client: TestClient, drone: FakeDrone) -> None:
    with video(client) as quick:
        until(lambda: drone.processors["front"])
        with video(client) as slow:
            drone.show(10)
            head, _ = frame(slow.receive_bytes())
            for shade in (10, 60, 110):
                if shade != 10:
                    drone.show(shade)
                head, image = frame(quick.receive_bytes())
                assert image.mean() == pytest.approx(shade, abs=2)
                quick.send_json({"ack": head["ack"]})
                until(lambda n=head["ack"]: statistics(client)["frames_acknowledged"] == n)
        assert len(drone.processors["front"]) == 1
    until(lambda: not drone.processors["front"])


def test_new_page_gets_the_newest_frame_at_once(client: TestClient, drone: FakeDrone) -> None:
    with video(client) as first:
        until(lambda: drone.processors["front"])
        drone.show(70)
        frame(first.receive_bytes())
        with video(client) as second:
            _, image = frame(second.receive_bytes())
            assert image.mean() == pytest.approx(70, abs=2)


def test_drawings_follow_the_frame_that_they_belong_to(client: TestClient, drone: FakeDrone) -> None:
    shapes = (
        Polyline(((1.0, 2.0), (3.0, 4.0)), True, (255, 0, 0)),
        Points(((5.0, 6.0),)),
        Text("marker 7", (8.0, 9.0)),
    )
    with video(client) as socket:
        until(lambda: drone.processors["front"])
        first = drone.show(10)
        head, _ = frame(socket.receive_bytes())
        drone.draw(Annotation("follow", "front", first.captured_ns, 64, 48, shapes))
        drawing = socket.receive_json()
        assert drawing["type"] == "drawing"
        assert drawing["captured_ns"] == head["captured_ns"] == str(first.captured_ns)
        assert [shape["kind"] for shape in drawing["shapes"]] == ["line", "points", "text"]
        later = drone.show(60)
        drone.draw(Annotation("follow", "front", later.captured_ns, 64, 48, shapes[:1]))
        drone.draw(Annotation("follow", "bottom", later.captured_ns, 64, 48, ()))
        socket.send_json({"ack": head["ack"]})
        # Never ahead of its frame, and nothing of another camera.
        head, _ = frame(socket.receive_bytes())
        assert head["captured_ns"] == str(later.captured_ns)
        assert len(socket.receive_json()["shapes"]) == 1


@pytest.mark.parametrize("message", ["", "x", "[]", '{"ack": "1"}', '{"takeoff": 1}', "[" * 4000])
def test_anything_but_an_acknowledgement_ends_the_connection(client: TestClient, message: str) -> None:
    with video(client) as socket:
        socket.send_text(message)
        with pytest.raises(WebSocketDisconnect) as ended:
            socket.receive_bytes()
        assert ended.value.code == 1008


def test_binary_from_a_page_ends_the_connection(client: TestClient) -> None:
    with video(client) as socket:
        socket.send_bytes(b"\x00")
        with pytest.raises(WebSocketDisconnect) as ended:
            socket.receive_bytes()
        assert ended.value.code == 1008


def test_words_to_the_telemetry_stream_end_the_connection(client: TestClient) -> None:
    with telemetry(client) as socket:
        socket.send_text("takeoff")
        message: dict[str, Any] = {}
        while message.get("type") != "websocket.close":
            message = dict(socket.receive())
        assert message["code"] == 1008


@pytest.mark.parametrize("path", ["beta/telemetry", "beta/video/front", "alpha/video/rear"])
def test_unknown_names_are_told(client: TestClient, path: str) -> None:
    with (
        client.websocket_connect(f"{SOCKETS}/{path}", headers=ORIGIN) as socket,
        pytest.raises(WebSocketDisconnect) as ended,
    ):
        socket.receive_json()
    assert ended.value.code == 4404


def test_pages_are_counted(client: TestClient, drone: FakeDrone) -> None:
    with telemetry(client) as socket:
        socket.receive_json()
        until(lambda: statistics(client)["pages"] == 1)
    until(lambda: statistics(client)["pages"] == 0)


def test_everything_is_given_back(drone: FakeDrone) -> None:
    before = threading.active_count()
    app = create_app({"alpha": drone}, own_names("127.0.0.1", 8123))  # type: ignore[dict-item]
    with TestClient(app, base_url=OWN) as client, video(client) as socket:
        until(lambda: drone.processors["front"])
        drone.show(10)
        socket.receive_bytes()
    assert not drone.event_listeners
    assert not drone.annotation_listeners
    assert not drone.processors["front"]
    until(lambda: threading.active_count() <= before)
