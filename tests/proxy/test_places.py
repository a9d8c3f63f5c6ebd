"""Targets: which can be flown to, how fast, and how the proxy handles commands to them."""

from __future__ import annotations

import itertools
import math
from typing import Any

import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from skyloop.clock import NS_PER_S
from skyloop.messages import (
    EventKind,
    Feedback,
    FlightState,
    Hover,
    Idle,
    Land,
    Position,
    Refusal,
    Severity,
    Velocity,
)
from skyloop.proxy.core.airspace import Airspace, AirspaceSettings, Limits, Verdict
from skyloop.zones import Box, Cylinder, Space
from tests.support.proxy_bench import ALL, App, Bench, write

NOW = 100 * NS_PER_S
LIMITS = Limits(climb=1.0, yaw_rate=1.5, speed=2.0, altitude=5.0)
BOXED = Space(None, Box((-4.0, -4.0, 0.0), (4.0, 4.0, 3.0)), (Cylinder(2.0, 0.0, 0.5, 0.0, 3.0),))
ROOM = Space(Box((-4.0, -4.0, 0.0), (4.0, 4.0, 9.0)))
ANYWHERE = Space()
SOFTWARE = ALL - {"position"}


def at(x: float, y: float, z: float, **more: Any) -> Feedback:
    known: dict[str, Any] = {"captured_ns": NOW, "position_m": (x, y, z), "yaw_rad": 0.0, "altitude_m": z}
    return Feedback(**(known | more))


START = at(0.0, 0.0, 1.0)


def within(limits: Limits, space: Space) -> Airspace:
    return Airspace(AirspaceSettings(limits, space))


def asked_newly(action: Position, limits: Limits, space: Space, feedback: Feedback | None) -> Verdict:
    return within(limits, space).judge(action, feedback, NOW, new=True)


def flown(verdict: Verdict) -> Position:
    assert isinstance(verdict.action, Position)
    return verdict.action


# Decisions -------------------------------------------------------------------------------------------------------


def test_both_speeds_are_filled_in() -> None:
    decided = asked_newly(Position(3.0, 0.0, 1.0, 0.5), LIMITS, ANYWHERE, START)
    assert decided.action == Position(3.0, 0.0, 1.0, 0.5, 2.0, 1.5)
    assert decided.clamps == ()
    slow = Position(3.0, 0.0, 1.0, None, 0.3, 0.2)
    assert asked_newly(slow, LIMITS, ANYWHERE, START).action == slow


@pytest.mark.parametrize(
    ("asked", "speed", "limit"),
    [
        (Position(3.0, 0.0, 1.0, speed=9.0), 2.0, "limits.speed"),
        (Position(0.0, 0.0, 4.0, speed=9.0), 1.0, "limits.climb"),
        (Position(3.0, 0.0, 4.0, speed=9.0), math.sqrt(2.0), "limits.climb"),
        (Position(0.01, 0.0, 1.0, speed=9.0), 1.0, "limits.climb"),
    ],
)
def test_the_speed_keeps_to_the_limits_across_and_upwards(asked: Position, speed: float, limit: str) -> None:
    airspace = within(LIMITS, ANYWHERE)
    decided = airspace.judge(asked, START, NOW, new=True)
    assert flown(decided).speed == pytest.approx(speed)
    (clamp,) = decided.clamps
    assert (clamp.limit, clamp.asked, clamp.applied) == (limit, 9.0, flown(decided).speed)
    assert airspace.judge(asked, START, NOW).clamps == (), "repeats are not reported again"


@pytest.mark.parametrize(
    ("asked", "feedback", "reason", "words"),
    [
        (Position(0.0, 0.0, 1.0, speed=-1.0), START, Refusal.OUT_OF_RANGE, "speed is -1"),
        (Position(1.0, 0.0, 1.0), None, Refusal.WRONG_STATE, "does not report its position"),
        (Position(1.0, 0.0, 1.0), at(0, 0, 1, position_m=None), Refusal.WRONG_STATE, "motion capture"),
        (Position(1.0, 0.0, 1.0), at(0, 0, 1, yaw_rad=None), Refusal.WRONG_STATE, "does not report its yaw"),
        (Position(1.0, 0.0, 1.0), at(0, 0, 1, captured_ns=NOW - 3 * NS_PER_S), Refusal.WRONG_STATE, "3.0 s old"),
        (Position(0.0, 0.0, 7.0), START, Refusal.OUT_OF_RANGE, "z is 7 m and must be at most 5.00 m"),
        (Position(0.0, 0.0, 6.0), at(0, 0, 1, altitude_m=2.0), Refusal.OUT_OF_RANGE, "at most 4.00 m"),
        (Position(5.0, 0.0, 1.0), START, Refusal.OUT_OF_RANGE, "outside the safety box, box -4 -4 0 4 4 3"),
        (Position(0.0, 0.0, 3.5), START, Refusal.OUT_OF_RANGE, "outside the safety box"),
        (Position(2.1, 0.1, 1.0), START, Refusal.OUT_OF_RANGE, "in a no-fly zone, cylinder 2 0 0.5 0 3"),
        (Position(3.5, 0.1, 1.0), START, Refusal.OUT_OF_RANGE, "blocks the straight line, cylinder 2 0 0.5 0 3"),
    ],
)
def test_refused_targets_and_their_reasons(
    asked: Position, feedback: Feedback | None, reason: Refusal, words: str
) -> None:
    decided = asked_newly(asked, LIMITS, BOXED, feedback)
    assert (decided.action, decided.refusal) == (None, reason)
    assert words in decided.why


@pytest.mark.parametrize(
    ("asked", "feedback", "words"),
    [
        (Position(50.0, 0.0, -3.0), START, "outside the room, box -4 -4 0 4 4 9 [m] (safety.room)"),
        (Position(0.0, 0.0, -0.2), START, "outside the room"),
        (Position(0.0, 0.0, 8.0), START, "must be at most 5.00 m"),
    ],
)
def test_a_known_room_is_never_left(asked: Position, feedback: Feedback, words: str) -> None:
    airspace = within(LIMITS, ROOM)
    for new in (True, False):
        decided = airspace.judge(asked, feedback, NOW, new=new)
        assert (decided.action, decided.refusal) == (None, Refusal.OUT_OF_RANGE)
        assert words in decided.why


def test_no_target_below_the_ground_is_flown_to() -> None:
    into = asked_newly(Position(2.0, 0.0, -3.0), LIMITS, ANYWHERE, START)
    assert (into.action, into.refusal) == (None, Refusal.OUT_OF_RANGE)
    assert "z is -3 m, which is 3.00 m below the ground under the vehicle" in into.why
    hill = at(0.0, 0.0, -4.0, altitude_m=2.0)  # it took off from higher ground
    assert asked_newly(Position(2.0, 0.0, -5.0), LIMITS, ANYWHERE, hill).action is not None
    assert asked_newly(Position(2.0, 0.0, -7.0), LIMITS, ANYWHERE, hill).action is None
    unknown = at(0.0, 0.0, 1.0, altitude_m=None)
    assert asked_newly(Position(2.0, 0.0, -3.0), LIMITS, ANYWHERE, unknown).action is not None


def test_a_fresh_position_is_awaited_for_a_moment() -> None:
    old = at(0, 0, 1, captured_ns=NOW - NS_PER_S)
    for new in (True, False):
        assert within(LIMITS, BOXED).judge(Position(1.0, 0.0, 1.0), old, NOW, new=new) == Verdict()


def test_repeats_follow_a_lower_ceiling_and_drift_past_a_zone_is_not_refused() -> None:
    airspace, high = within(LIMITS, ANYWHERE), Position(0.0, 0.0, 4.0)
    assert flown(airspace.judge(high, START, NOW, new=True)).z == 4.0
    airspace.settings = AirspaceSettings(Limits(altitude=3.0))
    decided = airspace.judge(high, START, NOW)
    assert flown(decided).z == pytest.approx(3.0)
    assert [clamp.limit for clamp in decided.clamps] == ["limits.altitude"]
    airspace, past = within(LIMITS, BOXED), Position(3.5, 0.1, 1.0)
    assert airspace.judge(past, at(0.0, 3.0, 1.0), NOW, new=True).action is not None
    assert airspace.judge(past, START, NOW).action is not None
    inside = Position(2.1, 0.1, 1.0)
    assert airspace.judge(inside, START, NOW).refusal is Refusal.OUT_OF_RANGE


REFUSED = [
    (Position(3.5, 0.1, 1.0), "zone blocks the straight line"),
    (Position(0.0, 0.0, 6.0), "must be at most 5.00 m"),
    (Position(-2.0, 0.0, -3.0), "3.00 m below the ground"),
]


@pytest.mark.parametrize(("asked", "words"), REFUSED, ids=["behind a zone", "too high", "below the ground"])
def test_a_refused_target_stays_refused_when_repeated(asked: Position, words: str) -> None:
    """A refused target was flown to by its repeats."""
    airspace = within(LIMITS, Space(zones=BOXED.zones))
    for new in (True, False, False):
        decided = airspace.judge(asked, START, NOW, new=new)
        assert (decided.action, decided.refusal) == (None, Refusal.OUT_OF_RANGE)
        assert words in decided.why


def test_a_zone_drawn_across_the_path_ends_the_flight() -> None:
    airspace, far = within(LIMITS, ANYWHERE), Position(3.5, 0.1, 1.0)
    assert airspace.judge(far, START, NOW, new=True).action is not None
    airspace.settings = AirspaceSettings(LIMITS, BOXED)
    assert airspace.judge(far, START, NOW).refusal is Refusal.OUT_OF_RANGE
    assert airspace.judge(far, START, NOW).refusal is Refusal.OUT_OF_RANGE


def test_a_command_in_between_ends_the_flight() -> None:
    airspace, past = within(LIMITS, BOXED), Position(3.5, 0.1, 1.0)
    assert airspace.judge(past, at(0.0, 3.0, 1.0), NOW, new=True).action is not None
    assert airspace.judge(Velocity(left=-1.0), START, NOW).action is not None
    assert airspace.judge(past, START, NOW).refusal is Refusal.OUT_OF_RANGE


def test_a_zone_around_the_vehicle_can_be_left() -> None:
    decided = asked_newly(Position(0.0, 0.0, 1.0), LIMITS, BOXED, at(2.1, 0.0, 1.0))
    assert decided.action is not None


COORDINATE = st.floats(-6.0, 6.0)
PLACE = st.tuples(COORDINATE, COORDINATE, COORDINATE)


@given(PLACE, PLACE, st.sampled_from([Box((-1.0, -2.0, 0.5), (2.0, 1.0, 2.0)), Cylinder(0.5, -0.5, 1.5, 0.0, 2.0)]))
def test_a_zone_blocks_a_line_if_it_contains_a_point_of_it(
    start: tuple[float, float, float], end: tuple[float, float, float], zone: Box | Cylinder
) -> None:
    shares = [step / 200 for step in range(201)]
    places = [tuple(a + share * (b - a) for a, b in zip(start, end, strict=True)) for share in shares]
    if any(zone.holds((x, y, z)) for x, y, z in places):
        assert zone.is_in_the_way(start, end)
    elif zone.is_in_the_way(start, end):  # it is only touched, between two of the sampled positions
        step = math.dist(start, end) / 200
        assert min(abs(zone.wall_outside((x, y, z)).distance) for x, y, z in places) <= step + 1e-9


@given(PLACE, PLACE, st.floats(0.1, 20.0))
def test_flown_speeds_stay_within_each_limit(
    start: tuple[float, float, float], end: tuple[float, float, float], speed: float
) -> None:
    assume(math.dist(start, end) > 0.1 and end[2] >= 0.0)
    limits = Limits(climb=0.7, speed=1.3, altitude=100.0)
    action = flown(asked_newly(Position(*end, speed=speed), limits, ANYWHERE, at(*start)))
    assert action.speed is not None
    away = math.dist(start, end)
    assert action.speed <= speed
    assert action.speed * math.dist(start[:2], end[:2]) / away <= 1.3 + 1e-9
    assert action.speed * abs(end[2] - start[2]) / away <= 0.7 + 1e-9


# In the proxy ----------------------------------------------------------------------------------------------------


def placed(bench: Bench, **more: Any) -> App:
    """Return a pilot whose vehicle hovers 1 m above the origin."""
    pilot = bench.airborne()
    bench.driver.report(position_m=(0.0, 0.0, 1.0), yaw_rad=0.0, altitude_m=1.0, **more)
    bench.driver.told.clear()
    return pilot


def test_a_vehicle_with_native_positions_gets_the_target_with_its_limits() -> None:
    with Bench() as bench:
        pilot = placed(bench)
        pilot.command(Position(3.0, 0.0, 1.0, 0.5))
        told = Position(3.0, 0.0, 1.0, 0.5, 2.0, 1.75)
        assert bench.driver.told == [told]
        assert pilot.applied[-1].applied == told
        assert pilot.applied[-1].asked == Position(3.0, 0.0, 1.0, 0.5)
        bench.run(0.1)
        assert bench.driver.told == [told], "it flies there itself"


def test_other_vehicles_are_flown_there_by_velocity() -> None:
    with Bench(SOFTWARE) as bench:
        pilot = placed(bench)
        pilot.command(Position(3.0, 0.0, 1.0))
        bench.run(0.1, lambda: bench.driver.report())
        assert set(map(type, bench.driver.told)) == {Velocity}
        (told,) = {action for action in bench.driver.told if isinstance(action, Velocity)}
        assert (told.forward, told.left, told.up) == pytest.approx((math.sqrt(2 * 0.6 * 3.0), 0.0, 0.0))
        pilot.command(Hover())
        bench.driver.told.clear()
        bench.run(0.1)
        assert bench.driver.told == [], "hovering ends it"


def test_a_vehicle_without_a_position_is_refused_with_the_reason() -> None:
    with Bench(SOFTWARE) as bench:
        pilot = bench.airborne()
        pilot.command(Position(3.0, 0.0, 1.0))
        (event,) = pilot.told(EventKind.COMMAND_REFUSED)
        assert event.data["reason"] == Refusal.WRONG_STATE
        assert "the vehicle does not report its position" in event.text
        assert bench.driver.told == [Hover()]


def test_a_refused_target_ends_the_previous_set_point() -> None:
    with Bench() as bench:
        pilot = placed(bench)
        write(bench, pilot, "safety.box.x_high", 2.0)
        pilot.command(Velocity(forward=0.5))
        pilot.command(Position(3.0, 0.0, 1.0))
        assert isinstance(bench.driver.told[-1], Hover)
        (event,) = pilot.told(EventKind.COMMAND_REFUSED)
        assert event.data["reason"] == Refusal.OUT_OF_RANGE
        assert "safety.box" in event.text


@pytest.mark.parametrize("actions", [ALL, SOFTWARE], ids=["native", "software"])
@pytest.mark.parametrize(("asked", "words"), REFUSED, ids=["behind a zone", "too high", "below the ground"])
def test_a_refused_target_is_not_flown_to_by_its_repeats(actions: frozenset[str], asked: Position, words: str) -> None:
    """``go_to(wait=False)`` to a refused target: its repeats brought the vehicle there, or to the floor."""
    with Bench(actions) as bench:
        pilot = placed(bench)
        if "zone" in words or "way" in words:
            write(bench, pilot, "safety.zones", "cylinder 2 0 0.5 0 3")
        pilot.command(asked)
        for _ in range(10):
            bench.run(0.03, bench.driver.report)
            pilot.command(asked, repeat=True)
        bench.run(0.1, bench.driver.report)
        assert {type(action) for action in bench.driver.told if action != Velocity()} <= {Hover}
        assert words in pilot.told(EventKind.COMMAND_REFUSED)[0].text


@pytest.mark.parametrize(("asked", "words"), REFUSED[1:], ids=["too high", "below the ground"])
def test_a_target_is_judged_while_the_vehicle_takes_off(asked: Position, words: str) -> None:
    """A ``go_to`` during a take-off was held, then flown to by its repeats without any judgement."""
    with Bench() as bench:
        pilot = placed(bench, state=FlightState.TAKING_OFF)
        pilot.command(asked)
        assert words in pilot.told(EventKind.COMMAND_REFUSED)[0].text
        assert bench.driver.told == [], "the take-off continues"
        bench.driver.report(state=FlightState.FLYING)
        pilot.command(asked, repeat=True)
        assert Position not in map(type, bench.driver.told)


def test_a_valid_target_waits_for_the_end_of_the_take_off() -> None:
    with Bench() as bench:
        pilot = placed(bench, state=FlightState.TAKING_OFF)
        pilot.command(Position(2.0, 0.0, 1.0))
        assert pilot.refusals() == []
        bench.driver.report(state=FlightState.FLYING)
        pilot.command(Position(2.0, 0.0, 1.0), repeat=True)
        assert isinstance(bench.driver.told[-1], Position)


def test_a_lost_position_stops_a_vehicle_that_flies_there_itself() -> None:
    with Bench() as bench:
        pilot = placed(bench)
        pilot.command(Position(3.0, 0.0, 1.0))
        bench.driver.report(position_m=None)
        pilot.command(Position(3.0, 0.0, 1.0), repeat=True)
        assert bench.driver.told[-1] == Hover()
        assert pilot.refusals() == [Refusal.WRONG_STATE]


@pytest.mark.parametrize("actions", [ALL, SOFTWARE], ids=["native", "software"])
def test_a_vehicle_that_is_silent_for_a_moment_stops_and_then_continues(actions: frozenset[str]) -> None:
    with Bench(actions) as bench:
        pilot = placed(bench)
        pilot.command(Position(3.0, 0.0, 1.0))
        bench.clock.advance(0.6)
        pilot.command(Position(3.0, 0.0, 1.0), repeat=True)
        bench.driver.report()
        pilot.command(Position(3.0, 0.0, 1.0), repeat=True)
        bench.tick()
        flies = Position if actions is ALL else Velocity
        assert [type(action) for action in bench.driver.told][-2:] == [Hover, flies]
        assert pilot.refusals() == []


def test_with_walls_the_proxy_checks_each_step_of_the_path() -> None:
    with Bench() as bench:
        pilot = placed(bench)
        write(bench, pilot, "safety.box.x_high", 3.0)
        pilot.command(Position(2.9, 0.0, 1.0))
        assert Position not in map(type, bench.driver.told)
        bench.move((2.5, 0.0, 1.0), velocity_m_s=(2.0, 0.0, 0.0))
        told = bench.driver.told[-1]
        assert isinstance(told, Velocity)
        assert told.forward < 0.2, "as slow as any velocity this near to the wall: the path alone allows 0.36 m/s"
        write(bench, pilot, "safety.box.x_high", 2.7)
        pilot.command(Position(2.9, 0.0, 1.0), repeat=True)
        assert bench.driver.told[-1] == Hover(), "the target is outside by now"
        assert pilot.refusals() == [Refusal.OUT_OF_RANGE]


@pytest.mark.parametrize("actions", [ALL, SOFTWARE], ids=["native", "software"])
def test_a_position_jump_is_reported_and_the_vehicle_hovers(actions: frozenset[str]) -> None:
    """A reset of an autopilot's estimate, or motion capture that confuses two drones, went unnoticed."""
    with Bench(actions) as bench:
        pilot = placed(bench)
        bench.move((0.5, 0.0, 1.0))
        pilot.command(Position(5.0, 0.0, 1.0))
        bench.move((1.5, 0.0, 1.0))
        assert pilot.told(EventKind.VEHICLE_MESSAGE) == []
        bench.driver.told.clear()
        bench.driver.report(position_m=(1.5, 3.0, 1.0))
        bench.tick()
        (event,) = pilot.told(EventKind.VEHICLE_MESSAGE)
        assert (event.severity, event.data["reason"]) == (Severity.WARNING, "position_jumped")
        assert event.data["jumped_m"] == pytest.approx(3.0)
        assert bench.driver.told == [Hover()]
        bench.run(0.2, lambda: pilot.command(Position(5.0, 0.0, 1.0), repeat=True))
        assert bench.driver.told == [Hover()], "it does not continue unasked"
        assert set(pilot.refusals()) == {Refusal.NOT_FRESH}
        pilot.command(Position(5.0, 0.0, 1.0))
        assert pilot.applied[-1].applied != Idle(), "a new one is flown"


def test_a_position_that_jumps_back_and_forth_is_reported_once_a_second() -> None:
    """Two drones that motion capture confused made 99 events in 2 s."""
    with Bench() as bench:
        bench.airborne()
        places = itertools.cycle([(0.0, 0.0, 1.0), (5.0, 0.0, 1.0)])
        bench.run(2.0, lambda: bench.driver.report(position_m=next(places)))
        told = [event for event in bench.published(EventKind.VEHICLE_MESSAGE) if "jumped_m" in event.data]
        assert 1 <= len(told) <= 3
        assert told[0].data["count"] == 1


def test_a_landing_that_does_not_show_yet_is_not_aborted_by_a_position_jump() -> None:
    """The landing had to be repeated after each jump."""
    with Bench() as bench:
        pilot = bench.airborne()
        bench.driver.report(position_m=(0.0, 0.0, 1.0))
        bench.tick()
        bench.driver.answers = False
        pilot.command(Land())
        for x in (3.0, 6.0):
            bench.clock.advance(0.1)
            bench.driver.report(position_m=(x, 0.0, 1.0))
            bench.tick()
        pilot.command(Land(), repeat=True)
        assert len(bench.published(EventKind.VEHICLE_MESSAGE)) == 1, "the others follow as a sum"
        assert bench.driver.told == [Land(), Land()]


def test_a_carried_or_long_unseen_vehicle_does_not_jump() -> None:
    with Bench() as bench:
        pilot = bench.pilot()
        bench.driver.report(position_m=(0.0, 0.0, 0.0), yaw_rad=0.0)
        bench.tick()
        bench.driver.report(position_m=(4.0, 0.0, 0.0))
        bench.tick()
        bench.take_off(pilot)
        bench.driver.report(position_m=None)
        bench.run(1.5, lambda: pilot.command(Hover(), repeat=True))
        bench.driver.report(position_m=(8.0, 0.0, 0.0))
        bench.tick()
        assert pilot.told(EventKind.VEHICLE_MESSAGE) == []


def test_walls_added_during_the_flight_take_over_from_the_vehicle() -> None:
    with Bench() as bench:
        pilot = placed(bench)
        pilot.command(Position(3.0, 0.0, 1.0))
        write(bench, pilot, "safety.zones", "box 10 10 0 11 11 3")
        pilot.command(Position(3.0, 0.0, 1.0), repeat=True)
        bench.tick()
        assert [type(action) for action in bench.driver.told] == [Position, Velocity]


@pytest.mark.parametrize("actions", [ALL, SOFTWARE], ids=["native", "software"])
def test_a_silent_pilot_on_the_way_gets_the_failsafe(actions: frozenset[str]) -> None:
    with Bench(actions) as bench:
        pilot = placed(bench)
        pilot.command(Position(100.0, 0.0, 1.0))
        bench.run(3.0, lambda: bench.driver.report())
        assert Hover() in bench.driver.told
        after = bench.driver.told[bench.driver.told.index(Hover()) :]
        assert not {Position, Velocity} & set(map(type, after)), "nothing flies on"


@pytest.mark.parametrize("state", [FlightState.LANDED, FlightState.EMERGENCY])
def test_a_target_is_refused_on_the_ground(state: FlightState) -> None:
    with Bench(SOFTWARE) as bench:
        pilot = placed(bench, state=state)
        pilot.command(Position(0.0, 0.0, 2.0))
        assert pilot.refusals() == [Refusal.WRONG_STATE]
        bench.tick()
        assert bench.driver.told == []


@pytest.mark.parametrize("wrong", [Position(math.nan, 0.0, 1.0), Position(0.0, 0.0, 1.0, math.inf)])
def test_invalid_numbers_are_refused(wrong: Position) -> None:
    with Bench() as bench:
        pilot = placed(bench)
        pilot.command(wrong)
        assert pilot.refusals() == [Refusal.NON_FINITE]
        assert bench.driver.told == []


def test_applications_learn_the_proxys_software_actions() -> None:
    with Bench(SOFTWARE) as bench:
        welcome = bench.stranger().hello("somebody")
        assert welcome.capabilities.software == {"position"}
