"""The emulated PX4 behaves as the real one was observed to."""

from __future__ import annotations

import math

import pytest

from skyloop.messages.geometry import quaternion_from_euler
from skyloop.vehicles.mavlink.emulator import Kind
from skyloop.vehicles.mavlink.wire.axes import to_wire
from skyloop.vehicles.mavlink.wire.codec import Message
from skyloop.vehicles.mavlink.wire.codec import dialect as m
from tests.vehicles.mavlink.emulator.rig import HOME_M, Rig


def rig() -> Rig:
    return Rig(Kind.PX4)


def attitude(thrust: float, roll: float = 0.0) -> Message:
    return m.MAVLink_set_attitude_target_message(
        0, 1, 1, 7, to_wire(quaternion_from_euler(roll, 0, 0)), 0, 0, 0, thrust
    )


def flying() -> Rig:
    """Return a rig in OFFBOARD, hovering."""
    it = rig()
    it.up()
    it.offboard(it.velocity(0, 0, 0))
    it.go_on(1.0, it.velocity(0, 0, 0))
    assert it.autopilot.mode == "OFFBOARD"
    return it


def sticks(*, forward: int = 0, throttle: int = 500) -> Message:
    """A ground station's joystick [1/1000]; the throttle is centred at 500."""
    return m.MAVLink_manual_control_message(1, forward, 0, throttle, 0, 0)


def test_all_messages_stream_without_requests() -> None:
    it = rig()
    it.go_on(1.0)
    it.wire.sent.clear()
    it.go_on(2.0)
    assert 90 <= len(it.of("ATTITUDE")) <= 102
    assert len(it.wire.sent) > 400
    assert it.command(m.MAV_CMD_SET_MESSAGE_INTERVAL, m.MAVLINK_MSG_ID_HEARTBEAT, 200_000) == 4


def test_arming_is_denied_with_a_text_in_chunks() -> None:
    it = rig()
    it.go_on(0.2)
    assert it.arm() == 1
    chunks = it.of("STATUSTEXT")
    assert [each.text for each in chunks] == ["Arming denied: Resolve system health failures firs", "t\t"]
    assert {each.id for each in chunks} == {chunks[0].id}
    assert [each.chunk_seq for each in chunks] == [0, 1]


def test_mode_changes_are_accepted_even_without_effect() -> None:
    it = rig()
    it.up()
    assert it.mode(6) == 0
    it.go_on(1.0)
    assert it.autopilot.mode == "AUTO.LOITER", "OFFBOARD without set-points"
    assert it.mode(17) == 0
    assert it.mode(3) == 0
    assert "Switching to Position is currently not available" in it.texts()
    assert it.autopilot.mode == "AUTO.LOITER"


def test_take_off_is_above_sea_level_accepted_while_disarmed_and_ends_in_hold() -> None:
    it = rig()
    it.go_on(1.5)
    nan = math.nan
    assert it.command(m.MAV_CMD_NAV_TAKEOFF, 0, 0, 0, nan, nan, nan, HOME_M + 3) == 0
    it.go_on(2.0)
    assert (it.autopilot.mode, it.autopilot.armed) == ("AUTO.TAKEOFF", False)
    assert it.height < 0.1
    it = rig()
    it.up(3.0)
    assert it.autopilot.mode == "AUTO.LOITER"
    assert it.height == pytest.approx(3.0, abs=0.4)


def test_a_climb_rate_on_the_ground_lifts_off() -> None:
    it = rig()
    it.go_on(1.5)
    assert it.arm() == 0
    climb = it.velocity(0, 0, -0.5)
    it.offboard(climb)
    it.go_on(5.0, climb)
    assert it.height > 0.5


def test_body_frame_is_accepted_and_others_are_reported() -> None:
    it = flying()
    yaw = it.simulation.truth(0).yaw_rad
    it.go_on(2.5, it.velocity(1, 0, 0, frame=8))
    assert it.speed[:2] == pytest.approx((math.cos(yaw), math.sin(yaw)), abs=0.15)
    it.texts()
    it.say(it.velocity(1, 0, 0, frame=9))
    assert "unsupported" in it.texts()[0]


def test_without_set_points_it_sinks_and_with_them_returns_to_offboard() -> None:
    it = flying()
    it.go_on(1.4)
    assert it.autopilot.mode == "POSCTL"
    assert "Failsafe activated" in it.texts()
    assert it.autopilot.system_status == 5
    it.go_on(1.0)
    assert it.speed[2] == pytest.approx(-0.7, abs=0.15)
    it.go_on(0.2, it.velocity(0, 0, 0))
    assert it.autopilot.mode == "OFFBOARD", "it was not commanded"


def test_without_set_points_it_holds_if_configured() -> None:
    it = flying()
    it.autopilot.parameters["COM_OBL_RC_ACT"] = 5
    it.go_on(3.0)
    assert it.autopilot.mode == "AUTO.LOITER"
    assert abs(it.speed[2]) < 0.1


@pytest.mark.parametrize(("rate_hz", "holds"), [(3.0, True), (1.2, True), (0.8, False)])
def test_the_lowest_rate_of_set_points(rate_hz: float, holds: bool) -> None:
    it = flying()
    it.texts()
    it.go_on(5.0, it.velocity(0, 0, 0), rate_hz=rate_hz)
    assert ("Failsafe activated" not in it.texts()) is holds


def test_thrust_is_a_force() -> None:
    it = flying()
    it.go_on(1.0, attitude(0.5))
    assert abs(it.speed[2]) < 0.2
    it.go_on(1.0, attitude(0.56))
    assert it.speed[2] > 0.4
    it = flying()
    it.go_on(2.0, attitude(0.5, roll=math.radians(10)))
    assert it.speed[2] < -0.1, "leaning, the same thrust lifts less"


def test_after_a_landing_it_returns_to_offboard_and_arms_only_in_hold() -> None:
    it = flying()
    assert it.mode(4, 6) == 0
    it.go_on(12.0)
    assert not it.autopilot.armed
    assert "Disarmed by landing" in it.texts()
    assert it.autopilot.mode == "OFFBOARD"
    assert it.arm() == 1
    assert it.mode(4, 3) == 0
    assert it.arm() == 0


def test_disarming_in_flight_is_denied() -> None:
    it = flying()
    assert it.command(m.MAV_CMD_COMPONENT_ARM_DISARM, 0) == 1
    assert it.texts() == ["Disarming denied: not landed"]


def test_ground_station_silence_holds_if_configured() -> None:
    it = flying()
    it.autopilot.parameters["NAV_DLL_ACT"] = 1
    it.autopilot.parameters["COM_DL_LOSS_T"] = 5
    it.heartbeats = False
    it.go_on(7.0, it.velocity(0.5, 0, 0))
    assert it.autopilot.mode == "AUTO.LOITER"
    assert "Preflight Fail: No connection to the GCS" in it.texts()
    it.heartbeats = True
    it.go_on(2.0, it.velocity(0.5, 0, 0))
    assert "GCS connection regained" in it.texts()
    assert it.autopilot.mode == "AUTO.LOITER"


def test_integers_are_bytes_and_the_capabilities_say_so() -> None:
    it = rig()
    it.go_on(0.1)
    assert it.command(m.MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES, 1) == 0
    (version,) = it.of("AUTOPILOT_VERSION")
    assert version.capabilities & 0x10
    it.say(m.MAVLink_param_request_read_message(1, 1, b"COM_DL_LOSS_T", -1))
    assert it.of("PARAM_VALUE")[0].param_value == pytest.approx(1.4e-44, rel=0.01)


def test_the_time_is_reported_on_request() -> None:
    it = rig()
    it.go_on(2.0)
    it.wire.sent.clear()
    it.say(m.MAVLink_timesync_message(0, 12345))
    (answer,) = it.of("TIMESYNC")
    assert answer.ts1 == 12345
    assert answer.tc1 == pytest.approx(2e9, rel=0.02)


def test_it_flies_to_a_position_on_the_earth_in_offboard() -> None:
    it = flying()
    for frame, altitude in ((6, 4.0), (5, HOME_M + 3.0)):
        it.go_on(5.0, it.place_at(3.0, -2.0, altitude, frame=frame))
        there = altitude - (HOME_M if frame == 5 else 0.0)
        assert (*it.place, it.height) == pytest.approx((3.0, -2.0, there), abs=0.4)
    it.texts()
    it.say(it.place_at(3.0, -2.0, 4.0, frame=3))
    assert it.texts() == ["SET_POSITION_TARGET_GLOBAL_INT invalid coordinate frame 3"]


def test_reposition_is_a_hold_elsewhere() -> None:
    it = rig()
    it.go_on(1.5)
    reposition, nan = m.MAV_CMD_DO_REPOSITION, math.nan
    assert it.command_at(reposition, 5, (-1, 0, 0, nan), 9.0, 0.0, HOME_M + 4.0) == 3, (
        "without permission to change the mode"
    )
    assert it.command_at(reposition, 5, (-1, 1, 0, nan), 9.0, 0.0, HOME_M + 4.0) == 0
    it.up()
    it.go_on(1.0)
    assert math.hypot(*it.place) < 0.3, "a request while disarmed is forgotten"
    assert it.command_at(reposition, 5, (0.7, 1, 0, nan), 9.0, 0.0, HOME_M + 4.0) == 0
    it.go_on(3.0)
    assert it.speed[0] == pytest.approx(0.7, abs=0.1)
    assert it.command(m.MAV_CMD_DO_CHANGE_SPEED, 1, 2.0, -1) == 0
    it.go_on(1.5)
    assert it.speed[0] == pytest.approx(2.0, abs=0.3)
    assert it.command(reposition, -1, 1, 0, nan, nan, nan, HOME_M + 5.0) == 0
    it.go_on(6.0)
    assert (*it.place, it.height) == pytest.approx((9.0, 0.0, 5.0), abs=0.4), "a new altitude, the same position"
    it.say(m.MAVLink_command_int_message(1, 1, 5, reposition, 0, 0, -1, 1, 0, nan, 0x7FFFFFFF, 0x7FFFFFFF, nan))
    it.go_on(1.0)
    assert it.place == pytest.approx((9.0, 0.0), abs=0.4)
    assert it.autopilot.mode == "AUTO.LOITER"


@pytest.mark.parametrize(("away", "cone", "height"), [(4.0, 45, 4.0), (5.0, 45, 5.0), (5.0, 0, 6.5)])
def test_it_returns_at_the_return_altitude_or_within_its_cone(away: float, cone: float, height: float) -> None:
    it = rig()
    it.autopilot.parameters["RTL_RETURN_ALT"] = 6.5
    it.autopilot.parameters["RTL_CONE_ANG"] = cone
    it.up()
    assert it.command_at(m.MAV_CMD_DO_REPOSITION, 5, (3, 1, 0, math.nan), away, 0.0, HOME_M + 3.0) == 0
    it.go_on(6.0)
    assert it.command(m.MAV_CMD_NAV_RETURN_TO_LAUNCH) == 0
    assert it.until(lambda: not it.autopilot.armed, 30.0) == pytest.approx(height, abs=0.4)
    assert (*it.place, it.height) == pytest.approx((0.0, 0.0, 0.0), abs=0.5)


def rising() -> Rig:
    """Return a rig in a take-off to 3 m, beside a pilot with centred sticks."""
    it = rig()
    it.go_on(1.5, sticks())
    assert it.arm() == 0
    nan = math.nan
    assert it.command(m.MAV_CMD_NAV_TAKEOFF, 0, 0, 0, nan, nan, nan, HOME_M + 3.0) == 0
    while it.height < 0.8:
        it.go_on(0.1, sticks())
    assert it.autopilot.mode == "AUTO.TAKEOFF"
    return it


def test_moved_sticks_take_over_during_a_take_off() -> None:
    it = rising()
    it.texts()
    it.go_on(0.3, sticks(forward=500))
    assert it.autopilot.mode == "POSCTL"
    assert it.texts() == ["Pilot took over using sticks"]
    it.go_on(2.0, sticks(forward=500))
    assert it.height < 1.8, "it does not reach the commanded height"
    assert math.hypot(*it.place) > 1.0, "it follows the stick"


def test_resting_sticks_take_nothing_over() -> None:
    it = rising()
    assert it.of("SYS_STATUS")[-1].onboard_control_sensors_present & 0x10000, "they count as a remote control"
    it.go_on(6.0, sticks())
    assert it.autopilot.mode == "AUTO.LOITER"
    assert it.height == pytest.approx(3.0, abs=0.4)


def test_an_axis_out_of_range_is_ignored() -> None:
    it = rising()
    it.go_on(0.5, sticks(forward=32767))
    assert it.autopilot.mode == "AUTO.TAKEOFF"


@pytest.mark.parametrize(("override", "mode"), [(1, "OFFBOARD"), (3, "POSCTL")])
def test_sticks_override_a_program_only_if_configured(override: int, mode: str) -> None:
    it = flying()
    it.autopilot.parameters["COM_RC_OVERRIDE"] = override
    it.go_on(0.5, it.velocity(0, 0, 0), sticks())
    it.go_on(0.5, it.velocity(0, 0, 0), sticks(forward=600))
    assert it.autopilot.mode == mode


def test_a_pilot_with_sticks_may_select_position_mode() -> None:
    it = flying()
    it.go_on(0.5, it.velocity(0, 0, 0), sticks())
    assert it.mode(3) == 0
    it.go_on(2.0, it.velocity(0, 0, 1.0), sticks())
    assert it.autopilot.mode == "POSCTL"
    assert it.height == pytest.approx(3.0, abs=0.4), "centred sticks hold the height"


def test_sticks_that_stop_in_flight_make_it_hold_then_return() -> None:
    it = flying()
    it.go_on(0.5, it.velocity(0, 0, 0), sticks())
    it.texts()
    it.go_on(1.0, it.velocity(0, 0, 0))
    assert it.autopilot.mode == "AUTO.LOITER", "even from OFFBOARD"
    assert "Failsafe activated" in it.texts()
    it.go_on(3.5, it.velocity(0, 0, 0))
    assert it.autopilot.mode == "AUTO.LOITER", "set-points alone do not restore OFFBOARD"
    it.go_on(1.5, it.velocity(0, 0, 0))
    assert it.autopilot.mode == "AUTO.RTL"


def test_sticks_that_return_in_time_end_that() -> None:
    it = flying()
    it.go_on(0.5, it.velocity(0, 0, 0), sticks())
    it.go_on(2.0, it.velocity(0, 0, 0))
    it.go_on(0.5, it.velocity(0, 0, 0), sticks())
    assert it.autopilot.mode == "OFFBOARD"
