"""Whole flights of a session with an emulated Tello, in simulated time, over good and bad links."""

from __future__ import annotations

import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from skyloop.errors import DriverError
from skyloop.messages import (
    Attitude,
    EmergencyStop,
    EventKind,
    FlightState,
    Hover,
    Idle,
    Land,
    LinkState,
    ResetEmergency,
    Takeoff,
    Velocity,
)
from skyloop.vehicles.tello.options import TelloOptions, VelocityAxes
from skyloop.vehicles.tello.wire import Sdk
from tests.vehicles.tello.emulator.rig import PILOT
from tests.vehicles.tello.rig import Rig, strings


@pytest.mark.parametrize("lost", [0.0, 0.1, 0.3])
def test_a_flight(lost: float) -> None:
    rig = Rig(lost=lost)
    rig.ready()
    assert rig.state is FlightState.LANDED
    rig.do(Takeoff())
    rig.until(lambda: rig.state is FlightState.TAKING_OFF, 8.0)
    rig.until(lambda: rig.state is FlightState.HOVERING, 10.0)
    assert rig.feedback.altitude_m is not None
    assert rig.feedback.altitude_m > 0.4
    rig.do(Velocity(forward=0.5))
    rig.until(lambda: rig.state is FlightState.FLYING, 1.0)
    rig.until(lambda: (rig.feedback.velocity_m_s or (0.0,))[0] > 0.35, 4.0)
    rig.do(Hover())
    rig.until(lambda: rig.state is FlightState.HOVERING, 1.0)
    rig.run(30.0)
    assert rig.bench.truth.state is FlightState.HOVERING  # it did not land for lack of commands
    rig.do(Land())
    rig.until(lambda: rig.state is FlightState.LANDING, 2.0)
    rig.until(lambda: rig.state is FlightState.LANDED, 15.0)
    assert rig.bench.flight is FlightState.LANDED


def test_sticks_are_sent_twenty_times_a_second_and_new_ones_at_once() -> None:
    rig = Rig()
    rig.ready()
    rig.do(Takeoff())
    rig.until(lambda: rig.state is FlightState.HOVERING, 10.0)
    rig.take_sent()
    rig.run(2.0)
    sticks = [text for text in rig.take_sent() if text.startswith("rc")]
    assert set(sticks) == {"rc 0 0 0 0"}
    assert 30 <= len(sticks) <= 45
    rig.do(Velocity(left=0.3))
    rig.step()
    rig.step()
    assert "rc -30 0 0 0" in rig.take_sent()


def test_a_drone_flown_by_another_program_gets_no_sticks_before_we_take_it() -> None:
    rig = Rig()
    rig.ready()
    rig.bench.logic.receive(b"takeoff", PILOT)
    rig.until(lambda: rig.state is FlightState.HOVERING, 12.0)
    rig.run(3.0)
    assert not [text for text in rig.sent if text.startswith(("rc", "land", "stop"))]
    rig.do(Hover())
    rig.run(0.2)
    assert "rc 0 0 0 0" in rig.take_sent()
    rig.do(Land())
    rig.until(lambda: rig.state is FlightState.LANDED, 15.0)
    rig.run(1.0)
    rig.take_sent()
    rig.bench.logic.receive(b"takeoff", PILOT)
    rig.until(lambda: rig.state is FlightState.HOVERING, 12.0)
    rig.run(1.0)
    assert not [text for text in rig.sent if text.startswith("rc")], "nor the next flight"


def test_nothing_moves_a_landed_drone() -> None:
    rig = Rig()
    rig.ready()
    rig.do(Velocity(forward=1.0))
    rig.do(Hover())
    rig.run(3.0)
    assert not [text for text in rig.sent if text.startswith("rc")]


def test_a_drone_that_does_not_take_off_is_reported() -> None:
    rig = Rig()
    rig.ready()
    rig.deaf = True
    rig.do(Takeoff())
    rig.run(9.0)
    assert rig.sent.count("takeoff") in (5, 6)
    assert "no_takeoff" in rig.reasons
    assert rig.state is FlightState.LANDED
    rig.take_sent()
    rig.run(3.0)
    assert "takeoff" not in rig.sent


@pytest.mark.parametrize("after_s", [0.1, 0.5, 0.9])
@pytest.mark.parametrize("lost", [0.0, 0.3])
def test_a_take_off_withdrawn_before_it_shows_is_landed(after_s: float, lost: float) -> None:
    """The drone was still on the ground, so nothing was sent; it then rose anyway and hovered for good."""
    rig = Rig(lost=lost)
    rig.ready()
    rig.do(Takeoff())
    rig.until(lambda: "takeoff" in rig.sent, 1.0)
    rig.run(after_s)
    assert rig.state is FlightState.LANDED
    rig.do(Land())
    rig.run(0.3)
    rig.do(Velocity(up=1.0))
    rig.do(Hover())  # a hover neither flies a landed drone nor lets it rise
    rig.run(15.0)
    assert rig.bench.flight is FlightState.LANDED
    assert rig.state is FlightState.LANDED
    rig.take_sent()
    rig.run(3.0)
    assert not [text for text in rig.sent if text.startswith(("rc", "land", "takeoff"))]


def test_a_drone_that_falls_over_during_its_take_off_is_not_restarted() -> None:
    """It once was, while a person walked up to it, until 8 s after the take-off command."""
    rig = Rig()
    rig.ready()
    rig.do(Takeoff())
    rig.until(lambda: rig.state is FlightState.TAKING_OFF, 4.0)
    rig.bench.logic.receive(b"emergency", PILOT)
    rig.take_sent()
    rig.until(lambda: rig.state is FlightState.LANDED, 5.0)
    rig.run(8.0)
    assert "takeoff" not in rig.sent
    assert rig.reasons.count("no_takeoff") == 1
    rig.do(Takeoff())
    rig.until(lambda: rig.state is FlightState.HOVERING, 12.0)


@pytest.mark.parametrize("after_s", [0.0, 0.2, 0.5])
def test_motors_that_ran_before_a_landing_show_no_take_off(after_s: float) -> None:
    """They once seemed to start and stop: the rising drone was reported as not restarted, LANDED, and not steered."""
    rig = Rig()
    rig.ready()
    rig.do(Takeoff())
    rig.until(lambda: rig.state is FlightState.HOVERING, 10.0)
    rig.run(3.0)
    rig.do(Land())
    rig.until(lambda: rig.bench.truth.state is FlightState.LANDED, 10.0)
    rig.session.on_reply(b"ok", rig.now_ns)  # real drones answer at touchdown
    rig.until(lambda: rig.state is FlightState.LANDED, 0.2)
    rig.run(after_s)
    rig.do(Takeoff())
    rig.until(lambda: rig.bench.truth.state is FlightState.HOVERING, 5.0)
    assert rig.state is FlightState.TAKING_OFF
    rig.until(lambda: rig.state is FlightState.HOVERING, 2.0)
    assert "no_takeoff" not in rig.reasons
    rig.take_sent()
    rig.run(1.0)
    assert "rc 0 0 0 0" in rig.sent


def test_a_refused_take_off_is_reported() -> None:
    rig = Rig()
    rig.ready()
    rig.bench.simulation.set_charge(0, 0.01)
    rig.do(Takeoff())
    rig.until(lambda: "takeoff_refused" in rig.reasons, 5.0)
    assert rig.state is FlightState.LANDED


def test_a_landing_can_be_aborted() -> None:
    rig = Rig()
    rig.ready()
    rig.do(Takeoff())
    rig.until(lambda: rig.state is FlightState.HOVERING, 10.0)
    rig.run(8.0)
    rig.do(Land())
    rig.do(Hover())
    assert rig.session.setpoints.watch.sinking is False


@pytest.mark.parametrize("lost", [0.0, 0.2])
def test_an_emergency_stop_is_kept_until_the_reset(lost: float) -> None:
    rig = Rig(lost=lost)
    rig.ready()
    rig.do(Takeoff())
    rig.until(lambda: rig.state is FlightState.HOVERING, 12.0)
    rig.do(EmergencyStop())
    rig.until(lambda: rig.bench.flight is FlightState.LANDED, 4.0)
    rig.until(lambda: rig.state is FlightState.EMERGENCY, 3.0)
    assert EventKind.EMERGENCY in [event.kind for event in rig.sink.events]
    with pytest.raises(DriverError, match="reset the emergency first"):
        rig.do(Takeoff())
    assert rig.do(Velocity(forward=1.0)) == Hover()
    rig.do(Hover())
    rig.run(3.0)
    assert rig.state is FlightState.EMERGENCY
    rig.take_sent()
    rig.run(5.0)
    assert "emergency" not in rig.sent
    rig.do(ResetEmergency())
    rig.until(lambda: rig.state is FlightState.LANDED, 1.0)
    rig.do(Takeoff())
    rig.until(lambda: rig.state is FlightState.HOVERING, 12.0)


def test_a_stop_that_does_not_show_cannot_be_reset() -> None:
    rig = Rig()
    rig.ready()
    rig.do(Takeoff())
    rig.until(lambda: rig.state is FlightState.HOVERING, 12.0)
    rig.deaf = True
    rig.do(EmergencyStop())
    rig.run(0.5)
    with pytest.raises(DriverError, match="motors still run"):
        rig.do(ResetEmergency())
    assert rig.do(Idle()) == Idle()


def test_a_stop_that_never_shows_is_abandoned_and_reported_and_the_drone_lands() -> None:
    """The Wi-Fi fails before the stop and returns long after: no commands arrive, and the drone lands without them."""
    rig = Rig()
    rig.ready()
    rig.do(Takeoff())
    rig.until(lambda: rig.state is FlightState.HOVERING, 12.0)
    rig.on = False
    rig.run(2.0)
    rig.do(EmergencyStop())
    rig.take_sent()
    rig.run(9.8)
    assert rig.take_sent().count("emergency") > 75, "also to a silent drone"
    rig.run(0.6)
    assert rig.reasons.count("stop_given_up") == 1
    rig.take_sent()
    rig.on = True
    rig.until(lambda: rig.state is FlightState.HOVERING, 5.0)
    assert "emergency" not in rig.sent, "it must not fall minutes later"
    rig.until(lambda: rig.state is FlightState.LANDED, 30.0)
    assert rig.bench.flight is FlightState.LANDED
    assert not [text for text in rig.sent if text.startswith(("rc", "wifi?", "land", "emergency"))]
    rig.do(Takeoff())
    rig.until(lambda: rig.state is FlightState.HOVERING, 12.0)


def test_after_an_abandoned_stop_the_drone_can_land_and_a_reset_is_allowed() -> None:
    rig = Rig()
    rig.ready()
    rig.do(Takeoff())
    rig.until(lambda: rig.state is FlightState.HOVERING, 12.0)
    rig.deaf = True
    rig.do(EmergencyStop())
    rig.run(11.0)
    assert rig.state is FlightState.HOVERING, "a flying drone reports no emergency"
    rig.deaf = False
    rig.do(ResetEmergency())
    rig.do(Hover())
    rig.run(6.0)
    assert "wifi?" in rig.sent, "a command makes us keep it awake again"
    rig.do(Land())
    rig.until(lambda: rig.state is FlightState.LANDED, 15.0)


def test_a_stop_shows_while_it_is_repeated() -> None:
    rig = Rig()
    rig.ready()
    rig.do(Takeoff())
    rig.until(lambda: rig.state is FlightState.HOVERING, 12.0)

    def repeated() -> bool:
        rig.do(EmergencyStop())
        return rig.state is FlightState.EMERGENCY

    rig.until(repeated, 4.0)


def test_an_answer_alone_does_not_end_a_stop() -> None:
    """An "ok" does not name its command: it may belong to an earlier landing."""
    rig = Rig()
    rig.ready()
    rig.do(Takeoff())
    rig.until(lambda: rig.state is FlightState.HOVERING, 12.0)
    rig.deaf = True
    rig.do(EmergencyStop())
    rig.step()
    rig.step()
    for _ in range(2):  # the take-off's answer, and one more
        rig.session.on_reply(b"ok", rig.now_ns)
    rig.run(2.0)
    with pytest.raises(DriverError, match="motors still run"):
        rig.do(ResetEmergency())
    rig.deaf = False
    rig.until(lambda: rig.bench.flight is FlightState.LANDED, 4.0)


def test_a_stop_during_a_take_off_continues_until_the_motors_are_off() -> None:
    """They were not turning at the stop, and turn once the drone received the take-off but not the stop."""
    rig = Rig()
    rig.ready()
    rig.do(Takeoff())
    rig.run(0.1)
    rig.deaf = True
    rig.do(EmergencyStop())
    rig.run(3.0)
    rig.deaf = False
    rig.until(lambda: rig.bench.flight is FlightState.LANDED, 4.0)
    rig.run(3.0)
    assert rig.state is FlightState.EMERGENCY


def test_attitude_is_a_share_of_the_stick() -> None:
    rig = Rig()
    rig.ready()
    rig.do(Takeoff())
    rig.until(lambda: rig.state is FlightState.HOVERING, 12.0)
    rig.take_sent()
    applied = rig.do(Attitude(roll=0.1, pitch=-0.9, climb=5.0, yaw_rate=0.875))
    assert applied == Attitude(roll=0.1, pitch=-0.2, climb=1.0, yaw_rate=0.875)
    rig.run(0.1)
    assert rig.sent[-1] == "rc 50 -100 100 -50"


# Link loss and recovery --------------------------------------------------------------------------------------------


def test_an_absent_drone_is_reported_and_retried() -> None:
    rig = Rig()
    rig.on = False
    rig.run(2.5)
    assert [state for state, _ in rig.sink.links] == [LinkState.CONNECTING, LinkState.LOST]
    assert "no state from drone, UDP port 8889" in rig.sink.links[-1][1]
    assert 4 <= rig.sent.count("command") <= 6
    with pytest.raises(DriverError, match="no data from"):
        rig.do(Takeoff())
    rig.on = True
    rig.ready()
    rig.run(0.2)
    assert rig.sink.link_state is LinkState.UP


def test_a_firewall_is_suspected_when_answers_arrive_without_state() -> None:
    rig = Rig()
    rig.bench.logic.state_string = lambda: None  # type: ignore[method-assign]
    rig.run(2.5)
    assert rig.sink.link_state is LinkState.LOST
    assert "though it answers: does a firewall of this host block UDP port 8890?" in rig.sink.links[-1][1]


def test_a_link_restored_in_flight_resumes_nothing() -> None:
    rig = Rig()
    rig.ready()
    rig.do(Takeoff())
    rig.until(lambda: rig.state is FlightState.HOVERING, 12.0)
    rig.do(Velocity(forward=0.3))
    rig.run(1.0)
    rig.on = False
    rig.until(lambda: rig.sink.link_state is LinkState.DEGRADED, 1.0)
    rig.until(lambda: rig.sink.link_state is LinkState.LOST, 1.2)
    rig.take_sent()
    rig.run(1.0)
    assert set(rig.take_sent()) == {"command", "rc 0 0 0 0"}  # it may receive us
    rig.on = True
    rig.until(lambda: rig.sink.link_state is LinkState.UP, 3.0)
    rig.until(lambda: rig.state is FlightState.HOVERING, 3.0)  # in the air, by its motors
    assert "rc 0 30 0 0" not in rig.sent


def test_a_landing_continues_while_the_drone_is_silent() -> None:
    rig = Rig()
    rig.ready()
    rig.do(Takeoff())
    rig.until(lambda: rig.state is FlightState.HOVERING, 12.0)
    rig.on = False
    rig.until(lambda: rig.sink.link_state is LinkState.LOST, 3.0)
    rig.do(Land())
    rig.take_sent()
    rig.run(2.9)
    assert rig.sent.count("land") in (2, 3)
    rig.on = True
    rig.until(lambda: rig.bench.flight is FlightState.LANDED, 12.0)
    rig.until(lambda: rig.state is FlightState.LANDED, 4.0)


def test_a_landing_of_a_lost_drone_expires() -> None:
    """It was once sent minutes or hours later, to a drone that another pilot flew by then."""
    rig = Rig()
    rig.ready()
    rig.do(Takeoff())
    rig.until(lambda: rig.state is FlightState.HOVERING, 12.0)
    rig.on = False
    rig.until(lambda: rig.sink.link_state is LinkState.LOST, 3.0)
    for _ in range(8):  # a pilot that still wants it sends it again
        rig.do(Land())
        rig.run(1.0)
    assert rig.take_sent().count("land") >= 5
    rig.run(3.0)
    assert rig.reasons.count("landing_given_up") == 1
    rig.take_sent()
    rig.run(60.0)
    assert not [text for text in rig.take_sent() if text.startswith(("land", "rc"))], "without commands it lands"
    rig.on = True
    rig.until(lambda: rig.sink.link_state is LinkState.UP, 5.0)
    rig.run(0.5)
    assert "land" not in rig.sent


def unheard() -> Rig:
    """Return a drone that receives but has been silent for a while; its pilot is there and sends no commands."""
    rig = Rig()
    rig.ready()
    rig.do(Takeoff())
    rig.until(lambda: rig.state is FlightState.HOVERING, 12.0)
    rig.do(Velocity(forward=0.3))
    rig.mute = True
    rig.until(lambda: rig.sink.link_state is LinkState.LOST, 3.0)
    return rig


def test_a_silent_drone_is_left_to_its_automatic_landing() -> None:
    """``command`` and level sticks once kept it in the air until its battery was empty."""
    rig = unheard()
    rig.run(3.1)
    assert "rc 0 0 0 0" in rig.take_sent(), "it does not continue with the earlier sticks"
    for _ in range(50):
        rig.session.command(Hover(), rig.now_ns, new=False)  # the library's own
        rig.session.command(Velocity(forward=0.3), rig.now_ns)  # a program that continues
        rig.run(0.5)
    assert not rig.take_sent()
    assert rig.bench.flight is FlightState.LANDED
    rig.run(6.0)
    assert set(rig.take_sent()) == {"command"}, "it may have been switched off and on"
    rig.mute = False
    rig.until(lambda: rig.sink.link_state is LinkState.UP, 5.0)
    rig.run(3.0)
    assert rig.bench.flight is FlightState.LANDED


@pytest.mark.parametrize("after_s", [0.1, 0.6])
def test_a_take_off_lost_before_it_shows_ends_in_an_automatic_landing(after_s: float) -> None:
    """``command``, twice a second, once kept it in the air for as long as it was silent."""
    rig = Rig()
    rig.ready()
    rig.do(Takeoff())
    rig.run(after_s)
    rig.mute = True
    rig.until(lambda: rig.bench.truth.state is FlightState.HOVERING, 5.0)
    rig.run(30.0)
    assert rig.bench.truth.state is FlightState.LANDED
    rig.mute = False
    rig.until(lambda: rig.session.ready, 40.0)
    assert rig.state is FlightState.LANDED


@pytest.mark.parametrize("asked_s", [1.0, 10.0])
def test_a_persons_command_reaches_a_silent_drone(asked_s: float) -> None:
    rig = unheard()
    rig.run(asked_s)
    rig.take_sent()
    rig.do(Hover())
    rig.run(0.2)
    assert "rc 0 0 0 0" in rig.take_sent()
    rig.do(Land())
    rig.until(lambda: rig.bench.flight is FlightState.LANDED, 8.0)
    assert "land" in rig.sent


def test_a_stop_reaches_a_drone_in_its_automatic_landing() -> None:
    rig = unheard()
    rig.run(10.0)
    rig.do(EmergencyStop())
    rig.until(lambda: rig.bench.flight is FlightState.LANDED, 4.0)


def test_a_drone_found_again_in_the_air_is_flown_further() -> None:
    rig = unheard()
    rig.run(8.0)
    rig.mute = False
    rig.until(lambda: rig.sink.link_state is LinkState.UP, 5.0)
    rig.do(Hover())
    rig.run(20.0)
    assert rig.state is FlightState.HOVERING


def test_an_automatic_hover_leaves_a_drone_alone_after_an_abandoned_stop() -> None:
    """The library's own hover once kept it awake and prevented its automatic landing."""
    rig = Rig()
    rig.ready()
    rig.do(Takeoff())
    rig.until(lambda: rig.state is FlightState.HOVERING, 12.0)
    rig.deaf = True
    rig.do(EmergencyStop())
    rig.run(11.0)
    rig.deaf = False
    rig.take_sent()
    for _ in range(8):  # it lands, and is kept awake on the ground
        rig.session.command(Hover(), rig.now_ns, new=False)
        rig.run(0.5)
    assert not [text for text in rig.sent if text.startswith(("rc", "wifi?"))]
    rig.session.command(Land(), rig.now_ns, new=False)
    rig.until(lambda: rig.state is FlightState.LANDED, 15.0)


def test_after_an_abandoned_stop_the_version_is_not_requested() -> None:
    """That request, like any command, kept it in the air for another 15 s, or forever if it was not answered."""
    rig = Rig()
    rig.ready()
    rig.do(Takeoff())
    rig.until(lambda: rig.state is FlightState.HOVERING, 12.0)
    rig.on = False
    rig.run(2.0)
    rig.do(EmergencyStop())
    rig.run(10.4)
    rig.take_sent()
    rig.on = True
    rig.until(lambda: rig.sink.link_state is LinkState.DEGRADED, 1.0)
    rig.until(lambda: rig.bench.flight is FlightState.LANDING, 3.0)
    assert not rig.take_sent()
    rig.do(Hover())
    rig.until(lambda: rig.sink.link_state is LinkState.UP, 3.0)


def test_a_drone_left_in_the_air_by_another_program_lands() -> None:
    """A request every 4 s once kept it there until its battery was empty."""
    rig = Rig()
    rig.ready()
    rig.bench.logic.receive(b"takeoff", PILOT)
    rig.until(lambda: rig.state is FlightState.HOVERING, 12.0)
    rig.run(1.0)
    rig.take_sent()
    rig.until(lambda: rig.state is FlightState.LANDED, 25.0)
    assert not rig.sent
    rig.run(5.0)
    assert set(rig.sent) == {"wifi?"}, "on the ground it is kept awake"


def test_a_drone_found_in_the_air_without_answers_is_not_asked_forever() -> None:
    rig = Rig()
    rig.on = False
    for text in (b"command", b"takeoff"):
        rig.bench.logic.receive(text, PILOT)
    rig.until(lambda: rig.bench.truth.state is FlightState.HOVERING, 5.0)
    rig.on = rig.deaf = True
    rig.run(6.0)
    assert "sdk?" in rig.take_sent()
    rig.run(5.0)
    assert not rig.take_sent()
    rig.deaf = False
    rig.do(Hover())
    rig.until(lambda: rig.sink.link_state is LinkState.UP, 3.0)


def test_a_restarted_drone_is_set_up_again() -> None:
    rig = Rig(TelloOptions("drone", video=False, pads=True))
    rig.ready()
    rig.run(1.0)
    assert rig.bench.logic.looks_for_pads
    rig.session.remembered["camera.fps"] = "setfps low"
    rig.on = False
    rig.until(lambda: rig.sink.link_state is LinkState.LOST, 3.0)
    rig.restart_drone()
    rig.ready()
    rig.run(1.0)
    assert rig.bench.logic.looks_for_pads
    assert rig.bench.logic.fps == 5.0


def test_a_drone_that_does_not_receive_us_is_reported() -> None:
    rig = Rig()
    rig.ready()
    rig.run(0.1)
    rig.deaf = True
    rig.until(lambda: rig.sink.link_state is LinkState.DEGRADED, 15.0)
    assert rig.sink.links[-1][1] == "the drone sends its state, but answers no command"
    rig.deaf = False
    rig.until(lambda: rig.sink.link_state is LinkState.UP, 3.0)


@pytest.mark.parametrize(
    ("sdk", "serial"), [(Sdk.V1_3, ""), (Sdk.V2_0, "0TQEMULATED001"), (Sdk.V3_0, "0TQEMULATED001")]
)
def test_the_version_is_detected(sdk: Sdk, serial: str) -> None:
    rig = Rig(sdk=sdk)
    rig.ready()
    rig.run(1.0)
    assert rig.session.sdk is sdk
    assert rig.session.serial == serial


def test_custom_ports_need_sdk_3() -> None:
    options = TelloOptions("drone", video=False, state_port=9990)
    rig = Rig(options)
    rig.ready()
    assert rig.bench.logic.state_port == 9990
    old = Rig(options, sdk=Sdk.V2_0)
    board = old.bench.logic
    board.state_string = lambda: None  # type: ignore[method-assign]  # its states go to another port
    old.run(3.0)
    assert old.reasons.count("ports_refused") == 1


def test_video_is_requested_until_it_arrives() -> None:
    came_ns = [0]
    rig = Rig(TelloOptions("drone"))
    rig.session._video_ns = lambda: came_ns[0]
    rig.ready()
    rig.run(5.0)
    assert rig.sent.count("streamon") in (2, 3)
    assert rig.bench.logic.streaming
    rig.take_sent()
    for _ in range(100):
        came_ns[0] = rig.now_ns
        rig.step()
    assert "streamon" not in rig.sent


# Reports -----------------------------------------------------------------------------------------------------------


def test_pads_are_reported_when_they_appear_and_disappear() -> None:
    x, y, _ = Rig().bench.truth.position_m
    rig = Rig(TelloOptions("drone", video=False, pads=True), pads={5: (x, y)})
    rig.ready()
    rig.run(1.0)
    rig.do(Takeoff())
    rig.until(lambda: "mission_pad" in rig.reasons, 10.0)
    event = next(event for event in rig.sink.events if event.data.get("reason") == "mission_pad")
    assert event.data["pad"] == 5
    assert event.data["in_view"] is True
    place = event.data["place"]
    assert isinstance(place, tuple)
    assert place[2] == pytest.approx(0.3, abs=0.15)
    rig.until(lambda: rig.state is FlightState.HOVERING, 10.0)
    rig.do(Velocity(forward=0.8))
    rig.until(lambda: rig.sink.events[-1].data.get("in_view") is False, 6.0)
    assert rig.feedback.native is not None
    assert rig.feedback.native["mid"] == -1


def test_feedback_agrees_with_the_truth() -> None:
    rig = Rig()
    rig.ready()
    start_yaw = rig.bench.truth.yaw_rad
    rig.do(Takeoff())
    rig.until(lambda: rig.state is FlightState.HOVERING, 12.0)
    rig.do(Velocity(forward=0.4, left=0.3, yaw_rate=0.5))
    rig.run(2.5)
    feedback, truth = rig.feedback, rig.bench.truth
    assert feedback.yaw_rad == pytest.approx(math.remainder(truth.yaw_rad - start_yaw, math.tau), abs=0.1)
    assert feedback.altitude_m == pytest.approx(truth.position_m[2], abs=0.1)
    assert feedback.velocity_m_s is not None
    assert feedback.velocity_m_s[0] == pytest.approx(0.4, abs=0.15)
    assert feedback.velocity_m_s[1] == pytest.approx(0.3, abs=0.15)
    assert feedback.pitch_rad == pytest.approx(truth.pitch_rad, abs=0.03)
    assert feedback.roll_rad == pytest.approx(truth.roll_rad, abs=0.03)
    assert feedback.acceleration_m_s2 is not None
    assert feedback.acceleration_m_s2[2] == pytest.approx(9.8, abs=1.0)
    assert feedback.battery == pytest.approx(1.0, abs=0.05)
    assert feedback.position_m is None
    assert feedback.native is not None
    assert feedback.native["state.received"] > 10  # type: ignore[operator]


def test_velocity_may_be_left_out() -> None:
    rig = Rig(TelloOptions("drone", video=False, velocity_axes=VelocityAxes.NONE))
    rig.ready()
    rig.run(0.5)
    assert rig.feedback.velocity_m_s is None


# Damage ------------------------------------------------------------------------------------------------------------

_NOISE = st.binary(max_size=300) | st.text(alphabet="okerounmidpthbatvgxyz:;-.0123456789 ", max_size=120).map(
    str.encode
)


@settings(max_examples=60, deadline=None)
@given(st.lists(st.tuples(st.booleans(), _NOISE), max_size=60), st.booleans())
def test_no_input_raises(datagrams: list[tuple[bool, bytes]], flying: bool) -> None:
    rig = Rig()
    rig.run(0.5)
    if flying:
        rig.do(Takeoff())
    for is_state, datagram in datagrams:
        (rig.session.on_state if is_state else rig.session.on_reply)(datagram, rig.now_ns)
        rig.step()
    assert not rig.sink.problems
    assert isinstance(rig.state, FlightState)


@settings(max_examples=40, deadline=None)
@given(st.data())
def test_recorded_states_that_were_damaged_do_not_raise(data: st.DataObject) -> None:
    rig = Rig()
    rig.run(0.2)
    for _ in range(10):
        line = bytearray(data.draw(st.sampled_from(strings())).encode())
        for _ in range(data.draw(st.integers(0, 6))):
            line[data.draw(st.integers(0, len(line) - 1))] = data.draw(st.integers(0, 255))
        rig.session.on_state(bytes(line), rig.now_ns)
        rig.step()
    assert not rig.sink.problems


def test_a_late_state_is_ignored() -> None:
    """An earlier one, with fewer seconds of running motors, would make the next one look like a start of the motors."""
    rig = Rig()
    rig.ready()
    rig.do(Takeoff())
    rig.until(lambda: rig.state is FlightState.HOVERING, 12.0)
    late = rig.bench.logic.state_string()
    assert late is not None
    rig.do(Land())
    rig.until(lambda: rig.state is FlightState.LANDED, 12.0)
    before = rig.sink.feedback_count
    rig.session.on_state(late, rig.now_ns)
    for publish in rig.session.drain():
        publish(rig.sink)
    assert rig.sink.feedback_count == before
    rig.run(1.0)
    assert rig.state is FlightState.LANDED
    assert rig.feedback.native is not None
    assert rig.feedback.native["state.late"] == 1
