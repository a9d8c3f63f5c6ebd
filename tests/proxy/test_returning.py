"""The start, the flight back there, and what ends it: pilots, low batteries, lost pilots."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest

from skyloop.clock import NS_PER_S
from skyloop.messages import (
    EmergencyStop,
    EventKind,
    Failsafe,
    Feedback,
    FlightState,
    Hover,
    Land,
    LinkState,
    Position,
    Refusal,
    ReleaseAuthority,
    ReturnPhase,
    ReturnToStart,
    SetParameter,
    Takeoff,
    Value,
    Velocity,
)
from skyloop.proxy.core.airspace import Airspace, AirspaceSettings, Limits
from skyloop.proxy.core.autopilot import ReturnDecision, ReturnFlight, ReturnSettings, StartPoint
from skyloop.zones import Box, Cylinder, Space
from tests.support.proxy_bench import ALL, App, Bench

NOW = 100 * NS_PER_S
S = NS_PER_S
LIMITS = Limits()
ANYWHERE = Space()
HOME = (0.0, 0.0, 0.1)
SETTINGS = ReturnSettings()


def at(x: float, y: float, z: float, now_ns: int = NOW, **more: Any) -> Feedback:
    known: dict[str, Any] = {"position_m": (x, y, z), "yaw_rad": 0.0, "altitude_m": z, "velocity_m_s": (0.0, 0.0, 0.0)}
    return Feedback(captured_ns=now_ns, **(known | more))


def flight(
    action: ReturnToStart | None = None,
    start: tuple[float, float, float] | None = HOME,
    settings: ReturnSettings = SETTINGS,
) -> ReturnFlight:
    return ReturnFlight(action or ReturnToStart(), start, settings)


def within(limits: Limits, space: Space) -> Airspace:
    return Airspace(AirspaceSettings(limits, space))


def place(decision: ReturnDecision) -> tuple[float, float, float]:
    assert isinstance(decision.action, Position), decision
    return decision.action.place


# Where the start is ----------------------------------------------------------------------------------------------


def observed(*seen: tuple[float, FlightState, Feedback | None]) -> StartPoint:
    start = StartPoint()
    for at_s, state, feedback in seen:
        start.observe(state, feedback, NOW + round(at_s * S))
    return start


GROUND = at(1.0, 2.0, 0.1)


def test_the_start_is_where_it_took_off() -> None:
    start = observed((0, FlightState.LANDED, GROUND))
    assert start.position is None
    start.observe(FlightState.TAKING_OFF, GROUND, NOW)
    assert start.position == (1.0, 2.0, 0.1)
    start.observe(FlightState.FLYING, at(3.0, 3.0, 2.0), NOW)
    assert start.position == (1.0, 2.0, 0.1)


def test_each_take_off_has_its_own_start() -> None:
    start = observed((0, FlightState.LANDED, GROUND), (0.1, FlightState.TAKING_OFF, GROUND))
    start.observe(FlightState.LANDED, None, NOW + S)
    start.observe(FlightState.TAKING_OFF, at(5.0, 5.0, 0.0, NOW + S), NOW + S)
    assert start.position == (5.0, 5.0, 0.0)
    start.observe(FlightState.LANDED, None, NOW + 2 * S)
    start.observe(FlightState.FLYING, at(6.0, 5.0, 0.0, NOW + 4 * S), NOW + 4 * S)
    assert start.position == (6.0, 5.0, 0.0), "some vehicles never report that they are taking off"


def test_a_brief_landed_in_the_air_does_not_move_it() -> None:
    start = observed((0, FlightState.LANDED, GROUND), (0.1, FlightState.TAKING_OFF, GROUND))
    for state in (FlightState.FLYING, FlightState.LANDED, FlightState.FLYING):
        start.observe(state, at(9.0, 9.0, 3.0), NOW + S // 2)
    assert start.position == (1.0, 2.0, 0.1)


def test_a_vehicle_found_in_the_air_has_none() -> None:
    assert observed((0, FlightState.FLYING, GROUND), (1, FlightState.HOVERING, GROUND)).position is None


def test_a_take_off_found_in_progress_counts_from_the_ground_below() -> None:
    assert observed((0, FlightState.TAKING_OFF, at(1.0, 2.0, 0.75, altitude_m=0.5))).position == (1.0, 2.0, 0.25)


def test_a_position_that_arrives_during_the_take_off_counts_from_the_ground_below() -> None:
    start = observed((0, FlightState.LANDED, at(0, 0, 0, position_m=None)))
    start.observe(FlightState.TAKING_OFF, at(0, 0, 0, position_m=None), NOW)
    start.observe(FlightState.TAKING_OFF, at(1.0, 2.0, 0.75, altitude_m=0.5), NOW)
    assert start.position == (1.0, 2.0, 0.25)
    late = observed((0, FlightState.LANDED, None), (0, FlightState.TAKING_OFF, None), (1, FlightState.FLYING, GROUND))
    late.observe(FlightState.FLYING, GROUND, NOW)
    assert late.position is None, "it may have flown anywhere since"


def test_an_old_position_does_not_count() -> None:
    old = at(1.0, 2.0, 0.0, NOW - S)
    assert observed((0, FlightState.LANDED, old), (0, FlightState.TAKING_OFF, old)).position is None


# The flight back -------------------------------------------------------------------------------------------------


def test_it_climbs_flies_over_its_start_and_lands() -> None:
    back = flight()
    assert place(back.step(within(LIMITS, ANYWHERE), at(5.0, 0.0, 1.0), NOW)) == (5.0, 0.0, 2.1)
    assert str(back.phase) == "climbing"
    assert place(back.step(within(LIMITS, ANYWHERE), at(5.1, 0.0, 1.5), NOW)) == (5.0, 0.0, 2.1)
    assert place(back.step(within(LIMITS, ANYWHERE), at(5.0, 0.0, 1.9), NOW)) == (0.0, 0.0, 2.1)
    assert str(back.phase) == "flying"
    fast = at(0.1, 0.0, 2.1, velocity_m_s=(0.8, 0.0, 0.0))
    assert place(back.step(within(LIMITS, ANYWHERE), fast, NOW)) == (0.0, 0.0, 2.1), "it is not at rest yet"
    assert back.step(within(LIMITS, ANYWHERE), at(0.1, 0.0, 2.1), NOW).action == Land()
    assert str(back.phase) == "landing"
    assert back.step(within(LIMITS, ANYWHERE), None, NOW + 60 * S).action == Land(), "whatever happens to its position"


@pytest.mark.parametrize(
    "wrong",
    [{100: 8.0}, dict.fromkeys(range(100, 103), 7.0), {0: 8.0}, dict.fromkeys(range(100, 150), 7.0)],
    ids=["one sample", "a narrow hole", "the first sample", "a second long"],
)
def test_wrong_heights_do_not_lower_the_return_for_good(wrong: dict[int, float]) -> None:
    """One reading of 8 m lowered the return for good: it descended to 4 cm, half a metre before the start."""
    back, airspace = flight(settings=ReturnSettings(height=3.0)), within(LIMITS, ANYWHERE)
    x, z, lowest, overhead = 8.0, 4.0, 4.0, 0.0
    for step in range(-10, 2000):
        now_ns = NOW + step * S // 50
        seen = at(x, 0.0, z, now_ns, altitude_m=wrong.get(step, z))
        airspace.observe(seen)  # as at each tick
        if step < 0:
            continue
        decision = back.step(airspace, seen, now_ns)
        if decision.action == Land():
            break
        to = place(decision)
        away = max(1e-9, ((to[0] - x) ** 2 + (to[2] - z) ** 2) ** 0.5)
        share = min(1.0, 0.02 / away)
        x, z = x + share * (to[0] - x), z + share * (to[2] - z)
        lowest, overhead = min(lowest, z), z
    assert decision.action == Land()
    assert abs(x) < 0.4
    assert overhead > 3.5
    assert lowest > (2.9 if len(wrong) > 10 else 3.9)


def test_it_stays_above_its_start_if_requested() -> None:
    back = flight(ReturnToStart(land=False))
    back.step(within(LIMITS, ANYWHERE), at(5.0, 0.0, 3.0), NOW)
    assert str(back.phase) == "flying", "it is high enough, and never descends on the way"
    assert place(back.step(within(LIMITS, ANYWHERE), at(0.0, 0.0, 3.0), NOW)) == (0.0, 0.0, 3.0)
    assert str(back.phase) == "arrived"
    assert place(back.step(within(LIMITS, ANYWHERE), at(2.0, 0.0, 3.0, NOW + 60 * S), NOW + 60 * S)) == (0.0, 0.0, 3.0)


def test_the_command_overrides_the_settings() -> None:
    settings = ReturnSettings(height=1.0, speed=0.5, land=False)
    decided = flight(settings=settings).step(within(LIMITS, ANYWHERE), at(5.0, 0.0, 0.5), NOW)
    assert place(decided) == (5.0, 0.0, 1.1)
    assert isinstance(decided.action, Position)
    assert decided.action.speed == 0.5
    assert (
        place(flight(ReturnToStart(3.0), settings=settings).step(within(LIMITS, ANYWHERE), at(5.0, 0.0, 0.5), NOW))[2]
        == 3.1
    )


@pytest.mark.parametrize(
    ("space", "limits", "feedback", "top"),
    [
        (Space(room=Box((-9, -9, 0), (9, 9, 2))), LIMITS, at(5.0, 0.0, 1.0), 1.7),
        (Space(box=Box((-9, -9, 0), (9, 9, 2.2))), LIMITS, at(5.0, 0.0, 1.0), 1.9),
        (ANYWHERE, Limits(altitude=1.5), at(5.0, 0.0, 1.0), 1.5),
        (ANYWHERE, Limits(altitude=1.5), at(5.0, 0.0, 2.5), 1.5),
        (ANYWHERE, LIMITS, at(0.5, 0.0, 1.0), 1.0),
    ],
    ids=["room", "box", "limit", "comes down to the limit", "near its start"],
)
def test_the_height_is_limited_to_the_permitted_space(
    space: Space, limits: Limits, feedback: Feedback, top: float
) -> None:
    assert place(flight().step(within(limits, space), feedback, NOW))[2] == pytest.approx(top)


@pytest.mark.parametrize(
    ("start", "space", "feedback", "reason", "words"),
    [
        (None, ANYWHERE, at(5, 0, 1), Refusal.WRONG_STATE, "the start is unknown"),
        (HOME, ANYWHERE, None, Refusal.WRONG_STATE, "does not report its position"),
        (None, ANYWHERE, at(5, 0, 1, position_m=None), Refusal.WRONG_STATE, "does not report its position"),
        (HOME, ANYWHERE, at(5, 0, 1, yaw_rad=None), Refusal.WRONG_STATE, "does not report its yaw"),
        (HOME, ANYWHERE, at(5, 0, 1, NOW - 3 * S), Refusal.WRONG_STATE, "3.0 s old"),
        (HOME, Space(zones=(Cylinder(2, 0, 0.5, 0, 5),)), at(5, 0, 1), Refusal.OUT_OF_RANGE, "a no-fly zone blocks"),
        (HOME, Space(zones=(Box((-1, -1, 0), (1, 1, 1)),)), at(5, 0, 1), Refusal.OUT_OF_RANGE, "a no-fly zone blocks"),
        (HOME, Space(zones=(Box((4, -1, 1.5), (6, 1, 1.8)),)), at(5, 0, 1), Refusal.OUT_OF_RANGE, "no-fly zone blocks"),
        (HOME, Space(box=Box((1, -9, 0), (9, 9, 9))), at(5, 0, 1), Refusal.OUT_OF_RANGE, "outside the safety box"),
    ],
)
def test_objections_to_a_return(
    start: tuple[float, float, float] | None, space: Space, feedback: Feedback | None, reason: Refusal, words: str
) -> None:
    back = flight(start=start)
    decided = back.step(within(LIMITS, space), feedback, NOW)
    assert (decided.action, decided.refusal) == (None, reason)
    assert words in decided.why
    assert str(back.phase) == "none"


def test_a_nonsensical_height_is_refused() -> None:
    decided = flight(ReturnToStart(-1.0)).step(within(LIMITS, ANYWHERE), at(5, 0, 1), NOW)
    assert (decided.refusal, "height is -1 m" in decided.why) == (Refusal.OUT_OF_RANGE, True)


def test_from_outside_the_box_it_flies_straight_back_inside() -> None:
    space = Space(box=Box((-4, -4, 0), (4, 4, 9)))
    assert place(flight().step(within(LIMITS, space), at(5.0, 0.0, 1.0), NOW)) == (0.0, 0.0, 2.1)


def test_a_zone_added_on_the_way_stops_it() -> None:
    back = flight()
    back.step(within(LIMITS, ANYWHERE), at(5.0, 0.0, 1.0), NOW)
    zones = Space(zones=(Cylinder(2, 0, 0.5, 0, 5),))
    assert "a no-fly zone blocks the straight line" in back.step(within(LIMITS, zones), at(5.0, 0.0, 2.1), NOW).why
    assert back.step(within(LIMITS, zones), at(5.0, 0.0, 2.1), NOW).action is None, "repeats don't change that"
    assert back.step(within(LIMITS, ANYWHERE), at(5.0, 0.0, 2.1), NOW).action is not None


def test_it_stops_without_a_fresh_position_and_continues_with_one() -> None:
    back = flight()
    back.step(within(LIMITS, ANYWHERE), at(5.0, 0.0, 1.0), NOW)
    later = NOW + 60 * S
    assert back.step(within(LIMITS, ANYWHERE), at(5.0, 0.0, 1.0, later - S), later) == ReturnDecision()
    decided = back.step(within(LIMITS, ANYWHERE), at(5.0, 0.0, 1.0, later - 3 * S), later)
    assert (decided.refusal, decided.lasting) == (Refusal.WRONG_STATE, False)
    assert place(back.step(within(LIMITS, ANYWHERE), at(5.0, 0.0, 1.0, later), later)) == (5.0, 0.0, 2.1)


def stuck(back: ReturnFlight, x: float, seconds: float) -> ReturnDecision:
    """Return the decision while it gets no closer: the last target, or the action instead."""
    decided = ReturnDecision()
    for tick in range(round(seconds * 10)):
        now_ns = NOW + tick * S // 10
        decided = back.step(within(LIMITS, ANYWHERE), at(x, 0.0, 3.0, now_ns), now_ns)
        if not isinstance(decided.action, Position):
            break
    return decided


def test_a_return_that_leads_nowhere_is_abandoned() -> None:
    assert isinstance(stuck(flight(), 5.0, 10.0).action, Position)
    decided = stuck(flight(), 5.0, 10.3)
    assert (decided.refusal, decided.lasting) == (Refusal.WRONG_STATE, True)
    assert "got no closer to its start for 10 s, and 5.0 m remain" in decided.why


def test_near_the_start_it_lands_if_it_gets_no_closer() -> None:
    assert stuck(flight(), 0.8, 10.3).action == Land()


# In the whole proxy ----------------------------------------------------------------------------------------------


def write(bench: Bench, pilot: App, name: str, value: Value) -> None:
    pilot.ask(SetParameter(name, value, pilot.lease))


def fall_below_the_charge_to_return_at(bench: Bench, pilot: App) -> None:
    write(bench, pilot, "battery.return", 0.3)
    bench.driver.report(battery=0.29)
    bench.tick()


def away(bench: Bench, x: float = 5.0) -> App:
    """Return a pilot whose vehicle took off at (0, 0) and hovers somewhere else."""
    pilot = bench.pilot()
    still = {"yaw_rad": 0.0, "velocity_m_s": (0.0, 0.0, 0.0)}
    bench.driver.report(state=FlightState.LANDED, position_m=(0.0, 0.0, 0.0), altitude_m=0.0, **still)
    bench.tick()
    pilot.command(Takeoff())
    bench.tick()
    assert pilot.last_feedback().start_position_m is None or pilot.last_feedback().start_position_m == (0.0, 0.0, 0.0)
    bench.move((x, 0.0, 1.0), state=FlightState.HOVERING, altitude_m=1.0)
    bench.driver.told.clear()
    return pilot


def fly_back(bench: Bench, each: Callable[[], object]) -> None:
    """Put the vehicle where the return wants it, until it lands."""
    for position in ((5.0, 0.0, 2.0), (2.0, 0.0, 2.0), (0.0, 0.0, 2.0)):
        bench.move(position, altitude_m=position[2])
        bench.run(0.04, each)


def phases(app: App) -> list[str]:
    seen = [str(sample.return_phase) for sample in app.feedback]
    return [phase for number, phase in enumerate(seen) if number == 0 or seen[number - 1] != phase]


def steps(app: App) -> list[tuple[object, object, object]]:
    return [tuple(event.data[name] for name in ("step", "reason", "returns")) for event in app.told(EventKind.FAILSAFE)]  # type: ignore[misc]


def test_a_pilots_return() -> None:
    with Bench() as bench:
        pilot = away(bench)
        assert pilot.last_feedback().start_position_m == (0.0, 0.0, 0.0)
        pilot.command(ReturnToStart())
        assert bench.driver.told == [Position(5.0, 0.0, 2.0, None, 1.0, 1.75)]
        fly_back(bench, lambda: pilot.command(ReturnToStart(), repeat=True))
        assert [*dict.fromkeys(map(type, bench.driver.told))] == [Position, Land]
        assert bench.driver.now.state is FlightState.LANDING
        bench.driver.report(state=FlightState.LANDED, altitude_m=0.0)
        bench.run(0.5, lambda: pilot.command(ReturnToStart(), repeat=True))
        assert pilot.refusals() == [], "repeats of a completed return are not refused"
        assert phases(pilot) == ["none", "climbing", "flying", "landing", "none"]
        pilot.command(ReturnToStart())
        assert pilot.refusals() == [Refusal.WRONG_STATE], "a new one is"


def test_feedback_never_shows_a_new_return_beside_the_previous_arrival() -> None:
    """A sample between the command and the next tick did: return_to_start() ended before the vehicle landed."""
    with Bench() as bench:
        pilot = away(bench)
        pilot.command(ReturnToStart(land=False))
        fly_back(bench, lambda: pilot.command(ReturnToStart(land=False), repeat=True))
        assert pilot.last_feedback().return_phase is ReturnPhase.ARRIVED
        pilot.command(ReturnToStart())
        bench.driver.report()
        pilot.sync()
        first = next(sample for sample in pilot.feedback if sample.outcome and sample.outcome.intent == pilot.intent)
        assert first.return_phase is ReturnPhase.FLYING


@pytest.mark.parametrize("action", [Hover(), Velocity(0.5), Land(), EmergencyStop(), Position(5.0, 1.0, 1.0)])
def test_any_command_ends_it(action: Hover | Velocity | Land | EmergencyStop | Position) -> None:
    with Bench() as bench:
        pilot = away(bench)
        pilot.command(ReturnToStart())
        bench.tick()
        assert pilot.last_feedback().return_phase is ReturnPhase.CLIMBING
        pilot.command(action)
        bench.tick()
        assert type(bench.driver.told[-1]) is type(action)
        assert pilot.last_feedback().return_phase is ReturnPhase.NONE


def test_another_pilot_ends_it() -> None:
    with Bench() as bench:
        pilot = away(bench)
        pilot.command(ReturnToStart())
        bench.pilot("other", 0)
        pilot.command(ReturnToStart(), repeat=True)
        assert bench.driver.told[-1] == Hover()
        assert pilot.refusals() == [Refusal.FOREIGN_LEASE]
        bench.tick()
        assert pilot.last_feedback().return_phase is ReturnPhase.NONE


def test_a_refused_return_stops_the_vehicle() -> None:
    with Bench() as bench:
        pilot = away(bench)
        write(bench, pilot, "safety.zones", "cylinder 2 0 0.5 0 5")
        pilot.command(Velocity(0.5))
        pilot.command(ReturnToStart())
        assert bench.driver.told[-1] == Hover()
        assert pilot.refusals() == [Refusal.OUT_OF_RANGE]


def test_without_a_position_it_is_refused() -> None:
    with Bench() as bench:
        pilot = bench.airborne()
        pilot.command(ReturnToStart())
        (refused,) = pilot.told(EventKind.COMMAND_REFUSED)
        assert "does not report its position" in refused.text
        assert pilot.last_feedback().start_position_m is None


def test_a_low_battery_returns_it_whatever_set_points_arrive() -> None:
    with Bench() as bench:
        pilot = away(bench)
        write(bench, pilot, "battery.return", 0.3)
        write(bench, pilot, "return.land", False)
        bench.driver.report(battery=0.29)
        fly_back(bench, lambda: pilot.command(Velocity(0.5)))
        assert [*dict.fromkeys(map(type, bench.driver.told))] == [Position, Land], "it lands in any case"
        assert steps(pilot) == [("land", "battery_return", True)]
        assert pilot.told(EventKind.FAILSAFE)[0].text == (
            "failsafe: return to the start and land there, because the battery is low"
        )
        assert set(pilot.refusals()) == {Refusal.WRONG_STATE}
        assert pilot.last_feedback().failsafe is Failsafe.LAND
        assert pilot.last_feedback().return_phase is ReturnPhase.LANDING
        bench.driver.report(state=FlightState.LANDED)
        bench.run(2.2)
        assert pilot.last_feedback().return_phase is ReturnPhase.NONE
        pilot.take_authority()
        pilot.command(Takeoff())
        assert "battery.return" in pilot.told(EventKind.COMMAND_REFUSED)[-1].text
        bench.driver.report(battery=0.9)
        bench.tick()
        pilot.command(Takeoff())
        assert bench.driver.told[-1] == Takeoff()


def test_no_automatic_hover_or_landing_ends_a_return_for_a_low_battery() -> None:
    """A route's end, a page closed half-way, a released key: only a person's own command ends it."""
    with Bench() as bench:
        pilot = away(bench)
        fall_below_the_charge_to_return_at(bench, pilot)
        for action in (Hover(), Land()):
            pilot.command(action, automatic=True)
            bench.run(0.2, lambda action=action: pilot.command(action, automatic=True, repeat=True))  # type: ignore[misc]
        assert {type(action) for action in bench.driver.told} == {Position}
        assert set(pilot.refusals()) == {Refusal.WRONG_STATE}
        assert steps(pilot) == [("land", "battery_return", True)]
        pilot.command(Hover())
        assert bench.driver.told[-1] == Hover()


def test_a_repeated_landing_of_a_waiting_call_is_not_refused() -> None:
    """After a lost link, ``land()`` raised while the vehicle was on its way to land."""
    with Bench() as bench:
        pilot = away(bench)
        fall_below_the_charge_to_return_at(bench, pilot)
        pilot.command(Land(), automatic=True)
        bench.run(0.2, lambda: pilot.command(Land(), automatic=True, repeat=True))
        assert {type(action) for action in bench.driver.told} == {Position}
        assert pilot.refusals() == []
        pilot.ask(ReleaseAuthority())
        bench.run(0.2)
        assert {type(action) for action in bench.driver.told} == {Position}, "it still lands at its start"


def test_the_pilot_takes_over_with_a_new_hover_until_it_is_charged() -> None:
    with Bench() as bench:
        pilot = away(bench)
        fall_below_the_charge_to_return_at(bench, pilot)
        pilot.command(Hover())
        pilot.command(Velocity(0.1))
        assert bench.driver.told[-2:] == [Hover(), Velocity(0.1)]
        bench.driver.report(battery=0.34)
        bench.driver.report(battery=0.2)
        bench.run(0.1, lambda: pilot.command(Velocity(0.1)))
        assert steps(pilot) == [("land", "battery_return", True), ("none", "fresh command", False)]
        bench.driver.report(battery=0.36)
        bench.run(0.02, lambda: pilot.command(Velocity(0.1)))
        bench.driver.report(battery=0.29)
        bench.run(0.02, lambda: pilot.command(Velocity(0.1)))
        assert steps(pilot)[-1] == ("land", "battery_return", True), "it rose, and fell again"
        bench.driver.report(battery=0.09)
        bench.tick()
        assert bench.driver.told[-1] == Land(), "at battery.land it lands in place"
        assert steps(pilot)[-1] == ("land", "battery", False)
        pilot.command(Hover())
        assert bench.driver.told[-1] == Land()


def test_a_low_battery_without_a_start_lands() -> None:
    with Bench() as bench:
        pilot = bench.airborne()
        fall_below_the_charge_to_return_at(bench, pilot)
        assert bench.driver.told == [Land()]
        assert steps(pilot) == [("land", "battery_return", False)]
        assert "it can't return to its start: the vehicle does not report" in pilot.told(EventKind.FAILSAFE)[0].text


def test_a_position_lost_on_the_way_ends_in_a_landing() -> None:
    with Bench() as bench:
        pilot = away(bench)
        fall_below_the_charge_to_return_at(bench, pilot)
        bench.driver.answers = False
        bench.run(1.0)
        assert bench.driver.told[-1] == Hover(), "it waits for a fresh position"
        bench.driver.report(position_m=None, state=FlightState.FLYING)
        bench.run(0.98, bench.driver.report)
        assert Land() not in bench.driver.told
        bench.run(0.1)
        assert bench.driver.told[-1:] == [Land()]
        assert steps(pilot)[-1] == ("land", "battery_return", False)


def test_a_link_that_breaks_and_returns_on_the_way_does_not_end_it() -> None:
    with Bench() as bench:
        pilot = away(bench)
        fall_below_the_charge_to_return_at(bench, pilot)
        bench.driver.link(LinkState.LOST)
        bench.run(4.0)
        bench.driver.told.clear()
        bench.driver.link(LinkState.UP)
        bench.tick()
        bench.driver.report(state=FlightState.FLYING)
        bench.tick()
        assert isinstance(bench.driver.told[-1], Position)
        assert steps(pilot) == [("land", "battery_return", True)]


def test_a_driver_that_fails_to_fly_it_there_lands_it() -> None:
    with Bench() as bench:
        pilot = away(bench)
        write(bench, pilot, "battery.return", 0.3)
        bench.driver.fail.add("apply")
        bench.driver.report(battery=0.29)
        bench.run(0.9, bench.driver.report)
        assert steps(pilot)[-1][2] is True
        bench.run(0.2, bench.driver.report)
        assert steps(pilot)[-1][2] is False
        bench.driver.fail.clear()
        bench.run(0.3)
        assert bench.driver.told == [Land()]


@pytest.mark.parametrize("actions", [ALL, ALL - {"position"}], ids=["native", "software"])
def test_a_lost_pilots_vehicle_returns_if_configured(actions: frozenset[str]) -> None:
    with Bench(actions) as bench:
        pilot, witness = away(bench), bench.join("witness")
        write(bench, pilot, "failsafe.return", True)

        def hovers() -> None:
            bench.driver.report(state=FlightState.HOVERING)
            pilot.sync()
            witness.sync()

        bench.run(5.1, hovers)
        assert steps(witness) == [("hover", "silent", False), ("land", "silent", True)]
        assert type(bench.driver.told[-1]) is (Position if "position" in actions else Velocity)
        assert witness.last_feedback().return_phase is ReturnPhase.CLIMBING
        pilot.take_authority()
        pilot.command(Velocity(0.2))
        assert bench.driver.told[-1] == Velocity(0.2), "a returning pilot flies on at once"
        bench.tick()
        assert steps(witness)[-1] == ("none", "fresh command", False)
        assert witness.last_feedback().return_phase is ReturnPhase.NONE


def test_a_vehicle_flown_by_others_is_not_brought_back() -> None:
    with Bench() as bench:
        pilot = away(bench)
        fall_below_the_charge_to_return_at(bench, pilot)
        bench.driver.told.clear()
        bench.driver.left = "RTL"
        bench.run(0.1)
        assert bench.driver.told == []
        assert pilot.last_feedback().return_phase is ReturnPhase.NONE


def test_the_settings_are_parameters() -> None:
    with Bench() as bench:
        pilot = away(bench)
        write(bench, pilot, "return.height", 3.0)
        write(bench, pilot, "return.speed", 0.5)
        write(bench, pilot, "return.land", False)
        assert bench.proxy.handler.checks.returns == replace(SETTINGS, height=3.0, speed=0.5, land=False)
        pilot.command(ReturnToStart())
        assert bench.driver.told == [Position(5.0, 0.0, 3.0, None, 0.5, 1.75)]
