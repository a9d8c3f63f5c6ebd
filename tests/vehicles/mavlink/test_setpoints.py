"""Messages to the vehicle for decisions and reports, on a manual clock."""

from __future__ import annotations

import math
from contextlib import suppress
from itertools import pairwise

import pytest

from skyloop.errors import DriverError
from skyloop.messages import (
    Attitude,
    EmergencyStop,
    FlightState,
    Hover,
    Idle,
    Land,
    LinkState,
    Position,
    ResetEmergency,
    Takeoff,
    Velocity,
)
from skyloop.vehicles.mavlink.wire.axes import angles_of, from_wire
from skyloop.vehicles.mavlink.wire.codec import Landed, Message, chunks_of
from tests.vehicles.mavlink.scripted import ARDUPILOT, PX4, Bench, Vehicle

ARM, MODE, TAKEOFF = 400, 176, 22
FORCE = 21196.0
CUT = (ARM, 0.0, FORCE, 0.0, 0.0)
AUTOPILOTS = pytest.mark.parametrize("autopilot", [ARDUPILOT, PX4])
GUIDED = {ARDUPILOT: "GUIDED", PX4: "OFFBOARD"}
HOLD = {ARDUPILOT: ("BRAKE", (MODE, 1.0, 17.0, 0.0, 0.0)), PX4: ("AUTO.LOITER", (MODE, 1.0, 4.0, 3.0, 0.0))}
LAND = {ARDUPILOT: ("LAND", (MODE, 1.0, 9.0, 0.0, 0.0)), PX4: ("AUTO.LAND", (MODE, 1.0, 4.0, 6.0, 0.0))}
SET_POINT = "SET_POSITION_TARGET_LOCAL_NED"


def steering(autopilot: int, action: Velocity | Attitude | Position = Velocity(forward=1.0)) -> Bench:  # noqa: B008  immutable
    """Return a bench flown by set-points."""
    bench = Bench(Vehicle(autopilot)).flying(GUIDED[autopilot])
    bench.apply(action)
    bench.go_on(1.2)
    bench.said.clear()
    return bench


# Taking off ------------------------------------------------------------------------------------------------------


def test_arducopter_is_guided_armed_and_gets_a_relative_altitude() -> None:
    bench = Bench(Vehicle(ARDUPILOT)).found()
    vehicle = bench.vehicle
    bench.apply(Takeoff())
    assert bench.commands() == [(MODE, 1.0, 4.0, 0.0, 0.0)]
    vehicle.mode = "GUIDED"
    bench.hear(vehicle.heartbeat())
    bench.tick()
    assert bench.commands() == [(ARM, 1.0, 0.0, 0.0, 0.0)]
    bench.answer(ARM)
    bench.tick()  # the heartbeat reports it a second later
    assert bench.commands() == [(TAKEOFF, 0.0, 0.0, 0.0, 1.5)]
    assert bench.session.setpoints is not None
    bench.answer(TAKEOFF)
    vehicle.armed, vehicle.status, vehicle.landed = True, 4, Landed.IN_AIR
    bench.go_on(0.5)
    vehicle.place = (0.0, 0.0, -0.8)
    assert bench.apply(Velocity(forward=1.0)) == Idle(), "a set-point would cancel it"
    bench.go_on(1.0)
    assert bench.state() is FlightState.TAKING_OFF
    assert bench.heard_of(SET_POINT) == []
    vehicle.place = (0.0, 0.0, -1.4)
    bench.go_on(0.1)
    assert bench.state() is FlightState.HOVERING
    assert bench.heard_of(SET_POINT)


def test_px4_holds_is_armed_and_gets_an_altitude_above_sea_level() -> None:
    bench = Bench(Vehicle(PX4)).found()
    vehicle = bench.vehicle
    vehicle.mode = "OFFBOARD"  # left over from an earlier flight: it can't be armed in this mode
    bench.hear(vehicle.heartbeat())
    bench.apply(Takeoff())
    assert bench.commands() == [HOLD[PX4][1]]
    vehicle.mode = "AUTO.LOITER"
    bench.hear(vehicle.heartbeat())
    bench.tick()
    assert bench.commands() == [(ARM, 1.0, 0.0, 0.0, 0.0)]
    bench.answer(ARM)
    bench.tick()
    (said,) = bench.heard_of("COMMAND_LONG")
    assert (said.command, said.param7) == (TAKEOFF, pytest.approx(489.5))
    assert math.isnan(said.param4)
    assert math.isnan(said.param5)
    assert math.isnan(said.param6)
    vehicle.armed, vehicle.status, vehicle.mode, vehicle.landed = True, 4, "AUTO.TAKEOFF", Landed.TAKING_OFF
    vehicle.place = (0.0, 0.0, -1.0)
    bench.go_on(1.2)
    assert bench.state() is FlightState.TAKING_OFF
    vehicle.mode, vehicle.landed = "AUTO.LOITER", Landed.IN_AIR
    bench.hear(vehicle.heartbeat())
    bench.commands()
    bench.go_on(0.1)
    assert bench.commands() == [(MODE, 1.0, 6.0, 0.0, 0.0)], "set-points are flowing already: it enters at once"
    vehicle.mode = "OFFBOARD"
    bench.go_on(0.1)
    assert bench.state() is FlightState.HOVERING


def test_a_px4_whose_take_off_ends_below_its_height_is_still_flown_from_here() -> None:
    """A real one ends at 0.7 of 1.5 m (NAV_MC_ALT_RAD). It was left to others, and so to the failsafes."""
    bench = about_to_rise(PX4)
    vehicle = bench.vehicle
    vehicle.status, vehicle.mode, vehicle.landed, vehicle.place = 4, "AUTO.TAKEOFF", Landed.IN_AIR, (0.0, 0.0, -0.6)
    bench.go_on(1.2)
    vehicle.mode, vehicle.place, vehicle.amsl_m = "AUTO.LOITER", (0.0, 0.0, -0.3), vehicle.amsl_m + 0.4  # moved home
    bench.go_on(0.9)
    vehicle.mode = "OFFBOARD"
    bench.go_on(0.3)
    assert bench.state() is FlightState.HOVERING
    assert [text for text in bench.texts if "not chosen here" in text] == []


def just_landed(autopilot: int) -> Bench:
    """Return a bench on the ground after our landing, still armed."""
    bench = Bench(Vehicle(autopilot)).flying(GUIDED[autopilot])
    vehicle = bench.vehicle
    bench.apply(Hover())
    bench.go_on(1.2)
    bench.apply(Land())
    vehicle.mode, vehicle.landed, vehicle.place = LAND[autopilot][0], Landed.ON_GROUND, (0.0, 0.0, 0.0)
    bench.go_on(0.3)
    return bench


@AUTOPILOTS
def test_a_take_off_right_after_a_landing_arms_again_after_that_landing_disarms(autopilot: int) -> None:
    """It was reported as "disarmed itself" 2.5 s later: messages before a request prove nothing about it."""
    bench = just_landed(autopilot)
    vehicle = bench.vehicle
    assert bench.state() is FlightState.LANDED
    bench.apply(Takeoff())
    bench.go_on(0.3)
    assert bench.state() is FlightState.LANDED, "it is armed from the previous flight"
    bench.commands()
    vehicle.armed, vehicle.mode = False, {ARDUPILOT: "GUIDED", PX4: "AUTO.LOITER"}[autopilot]
    bench.go_on(0.3)
    assert (ARM, 1.0, 0.0, 0.0, 0.0) in bench.commands()
    bench.answer(ARM)
    bench.go_on(0.1)
    assert bench.state() is FlightState.TAKING_OFF


@AUTOPILOTS
def test_the_answer_to_disarming_after_a_landing_does_not_count_for_arming(autopilot: int) -> None:
    """Both commands have one number. A real PX4 was never armed, and reported as "disarmed itself" 2.5 s later."""
    bench = just_landed(autopilot)
    vehicle = bench.vehicle
    bench.apply(Takeoff())
    bench.answer(ARM)  # to the earlier disarm command, delayed
    bench.go_on(0.2)
    vehicle.armed = False
    bench.go_on(0.2)
    vehicle.mode = {ARDUPILOT: "GUIDED", PX4: "AUTO.LOITER"}[autopilot]
    bench.go_on(0.2)
    assert (ARM, 1.0, 0.0, 0.0, 0.0) in bench.commands()


@AUTOPILOTS
def test_a_vehicle_killed_in_a_take_off_right_after_a_landing_is_not_armed_again(autopilot: int) -> None:
    """The previous landing is over by then: another operator's switch did it, and a person may walk up to it."""
    bench = just_landed(autopilot)
    vehicle = bench.vehicle
    bench.apply(Takeoff())
    bench.go_on(0.2)
    vehicle.mode = {ARDUPILOT: "GUIDED", PX4: "AUTO.TAKEOFF"}[autopilot]
    bench.go_on(1.0)
    bench.answer(TAKEOFF)
    bench.go_on(0.2 if autopilot == ARDUPILOT else 1.5)  # one accepts it only while armed, the other soon disarms
    assert bench.state() is FlightState.TAKING_OFF
    bench.commands()
    vehicle.armed, vehicle.mode = False, {ARDUPILOT: "GUIDED", PX4: "AUTO.LOITER"}[autopilot]
    bench.go_on(4.0)
    assert (ARM, 1.0, 0.0, 0.0, 0.0) not in bench.commands()
    assert bench.state() is FlightState.LANDED


@AUTOPILOTS
def test_a_vehicle_armed_and_disarmed_by_others_is_not_armed_from_here(autopilot: int) -> None:
    """By a pilot's switch, during a take-off that has not left the ground."""
    bench = Bench(Vehicle(autopilot)).found()
    vehicle = bench.vehicle
    vehicle.armed, vehicle.mode = True, {ARDUPILOT: "GUIDED", PX4: "AUTO.LOITER"}[autopilot]
    bench.go_on(0.3)
    bench.apply(Takeoff())
    bench.go_on(0.3)
    vehicle.armed = False
    bench.commands()
    bench.go_on(4.0)
    assert ARM not in [command[0] for command in bench.commands()]
    assert bench.state() is FlightState.LANDED


def about_to_rise(autopilot: int) -> Bench:
    """Return a bench armed for a take-off, still on the ground."""
    bench = Bench(Vehicle(autopilot)).found()
    vehicle = bench.vehicle
    vehicle.mode = {ARDUPILOT: "GUIDED", PX4: "AUTO.LOITER"}[autopilot]
    bench.hear(vehicle.heartbeat())
    bench.apply(Takeoff())
    bench.answer(ARM)
    vehicle.armed, vehicle.status = True, 3
    vehicle.mode = {ARDUPILOT: "GUIDED", PX4: "AUTO.TAKEOFF"}[autopilot]
    bench.go_on(0.3)
    assert bench.state() is FlightState.TAKING_OFF
    return bench


@AUTOPILOTS
def test_a_pilot_who_takes_the_vehicle_before_it_is_armed_keeps_it(autopilot: int) -> None:
    """The mode was requested again, and the vehicle was armed and took off."""
    bench = Bench(Vehicle(autopilot)).found()
    vehicle = bench.vehicle
    vehicle.mode = {ARDUPILOT: "GUIDED", PX4: "AUTO.LOITER"}[autopilot]
    bench.hear(vehicle.heartbeat())
    bench.apply(Takeoff())
    bench.tick()
    assert (ARM, 1.0, 0.0, 0.0, 0.0) in bench.commands()
    vehicle.mode = other_mode(autopilot, "sticks")
    bench.hear(vehicle.heartbeat())
    bench.said.clear()
    bench.go_on(3.0)
    with pytest.raises(DriverError, match="not chosen here"):
        bench.apply(Takeoff(), new=False)
    bench.go_on(1.0)
    assert bench.commands() == []
    bench.apply(Takeoff())
    bench.go_on(0.1)
    assert bench.commands()


@AUTOPILOTS
def test_a_pilot_who_takes_the_vehicle_before_its_heartbeat_shows_the_arming_keeps_it(autopilot: int) -> None:
    """A PX4 reports it once a second: sticks moved in that second were answered by a take-off."""
    bench = Bench(Vehicle(autopilot)).found()
    vehicle = bench.vehicle
    vehicle.mode = {ARDUPILOT: "GUIDED", PX4: "AUTO.LOITER"}[autopilot]
    bench.hear(vehicle.heartbeat())
    bench.apply(Takeoff())
    bench.answer(ARM)
    bench.tick()
    vehicle.armed, vehicle.status, vehicle.mode = True, 4, other_mode(autopilot, "sticks")
    bench.hear(vehicle.heartbeat())
    bench.said.clear()
    bench.go_on(3.0)
    assert bench.commands() == []
    assert any("not chosen here" in text for text in bench.texts)


@AUTOPILOTS
def test_a_hover_ends_a_take_offs_climb(autopilot: int) -> None:
    """A cancelled takeoff() left it climbing to the end."""
    bench = climbing(autopilot)
    bench.apply(Hover())
    bench.go_on(1.5)
    assert bench.heard_of(SET_POINT)
    if autopilot == PX4:
        assert (MODE, 1.0, 6.0, 0.0, 0.0) in bench.commands()


@AUTOPILOTS
def test_a_hover_before_lift_off_disarms_it_and_a_failsafes_lets_it_take_off(autopilot: int) -> None:
    bench = about_to_rise(autopilot)
    bench.apply(Hover(), alone=True)
    bench.go_on(0.3)
    assert (ARM, 0.0, 0.0, 0.0, 0.0) not in bench.commands()
    bench.apply(Hover())
    bench.go_on(1.2)
    assert (ARM, 0.0, 0.0, 0.0, 0.0) in bench.commands()


@AUTOPILOTS
def test_a_refusal_is_reported_in_the_vehicles_words_and_retried(autopilot: int) -> None:
    bench = Bench(Vehicle(autopilot)).found()
    bench.vehicle.mode = {ARDUPILOT: "GUIDED", PX4: "AUTO.LOITER"}[autopilot]
    bench.hear(bench.vehicle.heartbeat())
    bench.apply(Takeoff())
    for chunk in chunks_of("Arm: Gyros inconsistent", 2, 1):
        bench.hear(chunk)
    bench.answer(ARM, 4)
    bench.tick()
    with pytest.raises(DriverError, match="arming was failed: Arm: Gyros inconsistent"):
        bench.apply(Takeoff())
    bench.commands()
    bench.go_on(2.1)
    assert [command[0] for command in bench.commands()] == [ARM, ARM]


@AUTOPILOTS
def test_a_take_off_that_is_no_longer_requested_is_given_up(autopilot: int) -> None:
    """The pilot may be gone: a vehicle that becomes ready later must not start."""
    bench = Bench(Vehicle(autopilot)).found()
    bench.apply(Takeoff())
    bench.go_on(7.0)
    assert any("did not take off" in text for text in bench.texts)
    bench.commands()
    bench.go_on(3.0)
    assert bench.commands() == []


@AUTOPILOTS
def test_a_landing_ends_a_take_off_on_the_ground_by_disarming(autopilot: int) -> None:
    bench = Bench(Vehicle(autopilot)).found()
    bench.apply(Takeoff())
    bench.vehicle.armed = True
    bench.go_on(0.2)
    bench.apply(Land())
    bench.commands()
    bench.go_on(0.6)
    assert (ARM, 0.0, 0.0, 0.0, 0.0) in bench.commands()
    bench.vehicle.armed = False
    bench.go_on(0.3)
    bench.commands()
    bench.go_on(1.0)
    assert bench.commands() == []


def test_a_vehicle_slow_to_leave_the_ground_gets_time() -> None:
    """A real ArduCopter, 4.5 s after it was armed by its clock, which was slow: it was disarmed just before."""
    bench = Bench(Vehicle(ARDUPILOT)).found()
    bench.apply(Takeoff())
    bench.vehicle.mode = "GUIDED"
    bench.go_on(0.3)
    bench.answer(ARM)
    bench.vehicle.armed = True
    bench.go_on(10.0)
    bench.apply(Takeoff(), new=False)
    assert (ARM, 0.0, 0.0, 0.0, 0.0) not in bench.commands()
    bench.vehicle.status, bench.vehicle.landed, bench.vehicle.place = 4, Landed.IN_AIR, (0.0, 0.0, -1.5)
    bench.go_on(0.5)
    assert bench.state() is FlightState.HOVERING


def test_a_cancelled_climb_continues_by_a_position() -> None:
    bench = Bench(Vehicle(ARDUPILOT)).found()
    vehicle = bench.vehicle
    bench.apply(Takeoff())
    vehicle.armed, vehicle.mode, vehicle.status, vehicle.landed = True, "GUIDED", 4, Landed.IN_AIR
    vehicle.place = (0.0, 0.0, -0.7)  # another operator's set-point stopped it here
    bench.go_on(5.0)
    assert bench.heard_of(SET_POINT) == []
    bench.go_on(3.0)
    said = bench.heard_of(SET_POINT)[-1]
    assert (said.coordinate_frame, said.type_mask, said.z) == (1, 0xDF8, pytest.approx(-1.5, abs=0.01))


def test_an_operator_who_takes_over_during_the_climb_keeps_it() -> None:
    bench = Bench(Vehicle(PX4)).found()
    vehicle = bench.vehicle
    bench.apply(Takeoff())
    vehicle.armed, vehicle.mode, vehicle.status, vehicle.landed = True, "AUTO.TAKEOFF", 4, Landed.TAKING_OFF
    bench.answer(ARM)
    bench.go_on(1.0)
    vehicle.mode = "POSCTL"
    bench.go_on(1.0)
    assert any("changed to POSCTL" in text for text in bench.texts)
    bench.said.clear()
    bench.go_on(1.0)
    assert (bench.commands(), bench.heard_of(SET_POINT)) == ([], [])


def test_a_climb_that_ends_a_little_low_still_ends() -> None:
    bench = Bench(Vehicle(ARDUPILOT)).found()
    vehicle = bench.vehicle
    bench.apply(Takeoff())
    vehicle.armed, vehicle.mode, vehicle.status, vehicle.landed = True, "GUIDED", 4, Landed.IN_AIR
    vehicle.place = (0.0, 0.0, -1.2)
    bench.go_on(7.0)
    assert bench.state() is FlightState.TAKING_OFF
    bench.go_on(7.0)
    assert bench.state() is FlightState.HOVERING


def test_it_does_not_take_off_while_silent() -> None:
    bench = Bench(Vehicle(ARDUPILOT))
    with pytest.raises(DriverError, match="no data from"):
        bench.apply(Takeoff())


# Set-points ------------------------------------------------------------------------------------------------------


@AUTOPILOTS
def test_velocity_is_streamed_in_body_axes(autopilot: int) -> None:
    bench = steering(autopilot, Velocity(forward=1.0, left=0.5, up=0.2, yaw_rate=0.3))
    bench.go_on(1.0)
    said = bench.heard_of(SET_POINT)
    assert 24 <= len(said) <= 26
    assert {(each.coordinate_frame, each.type_mask) for each in said} == {(8, 0x5C7)}
    newest = said[-1]
    assert (newest.vx, newest.vy, newest.vz) == pytest.approx((1.0, -0.5, -0.2))
    assert newest.yaw_rate == pytest.approx(-0.3)
    assert bench.state() is FlightState.FLYING


def test_a_new_velocity_is_sent_at_once() -> None:
    bench = steering(ARDUPILOT)
    bench.clock.advance(0.01)
    bench.apply(Velocity(forward=0.4))
    assert [each.vx for each in bench.heard_of(SET_POINT)] == [pytest.approx(0.4)]


def test_px4_gets_set_points_for_a_second_before_it_follows_them() -> None:
    bench = Bench(Vehicle(PX4)).flying("AUTO.LOITER")
    bench.apply(Velocity(forward=1.0))
    bench.go_on(0.9)
    assert bench.commands() == []
    assert len(bench.heard_of(SET_POINT)) >= 20
    bench.go_on(0.3)
    assert bench.commands() == [(MODE, 1.0, 6.0, 0.0, 0.0)]
    bench.go_on(1.2)
    assert len(bench.commands()) == 2, "accepted or not, until the mode shows"


@AUTOPILOTS
def test_set_points_have_no_effect_on_the_ground(autopilot: int) -> None:
    bench = Bench(Vehicle(autopilot)).found()
    assert bench.apply(Velocity(up=1.0)) == Idle()
    assert bench.apply(Hover()) == Hover()
    bench.go_on(1.5)
    assert bench.commands() == []
    assert bench.heard_of(SET_POINT) == []


@pytest.mark.parametrize(("climb", "thrust"), [(0.0, 0.5), (1.25, 0.75), (9.0, 1.0), (-0.75, 0.25), (-9.0, 0.0)])
def test_arducopters_thrust_is_a_climb_rate(climb: float, thrust: float) -> None:
    bench = steering(ARDUPILOT, Attitude(roll=0.1, pitch=0.2, climb=climb))
    bench.go_on(0.1)
    said = bench.heard_of("SET_ATTITUDE_TARGET")[-1]
    assert said.type_mask == 7
    assert said.thrust == pytest.approx(thrust)
    roll, pitch, _ = angles_of(from_wire(said.q))
    assert (roll, pitch) == pytest.approx((0.1, -0.2), abs=1e-5)


def test_a_climb_beyond_arducopters_limit_is_not_reported_as_applied() -> None:
    bench = Bench(Vehicle(ARDUPILOT)).flying("GUIDED")
    applied = bench.apply(Attitude(climb=9.0))
    assert isinstance(applied, Attitude)
    assert applied.climb == 2.5


def test_px4s_thrust_is_a_force_that_holds_the_climb_rate() -> None:
    bench = steering(PX4, Attitude(climb=0.0))
    bench.go_on(0.1)
    assert bench.heard_of("SET_ATTITUDE_TARGET")[-1].thrust == pytest.approx(0.5, abs=0.01)
    bench.vehicle.velocity = (0.0, 0.0, 0.5)  # it sinks
    bench.go_on(0.2)
    first = bench.heard_of("SET_ATTITUDE_TARGET")[-1].thrust
    bench.go_on(1.0)
    later = bench.heard_of("SET_ATTITUDE_TARGET")[-1].thrust
    assert 0.5 < first < later < 0.7
    bench.apply(Attitude(climb=-0.5))
    bench.go_on(0.1)
    assert bench.heard_of("SET_ATTITUDE_TARGET")[-1].thrust < later


def test_a_leaning_px4_gets_more_thrust() -> None:
    bench = steering(PX4, Attitude(pitch=0.5))
    bench.go_on(0.1)
    assert bench.heard_of("SET_ATTITUDE_TARGET")[-1].thrust == pytest.approx(0.5 / math.cos(0.5), abs=0.01)


@AUTOPILOTS
def test_a_yaw_rate_beside_an_attitude_turns_the_requested_heading(autopilot: int) -> None:
    bench = steering(autopilot, Attitude(yaw_rate=0.5))
    bench.go_on(3.0)
    _, _, yaw = angles_of(from_wire(bench.heard_of("SET_ATTITUDE_TARGET")[-1].q))
    assert yaw == pytest.approx(-0.5), "counter-clockwise, and no further ahead than half a radian"


# Hovering --------------------------------------------------------------------------------------------------------


@AUTOPILOTS
def test_hovering_stops_then_holds_the_position(autopilot: int) -> None:
    bench = steering(autopilot)
    bench.vehicle.velocity = (1.0, 0.0, 0.0)
    bench.go_on(0.1)
    bench.apply(Hover())
    bench.go_on(0.3)
    assert {each.type_mask for each in bench.heard_of(SET_POINT)[1:]} == {0x5C7}
    bench.vehicle.velocity, bench.vehicle.place = (0.0, 0.0, 0.0), (4.0, 5.0, -3.0)
    bench.go_on(0.3)
    said = bench.heard_of(SET_POINT)[-1]
    assert (said.type_mask, said.x, said.y, said.z) == (0xDF8, 4.0, 5.0, -3.0)
    assert bench.state() is FlightState.HOVERING


@AUTOPILOTS
def test_without_a_pilot_it_holds_in_its_own_mode_and_the_stream_ends(autopilot: int) -> None:
    bench = steering(autopilot)
    bench.apply(Hover(), alone=True)
    mode, order = HOLD[autopilot]
    bench.go_on(0.4)
    assert set(bench.commands()) == {order}
    assert {each.vx for each in bench.heard_of(SET_POINT)} <= {0.0}
    bench.vehicle.mode = mode
    bench.go_on(0.3)
    bench.said.clear()
    bench.go_on(2.0)
    assert bench.heard_of(SET_POINT) == []
    assert bench.commands() == []
    assert bench.state() is FlightState.HOVERING


@AUTOPILOTS
def test_a_landing_is_confirmed_by_the_mode_not_the_acknowledgement(autopilot: int) -> None:
    bench = steering(autopilot)
    mode, order = LAND[autopilot]
    bench.apply(Land(), alone=True)
    bench.answer(MODE)
    bench.go_on(1.2)
    assert bench.commands() == [order] * 3
    assert bench.heard_of(SET_POINT) == []
    bench.vehicle.mode = mode
    bench.go_on(1.0)
    assert bench.commands() == []
    assert bench.state() is FlightState.LANDING
    bench.vehicle.landed = Landed.ON_GROUND
    bench.go_on(0.1)
    assert bench.state() is FlightState.LANDED


# Other operators ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("autopilot", "mode"), [(ARDUPILOT, "LOITER"), (PX4, "POSCTL")])
def test_an_operator_who_takes_the_vehicle_over_keeps_it(autopilot: int, mode: str) -> None:
    bench = steering(autopilot)
    bench.vehicle.mode = mode
    bench.go_on(1.0)
    bench.said.clear()
    with pytest.raises(DriverError, match=f"in {mode}, which was not chosen here"):
        bench.apply(Velocity(forward=1.0))
    assert bench.apply(Hover(), alone=True) == Idle()
    assert bench.apply(Land(), alone=True) == Idle()
    bench.go_on(2.0)
    assert bench.commands() == []
    assert bench.heard_of(SET_POINT) == []
    assert bench.state() is FlightState.FLYING
    bench.apply(Hover())
    bench.go_on(1.2)
    assert bench.commands(), "a new decision takes it back"


@AUTOPILOTS
@pytest.mark.parametrize("alone", [False, True])
def test_an_operator_who_holds_a_landing_vehicle_keeps_it(autopilot: int, alone: bool) -> None:
    """A person stands below, and another station stops it. Each repeat of the landing took it back."""
    bench = steering(autopilot)
    bench.apply(Land())
    bench.vehicle.mode = LAND[autopilot][0]
    bench.go_on(4.0)
    bench.vehicle.mode = HOLD[autopilot][0]
    bench.commands()
    for _ in range(20):
        bench.go_on(0.1)
        with suppress(DriverError):
            bench.apply(Land(), alone=alone, new=False)
    assert bench.commands() == []
    assert bench.session.setpoints is not None
    assert bench.session.setpoints.ownership.others == HOLD[autopilot][0]
    bench.go_on(0.6)
    bench.apply(Land())
    bench.go_on(0.1)
    assert bench.commands() == [LAND[autopilot][1]], "a new decision takes it back"


@AUTOPILOTS
def test_our_landing_is_requested_again_if_the_vehicle_is_found_holding(autopilot: int) -> None:
    """Its own actions during a silence are not a pilot's decision."""
    bench = steering(autopilot)
    bench.apply(Land())
    bench.vehicle.mode = LAND[autopilot][0]
    bench.go_on(4.0)
    bench.go_on(2.6, silent=True)
    bench.vehicle.mode = HOLD[autopilot][0]
    bench.commands()
    bench.go_on(1.0)
    assert LAND[autopilot][1] in bench.commands()


@AUTOPILOTS
def test_a_late_mode_of_our_own_is_not_another_operators(autopilot: int) -> None:
    """A pilot is back while the failsafe's mode is still on its way: the guided mode is requested again."""
    bench = steering(autopilot)
    bench.apply(Hover(), alone=True)
    bench.apply(Velocity(forward=0.5))
    bench.go_on(0.3)
    bench.vehicle.mode = HOLD[autopilot][0]
    bench.commands()
    bench.go_on(1.5)
    guided = {ARDUPILOT: (MODE, 1.0, 4.0, 0.0, 0.0), PX4: (MODE, 1.0, 6.0, 0.0, 0.0)}[autopilot]
    assert set(bench.commands()) == {guided}
    bench.vehicle.mode = GUIDED[autopilot]
    bench.go_on(0.3)
    assert bench.state() is FlightState.FLYING
    bench.apply(Velocity(forward=0.5))


def test_repeated_hovers_do_not_take_the_vehicle_back() -> None:
    bench = steering(PX4)
    for _ in range(50):
        bench.apply(Hover())
        bench.go_on(0.02)
    bench.vehicle.mode = "POSCTL"
    refused = 0
    for _ in range(60):
        try:
            bench.apply(Hover())
        except DriverError:
            refused += 1
        bench.go_on(0.02)
    assert refused > 20
    assert (MODE, 1.0, 6.0, 0.0, 0.0) not in bench.commands()


def test_a_failsafe_that_leaves_a_px4_to_absent_sticks_ends_in_hold() -> None:
    bench = steering(PX4)
    bench.vehicle.mode, bench.vehicle.status = "POSCTL", 5
    bench.go_on(1.0)
    assert HOLD[PX4][1] in bench.commands(), "without a remote control it would sink"
    assert bench.heard_of(SET_POINT)[-1].vx == 1.0, "sent before it was seen"
    bench.go_on(1.0)
    assert bench.heard_of(SET_POINT) == []


@AUTOPILOTS
def test_a_restored_link_flies_nothing_old(autopilot: int) -> None:
    bench = steering(autopilot)
    bench.go_on(3.0, silent=True)
    bench.said.clear()
    bench.hear(bench.vehicle.heartbeat())
    bench.go_on(0.5)
    assert {each.vx for each in bench.heard_of(SET_POINT)} <= {0.0}
    assert set(bench.commands()) == {HOLD[autopilot][1]}


@AUTOPILOTS
def test_a_vehicle_found_again_in_the_air_is_not_landed_before_it_reports_that(autopilot: int) -> None:
    """Heartbeat and attitude arrive first, without the landed state; a hold given up here would be missed."""
    bench = steering(autopilot)
    bench.go_on(4.0, silent=True)
    bench.said.clear()
    bench.sink.feedbacks.clear()
    for _ in range(20):
        bench.clock.advance(0.02)
        bench.vehicle.boot_ms += 20
        bench.hear(bench.vehicle.heartbeat(), bench.vehicle.telemetry()[-1])
        bench.tick()
    assert {each.state for each in bench.sink.feedbacks} == {FlightState.UNKNOWN}
    assert set(bench.commands()) == {HOLD[autopilot][1]}
    bench.go_on(0.5)
    assert bench.state() in (FlightState.FLYING, FlightState.HOVERING)
    assert set(bench.commands()) == {HOLD[autopilot][1]}


@AUTOPILOTS
def test_a_vehicle_found_again_low_above_the_ground_has_not_landed_before_it_reports_that(autopilot: int) -> None:
    """A real PX4's position arrived before its landed state: ``land()`` returned 3.6 s too early."""
    bench = steering(autopilot)
    bench.apply(Land())
    bench.vehicle.mode = LAND[autopilot][0]
    bench.go_on(1.0)
    bench.go_on(4.0, silent=True)
    bench.vehicle.place = (0.0, 0.0, -0.2)
    bench.said.clear()
    bench.sink.feedbacks.clear()
    for _ in range(20):
        bench.clock.advance(0.02)
        bench.vehicle.boot_ms += 20
        bench.hear(bench.vehicle.heartbeat(), bench.vehicle.telemetry()[0], bench.vehicle.telemetry()[-1])
        bench.tick()
    assert {each.state for each in bench.sink.feedbacks} == {FlightState.UNKNOWN}
    assert (ARM, 0.0, 0.0, 0.0, 0.0) not in bench.commands()
    bench.vehicle.landed = Landed.ON_GROUND
    bench.go_on(0.5)
    assert (ARM, 0.0, 0.0, 0.0, 0.0) in bench.commands()


@AUTOPILOTS
def test_an_armed_vehicle_that_reports_no_landed_state(autopilot: int) -> None:
    bench = Bench(Vehicle(autopilot))
    bench.vehicle.armed = True
    bench.hear(bench.vehicle.heartbeat())
    assert bench.state() is FlightState.UNKNOWN
    with pytest.raises(DriverError, match="has not reported yet whether it is in the air"):
        bench.apply(Takeoff())
    assert bench.apply(Velocity(forward=1.0)) == Idle()
    bench.go_on(2.0, silent=True)
    assert bench.heard_of(SET_POINT) == []
    bench.apply(Land())
    bench.hear(bench.vehicle.heartbeat())
    bench.tick()
    assert LAND[autopilot][1] in bench.commands(), "a landing does not disarm a vehicle that may fly"


@AUTOPILOTS
@pytest.mark.parametrize("mode", ["sticks", "RTL", "LAND"])
@pytest.mark.parametrize("action", [Hover(), Land()])
def test_a_vehicle_flown_by_others_is_neither_held_nor_landed(autopilot: int, mode: str, action: Hover | Land) -> None:
    """The proxy's ladder requests both, as for a vehicle found in the air."""
    bench = Bench(Vehicle(autopilot)).flying(other_mode(autopilot, mode))
    for _ in range(10):
        assert bench.apply(action, alone=True) == Idle()
        bench.go_on(0.3)
    assert bench.commands() == []
    assert bench.heard_of(SET_POINT) == []
    assert bench.session.setpoints is not None
    assert bench.session.setpoints.ownership.others == other_mode(autopilot, mode)
    assert [text for text in bench.texts if "not chosen here" in text] != []


@AUTOPILOTS
@pytest.mark.parametrize("mode", ["sticks", "RTL", "LAND"])
def test_a_mode_chosen_by_others_while_the_vehicle_holds_is_kept(autopilot: int, mode: str) -> None:
    """The ladder held it, without a stream: the other operator's choice must still be seen."""
    bench = steering(autopilot)
    bench.apply(Hover(), alone=True)
    bench.vehicle.mode = HOLD[autopilot][0]
    bench.go_on(1.0)
    bench.commands()
    bench.vehicle.mode = other_mode(autopilot, mode)
    bench.go_on(1.0)
    assert bench.apply(Hover(), alone=True) == Idle()
    assert bench.apply(Land(), alone=True) == Idle()
    bench.go_on(1.0)
    assert bench.commands() == []
    assert any("not chosen here" in text for text in bench.texts)


@AUTOPILOTS
def test_a_mode_chosen_by_others_while_the_link_was_lost_is_kept(autopilot: int) -> None:
    bench = steering(autopilot)
    bench.go_on(4.0, silent=True)
    bench.apply(Hover(), alone=True)
    bench.vehicle.mode = other_mode(autopilot, "RTL")
    bench.said.clear()
    bench.go_on(3.0)
    assert bench.apply(Hover(), alone=True) == Idle()
    bench.go_on(1.0)
    assert bench.commands() == []
    assert bench.heard_of(SET_POINT) == []


@AUTOPILOTS
@pytest.mark.parametrize("action", [Takeoff(), Hover(), Land()])
def test_a_repeat_never_takes_the_vehicle_back_but_a_new_action_does(
    autopilot: int, action: Takeoff | Hover | Land
) -> None:
    bench = steering(autopilot)
    bench.vehicle.mode = other_mode(autopilot, "RTL")
    bench.go_on(1.0)
    bench.commands()
    for _ in range(20):
        with pytest.raises(DriverError, match="which was not chosen here"):
            bench.apply(action, new=False)
        bench.go_on(0.1)
    assert bench.commands() == []
    bench.apply(action)
    bench.go_on(1.2)
    assert bench.commands() != []
    assert bench.session.setpoints is not None
    assert bench.session.setpoints.ownership.others == ""


@AUTOPILOTS
def test_another_stations_landing_during_a_take_off_is_kept(autopilot: int) -> None:
    bench = climbing(autopilot)
    bench.vehicle.mode = other_mode(autopilot, "LAND")
    bench.go_on(1.0)
    bench.commands()
    for hover in (Takeoff(), Hover()):  # for the proxy, a take-off in flight is a hover
        for _ in range(10):
            with pytest.raises(DriverError, match="which was not chosen here"):
                bench.apply(hover, new=False)
            bench.go_on(0.1)
    assert bench.commands() == []
    assert bench.heard_of(SET_POINT) == []


@AUTOPILOTS
@pytest.mark.parametrize("reached", [True, False])
def test_an_operator_who_lands_it_as_a_take_off_ends_keeps_it(autopilot: int, reached: bool) -> None:
    """It was in the previous landing's mode, and taken from the other station within 0.3 s."""
    bench = climbing(autopilot, stands_in=LAND[autopilot][0])
    vehicle = bench.vehicle
    if reached:
        vehicle.place, vehicle.mode = (0.0, 0.0, -1.4), {ARDUPILOT: "GUIDED", PX4: "AUTO.LOITER"}[autopilot]
        bench.go_on(0.02)
        bench.commands()
    vehicle.mode = LAND[autopilot][0]
    bench.go_on(0.02)
    vehicle.place = (0.0, 0.0, -1.4)
    bench.go_on(1.2)
    assert bench.commands() == []
    assert bench.session.setpoints is not None
    assert bench.session.setpoints.ownership.others == LAND[autopilot][0]


def test_an_operator_who_stops_a_px4s_climb_keeps_it() -> None:
    """By the mode for position hold, in which a take-off also ends, at its height."""
    bench = climbing(PX4)
    bench.vehicle.mode = "AUTO.LOITER"
    bench.go_on(1.2)
    assert (MODE, 1.0, 6.0, 0.0, 0.0) not in bench.commands()
    assert bench.session.setpoints is not None
    assert bench.session.setpoints.ownership.others == "AUTO.LOITER"


@AUTOPILOTS
def test_a_mode_chosen_by_others_before_lift_off_is_kept(autopilot: int) -> None:
    bench = Bench(Vehicle(autopilot)).found()
    vehicle = bench.vehicle
    vehicle.mode = {ARDUPILOT: "GUIDED", PX4: "AUTO.LOITER"}[autopilot]
    bench.go_on(0.3)
    bench.apply(Takeoff())
    bench.answer(ARM)
    vehicle.armed, vehicle.status = True, 4
    bench.go_on(0.5)
    vehicle.mode = other_mode(autopilot, "sticks")
    bench.hear(vehicle.heartbeat())
    bench.commands()
    bench.go_on(4.0)
    assert bench.commands() == []
    assert any("not chosen here" in text for text in bench.texts)


def test_a_vehicle_armed_by_others_is_not_disarmed_after_a_failed_take_off() -> None:
    bench = Bench(Vehicle(ARDUPILOT))
    bench.vehicle.armed, bench.vehicle.mode = True, "GUIDED"
    bench.found()
    bench.apply(Takeoff())
    bench.go_on(20.0)
    assert any("did not take off" in text for text in bench.texts)
    assert (ARM, 0.0, 0.0, 0.0, 0.0) not in bench.commands()


def test_a_failsafe_that_hands_a_px4_to_a_remote_control_is_accepted() -> None:
    bench = steering(PX4)
    bench.vehicle.remote = True
    bench.go_on(0.2)
    bench.vehicle.mode, bench.vehicle.status = "POSCTL", 5
    bench.go_on(1.5)
    assert bench.commands() == []
    assert bench.apply(Land(), alone=True) == Idle()


def climbing(autopilot: int, stands_in: str = "") -> Bench:
    """Return a bench taking off to 1.5 m, 0.4 m high. ``stands_in``: its mode when the take-off was requested."""
    bench = Bench(Vehicle(autopilot)).found()
    vehicle = bench.vehicle
    arming = {ARDUPILOT: "GUIDED", PX4: "AUTO.LOITER"}[autopilot]
    vehicle.mode = stands_in or arming
    bench.go_on(0.3)
    bench.apply(Takeoff())
    vehicle.mode = arming
    bench.go_on(0.1)
    bench.answer(ARM)
    vehicle.armed, vehicle.status = True, 4
    bench.go_on(0.3)
    vehicle.landed, vehicle.place = Landed.IN_AIR, (0.0, 0.0, -0.4)
    vehicle.mode = {ARDUPILOT: "GUIDED", PX4: "AUTO.TAKEOFF"}[autopilot]
    bench.go_on(0.5)
    assert bench.state() is FlightState.TAKING_OFF
    bench.said.clear()
    return bench


def other_mode(autopilot: int, mode: str) -> str:
    copter = {"sticks": "LOITER"}
    px4 = {"sticks": "POSCTL", "RTL": "AUTO.RTL", "LAND": "AUTO.LAND"}
    return (copter if autopilot == ARDUPILOT else px4).get(mode, mode)


# Motors ------------------------------------------------------------------------------------------------------------


@AUTOPILOTS
def test_an_emergency_stop_disarms_by_force_until_it_shows(autopilot: int) -> None:
    bench = steering(autopilot)
    bench.apply(EmergencyStop())
    bench.go_on(0.5)
    assert set(bench.commands()) == {(ARM, 0.0, FORCE, 0.0, 0.0)}
    assert bench.state() is FlightState.HOVERING, "it is reported as flying while it flies"
    with pytest.raises(DriverError, match="still armed"):
        bench.apply(ResetEmergency())
    bench.vehicle.armed, bench.vehicle.landed = False, Landed.ON_GROUND
    bench.go_on(0.3)
    bench.said.clear()
    with pytest.raises(DriverError, match="reset it first"):
        bench.apply(Takeoff())
    bench.apply(Hover())
    bench.go_on(1.0)
    assert bench.commands() == []
    assert bench.state() is FlightState.EMERGENCY
    bench.apply(ResetEmergency())
    bench.go_on(0.1)
    assert bench.state() is FlightState.LANDED


@AUTOPILOTS
def test_a_failed_stop_can_be_pressed_again_and_expires(autopilot: int) -> None:
    """The autopilot refuses, or the link was lost: the vehicle is armed long after the first press."""
    bench = steering(autopilot)
    bench.apply(EmergencyStop())
    bench.go_on(11.0)
    bench.said.clear()
    bench.go_on(1.0)
    assert bench.commands() == [], "an old press has expired"
    bench.apply(EmergencyStop())
    bench.go_on(0.5)
    assert set(bench.commands()) == {(ARM, 0.0, FORCE, 0.0, 0.0)}
    with pytest.raises(DriverError, match="still armed"):
        bench.apply(ResetEmergency())
    bench.go_on(11.0)
    bench.apply(ResetEmergency())
    bench.said.clear()
    bench.apply(Land())
    bench.go_on(0.5)
    assert LAND[autopilot][1] in bench.commands()


@AUTOPILOTS
def test_a_stop_right_after_arming_is_sent_at_once_and_survives_a_quick_reset(autopilot: int) -> None:
    """The heartbeat that shows the arming arrives up to a second later: don't wait for it."""
    bench = arming(autopilot)
    bench.vehicle.armed = True
    bench.answer(ARM)
    bench.commands()
    bench.apply(EmergencyStop())
    assert bench.commands() == [CUT], "before any heartbeat shows it as armed"
    for _ in range(2):  # a delayed one reports that it is not armed
        bench.clock.advance(0.1)
        bench.hear(stale_heartbeat(bench))
        bench.tick()
        with pytest.raises(DriverError, match="is not confirmed"):
            bench.apply(ResetEmergency())
    bench.go_on(1.0)
    assert bench.commands().count(CUT) in (10, 11, 12), "ten times a second until it shows"
    bench.vehicle.armed = False
    bench.go_on(0.5)
    bench.commands()
    bench.go_on(1.0)
    assert bench.commands() == []
    bench.apply(ResetEmergency())
    bench.go_on(0.1)
    assert bench.state() is FlightState.LANDED


@AUTOPILOTS
def test_a_landing_during_arming_disarms_a_late_arming(autopilot: int) -> None:
    """Neither an acknowledgement nor a heartbeat has shown the arming: it must not stay armed on the ground."""
    bench = arming(autopilot)
    bench.apply(Land())
    bench.apply(Land())
    bench.vehicle.armed = True
    bench.answer(ARM)
    bench.go_on(0.6)
    assert bench.state() is FlightState.LANDING
    assert set(bench.commands()) == {(ARM, 0.0, 0.0, 0.0, 0.0)}
    bench.vehicle.armed = False
    bench.go_on(0.3)
    assert bench.state() is FlightState.LANDED
    bench.commands()
    bench.go_on(3.0)
    assert bench.commands() == []


@AUTOPILOTS
@pytest.mark.parametrize("alone", [False, True])
def test_a_hover_after_that_landing_still_disarms_a_late_arming(autopilot: int, alone: bool) -> None:
    """A pilot who hovers and lands at once, or a failsafe after a withdrawn take-off: nothing disarmed it."""
    bench = Bench(Vehicle(autopilot)).found()
    bench.vehicle.mode = {ARDUPILOT: "GUIDED", PX4: "AUTO.LOITER"}[autopilot]
    bench.hear(bench.vehicle.heartbeat())
    bench.apply(Takeoff())
    bench.go_on(0.1)
    assert (ARM, 1.0, 0.0, 0.0, 0.0) in bench.commands()
    bench.apply(Land())
    bench.go_on(0.1)
    bench.apply(Hover(), alone=alone)
    bench.commands()
    bench.vehicle.armed = True
    bench.go_on(1.0)
    assert (ARM, 0.0, 0.0, 0.0, 0.0) in bench.commands()
    bench.vehicle.armed = False
    bench.go_on(0.5)
    assert bench.state() is FlightState.LANDED


@AUTOPILOTS
def test_an_arming_that_shows_after_its_take_off_failed_is_undone(autopilot: int) -> None:
    """Its acknowledgement was lost, and a PX4's heartbeat arrives once a second."""
    bench = arming(autopilot)
    while not any("does not answer" in text for text in bench.texts):
        bench.go_on(0.02)
        assert bench.clock() < 60_000_000_000
    bench.commands()
    bench.vehicle.armed = True
    bench.go_on(1.0)
    assert (ARM, 0.0, 0.0, 0.0, 0.0) in bench.commands()
    bench.vehicle.armed = False
    bench.go_on(0.5)
    assert bench.state() is FlightState.LANDED


@AUTOPILOTS
@pytest.mark.parametrize("held", [False, True])
@pytest.mark.parametrize("acknowledged", [False, True])
def test_a_vehicle_armed_by_a_take_off_that_a_lost_link_cut_off_is_disarmed(
    autopilot: int, acknowledged: bool, held: bool
) -> None:
    """Its propellers turned until it disarmed itself 10 s later, though the take-off was no longer wanted."""
    bench = arming(autopilot)
    bench.vehicle.armed = True
    if acknowledged:
        bench.answer(ARM)
    bench.go_on(3.0, silent=True)
    if held:  # as the proxy requests, unsure whether it flies
        bench.apply(Hover(), alone=True)
        bench.go_on(0.5, silent=True)
    bench.commands()
    bench.hear(bench.vehicle.heartbeat())
    bench.tick()
    bench.vehicle.mode = {ARDUPILOT: "BRAKE", PX4: "AUTO.LOITER"}[autopilot] if held else bench.vehicle.mode
    bench.go_on(1.0)
    assert (ARM, 0.0, 0.0, 0.0, 0.0) in bench.commands()
    bench.vehicle.armed = False
    bench.go_on(1.0)
    bench.commands()
    bench.go_on(3.0)
    assert bench.commands() == []


@AUTOPILOTS
@pytest.mark.parametrize("switched", [True, False])
def test_an_operator_who_flies_it_right_after_a_failed_take_off_keeps_it(autopilot: int, switched: bool) -> None:
    """A safety pilot took over a vehicle that had not started, and got landings twice a second all flight long."""
    bench = arming(autopilot)
    while not any("does not answer" in text for text in bench.texts):
        bench.go_on(0.02)
    bench.go_on(0.3)
    bench.commands()
    vehicle = bench.vehicle
    vehicle.armed = True
    if switched:
        vehicle.mode = {ARDUPILOT: "STABILIZE", PX4: "POSCTL"}[autopilot]
    bench.go_on(0.5)
    assert bool(bench.commands()) is not switched, "only in that mode may it be our own late arming"
    vehicle.landed, vehicle.place, vehicle.status = Landed.IN_AIR, (0.0, 0.0, -1.0), 4
    bench.go_on(3.0)
    assert bench.commands() == []


@AUTOPILOTS
def test_a_landing_before_an_arming_that_never_shows_ends_soon(autopilot: int) -> None:
    bench = arming(autopilot)
    bench.apply(Land())
    bench.go_on(3.0)
    assert bench.state() is FlightState.LANDED
    bench.commands()
    bench.go_on(1.0)
    assert bench.commands() == []


@AUTOPILOTS
def test_a_stop_that_never_shows_expires_and_the_vehicle_can_be_landed(autopilot: int) -> None:
    """The link is lost when it is pressed, and returns after it expired: it reports flying, and lands."""
    bench = steering(autopilot)
    bench.go_on(3.0, silent=True)
    assert bench.link() is LinkState.LOST
    bench.apply(EmergencyStop())
    assert bench.commands() == [CUT], "it may receive us although it is not received"
    bench.go_on(9.0, silent=True)
    assert len(bench.commands()) > 80
    bench.go_on(3.0, silent=True)
    assert any("stop has ended" in text and "land it" in text for text in bench.texts)
    bench.commands()
    bench.go_on(1.0)
    assert bench.state() in (FlightState.HOVERING, FlightState.FLYING)
    assert bench.commands() == [] or CUT not in bench.commands()
    bench.apply(Land(), alone=True)
    bench.go_on(0.5)
    assert LAND[autopilot][1] in bench.commands(), "a failsafe lands it"


@AUTOPILOTS
def test_a_stop_shows_while_it_is_repeated(autopilot: int) -> None:
    """The library repeats it until it shows: the repeats must not delay that."""
    bench = steering(autopilot)
    bench.apply(EmergencyStop())
    bench.vehicle.armed, bench.vehicle.landed = False, Landed.ON_GROUND
    for _ in range(40):
        bench.go_on(0.04)
        bench.apply(EmergencyStop(), new=False)
    assert bench.state() is FlightState.EMERGENCY


@AUTOPILOTS
def test_a_stopped_vehicle_that_others_arm_again_is_reported_flying(autopilot: int) -> None:
    bench = steering(autopilot)
    bench.apply(EmergencyStop())
    bench.vehicle.armed, bench.vehicle.landed = False, Landed.ON_GROUND
    bench.go_on(12.0)
    assert bench.state() is FlightState.EMERGENCY
    bench.vehicle.armed, bench.vehicle.landed, bench.vehicle.mode = True, Landed.IN_AIR, other_mode(autopilot, "sticks")
    bench.commands()
    bench.go_on(0.5)
    assert CUT not in bench.commands()
    assert bench.state() is FlightState.FLYING
    assert any("started its motors again" in text for text in bench.texts)


def arming(autopilot: int) -> Bench:
    """Return a bench asked to arm for a take-off, without effect so far."""
    bench = Bench(Vehicle(autopilot))
    bench.vehicle.mode = {ARDUPILOT: "GUIDED", PX4: "AUTO.LOITER"}[autopilot]
    bench.found()
    bench.apply(Takeoff())
    bench.tick()
    assert (ARM, 1.0, 0.0, 0.0, 0.0) in bench.commands()
    return bench


def stale_heartbeat(bench: Bench) -> Message:
    """Return its last heartbeat from before the arming."""
    bench.vehicle.armed = False
    message = bench.vehicle.heartbeat()
    bench.vehicle.armed = True
    return message


# Positions -------------------------------------------------------------------------------------------------------


def follows(bench: Bench, seconds: float) -> list[Message]:
    """Make the vehicle be where it was sent 0.1 s before."""
    said: list[Message] = []
    for _ in range(round(seconds / 0.1)):
        bench.go_on(0.1)
        said += bench.heard_of(SET_POINT)
        newest = said[-1]
        bench.vehicle.place, bench.vehicle.yaw = (newest.x, newest.y, newest.z), newest.yaw
    return said


@AUTOPILOTS
def test_a_position_is_sent_in_the_vehicles_axes_step_by_step(autopilot: int) -> None:
    bench = Bench(Vehicle(autopilot)).flying(GUIDED[autopilot])
    bench.vehicle.place, bench.vehicle.yaw = (1.0, 2.0, -3.0), 0.0
    bench.go_on(0.1)
    asked = Position(2.0, 4.0, 3.5, math.pi / 2 - 0.6, 0.8, 0.5)  # east, north, up; counter-clockwise from east
    assert bench.apply(asked) == asked
    said = follows(bench, 9.0)
    assert bench.state() is FlightState.FLYING
    assert {(each.coordinate_frame, each.type_mask) for each in said} == {(1, 0x9F8)}
    first, last = said[0], said[-1]
    assert (first.x, first.y, first.z) == pytest.approx((1.0, 2.0, -3.0), abs=0.05), "it starts at the vehicle"
    assert (last.x, last.y, last.z) == pytest.approx((4.0, 2.0, -3.5), abs=1e-3), "north, east, down"
    assert last.yaw == pytest.approx(0.6, abs=1e-3), "clockwise from north"
    steps = [math.dist((a.x, a.y, a.z), (b.x, b.y, b.z)) for a, b in pairwise(said)]
    assert max(steps) <= 0.8 * 0.05, "no faster than requested, at 25 Hz"
    assert max(abs(b.yaw - a.yaw) for a, b in pairwise(said)) <= 0.5 * 0.05
    assert steps[-1] < 1e-3
    assert max(steps[:3]) < max(steps), "it starts slowly"


@AUTOPILOTS
def test_without_a_yaw_the_heading_is_kept(autopilot: int) -> None:
    bench = Bench(Vehicle(autopilot)).flying(GUIDED[autopilot])
    bench.vehicle.yaw = 1.2
    bench.go_on(0.1)
    bench.apply(Position(3.0, 0.0, 3.0))
    assert {round(each.yaw, 3) for each in follows(bench, 2.0)} == {1.2}
    bench.apply(Position(3.0, 0.0, 3.0, math.pi / 2))
    follows(bench, 4.0)
    bench.apply(Position(1.0, 0.0, 3.0))
    assert {round(each.yaw, 2) for each in follows(bench, 1.0)} == {0.0}


def test_the_sent_position_waits_for_a_vehicle_that_does_not_follow() -> None:
    bench = Bench(Vehicle(ARDUPILOT)).flying("GUIDED")
    bench.apply(Position(0.0, 50.0, 3.0, speed=2.0))
    bench.go_on(10.0)
    said = bench.heard_of(SET_POINT)
    assert max(each.x for each in said) == pytest.approx(3.0, abs=0.01), "at most 1.5 s ahead"


def test_a_path_starts_only_in_the_mode_that_follows_it() -> None:
    bench = Bench(Vehicle(PX4)).flying("AUTO.LOITER")
    bench.apply(Position(0.0, 5.0, 3.0))
    bench.go_on(1.5)
    assert {each.x for each in bench.heard_of(SET_POINT)} == {0.0}
    bench.vehicle.mode = "OFFBOARD"
    bench.go_on(1.0)
    assert bench.heard_of(SET_POINT)[-1].x > 0.2


@AUTOPILOTS
def test_it_stops_when_its_position_is_lost(autopilot: int) -> None:
    bench = steering(autopilot, Position(0.0, 5.0, 3.0))
    bench.go_on(0.2)
    bench.said.clear()
    bench.vehicle.knows_place = False
    bench.go_on(1.5)
    said = bench.heard_of(SET_POINT)[-1]
    assert (said.type_mask, said.vx, said.vy, said.vz) == (0x5C7, 0.0, 0.0, 0.0)


@AUTOPILOTS
def test_a_position_has_no_effect_on_the_ground(autopilot: int) -> None:
    bench = Bench(Vehicle(autopilot)).found()
    assert bench.apply(Position(0.0, 0.0, 2.0)) == Idle()
    bench.go_on(1.5)
    assert (bench.commands(), bench.heard_of(SET_POINT)) == ([], [])


@AUTOPILOTS
def test_an_operator_who_takes_it_over_on_the_way_keeps_it(autopilot: int) -> None:
    bench = steering(autopilot, Position(0.0, 5.0, 3.0))
    bench.vehicle.mode = LAND[autopilot][0]
    bench.go_on(1.0)
    bench.said.clear()
    for new in (True, False):
        with pytest.raises(DriverError, match="was not chosen here"):
            bench.apply(Position(0.0, 5.0, 3.0), new=new)
    bench.go_on(1.0)
    assert (bench.commands(), bench.heard_of(SET_POINT)) == ([], [])


@AUTOPILOTS
def test_a_hover_and_a_failsafe_end_the_flight_to_a_position(autopilot: int) -> None:
    bench = steering(autopilot, Position(0.0, 5.0, 3.0))
    bench.apply(Hover())
    bench.go_on(0.5)
    assert {each.type_mask for each in bench.heard_of(SET_POINT)[1:]} <= {0x5C7, 0xDF8}
    bench.apply(Position(0.0, 5.0, 3.0))
    bench.go_on(0.2)
    bench.said.clear()
    bench.apply(Hover(), alone=True)
    bench.go_on(0.4)
    assert set(bench.commands()) == {HOLD[autopilot][1]}
    assert {each.type_mask for each in bench.heard_of(SET_POINT)} <= {0x5C7}


@AUTOPILOTS
def test_a_vehicle_found_armed_on_the_ground_gets_no_velocity_before_it_reports_landed(autopilot: int) -> None:
    """After a hover an upward velocity was sent, and OFFBOARD requested, without a take-off."""
    bench = Bench(Vehicle(autopilot)).found()
    vehicle = bench.vehicle
    vehicle.mode = {ARDUPILOT: "GUIDED", PX4: "AUTO.LOITER"}[autopilot]
    vehicle.armed, vehicle.status, vehicle.landed = True, 4, Landed.ON_GROUND
    bench.go_on(1.0)
    bench.go_on(6.0, silent=True)
    bench.said.clear()
    for action in (None, Hover(), Velocity(0.0, 0.0, 0.5)):
        for step in range(100):
            bench.clock.advance(0.02)
            vehicle.boot_ms += 20
            told = [each for each in vehicle.telemetry() if each.get_type() != "EXTENDED_SYS_STATE"]
            bench.hear(*([vehicle.heartbeat()] if step % 10 == 0 else []), *told)
            bench.tick()
            if action is not None and step == 0:
                bench.apply(action)
    told = bench.heard_of("SET_POSITION_TARGET_LOCAL_NED")
    assert all((each.vx, each.vy, each.vz) == (0.0, 0.0, 0.0) for each in told)
    assert told == [] or autopilot == ARDUPILOT, "ArduPilot stays on the ground with these"


@AUTOPILOTS
def test_an_autopilot_that_does_not_report_landed_is_disarmed_by_its_height(autopilot: int) -> None:
    bench = steering(autopilot)
    bench.vehicle.landed = Landed.UNKNOWN
    bench.apply(Land())
    bench.vehicle.mode, bench.vehicle.place = LAND[autopilot][0], (0.0, 0.0, -0.1)
    bench.go_on(5.0)
    assert (ARM, 0.0, 0.0, 0.0, 0.0) in bench.commands()


@AUTOPILOTS
def test_a_second_take_off_that_is_cut_off_disarms_after_the_first_ones_arming(autopilot: int) -> None:
    bench = arming(autopilot)
    bench.go_on(3.0, silent=True)
    bench.vehicle.armed = True
    bench.hear(bench.vehicle.heartbeat())
    bench.tick()
    bench.apply(Takeoff())
    bench.go_on(3.0, silent=True)
    bench.commands()
    bench.go_on(1.0)
    assert (ARM, 0.0, 0.0, 0.0, 0.0) in bench.commands()
