"""The emulated Tello behaves as described in the guides and seen in recordings of real ones."""

from __future__ import annotations

import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from skyloop.messages import FlightState
from skyloop.messages.geometry import wrap_angle
from skyloop.vehicles.tello.wire import SILENCE_S, Sdk
from tests.vehicles.tello.emulator.rig import PILOT, Bench


def test_nothing_is_answered_before_command() -> None:
    bench = Bench()
    bench.say("battery?")
    bench.say("takeoff")
    bench.run(2.0)
    assert bench.answers == []
    assert bench.logic.unknown == 2
    assert bench.logic.client is None
    assert bench.ask("command") == "ok"
    assert bench.logic.client == PILOT[0]


def test_a_take_off_is_answered_long_after_it_hovers_and_a_landing_at_touchdown() -> None:
    bench = Bench()
    bench.ask("command")
    assert bench.state.distance_cm == 10
    bench.say("takeoff")
    assert bench.until(lambda: bench.truth.position_m[2] > 0.1, 3.0) == pytest.approx(1.1, abs=0.3)
    assert bench.until(lambda: (bench.state.distance_cm or 0) >= 70, 3.0) < 2.5
    bench.until(lambda: bench.flight is FlightState.HOVERING, 3.0)
    assert len(bench.answers) == 1
    bench.until(lambda: len(bench.answers) == 2, 8.0)
    assert bench.answers[-1] == ("ok", PILOT)
    motor_s = bench.state.motor_s
    assert motor_s == pytest.approx(8, abs=1)
    assert bench.ask("land", 6.0) == "ok"
    assert bench.flight is FlightState.LANDED
    stood_s = bench.state.motor_s
    bench.run(3.0)
    assert bench.state.motor_s == stood_s  # counts while the motors run


@pytest.mark.parametrize(
    ("command", "forward_m", "left_m", "up_m"),
    [
        ("forward 50", 0.5, 0, 0),
        ("back 60", -0.6, 0, 0),
        ("left 40", 0, 0.4, 0),
        ("right 30", 0, -0.3, 0),
        ("up 40", 0, 0, 0.4),
        ("down 30", 0, 0, -0.3),
        ("go 40 -30 20 50", 0.4, -0.3, 0.2),
        ("curve 20 20 0 50 0 0 40", 0.5, 0, 0),
    ],
)
def test_moves_end_at_their_goal_and_are_then_answered(
    command: str, forward_m: float, left_m: float, up_m: float
) -> None:
    bench = Bench()
    bench.fly()
    start = bench.truth
    assert bench.ask(command, 8.0) == "ok"
    end = bench.truth
    east, north, up = (b - a for a, b in zip(start.position_m, end.position_m, strict=True))
    cos, sin = math.cos(start.yaw_rad), math.sin(start.yaw_rad)
    assert cos * east + sin * north == pytest.approx(forward_m, abs=0.1)
    assert cos * north - sin * east == pytest.approx(left_m, abs=0.1)
    assert up == pytest.approx(up_m, abs=0.1)


@pytest.mark.parametrize(("command", "left_rad"), [("cw 90", -math.pi / 2), ("ccw 45", math.pi / 4)])
def test_turns(command: str, left_rad: float) -> None:
    bench = Bench()
    bench.fly()
    start = bench.truth.yaw_rad
    told = bench.state.yaw_deg
    assert bench.ask(command, 8.0) == "ok"
    assert wrap_angle(bench.truth.yaw_rad - start) == pytest.approx(left_rad, abs=0.1)
    assert told is not None
    assert bench.state.yaw_deg == pytest.approx(told - math.degrees(left_rad), abs=6)


def test_sticks_are_never_answered_and_stay_in_force() -> None:
    bench = Bench()
    bench.fly()
    answers = len(bench.answers)
    start = bench.truth
    bench.say("rc 0 50 20 0")
    bench.run(2.0)
    state = bench.state
    assert state.speed_dm_s is not None
    assert state.speed_dm_s[0] == pytest.approx(5, abs=1)
    assert state.speed_dm_s[2] == pytest.approx(-2, abs=1)  # down is positive
    bench.say("rc 0 0 0 0")
    bench.run(2.0)
    assert bench.truth.position_m[2] - start.position_m[2] > 0.3
    assert math.hypot(*bench.truth.velocity_m_s) < 0.1
    bench.say("rc 0 0 0 100")
    bench.run(0.5)
    assert wrap_angle(bench.truth.yaw_rad - start.yaw_rad) < -0.3  # clockwise
    bench.say("rc 50 0 0")
    bench.say("rc 500 0 0 0")
    bench.say("rc a b c d")
    assert len(bench.answers) == answers


def test_it_lands_after_fifteen_seconds_of_silence() -> None:
    bench = Bench()
    bench.fly()
    bench.say("rc 0 0 0 0")
    bench.run(SILENCE_S - 0.5)
    assert bench.flight is FlightState.HOVERING
    bench.until(lambda: bench.flight is FlightState.LANDING, 1.5)
    bench.until(lambda: bench.flight is FlightState.LANDED, 6.0)


def test_questions_keep_it_in_the_air() -> None:
    bench = Bench()
    bench.fly()
    for _ in range(8):
        bench.run(4.0)
        bench.ask("wifi?")
    assert bench.flight is FlightState.HOVERING


def test_an_emergency_cuts_the_motors_and_is_forgotten_on_the_ground() -> None:
    bench = Bench()
    bench.fly()
    assert bench.ask("emergency") == "ok"
    bench.until(lambda: bench.flight is FlightState.LANDED, 5.0)
    assert bench.ask("takeoff", 12.0) == "ok"


def test_one_command_at_a_time() -> None:
    bench = Bench()
    bench.fly()
    bench.say("forward 100")
    assert bench.ask("back 50") == "error Not joystick"
    assert bench.ask("flip l") == "error Not joystick"
    bench.say("rc 0 -100 0 0")  # ignored
    bench.until(lambda: bench.answers[-1][0] == "ok", 8.0)
    bench.say("forward 100")
    assert bench.ask("stop") == "ok"
    assert bench.ask("flip b", 3.0) == "ok"


@pytest.mark.parametrize(
    ("command", "answer"),
    [
        ("forward 50", "error Motor stop"),
        ("cw 90", "error Motor stop"),
        ("land", "error Motor stop"),
        ("flip x", "error"),
        ("forward", "error"),
        ("forward ten", "error"),
        ("forward 10", "out of range"),
        ("cw 361", "out of range"),
        ("go 1 2 3 50", "out of range"),
        ("speed 5", "out of range"),
        ("speed 80", "ok"),
        ("wifi name secret", "ok"),
        ("mon", "ok"),
        ("mdirection 2", "ok"),
        ("mdirection 3", "out of range"),
        ("keepalive", "ok"),
        ("setfps middle", "ok"),
        ("setfps often", "unknown command: setfps often"),
        ("setresolution low", "ok"),
        ("setbitrate 3", "ok"),
        ("downvision 1", "ok"),
        ("sdk?", "30"),
        ("speed?", "50.0"),
        ("battery?", "100"),
        ("time?", "0"),
        ("height?", "0dm"),
        ("temp?", "60~63C"),
        ("attitude?", "pitch:0;roll:0;yaw:0;"),
        ("tof?", "100mm"),
        ("sn?", "0TQEMULATED001"),
        ("dance", "unknown command: dance"),
        ("dance?", "unknown command: dance?"),
    ],
)
def test_answers_on_the_ground(command: str, answer: str) -> None:
    bench = Bench()
    bench.ask("command")
    assert bench.ask(command).strip() == answer


def test_the_configuration_is_in_force() -> None:
    bench = Bench()
    bench.ask("command")
    for command in ("streamon", "port 9990 9991", "setfps low", "setresolution low", "setbitrate 2", "downvision 1"):
        assert bench.ask(command) == "ok"
    board = bench.logic
    assert (board.streaming, board.state_port, board.video_port) == (True, 9990, 9991)
    assert (board.fps, board.size, board.bitrate_mbps, board.looks_down) == (5.0, (640, 480), 2, True)
    assert bench.ask("speed 80") == "ok"
    assert bench.ask("speed?").strip() == "80.0"


def test_older_versions_have_fewer_commands() -> None:
    bench = Bench(Sdk.V1_3)
    bench.ask("command")
    for command in ("sdk?", "stop", "mon", "port 9990 9991", "keepalive", "setfps low"):
        assert bench.ask(command) == f"unknown command: {command}"
    assert bench.ask("forward 10") == "error"
    assert bench.ask("cw 3600") == "error Motor stop"  # in its range
    assert not bench.state.pads
    assert Bench(Sdk.V2_0).state.pads


def test_mission_pads_in_view() -> None:
    x, y, _ = Bench().truth.position_m
    bench = Bench(pads={4: (x + 0.1, y), 7: (x + 5.0, y)})
    bench.fly()
    assert bench.state.pad is None
    assert bench.ask("go 0 0 60 50 m4", 5.0) == "error No valid marker"
    bench.ask("mon")
    pad = bench.state.pad
    assert pad is not None
    assert pad.number == 4
    assert pad.place_cm is not None
    assert pad.place_cm[0] == pytest.approx(-10, abs=8)
    assert bench.ask("go 0 0 100 50 m4", 8.0) == "ok"
    end = bench.truth.position_m
    assert math.dist(end, (x + 0.1, y, 1.0)) < 0.12
    assert bench.ask("go 0 0 100 50 m7", 5.0) == "error No valid marker"
    bench.ask("moff")
    assert bench.state.pad is None


@settings(max_examples=60, deadline=None)
@given(st.lists(st.binary(max_size=60) | st.text(alphabet="abcdflgort m?-0123456789", max_size=30).map(str.encode)))
def test_any_datagrams_are_survived(datagrams: list[bytes]) -> None:
    bench = Bench()
    bench.ask("command")
    for datagram in datagrams:
        bench.logic.receive(datagram, PILOT)
        bench.tick()
    assert bench.state.battery_percent == 100
