"""Routes of the page: kept in a folder, checked, and flown by a page that has control."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from skyloop.cockpit import control_session
from skyloop.cockpit.fleet import CockpitFleet
from skyloop.cockpit.recordings import Recordings
from skyloop.cockpit.routes import MOST_CHECKED, CheckedRoutes, RouteFiles
from skyloop.cockpit.station import PilotConnection
from skyloop.control.route import Conditions, Route, RouteWaypoint, check_route
from skyloop.errors import RefusedError, UnknownNameError, UsageError
from skyloop.messages import AnyAction, FlightState, Hover
from tests.support.cockpit import ORIGIN, Node, Nodes, cockpit, until
from tests.support.cockpit_page import Page, page
from tests.support.testclient import TestClient

TRIANGLE: dict[str, Any] = {
    "name": "triangle",
    "speed": 1.0,
    "waypoints": [
        {"x": 0.3, "y": 0.0, "z": 0.3, "actions": [{"do": "photo"}]},
        {"x": 0.3, "y": 0.3, "z": 0.4, "yaw": 0.4},
        {"x": 0.0, "y": 0.3, "z": 0.3},
    ],
}


def route(*places: tuple[float, float, float]) -> Route:
    return Route(waypoints=tuple(RouteWaypoint(*place) for place in places))


@pytest.fixture
def client(node: Node, tmp_path: Path) -> Iterator[TestClient]:
    with cockpit(CockpitFleet(Nodes(node)), recordings=Recordings(tmp_path)) as client:
        client.headers.update(ORIGIN)
        yield client


# Files -----------------------------------------------------------------------------------------------------------


def test_routes_are_kept_listed_and_deleted(tmp_path: Path) -> None:
    files = RouteFiles(tmp_path / "routes")
    assert files.listing()["routes"] == []
    files.save("my tour-1", route((1, 2, 1)))
    assert files.load("my tour-1").name == "my tour-1"
    (files.folder / "broken.route.json").write_text("{")
    assert [(one["name"], one["waypoints"]) for one in files.listing()["routes"]] == [
        ("broken", None),
        ("my tour-1", 1),
    ]
    files.delete("my tour-1")
    with pytest.raises(UnknownNameError):
        files.load("my tour-1")
    with pytest.raises(UnknownNameError):
        files.delete("my tour-1")


@pytest.mark.parametrize("name", ["", "..", "../x", "a/b", ".hidden", "x" * 49, "a\nb", "a\\b", "ä"])
def test_a_name_never_leads_out_of_the_folder(name: str, tmp_path: Path) -> None:
    files = RouteFiles(tmp_path)
    for use in (files.load, files.delete, lambda name: files.save(name, route((1, 2, 1)))):
        with pytest.raises(UsageError, match="is not a valid route name"):
            use(name)
    assert list(tmp_path.iterdir()) == []


def test_only_the_routes_that_were_checked_last_may_be_flown() -> None:
    kept = CheckedRoutes()
    numbers = []
    for x in range(MOST_CHECKED + 1):
        one = route((x, 0, 1))
        numbers.append(kept.add(one, check_route(one, Conditions()))["id"])
    assert len(set(numbers)) == MOST_CHECKED + 1
    assert kept.get(numbers[-1]).waypoints[0].x == MOST_CHECKED
    with pytest.raises(RefusedError, match="check it again"):
        kept.get(numbers[0])


# Requests --------------------------------------------------------------------------------------------------------


def checked(client: TestClient, wanted: dict[str, Any] = TRIANGLE) -> dict[str, Any]:
    answer = client.post("/api/drones/alpha/route/check", json=wanted)
    assert answer.status_code == 200, answer.text
    values: dict[str, Any] = answer.json()
    return values


def test_the_page_saves_loads_and_deletes(client: TestClient) -> None:
    assert client.post("/api/routes/tour", json=TRIANGLE).status_code == 201
    assert [one["name"] for one in client.get("/api/routes").json()["routes"]] == ["tour"]
    assert client.get("/api/routes/tour").json()["waypoints"] == TRIANGLE["waypoints"]
    assert client.post("/api/routes/tour/delete", json={}).status_code == 200
    assert client.get("/api/routes/tour").status_code == 404


@pytest.mark.parametrize(
    ("path", "body", "status", "words"),
    [
        ("/api/routes/tour", {"waypoints": []}, 400, "length >= 1"),
        ("/api/routes/tour", {"waypoints": [{"x": 1, "y": 2}]}, 400, "$.waypoints[0]"),
        ("/api/routes/..%2fx", TRIANGLE, 404, ""),
        ("/api/drones/alpha/route/check", [], 400, "not a route"),
        ("/api/drones/nobody/route/check", TRIANGLE, 404, "nobody"),
    ],
)
def test_invalid_routes_are_refused(client: TestClient, path: str, body: Any, status: int, words: str) -> None:
    answer = client.post(path, json=body)
    assert answer.status_code == status
    assert words in answer.text
    assert client.get("/api/routes").json()["routes"] == []


def test_the_check_names_waypoints(client: TestClient) -> None:
    with page(client) as pilot:
        pilot.take().say("set", name="safety.box.x_high", value=2.0)
        pilot.wait("done", do="set")
    far = {**TRIANGLE, "waypoints": [*TRIANGLE["waypoints"], {"x": 3, "y": 0, "z": 1}]}
    found = checked(client, far)
    assert not found["ok"]
    assert [one["waypoint"] for one in found["findings"] if one["severity"] == "error"] == [4]
    assert found["length_m"] > 1.0


# Flying ----------------------------------------------------------------------------------------------------------


def told(pilot: Page, kind: str) -> dict[str, Any]:
    while True:
        message: dict[str, Any] = pilot.wait("route")
        if message["kind"] == f"route.{kind}":
            return message


def test_a_route_is_flown_paused_resumed_and_skipped(
    client: TestClient, node: Node, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("SILENT_S", "GONE_S"):  # a test delayed by half a second must not count as a silent page
        monkeypatch.setattr(control_session, name, getattr(control_session, name) + 30.0)
    number = checked(client)["id"]
    with page(client) as pilot:
        pilot.take().say("route", id=number)
        assert "take off first" in pilot.wait("refused", do="route")["why"]
        pilot.take_off()
        pilot.say("route", id="other")
        assert "check it again" in pilot.wait("refused", do="route")["why"]
        pilot.say("route", id=number)
        with pilot.staying():
            assert told(pilot, "waypoint_reached")["waypoint"] == 1
            pilot.say("route_pause")
            assert told(pilot, "paused")["state"] == "paused"
            until(lambda: node.flyer.applied[-1] == Hover())
            pilot.say("route_skip")
            pilot.say("route_resume")
            told(pilot, "resumed")
            while (reached := told(pilot, "waypoint_reached"))["waypoint"] != 3:
                assert reached["waypoint"] == 2
            assert told(pilot, "done")["state"] == "done"
        assert len(list(tmp_path.glob("photos/alpha/*-waypoint1-front.jpg"))) <= 1, "unless it was skipped"
        assert math.dist(node.flyer.place, (0.0, 0.3, 0.3)) < 0.2
        until(lambda: node.flyer.state is FlightState.HOVERING)
        pilot.say("route_resume")
        assert "not flying a route" in pilot.wait("refused", do="route_resume")["why"]


def test_a_page_that_falls_silent_or_commands_something_else_pauses_the_route(client: TestClient, node: Node) -> None:
    number = checked(client, {**TRIANGLE, "waypoints": [{"x": 40, "y": 0, "z": 0.5}]})["id"]
    with page(client) as pilot:
        pilot.take().take_off()
        pilot.say("route", id=number)
        told(pilot, "started")
        assert told(pilot, "paused")["problem"], "the page was silent"
        until(lambda: node.flyer.state is FlightState.HOVERING)
        assert node.flyer.place[0] < 3.0
        with pilot.staying():
            pilot.say("route_resume")
            until(lambda: node.flyer.state is FlightState.FLYING)
            pilot.say("hover")
            assert told(pilot, "paused")["problem"]
            until(lambda: node.flyer.applied[-1] == Hover())
            pilot.say("route_resume")
            until(lambda: node.flyer.state is FlightState.FLYING)
    until(lambda: node.flyer.state in (FlightState.HOVERING, FlightState.LANDING, FlightState.LANDED))
    assert node.flyer.place[0] < 10.0, "a page that is gone flies nowhere"


@pytest.mark.parametrize(("first", "then"), [("route", "route_skip"), ("goto", "route_resume")])
def test_a_failed_route_control_leaves_the_vehicle_hovering(
    client: TestClient, node: Node, monkeypatch: pytest.MonkeyPatch, first: str, then: str
) -> None:
    """It flew on to its previous goal, but no one watched that any more."""
    number = checked(client, {**TRIANGLE, "waypoints": [{"x": 40, "y": 0, "z": 0.5}, {"x": 40, "y": 1, "z": 0.5}]})[
        "id"
    ]
    with page(client) as pilot:
        pilot.take().take_off()
        with pilot.staying():
            pilot.say("route", id=number)
            until(lambda: node.flyer.state is FlightState.FLYING)
            if first == "goto":
                pilot.say("goto", x=-40, y=0, z=1)
                until(lambda: node.flyer.place[0] < -0.2)

            def refuse(self: PilotConnection, _: AnyAction) -> bool:
                raise RefusedError("not now")

            monkeypatch.setattr(PilotConnection, "command", refuse)
            pilot.say(then)
            assert pilot.wait("refused", do=then)["why"] == "not now"
            until(lambda: node.flyer.state is FlightState.HOVERING)
