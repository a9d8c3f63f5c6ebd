"""Units of the driver: addresses, motion, settings, parameters, requests, INAV."""

from __future__ import annotations

import math
import random

import pytest

from skyloop.clock import NS_PER_S
from skyloop.drivers.base import ExternalPose
from skyloop.drivers.recording_sink import RecordingSink
from skyloop.drivers.uri import parse_uri
from skyloop.errors import DriverError, ParameterError, UnknownNameError, UsageError
from skyloop.messages import Attitude, EmergencyStop, FlightState, LinkState, ResetEmergency, Takeoff
from skyloop.vehicles.msp.driver import MspDriver
from skyloop.vehicles.msp.firmware import MspSetup, hindrances
from skyloop.vehicles.msp.parameters import DriverParameters, options_of
from skyloop.vehicles.msp.protocol import MspSession
from skyloop.vehicles.msp.setpoints import MspReport, MspSetpoints, Phase
from skyloop.vehicles.msp.telemetry import PATIENCE_NS, MotionEstimate, MspMotion, MspTelemetry, Questions, charge_left
from skyloop.vehicles.msp.wire import messages as msp
from skyloop.vehicles.msp.wire.frames import Direction, MspFrame, Parser, encode
from skyloop.vehicles.msp.wire.messages import Function, ModeRange, MspIdentity

# Addresses -----------------------------------------------------------------------------------------------------------


def test_addresses() -> None:
    tcp = options_of(parse_uri("msp://tcp:127.0.0.1:5761?rate=100"))
    assert (tcp.place, tcp.port, tcp.serial, tcp.rate_hz) == ("127.0.0.1", 5761, False, 100.0)
    serial = options_of(parse_uri("msp:///dev/ttyACM0?baud=230400&override"))
    assert (serial.place, serial.baud, serial.serial, serial.override) == ("/dev/ttyACM0", 230400, True, True)
    assert "230400 baud" in str(serial)
    assert options_of(parse_uri("msp:///COM3?baud=9600")).place == options_of(parse_uri("msp://com3")).place == "COM3"


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("msp://", "names no host or device"),
        ("msp://ttyACM0", "names no host or device"),
        ("msp://tcp:127.0.0.1", "names no host or device"),
        ("msp://tcp:127.0.0.1:0", "names no host or device"),
        ("msp://tcp:127.0.0.1:5761?baud=9600", "baud is for a serial port"),
        ("msp:///dev/ttyACM0?rate=5", "from 20 to 250"),
        ("msp:///dev/ttyACM0?speed=5", "option of msp://"),
    ],
)
def test_bad_addresses(text: str, told: str) -> None:
    with pytest.raises(UsageError, match=told):
        options_of(parse_uri(text))


# Motion --------------------------------------------------------------------------------------------------------------


def pose(place: tuple[float, float, float], at_ns: int, yaw: float = 0.0) -> ExternalPose:
    return ExternalPose(place, (0.0, 0.0, math.sin(yaw / 2), math.cos(yaw / 2)), at_ns)


@pytest.mark.parametrize("rate", [10, 50, 200])
def test_velocity_from_noisy_poses(rate: int) -> None:
    estimate, noise = MotionEstimate(), random.Random(1)
    for step in range(3 * rate):
        time_s = step / rate
        place = (0.5 * time_s + noise.gauss(0, 0.001), -0.3 * time_s, 1.0 + noise.gauss(0, 0.001))
        estimate.on_pose(pose(place, step * NS_PER_S // rate, yaw=0.4))
    motion = estimate.at(3 * NS_PER_S)
    assert motion.velocity_m_s == pytest.approx((0.5, -0.3, 0.0), abs=0.05)
    assert motion.yaw_rad == pytest.approx(0.4)
    assert motion.precise


def test_an_old_pose_expires_but_its_heading_does_not() -> None:
    estimate = MotionEstimate()
    estimate.on_attitude(msp.MspAttitude(0.0, 0.0, 90.0))  # east by the compass: yaw 0
    estimate.on_pose(pose((0.0, 0.0, 1.0), 0, yaw=1.0))
    estimate.on_pose(pose((0.0, 0.0, 1.0), NS_PER_S // 50, yaw=1.0))
    estimate.on_pose(pose((9.0, 9.0, 9.0), 0, yaw=2.0))  # older: ignored
    estimate.on_altitude(msp.Altitude(1.5, 0.1), NS_PER_S)
    motion = estimate.at(NS_PER_S)
    assert (motion.climb_m_s, motion.height_m, motion.velocity_m_s) == (0.1, 1.5, None)
    assert motion.yaw_rad == pytest.approx(1.0)
    assert estimate.at(3 * NS_PER_S).climb_m_s is None


def test_gps() -> None:
    estimate = MotionEstimate()
    estimate.on_attitude(msp.MspAttitude(0.0, 0.0, 0.0))
    estimate.on_gps(msp.Gps(True, 3, 1.0, 1.0, 0.0, 1.0, 0.0), 0)
    assert estimate.at(0).velocity_m_s is None, "three satellites are too few"
    estimate.on_gps(msp.Gps(True, 9, 47.0, 8.0, 400.0, 0.0, 0.0), 0)
    estimate.on_gps(msp.Gps(True, 9, 47.00001, 8.0, 401.0, 2.0, 90.0), 0)
    motion = estimate.at(0)
    assert motion.velocity_m_s == pytest.approx((2.0, 0.0, 0.0), abs=1e-9)
    assert motion.position_m == pytest.approx((0.0, 1.112, 1.0), abs=0.01)
    assert motion.yaw_rad == pytest.approx(math.pi / 2)
    assert estimate.origin is not None
    assert estimate.origin.latitude_deg == 47.0
    estimate.lost()
    assert estimate.at(0).velocity_m_s is None


# Settings ------------------------------------------------------------------------------------------------------------

BOXES = ((0, "ARM"), (1, "ANGLE"), (28, "AIR MODE"), (36, "PREARM"), (50, "MSP OVERRIDE"))
BETAFLIGHT = MspIdentity("BTFL", (4, 6, 0), (1, 47), "SITL")


def test_wanted_switches_are_on_and_no_others() -> None:
    setup = MspSetup(
        BETAFLIGHT,
        BOXES,
        (
            ModeRange(0, 0, 1700, 2100),
            ModeRange(1, 1, 1300, 1700),
            ModeRange(28, 1, 1700, 2100),  # air mode on the same switch, at higher values
            ModeRange(36, 5, 900, 1200),  # prearm while it is low
        ),
    )
    off, on = setup.aux_us(arm=False, given={}), setup.aux_us(arm=True, given={2: 1234, 0: 1000})
    assert len(off) == len(on) == 6
    assert off[0] < 1700 <= on[0], "the arm switch is used for nothing else"
    assert 1300 <= off[1] < 1700, "ANGLE, and no air mode"
    assert on[2] == 1234
    assert on[5] < 1200 <= off[5]


def test_inav_without_a_failsafe_is_refused() -> None:
    inav = MspIdentity("INAV", (8, 0, 0), (2, 5), "MATEKF405")
    setup = MspSetup(
        inav,
        BOXES,
        (ModeRange(0, 0, 1700, 2100), ModeRange(1, 1, 900, 2100)),
        failsafe=msp.FailsafeConfig(0.5, 20.0, 1000, 0.0, 3),
        receiver_is_msp=True,
    )
    assert "it does nothing" in hindrances(setup.diagnose(override=False))
    assert str(inav) == "INAV 8.0.0 on MATEKF405"
    unknown = MspSetup(inav, BOXES, setup.ranges, receiver_is_msp=False)
    told = hindrances(unknown.diagnose(override=False))
    assert "sticks do not arrive by MSP" in told
    assert "failsafe is unknown" in told


def test_charge() -> None:
    cells = msp.CellVoltages(3.3, 4.3)
    assert charge_left(msp.Battery(15.2, 0.0, 4), cells) == pytest.approx(0.5)
    assert charge_left(msp.Battery(15.2, 0.0, 4, 0.9), cells) == 0.9
    assert charge_left(msp.Battery(15.2, 0.0), cells) is None


# Parameters ----------------------------------------------------------------------------------------------------------


def test_parameters() -> None:
    setpoints = MspSetpoints()
    parameters = DriverParameters(setpoints)
    parameters.write("limits.tilt", 0.3)
    parameters.write("msp.aux3", 1700)
    parameters.write("msp.hover_throttle", 0.4)
    parameters.write("msp.full_stick.tilt", 0.7)
    parameters.write("msp.climb_p", 3)
    assert (setpoints.limits.tilt, setpoints.given_aux, setpoints.hover) == (0.3, {2: 1700}, 0.4)
    assert (setpoints.full_tilt, setpoints.gains.climb_p) == (0.7, 3.0)
    parameters.write("msp.aux3", 0)
    parameters.write("msp.hover_throttle", 0)
    assert (setpoints.given_aux, setpoints.hover) == ({}, None)
    for name, value, error in (
        ("limits.tilt", 9.0, ParameterError),
        ("limits.tilt", "much", ParameterError),
        ("msp.aux99", 1000, UnknownNameError),
    ):
        with pytest.raises(error):
            parameters.write(name, value)


# Requests ------------------------------------------------------------------------------------------------------------


def test_a_question_is_asked_three_times() -> None:
    answers: list[bytes | None] = []
    questions = Questions()
    questions.ask(1, answers.append)
    questions.ask(2, answers.append)
    for step in range(3):
        assert questions.due(step * PATIENCE_NS) == MspFrame(1)
        assert questions.due(step * PATIENCE_NS + 1) is None
    assert questions.due(3 * PATIENCE_NS) == MspFrame(2)
    assert answers == [None]
    assert not questions.on_frame(MspFrame(9, b"", Direction.REPLY))
    assert questions.on_frame(MspFrame(2, b"", Direction.ERROR))
    assert answers == [None, None]
    assert questions.idle


def test_states_are_requested_singly_or_together() -> None:
    single = MspTelemetry({1: 50.0, 2: 50.0, 3: 50.0})
    assert single.requests(0) == [MspFrame(1), MspFrame(2)], "at most two unanswered requests"
    assert single.requests(1) == []
    assert single.on_frame(MspFrame(2, b"b", Direction.REPLY)) == [(2, b"b")], "and the previous one is lost"
    assert single.unanswered == 1
    assert single.requests(2) == [MspFrame(3)]
    assert single.on_frame(MspFrame(3, b"", Direction.ERROR)) == [(3, None)]
    single.drop(3)
    assert all(frame.function != 3 for frame in single.requests(NS_PER_S))
    single.forget()
    assert single.on_frame(MspFrame(1, b"a", Direction.REPLY)) == []


def test_after_a_lost_answer_no_other_is_mistaken_for_it() -> None:
    together = MspTelemetry({1: 50.0, 2: 25.0, 3: 10.0}, (1, 2))
    assert together.requests(0) == [MspFrame(Function.MULTIPLE, b"\1\2"), MspFrame(3)]
    reply = MspFrame(Function.MULTIPLE, b"\1a\1b", Direction.REPLY)
    assert together.on_frame(reply) == [(1, b"a"), (2, b"b")]
    together.requests(NS_PER_S)
    together.requests(2 * NS_PER_S)  # the answers of a second ago never came
    assert together.unanswered == 2 + 1
    assert together.on_frame(reply) == [(1, b"a"), (2, b"b")]
    assert together.on_frame(MspFrame(Function.MULTIPLE, b"", Direction.ERROR)) == []
    assert together.due_ns() is not None


# INAV ----------------------------------------------------------------------------------------------------------------

REPLIES = {
    Function.API_VERSION: bytes((0, 2, 5)),
    Function.FC_VARIANT: b"INAV",
    Function.FC_VERSION: bytes((8, 0, 0)),
    Function.BOARD_INFO: b"MF4S\0\0\0\0\x0aMATEKF405S",
    Function.BOXIDS: bytes((0, 1)),
    Function.BOXNAMES: b"ARM;ANGLE;",
    Function.MODE_RANGES: msp.pack_mode_ranges([ModeRange(0, 0, 1700, 2100), ModeRange(1, 1, 900, 2100)]),
    Function.RX_MAP: bytes((0, 1, 3, 2)),
    Function.FAILSAFE_CONFIG: msp.FailsafeConfig(0.5, 20.0, 1000, 0.0, 1).encode(),
    Function.RC_TUNING: bytes((100, 70, 20, 20, 20, 0, 50, 0, 0, 0, 20)),
    Function.ATTITUDE: msp.MspAttitude(1.0, 2.0, 45.0).encode(),
    Function.ALTITUDE: msp.Altitude(0.2, 0.0).encode() + bytes(4),
    Function.INAV_ANALOG: bytes.fromhex("40a0066400000000000000000000000000000000004b"),
}


def inav_reply(frame: MspFrame, flags: int) -> MspFrame:
    status = bytes.fromhex("f401000063000500") + b"\x10" + flags.to_bytes(4, "little") + bytes((3, 0, 0, 0, 0, 0, 0, 0))
    settings = {b"receiver_type\0": b"\2", b"max_angle_inclination_rll\0": (300).to_bytes(2, "little")}
    if frame.function == Function.INAV_STATUS:
        return MspFrame(frame.function, status, Direction.REPLY)
    if frame.function == Function.COMMON_SETTING:
        return MspFrame(frame.function, settings[frame.payload], Direction.REPLY)
    if frame.function == Function.SET_RAW_RC:
        return MspFrame(frame.function, b"", Direction.REPLY)
    if frame.function in REPLIES:
        return MspFrame(frame.function, REPLIES[Function(frame.function)], Direction.REPLY)
    return MspFrame(frame.function, b"", Direction.ERROR)


def test_inav_is_identified_and_armed() -> None:
    session, parser, sink = MspSession(options_of(parse_uri("msp:///dev/ttyACM0")), 0), Parser(), RecordingSink()
    flags, sticks, now_ns = 0, [0], 0

    def run(seconds: float) -> None:
        nonlocal now_ns, sticks
        end_ns = now_ns + int(seconds * NS_PER_S)
        while now_ns < end_ns:
            now_ns += NS_PER_S // 200
            for frame in parser.feed(session.poll(now_ns)):
                if frame.function == Function.SET_RAW_RC:
                    sticks = msp.channels(frame.payload)
                session.receive(encode(inav_reply(frame, flags)), now_ns)
            for publish in session.drain():
                publish(sink)

    run(1.0)
    assert sink.link_state is LinkState.UP
    assert session.setup is not None
    assert session.setup.full_tilt_rad == pytest.approx(math.radians(30.0))
    assert session.setup.inav_yaw_rate_deg_s == 200.0
    assert not hindrances(session.setup.diagnose(override=False))
    assert sink.newest is not None
    assert sink.newest.battery == 0.75
    assert sink.newest.yaw_rad == pytest.approx(math.pi / 4)
    assert session.ask_takeoff(now_ns) == ""
    session.command(Attitude(climb=0.3), now_ns)
    run(0.2)
    assert (sticks[2], sticks[4] >= 1700) == (1000, True), "no throttle, and the arm switch is on"
    flags = 1 << 2
    run(1.0)
    assert sticks[2] > 1050, "armed: the throttle rises"
    flags = 1 << 8
    run(0.3)
    assert any("disarmed before it had taken off: NOT_LEVEL" in event.text for event in sink.events)
    with pytest.raises(DriverError, match="NOT_LEVEL"):
        session.command(Attitude(climb=0.3), now_ns)


# A pilot's receiver --------------------------------------------------------------------------------------------------


def test_a_pilot_hands_over_the_sticks_and_takes_them_back() -> None:
    setpoints = given_away()
    assert setpoints.left_to == ""
    assert setpoints.channels(NS_PER_S // 50)[2] == pytest.approx(1420, abs=2), "nothing jumps"
    setpoints.on_report(MspReport(armed=True), 2)
    assert setpoints.left_to == "RECEIVER"
    assert [event.data["active"] for event in setpoints.pop_events()] == [True, False]
    with pytest.raises(DriverError, match="at the pilot's receiver"):
        setpoints.apply(Attitude(climb=0.5), 3)


def test_a_pilots_switch_off_and_on_raises_no_throttle_after_a_stop_without_reset() -> None:
    setpoints = given_away()
    setpoints.apply(EmergencyStop(), 0)
    now_ns = 0

    def see(overridden: bool, seconds: float) -> int:
        """Return the throttle after this time [µs]."""
        nonlocal now_ns
        for _ in range(round(seconds / 0.02)):
            now_ns += NS_PER_S // 50
            setpoints.on_report(MspReport(armed=True, overridden=overridden), now_ns)
            if not overridden:
                setpoints.on_pilot_throttle(0.42)
            setpoints.step_stop(now_ns)
        return setpoints.channels(now_ns)[2]

    assert see(overridden=True, seconds=1.0) == 1000
    see(overridden=False, seconds=1.0)
    assert see(overridden=True, seconds=1.0) == 1000
    see(overridden=False, seconds=30.0)
    assert see(overridden=True, seconds=1.0) == 1000, "however long the pilot flies"
    assert setpoints.flight_state() is FlightState.EMERGENCY
    setpoints.apply(ResetEmergency(), now_ns)
    assert see(overridden=True, seconds=1.0) == 1000
    see(overridden=False, seconds=1.0)
    assert see(overridden=True, seconds=0.02) == pytest.approx(1420, abs=2), "after the reset it is adopted in flight"


def given_away() -> MspSetpoints:
    """Return a controller after a pilot flew by receiver at a throttle of 0.42 and handed over the sticks."""
    setpoints = MspSetpoints(override=True)
    setpoints.set_up(MspSetup(BETAFLIGHT, BOXES), "")
    setpoints.on_report(MspReport(armed=True), 0)
    assert setpoints.left_to == "RECEIVER"
    estimate = MotionEstimate()
    estimate.on_altitude(msp.Altitude(1.0, 0.0), 0)
    setpoints.on_motion(estimate.at(0))
    setpoints.on_pilot_throttle(0.42)
    setpoints.on_report(MspReport(armed=True, overridden=True), 1)
    return setpoints


@pytest.mark.parametrize("climbs", [False, True])
def test_a_vehicle_disarmed_in_its_take_off_is_not_armed_again_by_that_take_off(climbs: bool) -> None:
    """It tipped over, or a switch killed it: 20 ms later the software take-off armed it again."""
    setpoints = MspSetpoints()
    setpoints.set_up(MspSetup(BETAFLIGHT, BOXES), "")
    setpoints.receiving = True
    estimate = MotionEstimate()
    estimate.on_altitude(msp.Altitude(0.0, 0.0), 0)
    setpoints.on_motion(estimate.at(0))
    setpoints.on_report(MspReport(armed=False), 0)
    assert setpoints.ask_takeoff(1) == ""
    setpoints.apply(Attitude(climb=0.5), 1)
    setpoints.on_report(MspReport(armed=True), 2)
    if climbs:
        setpoints.phase = Phase.FLYING
    setpoints.on_report(MspReport(armed=False), 3)
    with pytest.raises(DriverError, match="disarmed"):
        setpoints.apply(Attitude(climb=0.5), 4)
    assert setpoints.phase is Phase.STANDING


def test_a_descent_that_seems_to_stall_high_above_the_ground_needs_more_to_be_a_landing() -> None:
    """A simulated world ran slower than the firmware's clock: its motors were stopped at 1.6 m, without an event."""
    setpoints, now_ns = MspSetpoints(), 0
    setpoints.set_up(MspSetup(BETAFLIGHT, BOXES), "")
    setpoints.receiving, setpoints.phase, setpoints.hover = True, Phase.FLYING, 0.4

    def descend(climb: float, height: float, time_s: float) -> Phase:
        nonlocal now_ns
        setpoints.apply(Attitude(climb=-0.5), now_ns)
        for _ in range(round(time_s / 0.02)):
            now_ns += 20_000_000
            setpoints.on_motion(MspMotion(climb_m_s=climb, height_m=height, precise=True))
            setpoints.channels(now_ns)
        return setpoints.phase

    descend(-0.4, 1.8, 1.0)
    assert descend(0.0, 1.6, 2.2) is Phase.FLYING
    throttle = setpoints.throttle
    assert descend(-0.3, 1.5, 0.5) is Phase.FLYING, "it fell once its throttle was low"
    assert setpoints.throttle > throttle
    descend(-0.4, 0.1, 0.5)
    assert descend(0.0, 0.0, 2.2) is Phase.STANDING
    setpoints.phase = Phase.FLYING
    descend(-0.4, 1.0, 0.5)
    assert descend(0.0, 1.0, 4.0) is Phase.STANDING, "on a table"


def test_a_vehicle_found_again_disarmed_can_take_off_at_once() -> None:
    """Its firmware restarted in flight: the earlier take-off is over, and none continues."""
    setpoints = MspSetpoints()
    setpoints.set_up(MspSetup(BETAFLIGHT, BOXES), "")
    estimate = MotionEstimate()
    estimate.on_altitude(msp.Altitude(1.0, 0.0), 0)
    setpoints.on_motion(estimate.at(0))
    setpoints.on_report(MspReport(armed=True), 1)
    setpoints.phase = Phase.FLYING
    setpoints.lost()
    setpoints.on_motion(estimate.at(2))
    setpoints.on_report(MspReport(armed=False), 3)
    assert setpoints.phase is Phase.STANDING
    assert setpoints.ask_takeoff(4) == ""


# Without a vehicle ---------------------------------------------------------------------------------------------------


def test_a_hopeless_take_off_is_refused_before_it_starts() -> None:
    driver = MspDriver(parse_uri("msp://tcp:127.0.0.1:1"))
    with pytest.raises(DriverError, match="is not open"):
        driver.check(Takeoff())
    driver.check(Attitude())
    sink = RecordingSink()
    driver.open(sink)
    try:
        with pytest.raises(DriverError, match="no data from the flight controller"):
            driver.check(Takeoff())
        assert sink.wait(lambda: sink.link_state is LinkState.LOST, 10.0)
        assert "TCP port 1" in sink.links[-1][1]
        assert driver.checkup()[0].what == "settings"
    finally:
        driver.close()
