"""What is said of take-off, landing and emergency, tick by tick."""

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
from skyloop.vehicles.ardrone.setpoints import Condition, SetpointController, StickLimits
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
    """A pilot with the time."""

    setpoints: SetpointController = field(default_factory=SetpointController)
    now_s: float = 1000.0

    def __post_init__(self) -> None:
        self.setpoints.limits = StickLimits(0.2, 0.7, 1.75)

    def take(self, action: AnyAction) -> AnyAction:
        return self.setpoints.apply(action, ns(self.now_s))

    def hears(self, condition: Condition) -> None:
        self.setpoints.on_condition(condition, ns(self.now_s))

    def ref(self) -> Ref | None:
        """At the next tick; without the fixed bits."""
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
def test_before_anything_is_decided_the_drone_goes_on(condition: Condition | None, ref: Ref | None) -> None:
    assert at(condition).ref() == ref


def test_a_drone_that_another_program_flies_is_told_nothing_but_that_we_are_there() -> None:
    cockpit = at(AIR)
    assert cockpit.setpoints.messages(0) == [("COMWDG", ())], "neither REF nor PCMD, which would stop its sticks"
    cockpit.setpoints.apply(Hover(), 0)
    assert {name for name, _ in cockpit.setpoints.messages(0)} == {"REF", "PCMD"}
    cockpit.setpoints.on_condition(GROUND, 1)
    cockpit.setpoints.on_condition(AIR, 2)
    assert cockpit.setpoints.messages(3) == [("COMWDG", ())], "the next flight is not ours because the last one was"


@pytest.mark.parametrize("before", [None, GROUND, AIR, EMERGENCY])
def test_a_drone_that_is_not_heard_and_that_nobody_flies_from_here_is_told_nothing(before: Condition | None) -> None:
    """A hover stops another program's sticks, and after an emergency a landing; it also kept up a lost drone."""
    cockpit = at(before)
    cockpit.setpoints.lost()
    assert cockpit.setpoints.messages(0) == []
    cockpit.take(Hover())
    assert [name for name, _ in cockpit.setpoints.messages(0)] != [], "somebody flies it by now"


def test_a_landing_that_was_given_up_leaves_what_is_not_heard_to_land_by_itself() -> None:
    cockpit = at(AIR)
    cockpit.take(Land())
    cockpit.setpoints.lost()
    assert cockpit.ref() == Ref(0)
    assert cockpit.setpoints.forget_landing()
    assert cockpit.setpoints.messages(0) == []


def test_takeoff_is_said_until_the_drone_flies_and_as_long_as_it_does() -> None:
    cockpit = at(GROUND)
    assert cockpit.take(Takeoff()) == Takeoff()
    assert [cockpit.ref() for _ in range(5)] == [Ref.TAKEOFF] * 5
    cockpit.hears(Condition(State.FLYING, ControlState.TAKING_OFF))
    assert cockpit.ref() == Ref.TAKEOFF
    cockpit.hears(AIR)
    assert cockpit.ref() == Ref.TAKEOFF
    cockpit.hears(LANDING)
    assert cockpit.ref() == Ref(0), "it lands by itself, and is not talked out of it"
    cockpit.hears(GROUND)
    assert cockpit.ref() == Ref(0), "nor made to take off again"


def test_hover_and_set_points_do_not_break_a_takeoff_off() -> None:
    cockpit = at(GROUND)
    cockpit.take(Takeoff())
    cockpit.take(Hover())
    assert cockpit.ref() == Ref.TAKEOFF
    cockpit.take(Attitude(pitch=0.1))
    assert cockpit.ref() == Ref.TAKEOFF


def test_a_takeoff_has_its_time() -> None:
    cockpit = at(GROUND)
    cockpit.take(Takeoff())
    cockpit.now_s += 4.9
    assert cockpit.ref() == Ref.TAKEOFF
    cockpit.now_s += 0.2
    assert cockpit.ref() == Ref(0)
    assert ["did not take off" in notice.text for notice in cockpit.setpoints.pop_events()] == [True]


@pytest.mark.parametrize("condition", [AIR, GROUND, None])
def test_landing_is_said_until_something_else_is_decided(condition: Condition | None) -> None:
    cockpit = at(condition)
    assert cockpit.take(Land()) == Land()
    assert [cockpit.ref() for _ in range(5)] == [Ref(0)] * 5


def test_a_landing_that_withdraws_a_takeoff_is_said_when_the_drone_rises_all_the_same() -> None:
    """What it had heard last of us was the take-off: it was taken for another program's flight, and left to hover."""
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


def test_a_landing_of_ours_can_be_broken_off() -> None:
    cockpit = at(AIR)
    cockpit.take(Land())
    cockpit.hears(LANDING)
    cockpit.take(Hover())
    assert cockpit.ref() == Ref.TAKEOFF
    cockpit.hears(AIR)
    assert cockpit.ref() == Ref.TAKEOFF


@pytest.mark.parametrize("action", [Hover(), Attitude(pitch=0.1)])
@pytest.mark.parametrize("low", [TOUCHING_DOWN, Condition(State.FLYING, ControlState.LANDING)])
def test_a_landing_is_not_broken_off_where_the_drone_touches_down(low: Condition, action: AnyAction) -> None:
    """Navdata are a moment old: the bit reached a drone that stood by then, and it took off again."""
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


def test_a_drone_that_lands_by_itself_after_a_landing_that_was_broken_off_is_left_to_land() -> None:
    """It was told to take off again, on and on, with an empty battery."""
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


def test_a_landing_that_is_broken_off_too_late_for_the_drone_to_hear_it_is_completed() -> None:
    """The bit was sent on until navdata no longer showed it flying, which is later than it stands."""
    cockpit = at(AIR)
    cockpit.take(Land())
    cockpit.hears(LANDING)
    cockpit.take(Hover())
    assert cockpit.ref() == Ref.TAKEOFF
    for condition in (TOUCHING_DOWN, Condition(State.FLYING, ControlState.LANDED, 0.0), GROUND):
        cockpit.hears(condition)
        assert cockpit.ref() == Ref(0)


def test_a_landing_that_was_given_up_and_shows_all_the_same_is_not_broken_off() -> None:
    """The drone was told to take off again as soon as it was heard."""
    cockpit = at(AIR)
    cockpit.take(Land())
    cockpit.hears(LANDING)
    cockpit.setpoints.lost()
    assert cockpit.setpoints.forget_landing()
    assert not cockpit.setpoints.forget_landing()
    for condition in (None, LANDING, AIR):
        if condition is not None:
            cockpit.hears(condition)
        assert cockpit.ref() is None, "it may be somebody else's flight by now"
    cockpit.hears(LANDING)
    cockpit.take(Hover())
    assert cockpit.ref() == Ref.TAKEOFF, "a pilot breaks it off"


def test_set_points_are_said_until_the_next_decision() -> None:
    cockpit = at(AIR)
    assert cockpit.take(Attitude(pitch=0.1, climb=9.0)) == Attitude(pitch=0.1, climb=0.7)
    assert cockpit.pcmd() == cockpit.pcmd() == (1, 0.0, -0.5, 1.0, 0.0)
    assert cockpit.take(Idle()) == Idle()
    assert cockpit.pcmd() == (1, 0.0, -0.5, 1.0, 0.0)
    cockpit.take(Hover())
    assert cockpit.pcmd() == (0, 0.0, 0.0, 0.0, 0.0)


@pytest.mark.parametrize("action", [Land(), Takeoff(), EmergencyStop()])
def test_what_ends_a_set_point(action: AnyAction) -> None:
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
    """It was sent on for as long as nothing was heard, unless somebody thought of a hover."""
    cockpit = at(AIR)
    cockpit.take(Attitude(pitch=0.1))
    cockpit.setpoints.lost()
    assert cockpit.pcmd()[0] == 0


def test_without_limits_it_hovers_and_says_so_once() -> None:
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


def test_the_emergency_bit_is_let_go_when_the_motors_are_cut() -> None:
    cockpit = at(AIR)
    cockpit.take(EmergencyStop())
    assert [cockpit.ref() for _ in range(4)] == [Ref.EMERGENCY] * 4
    cockpit.hears(EMERGENCY)
    assert [cockpit.ref() for _ in range(4)] == [Ref(0)] * 4


def test_an_emergency_stop_of_what_is_stopped_resets_nothing() -> None:
    cockpit = at(EMERGENCY)
    cockpit.take(EmergencyStop())
    assert cockpit.ref() == Ref(0)


def test_an_emergency_stop_is_said_to_a_drone_that_is_not_heard() -> None:
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


def test_no_second_edge_while_nothing_new_is_heard() -> None:
    cockpit = at(AIR)
    cockpit.take(EmergencyStop())
    assert {cockpit.ref() for _ in range(40)} == {Ref.EMERGENCY}


def test_a_stop_pressed_while_the_drone_is_lost_is_not_sent_when_it_is_back_minutes_later() -> None:
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


def test_a_stop_that_has_no_effect_is_given_up_and_the_drone_can_be_landed() -> None:
    cockpit = at(AIR)
    cockpit.take(Hover())
    cockpit.take(EmergencyStop())
    with pytest.raises(DriverError, match="has not shown"):
        cockpit.take(ResetEmergency())
    for _ in range(340):
        cockpit.hears(AIR)
        cockpit.ref()
    assert cockpit.ref() is None
    cockpit.take(Land())
    assert cockpit.ref() == Ref(0)


def test_a_stop_of_a_drone_that_another_program_flies_since_is_still_sent() -> None:
    cockpit = at(AIR)
    cockpit.setpoints.lost()
    cockpit.take(EmergencyStop())
    cockpit.hears(GROUND)
    cockpit.hears(AIR)
    assert cockpit.ref() == Ref.EMERGENCY


def test_a_further_stop_while_a_stopped_drone_is_lost_makes_no_edge_that_would_release_it() -> None:
    cockpit = at(AIR)
    cockpit.take(EmergencyStop())
    cockpit.hears(EMERGENCY)
    assert cockpit.ref() == Ref(0)
    cockpit.setpoints.lost()
    cockpit.take(EmergencyStop())
    assert {cockpit.ref() for _ in range(400)} == {Ref(0)}


@pytest.mark.parametrize("action", [Hover(), Land(), Attitude(pitch=0.1)])
def test_nothing_but_a_reset_takes_an_emergency_stop_back(action: AnyAction) -> None:
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


def test_a_reset_is_not_waited_for_after_the_link_was_lost() -> None:
    cockpit = at(EMERGENCY)
    cockpit.take(ResetEmergency())
    cockpit.setpoints.lost()
    cockpit.hears(EMERGENCY)
    assert cockpit.ref() == Ref(0)


def test_nobody_resets_by_himself() -> None:
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
def test_what_cannot_be_done(condition: Condition | None, action: AnyAction, says: str) -> None:
    cockpit = at(condition)
    with pytest.raises(DriverError, match=says):
        cockpit.take(action)
