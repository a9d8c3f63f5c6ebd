"""The page and its two streams, with a stand-in for a drone."""

from __future__ import annotations

import json
import mimetypes
import struct
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from starlette.websockets import WebSocketDisconnect

from skyloop.messages import (
    Annotation,
    Applied,
    CameraInfo,
    Capabilities,
    EventKind,
    LinkState,
    LogEntry,
    Points,
    Polyline,
    Severity,
    Text,
    Velocity,
)
from tests.support.cockpit import FakeDrone, cockpit, fake_fleet, flying, open_socket, until
from tests.support.testclient import TestClient, WebSocketTestSession


@pytest.fixture
def drone() -> FakeDrone:
    return FakeDrone()


@pytest.fixture
def client(drone: FakeDrone) -> Iterator[TestClient]:
    with cockpit(fake_fleet({"alpha": drone})) as client:
        yield client


def telemetry(client: TestClient) -> WebSocketTestSession:
    return open_socket(client, "drones/alpha/telemetry")


def video(client: TestClient, camera: str = "front") -> WebSocketTestSession:
    return open_socket(client, f"drones/alpha/video/{camera}")


def frame(message: bytes) -> tuple[dict[str, Any], np.ndarray]:
    (length,) = struct.unpack_from(">I", message)
    head = json.loads(message[4 : 4 + length])
    image = cv2.imdecode(np.frombuffer(message[4 + length :], np.uint8), cv2.IMREAD_COLOR)
    assert image is not None
    return head, image


def statistics(client: TestClient) -> dict[str, Any]:
    answer: dict[str, Any] = client.get("/api/statistics").json()
    return answer


def test_the_page_and_its_files_are_served(drone: FakeDrone, tmp_path: Path) -> None:
    static = tmp_path / "static"
    static.mkdir()
    (tmp_path / "secret.txt").write_text("secret")
    with cockpit(fake_fleet({"alpha": drone}), static=static) as client:
        answer = client.get("/")
        assert (answer.status_code, "not built" in answer.text) == (503, True)
        (static / "index.html").write_text("<title>Cockpit</title>")
        (static / "page.js").write_text("export {}")
        assert "Cockpit" in client.get("/").text
        assert "javascript" in client.get("/static/page.js").headers["content-type"]
        for path in ("/static/../secret.txt", "/static/%2e%2e/secret.txt", "/static/nothing.js"):
            assert client.get(path).status_code == 404
        assert client.get("/nothing").status_code == 404


def test_the_system_does_not_decide_what_a_script_is(
    drone: FakeDrone, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A browser runs no module that is served as text, which is what the registry of many Windows computers says."""
    mimetypes.init()
    monkeypatch.setitem(mimetypes.types_map, ".js", "text/plain")
    (tmp_path / "page.js").write_text("export {}")
    with cockpit(fake_fleet({"alpha": drone}), static=tmp_path) as client:
        assert "javascript" in client.get("/static/page.js").headers["content-type"]


def test_drones_are_listed(client: TestClient) -> None:
    assert client.get("/api/drones").json() == [
        {"name": "alpha", "uri": "sim://?seed=1", "cameras": ["front", "bottom"]}
    ]


def follow(socket: WebSocketTestSession, enough: Callable[[dict[str, Any]], Any]) -> dict[str, Any]:
    """Return the first state that satisfies a condition."""
    deadline = time.monotonic() + 5
    while time.monotonic() < deadline:
        message: dict[str, Any] = socket.receive_json()
        if message["type"] == "state" and enough(message):
            return message
    raise AssertionError("no such state came")


def test_telemetry_flows(client: TestClient, drone: FakeDrone) -> None:
    drone.tell("authority to demo", app="demo")
    with telemetry(client) as socket:
        vehicle = socket.receive_json()
        assert (vehicle["type"], vehicle["name"], vehicle["can_fly"]) == ("vehicle", "alpha", True)
        assert vehicle["priorities"] == [0, 31]
        first = socket.receive_json()
        assert first["feedback"] is None
        assert first["attitude"] is None
        assert [event["text"] for event in first["events"]] == ["authority to demo"]
        channels = follow(socket, lambda state: state["channels"])["channels"]
        assert channels["feedback"]["delay_s"]["median"] == pytest.approx(0.0002)
        drone.newest = flying(battery=float("nan"))
        drone.link.vehicle = LinkState.LOST
        drone.tell("vehicle link lost", severity=Severity.ERROR)
        state = follow(socket, lambda state: state["events"])
        assert [event["text"] for event in state["events"]] == ["vehicle link lost"], "each is told once"
        state = follow(socket, lambda state: state["feedback"])
        feedback = state["feedback"]
        assert feedback["state"] == state["flight"] == "flying"
        assert feedback["owner"] == state["owner"] == "demo"
        assert feedback["battery"] is None, "NaN is no JSON"
        assert state["altitude"] == pytest.approx(1.25)
        assert state["attitude"] == {"roll": 0.1, "pitch": -0.05, "yaw": 1.0}
        assert feedback["age_s"] >= 0
        assert state["link"]["vehicle"] == state["links"]["vehicle"] == "lost"
        assert state["authority"] == {"holder": "demo", "priority": 16, "lease": 3, "me": False}
        assert state["alarms"] == [{"id": "vehicle_link", "severity": "critical", "text": "link to the vehicle lost"}]


def test_commands_and_logs_are_subscribed_while_a_page_is_open(client: TestClient, drone: FakeDrone) -> None:
    assert not drone.command_listeners
    assert not drone.log_listeners
    drone.newest = flying(native={"pwm": 3, "name": "x", "gyro": (1.0, 2.0)})
    with telemetry(client) as socket:
        follow(socket, lambda _: True)
        now_ns = time.monotonic_ns()
        drone.command_listeners[0](Applied(1, 3, 1, now_ns, now_ns, Velocity(forward=2.0), Velocity(forward=1.0)))
        drone.log_listeners[0](LogEntry("demo", "range", now_ns, number=1.5))
        drone.log_listeners[0](LogEntry("demo", "", now_ns, text="words are no number"))
        places = (1.0, 2.0, 3.0, 4.0, 5.0, 6.0)
        drone.log_listeners[0](LogEntry("demo", "waypoints", now_ns, values=places, shape=(2, 3)))
        state = follow(socket, lambda state: state["waypoints"])
        values = state["values"]
        assert values["log.range"] == 1.5
        assert values["native.pwm"] == 3
        assert values["native.gyro.1"] == 2.0
        assert "native.name" not in values
        assert values["velocity.forward"] == pytest.approx(0.3)
        assert values["set_point.forward"] == 1.0, "as it was applied"
        assert state["set_points"]["action"] == "velocity"
        assert [one["position"] for one in state["waypoints"]] == [[1, 2, 3], [4, 5, 6]]
    until(lambda: not drone.command_listeners and not drone.log_listeners)


def test_another_vehicle_under_the_same_name_is_reported(client: TestClient, drone: FakeDrone) -> None:
    with telemetry(client) as socket:
        assert socket.receive_json()["cameras"][0]["width"] == 64
        socket.receive_json()
        drone.capabilities = Capabilities("other", frozenset(), (CameraInfo("top", 32, 24, 15.0),))
        message = socket.receive_json()
        while message["type"] != "vehicle":
            message = socket.receive_json()
        assert message["cameras"] == [{"name": "top", "width": 32, "height": 24}]


def test_overview_shows_all_drones() -> None:
    alpha, beta = FakeDrone(), FakeDrone()
    beta.newest = flying(battery=0.05, position_m=(1.0, 2.0, 3.0))
    with (
        cockpit(fake_fleet({"beta": beta, "alpha": alpha})) as client,
        open_socket(client, "overview") as first,
        open_socket(client, "overview") as second,
    ):
        message = first.receive_json()
        assert message["type"] == "overview"
        one, two = message["drones"]
        assert (one["name"], one["state"], one["airborne"], one["position"]) == ("alpha", "unknown", False, None)
        assert (two["name"], two["state"], two["airborne"], two["position"]) == ("beta", "flying", True, [1, 2, 3])
        assert (two["owner"], two["me"], two["recording"]) == ("demo", False, False)
        assert two["alarms"] == [{"id": "battery", "severity": "critical", "text": "battery critical: 5%"}]
        assert two["links"]["application"] == "up"
        assert two["cameras"][1] == {"name": "bottom", "width": 64, "height": 48}
        assert second.receive_json()["drones"][0]["name"] == "alpha"
        alpha.link.application = LinkState.LOST
        alpha.link.reason = "killed"
        deadline = time.monotonic() + 5
        while not (row := first.receive_json()["drones"][0])["alarms"]:
            assert time.monotonic() < deadline
        assert row["links"]["application"] == "lost"
        assert [alarm["text"] for alarm in row["alarms"]] == ["link to the proxy lost: killed"]


def test_stale_video_is_an_alarm(client: TestClient, drone: FakeDrone) -> None:
    drone.newest = flying()
    with video(client) as picture, telemetry(client) as socket:
        until(lambda: drone.processors["front"])
        assert follow(socket, lambda _: True)["alarms"] == []
        old = drone.show(10, captured_ns=time.monotonic_ns() - 3_000_000_000)
        head, _ = frame(picture.receive_bytes())
        assert head["captured_ns"] == str(old.captured_ns)
        drone.newest = flying()
        state = follow(socket, lambda state: state["alarms"])
        assert "video of front is 3." in state["alarms"][0]["text"]


def test_alarm_thresholds_are_reread_after_a_parameter_write(client: TestClient, drone: FakeDrone) -> None:
    drone.newest = flying(battery=0.3)
    with telemetry(client) as socket:
        assert follow(socket, lambda _: True)["alarms"] == []
        drone.config["battery.warn"] = 0.4
        drone.tell("battery.warn is 0.4", EventKind.PARAMETER_CHANGED)
        drone.newest = flying(battery=0.3)
        follow(socket, lambda state: "battery low: 30%" in [alarm["text"] for alarm in state["alarms"]])


def wait_for_acknowledgements(client: TestClient, count: int) -> None:
    until(lambda: statistics(client)["frames_acknowledged"] == count, f"{count} were acknowledged")


def test_a_picture_is_encoded_once_for_all_pages(client: TestClient, drone: FakeDrone) -> None:
    with ExitStack() as stack:
        pages = [stack.enter_context(video(client)) for _ in range(10)]
        until(lambda: drone.processors["front"])
        for number in (1, 2, 3):
            drone.show(number)
            for page in pages:
                head, _ = frame(page.receive_bytes())
                page.send_json({"ack": head["ack"]})
            wait_for_acknowledgements(client, 10 * number)
        counts = statistics(client)
        assert (counts["frames_sent"], counts["frames_encoded"]) == (30, 3)
        assert len(drone.processors["front"]) == 1


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
        for shade in (60, 110, 160):  # none of these is sent, because the first is not acknowledged
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


def test_an_old_acknowledgement_is_ignored(client: TestClient, drone: FakeDrone) -> None:
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
                wait_for_acknowledgements(client, head["ack"])
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
        # Never ahead of its frame, and none of another camera.
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


def test_messages_to_the_telemetry_stream_end_the_connection(client: TestClient) -> None:
    with telemetry(client) as socket:
        socket.send_text("takeoff")
        message: dict[str, Any] = {}
        while message.get("type") != "websocket.close":
            message = dict(socket.receive())
        assert message["code"] == 1008


@pytest.mark.parametrize("path", ["beta/telemetry", "beta/video/front", "alpha/video/rear", "beta/control"])
def test_unknown_names_are_refused(client: TestClient, path: str) -> None:
    with (
        open_socket(client, f"drones/{path}") as socket,
        pytest.raises(WebSocketDisconnect) as ended,
    ):
        socket.receive_json()
    assert ended.value.code == 4404


def test_pages_are_counted(client: TestClient, drone: FakeDrone) -> None:
    with telemetry(client) as socket:
        socket.receive_json()
        until(lambda: statistics(client)["pages"] == 1)
    until(lambda: statistics(client)["pages"] == 0)


def test_everything_is_released(drone: FakeDrone) -> None:
    def threads() -> int:  # except the one that encodes JPEGs, which belongs to the process
        return sum(not thread.name.startswith("jpeg") for thread in threading.enumerate())

    before = threads()
    with cockpit(fake_fleet({"alpha": drone})) as client, video(client) as socket:
        until(lambda: drone.processors["front"])
        drone.show(10)
        socket.receive_bytes()
    assert not drone.event_listeners
    assert not drone.annotation_listeners
    assert not drone.processors["front"]
    assert drone.closed
    until(lambda: threads() <= before)
