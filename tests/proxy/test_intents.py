"""An intent starts once and ends once, and no repeat acts after its end."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from hypothesis import given
from hypothesis import strategies as st

from skyloop.clock import NS_PER_S
from skyloop.errors import DriverError
from skyloop.messages import (
    AnyAction,
    Attitude,
    Command,
    EmergencyStop,
    EventKind,
    Fate,
    FlightState,
    Hover,
    Idle,
    Land,
    LinkState,
    Position,
    Refusal,
    ReleaseAuthority,
    ResetEmergency,
    ReturnToStart,
    Takeoff,
    Velocity,
)
from skyloop.messages.command import ENDINGS
from skyloop.proxy.core.command_checks import SETTLED_NS, TAKEOFF_NS, Intent, Intents
from tests.support.proxy_bench import ALL, App, Bench

NOW = 100 * NS_PER_S
S = FlightState
ORDERS: tuple[AnyAction, ...] = (
    Takeoff(),
    Hover(),
    Land(),
    Velocity(0.3),
    Attitude(0.1),
    Position(1.0, 0.0, 1.0),
    ReturnToStart(),
)


# The pure module ---------------------------------------------------------------------------------------------------


def received(intents: Intents, number: int, action: AnyAction, state: FlightState = S.HOVERING) -> tuple[Intent, bool]:
    command = Command(intents.seq + 1, 1, number, NOW, action)
    assert intents.check(command, NOW, NS_PER_S, 1, True) is None
    return intents.intent_of(command, state, NOW)


@pytest.mark.parametrize("action", ORDERS, ids=lambda action: action.name)
@pytest.mark.parametrize("fate", ENDINGS)
def test_each_end_ends_every_kind_of_intent(fate: Fate, action: AnyAction) -> None:
    intents = Intents()
    received(intents, 3, action)
    intents.end(fate)
    repeat, new = received(intents, 3, action)
    assert (repeat.over, new, repeat.fate) == (True, False, fate)
    later, new = received(intents, 4, action)
    assert (later.over, new) == (False, True)


def test_the_list_of_ends_is_complete() -> None:
    assert set(ENDINGS) == set(Fate) - {Fate.UNDER_WAY}


def test_a_newer_intent_replaces_the_previous_one_for_good() -> None:
    intents = Intents()
    first, _ = received(intents, 1, Velocity(0.3))
    received(intents, 2, Hover())
    assert first.fate is Fate.REPLACED
    assert received(intents, 1, Velocity(0.3))[0].over


def test_idle_withdraws_the_request() -> None:
    intents = Intents()
    takeoff, _ = received(intents, 1, Takeoff(), S.LANDED)
    received(intents, 2, Idle(), S.LANDED)
    assert takeoff.fate is Fate.WITHDRAWN


def test_late_refused_commands_are_ended_too() -> None:
    intents = Intents()
    intents.check(Command(1, 1, 9, 0, Hover()), NOW, NS_PER_S, 1, True)
    intents.end(Fate.FAILSAFE)
    repeat, new = received(intents, 9, Hover())
    assert (repeat.over, new, repeat.reason) == (True, False, Refusal.NOT_FRESH)


def test_intent_zero_is_new_before_anything_was_received() -> None:
    assert received(Intents(), 0, Hover())[1]


@pytest.mark.parametrize(
    ("action", "states", "fate"),
    [
        (Takeoff(), [S.LANDED, S.TAKING_OFF, S.HOVERING], Fate.COMPLETED),
        (Takeoff(), [S.LANDED, S.TAKING_OFF], Fate.UNDER_WAY),
        (Takeoff(), [S.LANDED, S.TAKING_OFF, S.LANDED], Fate.LANDED),  # tipped over, or disarmed by a switch
        (Takeoff(), [S.LANDED, S.TAKING_OFF, S.LANDING], Fate.LANDED),  # others land it
        (Takeoff(), [S.LANDED, S.TAKING_OFF, S.UNKNOWN, S.LANDED], Fate.LANDED),  # with an unknown state in between
        (Takeoff(), [S.LANDED, S.TAKING_OFF, S.EMERGENCY], Fate.EMERGENCY),
        (Land(), [S.HOVERING, S.LANDING], Fate.UNDER_WAY),
        (Land(), [S.HOVERING, S.LANDING, S.LANDED], Fate.COMPLETED),
        (Land(), [S.LANDED], Fate.COMPLETED),
        (Hover(), [S.LANDING, S.HOVERING], Fate.UNDER_WAY),  # it aborted a landing
        (Hover(), [S.HOVERING, S.LANDING], Fate.LANDED),
        (Velocity(0.3), [S.FLYING, S.LANDED], Fate.LANDED),
        (Velocity(0.3), [S.FLYING, S.UNKNOWN], Fate.UNDER_WAY),
        (Position(1.0, 0.0, 1.0), [S.TAKING_OFF, S.HOVERING, S.FLYING], Fate.UNDER_WAY),
        (ReturnToStart(), [S.FLYING, S.LANDING], Fate.UNDER_WAY),
        (ReturnToStart(), [S.FLYING, S.LANDING, S.LANDED], Fate.COMPLETED),
        (ResetEmergency(), [S.EMERGENCY], Fate.UNDER_WAY),
        (ResetEmergency(), [S.EMERGENCY, S.LANDED], Fate.COMPLETED),
    ],
)
def test_the_vehicles_actions_end_an_intent(action: AnyAction, states: list[FlightState], fate: Fate) -> None:
    intent = Intent(1, action, NOW, states[0], begun=True)
    for state in states:
        intent.observe(state, NOW)
    assert intent.fate is fate


def test_a_take_off_has_a_time_limit_on_the_ground_but_none_in_the_air() -> None:
    stands, climbs = (Intent(1, Takeoff(), NOW, S.LANDED, begun=True) for _ in range(2))
    stands.observe(S.LANDED, NOW + TAKEOFF_NS - 1)
    assert not stands.over
    stands.observe(S.LANDED, NOW + TAKEOFF_NS)
    climbs.observe(S.TAKING_OFF, NOW + 2 * TAKEOFF_NS)
    assert (stands.fate, climbs.fate) == (Fate.TIMED_OUT, Fate.UNDER_WAY)


def test_a_take_off_of_a_vehicle_without_a_state_has_a_time_limit_too(bench: Bench) -> None:
    """A robot's service did not answer: the repeats called it forever, until it did."""
    pilot = bench.pilot()
    bench.driver.answers = False
    bench.driver.report(state=S.UNKNOWN)
    pilot.command(Takeoff())
    repeats(bench, pilot, Takeoff(), TAKEOFF_NS / NS_PER_S + 0.1)
    bench.driver.told.clear()
    repeats(bench, pilot, Takeoff())
    assert bench.driver.told == []
    outcome = pilot.last_feedback().outcome
    assert outcome is not None
    assert outcome.fate is Fate.TIMED_OUT


def test_a_landing_that_withdrew_a_take_off_waits_for_an_arming_on_its_way() -> None:
    landing = Intent(1, Land(), NOW, S.LANDED, withdrew=True)
    landing.observe(S.LANDED, NOW + SETTLED_NS - 1)
    assert not landing.over
    landing.observe(S.LANDED, NOW + SETTLED_NS)
    assert landing.fate is Fate.COMPLETED


_STEPS = st.one_of(
    st.tuples(st.just("ask"), st.sampled_from(ORDERS)),
    st.tuples(st.just("repeat"), st.integers(0, 3)),
    st.tuples(st.just("end"), st.sampled_from(list(ENDINGS))),
    st.tuples(st.just("see"), st.sampled_from(list(FlightState))),
)


@given(st.lists(_STEPS, max_size=40))
def test_no_repeat_is_in_progress_after_an_end_whatever_happens(steps: list[tuple[str, object]]) -> None:
    intents, over, number = Intents(), set[int](), 0
    for step, what in steps:
        if step == "ask":
            over.add(number)  # the newer one replaces it
            number += 1
            intent, new = received(intents, number, what)  # type: ignore[arg-type]
            assert new
            assert not intent.over
        elif step == "repeat" and number:
            wanted = max(1, number - what)  # type: ignore[operator]
            intent, new = received(intents, wanted, Hover())
            assert not new
            assert intent.over or wanted not in over
        elif step == "end":
            over.update(range(number + 1))
            intents.end(what)  # type: ignore[arg-type]
        elif step == "see":
            intents.newest.observe(what, NOW)  # type: ignore[arg-type]
            if intents.newest.over:
                over.add(number)


# In a proxy --------------------------------------------------------------------------------------------------------


def pending(bench: Bench, name: str = "pilot") -> App:
    """Return a pilot whose vehicle got a take-off that it does not show yet."""
    bench.driver.answers = False
    pilot = bench.pilot(name)
    pilot.command(Takeoff())
    assert bench.driver.told == [Takeoff()]
    return pilot


def repeats(bench: Bench, pilot: App, action: AnyAction, seconds: float = 1.0) -> None:
    """Repeat an action as often as the library does."""
    bench.run(seconds, lambda: pilot.command(action, repeat=True))


def test_a_take_off_that_others_land_does_not_restart(bench: Bench) -> None:
    """Another station, or a pilot's switch, lands it at 1 m: 0.1 s after touch-down it took off again."""
    pilot = bench.pilot()
    pilot.command(Takeoff())
    bench.driver.left = "LAND"
    bench.driver.report(state=S.LANDING)
    repeats(bench, pilot, Takeoff())
    bench.driver.left = ""
    bench.driver.report(state=S.LANDED)
    repeats(bench, pilot, Takeoff(), 5.0)
    assert bench.driver.told == [Takeoff()]
    assert pilot.last_feedback().outcome is not None
    assert "LAND, which was not chosen here" in pilot.told(EventKind.COMMAND_REFUSED)[0].text


@pytest.mark.parametrize("noticed", [True, False], ids=["seen landing", "seen standing"])
def test_a_take_off_that_ends_on_the_ground_is_over(bench: Bench, noticed: bool) -> None:
    """It tips over, or a switch disarms it: 0.1 s later it armed itself and took off."""
    pilot = bench.pilot()
    pilot.command(Takeoff())
    bench.tick()
    if noticed:
        bench.driver.report(state=S.LANDING)
        bench.tick()
    bench.driver.report(state=S.LANDED)
    repeats(bench, pilot, Takeoff(), 5.0)
    assert bench.driver.told == [Takeoff()]
    outcome = pilot.last_feedback().outcome
    assert outcome is not None
    assert (outcome.app_id, outcome.intent, outcome.fate) == (pilot.app_id, pilot.intent, Fate.LANDED)
    assert "landed or disarmed" in outcome.text


def battery(bench: Bench) -> Callable[[], object]:
    bench.driver.report(battery=0.05)
    bench.tick()
    return lambda: bench.driver.report(battery=0.5)


def emergency(bench: Bench) -> Callable[[], object]:
    bench.driver.report(state=S.EMERGENCY)
    return lambda: bench.driver.report(state=S.LANDED)


def not_ready(bench: Bench) -> Callable[[], object]:
    bench.driver.refuses = "GPS has no fix"
    return lambda: setattr(bench.driver, "refuses", "")


def no_link(bench: Bench) -> Callable[[], object]:
    bench.driver.link(LinkState.CONNECTING)
    return lambda: bench.driver.link(LinkState.UP)


@pytest.mark.parametrize("prevent", [battery, emergency, not_ready, no_link], ids=lambda one: one.__name__)
def test_a_refused_take_off_is_not_executed_later(
    bench: Bench, prevent: Callable[[Bench], Callable[[], object]]
) -> None:
    """Refused and without a waiting call: it was executed once the battery read higher, or an emergency was reset."""
    pilot = bench.pilot()
    bench.tick()
    release = prevent(bench)
    pilot.command(Takeoff())
    assert len(pilot.refusals()) == 1
    release()
    bench.tick()
    repeats(bench, pilot, Takeoff())
    assert Takeoff() not in bench.driver.told
    pilot.command(Takeoff())
    assert bench.driver.told[-1] == Takeoff(), "a new request is executed"


def test_a_driver_that_gives_up_midway_must_forget_the_take_off(bench: Bench) -> None:
    pilot = pending(bench)
    bench.driver.fail = {"apply"}
    pilot.command(Takeoff(), repeat=True)
    bench.driver.fail = set()
    assert pilot.refusals() == [Refusal.DRIVER_FAILED]
    repeats(bench, pilot, Takeoff())
    assert bench.driver.told == [Takeoff(), Land()]


def test_a_failed_set_point_does_not_leave_the_previous_one_in_force(bench: Bench) -> None:
    """The driver raised once at a repeat: the library sent Idle from then on, and it flew on at the old velocity."""
    pilot = bench.airborne()
    pilot.command(Velocity(0.5))
    bench.driver.told.clear()
    bench.driver.fail = {"apply"}
    pilot.command(Velocity(0.5), repeat=True)
    bench.run(0.3, lambda: pilot.command(Idle(), repeat=True))
    bench.driver.fail = set()
    bench.run(1.0, lambda: pilot.command(Idle(), repeat=True))
    assert bench.driver.told == [Hover()]
    pilot.command(Velocity(0.5))
    bench.run(0.5, lambda: pilot.command(Velocity(0.5), repeat=True))
    assert set(map(type, bench.driver.told[1:])) == {Velocity}, "a new one is flown"


def test_an_unreachable_target_leaves_no_velocity_in_force() -> None:
    """It was refused but replaced the velocity, which was not repeated, and nothing ended."""
    with Bench(ALL - {"position"}) as bench:
        pilot = bench.airborne()
        pilot.command(Velocity(0.5))
        bench.driver.told.clear()
        bench.driver.report(position_m=(0.0, 0.0, 1.0), yaw_rad=0.0)
        bench.driver.refuses = "no GPS"
        pilot.command(Position(1.0, 0.0, 1.0))
        bench.driver.refuses = ""
        bench.run(0.5, lambda: pilot.command(Idle(), repeat=True))
        assert bench.driver.told == [Hover()]


def lease_lost(bench: Bench, pilot: App) -> None:
    pilot.ask(ReleaseAuthority())


def taken_over(bench: Bench, pilot: App) -> None:
    bench.pilot("boss", priority=0)


def link_broken(bench: Bench, pilot: App) -> None:
    bench.driver.link(LinkState.LOST)
    bench.tick()


def given_up(bench: Bench, pilot: App) -> None:
    pilot.command(Idle())


def no_longer_repeated(bench: Bench, pilot: App) -> None:
    pilot.command(Idle(), repeat=True)


def hovered(bench: Bench, pilot: App) -> None:
    pilot.command(Hover())


def landed(bench: Bench, pilot: App) -> None:
    pilot.command(Land())


def timed_out(bench: Bench, pilot: App) -> None:
    bench.run(20.1, lambda: pilot.command(Takeoff(), repeat=True))


def timed_out_behind_a_set_point(bench: Bench, pilot: App) -> None:
    bench.run(20.1, lambda: pilot.command(Velocity(0.1)))


@pytest.mark.parametrize(
    "end",
    [
        lease_lost,
        taken_over,
        link_broken,
        given_up,
        no_longer_repeated,
        hovered,
        landed,
        timed_out,
        timed_out_behind_a_set_point,
    ],
    ids=lambda one: one.__name__,
)
def test_a_take_off_that_ends_before_it_shows_is_withdrawn_from_the_vehicle(
    bench: Bench, end: Callable[[Bench, App], None]
) -> None:
    """A call gave up after 4 s, and the vehicle took off at 14.6 s, because its driver kept trying."""
    pilot = pending(bench)
    end(bench, pilot)
    assert bench.driver.told[-1] == Land(), "this makes a driver forget it"
    assert bench.driver.told.count(Land()) == 1


@pytest.mark.parametrize(
    "end",
    [
        lambda pilot: pilot.command(Hover()),
        lambda pilot: pilot.command(Land()),
        lambda pilot: pilot.ask(ReleaseAuthority()),
    ],
    ids=["hover", "land", "release"],
)
def test_a_failed_withdrawal_of_a_take_off_is_retried(bench: Bench, end: Callable[[App], object]) -> None:
    """The driver raised once at the landing: its take-off continued, although the person had ended it."""
    pilot = bench.pilot()
    bench.driver.answers = False
    pilot.command(Takeoff())
    bench.driver.told.clear()
    bench.driver.fail = {"apply"}
    end(pilot)
    bench.run(0.5)
    bench.driver.fail = set()
    bench.run(1.0)
    assert bench.driver.told == [Land()]


@pytest.mark.parametrize("action", [Velocity(0.1), Takeoff()], ids=lambda action: action.name)
def test_a_running_controller_leaves_a_take_off_alone(bench: Bench, action: AnyAction) -> None:
    pilot = pending(bench)
    bench.run(0.5, lambda: pilot.command(action))
    assert Land() not in bench.driver.told


def test_a_visible_take_off_is_not_aborted_by_a_lost_lease(bench: Bench) -> None:
    pilot = pending(bench)
    bench.driver.report(state=S.TAKING_OFF)
    bench.tick()
    pilot.ask(ReleaseAuthority())
    pilot.command(Idle())
    assert bench.driver.told == [Takeoff()]


def test_a_command_that_shows_whose_flight_it_is_takes_it_at_once(bench: Bench) -> None:
    pilot = bench.pilot()
    bench.driver.report(state=S.FLYING)  # by others, and nothing has checked since
    pilot.command(Hover())
    assert bench.driver.told == [Hover()]


def test_a_hover_that_withdraws_a_take_off_is_reported_as_completed(bench: Bench) -> None:
    pilot = pending(bench)
    pilot.command(Hover())
    bench.driver.report()
    outcome = pilot.last_feedback().outcome
    assert outcome is not None
    assert (outcome.intent, outcome.fate) == (pilot.intent, Fate.COMPLETED)


def test_nothing_else_is_sent_after_a_motor_stop(bench: Bench) -> None:
    pilot = pending(bench)
    pilot.command(EmergencyStop())
    repeats(bench, pilot, Takeoff())
    assert bench.driver.told == [Takeoff(), EmergencyStop()]


def test_a_flight_long_after_a_withdrawn_take_off_is_others(bench: Bench) -> None:
    """For 15 s, anything that rose counted as the take-off that a person had ended: another's flight was landed."""
    pilot = bench.pilot()
    bench.driver.answers = False
    pilot.command(Takeoff())
    pilot.command(Land())
    repeats(bench, pilot, Land(), 2.0)
    pilot.ask(ReleaseAuthority())
    bench.run(4.0)
    bench.driver.told.clear()
    bench.driver.report(state=S.FLYING)
    bench.run(6.0)
    assert bench.driver.told == []


def test_nothing_is_withdrawn_from_a_vehicle_taken_by_others(bench: Bench) -> None:
    pilot = pending(bench)
    bench.driver.left = "STABILIZE"
    bench.driver.answers = True
    bench.driver.report(state=S.TAKING_OFF)
    bench.tick()
    pilot.command(Idle())
    bench.run(1.0)
    assert bench.driver.told == [Takeoff()]


def at_home(bench: Bench, state: FlightState = S.HOVERING) -> App:
    pilot = bench.airborne()
    bench.driver.report(state=state, position_m=(0.0, 0.0, 1.0), yaw_rad=0.0, altitude_m=1.0)
    return pilot


BELOW, HIGH = Position(0.0, 0.0, -4.0), Position(0.0, 0.0, 50.0)


@pytest.mark.parametrize("place", [BELOW, HIGH], ids=["below the ground", "above the limit"])
def test_a_refused_target_is_not_flown_to_by_its_own_repeat(bench: Bench, place: Position) -> None:
    """Judged only while it was new, it stood on the floor 3 s later with its motors running."""
    pilot = at_home(bench)
    pilot.command(place)
    assert pilot.refusals() == [Refusal.OUT_OF_RANGE]
    repeats(bench, pilot, place)
    assert set(bench.driver.told) == {Hover()}


@pytest.mark.parametrize("place", [BELOW, HIGH], ids=["below the ground", "above the limit"])
def test_a_target_requested_during_a_take_off_is_judged_at_once(bench: Bench, place: Position) -> None:
    pilot = at_home(bench, S.TAKING_OFF)
    pilot.command(place)
    assert pilot.refusals() == [Refusal.OUT_OF_RANGE]
    bench.driver.report(state=S.HOVERING)
    repeats(bench, pilot, place)
    assert bench.driver.told == [], "the take-off continued, and it hovers"


def test_a_good_target_requested_during_a_take_off_is_flown_to_after_it(bench: Bench) -> None:
    pilot = at_home(bench, S.TAKING_OFF)
    place = Position(1.0, 0.0, 1.0)
    pilot.command(place)
    assert bench.driver.told == []
    bench.driver.report(state=S.HOVERING)
    pilot.command(place, repeat=True)
    assert [type(action) for action in bench.driver.told] == [Position]


def test_a_target_behind_a_zone_added_during_a_take_off_is_judged_again(bench: Bench) -> None:
    from tests.support.proxy_bench import write

    pilot = at_home(bench, S.TAKING_OFF)
    place = Position(3.0, 0.0, 1.0)
    pilot.command(place)
    write(bench, pilot, "safety.zones", "box 1 -1 0 2 1 3")
    bench.driver.report(state=S.HOVERING)
    pilot.command(place, repeat=True)
    assert pilot.refusals() == [Refusal.OUT_OF_RANGE]
    assert Position not in map(type, bench.driver.told)


def test_a_landing_that_fails_once_is_retried(bench: Bench) -> None:
    pilot = bench.airborne()
    bench.driver.fail = {"apply"}
    pilot.command(Land())
    bench.driver.fail = set()
    pilot.command(Land(), repeat=True)
    assert bench.driver.told == [Land()]


def test_a_reset_before_the_emergency_is_known_is_executed_once_it_is(bench: Bench) -> None:
    pilot = bench.airborne()
    pilot.command(ResetEmergency())
    assert pilot.refusals() == [Refusal.WRONG_STATE]
    bench.driver.report(state=S.EMERGENCY)
    pilot.command(ResetEmergency(), repeat=True)
    assert bench.driver.told == [ResetEmergency()]


def test_a_landing_requested_while_others_land_does_not_take_the_vehicle_by_a_repeat(bench: Bench) -> None:
    pilot = bench.airborne()
    bench.driver.left = "LAND"
    bench.driver.report(state=S.LANDING)
    bench.tick()
    pilot.command(Land())
    bench.driver.left = "LOITER"
    bench.driver.report(state=S.HOVERING)
    repeats(bench, pilot, Land())
    assert bench.driver.told == []
    assert pilot.refusals() == [Refusal.WRONG_STATE]


def test_a_repeated_take_off_takes_no_vehicle_from_others(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    """takeoff() waited for GPS, and a safety pilot took off by hand: the next attempt stopped it in the air."""
    begun: list[bool] = []
    apply = bench.driver.apply

    def noted(action: AnyAction, *, new: bool = True) -> AnyAction | None:
        begun.append(new)
        return apply(action, new=new)

    monkeypatch.setattr(bench.driver, "apply", noted)
    pilot = bench.pilot()
    pilot.command(Takeoff(), automatic=True)
    assert (begun, bench.driver.told) == ([True], [Takeoff()]), "on the ground it starts"
    pilot.command(Idle())
    bench.driver.report(state=S.LANDED)
    bench.tick()
    bench.driver.told.clear()
    bench.driver.left = "STABILIZE"
    bench.driver.report(state=S.FLYING)
    bench.tick()
    pilot.command(Takeoff(), automatic=True)
    assert bench.driver.told == []
    assert pilot.refusals()[-1] == Refusal.WRONG_STATE
    pilot.command(Takeoff())
    assert bench.driver.told == [Hover()], "a person's own still does"


def test_an_outcome_stays_in_feedback_until_a_newer_intent(bench: Bench) -> None:
    pilot = bench.pilot()
    pilot.command(Velocity(0.5))
    for _ in range(3):
        bench.driver.report()
        outcome = pilot.last_feedback().outcome
        assert outcome is not None
        assert (outcome.intent, outcome.fate, outcome.reason) == (1, Fate.REFUSED, Refusal.WRONG_STATE)
        assert outcome.text == "pilot: velocity refused: velocity is not possible while landed: take off first"
    pilot.command(Takeoff())
    bench.driver.report(state=S.TAKING_OFF)
    outcome = pilot.last_feedback().outcome
    assert outcome is not None
    assert (outcome.intent, outcome.fate) == (2, Fate.UNDER_WAY)
    bench.driver.report(state=S.HOVERING)
    bench.tick()
    bench.driver.report()
    outcome = pilot.last_feedback().outcome
    assert outcome is not None
    assert (outcome.intent, outcome.fate) == (2, Fate.COMPLETED)


def test_a_take_off_in_the_air_is_not_reported_before_it_is_known_whose_it_is(bench: Bench) -> None:
    """A pilot's sticks took it on its way up: for 20 ms all reports said that it flew as requested."""
    pilot = pending(bench)
    bench.driver.report(state=S.TAKING_OFF)
    bench.tick()
    bench.driver.left = "POSCTL"
    bench.driver.report(state=S.FLYING)
    risen = pilot.last_feedback()
    assert risen.state is S.FLYING
    assert risen.outcome is not None
    assert risen.outcome.app_id == 0, "no one's until the proxy has checked"
    bench.tick()
    outcome = pilot.last_feedback().outcome
    assert outcome is not None
    assert (outcome.app_id, outcome.intent, outcome.fate) == (pilot.app_id, pilot.intent, Fate.OTHERS)


def test_a_motor_stop_ends_all_requests(bench: Bench) -> None:
    pilot, other = bench.airborne(), bench.join("other")
    pilot.command(Velocity(0.5))
    other.command(EmergencyStop())
    bench.driver.report(state=S.LANDED)  # reset at the vehicle itself
    repeats(bench, pilot, Velocity(0.5))
    assert bench.driver.told == [Velocity(0.5), EmergencyStop()]
    outcome = pilot.last_feedback().outcome
    assert outcome is not None
    assert outcome.fate is Fate.EMERGENCY


def test_a_repeat_of_a_completed_intent_ends_no_failsafe(bench: Bench) -> None:
    pilot = bench.airborne()
    bench.tick()
    bench.run(0.6)
    bench.driver.told.clear()
    pilot.command(Takeoff(), repeat=True)
    assert pilot.last_feedback().failsafe == "hover"
    assert bench.driver.told == []


def test_an_immediate_refusal_by_the_driver_is_explained_to_a_repeat(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(_: AnyAction, *, new: bool = True) -> AnyAction:
        raise DriverError("no")

    monkeypatch.setattr(bench.driver, "apply", refuse)
    pilot = bench.pilot()
    pilot.command(Takeoff())
    monkeypatch.undo()
    pilot.command(Takeoff(), repeat=True)
    assert bench.driver.told == []


def test_a_refused_software_take_off_is_over() -> None:
    """It was disarmed before it rose: the software autopilot armed it again, 50 times a second."""
    with Bench(actions={"attitude"}) as bench:
        bench.driver.answers = False
        bench.driver.report(altitude_m=0.0)
        pilot = bench.pilot()
        pilot.command(Takeoff())
        bench.run(0.1, lambda: pilot.command(Takeoff(), repeat=True))
        assert pilot.last_feedback().state is S.TAKING_OFF
        bench.driver.refuses = "the flight controller disarmed before it had taken off"
        bench.run(0.1, lambda: pilot.command(Takeoff(), repeat=True))
        assert pilot.last_feedback().state is S.LANDED
        bench.driver.refuses = ""
        bench.driver.told.clear()
        bench.run(2.0, lambda: pilot.command(Takeoff(), repeat=True))
        assert not [told for told in bench.driver.told if isinstance(told, Attitude) and told.climb > 0]
        outcome = pilot.last_feedback().outcome
        assert outcome is not None
        assert outcome.fate is Fate.REFUSED
        assert "disarmed before it had taken off" in outcome.text
