"""A session from the first datagram on: set-up, link loss, recovery, reports. Without sockets, on a manual clock."""

from __future__ import annotations

import random

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from skyloop.errors import DriverError
from skyloop.messages import (
    Attitude,
    EmergencyStop,
    FlightState,
    Hover,
    Land,
    LinkState,
    ResetEmergency,
    Severity,
    Takeoff,
)
from skyloop.vehicles.ardrone.configuration import Exchange, Read, Write
from skyloop.vehicles.ardrone.options import ArdroneOptions
from skyloop.vehicles.ardrone.wire.at import Ref
from skyloop.vehicles.ardrone.wire.navdata import Demo, State, Time, encode
from tests.support.recordings import content, needs_recordings
from tests.vehicles.ardrone.scripted import IDS, Rig, ScriptedDrone, ns

RECORDED = content("ardrone2/navdata-full-landed.bin")


def links(rig: Rig) -> list[LinkState]:
    return [state for state, _ in rig.sink.links]


def newest_link(rig: Rig) -> tuple[LinkState, str]:
    return rig.sink.links[-1]


def test_an_ardrone_2_is_set_up_within_a_second() -> None:
    rig = Rig()
    rig.run(0.02)
    assert links(rig) == [LinkState.CONNECTING]
    assert rig.until(lambda: rig.session.ready, 1.0) < 1.0
    rig.run(0.05)
    assert links(rig) == [LinkState.CONNECTING, LinkState.UP]
    assert rig.session.version == 2
    assert rig.drone.state & State.DEMO
    ids = ("custom:session_id", "custom:profile_id", "custom:application_id")
    assert tuple(rig.drone.values[key] for key in ids) == (IDS.session, IDS.profile, IDS.application)
    assert rig.session.setpoints.limits is not None
    assert rig.session.setpoints.limits.tilt_rad == pytest.approx(0.2094395, rel=1e-6)
    assert not rig.drone.state & State.COMMAND_ACK, "the acknowledge bit is cleared after the last answer"


def test_every_config_is_preceded_by_the_ids_in_force() -> None:
    rig = Rig()
    rig.ready()
    commands = rig.drone.commands
    before = [commands[at - 1] for at, command in enumerate(commands) if command.name == "CONFIG"][1:]
    assert before, "the first one sets the mode, before ids are known"
    assert {command.name for command in before} == {"CONFIG_IDS"}
    assert before[0].arguments == ("00000000",) * 3
    assert before[-1].arguments == (IDS.session, IDS.profile, "00000000")


def test_an_ardrone_1_is_recognised_by_its_firmware_and_gets_no_ids() -> None:
    rig = Rig(drone=ScriptedDrone(version=1))
    rig.ready()
    assert rig.session.version == 1
    assert "CONFIG_IDS" not in rig.drone.names


def test_ids_can_be_declined() -> None:
    rig = Rig(ArdroneOptions("drone", ids=False))
    rig.ready()
    assert "CONFIG_IDS" not in rig.drone.names


def test_ids_that_the_drone_does_not_keep_are_reported() -> None:
    rig = Rig()
    rig.drone.stubborn = {"custom:session_id"}
    rig.ready()
    rig.run(0.05)
    assert any("settings of our own" in text for text in rig.texts)
    assert rig.session.configurator.ids is not None
    assert rig.session.configurator.ids.session == "00000000"


def test_the_full_mode_and_its_options() -> None:
    rig = Rig(ArdroneOptions("drone", full=True, navdata_options=0x4000401))
    rig.ready()
    assert not rig.drone.state & State.DEMO
    assert rig.drone.values["general:navdata_options"] == 0x4000401


def test_a_drone_already_in_its_mode_is_not_switched() -> None:
    rig = Rig()
    rig.drone.state = State.DEMO
    rig.ready()
    assert ("general:navdata_demo", "TRUE") not in [command.arguments for command in rig.drone.commands]


@pytest.mark.parametrize("seed", range(4))
def test_set_up_with_a_third_of_the_datagrams_lost(seed: int) -> None:
    rig = Rig()
    chance = random.Random(seed)
    rig.lost = lambda: chance.random() < 0.33
    rig.until(lambda: rig.session.ready, 12.0)


# The pace and the watchdog ---------------------------------------------------------------------------------------


def test_commands_keep_their_pace_whatever_the_application_does() -> None:
    rig = Rig()
    rig.ready()
    rig.run(0.2)
    rig.sent.clear()
    rig.run(3.0)
    assert len(rig.sent) == pytest.approx(100, abs=2)
    assert all(b"AT*PCMD" in datagram and b"AT*REF" in datagram for datagram in rig.sent)


def test_the_watchdog_is_cleared_while_its_bit_is_set() -> None:
    rig = Rig()
    rig.ready()
    rig.drone.state |= State.COMMUNICATION_WATCHDOG
    rig.until(lambda: not rig.drone.state & State.COMMUNICATION_WATCHDOG, 0.2)
    rig.run(0.1)
    rig.drone.commands.clear()
    rig.run(0.5)
    assert "COMWDG" not in rig.drone.names


def test_a_new_decision_is_sent_at_once() -> None:
    rig = Rig()
    rig.ready()
    rig.run(0.1)
    now_ns = rig.clock.now_ns
    rig.session.poll(now_ns)
    now_ns = rig.clock.advance(0.012)
    rig.session.command(Takeoff(), now_ns)
    assert rig.session.due_ns == now_ns
    rig.session.poll(now_ns)
    rig.session.command(Land(), rig.clock.advance(0.002))
    assert rig.session.due_ns == now_ns + ns(0.01), "but not sooner than the drone accepts it"


def test_a_repeated_decision_is_not_sent_early() -> None:
    rig = Rig()
    rig.ready()
    rig.session.poll(rig.clock.now_ns)
    due_ns = rig.session.due_ns
    rig.session.command(Hover(), rig.clock.advance(0.015))
    assert rig.session.due_ns == due_ns


def test_the_sequence_restarts_when_the_drone_lost_us() -> None:
    rig = Rig()
    rig.ready()
    rig.run(0.5)
    rig.drone.commands.clear()
    rig.drone.extra = State.COMMUNICATION_LOST
    rig.run(0.1)
    assert (LinkState.LOST, "the drone reports that it lost its link to us") in rig.sink.links
    assert 1 in [command.sequence for command in rig.drone.commands]
    rig.until(lambda: rig.sink.link_state is LinkState.UP, 2.0)
    rig.drone.extra = State(0)
    rig.run(0.5)
    assert rig.sink.link_state is LinkState.UP


def test_the_sequence_restarts_when_our_commands_are_ignored() -> None:
    rig = Rig()
    rig.ready()
    rig.run(0.5)
    rig.drone.heard_sequence = 1_000_000  # another program counted far
    rig.drone.state |= State.COMMUNICATION_WATCHDOG
    rig.until(lambda: not rig.drone.state & State.COMMUNICATION_WATCHDOG, 2.0)
    assert rig.drone.stale > 0


# Link loss and recovery ------------------------------------------------------------------------------------------


def test_silence_degrades_and_then_loses_the_link() -> None:
    rig = Rig()
    rig.ready()
    rig.run(0.1)
    rig.switch_off()
    rig.run(0.2)
    assert rig.sink.link_state is LinkState.UP
    rig.run(0.15)
    state, reason = newest_link(rig)
    assert state is LinkState.DEGRADED
    assert "no navdata for 0." in reason
    rig.run(0.9)
    state, reason = newest_link(rig)
    assert state is LinkState.LOST
    assert "drone, UDP port 5554" in reason


def test_a_short_silence_needs_no_set_up() -> None:
    rig = Rig()
    rig.ready()
    rig.run(0.1)
    rig.on = False
    rig.run(0.5)
    rig.on = True
    rig.run(0.1)
    assert links(rig)[-2:] == [LinkState.DEGRADED, LinkState.UP]
    assert rig.session.ready


def test_a_drone_is_set_up_again_after_an_absence() -> None:
    rig = Rig()
    rig.ready()
    rig.run(0.1)
    rig.switch_off()
    rig.run(2.0)
    assert rig.session.setpoints.limits is None
    rig.drone.commands.clear()
    rig.switch_on()
    rig.until(lambda: rig.sink.link_state is LinkState.UP, 3.0)
    assert rig.drone.heard_sequence < 200, "the sequence restarted"
    assert rig.drone.values["custom:session_id"] == IDS.session
    assert rig.session.setpoints.limits is not None
    assert rig.session.reception.counts["restarts"] == 1


def test_a_drone_is_set_up_again_after_an_unnoticed_absence() -> None:
    rig = Rig()
    rig.ready()
    rig.run(0.2)
    rig.drone.restart()
    rig.until(lambda: rig.sink.links[-1] == (LinkState.LOST, "the drone rebooted"), 0.5)
    rig.until(lambda: rig.sink.link_state is LinkState.UP, 2.0)


def test_a_single_datagram_shows_neither_a_reboot_nor_a_lost_link() -> None:
    """It takes two in a row."""
    rig = Rig()
    rig.ready()
    rig.run(0.5)
    for sign in (State.BOOTSTRAP, State.COMMUNICATION_LOST):
        rig.drone.sequence += 1
        rig.session.on_navdata(encode(rig.drone.state | sign, rig.drone.sequence), rig.clock.now_ns)
        rig.run(0.3)
        assert rig.sink.link_state is LinkState.UP
    assert LinkState.LOST not in [state for state, _ in rig.sink.links]


def test_keys_that_the_drone_forgot_are_written_again() -> None:
    rig = Rig()
    rig.ready()
    rig.session.remembered["control:euler_angle_max"] = "3.000000e-01"
    rig.drone.restart()
    rig.run(0.3)
    rig.until(lambda: rig.sink.link_state is LinkState.UP, 3.0)
    assert rig.session.setpoints.limits is not None
    assert rig.session.setpoints.limits.tilt_rad == pytest.approx(0.3)


def test_an_absent_drone_is_reported_and_retried_forever() -> None:
    rig = Rig()
    rig.on = False
    rig.session.unreachable("No route to host")
    rig.run(2.5)
    assert rig.sink.links[-1] == (LinkState.LOST, "no navdata from drone, UDP port 5554 (No route to host)")
    starts = sum(rig.session.wants_start(rig.clock.advance(0.05)) for _ in range(40))
    assert starts == pytest.approx(8, abs=1)
    rig.on = True
    rig.until(lambda: rig.sink.link_state is LinkState.UP, 3.0)


def test_a_configuration_that_cannot_be_read_leaves_landing_possible() -> None:
    rig = Rig()
    rig.port_open = False
    rig.run(4.0)
    state, reason = rig.sink.links[-1]
    assert state is LinkState.DEGRADED
    assert "connection refused" in reason
    assert rig.session.command(Takeoff(), rig.clock.now_ns) == Takeoff()
    rig.run(0.2)
    assert rig.session.command(Attitude(pitch=0.1), rig.clock.now_ns) == Hover(), "no set-point counts as applied"
    rig.run(0.1)
    assert any("limits are not known" in text for text in rig.texts)
    rig.session.command(Land(), rig.clock.now_ns)
    rig.run(0.2)
    assert not rig.drone.state & State.FLYING
    rig.port_open = True
    rig.until(lambda: rig.sink.link_state is LinkState.UP, 8.0)


def test_a_drone_that_acknowledges_nothing_is_reported() -> None:
    rig = Rig()
    rig.drone.deaf = True
    rig.run(4.0)
    assert rig.sink.link_state is LinkState.DEGRADED
    rig.drone.deaf = False
    rig.until(lambda: rig.sink.link_state is LinkState.UP, 8.0)


def test_without_limits_set_points_are_refused() -> None:
    rig = Rig()
    del rig.drone.values["control:control_yaw"]
    rig.ready()
    rig.run(0.1)
    assert any("has no limits" in text for text in rig.texts)
    assert rig.session.command(Attitude(pitch=0.1), rig.clock.now_ns) == Hover()


def test_a_link_loss_during_the_set_up() -> None:
    rig = Rig()
    rig.run(0.1)
    assert not rig.session.ready
    rig.switch_off()
    rig.until(lambda: rig.sink.link_state is LinkState.LOST, 3.0)
    rig.switch_on()
    rig.until(lambda: rig.sink.link_state is LinkState.UP, 3.0)


# Reports ---------------------------------------------------------------------------------------------------------


def test_feedback_includes_the_counts() -> None:
    rig = Rig()
    rig.ready()
    rig.session.on_navdata(b"garbage", rig.clock.now_ns)
    rig.run(0.5)
    feedback = rig.sink.newest
    assert feedback is not None
    assert (feedback.state, feedback.battery, feedback.altitude_m) == (FlightState.LANDED, 0.7, 0.0)
    assert feedback.native is not None
    assert feedback.native["navdata.damaged"] == 1
    assert not rig.sink.problems


def test_full_navdata_is_published_at_the_requested_rate() -> None:
    rig = Rig(ArdroneOptions("drone", full=True, rate_hz=10.0))
    rig.ready()
    rig.run(0.1)
    before = rig.sink.feedback_count
    rig.run(2.0)
    assert rig.sink.feedback_count - before == pytest.approx(20, abs=3)


def test_each_change_of_health_is_reported_once() -> None:
    rig = Rig()
    rig.ready()
    rig.drone.extra = State.BATTERY_LOW
    rig.run(0.5)
    rig.drone.extra = State(0)
    rig.run(0.5)
    told = [event for event in rig.sink.events if event.data.get("reason") == "battery_low"]
    assert [(event.severity, event.data["active"]) for event in told] == [
        (Severity.WARNING, True),
        (Severity.INFO, False),
    ]


def test_a_refused_takeoff_is_reported_and_not_retried_forever() -> None:
    rig = Rig()
    rig.ready()
    rig.drone.refuses_takeoff = True
    rig.session.command(Takeoff(), rig.clock.now_ns)
    rig.run(6.0)
    assert any("did not take off" in text for text in rig.texts)
    rig.drone.refuses_takeoff = False
    rig.run(1.0)
    assert not rig.drone.state & State.FLYING


def test_a_lost_flight_does_not_take_off_again_after_landing() -> None:
    rig = Rig()
    rig.ready()
    rig.session.command(Takeoff(), rig.clock.now_ns)
    rig.until(lambda: bool(rig.drone.state & State.FLYING), 0.5)
    rig.switch_off()
    rig.run(2.0)
    rig.session.command(Hover(), rig.clock.now_ns)  # as the proxy's failsafe does
    rig.drone.commands.clear()
    rig.switch_on()
    rig.until(lambda: rig.sink.link_state is LinkState.UP, 3.0)
    rig.run(1.0)
    assert not rig.drone.state & State.FLYING
    with_takeoff = [c for c in rig.drone.commands if c.name == "REF" and int(c.arguments[0]) & Ref.TAKEOFF]
    assert not with_takeoff


def test_a_flying_drone_is_left_flying() -> None:
    rig = Rig()
    rig.drone.state = State.FLYING | State.DEMO
    rig.ready()
    rig.run(1.0)
    assert rig.drone.state & State.FLYING


def test_no_takeoff_without_navdata() -> None:
    rig = Rig()
    with pytest.raises(DriverError, match="no data from"):
        rig.session.command(Takeoff(), rig.clock.now_ns)


def test_commands_without_acknowledgement_are_repeated_as_requested() -> None:
    rig = Rig()
    rig.ready()
    rig.session.send(("FTRIM", ()))
    rig.session.send(("ANIM", (18, 15)), 1)
    rig.run(0.5)
    assert rig.drone.names.count("FTRIM") == 3
    assert rig.drone.names.count("ANIM") == 1


def test_closing_ends_exchanges() -> None:
    rig = Rig()
    rig.ready()
    failures: list[str | None] = []
    steps = iter((Write("control:outdoor", "TRUE"), Read()))
    rig.session.submit(Exchange(steps, rig.clock.now_ns + ns(9), failures.append))
    rig.session.close()
    assert failures == ["the driver was closed"]


# Damage ----------------------------------------------------------------------------------------------------------


@needs_recordings
@settings(max_examples=60, deadline=None)
@given(st.lists(st.binary(max_size=64) | st.integers(0, 8 * len(RECORDED) - 1) | st.just(RECORDED), max_size=30))
def test_any_input_is_counted_and_never_raises(pieces: list[bytes | int]) -> None:
    rig = Rig()
    damaged = 0
    for piece in pieces:
        datagram = piece if isinstance(piece, bytes) else _flipped(piece)
        damaged += datagram != RECORDED
        rig.session.on_navdata(datagram, rig.clock.advance(0.005))
        rig.session.poll(rig.clock.now_ns)
    counts = rig.session.reception.counts
    assert counts["damaged"] == damaged
    assert counts["received"] + counts["late"] + damaged == len(pieces)
    for publish in rig.session.drain():
        publish(rig.sink)
    assert all(feedback.battery == 0.5 for feedback in rig.sink.feedbacks)


def _flipped(bit: int) -> bytes:
    datagram = bytearray(RECORDED)
    datagram[bit // 8] ^= 1 << bit % 8
    return bytes(datagram)


@settings(max_examples=60, deadline=None)
@given(st.permutations(range(1, 25)))
def test_reordered_navdata_never_run_backwards(order: list[int]) -> None:
    rig = Rig()
    for sequence in order:
        now_ns = rig.clock.advance(0.005)
        battery = Demo(ctrl_state=0x20000, battery=sequence)
        rig.session.on_navdata(encode(State.DEMO, sequence, [battery, Time(sequence * 5000)]), now_ns)
    for publish in rig.session.drain():
        publish(rig.sink)
    batteries = [feedback.battery for feedback in rig.sink.feedbacks if feedback.battery is not None]
    counts = rig.session.reception.counts
    assert counts["received"] == len(batteries)
    assert counts["received"] + counts["late"] == 24
    if not counts["restarts"]:
        assert batteries == sorted(batteries)
    assert not [problem for problem in rig.sink.problems if "before the one" in problem]


@needs_recordings
def test_the_recorded_datagram_goes_through() -> None:
    rig = Rig(ArdroneOptions("drone", full=True))
    rig.session.on_navdata(RECORDED, rig.clock.now_ns)
    for publish in rig.session.drain():
        publish(rig.sink)
    feedback = rig.sink.newest
    assert feedback is not None
    assert (feedback.state, feedback.battery) == (FlightState.LANDED, 0.5)
    assert not rig.sink.events, "it is healthy"


def test_a_landing_of_a_lost_drone_expires() -> None:
    rig = Rig()
    rig.ready()
    rig.session.command(Land(), rig.clock.now_ns)
    rig.on = False
    rig.until(lambda: newest_link(rig)[0] is LinkState.LOST, 5.0)
    rig.run(3.1)
    assert [event.data.get("reason") for event in rig.sink.events].count("landing_given_up") == 1
    rig.sent.clear()
    rig.run(5.0)
    assert rig.sent
    assert not [datagram for datagram in rig.sent if b"AT*REF" in datagram]


# The emergency bit over a bad link -----------------------------------------------------------------------------------


def flying() -> Rig:
    rig = Rig()
    rig.ready()
    rig.navdata_steps = 7  # about 15 Hz, like a real drone
    rig.session.command(Takeoff(), rig.clock.now_ns)
    rig.until(lambda: State.FLYING in rig.drone.state, 1.0)
    rig.run(0.3)
    return rig


@pytest.mark.parametrize("seed", range(10))
def test_an_emergency_is_toggled_once_over_any_link(seed: int) -> None:
    """Packets are late, lost and reordered; a second toggle would release the motors, or stop them after a reset."""
    rig, chance = flying(), random.Random(seed)
    drone, setpoints = rig.drone, rig.session.setpoints
    rig.lost = lambda: chance.random() < 0.3
    rig.late = lambda _up: chance.choice((0.0, 0.02, 0.1, 0.3))
    rig.session.command(EmergencyStop(), rig.clock.now_ns)
    rig.until(lambda: setpoints.stop.shown, 8.0)
    rig.run(3.0)
    assert State.EMERGENCY in drone.state
    assert drone.toggles == 1
    rig.session.command(ResetEmergency(), rig.clock.now_ns)
    rig.until(lambda: State.EMERGENCY not in drone.state, 3.0)
    rig.run(3.0)
    assert State.EMERGENCY not in drone.state
    assert drone.toggles == 2
    assert State.FLYING not in drone.state


@pytest.mark.parametrize("stall_s", [0.5, 0.7, 0.9])
@pytest.mark.parametrize("before_s", [0.0, 0.1, 0.3])
def test_delayed_navdata_is_not_new(stall_s: float, before_s: float) -> None:
    """After a stall of the driver or the network, navdata arrives in a burst, the oldest first."""
    rig = flying()
    until_s = 0.0
    rig.late = lambda up: 0.0 if up else max(0.0, until_s - rig.clock.now_ns / 1e9)
    for action in (EmergencyStop(), ResetEmergency()):
        before = rig.drone.toggles
        until_s = rig.clock.now_ns / 1e9 + stall_s
        rig.run(before_s)
        rig.session.command(action, rig.clock.now_ns)
        rig.run(3.0)
        assert rig.drone.toggles == before + 1
    assert State.EMERGENCY not in rig.drone.state


def test_one_old_datagram_after_a_gap_does_not_release_stopped_motors() -> None:
    rig = flying()
    old = rig.drone.navdata()
    rig.session.command(EmergencyStop(), rig.clock.now_ns)
    rig.until(lambda: rig.session.setpoints.stop.shown, 1.0)
    rig.run(1.0)
    rig.lost = lambda: True
    rig.run(0.3)
    rig.session.on_navdata(old, rig.clock.now_ns)
    rig.run(0.1)
    rig.lost = lambda: False
    rig.run(2.0)
    assert State.EMERGENCY in rig.drone.state
    assert rig.drone.toggles == 1


def test_a_stop_with_an_unseen_toggle_gets_another() -> None:
    """The drone had last seen the bit set, by another program."""
    rig = flying()
    rig.drone.hear_bit()
    rig.session.command(EmergencyStop(), rig.clock.now_ns)
    assert rig.until(lambda: State.EMERGENCY in rig.drone.state, 2.0) > 0.4
    rig.run(2.0)
    assert rig.drone.toggles == 1


@pytest.mark.parametrize("port_open", [False, True])
def test_such_a_stop_takes_no_longer_with_unconfigured_navdata(port_open: bool) -> None:
    """Navdata is sparse then, and was taken for dense: the next toggle took 7.5 s, or never came during the set-up."""
    rig = Rig()
    rig.navdata_steps = 7
    rig.drone.stubborn = {"general:navdata_demo"}
    rig.port_open = port_open
    rig.run(1.0)
    assert State.BOOTSTRAP in rig.drone.state
    rig.drone.hear_bit()
    rig.session.command(EmergencyStop(), rig.clock.now_ns)
    assert 0.4 < rig.until(lambda: State.EMERGENCY in rig.drone.state, 8.0) < 0.8


def test_motors_soon_released_by_another_program_are_stopped_again() -> None:
    rig = flying()
    rig.session.command(EmergencyStop(), rig.clock.now_ns)
    rig.run(2.0)
    rig.drone.state = rig.drone.state & ~State.EMERGENCY | State.FLYING
    assert rig.until(lambda: State.EMERGENCY in rig.drone.state, 2.0) < 0.8


# A landed drone does not take off by its old state -------------------------------------------------------------------


@pytest.mark.parametrize("stall_s", [0.5, 0.9, 4.0])
def test_a_drone_that_landed_during_a_stall_of_the_driver_stays_landed(stall_s: float) -> None:
    """After 2 s of silence it lands. Old navdata of its flight then made the driver command a take-off."""
    rig = flying()
    rig.session.command(Hover(), rig.clock.now_ns)
    rig.run(0.2)
    waiting = []
    for step in range(round(stall_s * 15)):
        rig.clock.advance(1 / 15)
        if step == round(stall_s * 10):
            rig.drone.land()
        waiting.append(rig.drone.navdata())
    before = len(rig.drone.commands)
    for number, datagram in enumerate(waiting):
        rig.session.on_navdata(datagram, rig.clock.advance(0.0005))
        if number % 3 == 0:  # between two bursts
            rig.session.command(Hover(), rig.clock.now_ns)
            rig.drone.take(rig.session.poll(rig.clock.now_ns))
        assert State.FLYING not in rig.drone.state
    rig.run(2.0)
    assert len(rig.drone.commands) > before + 20
    assert State.FLYING not in rig.drone.state


def test_a_short_silence_causes_no_takeoff() -> None:
    rig = flying()
    rig.lost = lambda: True
    rig.run(0.5)
    rig.drone.land()
    rig.late = lambda up: 0.0 if up else 10.0
    rig.lost = lambda: False
    rig.run(0.4)
    assert State.FLYING not in rig.drone.state
    rig.late = lambda _up: 0.0
    rig.run(0.5)
    assert State.FLYING not in rig.drone.state


def test_a_flying_drone_gets_the_takeoff_bit_again_after_a_gap() -> None:
    rig = flying()
    rig.lost = lambda: True
    rig.run(0.5)
    rig.lost = lambda: False
    rig.run(0.5)
    references = [command for command in rig.drone.commands if command.name == "REF"]
    assert Ref(int(references[-1].arguments[0])) & Ref.TAKEOFF
