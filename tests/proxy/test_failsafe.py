"""The failsafe ladder: exact times, the ends of steps, and the pace of retries."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from skyloop.clock import NS_PER_S
from skyloop.messages import Failsafe, FlightState, Hover, Land
from skyloop.proxy.core.failsafe import (
    BatteryLow,
    Effect,
    FailsafeAction,
    FailsafeInputs,
    FailsafeLadder,
    FailsafeSettings,
    StepChange,
)

S = NS_PER_S
MS = S // 1000
T0 = 100 * S
FLYING = FailsafeInputs(FlightState.FLYING, True, T0, "held", True, 0.9)
LANDED = replace(FLYING, state=FlightState.LANDED, airborne=False)


def taken(ladder: FailsafeLadder, now_ns: int, view: FailsafeInputs, ok: bool = True) -> list[Effect]:
    effects = ladder.update(now_ns, view)
    if any(isinstance(effect, FailsafeAction) for effect in effects):
        ladder.attempted(ok)
    return effects


def test_silence_makes_it_hover_and_then_land_to_the_nanosecond() -> None:
    ladder = FailsafeLadder()
    assert taken(ladder, T0 + 500 * MS - 1, FLYING) == []
    assert taken(ladder, T0 + 500 * MS, FLYING) == [StepChange(Failsafe.HOVER, "silent"), FailsafeAction(Hover())]
    hovering = replace(FLYING, state=FlightState.HOVERING)
    assert taken(ladder, T0 + 5 * S - 1, hovering) == []
    assert taken(ladder, T0 + 5 * S, hovering) == [StepChange(Failsafe.LAND, "silent"), FailsafeAction(Land())]


@pytest.mark.parametrize("pilot", ["released", "silent", "none"])
def test_the_reason_tells_why_there_is_no_pilot(pilot: str) -> None:
    ladder = FailsafeLadder()
    view = replace(FLYING, pilot=pilot)
    assert taken(ladder, T0 + 499 * MS, view) == []
    assert taken(ladder, T0 + 500 * MS, view) == [StepChange(Failsafe.HOVER, pilot), FailsafeAction(Hover())]


def test_a_dead_connection_makes_it_hover_at_once_and_land_after_the_same_five_seconds() -> None:
    ladder = FailsafeLadder()
    gone = replace(FLYING, pilot="gone")
    assert taken(ladder, T0 + MS, gone) == [StepChange(Failsafe.HOVER, "gone"), FailsafeAction(Hover())]
    gone = replace(gone, state=FlightState.HOVERING)
    assert taken(ladder, T0 + 5 * S - 1, gone) == []
    assert taken(ladder, T0 + 5 * S, gone) == [StepChange(Failsafe.LAND, "gone"), FailsafeAction(Land())]


def test_nothing_happens_on_the_ground() -> None:
    ladder = FailsafeLadder()
    assert taken(ladder, T0 + 100 * S, replace(LANDED, pilot="gone")) == []
    assert ladder.idle


def test_a_fresh_command_ends_a_step() -> None:
    ladder = FailsafeLadder()
    taken(ladder, T0 + S, FLYING)
    assert ladder.fresh_command() == [StepChange(Failsafe.NONE, "fresh command")]
    assert taken(ladder, T0 + S, replace(FLYING, last_command_ns=T0 + S)) == []


def test_signs_of_life_without_a_fresh_command_keep_the_step_but_do_not_land() -> None:
    ladder = FailsafeLadder()
    taken(ladder, T0 + S, FLYING)
    heard = replace(FLYING, state=FlightState.HOVERING, last_command_ns=T0 + 60 * S)
    assert taken(ladder, T0 + 60 * S, heard) == []
    assert ladder.step is Failsafe.HOVER


def test_landing_ends_the_step() -> None:
    ladder = FailsafeLadder()
    taken(ladder, T0 + 6 * S, FLYING)
    assert taken(ladder, T0 + 9 * S, LANDED) == [StepChange(Failsafe.NONE, "landed")]


def test_a_rejected_action_is_retried_at_the_set_pace() -> None:
    ladder = FailsafeLadder(FailsafeSettings(retry_s=0.25))
    view = replace(FLYING, state=FlightState.HOVERING)
    tries = [
        now for now in range(T0, T0 + 2 * S, 20 * MS) if FailsafeAction(Hover()) in taken(ladder, now, view, ok=False)
    ]
    assert tries[0] == T0 + 500 * MS
    assert all(later - earlier == 260 * MS for earlier, later in pairwise(tries))  # next tick
    assert len(tries) == 6


def test_an_accepted_action_is_repeated_only_while_the_state_contradicts_it() -> None:
    ladder = FailsafeLadder()
    taken(ladder, T0 + S, FLYING)
    assert taken(ladder, T0 + S + 100 * MS, FLYING) == []
    assert taken(ladder, T0 + S + 250 * MS, FLYING) == [FailsafeAction(Hover())]
    assert taken(ladder, T0 + 2 * S, replace(FLYING, state=FlightState.HOVERING)) == []


@pytest.mark.parametrize("state", [FlightState.TAKING_OFF, FlightState.LANDING])
def test_hover_never_aborts_a_manoeuvre(state: FlightState) -> None:
    ladder = FailsafeLadder()
    view = replace(FLYING, state=state, pilot="gone")
    assert FailsafeAction(Hover()) not in taken(ladder, T0 + S, view)
    expected = Failsafe.HOVER if state is FlightState.TAKING_OFF else Failsafe.NONE
    assert ladder.step is expected
    up = replace(view, state=FlightState.HOVERING)
    assert FailsafeAction(Hover()) in taken(ladder, T0 + 2 * S, up)


def test_land_aborts_a_take_off() -> None:
    ladder = FailsafeLadder()
    assert FailsafeAction(Land()) in taken(ladder, T0 + 5 * S, replace(FLYING, state=FlightState.TAKING_OFF))


def test_a_low_battery_is_reported_once_and_again_only_after_a_rise() -> None:
    ladder = FailsafeLadder()
    levels = [0.21, 0.19, 0.18, 0.21, 0.19, 0.26, 0.19]
    told = [ladder.update(T0, replace(LANDED, battery=level)) for level in levels]
    assert told == [[], [BatteryLow(0.19)], [], [], [], [], [BatteryLow(0.19)]]


def test_an_empty_battery_lands_and_bars_set_points_until_down() -> None:
    ladder = FailsafeLadder()
    empty = replace(FLYING, battery=0.09)
    assert taken(ladder, T0, empty) == [BatteryLow(0.09), StepChange(Failsafe.LAND, "battery"), FailsafeAction(Land())]
    assert ladder.barred == "battery"
    assert ladder.fresh_command() == []
    assert taken(ladder, T0, replace(empty, battery=0.12, state=FlightState.LANDING)) == []
    assert ladder.barred == "battery"  # it rises when the load falls: that is not a charge
    assert taken(ladder, T0, replace(LANDED, battery=0.12)) == [StepChange(Failsafe.NONE, "landed")]
    assert ladder.barred == ""


def test_an_empty_battery_on_the_ground_bars_a_take_off() -> None:
    ladder = FailsafeLadder()
    ladder.update(T0, replace(LANDED, battery=0.05))
    assert ladder.barred == "battery"
    ladder.update(T0, replace(LANDED, battery=0.95))
    assert ladder.barred == ""


def test_zero_disables_the_battery_steps() -> None:
    ladder = FailsafeLadder(FailsafeSettings(battery_warn=0.0, battery_land=0.0))
    assert taken(ladder, T0, replace(FLYING, battery=0.0)) == []


def test_an_unknown_battery_is_not_low() -> None:
    assert taken(FailsafeLadder(), T0, replace(FLYING, battery=None)) == []


def test_a_lost_vehicle_link_makes_it_hover() -> None:
    ladder = FailsafeLadder()
    assert taken(ladder, T0, replace(FLYING, link_up=False)) == [
        StepChange(Failsafe.HOVER, "vehicle_link"),
        FailsafeAction(Hover()),
    ]


def test_a_change_of_hands_hovers_without_a_step() -> None:
    ladder = FailsafeLadder()
    ladder.hand_over(T0)
    assert not ladder.idle
    assert taken(ladder, T0, FLYING) == [FailsafeAction(Hover())]
    assert ladder.step is Failsafe.NONE
    assert ladder.fresh_command() == []
    assert ladder.idle


def test_a_change_of_hands_does_not_abort_the_ladders_landing() -> None:
    ladder = FailsafeLadder()
    taken(ladder, T0 + 5 * S, FLYING)
    ladder.hand_over(T0 + 5 * S)
    assert taken(ladder, T0 + 6 * S, FLYING) == [FailsafeAction(Land())]


def test_a_requested_landing_continues() -> None:
    ladder = FailsafeLadder()
    ladder.order_landing()
    assert taken(ladder, T0, FLYING) == [StepChange(Failsafe.LAND, "closing"), FailsafeAction(Land())]
    assert ladder.fresh_command() == []
    ladder.update(T0, LANDED)
    assert ladder.barred == "closing"


views = st.builds(
    FailsafeInputs,
    state=st.sampled_from(list(FlightState)),
    airborne=st.booleans(),
    last_command_ns=st.integers(0, 8 * S),
    pilot=st.sampled_from(["held", "released", "silent", "gone", "none"]),
    link_up=st.booleans(),
    battery=st.none() | st.floats(0, 1),
)


@given(st.lists(st.tuples(views, st.integers(0, S), st.booleans(), st.booleans()), max_size=40))
def test_any_history_keeps_the_pace_and_only_escalates(
    history: list[tuple[FailsafeInputs, int, bool, bool]],
) -> None:
    ladder = FailsafeLadder()
    now, last_try, new = 0, -S, True
    for view, later, fresh, ok in history:
        now += later
        if fresh:
            ladder.fresh_command()
        before = ladder.step
        effects = taken(ladder, now, view, ok)
        if not view.airborne:
            assert ladder.step is Failsafe.NONE
            assert not any(isinstance(effect, FailsafeAction) for effect in effects)
        elif before is Failsafe.LAND:
            assert ladder.step is Failsafe.LAND
        new = new or any(isinstance(effect, StepChange) for effect in effects)  # since the last attempt
        for effect in effects:
            if isinstance(effect, FailsafeAction):
                assert new or now - last_try >= S // 4
                last_try, new = now, False
