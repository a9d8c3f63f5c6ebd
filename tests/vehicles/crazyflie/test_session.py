"""The driver's session against the emulated firmware, in simulated time: connecting, flying, and starting no motor."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from skyloop.errors import DriverError
from skyloop.messages import (
    AnyAction,
    Attitude,
    EmergencyStop,
    FlightState,
    Hover,
    Land,
    LinkState,
    Position,
    ResetEmergency,
    Takeoff,
    Velocity,
)
from skyloop.vehicles.crazyflie.cache import ContentsCache
from skyloop.vehicles.crazyflie.options import CrazyflieOptions, LinkKind, VelocityMode
from skyloop.vehicles.crazyflie.protocol import CrazyflieSession, Stage
from skyloop.vehicles.crazyflie.telemetry import MAIN
from skyloop.vehicles.crazyflie.wire.commander import GoTo, HighLevelTakeoff, NotifySetpointsStop, decode_message
from skyloop.vehicles.crazyflie.wire.contents import Entry, ValueType
from skyloop.vehicles.crazyflie.wire.crtp import CrtpPacket, CrtpPort
from tests.vehicles.crazyflie.rig import OPTIONS, Rig, flying

MOTORS = {"HighLevelTakeoff", "HighLevelLand", "GoTo", "HoverSetpoint", "ZDistanceSetpoint", "Arm"}


# Connecting ----------------------------------------------------------------------------------------------------------


def test_it_connects_in_spite_of_losses(tmp_path: Path) -> None:
    rig = Rig(tmp_path, lost=0.2)
    rig.ready()
    rig.run(3.0)
    assert rig.session.protocol == 12
    assert rig.session.device == "CF21"
    assert rig.session.parameters.complete
    assert rig.newest.battery is not None
    assert rig.newest.position_m is not None
    assert not MOTORS.intersection(rig.kinds())


def test_console_lines_are_events(tmp_path: Path) -> None:
    rig = Rig(tmp_path)
    rig.ready()
    for part in (b"SYS: Crazy", b"flie is up\nEST", b": \xff\x00Kalman\r\n"):
        rig.waiting.append(CrtpPacket(CrtpPort.CONSOLE, 0, part).encode())
    rig.run(0.1)
    lines = [event.text for event in rig.sink.events if event.data.get("reason") == "console"]
    assert lines == ["SYS: Crazyflie is up", "EST: \ufffdKalman"]


def test_known_tables_are_not_asked_again(tmp_path: Path) -> None:
    first = Rig(tmp_path)
    first.ready()
    asked = first.asked
    again = Rig(tmp_path)
    again.ready()
    assert again.asked < asked / 4
    for file in tmp_path.iterdir():
        content = bytearray(file.read_bytes())
        content[40] ^= 0x55
        file.write_bytes(content)
    damaged = Rig(tmp_path)
    damaged.ready()
    assert damaged.asked >= asked * 0.9
    assert damaged.session.parameters.complete


def test_a_lost_vehicle_is_found_again(tmp_path: Path) -> None:
    rig = Rig(tmp_path)
    rig.ready()
    rig.on = False
    rig.until(lambda: rig.sink.link_state is LinkState.LOST, 3.0)
    with pytest.raises(DriverError):
        rig.apply(Takeoff())
    rig.restart()
    rig.on = True
    rig.until(lambda: rig.sink.link_state is LinkState.UP, 5.0)
    rig.run(1.0)
    assert rig.state is FlightState.LANDED
    assert not MOTORS.intersection(rig.kinds())


@given(
    st.lists(
        st.tuples(st.sampled_from([0, 2, 5, 8, 9, 13, 15]), st.integers(0, 3), st.binary(max_size=31)), max_size=40
    ),
    st.booleans(),
)
def test_no_packet_raises_anything_or_starts_a_motor(packets: list[tuple[int, int, bytes]], asking: bool) -> None:
    session = CrazyflieSession(OPTIONS, 0, cache=ContentsCache(Path("/nonexistent")))
    now_ns = 0
    session.on_datagram(b"\xf3", now_ns)
    names = [name.split(".") for name in MAIN[2]]
    entries = [Entry(number, group, name, ValueType.FLOAT) for number, (group, name) in enumerate(names)]
    if not asking:
        session._stage, session._blocks, session._main = Stage.LOGGING, {0: entries[:6], 1: entries[6:]}, 1
    for port, channel, data in packets:
        now_ns += 10_000_000
        session.on_datagram(CrtpPacket(port, channel, data).encode(), now_ns)
        sent = [decode_message(CrtpPacket.decode(each)) for each in session.poll(now_ns)]
        assert not any(sent)
        session.drain()


# Starting no motor ---------------------------------------------------------------------------------------------------


def test_on_the_ground_nothing_is_sent_but_a_takeoff(tmp_path: Path) -> None:
    rig = Rig(tmp_path)
    rig.ready()
    rig.run(0.3)
    for action in (Hover(), Land(), Velocity(up=0.5), Attitude(climb=0.5), Position(0.0, 0.0, 1.0), Land()):
        rig.apply(action)
        rig.run(0.3)
        rig.apply(action, new=False)
        rig.run(0.2)
    rig.apply(Takeoff(), new=False)  # a repeat of one that is over
    rig.run(0.5)
    assert not MOTORS.intersection(rig.kinds())
    assert rig.state is FlightState.LANDED


def test_a_takeoff_is_repeated_for_a_moment_only(tmp_path: Path) -> None:
    rig = Rig(tmp_path)
    rig.ready()
    rig.run(0.3)
    rig.deaf = True
    begun = rig.now_ns / 1e9
    rig.apply(Takeoff())
    rig.run(4.0)
    times = [at for at, message in rig.sent if isinstance(message, HighLevelTakeoff)]
    assert 2 <= len(times) <= 5
    assert times[-1] - begun < 2.0
    rig.deaf = False
    rig.run(1.0)
    assert rig.state is FlightState.LANDED
    assert any(event.data.get("reason") == "no_takeoff" for event in rig.sink.events)
    assert "HighLevelStop" in rig.kinds()  # it may have planned the take-off


def test_a_takeoff_is_sent_only_while_state_arrives(tmp_path: Path) -> None:
    rig = Rig(tmp_path)
    rig.ready()
    rig.run(0.3)
    rig.mute = True
    rig.run(0.7)
    with pytest.raises(DriverError, match="no data"):
        rig.apply(Takeoff())
    rig.run(3.0)
    rig.mute = False
    rig.run(3.0)
    assert "HighLevelTakeoff" not in rig.kinds()


def test_a_landing_withdraws_a_takeoff(tmp_path: Path) -> None:
    rig = Rig(tmp_path)
    rig.ready()
    rig.run(0.3)
    rig.apply(Takeoff())
    rig.apply(Land())
    assert rig.session.setpoints.flight_state(rig.now_ns) is FlightState.LANDING
    rig.run(0.2)
    for action in (Hover(), Velocity(up=1.0)):
        rig.apply(action)
    rig.until(lambda: rig.state is FlightState.LANDED, 8.0)
    rig.run(2.0)
    assert rig.state is FlightState.LANDED


def test_a_vehicle_found_in_the_air_is_left_alone(tmp_path: Path) -> None:
    rig = flying(tmp_path)
    rig.on = False
    rig.until(lambda: rig.sink.link_state is LinkState.LOST, 3.0)
    before = len(rig.sent)
    rig.on = True
    rig.until(lambda: rig.sink.link_state is LinkState.UP, 5.0)
    rig.run(1.0)
    assert rig.sent[before:] == []
    assert rig.state is FlightState.HOVERING
    rig.apply(Land())
    rig.until(lambda: rig.state is FlightState.LANDED, 10.0)


def test_an_emergency_stop_is_sent_until_it_is_seen(tmp_path: Path) -> None:
    rig = flying(tmp_path)
    rig.deaf = True
    rig.apply(EmergencyStop())
    rig.run(1.0)
    assert rig.state is not FlightState.EMERGENCY
    assert rig.kinds().count("EmergencyStopMessage") >= 8
    with pytest.raises(DriverError, match="not confirmed"):
        rig.apply(ResetEmergency())
    assert rig.apply(Velocity(forward=0.5)) == Hover()
    rig.deaf = False
    rig.until(lambda: rig.state is FlightState.EMERGENCY, 2.0)
    sent = len(rig.sent)
    rig.run(1.0)
    assert len(rig.sent) == sent
    with pytest.raises(DriverError, match="reset"):
        rig.apply(Takeoff())
    with pytest.raises(DriverError, match="switch it off"):
        rig.apply(ResetEmergency())
    rig.restart()  # by hand, as a locked vehicle needs
    rig.run(4.0)
    state: FlightState = rig.state
    assert state is FlightState.EMERGENCY
    rig.apply(ResetEmergency())
    rig.until(lambda: rig.state is FlightState.LANDED, 3.0)


def test_a_stop_for_a_vehicle_of_unknown_version_is_sent_in_all_layouts(tmp_path: Path) -> None:
    rig = Rig(tmp_path)
    rig.mute = True
    rig.apply(EmergencyStop())
    assert rig.stops == {CrtpPort.LOCALISATION, CrtpPort.SUPERVISOR}


# Flying --------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("protocol", [7, 8, 9, 12])
def test_velocities_move_along_the_body_axes(tmp_path: Path, protocol: int) -> None:
    rig = flying(tmp_path, protocol=protocol)
    rig.apply(Velocity(yaw_rate=1.0))
    rig.run(2.0)
    rig.apply(Hover())
    rig.run(1.5)
    start = rig.newest
    assert start.yaw_rad is not None
    assert start.position_m is not None
    assert 0.8 < start.yaw_rad < 2.4
    rig.apply(Velocity(forward=0.4))
    rig.run(3.0)
    assert rig.newest.velocity_m_s is not None
    assert rig.newest.velocity_m_s[0] == pytest.approx(0.4, abs=0.15)
    end = rig.newest.position_m
    assert end is not None
    ahead = math.atan2(end[1] - start.position_m[1], end[0] - start.position_m[0])
    assert ahead == pytest.approx(start.yaw_rad, abs=0.15)
    rig.apply(Hover())
    rig.until(lambda: rig.state is FlightState.HOVERING, 3.0)


def test_a_place_is_reached_and_held(tmp_path: Path) -> None:
    rig = flying(tmp_path)
    place = Position(0.6, -0.4, 1.2, yaw=1.0, speed=0.5)
    rig.apply(place)
    rig.run(4.5)
    at = rig.newest.position_m
    assert at is not None
    assert math.dist(at, place.place) < 0.15
    assert rig.newest.yaw_rad == pytest.approx(1.0, abs=0.15)
    assert rig.state is FlightState.HOVERING
    rig.run(1.0)
    for _ in range(20):
        rig.apply(place, new=False)
        rig.run(0.03)
    assert sum(isinstance(message, GoTo) for _, message in rig.sent) <= 4  # repeats change nothing


def test_a_vehicle_whose_proxy_dies_hovers(tmp_path: Path) -> None:
    """Without another packet, a vehicle that was flying at a velocity comes to rest, and stays in the air."""
    rig = flying(tmp_path)
    rig.apply(Velocity(forward=0.5))
    rig.run(2.5)
    rig.deaf = True  # nothing that the driver sends arrives any more
    rig.run(3.0)
    stopped = rig.simulation.truth(0)
    rig.run(4.0)
    truth = rig.simulation.truth(0)
    assert math.hypot(*truth.velocity_m_s) < 0.1
    assert math.dist(truth.position_m, stopped.position_m) < 0.3
    assert truth.position_m[2] > 0.7


def test_set_points_give_way_to_a_hover_when_nothing_is_heard(tmp_path: Path) -> None:
    """An attitude needs set-points all the time, so a vehicle that is not heard is told to hover by itself."""
    rig = flying(tmp_path)
    rig.apply(Attitude(pitch=0.05))
    rig.run(0.5)
    assert "ZDistanceSetpoint" in rig.kinds()
    rig.mute = True
    rig.run(1.0)
    kinds = rig.kinds()
    last = max(index for index, kind in enumerate(kinds) if kind == "ZDistanceSetpoint")
    assert kinds[last + 1 : last + 4] == ["GoTo", "GoTo", "GoTo"]
    assert kinds[-1] == "NotifySetpointsStop"
    rig.run(4.0)
    assert rig.simulation.truth(0).position_m[2] > 0.5


@pytest.mark.parametrize("action", [Hover(), Velocity(forward=0.3), Land(), Position(0.5, 0.0, 1.0)])
def test_after_set_points_a_late_flight_does_not_make_it_fall(tmp_path: Path, action: AnyAction) -> None:
    """Flights are lost for 0.25 s and the end of set-points isn't: without a flight, the motors would stop."""
    rig = flying(tmp_path)
    for _ in range(20):
        rig.apply(Attitude(pitch=0.05))
        rig.run(0.05)
    height = rig.simulation.truth(0).position_m[2]
    rig.loses = "GoTo", "HighLevelLand"
    rig.apply(action)
    rig.run(0.25)
    rig.loses = ()
    rig.run(0.75)
    assert rig.simulation.truth(0).position_m[2] > height - 0.25
    assert rig.simulation.state(0).airborne
    assert "NotifySetpointsStop" in rig.kinds()
    rig.run(3.0)
    assert isinstance(action, Land) or rig.simulation.truth(0).position_m[2] > height - 0.25


def test_low_level_velocities_are_an_option(tmp_path: Path) -> None:
    options = CrazyflieOptions(LinkKind.UDP, "127.0.0.1", 19850, velocity=VelocityMode.SETPOINT)
    rig = flying(tmp_path, options=options)
    rig.apply(Velocity(forward=0.4))
    rig.run(2.0)
    assert rig.newest.velocity_m_s is not None
    assert rig.newest.velocity_m_s[0] == pytest.approx(0.4, abs=0.15)
    rig.apply(Hover())
    rig.run(0.1)
    assert [type(message) for _, message in rig.sent[-2:]] == [GoTo, NotifySetpointsStop]
    rig.until(lambda: rig.state is FlightState.HOVERING, 4.0)
    rig.run(3.0)
    assert rig.state is FlightState.HOVERING


def test_a_landing_is_sent_to_a_lost_vehicle_for_a_moment(tmp_path: Path) -> None:
    rig = flying(tmp_path)
    rig.mute = True
    rig.until(lambda: rig.sink.link_state is LinkState.LOST, 3.0)
    rig.apply(Land())
    rig.until(lambda: not rig.simulation.feedback(0).state.airborne, 15.0)
    rig.run(1.0)
    rig.mute = False
    rig.until(lambda: rig.sink.link_state is LinkState.UP, 5.0)
    rig.until(lambda: rig.state is FlightState.LANDED, 6.0)


def test_a_landed_vehicle_is_not_lifted_again(tmp_path: Path) -> None:
    """Firmware reports a flight for seconds after the landing; a hover or a velocity must not start the motors then."""
    rig = flying(tmp_path)
    rig.apply(Land())
    rig.until(
        lambda: rig.simulation.truth(0).position_m[2] < 0.02 and not rig.simulation.feedback(0).state.airborne, 12.0
    )
    rig.until(lambda: rig.state is FlightState.LANDED, 1.0)
    assert rig.session.telemetry.is_flying(rig.now_ns)
    sent = len(rig.sent)
    for action in (Hover(), Velocity(up=0.3), Hover(), Position(0.0, 0.0, 1.0)):
        rig.apply(action)
        rig.run(0.5)
    assert not MOTORS.intersection(type(message).__name__ for _, message in rig.sent[sent:])
    assert not rig.simulation.feedback(0).state.airborne
    rig.until(lambda: rig.state is FlightState.LANDED, 6.0)


def test_limits_hold(tmp_path: Path) -> None:
    rig = flying(tmp_path)
    assert rig.apply(Velocity(forward=9.0, up=-9.0, yaw_rate=9.0)) == Velocity(forward=1.0, up=-0.5, yaw_rate=1.5)
    assert rig.apply(Attitude(roll=-2.0)) == Attitude(roll=-0.35)
    applied = rig.apply(Position(1.0, 0.0, 1.0, speed=9.0))
    assert applied == Position(1.0, 0.0, 1.0, speed=1.0, turn_rate=1.5)


# Parameters ----------------------------------------------------------------------------------------------------------


def test_parameters_are_written_and_stored(tmp_path: Path) -> None:
    rig = Rig(tmp_path)
    rig.ready()
    rig.run(2.0)
    session = rig.session
    assert len(session.values) == len(session.parameters.entries)
    entry = next(each for each in session.parameters.entries.values() if each.extended and each.type.is_float)
    answers: list[object] = []
    session.write(entry.number, 0.5, answers.append)
    rig.until(lambda: answers, 1.0)
    assert session.values[entry.number] == 0.5
    session.store(entry.number, answers.append, clear=False)
    rig.until(lambda: len(answers) == 2, 1.0)
    session.store(entry.number, answers.append, clear=True)
    rig.until(lambda: len(answers) == 3, 1.0)
