"""Routes flown by the controller in simulated time, including refused legs and photos."""

from __future__ import annotations

import math
from datetime import datetime
from pathlib import Path
from unittest.mock import Mock

import pytest

import skyloop
from skyloop.control import FlyRoute, Photo, Route, RouteWaypoint, Wait
from skyloop.control.route import check_for
from skyloop.control.route_law import ENDED, TAKEN, Progress, TakePhoto, save_photo
from skyloop.errors import UnknownNameError, UsageError
from skyloop.messages import Event, EventKind, Fate, Outcome, Refusal
from skyloop.stepping.rehearsal import rehearse

CALM = "sim://?world=empty&cameras=none&wind=0"
TRIANGLE = Route(
    waypoints=(
        RouteWaypoint(1.0, 0.0, 1.0, actions=(Wait(1.0), Photo())),
        RouteWaypoint(0.5, 1.0, 1.4, look_at=(0.5, 9.0)),
        RouteWaypoint(0.0, 0.0, 1.0),
    ),
    speed=0.8,
    end="return",
)


def test_a_route_of_three_waypoints(tmp_path: Path) -> None:
    told: list[Progress] = []
    events: list[Event] = []
    with rehearse(CALM) as drone:
        drone.on_event(events.append, inline=True)
        flight = FlyRoute(drone, TRIANGLE, folder=tmp_path, on_progress=told.append)
        assert flight.check().ok
        with pytest.raises(UsageError, match="landed, take off first"):
            flight.run(seconds=1.0)
        drone.takeoff()
        estimate = flight.check()
        summary = flight.run(seconds=90.0)
        assert summary.reason == "stopped"
        drone.wait("landed", 20.0)
        assert math.hypot(*(drone.feedback().position_m or ())[:2]) < 0.4
    steps = [(one.kind.removeprefix("route."), one.waypoint) for one in told]
    assert steps == [
        ("started", 1),
        ("waypoint_reached", 1),
        ("photo", 1),
        ("waypoint_reached", 2),
        ("waypoint_reached", 3),
        ("waypoint_reached", 3),
        ("done", 3),
    ]
    assert "no camera" in told[2].text
    assert 0.5 * estimate.seconds < summary.seconds < 1.5 * estimate.seconds
    own = [event.data for event in events if event.kind is EventKind.VEHICLE_MESSAGE and "route" in event.data]
    assert {"route": "route.waypoint_reached", "waypoint": "2"} in own


def test_a_refused_leg_pauses_with_the_reason_and_can_be_skipped() -> None:
    told: list[Progress] = []
    route = Route(waypoints=tuple(RouteWaypoint(x, 0.0, 1.0) for x in (0.5, 3.0, 0.0)), speed=1.0)
    with rehearse(CALM) as drone:
        drone.config["safety.zones"] = "cylinder 2 0 0.5 0 3"
        drone.takeoff()

        def go_on(step: Progress) -> None:
            told.append(step)
            if step.kind == "route.paused":
                flight.skip()
                flight.resume()

        flight = FlyRoute(drone, route, on_progress=go_on)
        assert [one.waypoint for one in flight.check().findings] == [2, 3]
        flight.run(seconds=60.0)
        assert flight.law.state == "done"
    paused = [step for step in told if step.kind == "route.paused"]
    assert [step.waypoint for step in paused] == [2]
    assert "a no-fly zone blocks the straight line" in paused[0].text


@pytest.mark.parametrize(
    ("fate", "told"), [(Fate.FAILSAFE, ENDED), (Fate.REFUSED, "position refused: a zone"), (Fate.REPLACED, TAKEN)]
)
def test_a_stall_of_this_program_is_reported_as_such(fate: Fate, told: str, monkeypatch: pytest.MonkeyPatch) -> None:
    with rehearse(CALM) as drone:
        flight = FlyRoute(drone, TRIANGLE)
        flight._leg = 7
        outcome = Outcome(1, 7, fate, Refusal.NOT_FRESH, "position refused: a zone")
        monkeypatch.setattr(drone._commands, "outcome", lambda intent: outcome if intent == 7 else None)
        assert [flight._why_ended(), flight._why_ended()] == [told, ""]


def test_a_hover_of_the_same_program_is_not_ended_by_the_next_leg() -> None:
    """It hovered through the rest of a wait at a waypoint, then continued unasked."""
    told: list[Progress] = []
    route = Route(waypoints=(RouteWaypoint(0.0, 0.0, 1.0, actions=(Wait(1.0),)), RouteWaypoint(3.0, 0.0, 1.0)))
    with rehearse(CALM) as drone:
        drone.takeoff()

        def stop(step: Progress) -> None:
            told.append(step)
            if step.kind == "route.waypoint_reached":
                drone.hover()

        flight = FlyRoute(drone, route, on_progress=stop)
        flight.run(seconds=10.0)
        assert flight.law.state == "paused"
        assert math.hypot(*(drone.feedback().position_m or ())[:2]) < 0.4
        assert not drone._commands.schedule.automatic, "the requested hover continues"
    assert told[-1].text == TAKEN


def test_it_is_paused_and_ended_from_another_thread() -> None:
    with rehearse(CALM) as drone:
        drone.takeoff()
        flight = FlyRoute(drone, TRIANGLE)

        def pause(step: Progress) -> None:
            flight.pause()

        flight._on_progress = pause
        flight.run(until=lambda: flight.law.state == "paused")
        assert drone.feedback().state.airborne
        flight._on_progress = None
        flight.end()
        flight.run(seconds=5.0)
        assert flight.law.state == "stopped"


def test_the_error_without_a_position_says_how_to_get_one() -> None:
    with rehearse(f"{CALM}&position=none") as drone:
        drone.takeoff()
        [finding] = check_for(drone, TRIANGLE).findings
        assert "position=none" in finding.reason
        with pytest.raises(UsageError, match="position=none"):
            FlyRoute(drone, TRIANGLE).run(seconds=1.0)


def test_photos_are_named_by_time_waypoint_and_camera(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with skyloop.connect("sim://?cameras=front&width=64&fps=20", access="observe") as drone:
        path = save_photo(drone, tmp_path / "new", TakePhoto(2, None))
        assert path.read_bytes()[:3] == b"\xff\xd8\xff"
        assert path.name.endswith("-waypoint2-front.jpg")
        monkeypatch.setattr("skyloop.control.route_law.datetime", Mock(now=Mock(return_value=datetime(2026, 1, 2))))
        names = {save_photo(drone, tmp_path / "new", TakePhoto(2, None)).name for _ in range(3)}
        assert len(names) == 3, "within one moment"
        assert all(name.startswith("20260102T000000.000-") for name in names)
        with pytest.raises(UnknownNameError, match="rear"):
            save_photo(drone, tmp_path, TakePhoto(1, "rear"))
        (tmp_path / "file").touch()
        with pytest.raises(UsageError, match="can't be created"):
            save_photo(drone, tmp_path / "file", TakePhoto(1, None))
