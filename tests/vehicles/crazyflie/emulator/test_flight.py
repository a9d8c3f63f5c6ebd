"""How the emulated Crazyflie flies: set-points, the high-level commander, and what stops the motors."""

from __future__ import annotations

import math
import struct

import pytest

from skyloop.vehicles.crazyflie.wire import commander as wire
from skyloop.vehicles.crazyflie.wire.commander import Supervisor
from skyloop.vehicles.crazyflie.wire.crtp import CrtpPort
from tests.vehicles.crazyflie.emulator.bench import Bench

HOVER = wire.HoverSetpoint(0.0, 0.0, 0.0, 0.5)
TAKE_OFF = wire.HighLevelTakeoff(0, 1.0, 0.0, True, 2.0)


@pytest.fixture
def bench() -> Bench:
    return Bench()


def has(bench: Bench, bit: Supervisor) -> bool:
    return bool(bench.logic.flight.supervisor & bit)


def test_without_set_points_it_levels_and_then_cuts_its_motors(bench: Bench) -> None:
    bench.run(3.0, wire.HoverSetpoint(0.0, 0.0, 0.0, 1.5))
    bench.run(1.0, wire.VelocityWorldSetpoint(0.5, 0.0, 0.0, 0.0))
    bench.run(0.7)
    assert bench.turns
    assert bench.logic.flight.supervisor & Supervisor.HIGH_LEVEL_DISABLED
    height = bench.place[2]
    bench.run(0.8)
    assert 0.03 < height - bench.place[2] < 0.2  # it sinks slowly
    cut_s = bench.until(lambda: not bench.turns, 3.0) + 1.5
    assert 1.9 < cut_s < 2.2
    assert bench.place[2] > 0.5  # it falls
    assert has(bench, Supervisor.IS_LOCKED)
    bench.run(3.0, HOVER)
    assert not bench.turns
    assert not has(bench, Supervisor.CAN_FLY)


def test_the_high_level_commander_flies_on_without_a_client(bench: Bench) -> None:
    bench.fly()
    bench.send(wire.GoTo(0, False, False, 1.0, 0.5, 1.2, 1.0, 3.0))
    bench.run(4.0)
    assert math.dist(bench.place, (1.0, 0.5, 1.2, 1.0)) < 0.08
    bench.run(10.0)
    assert math.dist(bench.place, (1.0, 0.5, 1.2, 1.0)) < 0.05
    assert has(bench, Supervisor.HIGH_LEVEL_ACTIVE)
    assert has(bench, Supervisor.TRAJECTORY_FINISHED)
    bench.send(wire.HighLevelLand(0, 0.0, 0.0, True, 2.0))
    bench.until(lambda: not bench.turns, 4.0)
    bench.run(1.0)
    assert not bench.turns


def test_low_level_set_points_disable_the_high_level_commander_until_they_are_said_to_stop(bench: Bench) -> None:
    bench.run(3.0, HOVER)
    bench.send(wire.GoTo(0, False, False, 1.0, 0.0, 1.0, 0.0, 2.0))
    bench.run(1.0, HOVER)
    assert abs(bench.place[0]) < 0.1
    bench.send(wire.GoTo(0, False, False, 1.0, 0.0, 1.0, 0.0, 2.0))
    bench.send(wire.NotifySetpointsStop())
    bench.run(4.0)
    assert math.dist(bench.place[:3], (1.0, 0.0, 1.0)) < 0.08
    assert not has(bench, Supervisor.HIGH_LEVEL_DISABLED)


def test_when_set_points_are_said_to_stop_and_no_flight_was_asked_for_since_it_falls(bench: Bench) -> None:
    bench.fly()
    bench.run(1.0, HOVER)  # ends the take-off's flight
    bench.send(wire.NotifySetpointsStop(1000))
    bench.run(0.05)
    assert not bench.turns
    bench.run(3.0)
    assert not has(bench, Supervisor.IS_LOCKED)
    bench.fly()


def test_a_stop_set_point_in_the_air_disables_the_high_level_commander_and_then_locks(bench: Bench) -> None:
    bench.fly()
    bench.send(wire.StopSetpoint())
    bench.run(1.0)
    assert [answer.data[3] for answer in bench.send(TAKE_OFF)] == [0]
    bench.run(0.5)
    assert not bench.turns
    bench.run(1.0)
    assert has(bench, Supervisor.IS_LOCKED)


def test_on_the_ground_the_high_level_commander_may_fly_again_after_a_while(bench: Bench) -> None:
    bench.send(wire.RollPitchThrust(0.0, 0.0, 0.0, 0))  # what cflib sends when it disconnects
    assert has(bench, Supervisor.HIGH_LEVEL_DISABLED)
    bench.run(1.0)
    bench.fly()


@pytest.mark.parametrize(
    ("message", "moved"),
    [
        (wire.VelocityWorldSetpoint(0.4, 0.0, 0.0, 0.0), (1, 0)),
        (wire.VelocityWorldSetpoint(0.0, 0.4, 0.0, 0.0), (0, 1)),
        (wire.HoverSetpoint(0.4, 0.0, 0.0, 1.0), (1, 0)),
        (wire.HoverSetpoint(0.0, 0.4, 0.0, 1.0), (0, 1)),
        (wire.ZDistanceSetpoint(0.0, -4.0, 0.0, 1.0), (1, 0)),
        (wire.ZDistanceSetpoint(-4.0, 0.0, 0.0, 1.0), (0, 1)),
        (wire.AltitudeHoldSetpoint(4.0, 0.0, 0.0, 0.0), (0, -1)),
        (wire.PositionSetpoint(1.0, 0.0, 1.0, 0.0), (1, 0)),
        (wire.FullStateSetpoint(0, 1000, 1000, 0, 0, 0, 0, 0, 0, wire.compressed((0, 0, 0, 1)), 0, 0, 0), (0, 1)),
        (wire.RollPitchThrust(0.0, -4.0, 0.0, 37700), (1, 0)),
    ],
)
@pytest.mark.parametrize("protocol", [7, 12])
def test_set_points_move_it_in_their_axes(message: wire.Message, moved: tuple[int, int], protocol: int) -> None:
    bench = Bench(protocol=protocol)
    bench.send(wire.RollPitchThrust(0.0, 0.0, 0.0, 0))
    bench.run(3.0, wire.HoverSetpoint(0.0, 0.0, 0.0, 1.0))
    x, y, *_ = bench.place
    bench.run(1.5, message)
    away = bench.place[0] - x, bench.place[1] - y
    assert sum(a * b for a, b in zip(away, moved, strict=True)) > 0.25
    assert abs(away[0] * moved[1] - away[1] * moved[0]) < 0.1


@pytest.mark.parametrize("protocol", [7, 12])
def test_yaw_rates_are_counter_clockwise(protocol: int) -> None:
    bench = Bench(protocol=protocol)
    bench.run(2.0, HOVER)
    bench.run(1.5, wire.HoverSetpoint(0.0, 0.0, 40.0, 0.5))
    assert 0.6 < bench.place[3] < 1.2


def test_the_oldest_set_point_needs_thrust_zero_first(bench: Bench) -> None:
    bench.run(1.0, wire.RollPitchThrust(0.0, 0.0, 0.0, 50000))
    assert not bench.turns
    bench.send(wire.RollPitchThrust(0.0, 0.0, 0.0, 0))
    bench.run(1.5, wire.RollPitchThrust(0.0, 0.0, 0.0, 45000))
    assert bench.turns
    bench.send(wire.RollPitchThrust(0.0, 0.0, 0.0, 0))
    bench.run(0.1)
    assert not bench.turns


@pytest.mark.parametrize("message", [wire.StopSetpoint(), wire.EmergencyStopMessage(), wire.Arm(False)], ids=repr)
@pytest.mark.parametrize("protocol", [7, 12])
def test_what_stops_the_motors_in_the_air(message: wire.Message, protocol: int) -> None:
    bench = Bench(protocol=protocol, auto_arm=False)
    bench.send(wire.Arm(True))
    bench.fly()
    bench.send(message)
    bench.run(0.05)
    assert not bench.turns


def test_the_high_level_stop_cuts_the_motors(bench: Bench) -> None:
    bench.fly()
    bench.send(wire.HighLevelStop())
    bench.run(0.05)
    assert not bench.turns
    bench.run(3.0)
    bench.fly()  # unlike an emergency stop, it does not lock the vehicle


def test_an_emergency_stop_lasts_until_a_restart(bench: Bench) -> None:
    bench.fly()
    bench.send(wire.EmergencyStopMessage())
    bench.run(3.0)
    assert [answer.data[3] for answer in bench.send(TAKE_OFF)] == [0]  # and yet it does not fly
    (answer,) = bench.send(wire.Arm(True))
    assert answer.data[1:] == b"\0\0"
    bench.run(3.0, HOVER)
    assert not bench.turns
    assert b"Locked" in b"".join(packet.data for packet in bench.sent if packet.port == CrtpPort.CONSOLE)
    bench.restart()
    bench.fly()


def test_the_watchdog_for_emergency_stops_begins_with_its_first_message(bench: Bench) -> None:
    bench.fly()
    bench.run(3.0, wire.EmergencyWatchdog(), every_s=0.8)
    assert bench.turns
    stopped_s = bench.until(lambda: not bench.turns, 2.0)
    assert stopped_s < 1.1
    assert has(bench, Supervisor.IS_LOCKED)


def test_disarmed_it_does_not_start(bench: Bench) -> None:
    assert bench.logic.flight.supervisor & 0xFF == 0x0E
    bench.send(wire.Arm(False))
    assert bench.logic.flight.supervisor & 0xFF == 0x0E  # it arms itself
    bench = Bench(auto_arm=False)
    assert bench.logic.flight.supervisor & 0xFF == 0x01
    bench.run(1.0, HOVER)
    assert not bench.turns
    bench.send(wire.Arm(True))
    bench.run(1.0, HOVER)
    assert bench.turns


def test_after_a_crash_it_flies_only_when_recovered(bench: Bench) -> None:
    bench.fly()
    bench.logic.flight.crash()
    bench.run(0.05)
    assert not bench.turns
    assert has(bench, Supervisor.IS_CRASHED)
    bench.run(3.0)
    bench.run(1.0, HOVER)
    assert not bench.turns
    (answer,) = bench.send(wire.Recover())
    assert answer.data[1:] == b"\1\1"
    bench.fly()


@pytest.mark.parametrize("protocol", [7, 12])
def test_nothing_that_is_not_finite_flies_it(protocol: int) -> None:
    bench = Bench(protocol=protocol)
    for number in (math.nan, math.inf):
        bench.run(0.5, wire.HoverSetpoint(0.0, 0.0, 0.0, number))
        assert [answer.data[3] for answer in bench.send(wire.HighLevelTakeoff(0, number, 0.0, True, 2.0))] == [22]
        bench.run(1.0)
        assert not bench.turns


def test_an_uploaded_trajectory_relative_and_backwards(bench: Bench) -> None:
    piece = [0.0] * 33
    piece[1], piece[32] = 0.5, 2.0  # x at 0.5 m/s for 2 s
    bench.logic.flight.memory[132 : 2 * 132] = struct.pack("<33f", *piece)
    bench.fly()
    bench.send(wire.DefineTrajectory(3, 1, 0, 132, 1))
    for backwards, x in ((False, 1.0), (True, 0.0)):
        (answer,) = bench.send(wire.StartTrajectory(0, True, False, backwards, 3, 1.5))
        assert answer.data[3] == 0
        bench.run(2.0)
        assert 0.2 < bench.place[0] < 0.8
        bench.run(3.0)
        assert math.dist(bench.place[:3], (x, 0.0, 1.0)) < 0.1


def test_an_undefined_trajectory_is_not_flown(bench: Bench) -> None:
    bench.fly()
    bench.send(wire.StartTrajectory(0, True, False, False, 1, 1.0))
    bench.send(wire.DefineTrajectory(1, 1, 0, 4000, 2))  # reaches beyond the memory
    bench.send(wire.StartTrajectory(0, True, False, False, 1, 1.0))
    bench.run(1.0)
    assert math.dist(bench.place[:3], (0.0, 0.0, 1.0)) < 0.05


@pytest.mark.parametrize(
    ("clockwise", "sideways", "end"), [(False, False, (0, 1, 1.57)), (True, True, (0.5, 0.5, -1.57))]
)
def test_a_spiral(bench: Bench, clockwise: bool, sideways: bool, end: tuple[float, float, float]) -> None:
    bench.fly()
    turn = math.pi if not sideways else math.pi / 2
    bench.send(wire.Spiral(0, sideways, clockwise, turn, 0.5, 0.5, 0.2, 4.0))
    bench.run(5.0)
    x, y, yaw = end
    assert math.dist(bench.place[:3], (x, y, 1.2)) < 0.12
    assert abs(math.remainder(bench.place[3] - (yaw if sideways else math.pi), math.tau)) < 0.15


@pytest.mark.parametrize("message", [wire.GoTo(0, False, False, 0.0, 0.0, 1.0, 0.0, 2.0), wire.EmergencyStopMessage()])
def test_older_firmware_does_not_know_newer_messages(message: wire.Message) -> None:
    bench = Bench(protocol=7)
    answers = bench.logic.receive(message.encode(12))
    assert [answer.data[3] for answer in answers] == [8] * len(answers)
    bench.run(2.0)
    assert not bench.turns
    assert not has(bench, Supervisor.IS_LOCKED)


def test_a_second_take_off_is_refused(bench: Bench) -> None:
    bench.fly()
    assert [answer.data[3] for answer in bench.send(TAKE_OFF)] == [1]


def test_groups(bench: Bench) -> None:
    bench.send(wire.SetGroupMask(2))
    bench.send(wire.HighLevelTakeoff(1, 1.0, 0.0, True, 2.0))
    bench.run(2.0)
    assert not bench.turns
    bench.send(wire.HighLevelTakeoff(3, 1.0, 0.0, True, 2.0))
    bench.run(2.0)
    assert bench.turns


def test_poses_from_outside_move_the_estimate(bench: Bench) -> None:
    half = math.sqrt(0.5)
    bench.send(wire.ExternalPoseMessage(2.0, 3.0, 0.5, 0.0, 0.0, half, half))
    bench.run(0.1)
    assert math.dist(bench.place, (2.0, 3.0, 0.5, math.pi / 2)) < 0.02
    start = bench.truth.position_m
    bench.send(wire.HighLevelTakeoff(0, 1.5, 0.0, True, 2.0))
    bench.run(3.0)
    bench.send(wire.GoTo(0, False, False, 2.0, 4.0, 1.5, math.pi / 2, 2.0))
    bench.run(3.0)
    assert math.dist(bench.truth.position_m, (start[0] + 1.0, start[1], start[2] + 1.0)) < 0.1  # its x axis was north
    bench.logic.receive(
        wire.packed_poses([(0xE7, (0.0, 0.0, 1.0), (0.0, 0.0, 0.0, 1.0)), (1, (9, 9, 9), (0, 0, 0, 1))])
    )
    assert math.dist(bench.place, (0.0, 0.0, 1.0, 0.0)) < 0.02
