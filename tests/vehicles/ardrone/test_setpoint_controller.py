"""The bits for take-off, landing and emergency, tick by tick."""

from __future__ import annotations

from dataclasses import dataclass, field

import pytest

from skyloop.errors import DriverError
from skyloop.messages import (
    AnyAction,
    Attitude,
    EmergencyStop,
    Hover,
    Idle,
    Land,
    ResetEmergency,
    Takeoff,
    Velocity,
)
from skyloop.vehicles.ardrone.setpoints import ArdroneSetpoints, Condition, StickLimits
from skyloop.vehicles.ardrone.wire.at import Ref
from skyloop.vehicles.ardrone.wire.navdata import ControlState, State
from tests.vehicles.ardrone.scripted import ns

GROUND = Condition(State(0), ControlState.LANDED)
AIR = Condition(State.FLYING, ControlState.HOVERING)
LANDING = Condition(State.FLYING, ControlState.LANDING, 1.0)
TOUCHING_DOWN = Condition(State.FLYING, ControlState.LANDING, 0.2)
EMERGENCY = Condition(State.EMERGENCY, ControlState.DEFAULT)
PERIOD_S = 0.03


@dataclass
class Cockpit:
    """A pilot with a clock."""

    setpoints: ArdroneSetpoints = field(default_factory=ArdroneSetpoints)
    now_s: float = 1000.0

    def __post_init__(self) -> None:
        self.setpoints.limits = StickLimits(0.2, 0.7, 1.75)

    def take(self, action: AnyAction) -> AnyAction:
        return self.setpoints.apply(action, ns(self.now_s))

    def hears(self, condition: Condition) -> None:
        self.setpoints.on_condition(condition, ns(self.now_s))

    def ref(self) -> Ref | None:
        """Return the bits of the next tick, without the fixed ones."""
        self.now_s += PERIOD_S
        return next((self._bits(args) for name, args in self.setpoints.messages(ns(self.now_s)) if name == "REF"), None)

    def pcmd(self) -> tuple[object, ...]:
        self.now_s += PERIOD_S
        return self.setpoints.messages(ns(self.now_s))[-1][1]

    @staticmethod
    def _bits(arguments: tuple[object, ...]) -> Ref:
        bits = arguments[0]
        assert isinstance(bits, int)
        assert bits & Ref.FIXED == Ref.FIXED
        return Ref(bits & ~Ref.FIXED)


def at(condition: Condition | None) -> Cockpit:
    cockpit = Cockpit()
    if condition is not None:
        cockpit.hears(condition)
    return cockpit


@pytest.mark.parametrize(
    ("condition", "ref"),
    [(None, None), (GROUND, Ref(0)), (AIR, None), (LANDING, None), (EMERGENCY, Ref(0))],
)
def test_before_any_decision_the_drone_continues(condition: Condition | None, ref: Ref | None) -> None:
    assert at(condition).ref() == ref


def test_a_drone_flown_by_another_program_gets_only_the_watchdogs_answer() -> None:
    cockpit = at(AIR)
    assert cockpit.setpoints.messages(0) == [("COMWDG", ())], "neither REF nor PCMD, which would stop its sticks"
    cockpit.setpoints.apply(Hover(), 0)
    assert {name for name, _ in cockpit.setpoints.messages(0)} == {"REF", "PCMD"}
    cockpit.setpoints.on_condition(GROUND, 1)
    cockpit.setpoints.on_condition(AIR, 2)
    assert cockpit.setpoints.messages(3) == [("COMWDG", ())], "the next flight is not ours because the last one was"


@pytest.mark.parametrize("before", [None, GROUND, AIR, EMERGENCY])
def test_a_silent_drone_that_we_do_not_fly_gets_no_commands(before: Condition | None) -> None:
    """A hover would stop another program's sticks, and after an emergency a landing; it also kept a lost drone up."""
    cockpit = at(before)
    cockpit.setpoints.lost()
    assert cockpit.setpoints.messages(0) == []
    cockpit.take(Hover())
    assert [name for name, _ in cockpit.setpoints.messages(0)] != [], "now we fly it"


def test_a_silent_drone_lands_without_commands_after_an_abandoned_landing() -> None:
    cockpit = at(AIR)
    cockpit.take(Land())
    cockpit.setpoints.lost()
    assert cockpit.ref() == Ref(0)
    assert cockpit.setpoints.forget_landing()
    assert cockpit.setpoints.messages(0) == []


def test_the_takeoff_bit_is_sent_before_and_during_the_flight() -> None:
    cockpit = at(GROUND)
    assert cockpit.take(Takeoff()) == Takeoff()
    assert [cockpit.ref() for _ in range(5)] == [Ref.TAKEOFF] * 5
    cockpit.hears(Condition(State.FLYING, ControlState.TAKING_OFF))
    assert cockpit.ref() == Ref.TAKEOFF
    cockpit.hears(AIR)
    assert cockpit.ref() == Ref.TAKEOFF
    cockpit.hears(LANDING)
    assert cockpit.ref() == Ref(0), "its own landing is not aborted"
    cockpit.hears(GROUND)
    assert cockpit.ref() == Ref(0), "nor followed by a take-off"


def test_hover_and_set_points_do_not_abort_a_takeoff() -> None:
    cockpit = at(GROUND)
    cockpit.take(Takeoff())
    cockpit.take(Hover())
    assert cockpit.ref() == Ref.TAKEOFF
    cockpit.take(Attitude(pitch=0.1))
    assert cockpit.ref() == Ref.TAKEOFF


def test_a_takeoff_has_a_time_limit() -> None:
    cockpit = at(GROUND)
    cockpit.take(Takeoff())
    cockpit.now_s += 4.9
    assert cockpit.ref() == Ref.TAKEOFF
    cockpit.now_s += 0.2
    assert cockpit.ref() == Ref(0)
    assert ["did not take off" in notice.text for notice in cockpit.setpoints.pop_events()] == [True]


@pytest.mark.parametrize("condition", [AIR, GROUND, None])
def test_a_landing_is_sent_until_the_next_decision(condition: Condition | None) -> None:
    cockpit = at(condition)
    assert cockpit.take(Land()) == Land()
    assert [cockpit.ref() for _ in range(5)] == [Ref(0)] * 5


def test_a_landing_that_withdraws_a_takeoff_is_sent_if_the_drone_still_rises() -> None:
    """Its last command was the take-off. The rise once counted as another program's flight and was left hovering."""
    cockpit = at(GROUND)
    cockpit.take(Takeoff())
    assert cockpit.ref() == Ref.TAKEOFF
    cockpit.take(Land())
    cockpit.hears(GROUND)
    assert cockpit.ref() == Ref(0)
    cockpit.now_s += 0.5
    cockpit.hears(AIR)
    assert cockpit.ref() == Ref(0)
    cockpit.hears(LANDING)
    assert cockpit.ref() == Ref(0)
    cockpit.now_s += 5.0
    cockpit.hears(GROUND)
    cockpit.hears(AIR)
    assert cockpit.ref() is None, "another program flies it"


def test_our_own_landing_can_be_aborted() -> None:
    cockpit = at(AIR)
    cockpit.take(Land())
    cockpit.hears(LANDING)
    cockpit.take(Hover())
    assert cockpit.ref() == Ref.TAKEOFF
    cockpit.hears(AIR)
    assert cockpit.ref() == Ref.TAKEOFF


@pytest.mark.parametrize("action", [Hover(), Attitude(pitch=0.1)])
@pytest.mark.parametrize("low", [TOUCHING_DOWN, Condition(State.FLYING, ControlState.LANDING)])
def test_a_landing_is_not_aborted_at_touchdown(low: Condition, action: AnyAction) -> None:
    """Navdata is slightly old: the bit once reached a landed drone, which took off again."""
    cockpit = at(AIR)
    cockpit.take(Land())
    cockpit.hears(low)
    cockpit.take(action)
    assert cockpit.ref() == Ref(0)
    assert cockpit.pcmd()[0] == 0
    for condition in (Condition(State.FLYING, ControlState.LANDED, 0.0), GROUND):
        cockpit.hears(condition)
        cockpit.take(action)
        assert cockpit.ref() == Ref(0)


def test_a_drones_own_landing_after_an_aborted_one_is_not_aborted() -> None:
    """It was once repeatedly commanded to take off again, with an empty battery."""
    cockpit = at(AIR)
    cockpit.take(Land())
    cockpit.hears(LANDING)
    cockpit.take(Hover())
    assert cockpit.ref() == Ref.TAKEOFF
    cockpit.hears(AIR)
    cockpit.take(Attitude(pitch=0.1))
    assert cockpit.ref() == Ref.TAKEOFF
    cockpit.hears(LANDING)
    assert cockpit.ref() == Ref(0)


def test_a_landing_aborted_too_late_is_completed() -> None:
    """The bit was sent until navdata no longer showed a flight, which is after the touchdown."""
    cockpit = at(AIR)
    cockpit.take(Land())
    cockpit.hears(LANDING)
    cockpit.take(Hover())
    assert cockpit.ref() == Ref.TAKEOFF
    for condition in (TOUCHING_DOWN, Condition(State.FLYING, ControlState.LANDED, 0.0), GROUND):
        cockpit.hears(condition)
        assert cockpit.ref() == Ref(0)


def test_an_abandoned_landing_that_still_happens_is_not_aborted() -> None:
    """The drone was once commanded to take off again with its first navdata."""
    cockpit = at(AIR)
    cockpit.take(Land())
    cockpit.hears(LANDING)
    cockpit.setpoints.lost()
    assert cockpit.setpoints.forget_landing()
    assert not cockpit.setpoints.forget_landing()
    for condition in (None, LANDING, AIR):
        if condition is not None:
            cockpit.hears(condition)
        assert cockpit.ref() is None, "another program may fly it by now"
    cockpit.hears(LANDING)
    cockpit.take(Hover())
    assert cockpit.ref() == Ref.TAKEOFF, "a pilot aborts it"


def test_set_points_are_sent_until_the_next_decision() -> None:
    cockpit = at(AIR)
    assert cockpit.take(Attitude(pitch=0.1, climb=9.0)) == Attitude(pitch=0.1, climb=0.7)
    assert cockpit.pcmd() == cockpit.pcmd() == (1, 0.0, -0.5, 1.0, 0.0)
    assert cockpit.take(Idle()) == Idle()
    assert cockpit.pcmd() == (1, 0.0, -0.5, 1.0, 0.0)
    cockpit.take(Hover())
    assert cockpit.pcmd() == (0, 0.0, 0.0, 0.0, 0.0)


@pytest.mark.parametrize("action", [Land(), Takeoff(), EmergencyStop()])
def test_actions_that_end_a_set_point(action: AnyAction) -> None:
    cockpit = at(AIR)
    cockpit.take(Attitude(pitch=0.1))
    cockpit.take(action)
    assert cockpit.pcmd()[0] == 0


def test_a_set_point_does_not_outlive_the_flight() -> None:
    cockpit = at(AIR)
    cockpit.take(Attitude(pitch=0.1))
    cockpit.hears(GROUND)
    assert cockpit.pcmd()[0] == 0


def test_a_set_point_does_not_outlive_the_link() -> None:
    """It was once sent for as long as the drone was silent, unless an application sent a hover."""
    cockpit = at(AIR)
    cockpit.take(Attitude(pitch=0.1))
    cockpit.setpoints.lost()
    assert cockpit.pcmd()[0] == 0


def test_without_limits_it_hovers_with_one_warning() -> None:
    cockpit = at(AIR)
    cockpit.setpoints.limits = None
    for _ in range(3):
        assert cockpit.take(Attitude(pitch=0.1)) == Hover()
    assert cockpit.pcmd()[0] == 0
    assert len(cockpit.setpoints.pop_events()) == 1


def test_absolute_control() -> None:
    cockpit = at(AIR)
    cockpit.setpoints.reference_rad = 0.0
    cockpit.take(Attitude(pitch=0.1))
    assert cockpit.pcmd()[0] == 5
    cockpit.take(Hover())
    assert cockpit.setpoints.messages(0)[-1][0] == "PCMD", "hovering needs no heading"


# Emergency -------------------------------------------------------------------------------------------------------


def test_the_emergency_bit_is_cleared_when_the_motors_are_cut() -> None:
    cockpit = at(AIR)
    cockpit.take(EmergencyStop())
    assert [cockpit.ref() for _ in range(4)] == [Ref.EMERGENCY] * 4
    cockpit.hears(EMERGENCY)
    assert [cockpit.ref() for _ in range(4)] == [Ref(0)] * 4


def test_an_emergency_stop_of_stopped_motors_resets_nothing() -> None:
    cockpit = at(EMERGENCY)
    cockpit.take(EmergencyStop())
    assert cockpit.ref() == Ref(0)


def test_an_emergency_stop_is_sent_to_a_silent_drone() -> None:
    cockpit = at(AIR)
    cockpit.setpoints.lost()
    cockpit.take(EmergencyStop())
    assert {cockpit.ref() for _ in range(100)} == {Ref.EMERGENCY}, "without a second edge, which might reset it"


def test_an_emergency_stop_without_effect_gets_a_new_edge() -> None:
    cockpit = at(AIR)
    cockpit.take(EmergencyStop())
    said = []
    for _ in range(40):
        said.append(cockpit.ref())
        cockpit.hears(AIR)
    assert said.count(Ref(0)) == 2
    assert said[0] == said[-1] == Ref.EMERGENCY


def test_no_second_edge_without_new_navdata() -> None:
    cockpit = at(AIR)
    cockpit.take(EmergencyStop())
    assert {cockpit.ref() for _ in range(40)} == {Ref.EMERGENCY}


def test_a_stop_of_a_lost_drone_is_not_sent_minutes_later() -> None:
    cockpit = at(AIR)
    cockpit.take(Hover())
    cockpit.setpoints.lost()
    cockpit.take(EmergencyStop())
    said = [cockpit.ref() for _ in range(400)]
    assert said.count(Ref.EMERGENCY) == pytest.approx(10.0 / PERIOD_S, abs=2)
    assert Ref.EMERGENCY not in said[340:]
    (event,) = cockpit.setpoints.pop_events()
    assert event.data["reason"] == "stop_given_up"
    cockpit.now_s += 600.0
    cockpit.hears(GROUND)
    assert cockpit.ref() == Ref(0)
    assert cockpit.take(ResetEmergency()) == ResetEmergency()
    cockpit.hears(GROUND)
    cockpit.hears(AIR)
    assert cockpit.ref() is None, "another program flies it"
    cockpit.take(Land())
    assert cockpit.ref() == Ref(0)


def test_a_stop_without_effect_is_abandoned_and_the_drone_can_land() -> None:
    cockpit = at(AIR)
    cockpit.take(Hover())
    cockpit.take(EmergencyStop())
    with pytest.raises(DriverError, match="is not confirmed"):
        cockpit.take(ResetEmergency())
    for _ in range(340):
        cockpit.hears(AIR)
        cockpit.ref()
    assert cockpit.ref() is None
    cockpit.take(Land())
    assert cockpit.ref() == Ref(0)


def test_a_stop_is_sent_even_if_another_program_now_flies_the_drone() -> None:
    cockpit = at(AIR)
    cockpit.setpoints.lost()
    cockpit.take(EmergencyStop())
    cockpit.hears(GROUND)
    cockpit.hears(AIR)
    assert cockpit.ref() == Ref.EMERGENCY


def test_another_stop_of_a_lost_stopped_drone_makes_no_releasing_edge() -> None:
    cockpit = at(AIR)
    cockpit.take(EmergencyStop())
    cockpit.hears(EMERGENCY)
    assert cockpit.ref() == Ref(0)
    cockpit.setpoints.lost()
    cockpit.take(EmergencyStop())
    assert {cockpit.ref() for _ in range(400)} == {Ref(0)}


@pytest.mark.parametrize("action", [Hover(), Land(), Attitude(pitch=0.1)])
def test_only_a_reset_ends_an_emergency_stop(action: AnyAction) -> None:
    cockpit = at(AIR)
    cockpit.take(EmergencyStop())
    cockpit.take(action)
    assert cockpit.ref() == Ref.EMERGENCY


def test_reset_toggles_until_it_shows() -> None:
    cockpit = at(EMERGENCY)
    cockpit.take(ResetEmergency())
    assert cockpit.ref() == Ref.EMERGENCY
    cockpit.hears(GROUND)
    assert cockpit.ref() == Ref(0)


def test_reset_without_an_emergency_cuts_no_motors() -> None:
    cockpit = at(GROUND)
    cockpit.take(ResetEmergency())
    assert cockpit.ref() == Ref(0)


def test_a_link_loss_cancels_a_reset() -> None:
    cockpit = at(EMERGENCY)
    cockpit.take(ResetEmergency())
    cockpit.setpoints.lost()
    cockpit.hears(EMERGENCY)
    assert cockpit.ref() == Ref(0)


def test_no_reset_without_a_request() -> None:
    cockpit = at(AIR)
    cockpit.take(Attitude(pitch=0.1))
    for _ in range(50):
        cockpit.hears(EMERGENCY)
        assert cockpit.ref() == Ref(0)


@pytest.mark.parametrize(
    ("condition", "action", "says"),
    [
        (None, Takeoff(), "no data from"),
        (EMERGENCY, Takeoff(), "reset it first"),
        (None, ResetEmergency(), "no data from"),
        (AIR, Velocity(), "does not support velocity"),
    ],
)
def test_impossible_actions(condition: Condition | None, action: AnyAction, says: str) -> None:
    cockpit = at(condition)
    with pytest.raises(DriverError, match=says):
        cockpit.take(action)
