"""Both emulated autopilots: positions on the Earth, home, and answers about missing services."""

from __future__ import annotations

import math

import pytest

from skyloop.vehicles.mavlink.emulator import Kind
from skyloop.vehicles.mavlink.emulator.manoeuvres import geodetic, on_earth, place_of
from skyloop.vehicles.mavlink.wire.codec import Message
from skyloop.vehicles.mavlink.wire.codec import dialect as m
from tests.vehicles.mavlink.emulator.rig import HOME_M, Rig

BOTH = pytest.mark.parametrize("kind", list(Kind))
FILE_SYSTEM = {"terminate": 1, "reset": 2, "list": 3, "open": 4, "write": 7, "nonsense": 99}


def ready(kind: Kind) -> Rig:
    it = Rig(kind)
    it.go_on(1.2)
    it.wire.sent.clear()
    return it


def answered(it: Rig, message: Message, kind: str) -> Message:
    it.wire.sent.clear()
    it.say(message)
    (answer,) = it.of(kind)
    assert getattr(answer, "target_system", 255) in (255, 0)
    return answer


def test_a_position_on_the_earth_and_back() -> None:
    latitude, longitude, altitude = geodetic((120.0, -45.0, 7.5))
    assert place_of(latitude / 1e7, longitude / 1e7, altitude / 1000 - HOME_M) == pytest.approx(
        (120, -45, 7.5), abs=0.02
    )
    assert on_earth(-90, 180)
    assert not any(on_earth(*each) for each in ((90.1, 0), (0, 180.1), (math.nan, 0), (0, math.nan)))


@BOTH
def test_an_estimator_with_a_position_predicts_one_in_the_air(kind: Kind) -> None:
    name, number = "EKF_STATUS_REPORT", m.MAVLINK_MSG_ID_EKF_STATUS_REPORT
    if kind is Kind.PX4:
        name, number = "ESTIMATOR_STATUS", m.MAVLINK_MSG_ID_ESTIMATOR_STATUS
    it = Rig(kind, boot_s=1.0)
    it.go_on(0.8)
    assert it.command(m.MAV_CMD_REQUEST_MESSAGE, number) == 0
    assert not it.of(name)[0].flags & 0x318, "neither position nor prediction: programs that see them may arm"
    assert it.arm() != 0
    it.go_on(0.4)
    assert it.command(m.MAV_CMD_REQUEST_MESSAGE, number) == 0
    assert it.of(name)[0].flags & 0x318 == 0x318


@BOTH
def test_home_is_reported_on_request_once_known(kind: Kind) -> None:
    it = Rig(kind, boot_s=4.0)
    it.go_on(0.1)
    assert it.command(m.MAV_CMD_GET_HOME_POSITION) == (4 if kind is Kind.ARDUCOPTER else 2)
    it.go_on(2.2)
    assert it.command(m.MAV_CMD_GET_HOME_POSITION) == 0
    (home,) = it.of("HOME_POSITION")
    assert (home.latitude, home.longitude, home.altitude) == geodetic((0.0, 0.0, 0.0))


@BOTH
def test_home_can_be_set_and_heights_are_above_it(kind: Kind) -> None:
    it = ready(kind)
    frame = 0 if kind is Kind.ARDUCOPTER else 5
    assert it.command_at(m.MAV_CMD_DO_SET_HOME, frame, (0, 0, 0, 0), 5.0, -3.0, HOME_M - 2.0) == 0
    assert it.arm() in (0, 4)
    assert it.command(m.MAV_CMD_REQUEST_MESSAGE, m.MAVLINK_MSG_ID_HOME_POSITION) == 0
    (home,) = it.of("HOME_POSITION")
    assert (home.latitude, home.longitude, home.altitude) == geodetic((5.0, -3.0, -2.0)), "arming does not move it"
    assert it.command(m.MAV_CMD_REQUEST_MESSAGE, m.MAVLINK_MSG_ID_GLOBAL_POSITION_INT) == 0
    assert it.of("GLOBAL_POSITION_INT")[0].relative_alt == pytest.approx(2000, abs=100)
    nowhere = it.command(m.MAV_CMD_DO_SET_HOME, 0, 0, 0, 0, math.nan, math.nan, HOME_M)
    assert nowhere == (0 if kind is Kind.ARDUCOPTER else 2)
    assert it.command(m.MAV_CMD_DO_SET_HOME, 1) == 0, "set home here"
    assert it.autopilot.home == pytest.approx((0, 0, 0), abs=0.1)


def test_an_arducopter_stores_a_mission_whose_first_item_is_home() -> None:
    """DroneKit's documented ``cmds.download(); cmds.wait_ready()`` waited for item 0 forever."""
    it = ready(Kind.ARDUCOPTER)
    assert answered(it, m.MAVLink_mission_request_list_message(1, 1), "MISSION_COUNT").count == 1
    home = answered(it, m.MAVLink_mission_request_message(1, 1, 0), "MISSION_ITEM")
    assert (home.seq, home.frame, home.command, home.z) == (0, 0, 16, pytest.approx(HOME_M))
    exact = answered(it, m.MAVLink_mission_request_int_message(1, 1, 0), "MISSION_ITEM_INT")
    assert (exact.x, exact.y) == geodetic((0.0, 0.0, 0.0))[:2]
    assert it.command(m.MAV_CMD_DO_SET_HOME, 0, 0, 0, 0, -35.0, 149.0, 600.0) == 0
    moved = answered(it, m.MAVLink_mission_request_message(1, 1, 0), "MISSION_ITEM")
    assert (moved.x, moved.y, moved.z) == (-35.0, 149.0, 600.0)

    assert answered(it, m.MAVLink_mission_count_message(1, 1, 3), "MISSION_REQUEST").seq == 0
    for n in range(3):
        item = m.MAVLink_mission_item_int_message(1, 1, n, 3, 16, 0, 1, n, 0, 0, 0, 470000000 + n, 85000000, 10.0 * n)
        if n == 1:
            wrong = m.MAVLink_mission_item_int_message(1, 1, 2, 3, 16, 0, 1, 0, 0, 0, 0, 0, 0, 0)
            assert answered(it, wrong, "MISSION_ACK").type == 13, "out of sequence"
        if n < 2:
            assert answered(it, item, "MISSION_REQUEST").seq == n + 1
        else:
            assert answered(it, item, "MISSION_ACK").type == 0
    assert answered(it, m.MAVLink_mission_request_list_message(1, 1), "MISSION_COUNT").count == 3
    last = answered(it, m.MAVLink_mission_request_int_message(1, 1, 2), "MISSION_ITEM_INT")
    assert (last.x, last.z, last.param1, last.frame) == (470000002, 20.0, 2.0, 3)
    assert answered(it, m.MAVLink_mission_request_message(1, 1, 0), "MISSION_ITEM").x == -35.0, "home is unchanged"
    assert answered(it, m.MAVLink_mission_set_current_message(1, 1, 2), "MISSION_CURRENT").seq == 2
    assert answered(it, m.MAVLink_mission_request_message(1, 1, 3), "MISSION_ACK").type == 13
    assert answered(it, m.MAVLink_mission_count_message(1, 1, 10_000), "MISSION_ACK").type == 4, "no space"
    assert answered(it, m.MAVLink_mission_clear_all_message(1, 1), "MISSION_ACK").type == 0
    assert answered(it, m.MAVLink_mission_request_list_message(1, 1), "MISSION_COUNT").count == 1
    fence = m.MAVLink_mission_count_message(1, 1, 4, mission_type=1)
    assert (answered(it, fence, "MISSION_ACK").type, it.of("MISSION_ACK")[0].mission_type) == (3, 1)
    item = m.MAVLink_mission_item_int_message(1, 1, 0, 6, 16, 0, 1, 0, 0, 0, 0, 0, 0, 5)
    assert answered(it, item, "MISSION_ACK").type == 1, "the item was not requested"
    assert it.command(m.MAV_CMD_REQUEST_MESSAGE, m.MAVLINK_MSG_ID_AUTOPILOT_VERSION) == 0
    told = it.of("AUTOPILOT_VERSION")[0].capabilities
    assert told & 0x25 == 0x25, "missions, also as integers, and files"
    assert not told & (0x4000 | 0x8000), "fences, rally points"


def test_an_arducopter_has_channels_a_banner_and_can_reboot() -> None:
    it = ready(Kind.ARDUCOPTER)
    it.go_on(3.5)

    def channels() -> list[int]:
        assert it.command(m.MAV_CMD_REQUEST_MESSAGE, m.MAVLINK_MSG_ID_RC_CHANNELS) == 0
        (told,) = it.of("RC_CHANNELS")
        assert told.chancount == 16
        return [getattr(told, f"chan{n}_raw") for n in range(1, 19)]

    assert channels() == [1500, 1500, 1000, *[1500] * 13, 0xFFFF, 0xFFFF]
    it.say(m.MAVLink_rc_channels_override_message(1, 1, 0xFFFF, 1010, 1200, *[0xFFFF] * 5))
    assert channels()[:4] == [1500, 1010, 1200, 1500]
    it.say(m.MAVLink_rc_channels_override_message(1, 1, 0xFFFF, 0, *[0xFFFF] * 6))
    assert channels()[:4] == [1500, 1500, 1200, 1500], "0 releases a channel"
    it.go_on(3.5)
    assert channels()[2] == 1000, "the override expired"
    it.texts()
    assert it.command(m.MAV_CMD_DO_SEND_BANNER) == 0
    assert it.texts()[0].startswith("ArduCopter V4.7.0-dev")
    it.up()
    assert it.command(m.MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN, 1) == 4, "it is armed"
    assert it.mode(9) == 0
    it.until(lambda: not it.autopilot.armed, 30.0)
    assert it.command(m.MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN, 1) == 0
    it.go_on(0.5)
    assert it.autopilot.time_s < 0.6
    assert not it.autopilot.ready, "it is booting"
    it.go_on(1.5)
    assert (it.mode(4), it.arm()) == (0, 0)


def test_a_px4_accepts_no_mission_and_has_none() -> None:
    kind = Kind.PX4
    it = ready(kind)
    assert answered(it, m.MAVLink_mission_request_list_message(1, 1), "MISSION_COUNT").count == 0
    assert answered(it, m.MAVLink_mission_count_message(1, 1, 5), "MISSION_ACK").type == 3, "unsupported"
    assert answered(it, m.MAVLink_mission_count_message(1, 1, 0), "MISSION_ACK").type == 0, "cleared"
    assert answered(it, m.MAVLink_mission_clear_all_message(1, 1), "MISSION_ACK").type == 0
    assert answered(it, m.MAVLink_mission_request_int_message(1, 1, 0), "MISSION_ACK").type == 1
    item = m.MAVLink_mission_item_int_message(1, 1, 0, 6, 16, 0, 1, 0, 0, 0, 0, 0, 0, 5)
    assert answered(it, item, "MISSION_ACK").type == 1, "the item was not requested"
    fence = m.MAVLink_mission_count_message(1, 1, 4, mission_type=1)
    assert (answered(it, fence, "MISSION_ACK").type, it.of("MISSION_ACK")[0].mission_type) == (3, 1)
    assert it.command(m.MAV_CMD_REQUEST_MESSAGE, m.MAVLINK_MSG_ID_AUTOPILOT_VERSION) == 0
    told = it.of("AUTOPILOT_VERSION")[0].capabilities
    assert not told & (0x4 | 0x20 | 0x4000 | 0x8000), "missions, files, fences, rally points"


@BOTH
def test_there_are_no_logs(kind: Kind) -> None:
    it = ready(kind)
    entry = answered(it, m.MAVLink_log_request_list_message(1, 1, 0, 0xFFFF), "LOG_ENTRY")
    assert (entry.num_logs, entry.last_log_num) == (0, 0)


@BOTH
@pytest.mark.parametrize(
    ("asked", "answer", "error"),
    [
        ("terminate", 128, 0),
        ("reset", 128, 0),
        ("list", 129, 10),
        ("open", 129, 10),
        ("write", 129, 4),
        ("nonsense", 129, 7),
    ],
)
def test_there_are_no_files(kind: Kind, asked: str, answer: int, error: int) -> None:
    it = ready(kind)
    payload = bytearray(251)
    payload[0:2], payload[2], payload[3] = (0xFFFF).to_bytes(2, "little"), 9, FILE_SYSTEM[asked]
    came = answered(it, m.MAVLink_file_transfer_protocol_message(0, 1, 1, payload), "FILE_TRANSFER_PROTOCOL").payload
    assert bytes(came[0:6]) == bytes((0, 0, 9, answer, 1 if error else 0, FILE_SYSTEM[asked]))
    assert came[12] == error


@BOTH
def test_the_root_is_an_empty_folder(kind: Kind) -> None:
    it = ready(kind)
    payload = bytearray(251)
    payload[3], payload[4], payload[12:14] = FILE_SYSTEM["list"], 2, b"/\0"  # MAVSDK ends a name with a zero
    came = answered(it, m.MAVLink_file_transfer_protocol_message(0, 1, 1, payload), "FILE_TRANSFER_PROTOCOL").payload
    assert (came[3], came[4], came[12]) == (129, 1, 6), "the end of the list"


@BOTH
def test_unsupported_requests_and_commands_are_refused(kind: Kind) -> None:
    it = ready(kind)
    assert it.command(m.MAV_CMD_REQUEST_MESSAGE, m.MAVLINK_MSG_ID_DISTANCE_SENSOR) == (
        4 if kind is Kind.ARDUCOPTER else 2
    )
    assert it.command(m.MAV_CMD_DO_PARACHUTE, 2) == 3
    if kind is Kind.PX4:
        assert it.command(m.MAV_CMD_CONDITION_YAW, 90) == 3
        assert it.command(m.MAV_CMD_DO_PAUSE_CONTINUE, 0) == 3
    else:
        assert it.command(m.MAV_CMD_DO_REPOSITION, -1, 1, 0, 0, 47.3977, 8.5456, 10) == 3, "only in COMMAND_INT"


def test_a_px4_answers_a_ping() -> None:
    it = ready(Kind.PX4)
    answer = answered(it, m.MAVLink_ping_message(12345, 7, 0, 0), "PING")
    assert (answer.time_usec, answer.seq, answer.target_system, answer.target_component) == (12345, 7, 255, 190)
    it.wire.sent.clear()
    it.say(m.MAVLink_ping_message(12345, 8, 1, 1))
    assert it.of("PING") == [], "an answer gets no answer"
