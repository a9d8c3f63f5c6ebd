"""The session with an emulated board, in simulated time: arming, flight, refusals, silence, a pilot's switch."""

from __future__ import annotations

import math
import random
from contextlib import suppress
from dataclasses import replace

import pytest

from skyloop.clock import NS_PER_S
from skyloop.drivers.base import ExternalPose
from skyloop.errors import DriverError
from skyloop.messages import Attitude, EmergencyStop, FlightState, Hover, Idle, LinkState, ResetEmergency
from skyloop.vehicles.msp.emulator import EMPTY_WRITES, BoardSettings, bit
from skyloop.vehicles.msp.firmware import MspSetup
from skyloop.vehicles.msp.setpoints import MspReport, MspSetpoints, Phase
from skyloop.vehicles.msp.telemetry import MspMotion
from skyloop.vehicles.msp.wire.frames import Direction, MspFrame, encode
from skyloop.vehicles.msp.wire.messages import FailsafeConfig, Function, ModeRange, OnLoss, channels
from tests.vehicles.msp.bench import TICK_S, Bench, options


def test_it_learns_the_hover_throttle_and_holds_its_height() -> None:
    bench = Bench()
    bench.take_off(hover=None)
    bench.run(2.0)
    assert bench.feedback.state is FlightState.FLYING
    before = bench.height_m
    bench.run(3.0)
    assert abs(bench.climb_m_s) < 0.05
    assert abs(bench.height_m - before) < 0.3
    hover = bench.session.setpoints.hover
    assert hover is not None
    assert 0.27 < hover < 0.37, "the emulated racer hovers at 0.32"


def test_it_climbs_and_descends_as_requested() -> None:
    bench = Bench()
    bench.take_off()
    for climb in (0.8, -0.4):
        bench.fly(climb=climb)
        bench.run(2.5)
        assert bench.climb_m_s == pytest.approx(climb, abs=0.12)


@pytest.mark.parametrize("poses", [True, False])
def test_feedback_has_our_axes(poses: bool) -> None:
    bench = Bench(poses=poses)
    bench.take_off()
    bench.fly(roll=-0.1, pitch=0.15)
    bench.run(0.6)
    truth, feedback = bench.simulation.truth(0), bench.feedback
    assert feedback.roll_rad == pytest.approx(truth.roll_rad, abs=0.02)
    assert feedback.pitch_rad == pytest.approx(truth.pitch_rad, abs=0.02)
    assert truth.pitch_rad == pytest.approx(0.15, abs=0.02), "the stick leans it as far as requested"
    assert truth.roll_rad == pytest.approx(-0.1, abs=0.02)
    assert feedback.yaw_rad == pytest.approx(truth.yaw_rad, abs=math.radians(1))
    assert feedback.velocity_m_s is not None
    east, north, up = truth.velocity_m_s
    cos, sin = math.cos(truth.yaw_rad), math.sin(truth.yaw_rad)
    expected = (cos * east + sin * north, cos * north - sin * east, up)
    assert expected[0] > 0.4, "nose down is forward"
    assert expected[1] > 0.2, "left side down is left"
    assert feedback.velocity_m_s == pytest.approx(expected, abs=0.16)
    assert feedback.altitude_m == pytest.approx(bench.height_m - 0.04, abs=0.05)
    assert feedback.battery is not None
    assert 0.5 < feedback.battery <= 1.0


def test_it_turns_as_fast_as_requested() -> None:
    bench = Bench()
    bench.take_off()
    bench.fly(yaw_rate=0.7)
    bench.run(0.5)
    before = bench.simulation.truth(0).yaw_rad
    bench.run(1.0)
    assert bench.simulation.truth(0).yaw_rad - before == pytest.approx(0.7, abs=0.05)


def test_it_lands_and_disarms() -> None:
    bench = Bench()
    bench.take_off()
    bench.fly(climb=-0.4)
    bench.until(lambda: not bench.board.armed, 12.0)
    assert bench.height_m < 0.06
    bench.run(0.2)
    assert bench.feedback.state is FlightState.LANDED
    assert not bench.texts("disarmed"), "that was our own action"
    bench.fly(climb=0.5)  # and again
    bench.until(lambda: bench.height_m > 0.8, 20.0)


def test_a_descent_from_height_is_not_mistaken_for_the_ground() -> None:
    bench = Bench()
    bench.take_off()
    bench.fly(climb=1.0)
    bench.run(5.0)
    bench.fly(climb=-0.6)
    bench.run(4.0)
    assert bench.board.armed
    assert bench.height_m > 1.0
    assert bench.climb_m_s == pytest.approx(-0.6, abs=0.1)


NOISES = (0.05, 0.1, 0.2)  # of the climb [m/s]; that of a position of 1 cm is 0.056 m/s
SEEDS = 20


def descent(climb: float, noise: float, seed: int, seconds: float) -> tuple[MspSetpoints, list[float]]:
    """Return a vehicle asked to sink at 0.4 m/s, and its throttle as a share of the hover throttle."""
    setpoints, chance, now_ns, shares = MspSetpoints(), random.Random(seed), NS_PER_S, []
    setpoints.on_report(MspReport(True), now_ns)
    setpoints.adopt(0.3, now_ns)
    setpoints.apply(Attitude(climb=-0.4), now_ns)
    for tick in range(round(seconds / 0.02)):
        now_ns += NS_PER_S // 50
        true = climb if tick > 50 else -0.4
        setpoints.on_motion(MspMotion(climb_m_s=true + chance.gauss(0.0, noise), height_m=0.5, precise=True))
        setpoints.channels(now_ns)
        if setpoints.phase is Phase.STANDING:
            break
        shares.append(setpoints.throttle / (setpoints.hover or 1.0))
    return setpoints, shares


@pytest.mark.parametrize("noise", [0.0, *NOISES])
def test_a_touch_down_is_detected_despite_position_noise(noise: float) -> None:
    """It stayed armed while its throttle fell: the noise never stayed below 0.1 m/s for 0.6 s."""
    for seed in range(SEEDS):
        setpoints, shares = descent(0.0, noise, seed, 1.0 + 3.0)
        assert setpoints.phase is Phase.STANDING, seed
        assert setpoints.hover == pytest.approx(0.3, rel=0.2), "the hover throttle is not unlearnt"
        assert len(shares) * 0.02 > 1.0 + 0.6


@pytest.mark.parametrize("noise", [0.0, *NOISES])
def test_a_slow_descent_is_not_mistaken_for_a_touch_down(noise: float) -> None:
    for seed in range(SEEDS):
        setpoints, shares = descent(-0.15, noise, seed, 30.0)
        assert setpoints.phase is Phase.FLYING, seed
        assert min(shares) > 0.7, "the throttle is not reduced"


@pytest.mark.parametrize("climb", [-0.15, -0.4])
@pytest.mark.parametrize("noise", NOISES)
def test_a_landing_with_noisy_positions(noise: float, climb: float) -> None:
    bench = Bench()
    bench.take_off()
    bench.noise_m = noise / 5.6
    bench.fly(climb=climb)
    while bench.height_m > 0.06:
        bench.run(0.1)
        assert bench.board.armed
        assert bench.height_m < 0.3 or bench.climb_m_s > climb - 0.15
    bench.until(lambda: not bench.board.armed, 3.0)
    assert bench.height_m < 0.06


@pytest.mark.parametrize("noise_m", [0.018, 0.036])
@pytest.mark.parametrize("seed", range(3))
def test_noisy_heights_show_no_lift_off(noise_m: float, seed: int) -> None:
    """They did, on the ground: it stayed there armed, in flight mode, and learnt a useless hover throttle."""
    bench = Bench(seed=seed)
    bench.noise_m = noise_m
    stands_m = bench.height_m
    bench.ready()
    bench.fly(climb=0.7)
    bench.until(lambda: bench.session.setpoints.phase is Phase.FLYING, 20.0)
    assert 0.03 < bench.height_m - stands_m < 0.2
    assert bench.session.setpoints.hover == pytest.approx(0.32, abs=0.05)
    bench.until(lambda: bench.height_m > 1.0, 5.0)
    bench.fly(climb=-0.4)
    bench.until(lambda: not bench.board.armed, 8.0)
    bench.run(1.0)
    assert bench.feedback.altitude_m == pytest.approx(0.0, abs=0.06 + 2 * noise_m)


@pytest.mark.parametrize("world_speed", [1.0, 0.6, 0.45, 0.3])
def test_a_vehicle_still_rising_when_it_should_sink_is_not_on_the_ground(world_speed: float) -> None:
    """A real one overshot its height in a slow simulation: it was disarmed at 1.6 m, and fell."""
    bench = Bench()
    bench.take_off()
    bench.world_speed = world_speed
    for climb in (1.0, -0.5):
        bench.fly(climb=climb)
        bench.run(2.0)
        assert bench.board.armed
    bench.fly()
    bench.run(2.0)
    assert bench.board.armed
    assert bench.height_m > 0.7


def test_an_interrupted_take_off_disarms() -> None:
    bench = Bench()
    bench.ready()
    bench.fly(climb=0.5)
    bench.until(lambda: bench.board.armed, 2.0)
    bench.fly()
    bench.until(lambda: not bench.board.armed, 3.0)
    assert bench.height_m < 0.1


@pytest.mark.parametrize("climb", [0.0, -0.5])
def test_a_take_off_withdrawn_while_arming_does_not_arm_later(climb: float) -> None:
    """It armed as soon as the obstacle had passed, and its propellers turned for a second."""
    bench = Bench(BoardSettings(boot_s=4.0))
    bench.run(2.0)
    bench.fly(climb=0.7)
    bench.run(0.3)
    assert bench.feedback.native is not None
    assert bench.feedback.native["phase"] == "arming"
    bench.fly(climb=climb)
    with pytest.raises(AssertionError, match="not within"):
        bench.until(lambda: bench.board.armed, 5.0)
    assert bench.session.setpoints.phase is Phase.STANDING


def test_limits() -> None:
    bench = Bench()
    bench.take_off()
    setpoints = bench.session.setpoints
    applied = bench.session.command(Attitude(0.9, 0.9, 9.0, -9.0), bench.clock.now_ns)
    assert isinstance(applied, Attitude)
    assert math.hypot(applied.roll, applied.pitch) == pytest.approx(setpoints.limits.tilt)
    assert (applied.climb, applied.yaw_rate) == (setpoints.limits.climb, -setpoints.limits.yaw_rate)
    assert bench.session.command(Idle(), bench.clock.now_ns) == Idle()


# Refusals ------------------------------------------------------------------------------------------------------------


def test_a_refused_arming_is_reported_by_name() -> None:
    bench = Bench(BoardSettings(flags=bit("NO_ACC_CAL") | bit("ANGLE")))
    bench.run(2.0)
    with pytest.raises(DriverError, match=r"ANGLE \(it is not level\); NO_ACC_CAL \(its accelerometer was never"):
        bench.fly(climb=0.5)
    assert "NO_ACC_CAL" in str(bench.feedback.native and bench.feedback.native["arming.flags"])
    assert any(not each.good and "NO_ACC_CAL" in each.detail for each in bench.session.diagnose())


def test_an_obstacle_that_appears_while_arming_is_reported_by_name() -> None:
    bench = Bench(BoardSettings(boot_s=30.0))
    bench.run(2.0)
    bench.fly(climb=0.5)  # waits for temporary conditions
    bench.until(lambda: bool(bench.texts("arming_refused")), 10.0)
    assert "BOOTGRACE" in bench.texts("arming_refused")[0]
    assert not bench.board.armed
    with pytest.raises(DriverError, match="BOOTGRACE"):
        bench.fly(climb=0.5)


@pytest.mark.parametrize(
    ("settings", "told"),
    [
        (BoardSettings(ranges=(ModeRange(1, 1, 900, 2100),)), "no AUX channel arms it"),
        (BoardSettings(ranges=(ModeRange(0, 0, 1700, 2100),)), "no AUX channel switches ANGLE mode on"),
        (BoardSettings(rx_msp=False), "sticks do not arrive by MSP"),
        (BoardSettings(on_loss=()), "before the failsafe is unknown"),
        (BoardSettings(on_loss=((OnLoss.HOLD, 1500),) * 18), "holds the last roll, pitch, yaw, throttle"),
    ],
)
def test_unsafe_settings_are_refused(settings: BoardSettings, told: str) -> None:
    bench = Bench(settings)
    bench.run(2.0)
    with pytest.raises(DriverError, match=told):
        bench.fly(climb=0.5)
    assert any(told in text for text in bench.texts("setup"))
    assert bench.sink.link_state is LinkState.UP, "it can still be watched"


def test_a_late_failsafe_gets_a_warning() -> None:
    bench = Bench(BoardSettings(failsafe=FailsafeConfig(5.0, 10.0, 1300, 10.0, 0)))
    bench.run(1.0)
    assert any("only after 5 s" in text for text in bench.texts("setup"))
    bench.take_off()


def test_without_a_measured_climb_nothing_takes_off() -> None:
    bench = Bench(BoardSettings(barometer=False, gps=False), poses=False)
    bench.run(2.0)
    with pytest.raises(DriverError, match="its climb is not measured"):
        bench.fly(climb=0.5)


def test_one_pose_with_a_stamp_in_the_future_changes_nothing() -> None:
    """8 s ahead by a wrong clock, with poses as the only height: it would fly blind, and cut its motors."""
    bench = Bench(BoardSettings(barometer=False, gps=False))
    bench.take_off()
    now_ns, truth = bench.clock.now_ns, bench.simulation.truth(0)
    with pytest.raises(DriverError, match=r"stamped 8 s ahead"):
        bench.session.on_pose(ExternalPose((0.0, 0.0, 5.0), truth.quaternion, now_ns + 8 * NS_PER_S), now_ns)
    bench.session.on_pose(ExternalPose(truth.position_m, truth.quaternion, now_ns + NS_PER_S // 30), now_ns)
    for _ in range(10):
        bench.run(1.0)
        assert bench.session.motion.at(bench.clock.now_ns).precise
        assert bench.height_m == pytest.approx(truth.position_m[2], abs=0.3)
    assert not bench.texts("blind")


def test_other_firmware_is_not_flown() -> None:
    bench = Bench()
    bench.cut = True
    bench.tick()
    now_ns = bench.clock.now_ns
    identity = ((1, b"\0\1\x2a"), (2, b"CLFL"), (3, b"\2\6\0"), (4, b"ABCD"))
    for function, payload in ((101, bytes(20)), *identity, (101, bytes(20))):
        bench.session.poll(now_ns)
        bench.session.receive(encode(MspFrame(function, payload, Direction.REPLY)), now_ns)
    for publish in bench.session.drain():
        publish(bench.sink)
    assert bench.sink.link_state is LinkState.DEGRADED
    assert "'CLFL'" in bench.sink.links[-1][1]


# Silence -------------------------------------------------------------------------------------------------------------


def test_silence_makes_the_firmwares_failsafe_drop_it() -> None:
    bench = Bench()
    bench.take_off()
    bench.cut = True
    bench.until(lambda: not bench.board.armed, 1.6)
    assert bench.sink.link_state is LinkState.LOST
    bench.cut = False
    bench.until(lambda: bench.sink.link_state is LinkState.UP, 3.0)
    bench.run(0.5)
    assert bench.feedback.state is FlightState.LANDED
    bench.run(3.0)
    assert not bench.board.armed, "it is not armed again"


def test_a_vehicle_found_on_the_ground_stays_there() -> None:
    """The firmware was paused in flight and has disarmed; the hovering application continues to request a climb."""
    bench = Bench()
    bench.take_off()
    bench.cut = True
    bench.until(lambda: not bench.board.armed, 1.6)
    bench.cut = False
    bench.until(lambda: bench.sink.link_state is LinkState.UP, 3.0)
    for _ in range(300):
        with suppress(DriverError):
            bench.session.command(Attitude(climb=0.3), bench.clock.now_ns)
        bench.tick()
        assert bench.session.setpoints.phase is Phase.STANDING
    with pytest.raises(DriverError, match="take off first"):
        bench.session.command(Attitude(climb=0.3), bench.clock.now_ns)
    bench.fly(climb=0.7)
    bench.until(lambda: bench.height_m > 1.0, 20.0)


def test_an_old_take_off_request_does_not_start_now() -> None:
    bench = Bench()
    bench.ready()
    assert bench.session.ask_takeoff(bench.clock.now_ns) == ""
    bench.run(1.5)
    with pytest.raises(DriverError, match="take off first"):
        bench.session.command(Attitude(climb=0.3), bench.clock.now_ns)


def test_a_short_outage_is_flown_through() -> None:
    landing = FailsafeConfig(1.5, 10.0, 1310, 10.0, 0)
    on_loss = tuple((OnLoss.SET, 1310) if n == 3 else each for n, each in enumerate(BoardSettings().on_loss))
    bench = Bench(BoardSettings(failsafe=landing, on_loss=on_loss))
    bench.take_off()
    bench.fly(climb=0.8)
    bench.run(3.0)
    bench.fly()
    bench.cut = True
    bench.run(1.9)
    bench.cut = False
    bench.until(lambda: bench.sink.link_state is LinkState.UP, 3.0)
    bench.run(2.0)
    assert bench.board.armed
    assert bench.feedback.state is FlightState.FLYING
    assert bench.height_m > 0.5
    assert abs(bench.climb_m_s) < 0.3


def test_without_replies_it_sinks_level_and_is_disarmed() -> None:
    bench = Bench()
    bench.take_off()
    bench.fly(pitch=0.3)
    bench.run(0.3)
    bench.deaf = True
    bench.poses = False
    bench.run(1.5)
    assert abs(bench.simulation.truth(0).pitch_rad) < 0.03
    assert -3.0 < bench.climb_m_s < 0.05
    assert "sinks" in bench.texts("blind")[0]
    bench.until(lambda: not bench.board.armed, 7.0)


def test_poses_that_stop_leave_the_barometer() -> None:
    bench = Bench()
    bench.take_off()
    bench.poses = False
    bench.run(3.0)
    assert not bench.texts("blind")
    assert abs(bench.climb_m_s) < 0.1


def test_hover_survives_a_new_proxy() -> None:
    bench = Bench()
    bench.take_off()
    bench.reconnect()
    bench.until(lambda: bench.sink.link_state is LinkState.UP, 3.0)
    bench.run(2.0)
    assert bench.board.armed, "a new connection does not disarm it in flight"
    assert bench.feedback.state is FlightState.FLYING
    assert abs(bench.climb_m_s) < 0.15


def test_closing_disarms_a_vehicle_on_the_ground() -> None:
    bench = Bench()
    bench.ready()
    bench.fly(climb=0.5)
    bench.until(lambda: bench.board.armed, 2.0)
    words = bench.session.final_bytes(bench.clock.now_ns)
    assert channels(words[5:-1])[4] == 1000, "the arm switch is off"
    bench.until(lambda: not bench.board.armed, 1.0)
    bench.run(0.2)
    bench.take_off()
    assert bench.session.final_bytes(bench.clock.now_ns) == b""


def test_sticks_are_held_back_while_unacknowledged() -> None:
    bench = Bench()
    bench.ready()
    bench.deaf = True
    bench.run(0.2)
    before = len([frame for frame in bench.sent if frame.function == Function.SET_RAW_RC])
    bench.run(0.5)
    sent = len([frame for frame in bench.sent if frame.function == Function.SET_RAW_RC]) - before
    assert sent <= 21, "not the 25 of a healthy link: waiting sticks would be obeyed late"


def sticks(bench: Bench) -> list[list[int]]:
    """Return the stick frames sent."""
    return [channels(frame.payload) for frame in bench.sent if frame.function == Function.SET_RAW_RC]


def test_a_paused_flight_controller_is_left_with_few_sticks() -> None:
    """A pseudo-terminal or a socket accepted them all, and it obeyed seconds of old ones when it resumed."""
    bench = Bench()
    bench.take_off()
    bench.fly(pitch=0.3)
    bench.run(0.3)
    bench.sent.clear()
    bench.deaf = True
    for _ in range(20):
        bench.fly(pitch=0.3)
        bench.run(0.5)
    assert bench.sink.link_state is LinkState.LOST
    assert len(sticks(bench)) <= 4 + 9 + 3, "four, then ten a second until it is lost, then three"
    assert sticks(bench)[-1][:2] == [1500, 1500], "the last ones obeyed are level"


def test_only_requests_and_stops_are_sent_while_the_link_is_lost() -> None:
    bench = Bench()
    bench.take_off()
    bench.deaf = True
    bench.until(lambda: bench.sink.link_state is LinkState.LOST, 2.0)
    bench.run(0.4)
    bench.sent.clear()
    for _ in range(30):
        with suppress(DriverError):
            bench.session.command(Attitude(pitch=0.3, climb=0.5), bench.clock.now_ns)
        bench.run(0.1)
    assert not sticks(bench)
    assert len(bench.sent) >= 6, "requests continue"
    bench.session.command(EmergencyStop(), bench.clock.now_ns)
    bench.tick()
    assert sticks(bench)
    bench.deaf = False
    bench.until(lambda: bench.sink.link_state is LinkState.UP, 3.0)
    assert bench.feedback.state in (FlightState.EMERGENCY, FlightState.LANDED)


def test_a_vehicle_found_again_gets_no_sticks_before_it_reports_its_state() -> None:
    """Another pilot may have it by then, or it may be on the ground: earlier sticks are not for it."""
    bench = Bench()
    bench.take_off()
    bench.deaf = True
    bench.until(lambda: bench.sink.link_state is LinkState.LOST, 2.0)
    bench.run(0.4)
    bench.sent.clear()
    bench.deaf, bench.unanswered = False, {Function.STATUS_EX, Function.MULTIPLE}
    bench.run(1.0)
    assert not sticks(bench)
    bench.unanswered = set()
    bench.until(lambda: bool(sticks(bench)), 1.0)


@pytest.mark.parametrize("function", [Function.BOXNAMES, Function.MODE_RANGES, Function.RX_MAP])
def test_a_vehicle_found_again_in_flight_is_not_steered_by_guesses(function: Function) -> None:
    """One lost answer left its arm switch or stick order unknown: it was disarmed in the air."""
    bench = Bench()
    bench.take_off()
    bench.fly(climb=0.8)
    bench.run(2.0)
    bench.fly()
    bench.deaf = True
    bench.until(lambda: bench.sink.link_state is LinkState.LOST, 2.0)
    bench.deaf = False
    bench.unanswered = {function}
    for _ in range(45):
        bench.run(0.1)
        assert bench.board.armed
    assert abs(bench.climb_m_s) < 0.3
    assert len(bench.texts("setup_unread")) == 1
    bench.unanswered = set()
    bench.run(2.5)
    assert bench.board.armed
    assert len(bench.texts("firmware")) == 2, "they were finally read"


def test_the_order_of_the_sticks_is_requested_until_it_is_known() -> None:
    bench = Bench()
    bench.unanswered = {Function.RX_MAP}
    bench.run(5.0)
    assert LinkState.UP not in {state for state, _ in bench.sink.links}
    assert not [frame for frame in bench.sent if frame.function == Function.SET_RAW_RC]
    bench.unanswered = set()
    bench.until(lambda: bench.sink.link_state is LinkState.UP, 5.0)


# Stops ---------------------------------------------------------------------------------------------------------------


def test_emergency_stop_until_the_reset() -> None:
    bench = Bench()
    bench.take_off()
    bench.session.command(EmergencyStop(), bench.clock.now_ns)
    with pytest.raises(DriverError, match="motors still run"):
        bench.session.command(ResetEmergency(), bench.clock.now_ns)
    bench.until(lambda: not bench.board.armed, 0.2)
    bench.run(2.0)
    states = [bench.feedback.state]
    assert bench.session.command(Attitude(climb=0.5), bench.clock.now_ns) == Attitude()
    bench.session.command(ResetEmergency(), bench.clock.now_ns)
    bench.run(0.2)
    assert [*states, bench.feedback.state] == [FlightState.EMERGENCY, FlightState.LANDED]


def test_a_stop_is_sent_at_once_to_a_lagging_flight_controller() -> None:
    bench = Bench()
    bench.take_off()
    bench.deaf = True
    bench.run(0.1)
    bench.sent.clear()
    bench.session.command(EmergencyStop(), bench.clock.now_ns)
    bench.tick()
    assert [frame.function for frame in bench.sent if frame.function == Function.SET_RAW_RC]
    bench.tick()
    assert not bench.board.armed


@pytest.mark.parametrize("silent", [False, True])
@pytest.mark.parametrize("function", [Function.BOXNAMES, Function.MODE_RANGES, Function.RX_MAP])
def test_a_stop_reaches_a_vehicle_that_does_not_report_its_settings(function: Function, silent: bool) -> None:
    """It was not sent at all to a vehicle that a new proxy found in flight."""
    bench = Bench(BoardSettings(failsafe=FailsafeConfig(20.0, 60.0, 1000, 10.0, 1)))
    bench.take_off()
    bench.reconnect()
    (bench.unanswered if silent else bench.refused).add(function)
    bench.run(8.0)
    assert bench.board.armed
    bench.session.command(EmergencyStop(), bench.clock.now_ns)
    bench.until(lambda: not bench.board.armed, 0.1)


def test_a_stop_does_not_wait_for_settings() -> None:
    """A new proxy used to read nine answers first."""
    bench = Bench()
    bench.take_off()
    bench.reconnect()
    bench.session.command(EmergencyStop(), bench.clock.now_ns)
    bench.run(0.03)
    assert not bench.board.armed


#: An arm switch that is on when low, where every guess puts it.
INVERTED = BoardSettings(ranges=(ModeRange(0, 0, 900, 1300), ModeRange(1, 1, 900, 2100)))


@pytest.mark.parametrize("silent", [Function.STATUS, Function.MODE_RANGES, Function.RX_MAP, None])
@pytest.mark.parametrize("text", ["msp://tcp:127.0.0.1:5761", "msp://tcp:127.0.0.1:5761?override=1"])
def test_no_stop_arms_a_vehicle_on_the_ground(silent: Function | None, text: str) -> None:
    """Before its settings are read its arm switch is a guess, and a low one may be on."""
    bench = Bench(INVERTED)
    bench.ready()
    bench.reconnect(text)
    if silent is not None:
        bench.unanswered = {silent}
    bench.session.command(EmergencyStop(), bench.clock.now_ns)
    for tick in range(round(1.2 / TICK_S)):
        bench.tick()
        assert not bench.board.armed, f"armed by a stop {tick * TICK_S:.2f} s after it"


@pytest.mark.parametrize("silent", [Function.RX_MAP, Function.BOXNAMES])
def test_a_stop_keeps_the_switches_found_in_an_earlier_round(silent: Function) -> None:
    """While they were requested again, it fell back to guesses for some frames."""
    bench = Bench(INVERTED)
    bench.ready()
    bench.reconnect()
    bench.refused = {silent}
    bench.run(3.0)
    bench.session.command(EmergencyStop(), bench.clock.now_ns)
    bench.sent.clear()
    for _ in range(round(2.0 / TICK_S)):
        bench.tick()
        assert not bench.board.armed
    assert bool(sticks(bench)) is (silent is Function.RX_MAP), "without names it only reports that it is disarmed"
    assert all(widths[4] > 1300 for widths in sticks(bench))


@pytest.mark.parametrize("silent", [{Function.BOXNAMES}, {Function.BOXIDS}])
def test_a_stop_reaches_a_flying_vehicle_with_an_inverted_switch_and_unknown_modes(silent: set[int]) -> None:
    """It was sent throttle off with the arm switch on: its motors kept running, and nothing ended that."""
    bench = Bench(replace(INVERTED, failsafe=FailsafeConfig(20.0, 60.0, 1000, 10.0, 1)))
    bench.take_off()
    bench.reconnect()
    bench.unanswered = silent
    bench.run(8.0)
    assert bench.board.armed
    bench.session.command(EmergencyStop(), bench.clock.now_ns)
    bench.until(lambda: not bench.board.armed, 2.0)
    for _ in range(round(14.0 / TICK_S)):  # over several rounds of requests, and after it has expired
        bench.tick()
        assert not bench.board.armed


@pytest.mark.parametrize("silent", [Function.BOXNAMES, Function.BOXIDS, Function.MODE_RANGES])
def test_no_stop_arms_a_vehicle_with_unknown_state_and_mode_names(silent: Function) -> None:
    bench = Bench(INVERTED)
    bench.ready()
    bench.reconnect()
    bench.unanswered = {Function.STATUS, Function.STATUS_EX, silent}
    bench.session.command(EmergencyStop(), bench.clock.now_ns)
    for _ in range(round(14.0 / TICK_S)):
        bench.tick()
        assert not bench.board.armed


def test_a_stop_cuts_the_throttle_even_if_the_order_of_the_sticks_is_unknown() -> None:
    """The centre of roll may be half throttle; a stop without an arm switch was sent as such."""
    setpoints = MspSetpoints()
    setpoints.on_report(MspReport(True), 10**9)
    setpoints.apply(EmergencyStop(), 10**9)
    assert setpoints.channels(10**9)[:4] == [1000] * 4
    setpoints.set_up(MspSetup(sticks=(1, 2, 3, 0), sticks_known=True), "")
    assert setpoints.channels(10**9)[:4] == [1000, 1500, 1500, 1500]


def test_a_stop_by_a_new_proxy_reaches_a_vehicle_that_is_not_received() -> None:
    """A flying one may receive it; one on the ground got no sticks for a while, so its arm switch must first be off."""
    bench = Bench()
    bench.take_off()
    bench.reconnect()
    bench.deaf = True
    bench.session.command(EmergencyStop(), bench.clock.now_ns)
    bench.until(lambda: not bench.board.armed, 0.6)


def test_a_stop_while_a_flying_vehicle_is_found_is_not_undone_by_adopting_it() -> None:
    bench = Bench()
    bench.take_off()
    bench.reconnect()
    bench.session.command(EmergencyStop(), bench.clock.now_ns)
    bench.until(lambda: not bench.board.armed, 3.0)
    bench.run(1.0)
    assert not bench.board.armed
    assert bench.session.setpoints.phase is Phase.STANDING
    assert bench.feedback.state is FlightState.EMERGENCY


def test_a_vehicle_that_does_not_disarm_by_a_stop_is_not_reported_as_landed() -> None:
    """Neither during the stop nor after it has expired: else no pilot would look at it, or land it, any more."""
    setpoints, now_ns = MspSetpoints(), 10**9
    setpoints.on_report(MspReport(True), now_ns)
    setpoints.adopt(0.3, now_ns)
    assert setpoints.flight_state() is FlightState.FLYING
    setpoints.apply(EmergencyStop(), now_ns)
    told = set()
    for _ in range(120):
        now_ns += 10**8
        setpoints.on_report(MspReport(True), now_ns)
        setpoints.step_stop(now_ns)
        told.add(setpoints.flight_state())
    assert [event.data["reason"] for event in setpoints.pop_events()] == ["stop_given_up"]
    assert told == {FlightState.UNKNOWN}
    for _ in range(2):
        with pytest.raises(DriverError, match="still armed"):
            setpoints.apply(ResetEmergency(), now_ns)
        assert setpoints.flight_state() is FlightState.UNKNOWN
        assert "still armed" in setpoints.ask_takeoff(now_ns)
        assert setpoints.channels(now_ns)[:4].count(1000) == 1, "no throttle"
        setpoints.lost()
    setpoints.on_report(MspReport(False), now_ns)
    assert setpoints.flight_state() is FlightState.LANDED
    setpoints.apply(ResetEmergency(), now_ns)
    assert "still armed" not in setpoints.ask_takeoff(now_ns)


def test_a_stop_pressed_during_a_long_loss_does_not_disarm_the_vehicle_afterwards() -> None:
    """Its failsafe keeps it in the air for minutes: the stop has long expired, and the flight continues."""
    bench = Bench(BoardSettings(failsafe=FailsafeConfig(1.5, 60.0, 1322, 10.0, 0)))
    bench.take_off()
    bench.cut = True
    bench.run(1.5)
    bench.session.command(EmergencyStop(), bench.clock.now_ns)
    bench.run(9.0)
    assert not bench.texts("stop_given_up")
    bench.run(1.5)
    assert len(bench.texts("stop_given_up")) == 1
    bench.sink.feedbacks.clear()
    bench.cut = False
    bench.run(3.0)
    assert bench.board.armed
    assert bench.session.setpoints.phase is Phase.FLYING
    assert {feedback.state for feedback in bench.sink.feedbacks} == {FlightState.FLYING}


def test_a_crash_disarms_and_is_reported() -> None:
    bench = Bench()
    bench.take_off()
    bench.board.crashed()
    bench.run(0.5)
    assert "disarmed in flight: CRASH" in bench.texts("disarmed")[0]
    assert bench.feedback.state is FlightState.LANDED


# A pilot's receiver ---------------------------------------------------------------------------------------------------

OVERRIDE = "msp://tcp:127.0.0.1:5761?override=1"


def test_override_needs_its_switch_and_a_receiver() -> None:
    bench = Bench(text=OVERRIDE)
    bench.run(1.0)
    told = " ".join(bench.texts("setup"))
    assert "no switch hands over the sticks" in told
    assert "not a pilot's" in told
    assert "holds the last sticks indefinitely" in told
    with pytest.raises(DriverError, match="no switch hands"):
        bench.fly(climb=0.5)
    assert options(OVERRIDE).override


def test_unsupported_actions_are_no_surprise() -> None:
    bench = Bench()
    with pytest.raises(AssertionError):
        bench.session.command(Hover(), bench.clock.now_ns)


def test_a_vehicle_that_does_not_leave_the_ground_is_given_up() -> None:
    bench = Bench()
    bench.ready()
    setpoints = bench.session.setpoints
    setpoints.limits = replace(setpoints.limits, throttle=0.2)  # less than the hover throttle
    bench.fly(climb=0.5)
    bench.until(lambda: bool(bench.texts("no_takeoff")), 5.0)
    assert "did not leave the ground at 20% throttle" in bench.texts("no_takeoff")[0]
    bench.until(lambda: not bench.board.armed, 0.2)
    with pytest.raises(DriverError, match="did not leave the ground"):
        bench.fly(climb=0.5)


def test_a_climb_lost_before_the_lift_off_ends_the_take_off() -> None:
    bench = Bench(BoardSettings(barometer=False, gps=False))
    bench.ready()
    bench.fly(climb=0.5)
    bench.until(lambda: bench.board.armed, 2.0)
    bench.poses = False
    bench.until(lambda: bool(bench.texts("no_takeoff")), 2.0)
    assert "no longer measured" in bench.texts("no_takeoff")[0]


def test_the_throttle_does_not_rise_while_the_flight_controller_is_silent() -> None:
    """Poses still measured its climb, and the take-off kept requesting one."""
    bench = Bench()
    bench.ready()
    bench.fly(climb=0.5)
    bench.until(lambda: bench.session.setpoints.phase is Phase.SPOOLING, 2.0)
    bench.deaf = True
    for _ in range(150):
        with suppress(DriverError):
            bench.session.command(Attitude(climb=0.5), bench.clock.now_ns)
        bench.tick()
    assert "it sends no data" in bench.texts("no_takeoff")[0]
    assert not bench.board.armed
    assert bench.height_m < 0.06


def test_a_vehicle_that_has_just_started_says_what_it_waits_for() -> None:
    """``connect()`` returned seconds before it could be armed, without a word about that."""
    bench = Bench(BoardSettings(boot_s=5.0))
    bench.until(lambda: bench.sink.newest is not None, 2.0)
    state, reason = bench.sink.links[-1]
    assert state is LinkState.UP
    assert reason.startswith("still waking up: the flight controller can't be armed yet (")
    told = len(bench.sink.links)
    bench.until(lambda: bench.sink.links[-1] == (LinkState.UP, ""), 6.0)
    assert len(bench.sink.links) == told + 1
    settles = Bench(BoardSettings(boot_s=5.0, flags=bit("ANGLE")))  # until it knows how it stands
    settles.until(lambda: settles.sink.newest is not None, 2.0)
    assert settles.sink.links[-1][1].startswith("still waking up"), "or connect() returns, and it can't be armed"
    settles.board.settings = replace(settles.board.settings, flags=0)
    settles.until(lambda: settles.sink.links[-1] == (LinkState.UP, ""), 6.0)
    stays = Bench(BoardSettings(boot_s=5.0, flags=bit("MSP")))
    stays.until(lambda: stays.sink.newest is not None, 2.0)
    assert stays.sink.links[-1] == (LinkState.UP, ""), "the obstacle does not pass with time"


# Compared with a real one ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("number", sorted(EMPTY_WRITES))
def test_an_empty_write_is_acknowledged_as_by_a_real_one_without_effect(number: int) -> None:
    """A configurator's write was reported as refused. Compared with Betaflight 4.6.0 SITL."""
    bench = Bench()
    reply = bench.board.answer(MspFrame(number, b""), bench.clock.now_ns)
    assert reply == MspFrame(number, b"", Direction.REPLY)
    written = bench.board.answer(MspFrame(number, b"\0"), bench.clock.now_ns)
    assert written is not None
    assert written.direction is Direction.ERROR, "the written value is not kept"
