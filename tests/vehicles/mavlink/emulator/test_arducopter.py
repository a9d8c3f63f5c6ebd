"""The emulated ArduCopter behaves as the real one was observed to."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest

from skyloop.messages.geometry import quaternion_from_euler, wrap_angle
from skyloop.vehicles.mavlink.emulator import Kind
from skyloop.vehicles.mavlink.emulator.manoeuvres import geodetic
from skyloop.vehicles.mavlink.wire.axes import to_wire
from skyloop.vehicles.mavlink.wire.codec import MavlinkCodec, Message
from skyloop.vehicles.mavlink.wire.codec import dialect as m
from tests.vehicles.mavlink.emulator.rig import HOME_M, Rig


def rig() -> Rig:
    return Rig(Kind.ARDUCOPTER)


def attitude(roll: float = 0.0, pitch: float = 0.0, thrust: float = 0.5, scale: float = 1.0) -> Message:
    q = [each * scale for each in to_wire(quaternion_from_euler(roll, pitch, 0.0))]
    return m.MAVLink_set_attitude_target_message(0, 1, 1, 7, q, 0, 0, 0, thrust)


def test_a_new_link_gets_heartbeats_and_requested_messages() -> None:
    it = rig()
    it.go_on(4.0)
    assert {each.get_type() for each in it.wire.sent} <= {"HEARTBEAT", "TIMESYNC", "STATUSTEXT"}
    assert 3 <= len(it.of("HEARTBEAT")) <= 5
    assert it.command(m.MAV_CMD_SET_MESSAGE_INTERVAL, m.MAVLINK_MSG_ID_ATTITUDE, 20_000) == 0
    assert it.command(m.MAV_CMD_SET_MESSAGE_INTERVAL, m.MAVLINK_MSG_ID_HEARTBEAT, 200_000) == 0
    it.go_on(2.0)
    assert 90 <= len(it.of("ATTITUDE")) <= 102
    assert 9 <= len(it.of("HEARTBEAT")) <= 11


def test_a_crash_report_is_cut_to_the_message_size() -> None:
    """The autopilot fell silent when it hit the ground at more than 32 g."""
    it = rig()
    it.go_on(0.1)
    believed = replace(it.autopilot.report.believed, acceleration_m_s2=(-20.0, 0.0, 900.0))
    it.autopilot.report = replace(it.autopilot.report, believed=believed)
    assert it.command(m.MAV_CMD_REQUEST_MESSAGE, m.MAVLINK_MSG_ID_RAW_IMU) == 0
    (heard,) = it.of("RAW_IMU")
    assert (heard.xacc, heard.zacc) == (-2039, -32768)


def test_accepted_messages_do_not_flow_before_a_position_is_known() -> None:
    it = Rig(Kind.ARDUCOPTER, boot_s=4.0)
    it.go_on(0.1)
    assert it.command(m.MAV_CMD_SET_MESSAGE_INTERVAL, m.MAVLINK_MSG_ID_LOCAL_POSITION_NED, 100_000) == 0
    it.go_on(1.5)
    assert it.of("LOCAL_POSITION_NED") == []
    it.go_on(1.5)
    assert it.of("LOCAL_POSITION_NED")


def test_arming_is_refused_until_ready_and_in_unarmable_modes() -> None:
    it = rig()
    it.go_on(0.2)
    assert it.arm() == 4
    assert "Arm: Need Position Estimate" in it.texts()
    it.go_on(1.5)
    assert it.mode(17) == 0
    assert it.arm() == 4
    assert it.texts() == ["Arm: BRAKE mode not armable"]
    assert it.mode(4) == 0
    assert it.arm() == 0
    assert it.arm() == 0, "arming again succeeds"
    assert it.of("HEARTBEAT") == [], "arming sends no extra heartbeat"


def test_mode_changes_are_reported_at_once_and_bad_ones_refused() -> None:
    it = rig()
    it.go_on(1.5)
    it.wire.sent.clear()
    assert it.mode(4) == 0
    assert [each.custom_mode for each in it.of("HEARTBEAT")] == [4]
    assert it.mode(99) == 4
    assert it.texts() == ["No such mode 99"]
    assert it.mode(3) == 4
    assert it.texts() == ["Mode change to AUTO failed: init failed"]


def test_it_disarms_ten_seconds_after_arming_and_two_after_landing() -> None:
    it = rig()
    it.go_on(1.5)
    assert (it.mode(4), it.arm()) == (0, 0)
    it.go_on(9.5)
    assert it.autopilot.armed
    it.go_on(1.5)
    assert not it.autopilot.armed
    it = rig()
    it.up(2.0)
    assert it.mode(9) == 0
    it.go_on(12.0)
    assert not it.autopilot.armed
    assert it.autopilot.mode == "LAND"


def test_take_off_requires_guided_armed_and_on_the_ground() -> None:
    it = rig()
    it.go_on(1.5)
    assert it.command(m.MAV_CMD_NAV_TAKEOFF, 0, 0, 0, 0, 0, 0, 3) == 4
    it.up()
    assert it.height == pytest.approx(3.0, abs=0.4)
    assert it.command(m.MAV_CMD_NAV_TAKEOFF, 0, 0, 0, 0, 0, 0, 3) == 4


def test_a_velocity_cancels_the_climb_and_a_position_restarts_it() -> None:
    it = rig()
    it.go_on(1.5)
    assert (it.mode(4), it.arm()) == (0, 0)
    assert it.command(m.MAV_CMD_NAV_TAKEOFF, 0, 0, 0, 0, 0, 0, 6) == 0
    it.go_on(2.0)
    it.say(it.velocity(0, 0, 0))
    it.go_on(5.0)
    assert 0.3 < it.height < 4.0
    assert it.command(m.MAV_CMD_NAV_TAKEOFF, 0, 0, 0, 0, 0, 0, 6) == 4
    it.say(m.MAVLink_set_position_target_local_ned_message(0, 1, 1, 1, 0xDF8, 0, 0, -6, *[0.0] * 8))
    it.go_on(8.0)
    assert it.height == pytest.approx(6.0, abs=0.5)


def test_a_climb_rate_on_the_ground_does_nothing() -> None:
    it = rig()
    it.go_on(1.5)
    assert (it.mode(4), it.arm()) == (0, 0)
    it.go_on(3.0, it.velocity(0, 0, -1))
    assert it.height < 0.1


@pytest.mark.parametrize("frame", [1, 7])
def test_velocities_in_world_frames(frame: int) -> None:
    it = rig()
    it.up()
    it.go_on(3.0, it.velocity(1, 0.5, 0, frame=frame))
    assert it.speed[:2] == pytest.approx((0.5, 1.0), abs=0.15)


@pytest.mark.parametrize("frame", [8, 9])
def test_velocities_in_body_frames_turn_with_it(frame: int) -> None:
    it = rig()
    it.up()
    yaw = it.simulation.truth(0).yaw_rad
    it.go_on(3.0, it.velocity(1, 0, 0, frame=frame))
    assert it.speed[:2] == pytest.approx((math.cos(yaw), math.sin(yaw)), abs=0.15)
    it.go_on(3.0, it.velocity(1, 0, 0, frame=frame, yaw_rate=0.5))
    turned = it.simulation.truth(0).yaw_rad
    assert turned - yaw == pytest.approx(-1.5, abs=0.3)
    assert it.speed[0] * math.cos(turned) + it.speed[1] * math.sin(turned) > 0.5


@pytest.mark.parametrize("bad", ["frame", "nan"])
def test_an_unsupported_set_point_is_a_silent_stop(bad: str) -> None:
    it = rig()
    it.up()
    it.go_on(2.0, it.velocity(1, 0, 0))
    it.texts()
    it.go_on(2.0, it.velocity(1, 0, 0, frame=3) if bad == "frame" else it.velocity(math.nan, 0, 0))
    assert math.hypot(*it.speed[:2]) < 0.2
    assert it.texts() == []


def test_silence_brakes_after_three_seconds_without_a_text() -> None:
    it = rig()
    it.up()
    it.go_on(2.0, it.velocity(1, 0, 0))
    it.go_on(2.5)
    assert it.speed[1] == pytest.approx(1.0, abs=0.15)
    it.go_on(2.5)
    assert math.hypot(*it.speed[:2]) < 0.2
    assert it.autopilot.mode == "GUIDED"
    assert "failsafe" not in " ".join(it.texts()).lower()


def test_silence_after_an_attitude_levels_and_drifts() -> None:
    it = rig()
    it.up()
    it.go_on(3.0, attitude(pitch=-0.2))
    it.go_on(3.5)
    fast = math.hypot(*it.speed[:2])
    assert fast > 0.5
    assert abs(it.simulation.truth(0).pitch_rad) < 0.05


@pytest.mark.parametrize(("thrust", "climb"), [(0.5, 0.0), (0.7, 1.0), (0.3, -0.6)])
def test_thrust_is_a_climb_rate(thrust: float, climb: float) -> None:
    it = rig()
    it.up(6.0)
    it.go_on(2.0, attitude(thrust=thrust))
    assert it.speed[2] == pytest.approx(climb, abs=0.15)


@pytest.mark.parametrize(
    "bad",
    [
        attitude(pitch=-0.2, scale=1.1),
        m.MAVLink_set_attitude_target_message(
            0, 1, 1, 7 | 64, to_wire(quaternion_from_euler(0, -0.2, 0)), 0, 0, 0, 0.5
        ),
    ],
)
def test_an_attitude_without_thrust_or_unit_length_is_a_stop(bad: Message) -> None:
    it = rig()
    it.up()
    it.go_on(2.0, bad)
    assert math.hypot(*it.speed[:2]) < 0.2


def test_loiter_without_sticks_dives_and_with_them_holds() -> None:
    it = rig()
    it.up(6.0)
    assert it.mode(5) == 0
    it.go_on(1.5)
    assert it.speed[2] < -2.0
    it = rig()
    it.up(6.0)
    sticks = m.MAVLink_manual_control_message(1, 0, 0, 500, 0, 0)
    it.go_on(0.2, sticks)
    assert it.mode(5) == 0
    it.go_on(2.0, sticks)
    assert it.height > 5.0
    it.go_on(2.0, m.MAVLink_manual_control_message(1, 300, 0, 500, 0, 0))
    assert math.hypot(*it.speed[:2]) == pytest.approx(1.8, abs=0.3)


def test_disarming_in_flight_needs_force_and_makes_it_fall() -> None:
    it = rig()
    it.up(6.0)
    assert it.command(m.MAV_CMD_COMPONENT_ARM_DISARM, 0) == 4
    assert it.autopilot.armed
    assert it.command(m.MAV_CMD_COMPONENT_ARM_DISARM, 0, 21196) == 0
    it.go_on(0.8)
    assert it.speed[2] < -5.0
    it.go_on(2.0)
    assert it.height < 0.1


def test_ground_station_silence_brakes_if_configured() -> None:
    it = rig()
    it.autopilot.parameters["FS_GCS_ENABLE"] = 7
    it.up()
    it.heartbeats = False
    it.go_on(4.0, it.velocity(1, 0, 0))
    assert it.autopilot.mode == "GUIDED"
    it.go_on(2.0, it.velocity(1, 0, 0))
    assert it.autopilot.mode == "BRAKE"
    assert "GCS Failsafe" in it.texts()
    it.heartbeats = True
    it.go_on(1.5)
    assert it.texts() == ["GCS Failsafe Cleared"]
    assert it.autopilot.mode == "BRAKE"


def test_by_default_and_for_other_systems_silence_has_no_effect() -> None:
    it = rig()
    it.up()
    it.heartbeats = False
    it.go_on(10.0, it.velocity(0, 0, 0))
    assert it.autopilot.mode == "GUIDED"
    it.autopilot.parameters["FS_GCS_ENABLE"] = 7
    other = MavlinkCodec(245, 190)
    for _ in range(5):
        it.say(m.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3), other)
        it.say(it.velocity(0.5, 0, 0), other)
        it.go_on(0.5)
    assert it.autopilot.mode == "BRAKE", "only the one in MAV_GCS_SYSID counts"


def test_integers_are_cast_and_the_capabilities_say_so() -> None:
    it = rig()
    it.go_on(0.1)
    assert it.command(m.MAV_CMD_REQUEST_MESSAGE, m.MAVLINK_MSG_ID_AUTOPILOT_VERSION) == 0
    (version,) = it.of("AUTOPILOT_VERSION")
    assert not version.capabilities & 0x10
    it.say(m.MAVLink_param_request_read_message(1, 1, b"ANGLE_MAX", -1))
    (value,) = it.of("PARAM_VALUE")
    assert (value.param_value, value.param_type) == (3000.0, 4)


def test_without_gps_external_poses_make_it_ready() -> None:
    it = Rig(Kind.ARDUCOPTER, gps=False)
    it.go_on(3.0)
    assert it.mode(4) == 4
    pose = m.MAVLink_vision_position_estimate_message(0, 0, 0, 0, 0, 0, 0)
    it.go_on(1.5, pose)
    assert it.mode(4) == 0
    it.go_on(0.1, pose)
    assert it.arm() == 0


@pytest.mark.parametrize(("frame", "altitude"), [(6, 4.0), (3, 4.0), (5, HOME_M + 4.0), (0, HOME_M + 4.0)])
def test_it_flies_to_a_position_on_the_earth(frame: int, altitude: float) -> None:
    it = rig()
    it.up()
    it.say(it.place_at(3.0, -2.0, altitude, frame=frame))
    it.go_on(6.0)
    assert (*it.place, it.height) == pytest.approx((3.0, -2.0, 4.0), abs=0.4)


def test_a_position_in_an_unknown_frame_or_none_is_a_silent_stop() -> None:
    it = rig()
    it.up()
    it.go_on(2.0, it.velocity(1, 0, 0))
    it.texts()
    it.go_on(1.5, it.place_at(30.0, 0.0, 4.0, frame=1))
    assert math.hypot(*it.speed[:2]) < 0.3
    it.go_on(1.0, m.MAVLink_set_position_target_global_int_message(0, 1, 1, 6, 0xDF8, 910_000_000, 0, 4, *[0.0] * 8))
    assert math.hypot(*it.speed[:2]) < 0.3
    assert it.texts() == []


@pytest.mark.parametrize("frame", [7, 8])
def test_a_position_in_other_frames_is_relative_to_the_vehicle(frame: int) -> None:
    it = rig()
    it.up()
    it.say(it.place_at(2.0, 2.0, 3.0))
    it.go_on(5.0)
    yaw = it.simulation.truth(0).yaw_rad if frame == 8 else math.pi / 2
    it.say(m.MAVLink_set_position_target_local_ned_message(0, 1, 1, frame, 0xDF8, 2, 0, -1, *[0.0] * 8))
    it.go_on(5.0)
    there = (2 + 2 * math.cos(yaw), 2 + 2 * math.sin(yaw), 4.0)
    assert (*it.place, it.height) == pytest.approx(there, abs=0.4)


def test_it_flies_to_a_guided_mission_item() -> None:
    it = rig()
    it.go_on(1.5)

    def go(current: int = 2, *, command: int = 16, z: float = 4.0, frame: int = 3, x: float | None = None) -> int:
        it.wire.sent.clear()
        latitude, longitude, _ = geodetic((-2.0, 3.0, 0.0))
        x = latitude / 1e7 if x is None else x
        it.say(m.MAVLink_mission_item_message(1, 1, 0, frame, command, current, 0, 0, 0, 0, 0, x, longitude / 1e7, z))
        return int(it.of("MISSION_ACK")[0].type)

    assert go() == 1, "refused in STABILIZE"
    it.up()
    assert (go(command=22), go(z=math.nan), go(x=91.0), go(frame=10)) == (1, 12, 10, 3)
    assert go(3, z=9.0) == 0, "a new altitude has no effect"
    it.go_on(0.5)
    assert math.hypot(*it.place) < 0.5
    assert go() == 0
    it.go_on(6.0)
    assert (*it.place, it.height) == pytest.approx((-2.0, 3.0, 4.0), abs=0.5)


def test_reposition_needs_guided_or_permission_to_change_the_mode() -> None:
    it = rig()
    it.up()
    reposition = m.MAV_CMD_DO_REPOSITION
    assert it.mode(17) == 0
    assert it.command_at(reposition, 6, (-1, 0, 0, 0), 3.0, 0.0, 3.0) == 2
    assert it.command_at(reposition, 10, (-1, 1, 0, 0), 3.0, 0.0, 3.0) == 2, "unsupported frame"
    assert it.command_at(reposition, 6, (-1, 1, 0, 0), 3.0, 0.0, 3.0) == 0
    assert it.autopilot.mode == "GUIDED"
    it.go_on(5.0)
    assert it.place == pytest.approx((3.0, 0.0), abs=0.4)


def test_it_turns_by_command_the_long_way_if_requested() -> None:
    it = rig()
    it.up()
    heading = -math.degrees(it.simulation.truth(0).yaw_rad)
    assert it.command(m.MAV_CMD_CONDITION_YAW, 361) == 4
    assert it.command(m.MAV_CMD_CONDITION_YAW, 90, 0, 1, 1) == 0
    it.go_on(4.0)
    assert wrap_angle(-it.simulation.truth(0).yaw_rad - math.radians(heading + 90)) == pytest.approx(0, abs=0.1)
    turned, before = 0.0, it.simulation.truth(0).yaw_rad
    assert it.command(m.MAV_CMD_CONDITION_YAW, (heading + 90 + 90 - 30) % 360, 0, 1, 0) == 0
    for _ in range(80):
        it.go_on(0.1)
        turned += wrap_angle(it.simulation.truth(0).yaw_rad - before)
        before = it.simulation.truth(0).yaw_rad
    assert math.degrees(turned) == pytest.approx(-330, abs=8), "clockwise, though 30 degrees the other way are shorter"


def test_speeds_to_a_position_change_by_command_and_parameter() -> None:
    it = rig()
    it.up()
    assert it.command(m.MAV_CMD_DO_CHANGE_SPEED, 1, 0.6, -1) == 0
    assert it.command(m.MAV_CMD_DO_CHANGE_SPEED, 1, -1, -1) == 4
    it.say(it.place_at(20.0, 0.0, 3.0))
    it.go_on(3.0)
    assert it.speed[0] == pytest.approx(0.6, abs=0.1)
    assert it.command(m.MAV_CMD_DO_CHANGE_SPEED, 1, 1.5, -1) == 0
    it.go_on(2.0)
    assert it.speed[0] == pytest.approx(1.5, abs=0.2)
    assert it.mode(17) == 0
    assert it.command(m.MAV_CMD_DO_CHANGE_SPEED, 1, 1.5, -1) == 4
    it.autopilot.parameters["WPNAV_SPEED"] = 80.0
    it.go_on(1.0)
    assert it.mode(4) == 0
    it.say(it.place_at(20.0, 0.0, 3.0))
    it.go_on(3.0)
    assert it.speed[0] == pytest.approx(0.8, abs=0.1)


def test_guided_pauses_and_resumes() -> None:
    it = rig()
    it.up()
    assert it.command(m.MAV_CMD_DO_PAUSE_CONTINUE, 2) == 2
    it.say(it.place_at(20.0, 0.0, 3.0))
    it.go_on(2.0)
    assert it.command(m.MAV_CMD_DO_PAUSE_CONTINUE, 0) == 0
    it.go_on(2.0)
    assert math.hypot(*it.speed[:2]) < 0.3
    assert it.command(m.MAV_CMD_DO_PAUSE_CONTINUE, 1) == 0
    it.go_on(2.0)
    assert it.speed[0] > 1.0
    assert it.mode(17) == 0
    assert it.command(m.MAV_CMD_DO_PAUSE_CONTINUE, 0) == 4
    assert it.texts() == ["Failed to pause"]


def test_it_returns_at_the_configured_altitude_waits_and_lands() -> None:
    it = rig()
    it.autopilot.parameters["RTL_ALT"] = 600
    it.up()
    it.say(it.place_at(4.0, 0.0, 3.0))
    it.go_on(5.0)
    assert it.mode(6) == 0
    it.go_on(1.5)
    assert it.place[0] == pytest.approx(4.0, abs=0.4), "it climbs first"
    assert it.until(lambda: it.place[0] < 0.5, 8.0) == pytest.approx(6.0, abs=0.4)
    it.go_on(4.0)
    assert it.height > 5.5, "it waits"
    it.until(lambda: not it.autopilot.armed, 25.0)
    assert it.height < 0.1


@pytest.mark.parametrize(("away", "settings", "height"), [(1.5, {}, 4.5), (1.5, {"RTL_CONE_SLOPE": 0.0}, 5.0)])
def test_near_home_it_climbs_less_unless_the_cone_is_off(
    away: float, settings: dict[str, float], height: float
) -> None:
    it = rig()
    it.autopilot.parameters["RTL_ALT"] = 500
    it.autopilot.parameters["RTL_ALT_FINAL"] = 200
    for name, value in settings.items():
        it.autopilot.parameters[name] = value
    it.up(2.0)
    it.say(it.place_at(away, 0.0, 2.0))
    it.go_on(3.0)
    assert it.mode(6) == 0
    assert it.until(lambda: it.place[0] < 0.3, 8.0) == pytest.approx(height, abs=0.3)
    it.go_on(9.0)
    assert it.height == pytest.approx(2.0, abs=0.3), "RTL_ALT_FINAL: it stays up"


def test_a_return_altitude_above_the_ceiling_does_not_stall_it() -> None:
    it = rig()
    it.up()
    it.say(it.place_at(4.0, 0.0, 3.0))
    it.go_on(4.0)
    assert it.autopilot.parameters["RTL_ALT"] == 1500
    assert it.mode(6) == 0
    assert it.until(lambda: it.place[0] < 0.5, 12.0) == pytest.approx(7.0, abs=0.3), "of 8 m"
