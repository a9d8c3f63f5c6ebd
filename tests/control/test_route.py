"""Routes: the file, the checks, and the course of a flight as a state machine."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from skyloop.clock import NS_PER_S
from skyloop.control.route import (
    Conditions,
    Look,
    Photo,
    Route,
    RouteWaypoint,
    Wait,
    check_route,
    checked,
    conditions_of,
    load_route,
    parse_route,
    save_route,
)
from skyloop.control.route_law import Effect, Progress, RouteCommand, RouteLaw, RouteState, TakePhoto
from skyloop.errors import FileFormatError, UsageError
from skyloop.messages import Feedback, FlightState, Hover, Land, Position, Value
from skyloop.zones import Box, Cylinder, Space

TOUR = Route(
    name="tour",
    waypoints=(
        RouteWaypoint(1.0, 0.0, 1.0, look_at=(1.0, 5.0), actions=(Wait(2.0), Photo())),
        RouteWaypoint(1.0, 1.0, 1.5, speed=0.3, yaw=0.5, actions=(Look(yaw=-1.0), Look(at=(0.0, 1.0)))),
        RouteWaypoint(0.0, 1.0, 1.0),
    ),
)


# The file --------------------------------------------------------------------------------------------------------


def test_a_saved_route_is_loaded_again(tmp_path: Path) -> None:
    path = tmp_path / "tour.route.json"
    save_route(TOUR, path)
    assert load_route(path) == TOUR
    assert json.loads(path.read_text())["version"] == 1


numbers = st.floats(-100, 100)
actions = st.one_of(
    st.builds(Wait, st.floats(0, 60)), st.just(Photo()), st.builds(Look, at=st.tuples(numbers, numbers))
)
waypoints = st.builds(
    RouteWaypoint, numbers, numbers, numbers, st.none() | st.floats(0.1, 5.0), actions=st.tuples(actions)
)


@given(st.lists(waypoints, min_size=1, max_size=5), st.sampled_from(["hover", "land", "return"]))
def test_every_route_survives_its_file(places: list[RouteWaypoint], end: Any) -> None:
    route = Route(waypoints=tuple(places), end=end)
    assert parse_route(route.to_json()) == route


ONE = '{"x": 1, "y": 2, "z": 1}'


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "not a route"),
        ("[]", "Expected `object`"),
        ('{"waypoints": []}', "length >= 1"),
        ('{"waypoints": [{"x": 1, "y": 2}]}', r"missing required field `z` - at `\$.waypoints\[0\]`"),
        ('{"waypoints": [{"x": 1, "y": 2, "z": NaN}]}', "malformed"),
        ('{"waypoints": [{"x": 1, "y": 2, "z": 1e999}]}', r"out of range|<= 10000"),
        ('{"waypoints": [{"x": 1, "y": 2, "z": 20000}]}', r"<= 10000.*at `\$.waypoints\[0\].z`"),
        ('{"waypoints": [{"x": 1, "y": 2, "z": 1, "speed": 0}]}', r">= 0.05.*at `\$.waypoints\[0\].speed`"),
        ('{"waypoints": [{"x": 1, "y": 2, "z": 1, "hight": 3}]}', "unknown field `hight`"),
        ('{"waypoints": [{"x": 1, "y": 2, "z": 1, "yaw": 1, "look_at": [0, 0]}]}', "not both"),
        ('{"waypoints": [{"x": 1, "y": 2, "z": 1, "actions": [{"do": "dance"}]}]}', "dance"),
        ('{"waypoints": [{"x": 1, "y": 2, "z": 1, "actions": [{"do": "look"}]}]}', "one of yaw and at"),
        ('{"waypoints": [{"x": 1, "y": 2, "z": 1, "actions": [{"do": "wait", "seconds": 1e6}]}]}', "<= 3600"),
        (f'{{"version": 2, "waypoints": [{ONE}]}}', "version"),
        (f'{{"end": "crash", "waypoints": [{ONE}]}}', "crash"),
        (f'{{"waypoints": [{",".join([ONE] * 201)}]}}', "length <= 200"),
    ],
)
def test_invalid_routes_are_refused_with_the_place(text: str, words: str, tmp_path: Path) -> None:
    path = tmp_path / "bad.route.json"
    path.write_text(text)
    with pytest.raises(UsageError, match=f"bad.route.json.*({words})"):
        load_route(path)


def test_a_missing_or_too_large_file_is_refused(tmp_path: Path) -> None:
    with pytest.raises(FileFormatError, match="can't be read"):
        load_route(tmp_path / "none.route.json")
    (tmp_path / "big").write_bytes(b" " * 100_000)
    with pytest.raises(FileFormatError, match="larger"):
        load_route(tmp_path / "big")


def test_numbers_of_a_program_are_checked_too() -> None:
    with pytest.raises(UsageError, match="x is nan and must be finite"):
        RouteWaypoint(math.nan, 0.0, 1.0)
    with pytest.raises(UsageError, match=r"<= 10000"):
        checked(Route(waypoints=(RouteWaypoint(1e6, 0.0, 1.0),)))
    with pytest.raises(UsageError, match="at least one waypoint"):
        Route(waypoints=())


# The check -------------------------------------------------------------------------------------------------------

ROOM = Space(Box((-4.0, -3.0, 0.0), (4.0, 3.0, 3.0)), None, (Cylinder(2.0, 0.0, 0.5, 0.0, 3.0),))
HERE = Conditions(ROOM, (0.0, 0.0, 1.0), "", 0.0, 1.0)


def places(*points: tuple[float, float, float], **more: Any) -> Route:
    return Route(waypoints=tuple(RouteWaypoint(*point) for point in points), **more)


@pytest.mark.parametrize(
    ("route", "conditions", "found"),
    [
        (places((1, 1, 1)), HERE, []),
        (places((1, 1, 1), (50, 0, -3)), HERE, [(2, "outside the room")]),
        (places((0, 2, 1), (3.5, 0, 1)), HERE, []),
        (places((0.1, 0, 1), (3.5, 0, 1)), HERE, [(2, "blocks the straight line, cylinder 2 0 0.5 0 3")]),
        (places((2, 0.1, 1)), HERE, [(1, "in a no-fly zone")]),
        (places((3.5, 0, 1)), HERE, [(1, "blocks the straight line")]),
        (places((1, 0, -0.5)), Conditions(start=(0, 0, 1), ground_m=0.0, battery=1.0), [(1, "below the ground")]),
        (places((1, 0, 6)), Conditions(start=(0, 0, 1), ground_m=0.0, battery=1.0), [(1, "at most 5.00 m")]),
        (places((1, 1, 1), speed=3.0), HERE, [(1, "flown at 2 m/s")]),
        (places((1, 1, 1)), Conditions(problem="no position", battery=1.0), [(None, "no position")]),
        (places((1, 1, 1)), Conditions(start=(0, 0, 1)), [(None, "is unknown")]),
        (places((3, 2, 1), (-3, 2, 1), speed=0.1), Conditions(start=(0, 0, 1), battery=0.2), [(None, "battery falls")]),
        (places((1, 1, 1)), Conditions(start=(0, 0, 1), battery=0.2), [(None, "at about 19%, below 20%")]),
        (places((1, 2, 1), (3.5, 0, 1), end="return"), HERE, [(2, "on the way back, a no-fly zone")]),
    ],
)
def test_findings_of_a_check(route: Route, conditions: Conditions, found: list[tuple[int | None, str]]) -> None:
    check = check_route(route, conditions)
    assert [one.waypoint for one in check.findings] == [number for number, _ in found]
    for one, (_, words) in zip(check.findings, found, strict=True):
        assert words in one.reason


def test_the_estimate_has_legs_actions_and_the_landing() -> None:
    route = Route(
        waypoints=(RouteWaypoint(2.0, 0.0, 1.0, actions=(Wait(10.0), Photo(), Look(yaw=0.0))),), speed=0.5, end="land"
    )
    check = check_route(route, Conditions(start=(0.0, 0.0, 1.0), ground_m=0.0, battery=1.0, flight_time_s=100.0))
    assert check.length_m == 2.0
    assert check.seconds == pytest.approx(2.0 / 0.5 + 1.0 + 10.0 + 1.0 + 3.0 + 1.0 / 0.4)
    assert check.battery_left == pytest.approx(1.0 - check.seconds / 100.0)
    assert check.ok


def test_the_conditions_come_from_feedback_and_parameters() -> None:
    parameters: dict[str, Value] = {
        "limits.speed": 1.5,
        "safety.zones": "cylinder 0 0 1 0 2",
        "safety.room": "box -1 -1 0 1 1 2",
    }
    standing = Feedback(
        captured_ns=0, state=FlightState.LANDED, position_m=(1, 2, 0.1), yaw_rad=0.0, altitude_m=0.1, battery=0.5
    )
    c = conditions_of(standing, {**parameters, "autopilot.takeoff_altitude": 1.2})
    assert (c.start, c.ground_m, c.battery, c.speed_m_s) == ((1, 2, 1.3), 0.0, 0.5, 1.5)
    assert c.space == Space(Box((-1, -1, 0), (1, 1, 2)), None, (Cylinder(0, 0, 1, 0, 2),))
    blind = conditions_of(Feedback(captured_ns=0, yaw_rad=0.0), {})
    assert "position=none" in blind.problem
    assert conditions_of(None, {}).problem


# The course ------------------------------------------------------------------------------------------------------


def at(x: float, y: float, z: float, yaw: float = 0.0, **more: Any) -> Feedback:
    known: dict[str, Any] = {
        "captured_ns": 0,
        "state": FlightState.HOVERING,
        "position_m": (x, y, z),
        "yaw_rad": yaw,
        "velocity_m_s": (0.0, 0.0, 0.0),
    }
    return Feedback(**(known | more))


def actions_of(effects: list[Effect]) -> list[object]:
    return [effect.action for effect in effects if isinstance(effect, RouteCommand)]


def kinds(effects: list[Effect]) -> list[str]:
    return [effect.kind.removeprefix("route.") for effect in effects if isinstance(effect, Progress)]


def test_a_whole_flight() -> None:
    law = RouteLaw(TOUR)
    north = math.pi / 2
    assert actions_of(law.start(at(0, 0, 1))) == [Position(1.0, 0.0, 1.0, north, 0.5)]
    assert law.update(at(0.5, 0, 1), NS_PER_S) == []
    assert kinds(law.update(at(1, 0, 1, north), 4 * NS_PER_S)) == ["waypoint_reached"]
    assert law.update(at(1, 0, 1, north), 5 * NS_PER_S) == [], "it waits"
    assert law.update(at(1, 0, 1, north), 6 * NS_PER_S) == [TakePhoto(1, None)]
    assert law.update(at(1, 0, 1, north), 7 * NS_PER_S) == []
    law.photo_done()
    after = law.update(at(1, 0, 1, north), 8 * NS_PER_S)
    assert (kinds(after), actions_of(after)) == (["photo"], [Position(1.0, 1.0, 1.5, 0.5, 0.3)])
    turned = law.update(at(1, 1, 1.5, 0.5), 12 * NS_PER_S)
    assert actions_of(turned) == [Position(1.0, 1.0, 1.5, -1.0, 0.3)]
    assert actions_of(law.update(at(1, 1, 1.5, -1.0), 14 * NS_PER_S)) == [Position(1.0, 1.0, 1.5, math.pi, 0.3)]
    late = law.update(at(1, 1, 1.5, -1.0), 30 * NS_PER_S)
    assert (kinds(late), actions_of(late)) == (["look"], [Position(0.0, 1.0, 1.0, None, 0.5)]), "the turn timed out"
    done = law.update(at(0, 1, 1), 40 * NS_PER_S)
    assert (kinds(done), actions_of(done)) == (["waypoint_reached", "done"], [Hover()])
    assert law.over
    assert law.update(at(0, 1, 1), 41 * NS_PER_S) == law.pause() == law.resume() == law.skip() == law.stop() == []


def test_pause_resume_skip_and_stop() -> None:
    law = RouteLaw(TOUR)
    law.start(at(0, 0, 1))
    assert actions_of(law.pause()) == [Hover()]
    assert law.update(at(1, 0, 1, math.pi / 2), NS_PER_S) == [], "nothing moves while it is paused"
    assert actions_of(law.skip()) == []
    assert (law.state, law.index) == (RouteState.PAUSED, 1)
    assert actions_of(law.resume()) == [Position(1.0, 1.0, 1.5, 0.5, 0.3)]
    assert actions_of(law.skip()) == [Position(0.0, 1.0, 1.0, None, 0.5)]
    assert actions_of(law.stop()) == [Hover()]
    assert law.state is RouteState.STOPPED


@pytest.mark.parametrize(("end", "last"), [("land", Land()), ("hover", Hover()), ("return", Land())])
def test_a_paused_route_whose_last_waypoint_is_skipped_stays_paused(end: Any, last: Any) -> None:
    """It landed although a person had paused it."""
    law = RouteLaw(places((1, 0, 1), end=end))
    law.start(at(0, 0, 1))
    law.pause()
    left_out = [effect for _ in range(3) for effect in law.skip()]
    assert actions_of(left_out) == []
    assert kinds(left_out) == ["skipped"] * (2 if end == "return" else 1)
    assert law.state is RouteState.PAUSED
    assert law.update(at(1, 0, 1), NS_PER_S) == []
    on = law.resume()
    assert (kinds(on), actions_of(on), law.state) == (["resumed", "done"], [last], RouteState.DONE)


def test_actions_continue_after_a_pause_and_are_not_reported_twice() -> None:
    law = RouteLaw(TOUR)
    law.start(at(0, 0, 1))
    there = at(1, 0, 1, math.pi / 2)
    law.update(there, 0)
    law.update(there, 2 * NS_PER_S)  # waited: the photo is wanted
    law.pause("somebody is in the way")
    assert law.problem == "somebody is in the way"
    assert actions_of(law.resume()) == [Position(1.0, 0.0, 1.0, math.pi / 2, 0.5)]
    assert law.update(there, 9 * NS_PER_S) == [TakePhoto(1, None)], "it has already waited"
    assert kinds(law.update(there, 15 * NS_PER_S)) == ["photo"], "it does not wait for a frame forever"


def test_a_leg_that_takes_too_long_pauses_it() -> None:
    law = RouteLaw(TOUR)
    law.start(at(0, 0, 1))
    law.update(at(0.1, 0, 1), 0)
    assert law.update(at(0.1, 0, 1), 20 * NS_PER_S) == []
    assert kinds(law.update(at(0.1, 0, 1), 60 * NS_PER_S)) == ["paused"]
    assert "waypoint 1 of 3 was not reached in time" in law.problem


def test_the_way_back_starts_at_the_last_waypoint_and_ends_on_the_ground() -> None:
    law = RouteLaw(places((1, 0, 2), end="return"))
    law.start(at(0, 0, 1))
    assert actions_of(law.update(at(1, 0, 2), 0)) == [Position(0.0, 0.0, 2.0, None, 0.5)]
    assert actions_of(law.update(at(0, 0, 2), NS_PER_S)) == [Land()]
    assert law.state is RouteState.DONE


@pytest.mark.parametrize(
    ("feedback", "words"),
    [
        (at(0, 0, 0, state=FlightState.LANDED), "take off first"),
        (at(0, 0, 0, position_m=None), "position=none"),
        (at(0, 0, 0, yaw_rad=None), "its yaw"),
    ],
)
def test_it_starts_in_the_air_with_a_position(feedback: Feedback, words: str) -> None:
    law = RouteLaw(TOUR)
    with pytest.raises(UsageError, match=words):
        law.start(feedback)
    assert law.state is RouteState.READY


def test_a_landing_ends_it_and_without_a_position_it_waits() -> None:
    law = RouteLaw(TOUR)
    law.start(at(0, 0, 1))
    assert law.update(at(0, 0, 1, position_m=None), NS_PER_S) == []
    assert kinds(law.update(at(0, 0, 0, state=FlightState.LANDED), 2 * NS_PER_S)) == ["stopped"]


@given(st.lists(st.sampled_from(["pause", "resume", "skip", "stop", "there", "away", "photo"]), max_size=40))
def test_nothing_is_commanded_while_paused_or_over(happens: list[str]) -> None:
    law = RouteLaw(TOUR)
    law.start(at(0, 0, 1))
    for second, what in enumerate(happens):
        before = law.state
        if what == "photo":
            law.photo_done()
            continue
        goal = law._goals[law.index].goal
        there = at(goal.x, goal.y, goal.z, goal.yaw or 0.0) if what == "there" else at(9, 9, 9)
        effects = law.update(there, second * NS_PER_S) if what in ("there", "away") else getattr(law, what)()
        if before in (RouteState.PAUSED, RouteState.DONE, RouteState.STOPPED) and what != "resume":
            assert actions_of(effects) == [] or law.state is RouteState.DONE
        assert 0 <= law.index < len(law._goals)
