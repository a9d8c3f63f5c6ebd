"""Which messages count, how they are converted, and the link's state, on a manual clock."""

from __future__ import annotations

import math
import struct
from contextlib import suppress

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from skyloop.drivers.base import ExternalPose
from skyloop.drivers.byte_stream import Rank
from skyloop.drivers.recording_sink import RecordingSink, implausible
from skyloop.errors import DriverError
from skyloop.messages import (
    AnyAction,
    EmergencyStop,
    FlightState,
    Hover,
    Idle,
    Land,
    LinkState,
    Position,
    Severity,
    Takeoff,
    Velocity,
)
from skyloop.vehicles.mavlink.microservices import pose_message
from skyloop.vehicles.mavlink.options import PoseMessage
from skyloop.vehicles.mavlink.protocol import DEGRADED_NS, LOST_NS, REST_NS, TICK_NS, MavlinkSession, rank_of
from skyloop.vehicles.mavlink.setpoints import STEP_NS, Goal
from skyloop.vehicles.mavlink.telemetry import VehicleState
from skyloop.vehicles.mavlink.wire.codec import COPTER_NUMBERS, MavlinkCodec, Message, chunks_of
from skyloop.vehicles.mavlink.wire.codec import dialect as m
from tests.support.recordings import recorded
from tests.vehicles.mavlink.scripted import ARDUPILOT, PEER, PX4, Bench, Vehicle, options

AUTOPILOTS = pytest.mark.parametrize("autopilot", [ARDUPILOT, PX4])


@AUTOPILOTS
def test_an_autopilot_is_recognised_by_its_heartbeat(autopilot: int) -> None:
    bench = Bench(Vehicle(autopilot, system=7))
    assert bench.link() is LinkState.CONNECTING
    bench.hear(m.MAVLink_attitude_message(0, 0, 0, 0, 0, 0, 0))
    assert bench.sink.newest is None, "nothing counts before the first heartbeat"
    bench.found()
    assert bench.link() is LinkState.UP
    assert bench.state() is FlightState.LANDED
    assert bench.session.commands.target == (7, 1)
    assert bench.session.description.startswith("ArduCopter" if autopilot == ARDUPILOT else "PX4")


def test_messages_are_requested_until_they_flow() -> None:
    bench = Bench(Vehicle(ARDUPILOT))
    bench.hear(bench.vehicle.heartbeat())
    for _ in range(400):  # 8 s with only heartbeats
        bench.clock.advance(0.02)
        bench.hear(bench.vehicle.heartbeat())
        bench.tick()
    asked = [each.param1 for each in bench.heard_of("COMMAND_LONG") if each.command == m.MAV_CMD_SET_MESSAGE_INTERVAL]
    assert asked.count(m.MAVLINK_MSG_ID_ATTITUDE) == 3, "at once, and every three seconds"
    assert asked.count(m.MAVLINK_MSG_ID_HEARTBEAT) == 1, "that one flows"


def test_missing_values_are_absent_and_stopped_ones_become_so() -> None:
    bench = Bench(Vehicle(ARDUPILOT))
    bench.hear(bench.vehicle.heartbeat())
    first = bench.newest
    assert (first.roll_rad, first.altitude_m, first.velocity_m_s, first.battery, first.position_m) == (None,) * 5
    bench.found()
    assert None not in (bench.newest.altitude_m, bench.newest.velocity_m_s, bench.newest.battery)
    for _ in range(80):  # 1.6 s with only the attitude
        bench.clock.advance(0.02)
        bench.vehicle.boot_ms += 20
        bench.hear(bench.vehicle.telemetry()[-1])
        bench.tick()
    assert bench.newest.roll_rad is not None
    assert (bench.newest.velocity_m_s, bench.newest.position_m) == (None, None)
    assert (bench.newest.native or {})["mavlink.age.local_position_ned"] == pytest.approx(1.6, abs=0.05)


def test_units_axes_and_signs() -> None:
    bench = Bench(Vehicle(PX4))
    vehicle = bench.vehicle
    vehicle.yaw = math.pi / 2  # to the east
    vehicle.velocity = (1.0, 2.0, -0.5)  # north, east, down
    vehicle.place = (10.0, 20.0, -3.0)
    bench.found()
    newest = bench.newest
    assert newest.yaw_rad == pytest.approx(0.0, abs=1e-6)
    assert newest.roll_rad == pytest.approx(0.1)
    assert newest.pitch_rad == pytest.approx(-0.2), "nose up"
    assert newest.velocity_m_s == pytest.approx((2.0, 1.0, 0.5), abs=1e-5), "forward is east, left is north"
    assert newest.position_m == pytest.approx((20.0, 10.0, 3.0))
    assert newest.altitude_m == pytest.approx(3.0, abs=1e-3)
    assert newest.battery == pytest.approx(0.8)
    assert newest.battery_v == pytest.approx(12.0)


def test_another_vehicle_with_the_same_id_is_reported_and_ignored() -> None:
    bench = Bench(Vehicle(PX4)).found()
    other = MavlinkCodec(1, 1)
    bench.hear(m.MAVLink_attitude_message(20_000, 1.0, 0, 0, 0, 0, 0), peer=("127.0.0.1", 14581), codec=other)
    for _ in range(3):
        bench.hear(bench.vehicle.heartbeat(), peer=("127.0.0.1", 14581), codec=other)
    assert bench.newest.roll_rad == pytest.approx(0.1)
    told = [text for text in bench.texts if "another vehicle" in text]
    assert len(told) == 1
    assert "peer=HOST:PORT" in told[0]


def test_a_vehicle_is_chosen_by_its_system_id_and_by_its_peer() -> None:
    for text, right in (("sysid=2", MavlinkCodec(2, 1)), ("peer=127.0.0.1:14581", MavlinkCodec(1, 1))):
        bench = Bench(Vehicle(PX4), options(f"mavlink://udpin:127.0.0.1:14540?parameters=no&{text}"))
        bench.hear(bench.vehicle.heartbeat())
        assert not bench.session.is_receiving
        bench.hear(bench.vehicle.heartbeat(), peer=("127.0.0.1", 14581), codec=right)
        assert bench.session.is_receiving


def test_after_a_loss_no_other_system_is_flown() -> None:
    bench = Bench(Vehicle(PX4)).found()
    bench.go_on(3.0, silent=True)
    assert bench.link() is LinkState.LOST
    bench.hear(bench.vehicle.heartbeat(), codec=MavlinkCodec(9, 1))
    assert not bench.session.is_receiving
    bench.hear(bench.vehicle.heartbeat(), peer=("127.0.0.1", 20_000))
    assert bench.session.is_receiving, "the same system at another address"


@pytest.mark.parametrize(("system", "component", "kind", "autopilot"), [(255, 190, 6, 8), (1, 100, 30, 8)])
def test_ground_stations_and_cameras_are_not_vehicles(system: int, component: int, kind: int, autopilot: int) -> None:
    bench = Bench(Vehicle(PX4))
    bench.hear(m.MAVLink_heartbeat_message(kind, autopilot, 0, 0, 4, 3), codec=MavlinkCodec(system, component))
    assert not bench.session.is_receiving
    assert bench.texts == []


def test_answers_to_other_programs_are_ignored() -> None:
    bench = Bench(Vehicle(ARDUPILOT)).found()
    bench.hear(m.MAVLink_command_ack_message(400, 0, 0, 0, 245, 190))
    assert bench.session.commands.result(400, 0) is None
    bench.answer(400, 4)
    assert bench.session.commands.result(400, 0) == 4


@pytest.mark.parametrize(("autopilot", "kind", "why"), [(0, 2, "MAV_AUTOPILOT is 0"), (3, 1, "not a multirotor")])
def test_an_unsupported_vehicle_is_shown_and_clearly_refused(autopilot: int, kind: int, why: str) -> None:
    bench = Bench(Vehicle(ARDUPILOT))
    bench.vehicle.autopilot, bench.vehicle.kind = autopilot, kind
    heartbeat = m.MAVLink_heartbeat_message(kind, autopilot, 1, 0, 3, 3)
    for _ in range(50):
        bench.clock.advance(0.02)
        bench.hear(heartbeat, bench.vehicle.telemetry()[-1])
        bench.tick()
    assert bench.newest.roll_rad is not None
    assert any(why in text for text in bench.texts)
    with pytest.raises(DriverError, match="can't be flown"):
        bench.apply(Takeoff())


def test_an_old_vehicle_is_answered_in_its_version_and_offered_the_new_one() -> None:
    bench = Bench(Vehicle(ARDUPILOT, version=1)).found()
    bench.frames.clear()
    bench.go_on(1.1)
    magics = [frame[0] for frame in bench.frames]
    assert magics.count(0xFD) == 1, "one heartbeat a second"
    assert magics.count(0xFE) > 1
    bench.vehicle.version = 2
    bench.go_on(0.1)
    bench.frames.clear()
    bench.go_on(1.1)
    assert {frame[0] for frame in bench.frames} == {0xFD}


def test_signed_messages_without_a_key_are_clearly_refused() -> None:
    bench = Bench(Vehicle(PX4))
    signing = MavlinkCodec(1, 1, key=bytes(32))
    for _ in range(300):
        bench.clock.advance(0.02)
        bench.hear(bench.vehicle.heartbeat(), codec=signing)
        bench.tick()
    assert bench.link() is LinkState.LOST
    assert "signing_key" in bench.sink.links[-1][1]
    assert sum("signing_key" in text for text in bench.texts) == 1


def test_silence_is_reported_in_steps() -> None:
    bench = Bench(Vehicle(PX4)).found()
    bench.go_on(1.3, silent=True)
    assert bench.link() is LinkState.DEGRADED
    bench.go_on(LOST_NS / 1e9, silent=True)
    assert bench.link() is LinkState.LOST
    assert bench.state() is FlightState.UNKNOWN
    with pytest.raises(DriverError, match="no data from"):
        bench.apply(Velocity(forward=1.0))
    bench.found()
    assert bench.link() is LinkState.UP


def test_a_rebooted_vehicle_is_set_up_again() -> None:
    bench = Bench(Vehicle(ARDUPILOT)).found()
    bench.vehicle.boot_ms = 0
    bench.go_on(0.1)
    assert (LinkState.LOST, "the vehicle rebooted") in bench.sink.links
    bench.go_on(1.0)
    asked = [each for each in bench.heard_of("COMMAND_LONG") if each.command == m.MAV_CMD_SET_MESSAGE_INTERVAL]
    assert len(asked) >= 10
    assert bench.link() is LinkState.UP


def test_its_clock_is_mapped_to_ours_by_timesync() -> None:
    bench = Bench(Vehicle(PX4)).found()
    bench.go_on(1.1)
    question = bench.heard_of("TIMESYNC")[-1]
    assert question.tc1 == 0
    bench.clock.advance(0.004)
    bench.vehicle.boot_ms += 4
    theirs_ns = bench.vehicle.boot_ms * 1_000_000 - 2_000_000
    bench.hear(m.MAVLink_timesync_message(theirs_ns, question.ts1))
    assert bench.session.clock.round_trip_s is not None
    boot_ms = bench.vehicle.boot_ms
    bench.clock.advance(0.1)  # the message arrives 100 ms late, with its sending time
    bench.hear(m.MAVLink_attitude_message(boot_ms, 0, 0, 0, 0, 0, 0))
    assert bench.clock() - bench.newest.captured_ns == pytest.approx(100e6, abs=5e6)


def test_its_time_requests_are_answered() -> None:
    bench = Bench(Vehicle(PX4)).found()
    bench.said.clear()
    bench.hear(m.MAVLink_timesync_message(0, 987_654_321))
    assert bench.session.due_ns <= bench.clock(), "at once: it takes the delay for travel time"
    bench.tick()
    answers = [each for each in bench.heard_of("TIMESYNC") if each.ts1 == 987_654_321]
    assert answers[0].tc1 == bench.clock()


def test_texts_and_health_become_events() -> None:
    bench = Bench(Vehicle(PX4))
    bench.vehicle.ready = False
    bench.found()
    for chunk in chunks_of("Preflight Fail: ekf2 missing data, and more words so that it is long\t", 2, 3):
        bench.hear(chunk)
    bench.vehicle.ready = True
    bench.go_on(0.1)
    told = {event.text: event for event in bench.sink.events}
    text = told["Preflight Fail: ekf2 missing data, and more words so that it is long"]
    assert (text.severity, text.data["reason"]) == (Severity.ERROR, "prearm")
    assert told["the vehicle can't be armed now"].severity is Severity.WARNING
    assert "the vehicle is ready to arm" in told
    assert "the vehicle knows where it is" in told


def test_an_autopilot_with_another_component_is_named_and_can_be_chosen() -> None:
    vehicle = Vehicle(ARDUPILOT)
    vehicle.codec = MavlinkCodec(1, 42)
    bench = Bench(vehicle)
    for _ in range(3):
        bench.hear(vehicle.heartbeat())
    assert [event.text for event in bench.sink.events] == [
        "an autopilot answers as component 42 of system 1, not as component 1: ignored; ?component=42 chooses it"
    ]
    given = Bench(vehicle, options("mavlink://udpin:127.0.0.1:14540?parameters=no&component=42")).found()
    assert given.sink.link_state is LinkState.UP
    given.go_on(1.1)
    assert {each.target_component for each in given.heard_of("COMMAND_LONG")} == {42}


def test_a_booting_vehicle_reports_that_once() -> None:
    """A real ArduCopter can't be armed for 42 s after its start, which caused two events a second."""
    vehicle = Vehicle(ARDUPILOT)
    vehicle.ready = False
    bench = Bench(vehicle).found()
    assert bench.sink.links[-1] == (LinkState.UP, "still waking up: its pre-arm checks do not pass yet")
    links, events = len(bench.sink.links), len(bench.sink.events)
    for _ in range(10):
        bench.go_on(0.5)
        bench.hear(*chunks_of("PreArm: Waiting for Nav Checks", 2, 0))
        with pytest.raises(DriverError, match="the vehicle is still waking up"):
            bench.session.command(Takeoff(), bench.clock())
    assert len(bench.sink.links) == links
    assert [event.text for event in list(bench.sink.events)[events:]] == ["PreArm: Waiting for Nav Checks"]
    vehicle.ready = True
    bench.go_on(0.1)
    assert bench.sink.links[-1] == (LinkState.UP, "")
    vehicle.ready = False  # it was ready before: this has another cause
    bench.go_on(0.5)
    bench.hear(*chunks_of("PreArm: Compass not healthy", 2, 0), *chunks_of("PreArm: Compass not healthy", 2, 0))
    assert bench.sink.links[-1] == (LinkState.UP, "")
    assert [event.text for event in bench.sink.events].count("PreArm: Compass not healthy") == 2


def test_a_vehicle_started_long_ago_that_can_not_be_armed_is_not_booting() -> None:
    vehicle = Vehicle(ARDUPILOT)
    vehicle.ready, vehicle.boot_ms = False, 3_600_000
    bench = Bench(vehicle).found()
    assert bench.sink.links[-1] == (LinkState.UP, "")


def test_a_plane_is_shown_and_its_whole_recording_is_read() -> None:
    data, at, frames = recorded("mavlink/arduplane-flight.tlog").read_bytes(), 0, 0
    session, sink = MavlinkSession(options(), 0), RecordingSink()
    while at + 9 < len(data) and at + data[at + 9] + 16 <= len(data):
        now_ns = struct.unpack_from(">Q", data, at)[0] * 1000
        length = data[at + 9] + 8
        session.receive(data[at + 8 : at + 8 + length], PEER, now_ns, whole=True)
        frames += 1
        at += 8 + length
        for publish in session.drain():
            publish(_Timeless(sink))
    assert (frames, session.codec.frames, session.codec.damaged) == (417, 417, 0)
    newest = sink.newest
    assert newest is not None
    assert implausible(newest) == []
    assert None not in (newest.roll_rad, newest.pitch_rad, newest.yaw_rad, newest.altitude_m, newest.velocity_m_s)


class _Timeless(RecordingSink):
    """For a recording, whose clock is not ours."""

    def __init__(self, sink: RecordingSink) -> None:
        self.__dict__ = sink.__dict__

    def _check_time(self, what: str, captured_ns: int, now_ns: int) -> None:
        pass


KINDS = (
    *("HEARTBEAT", "ATTITUDE", "LOCAL_POSITION_NED", "GLOBAL_POSITION_INT", "SYS_STATUS", "EXTENDED_SYS_STATE"),
    *("GPS_RAW_INT", "STATUSTEXT", "PARAM_VALUE", "COMMAND_ACK", "TIMESYNC", "AUTOPILOT_VERSION", "DISTANCE_SENSOR"),
    *("HIGHRES_IMU", "RAW_IMU", "EKF_STATUS_REPORT", "ESTIMATOR_STATUS", "CURRENT_MODE", "BATTERY_STATUS"),
)


@settings(max_examples=120, deadline=None)
@given(
    st.lists(st.tuples(st.sampled_from(KINDS), st.binary(min_size=300, max_size=300)), max_size=12),
    st.sampled_from([ARDUPILOT, PX4]),
)
def test_hostile_messages_never_raise_and_feedback_stays_plausible(
    hostile: list[tuple[str, bytes]], autopilot: int
) -> None:
    """Well-formed frames with arbitrary bits in their fields, from the vehicle that is flown."""
    given_ = options("mavlink://udpin:127.0.0.1:14540")
    bench = Bench(Vehicle(autopilot), given_).found()
    for kind, noise in hostile:
        number = getattr(m, f"MAVLINK_MSG_ID_{kind}")
        made = m.mavlink_map[number]
        bench.session.receive(_frame(made, noise), PEER, bench.clock(), whole=True)
        bench.clock.advance(0.02)
        with suppress(DriverError):
            bench.session.command(Hover(), bench.clock())
        bench.tick()
    for feedback in bench.sink.feedbacks:
        for name in ("roll_rad", "pitch_rad", "yaw_rad", "altitude_m", "battery", "battery_v"):
            value = getattr(feedback, name)
            assert value is None or math.isfinite(value), name
        for name in ("velocity_m_s", "position_m", "angular_velocity_rad_s", "acceleration_m_s2"):
            vector = getattr(feedback, name)
            assert vector is None or all(map(math.isfinite, vector)), name


def _frame(made: type, noise: bytes) -> bytes:
    size = made.unpacker.size  # type: ignore[attr-defined]
    head = struct.pack("<BBBBBBBHB", 0xFD, size, 0, 0, 0, 1, 1, made.id & 0xFFFF, made.id >> 16)  # type: ignore[attr-defined]
    check = m.x25crc(head[1:] + noise[:size])
    check.accumulate(bytes([made.crc_extra]))  # type: ignore[attr-defined]
    return head + noise[:size] + struct.pack("<H", check.crc)


@settings(max_examples=100, deadline=None)
@given(st.lists(st.binary(max_size=80), max_size=10))
def test_noise_never_raises(datagrams: list[bytes]) -> None:
    bench = Bench(Vehicle(PX4)).found()
    for datagram in datagrams:
        bench.session.receive(datagram, PEER, bench.clock(), whole=True)
        bench.session.receive(datagram, ("10.0.0.1", 1), bench.clock(), whole=False)
        bench.tick()
    bench.go_on(0.1)
    assert bench.link() is LinkState.UP


def test_a_px4_is_ready_by_the_reports_that_it_really_sends() -> None:
    """It reports the outcome of its checks for its current mode, and never that the checks exist."""
    bench = Bench(Vehicle(PX4)).found()
    vehicle = bench.vehicle

    def ready() -> object:
        bench.go_on(1.0)
        return (bench.newest.native or {}).get("mavlink.ready")

    assert ready() is True
    vehicle.ready = False
    assert ready() is False, "in a take-off's first mode the report counts"
    for mode in ("OFFBOARD", "AUTO.LAND", "AUTO.RTL", "POSCTL"):  # modes that flights leave behind
        vehicle.mode = mode
        assert ready() is True, f"{mode} says nothing about a take-off's first mode"
    vehicle.flags = 0x07
    assert ready() is False, "it does not know where it is"


def test_a_px4_at_rest_is_not_lost_and_a_flying_one_is() -> None:
    bench = Bench(Vehicle(PX4)).found()
    bench.vehicle.flags = 0x9F
    bench.go_on(2.0)
    assert "the vehicle does not know where it is" not in bench.texts
    bench.flying("OFFBOARD")
    bench.go_on(2.0)
    assert "the vehicle does not know where it is" in bench.texts


def test_a_px4_that_lifts_off_is_not_lost_by_its_report_at_rest() -> None:
    """A real one reports its estimator once a second: the newest may be 0.33 s from before the lift-off."""
    bench = Bench(Vehicle(PX4)).found()
    bench.vehicle.flags = 0x9F
    bench.go_on(2.0)
    bench.flying("AUTO.TAKEOFF", 0.3)
    bench.go_on(0.5)
    bench.vehicle.flags = 0x1F
    bench.go_on(3.0)
    assert "the vehicle does not know where it is" not in bench.texts


def test_an_arducopter_that_assumes_its_position_is_lost_at_rest_too() -> None:
    bench = Bench(Vehicle(ARDUPILOT)).found()
    bench.vehicle.flags = 0x9F
    bench.go_on(2.0)
    assert "the vehicle does not know where it is" in bench.texts


def test_the_limits_in_force_are_reported_at_the_start() -> None:
    bench = Bench(Vehicle(PX4), options("mavlink://udpin:127.0.0.1:14540?parameters=no&speed=4&altitude=12")).found()
    assert any(text.startswith("limits: 4 m/s, 1 m/s up and down, 12 m high") for text in bench.texts)


def gps(fix: int) -> m.MAVLink_gps_raw_int_message:
    return m.MAVLink_gps_raw_int_message(0, fix, 0, 0, 0, 0, 0, 0, 0, 9)


def on_earth(bench: Bench, latitude_e7: int, longitude_e7: int, up_m: float) -> m.MAVLink_global_position_int_message:
    up_mm = round((488.0 + up_m) * 1000)
    boot_ms = bench.vehicle.boot_ms
    return m.MAVLink_global_position_int_message(boot_ms, latitude_e7, longitude_e7, up_mm, 0, 0, 0, 0, 0)


@AUTOPILOTS
def test_the_origin_of_its_axes_is_known_with_a_fix(autopilot: int) -> None:
    bench = Bench(Vehicle(autopilot))
    bench.found()
    metres_per_e7 = 0.011131884502145034 if autopilot == ARDUPILOT else math.radians(1e-7) * 6_371_000.0
    boot_ms = bench.vehicle.boot_ms
    # It flies north at 10 m/s, and reported one position 0.1 s before the other.
    local = m.MAVLink_local_position_ned_message(boot_ms - 100, 99.0, 50.0, -20.0, 10.0, 0.0, 0.0)
    north_e7, east_e7 = round(100.0 / metres_per_e7), round(50.0 / metres_per_e7)

    def told(fix: int) -> None:
        bench.hear(gps(fix), local, on_earth(bench, north_e7, east_e7, 20.0))
        bench.hear(m.MAVLink_attitude_message(boot_ms, 0, 0, 0, 0, 0, 0))

    told(2)
    assert bench.newest.origin is None, "an origin without a fix may be anywhere"
    told(3)
    origin = bench.newest.origin
    assert origin is not None
    assert (origin.latitude_deg, origin.longitude_deg) == pytest.approx((0.0, 0.0), abs=2e-7)
    assert origin.altitude_m == pytest.approx(488.0)
    assert origin.position_of(north_e7 / 1e7, east_e7 / 1e7, 508.0) == pytest.approx((50.0, 100.0, 20.0), abs=0.02)


@AUTOPILOTS
def test_positions_are_relative_to_the_worlds_origin(autopilot: int) -> None:
    world = options("mavlink://udpin:127.0.0.1:14540?parameters=no&world_origin=0,0,480")
    bench = Bench(Vehicle(autopilot), world)
    bench.hear(bench.vehicle.heartbeat())
    bench.tick()
    assert m.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN in [each.param1 for each in bench.heard_of("COMMAND_LONG")]
    bench.flying("GUIDED" if autopilot == ARDUPILOT else "OFFBOARD")
    assert bench.newest.position_m is None, "the autopilot's own origin is not known yet"
    bench.hear(m.MAVLink_gps_global_origin_message(898, -180, 488_000))  # 10 m north, 2 m west, 8 m up
    bench.go_on(0.1)
    assert bench.newest.position_m == pytest.approx((-2.0, 10.0, 11.0), abs=0.02)
    bench.apply(Position(x=-1.0, y=10.0, z=11.0))
    bench.go_on(2.0)
    sent = bench.heard_of("SET_POSITION_TARGET_LOCAL_NED")[-1]
    assert (sent.x, sent.y, sent.z) == pytest.approx((0.0, 1.0, -3.0), abs=0.02), "in the autopilot's own axes"
    bench.go_on(3.0, silent=True)
    bench.go_on(0.5)
    assert bench.newest.position_m is None, "it may have rebooted while the link was lost"


def test_external_poses_are_sent_in_the_autopilots_axes() -> None:
    bench = Bench(Vehicle(PX4), options("mavlink://udpin:127.0.0.1:14540?parameters=no&world_origin=0,0,480")).found()
    pose = ExternalPose((1.0, 2.0, 3.0), (0.0, 0.0, 0.0, 1.0), bench.clock())
    bench.session.send(pose_message(pose, PoseMessage.ODOMETRY))
    bench.tick()
    assert not bench.heard_of("ODOMETRY"), "they are not known yet"
    bench.hear(m.MAVLink_gps_global_origin_message(898, 0, 480_000))
    bench.session.send(pose_message(pose, PoseMessage.ODOMETRY))
    bench.tick()
    (told,) = bench.heard_of("ODOMETRY")
    assert (told.x, told.y, told.z) == pytest.approx((2.0 - 10.0, 1.0, -3.0), abs=0.02)


def test_neither_poses_that_may_be_read_late_nor_old_ones_are_sent() -> None:
    """An autopilot that dates a pose by its arrival takes it for a jump. Poses used to be sent for 2.5 s of silence."""
    bench = Bench(Vehicle(PX4)).found()

    def problem(age_s: float = 0.0) -> str:
        return bench.session.pose_problem(bench.clock() - round(age_s * 1e9), bench.clock())

    assert (problem(), problem(0.4)) == ("", "")
    assert problem(0.6) == "an external pose is 0.6 s old, at most 0.5 s"
    bench.go_on(0.6, silent=True)
    assert "the vehicle is silent just now" in problem()
    bench.go_on(3.0, silent=True)
    assert "no data from the vehicle" in problem()
    bench.go_on(1.0)
    assert problem() == ""
    bench.session._receives_us = False
    assert problem() != "", "nothing shows yet that it receives us"


def test_positions_of_different_times_are_not_paired() -> None:
    bench = Bench(Vehicle(ARDUPILOT))
    bench.found()
    before = bench.newest.origin
    late = m.MAVLink_local_position_ned_message(bench.vehicle.boot_ms - 700, 99.0, 50.0, -20.0, 10.0, 0.0, 0.0)
    bench.hear(gps(3), late, on_earth(bench, 90_000, 0, 20.0))
    bench.hear(m.MAVLink_attitude_message(bench.vehicle.boot_ms, 0, 0, 0, 0, 0, 0))
    origin = bench.newest.origin
    assert before is None
    assert origin is None or origin.latitude_deg < 1e-3, "only an earlier pair"


def test_a_vehicle_is_polled_as_often_as_its_activity_needs() -> None:
    bench = Bench(Vehicle(ARDUPILOT)).found()

    def next_ns() -> int:
        bench.tick()
        return bench.session.due_ns - bench.clock()

    assert next_ns() == REST_NS, "on the ground with nothing to do"
    bench.session.parameters.request_all(bench.clock())
    assert next_ns() == TICK_NS, "while parameters are read"
    bench.session.parameters.complete = True
    bench.flying("GUIDED")
    bench.session.command(Velocity(0.5), bench.clock())
    assert bench.session.due_ns == bench.clock(), "a command is sent at once"
    assert next_ns() == 2 * TICK_NS, "and is repeated 25 times a second"
    bench.clock.advance(0.01)
    assert next_ns() == 2 * TICK_NS - 10_000_000, "also when polled earlier"
    bench.session.command(Hover(), bench.clock())
    bench.tick()
    due_ns = bench.session.due_ns
    bench.session.command(Idle(), bench.clock())
    bench.session.command(Hover(), bench.clock())
    assert bench.session.due_ns == due_ns, "a running action is not hurried"
    bench.session.command(Land(), bench.clock())
    assert bench.session.setpoints is not None
    assert bench.session.setpoints.goal is Goal.LAND
    assert bench.session.due_ns <= bench.clock(), "it starts at once"
    assert next_ns() == STEP_NS, "and is followed step by step"
    bench.session.command(EmergencyStop(), bench.clock())
    assert bench.session.due_ns <= bench.clock()
    assert next_ns() == TICK_NS, "a stop is hurried"


@AUTOPILOTS
def test_a_resting_vehicle_is_missed_in_time_and_its_mode_seen_at_once(autopilot: int) -> None:
    bench = Bench(Vehicle(autopilot)).found()
    heard_ns = bench.clock()
    for wanted, after_ns in ((LinkState.DEGRADED, DEGRADED_NS), (LinkState.LOST, LOST_NS)):
        while bench.link() is not wanted:
            bench.clock.advance((bench.session.due_ns - bench.clock()) / 1e9)
            bench.tick()
        assert bench.clock() - heard_ns == pytest.approx(after_ns, abs=1000)
    bench.found()
    bench.tick()
    bench.hear(bench.vehicle.heartbeat())
    assert bench.session.due_ns > bench.clock(), "no news"
    bench.vehicle.armed = True
    for message in (bench.vehicle.heartbeat(), m.MAVLink_current_mode_message(0, 1, 1)):
        bench.clock.advance(0.001)
        bench.tick()
        bench.hear(message)
        assert bench.session.due_ns <= bench.clock()


# Replaced vehicles, and apparent ones --------------------------------------------------------------------------------


def parameter(name: str, value: float, index: int = 0, count: int = 1) -> Message:
    return m.MAVLink_param_value_message(name.encode(), value, 9, count, index)


def version_of(serial: int) -> Message:
    none = [0] * 8
    return m.MAVLink_autopilot_version_message(0, 0x01110000, 0, 0, 0, none, none, none, 0, 0, serial)


def known(bench: Bench, serial: int = 0) -> Bench:
    """Read a vehicle's parameters and version, with a serial number if it has one."""
    bench.found()
    bench.hear(parameter("MPC_THR_HOVER", 0.7))
    if serial:
        bench.hear(version_of(serial))
    bench.go_on(0.2)
    assert bench.link() is LinkState.UP
    return bench


def modes_set(bench: Bench) -> set[float]:
    return {each.param2 for each in bench.heard_of("COMMAND_LONG") if each.command == m.MAV_CMD_DO_SET_MODE}


WITH_PARAMETERS = "mavlink://udpin:127.0.0.1:14540"


@pytest.mark.parametrize("silent_s", [10.0, 0.0])
def test_another_autopilot_with_the_same_id_is_never_flown_with_the_first_ones_modes(silent_s: float) -> None:
    """A PX4, then an ArduCopter on the same port, where PX4's mode numbers mean GUIDED and RTL."""
    bench = known(Bench(Vehicle(PX4), options(WITH_PARAMETERS)), serial=7)
    bench.go_on(silent_s, silent=True)
    bench.vehicle = Vehicle(ARDUPILOT)
    bench.said.clear()
    bench.flying("LOITER")
    bench.go_on(1.0)
    assert "ArduCopter" in bench.session.description
    assert (bench.newest.native or {})["mavlink.mode"] == "LOITER"
    assert not bench.session.parameters.values, "the other vehicle's are gone"
    assert any("another vehicle" in text for text in bench.texts)
    bench.apply(Hover())
    bench.go_on(2.0)
    assert modes_set(bench) == {COPTER_NUMBERS["GUIDED"]}
    bench.apply(Land())
    bench.go_on(2.0)
    assert modes_set(bench) == {COPTER_NUMBERS["LAND"]}


def test_an_unsupported_vehicle_in_the_place_of_another_is_not_flown() -> None:
    bench = known(Bench(Vehicle(ARDUPILOT), options(WITH_PARAMETERS)))
    bench.go_on(3.0, silent=True)
    bench.vehicle.kind = 1  # a plane
    bench.found()
    with pytest.raises(DriverError, match="not a multirotor"):
        bench.apply(Hover())


def test_another_airframe_of_the_same_kind_is_read_again() -> None:
    """Recognised by its serial number; everything known of the first one is dropped."""
    bench = known(Bench(Vehicle(PX4), options(WITH_PARAMETERS)), serial=7)
    bench.go_on(3.0, silent=True)
    bench.vehicle = Vehicle(PX4)
    bench.found()
    assert bench.link() is LinkState.DEGRADED, "its identity is not known yet"
    bench.hear(version_of(8))
    bench.go_on(0.1)
    assert not bench.session.parameters.values
    assert bench.heard_of("PARAM_REQUEST_LIST")
    assert bench.link() is LinkState.DEGRADED
    bench.hear(parameter("MPC_THR_HOVER", 0.3))
    bench.go_on(0.1)
    assert bench.link() is LinkState.UP


def test_the_same_vehicle_is_up_again_without_reading_its_parameters() -> None:
    bench = known(Bench(Vehicle(PX4), options(WITH_PARAMETERS)), serial=7)
    bench.go_on(3.0, silent=True)
    bench.found()
    bench.hear(version_of(7))
    bench.go_on(0.1)
    assert bench.link() is LinkState.UP
    assert not bench.heard_of("PARAM_REQUEST_LIST")
    assert bench.session.parameters.values


@pytest.mark.parametrize("serial", [0, 7])
def test_a_vehicle_without_an_identity_is_read_again(serial: int) -> None:
    bench = known(Bench(Vehicle(PX4), options(WITH_PARAMETERS)), serial=serial)
    bench.go_on(3.0, silent=True)
    bench.hear(bench.vehicle.heartbeat())
    bench.go_on(2.5)
    assert bench.heard_of("PARAM_REQUEST_LIST")
    assert bench.link() is LinkState.DEGRADED
    bench.hear(parameter("MPC_THR_HOVER", 0.7))
    bench.go_on(0.1)
    assert bench.link() is LinkState.UP


def test_a_late_message_is_not_a_reboot() -> None:
    """One attitude is 1.5 s late: no loss, no missing set-point, and it does not count as the newest."""
    bench = Bench(Vehicle(ARDUPILOT)).flying("GUIDED")
    bench.apply(Velocity(forward=0.5))
    bench.go_on(1.0)
    bench.said.clear()
    for _ in range(3):
        at_ms, before = bench.vehicle.boot_ms - 1500, bench.newest.position_m
        late = m.MAVLink_attitude_message(at_ms, 1.5, 0.2, 0.0, 0.0, 0.0, 0.0)
        bench.hear(late, m.MAVLink_local_position_ned_message(at_ms, 9.0, 9.0, 9.0, 0.0, 0.0, 0.0), late)
        assert bench.newest.roll_rad == pytest.approx(0.1)
        assert bench.newest.position_m == before
        bench.go_on(1.0)
    assert bench.link() is LinkState.UP
    assert all(state is not LinkState.LOST for state, _ in bench.sink.links)
    sent = bench.heard_of("SET_POSITION_TARGET_LOCAL_NED")
    assert len(sent) >= 70
    assert all(each.vx == pytest.approx(0.5) for each in sent)


def test_a_serial_number_missing_in_one_protocol_version_is_not_another_vehicle() -> None:
    """MAVLink 1 truncates the longer one: then the shorter one decides, or none."""
    none = [0] * 8

    def said(serial: int, longer: int) -> Message:
        uid2 = [longer, *[0] * 17]
        return m.MAVLink_autopilot_version_message(0, 0, 0, 0, 0, none, none, none, 0, 0, serial, uid2)

    for before, after, reads in (((7, 9), (7, 0), 0), ((7, 9), (8, 9), 0), ((0, 9), (7, 0), 1), ((7, 9), (7, 8), 1)):
        bench = known(Bench(Vehicle(PX4), options(WITH_PARAMETERS)))
        bench.hear(said(*before))
        bench.go_on(3.0, silent=True)
        bench.found()
        bench.hear(said(*after))
        bench.go_on(0.5)
        assert len(bench.heard_of("PARAM_REQUEST_LIST")) == reads, (before, after)


def test_a_vehicle_that_stopped_reading_is_not_up_before_it_answers() -> None:
    """Our packets found no room: its heartbeats alone don't show that commands get through again."""
    bench = Bench(Vehicle(PX4)).found()
    bench.session.broken(ConnectionError("the vehicle no longer reads what we send"), bench.clock())
    bench.go_on(1.0)
    assert bench.link() is LinkState.DEGRADED
    assert (LinkState.LOST, "the connection failed: the vehicle no longer reads what we send") in bench.sink.links
    bench.answer(m.MAV_CMD_SET_MESSAGE_INTERVAL)
    bench.go_on(0.1)
    assert bench.link() is LinkState.UP


def test_a_vehicle_that_stopped_reading_gets_no_set_points_before_it_answers() -> None:
    """Nothing shows that the reopened port works: waiting set-points would be followed late."""
    bench = Bench(Vehicle(ARDUPILOT)).flying("GUIDED")
    bench.apply(Velocity(forward=0.5))
    bench.session.broken(ConnectionError("the vehicle no longer reads what we send"), bench.clock())
    bench.go_on(0.5)
    bench.said.clear()
    for _ in range(10):
        bench.apply(Velocity(forward=0.5))
        bench.go_on(0.1)
    assert not bench.heard_of("SET_POSITION_TARGET_LOCAL_NED")
    bench.apply(Land())
    bench.go_on(0.1)
    assert (m.MAV_CMD_DO_SET_MODE, 1, 9, 0, 0) in bench.commands(), "repeated commands are still sent"
    bench.answer(m.MAV_CMD_DO_SET_MODE)
    bench.apply(Hover())
    bench.go_on(0.1)
    assert bench.heard_of("SET_POSITION_TARGET_LOCAL_NED")


@pytest.mark.parametrize("way", ["udpin:127.0.0.1:14540", "tcp:127.0.0.1:5760"])
def test_a_paused_vehicle_is_left_with_few_set_points(way: str) -> None:
    """Sockets accepted all set-points of 2.5 s, and the vehicle followed them one by one when it resumed."""
    bench = Bench(Vehicle(ARDUPILOT), options(f"mavlink://{way}?parameters=no")).flying("GUIDED")
    bench.apply(Velocity(forward=0.5))
    bench.go_on(1.0)
    bench.said.clear()
    for _ in range(20):
        bench.apply(Velocity(forward=0.5))
        bench.go_on(0.1, silent=True)
    assert len(bench.heard_of("SET_POSITION_TARGET_LOCAL_NED")) <= 26, "half a second's worth"
    bench.go_on(0.1)
    bench.apply(Hover())
    bench.go_on(0.2)
    assert bench.heard_of("SET_POSITION_TARGET_LOCAL_NED")


@pytest.mark.parametrize("stop", [Hover(), Velocity()])
def test_a_hover_is_sent_to_a_silent_vehicle(stop: AnyAction) -> None:
    """It was held back with the other set-points: a vehicle that was only inaudible flew on for seconds."""
    bench = Bench(Vehicle(ARDUPILOT), options("mavlink://udpin:127.0.0.1:14540?parameters=no")).flying("GUIDED")
    bench.apply(Velocity(forward=0.5))
    bench.go_on(1.0)
    bench.go_on(0.7, silent=True)
    bench.said.clear()
    bench.apply(Velocity(forward=0.5))
    bench.go_on(0.2, silent=True)
    assert not bench.heard_of("SET_POSITION_TARGET_LOCAL_NED")
    bench.apply(stop)
    bench.go_on(0.2, silent=True)
    assert bench.heard_of("SET_POSITION_TARGET_LOCAL_NED")


@pytest.mark.parametrize("wanted", [Velocity(forward=-0.5), Velocity(left=0.3)])
def test_a_silent_vehicle_is_stopped_instead_of_redirected(wanted: Velocity) -> None:
    """If it was only inaudible, it flew on for up to 3 s in a direction that its pilot had left."""
    bench = Bench(Vehicle(ARDUPILOT), options("mavlink://udpin:127.0.0.1:14540?parameters=no")).flying("GUIDED")
    bench.apply(Velocity(forward=0.5))
    bench.go_on(1.0)
    bench.go_on(0.7, silent=True)
    bench.said.clear()
    bench.apply(wanted)
    bench.go_on(0.2, silent=True)
    told = bench.heard_of("SET_POSITION_TARGET_LOCAL_NED")
    assert len(told) >= 3
    assert {(each.vx, each.vy, each.vz, each.yaw_rate) for each in told} == {(0.0, 0.0, 0.0, 0.0)}
    bench.go_on(0.1)
    assert bench.heard_of("SET_POSITION_TARGET_LOCAL_NED")[-1].vx == pytest.approx(wanted.forward)


def test_a_vehicle_whose_only_answer_was_lost_is_asked_again() -> None:
    """It had reported its version, so nothing more was requested, and no set-point was ever sent again."""
    bench = Bench(Vehicle(ARDUPILOT)).flying("GUIDED")
    bench.apply(Velocity(forward=0.5))
    bench.session.broken(ConnectionError("the vehicle no longer reads what we send"), bench.clock())
    bench.go_on(0.1)
    bench.hear(version_of(1))
    bench.said.clear()
    bench.go_on(2.5)
    assert asked_for_its_version(bench) >= 2
    bench.answer(m.MAV_CMD_REQUEST_MESSAGE)
    bench.go_on(0.1)
    assert bench.link() is LinkState.UP
    bench.said.clear()
    bench.go_on(2.0)
    assert not asked_for_its_version(bench)


def asked_for_its_version(bench: Bench) -> int:
    told = [(each.command, each.param1) for each in bench.heard_of("COMMAND_LONG")]
    return told.count((m.MAV_CMD_REQUEST_MESSAGE, m.MAVLINK_MSG_ID_AUTOPILOT_VERSION))


def test_an_emergency_stop_precedes_everything() -> None:
    bench = Bench(Vehicle(ARDUPILOT)).flying("GUIDED")
    bench.apply(Velocity(forward=0.5))
    bench.session.command(EmergencyStop(), bench.clock())
    assert [packet.rank for packet in bench.session.poll(bench.clock())].count(Rank.STOP) == 1
    assert rank_of(m.MAVLink_command_long_message(1, 1, m.MAV_CMD_COMPONENT_ARM_DISARM, 0, *[0.0] * 7)) is Rank.COMMAND


def test_a_message_that_can_not_be_encoded_holds_no_stop_back() -> None:
    """After one pose with a number too large for its field, nothing that was due with it was sent."""
    bench = Bench(Vehicle(ARDUPILOT)).flying("GUIDED")
    pose = ExternalPose((1e39, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0), bench.clock())
    bench.session.command(EmergencyStop(), bench.clock())
    bench.session.send(pose_message(pose, PoseMessage.ODOMETRY))
    bench.tick()
    assert [each.param2 for each in bench.heard_of("COMMAND_LONG")] == [21196.0]
    bench.session.send(pose_message(pose, PoseMessage.ODOMETRY))
    bench.tick()
    assert sum("ODOMETRY was not sent" in text for text in bench.texts) == 1, "reported once"


def test_a_take_off_is_decided_by_a_single_state_of_the_vehicle(monkeypatch: pytest.MonkeyPatch) -> None:
    bench, read = Bench(Vehicle(ARDUPILOT)).found(), list[int]()
    state = MavlinkSession.vehicle_state

    def count(session: MavlinkSession, now_ns: int) -> VehicleState | None:
        read.append(now_ns)
        return state(session, now_ns)

    monkeypatch.setattr(MavlinkSession, "vehicle_state", count)
    bench.session.command(Takeoff(), bench.clock())
    assert len(read) == 1


# Nothing is received, but packets may arrive -------------------------------------------------------------------------


@pytest.mark.parametrize("way", ["udpin:127.0.0.1:14540", "udpout:10.0.0.5:14550", "tcp:127.0.0.1:5760"])
@pytest.mark.parametrize(("action", "mode"), [(Hover(), "BRAKE"), (Land(), "LAND")])
def test_actions_are_sent_to_a_vehicle_that_is_not_received(way: str, action: AnyAction, mode: str) -> None:
    """It may still receive us: the cause may be a dead receiver or a full downlink."""
    bench = Bench(Vehicle(ARDUPILOT), options(f"mavlink://{way}?parameters=no")).flying("GUIDED")
    bench.apply(Velocity(forward=0.5))
    bench.go_on(3.0, silent=True)
    assert bench.link() is LinkState.LOST
    bench.said.clear()
    bench.peers.clear()
    bench.apply(action)
    bench.go_on(10.0, silent=True)
    asked = [each for each in bench.heard_of("COMMAND_LONG") if each.command == m.MAV_CMD_DO_SET_MODE]
    assert 4 <= len(asked) <= 8, "for some seconds only: others may take it over meanwhile"
    assert {each.param2 for each in asked} == {COPTER_NUMBERS[mode]}
    assert bench.peers == {PEER}


@pytest.mark.parametrize("way", ["udpin:127.0.0.1:14540", "udpout:10.0.0.5:14550", "tcp:127.0.0.1:5760"])
def test_an_emergency_stop_is_sent_to_a_vehicle_that_is_not_received(way: str) -> None:
    bench = Bench(Vehicle(ARDUPILOT), options(f"mavlink://{way}?parameters=no")).flying("GUIDED")
    bench.go_on(3.0, silent=True)
    assert bench.link() is LinkState.LOST
    bench.said.clear()
    bench.peers.clear()
    bench.apply(EmergencyStop())
    assert [each.param2 for each in bench.heard_of("COMMAND_LONG")] == [21196.0], "at once"
    bench.go_on(2.0, silent=True)
    assert len(bench.heard_of("COMMAND_LONG")) >= 5
    assert bench.peers == {PEER}


def test_a_vehicle_that_is_not_received_gets_few_heartbeats_so_that_its_failsafe_acts() -> None:
    """A failsafe's hover and landing aren't sent blindly, as a safety pilot may have it: its own failsafe must act."""
    bench = Bench(Vehicle(ARDUPILOT)).flying("GUIDED")
    bench.apply(Velocity(forward=0.5))
    bench.go_on(3.0, silent=True)
    assert bench.link() is LinkState.LOST
    bench.said.clear()
    bench.apply(Hover(), alone=True)
    bench.go_on(5.0, silent=True)
    bench.apply(Land(), alone=True)
    bench.go_on(5.0, silent=True)
    assert not bench.said, "10 s of silence"
    bench.go_on(20.0, silent=True)
    assert 1 <= len(bench.heard_of("HEARTBEAT")) <= 2, "a few, for a vehicle that has lost our address"
    bench.go_on(1.2)
    assert bench.heard_of("HEARTBEAT")


def test_a_landing_of_a_vehicle_that_is_not_received_expires() -> None:
    bench = Bench(Vehicle(ARDUPILOT)).flying("GUIDED")
    bench.go_on(3.0, silent=True)
    bench.apply(Land(), alone=True)
    bench.go_on(3.1, silent=True)
    assert [event.data["reason"] for event in bench.sink.events][-1] == "landing_given_up"
    bench.go_on(600.0, silent=True)
    bench.said.clear()
    bench.go_on(2.0)
    assert not modes_set(bench), "it may be another flight"


def test_an_emergency_stop_outlives_the_vehicles_state() -> None:
    """It was pressed during silence, and dropped when another serial number answered."""
    bench = known(Bench(Vehicle(PX4), options(WITH_PARAMETERS)), serial=7)
    bench.flying("OFFBOARD")
    bench.go_on(3.0, silent=True)
    bench.apply(EmergencyStop())
    bench.go_on(1.0, silent=True)
    bench.hear(bench.vehicle.heartbeat())
    bench.hear(version_of(8))
    assert any("another vehicle" in text for text in bench.texts)
    bench.said.clear()
    bench.go_on(1.0)
    cuts = [each for each in bench.heard_of("COMMAND_LONG") if each.command == m.MAV_CMD_COMPONENT_ARM_DISARM]
    assert len(cuts) >= 5
    bench.go_on(10.0)
    assert "stop_given_up" in [event.data.get("reason") for event in bench.sink.events]


def cuts(bench: Bench) -> int:
    return [each[:3] for each in bench.commands()].count((m.MAV_CMD_COMPONENT_ARM_DISARM, 0.0, 21196.0))


def test_an_emergency_stop_of_an_unknown_vehicle_is_sent_and_kept_until_it_is_found() -> None:
    """As after a restart of its proxy in flight."""
    bench = Bench(Vehicle(ARDUPILOT, system=7), options("mavlink://udpout:10.0.0.5:14550?parameters=no&sysid=7"))
    assert bench.apply(EmergencyStop()) == EmergencyStop()
    bench.go_on(1.0, silent=True)
    assert [each.target_system for each in bench.said if each.get_type() == "COMMAND_LONG"][:1] == [7]
    assert cuts(bench) >= 9
    bench.flying("GUIDED")
    bench.go_on(0.5)
    assert cuts(bench) >= 4
    bench.vehicle.armed = False
    bench.go_on(0.5)
    assert bench.state() is FlightState.EMERGENCY


def test_an_emergency_stop_of_a_vehicle_found_much_later_expires() -> None:
    bench = Bench(Vehicle(ARDUPILOT))
    bench.apply(EmergencyStop())
    bench.go_on(11.0, silent=True)
    bench.said.clear()
    bench.flying("GUIDED")
    bench.go_on(1.0)
    assert not cuts(bench)
    assert "stop_given_up" in [event.data.get("reason") for event in bench.sink.events]


def test_a_silent_vehicle_on_the_ground_is_called_each_second() -> None:
    bench = Bench(Vehicle(ARDUPILOT)).found()
    bench.go_on(3.0, silent=True)
    bench.said.clear()
    bench.go_on(5.0, silent=True)
    assert len(bench.heard_of("HEARTBEAT")) >= 4


# Several of one thing, and one thing from elsewhere ------------------------------------------------------------------


def battery(number: int, percent: int, function: int = 0) -> Message:
    return m.MAVLink_battery_status_message(number, function, 1, 0, [65535] * 10, -1, -1, -1, percent)


def test_the_first_of_two_batteries_counts() -> None:
    """The second may power a gimbal or be nearly empty: its charge is not the flight's."""
    bench = Bench(Vehicle(ARDUPILOT))
    bench.hear(bench.vehicle.heartbeat())
    told = set()
    for step in range(40):
        bench.clock.advance(0.5)
        bench.hear(bench.vehicle.heartbeat(), battery(1, 5))
        if step % 20 < 4:
            bench.hear(battery(0, 80))
        told.add(bench.newest.battery)
    assert told == {0.8, None}, "unknown while the first is silent, not the other's"


def test_a_payloads_battery_does_not_count() -> None:
    bench = Bench(Vehicle(ARDUPILOT))
    bench.hear(bench.vehicle.heartbeat(), battery(0, 5, function=4), battery(1, 80), bench.vehicle.heartbeat())
    assert bench.newest.battery == 0.8


@pytest.mark.parametrize("facings", [(25, 0), (0, 25), (25, 25)])
def test_the_downward_range_finder_counts(facings: tuple[int, int]) -> None:
    """2.0 m to the ground, and 5.0 m to a wall or by a second downward sensor."""
    bench = Bench(Vehicle(ARDUPILOT)).found()
    below = facings.index(25)
    told = set()
    for _ in range(20):
        for number, facing in enumerate(facings):
            distance = 200 if number == below else 500
            bench.hear(m.MAVLink_distance_sensor_message(0, 10, 3000, distance, 0, number, facing, 0))
            bench.hear(m.MAVLink_extended_sys_state_message(0, 1), *bench.vehicle.telemetry())
            told.add(bench.newest.altitude_m)
        bench.go_on(0.04)
    assert told - {0.0} == {2.0}


def test_a_vehicle_that_continues_from_another_port_is_received_at_once() -> None:
    """Its host, or an address translation, gave it a new port in flight."""
    bench = Bench(Vehicle(ARDUPILOT)).flying("GUIDED")
    bench.apply(Velocity(forward=0.5))
    bench.go_on(1.0)
    moved = ("127.0.0.1", 33_333)
    deaf_s = 0.0
    while bench.session.identity is None or bench.session.identity.peer != moved:
        bench.clock.advance(0.02)
        bench.vehicle.boot_ms += 20
        bench.hear(*bench.vehicle.telemetry(), peer=moved)
        bench.tick()
        deaf_s += 0.02
    assert deaf_s < 0.5
    bench.peers.clear()
    for _ in range(150):
        bench.clock.advance(0.02)
        bench.vehicle.boot_ms += 20
        bench.hear(bench.vehicle.heartbeat(), *bench.vehicle.telemetry(), peer=moved)
        bench.tick()
    assert bench.link() is LinkState.UP
    assert all(state is not LinkState.LOST for state, _ in bench.sink.links)
    assert bench.peers == {moved}


@pytest.mark.parametrize("other", [("127.0.0.1", 33_333), ("10.0.0.7", 14_580)])
def test_a_second_vehicle_with_the_same_id_never_takes_over(other: tuple[str, int]) -> None:
    """Received beside the first one, or from another host: that is another vehicle, not the first one's new port."""
    bench = Bench(Vehicle(ARDUPILOT)).flying("GUIDED")
    bench.hear(bench.vehicle.heartbeat(), peer=other)
    bench.go_on(0.1)
    for _ in range(100):
        bench.clock.advance(0.02)
        bench.hear(*bench.vehicle.telemetry(), peer=other)
        bench.tick()
        assert bench.session.identity is None or bench.session.identity.peer == PEER


def test_a_lost_request_is_repeated_while_the_message_is_too_slow() -> None:
    """Unasked, PX4 sends positions once a second, which is not the requested rate."""
    bench = Bench(Vehicle(PX4))
    bench.hear(bench.vehicle.heartbeat())
    asked: list[float] = []
    for step in range(30 * 50):
        bench.clock.advance(0.02)
        bench.vehicle.boot_ms += 20
        if step % 10 == 0:
            bench.hear(bench.vehicle.heartbeat())
        for message in bench.vehicle.telemetry():
            if message.get_type() != "LOCAL_POSITION_NED" or step % 50 == 0 or len(asked) > 2:
                bench.hear(message)
        bench.tick()
        for each in bench.heard_of("COMMAND_LONG"):
            if each.command == m.MAV_CMD_SET_MESSAGE_INTERVAL and each.param1 == m.MAVLINK_MSG_ID_LOCAL_POSITION_NED:
                asked.append(step * 0.02)
    assert len(asked) == 3, "until it flows as requested"
    assert asked[2] < 8.0
