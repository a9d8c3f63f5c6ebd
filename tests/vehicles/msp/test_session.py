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
from skyloop.vehicles.msp.emulator.board import EMPTY_WRITES, BoardSettings, bit
from skyloop.vehicles.msp.firmware import Setup
from skyloop.vehicles.msp.setpoints import Phase, Report, SetpointController
from skyloop.vehicles.msp.telemetry import Motion
from skyloop.vehicles.msp.wire.frames import Direction, Frame, encode
from skyloop.vehicles.msp.wire.messages import FailsafeConfig, Function, ModeRange, OnLoss, channels
from tests.vehicles.msp.bench import TICK_S, Bench, options


def test_it_learns_the_throttle_and_holds_its_height() -> None:
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


def test_climbs_and_descends_as_asked() -> None:
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
    assert truth.pitch_rad == pytest.approx(0.15, abs=0.02), "the stick leans it as far as it was asked to"
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


def test_turns_as_fast_as_asked() -> None:
    bench = Bench()
    bench.take_off()
    bench.fly(yaw_rate=0.7)
    bench.run(0.5)
    before = bench.simulation.truth(0).yaw_rad
    bench.run(1.0)
    assert bench.simulation.truth(0).yaw_rad - before == pytest.approx(0.7, abs=0.05)


def test_lands_and_disarms() -> None:
    bench = Bench()
    bench.take_off()
    bench.fly(climb=-0.4)
    bench.until(lambda: not bench.board.armed, 12.0)
    assert bench.height_m < 0.06
    bench.run(0.2)
    assert bench.feedback.state is FlightState.LANDED
    assert not bench.texts("disarmed"), "that was our own doing"
    bench.fly(climb=0.5)  # and again
    bench.until(lambda: bench.height_m > 0.8, 20.0)


def test_a_descent_from_height_is_not_taken_for_the_ground() -> None:
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


def descent(climb: float, noise: float, seed: int, seconds: float) -> tuple[SetpointController, list[float]]:
    """One that is asked to sink at 0.4 m/s, and what it does; the throttle, as share of the one that carries it."""
    setpoints, chance, now_ns, shares = SetpointController(), random.Random(seed), NS_PER_S, []
    setpoints.on_report(Report(True), now_ns)
    setpoints.adopt(0.3, now_ns)
    setpoints.apply(Attitude(climb=-0.4), now_ns)
    for tick in range(round(seconds / 0.02)):
        now_ns += NS_PER_S // 50
        true = climb if tick > 50 else -0.4
        setpoints.on_motion(Motion(climb_m_s=true + chance.gauss(0.0, noise), height_m=0.5, precise=True))
        setpoints.channels(now_ns)
        if setpoints.phase is Phase.STANDING:
            break
        shares.append(setpoints.throttle / (setpoints.hover or 1.0))
    return setpoints, shares


@pytest.mark.parametrize("noise", [0.0, *NOISES])
def test_a_touch_down_is_seen_through_the_noise_of_positions(noise: float) -> None:
    """It stayed armed while its throttle fell: 0.6 s of noise below 0.1 m/s never came."""
    for seed in range(SEEDS):
        setpoints, shares = descent(0.0, noise, seed, 1.0 + 3.0)
        assert setpoints.phase is Phase.STANDING, seed
        assert setpoints.hover == pytest.approx(0.3, rel=0.2), "the throttle that carries it is not unlearnt"
        assert len(shares) * 0.02 > 1.0 + 0.6


@pytest.mark.parametrize("noise", [0.0, *NOISES])
def test_a_slow_sink_is_not_taken_for_a_touch_down(noise: float) -> None:
    for seed in range(SEEDS):
        setpoints, shares = descent(-0.15, noise, seed, 30.0)
        assert setpoints.phase is Phase.FLYING, seed
        assert min(shares) > 0.7, "nothing is taken away"


@pytest.mark.parametrize("climb", [-0.15, -0.4])
@pytest.mark.parametrize("noise", NOISES)
def test_a_landing_by_noisy_positions(noise: float, climb: float) -> None:
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
    """They did, on the ground: it stood there armed, told to fly, and learnt a throttle that carries nothing."""
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
def test_what_still_rises_when_it_should_sink_does_not_stand(world_speed: float) -> None:
    """A real one rose past its height, in a simulation slower than its clock: it was disarmed at 1.6 m, and fell."""
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
def test_a_take_off_that_is_withdrawn_while_it_arms_does_not_arm_later(climb: float) -> None:
    """It armed as soon as what kept it from that had passed, and its propellers turned for a second."""
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


def test_refused_arming_is_told_by_name() -> None:
    bench = Bench(BoardSettings(flags=bit("NO_ACC_CAL") | bit("ANGLE")))
    bench.run(2.0)
    with pytest.raises(DriverError, match=r"ANGLE \(it is not level\); NO_ACC_CAL \(its accelerometer was never"):
        bench.fly(climb=0.5)
    assert "NO_ACC_CAL" in str(bench.feedback.native and bench.feedback.native["arming.flags"])
    assert any(not each.good and "NO_ACC_CAL" in each.detail for each in bench.session.diagnose())


def test_what_appears_while_it_arms_is_told_by_name() -> None:
    bench = Bench(BoardSettings(boot_s=30.0))
    bench.run(2.0)
    bench.fly(climb=0.5)  # waits for what passes by itself
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
    assert bench.sink.link_state is LinkState.UP, "it can be watched all the same"


def test_a_late_failsafe_is_warned_of() -> None:
    bench = Bench(BoardSettings(failsafe=FailsafeConfig(5.0, 10.0, 1300, 10.0, 0)))
    bench.run(1.0)
    assert any("only after 5 s" in text for text in bench.texts("setup"))
    bench.take_off()


def test_without_a_measured_climb_nothing_takes_off() -> None:
    bench = Bench(BoardSettings(barometer=False, gps=False), poses=False)
    bench.run(2.0)
    with pytest.raises(DriverError, match="its climb is not measured"):
        bench.fly(climb=0.5)


def test_one_pose_that_is_stamped_ahead_changes_nothing() -> None:
    """8 s, by a wrong clock, and nothing but poses measures the height: it would be blind, and cut its motors."""
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
        bench.session.receive(encode(Frame(function, payload, Direction.REPLY)), now_ns)
    for publish in bench.session.drain():
        publish(bench.sink)
    assert bench.sink.link_state is LinkState.DEGRADED
    assert "'CLFL'" in bench.sink.links[-1][1]


# Silence -------------------------------------------------------------------------------------------------------------


def test_silence_drops_it_after_the_firmwares_failsafe() -> None:
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
    assert not bench.board.armed, "it is not armed again by itself"


def test_what_is_found_on_the_ground_stays_there() -> None:
    """The firmware stood still in flight and has disarmed; what hovered it goes on and asks for a climb."""
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


def test_a_take_off_that_was_asked_for_long_ago_does_not_begin_now() -> None:
    bench = Bench()
    bench.ready()
    assert bench.session.ask_takeoff(bench.clock.now_ns) == ""
    bench.run(1.5)
    with pytest.raises(DriverError, match="take off first"):
        bench.session.command(Attitude(climb=0.3), bench.clock.now_ns)


def test_a_short_cut_is_flown_through() -> None:
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
    assert bench.board.armed, "what flies is not disarmed by a new connection"
    assert bench.feedback.state is FlightState.FLYING
    assert abs(bench.climb_m_s) < 0.15


def test_standing_is_disarmed_with_the_last_words() -> None:
    bench = Bench()
    bench.ready()
    bench.fly(climb=0.5)
    bench.until(lambda: bench.board.armed, 2.0)
    words = bench.session.last_words(bench.clock.now_ns)
    assert channels(words[5:-1])[4] == 1000, "the arm switch is off"
    bench.until(lambda: not bench.board.armed, 1.0)
    bench.run(0.2)
    bench.take_off()
    assert bench.session.last_words(bench.clock.now_ns) == b""


def test_sticks_are_held_back_while_none_is_acknowledged() -> None:
    bench = Bench()
    bench.ready()
    bench.deaf = True
    bench.run(0.2)
    before = len([frame for frame in bench.sent if frame.function == Function.SET_RAW_RC])
    bench.run(0.5)
    sent = len([frame for frame in bench.sent if frame.function == Function.SET_RAW_RC]) - before
    assert sent <= 21, "not the 25 of a healthy link: what waits would be obeyed late"


def sticks(bench: Bench) -> list[list[int]]:
    """What was sent of them."""
    return [channels(frame.payload) for frame in bench.sent if frame.function == Function.SET_RAW_RC]


def test_a_flight_controller_that_stands_still_is_left_with_few_sticks() -> None:
    """A pseudo-terminal or a socket took them all, and it obeyed seconds of old ones when it went on."""
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
    assert sticks(bench)[-1][:2] == [1500, 1500], "what is obeyed last is level"


def test_nothing_but_questions_and_stops_is_sent_while_the_link_is_lost() -> None:
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
    assert len(bench.sent) >= 6, "it is still asked"
    bench.session.command(EmergencyStop(), bench.clock.now_ns)
    bench.tick()
    assert sticks(bench)
    bench.deaf = False
    bench.until(lambda: bench.sink.link_state is LinkState.UP, 3.0)
    assert bench.feedback.state in (FlightState.EMERGENCY, FlightState.LANDED)


def test_what_is_found_again_gets_no_sticks_before_it_has_told_its_state() -> None:
    """Another pilot may have it by then, or it may stand: sticks of before the loss are not for it."""
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
def test_what_is_found_again_in_flight_is_not_steered_by_guesses(function: Function) -> None:
    """One lost answer made its arm switch or its order of sticks unknown: it was disarmed in the air."""
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
    assert len(bench.texts("firmware")) == 2, "they were read at last"


def test_what_does_not_tell_the_order_of_its_sticks_is_asked_until_it_does() -> None:
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


def test_a_stop_is_sent_at_once_though_the_flight_controller_is_behind() -> None:
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
def test_a_stop_reaches_what_does_not_tell_its_settings(function: Function, silent: bool) -> None:
    """It was not sent at all to what a new proxy found in flight."""
    bench = Bench(BoardSettings(failsafe=FailsafeConfig(20.0, 60.0, 1000, 10.0, 1)))
    bench.take_off()
    bench.reconnect()
    (bench.unanswered if silent else bench.refused).add(function)
    bench.run(8.0)
    assert bench.board.armed
    bench.session.command(EmergencyStop(), bench.clock.now_ns)
    bench.until(lambda: not bench.board.armed, 0.1)


def test_a_stop_waits_for_no_settings() -> None:
    """A new proxy had to read nine answers first."""
    bench = Bench()
    bench.take_off()
    bench.reconnect()
    bench.session.command(EmergencyStop(), bench.clock.now_ns)
    bench.run(0.03)
    assert not bench.board.armed


#: Its arm switch is on while it is low, where every guess puts it.
INVERTED = BoardSettings(ranges=(ModeRange(0, 0, 900, 1300), ModeRange(1, 1, 900, 2100)))


@pytest.mark.parametrize("silent", [Function.STATUS, Function.MODE_RANGES, Function.RX_MAP, None])
@pytest.mark.parametrize("text", ["msp://tcp:127.0.0.1:5761", "msp://tcp:127.0.0.1:5761?override=1"])
def test_no_stop_arms_what_stands(silent: Function | None, text: str) -> None:
    """Before its settings are read its arm switch can only be guessed, and a low one may be on."""
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
def test_a_stop_keeps_to_the_switches_that_an_earlier_round_of_questions_found(silent: Function) -> None:
    """While they were asked for again, it fell back to guesses for some frames."""
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
    assert bool(sticks(bench)) is (silent is Function.RX_MAP), "without names it only tells that it stands"
    assert all(widths[4] > 1300 for widths in sticks(bench))


@pytest.mark.parametrize("silent", [{Function.BOXNAMES}, {Function.BOXIDS}])
def test_a_stop_reaches_what_flies_with_an_inverted_switch_and_does_not_name_its_modes(silent: set[int]) -> None:
    """It was sent throttle off, with the arm switch on: its motors ran on, and nothing ended that."""
    bench = Bench(replace(INVERTED, failsafe=FailsafeConfig(20.0, 60.0, 1000, 10.0, 1)))
    bench.take_off()
    bench.reconnect()
    bench.unanswered = silent
    bench.run(8.0)
    assert bench.board.armed
    bench.session.command(EmergencyStop(), bench.clock.now_ns)
    bench.until(lambda: not bench.board.armed, 2.0)
    for _ in range(round(14.0 / TICK_S)):  # over several rounds of questions, and after it is given up
        bench.tick()
        assert not bench.board.armed


@pytest.mark.parametrize("silent", [Function.BOXNAMES, Function.BOXIDS, Function.MODE_RANGES])
def test_no_stop_arms_what_tells_neither_whether_it_stands_nor_the_names_of_its_modes(silent: Function) -> None:
    bench = Bench(INVERTED)
    bench.ready()
    bench.reconnect()
    bench.unanswered = {Function.STATUS, Function.STATUS_EX, silent}
    bench.session.command(EmergencyStop(), bench.clock.now_ns)
    for _ in range(round(14.0 / TICK_S)):
        bench.tick()
        assert not bench.board.armed


def test_a_stop_takes_the_throttle_away_where_the_order_of_the_sticks_is_not_known() -> None:
    """The middle of roll may be half of the throttle: a stop that no arm switch carries went out so."""
    setpoints = SetpointController()
    setpoints.on_report(Report(True), 10**9)
    setpoints.apply(EmergencyStop(), 10**9)
    assert setpoints.channels(10**9)[:4] == [1000] * 4
    setpoints.set_up(Setup(sticks=(1, 2, 3, 0), sticks_told=True), "")
    assert setpoints.channels(10**9)[:4] == [1000, 1500, 1500, 1500]


def test_a_stop_reaches_what_can_not_be_heard_by_a_new_proxy() -> None:
    """What flies may hear it, and what stands had no sticks for so long that it wants its arm switch off first."""
    bench = Bench()
    bench.take_off()
    bench.reconnect()
    bench.deaf = True
    bench.session.command(EmergencyStop(), bench.clock.now_ns)
    bench.until(lambda: not bench.board.armed, 0.6)


def test_a_stop_of_what_is_just_being_found_in_flight_is_not_undone_by_taking_it_over() -> None:
    bench = Bench()
    bench.take_off()
    bench.reconnect()
    bench.session.command(EmergencyStop(), bench.clock.now_ns)
    bench.until(lambda: not bench.board.armed, 3.0)
    bench.run(1.0)
    assert not bench.board.armed
    assert bench.session.setpoints.phase is Phase.STANDING
    assert bench.feedback.state is FlightState.EMERGENCY


def test_what_does_not_disarm_by_a_stop_is_not_told_to_have_landed() -> None:
    """Neither while it is stopped, nor when that is given up: nobody would look at it, or land it, any more."""
    setpoints, now_ns = SetpointController(), 10**9
    setpoints.on_report(Report(True), now_ns)
    setpoints.adopt(0.3, now_ns)
    assert setpoints.flight_state() is FlightState.FLYING
    setpoints.apply(EmergencyStop(), now_ns)
    told = set()
    for _ in range(120):
        now_ns += 10**8
        setpoints.on_report(Report(True), now_ns)
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
    setpoints.on_report(Report(False), now_ns)
    assert setpoints.flight_state() is FlightState.LANDED
    setpoints.apply(ResetEmergency(), now_ns)
    assert "still armed" not in setpoints.ask_takeoff(now_ns)


def test_a_stop_pressed_in_a_long_loss_does_not_disarm_what_flies_when_the_link_is_back() -> None:
    """Its failsafe has it in the air for minutes: the stop was given up long before, and it is flown on."""
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


def test_a_crash_disarms_and_is_told() -> None:
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
    assert "holds the last sticks for ever" in told
    with pytest.raises(DriverError, match="no switch hands"):
        bench.fly(climb=0.5)
    assert options(OVERRIDE).override


def test_actions_that_it_does_not_name_are_no_surprise() -> None:
    bench = Bench()
    with pytest.raises(AssertionError):
        bench.session.command(Hover(), bench.clock.now_ns)


def test_what_does_not_leave_the_ground_is_given_up() -> None:
    bench = Bench()
    bench.ready()
    setpoints = bench.session.setpoints
    setpoints.limits = replace(setpoints.limits, throttle=0.2)  # less than carries it
    bench.fly(climb=0.5)
    bench.until(lambda: bool(bench.texts("no_takeoff")), 5.0)
    assert "did not leave the ground at 20% throttle" in bench.texts("no_takeoff")[0]
    bench.until(lambda: not bench.board.armed, 0.2)
    with pytest.raises(DriverError, match="did not leave the ground"):
        bench.fly(climb=0.5)


def test_a_climb_that_is_lost_before_the_lift_off_ends_the_take_off() -> None:
    bench = Bench(BoardSettings(barometer=False, gps=False))
    bench.ready()
    bench.fly(climb=0.5)
    bench.until(lambda: bench.board.armed, 2.0)
    bench.poses = False
    bench.until(lambda: bool(bench.texts("no_takeoff")), 2.0)
    assert "no longer measured" in bench.texts("no_takeoff")[0]


def test_the_throttle_is_not_raised_while_the_flight_controller_is_not_heard() -> None:
    """Poses still told its climb, and the take-off went on asking for one."""
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


def test_one_that_was_started_just_now_says_what_it_waits_for() -> None:
    """``connect()`` returned seconds before it could be armed, and nothing said so."""
    bench = Bench(BoardSettings(boot_s=5.0))
    bench.until(lambda: bench.sink.newest is not None, 2.0)
    state, reason = bench.sink.links[-1]
    assert state is LinkState.UP
    assert reason.startswith("still waking up: the flight controller can't be armed yet (")
    told = len(bench.sink.links)
    bench.until(lambda: bench.sink.links[-1] == (LinkState.UP, ""), 6.0)
    assert len(bench.sink.links) == told + 1
    stays = Bench(BoardSettings(boot_s=5.0, flags=bit("MSP")))
    stays.until(lambda: stays.sink.newest is not None, 2.0)
    assert stays.sink.links[-1] == (LinkState.UP, ""), "what keeps it from being armed does not pass by itself"


# Beside a real one ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("number", sorted(EMPTY_WRITES))
def test_an_empty_write_is_acknowledged_as_by_a_real_one_and_changes_nothing(number: int) -> None:
    """A configurator was told that its write was refused. Compared with Betaflight 4.6.0's own simulation."""
    bench = Bench()
    reply = bench.board.answer(Frame(number, b""), bench.clock.now_ns)
    assert reply == Frame(number, b"", Direction.REPLY)
    written = bench.board.answer(Frame(number, b"\0"), bench.clock.now_ns)
    assert written is not None
    assert written.direction is Direction.ERROR, "what is written is not kept"
