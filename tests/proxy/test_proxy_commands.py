"""The command path: execution, refusals, and reports at a limited rate."""

from __future__ import annotations

import math
import random
from typing import Any

import pytest

from skyloop.messages import (
    Annotation,
    AnyAction,
    Attitude,
    Command,
    EmergencyStop,
    Event,
    EventKind,
    Fate,
    Feedback,
    FlightState,
    GetStatistics,
    Hover,
    Idle,
    Land,
    LinkState,
    Refusal,
    Refused,
    RequestAuthority,
    ResetEmergency,
    Role,
    Statistics,
    Takeoff,
    Velocity,
    encode,
)
from tests.support.proxy_bench import WAIT_S, App, Bench


def test_a_command_reaches_the_vehicle_and_is_echoed(bench: Bench) -> None:
    pilot = bench.airborne()
    sent = pilot.command(Velocity(0.5, yaw_rate=0.1))
    assert bench.driver.told == [Velocity(0.5, yaw_rate=0.1)]
    echo = pilot.applied[-1]
    assert (echo.seq, echo.lease, echo.app_id, echo.sent_ns) == (sent.seq, 1, pilot.app_id, sent.sent_ns)
    assert echo.asked == echo.applied == sent.action


@pytest.mark.parametrize(
    ("changes", "action", "reason"),
    [
        ({"seq": 1}, Velocity(1.0), Refusal.OUT_OF_SEQUENCE),
        ({"sent_ns": 1}, Velocity(1.0), Refusal.STALE),
        ({"sent_ns": 2**62}, Velocity(1.0), Refusal.STALE),
        ({"lease": 0}, Velocity(1.0), Refusal.NO_AUTHORITY),
        ({"lease": 77}, Velocity(1.0), Refusal.FOREIGN_LEASE),
        ({}, Velocity(math.nan), Refusal.NON_FINITE),
        ({}, Attitude(0.0, math.inf), Refusal.NON_FINITE),
        ({}, ResetEmergency(), Refusal.WRONG_STATE),
    ],
)
def test_bad_commands_are_refused_and_reported(
    bench: Bench, changes: dict[str, Any], action: AnyAction, reason: Refusal
) -> None:
    pilot = bench.airborne()
    pilot.command(action, **changes)
    assert bench.driver.told == []
    assert pilot.refusals() == [reason]
    assert pilot.applied[-1].applied == Idle()
    pilot.seq += 1
    pilot.command(Velocity(0.5))
    assert bench.driver.told == [Velocity(0.5)]


def test_set_points_on_the_ground_are_refused_and_hover_is_harmless(bench: Bench) -> None:
    pilot = bench.pilot()
    pilot.command(Velocity(1.0))
    assert pilot.refusals() == [Refusal.WRONG_STATE]
    pilot.command(Hover())
    pilot.command(Land())
    assert pilot.refusals() == [Refusal.WRONG_STATE]
    assert bench.driver.told == []


def test_repeats_of_a_take_off_and_set_points_during_it_leave_it_alone(bench: Bench) -> None:
    pilot = bench.pilot()
    pilot.command(Takeoff())
    pilot.command(Takeoff(), repeat=True)
    pilot.command(Velocity(1.0))
    assert bench.driver.told == [Takeoff()]
    bench.driver.report(state=FlightState.HOVERING)
    pilot.command(Takeoff())
    assert bench.driver.told == [Takeoff(), Hover()]
    assert pilot.refusals() == []


def test_land_and_hover_are_obeyed_during_a_take_off(bench: Bench) -> None:
    pilot = bench.pilot()
    pilot.command(Takeoff())
    pilot.command(Land())
    pilot.command(Velocity(1.0))  # a controller that keeps running
    pilot.command(Takeoff())
    assert bench.driver.told == [Takeoff(), Land(), Hover()]


def test_an_unsupported_action_is_refused() -> None:
    with Bench(actions=()) as bench:
        pilot = bench.pilot()
        pilot.command(Takeoff())
        (event,) = pilot.told(EventKind.COMMAND_REFUSED)
        assert event.data["reason"] == Refusal.UNSUPPORTED
        assert "it is a picture" in event.text
        pilot.command(EmergencyStop())
        statistics = pilot.ask(GetStatistics())
        assert isinstance(statistics, Statistics)
        assert statistics.counters["commands.refused.unsupported"] == 2
        assert bench.driver.told == []


def test_set_points_beyond_the_limits_are_clamped_and_reported_once(bench: Bench) -> None:
    pilot = bench.airborne()
    for _ in range(64):
        bench.clock.advance(1 / 32)
        pilot.command(Velocity(8.0))
        bench.tick()
    assert bench.driver.told == [Velocity(2.0)] * 64
    (event,) = pilot.told(EventKind.COMMAND_CLAMPED)
    assert event.data == {"limit": "limits.speed", "asked": 8.0, "applied": 2.0}
    assert pilot.applied[-1].asked == Velocity(8.0)
    assert pilot.applied[-1].applied == Velocity(2.0)


def test_repeated_refusals_are_reported_at_once_and_then_once_a_second(bench: Bench) -> None:
    pilot, observer = bench.airborne(), bench.join("observer", Role.OBSERVER)

    def refused() -> None:
        pilot.command(Idle(), sync=False)
        pilot.command(Velocity(math.nan), sync=False)
        observer.command(Velocity())

    refused()
    assert len(pilot.refusals()) == 1
    bench.run(0.98, refused)
    assert len(pilot.refusals()) == 1
    bench.run(2.0, refused)
    told = [event for event in pilot.told(EventKind.COMMAND_REFUSED) if event.app == "pilot"]
    assert [event.data["count"] for event in told] == [1, 49, 50]
    assert len(observer.refusals()) == 3  # each application has its own count
    bench.run(2.0)
    assert len(pilot.refusals()) == 4  # the last sum
    pilot.command(Velocity(math.nan))
    assert len(pilot.refusals()) == 5  # a new one is reported at once again


@pytest.mark.parametrize("odd", [{}, {"seq": 0}, {"sent_ns": 0}, {"lease": 55}, {"sent_ns": 2**62}, {"sent_ns": 2**63}])
def test_any_pilot_can_stop_the_motors(bench: Bench, odd: dict[str, Any]) -> None:
    alice, bob = bench.airborne("alice"), bench.join("bob")
    alice.command(Velocity(0.5))
    bob.command(EmergencyStop(), **odd)
    assert bench.driver.told == [Velocity(0.5), EmergencyStop()]
    (event,) = alice.told(EventKind.EMERGENCY)
    assert event.app == "bob"
    alice.command(Velocity(0.5), repeat=True)
    alice.command(Takeoff())
    assert bench.driver.told[2:] == []
    alice.command(ResetEmergency())
    assert bench.driver.told[2:] == [ResetEmergency()]


def test_an_observer_and_a_stranger_stop_nothing(bench: Bench) -> None:
    bench.airborne()
    observer, stranger = bench.join("eve", Role.OBSERVER), bench.stranger()
    observer.command(EmergencyStop())
    assert observer.refusals() == [Refusal.OBSERVER]
    stranger.command(EmergencyStop(), sync=False)
    answer = stranger.ask(RequestAuthority())
    assert isinstance(answer, Refused)
    assert answer.code is Refusal.PROTOCOL
    assert observer.told(EventKind.COMMAND_REFUSED)[-1].data["reason"] == Refusal.PROTOCOL
    assert bench.driver.told == []


def test_a_raising_driver_is_reported_and_the_flight_continues(bench: Bench) -> None:
    pilot = bench.airborne()
    bench.driver.fail = {"apply"}
    pilot.command(Velocity(0.5))
    pilot.command(EmergencyStop())
    assert pilot.refusals() == [Refusal.DRIVER_FAILED]
    assert "apply is broken" in pilot.told(EventKind.DRIVER_ERROR)[0].text
    bench.driver.fail = set()
    pilot.command(Velocity(0.5))
    pilot.command(EmergencyStop())
    assert bench.driver.told == [Velocity(0.5), EmergencyStop()]


def test_a_landing_that_failed_once_is_not_reported_as_refused_while_the_vehicle_lands(bench: Bench) -> None:
    pilot = bench.airborne()
    bench.driver.fail = {"apply"}
    pilot.command(Land())
    bench.tick()
    outcome = pilot.last_feedback().outcome
    assert outcome is not None
    assert (outcome.over, outcome.reason) == (False, Refusal.DRIVER_FAILED)
    bench.driver.report(state=FlightState.LANDING)
    pilot.command(Land(), repeat=True)
    bench.driver.report(state=FlightState.LANDING)
    outcome = pilot.last_feedback().outcome
    assert outcome is not None
    assert (outcome.over, outcome.reason, outcome.text) == (False, None, "")


@pytest.mark.parametrize("state", [FlightState.HOVERING, FlightState.FLYING, FlightState.UNKNOWN])
@pytest.mark.parametrize("action", [Hover(), Land()])
def test_a_pilots_hover_and_landing_are_sent_to_a_silent_vehicle(
    bench: Bench, action: AnyAction, state: FlightState
) -> None:
    """It may still receive. Only the emergency stop was sent, which is not the way to bring a drone down."""
    pilot = bench.airborne()
    bench.tick()
    bench.driver.answers = False
    bench.driver.report(state=state)
    bench.driver.link(LinkState.LOST, "a dead downlink")
    bench.tick()
    bench.driver.told.clear()
    pilot.command(action)
    assert bench.driver.told == [action]
    bench.run(1.0, lambda: pilot.command(action, repeat=True))
    assert set(bench.driver.told) == {action}, "its failsafe's hover does not cancel a landing"
    assert pilot.refusals() == []
    steps = [event.data["step"] for event in pilot.told(EventKind.FAILSAFE)]
    assert steps == (["hover"] if action == Hover() else ["hover", "none"])
    for other in (Velocity(0.5), Takeoff(), ResetEmergency()):
        pilot.command(other)
    pilot.command(action, automatic=True)
    assert set(bench.driver.told) <= {action, Hover()}, "nothing else, and nothing that no one decided"
    bench.run(1.1)
    assert set(pilot.refusals()) == {Refusal.VEHICLE_LINK_LOST}
    bench.driver.link(LinkState.UP)
    bench.driver.told.clear()
    pilot.command(action, repeat=True)
    assert bench.driver.told == [Hover()], "requests from in between are not executed later"


@pytest.mark.parametrize("state", [FlightState.LANDING, FlightState.LANDED])
def test_a_landing_is_sent_to_a_silent_vehicle_whatever_it_showed_before(bench: Bench, state: FlightState) -> None:
    """It was held back as "already landing", although a hover that it may have received had aborted that."""
    pilot = bench.airborne()
    bench.driver.answers = False
    bench.driver.report(state=state)
    bench.driver.link(LinkState.LOST, "a dead downlink")
    bench.tick()
    pilot.command(Hover())
    bench.driver.told.clear()
    pilot.command(Land(), automatic=True)
    assert bench.driver.told == []
    pilot.command(Land())
    assert bench.driver.told == [Land()]


def test_a_landing_completes_only_by_newer_feedback(bench: Bench) -> None:
    """A vehicle last seen standing was reported as landed as soon as the landing was sent."""
    pilot = bench.pilot()
    bench.driver.answers = False
    bench.driver.link(LinkState.LOST, "a dead downlink")
    bench.run(0.5, lambda: pilot.command(Idle()))
    pilot.command(Land())
    assert bench.driver.told == [Land()]
    bench.run(0.5, lambda: pilot.command(Land(), repeat=True))
    outcome = pilot.last_feedback().outcome
    assert outcome is not None
    assert outcome.fate is Fate.UNDER_WAY
    bench.driver.link(LinkState.UP)
    bench.driver.report(state=FlightState.LANDED)
    bench.tick()
    outcome = pilot.last_feedback().outcome
    assert outcome is not None
    assert outcome.fate is Fate.COMPLETED


def test_a_landing_that_is_not_executed_does_not_suppress_the_failsafes_hover(bench: Bench) -> None:
    """``land()`` waits and repeats automatically: that is refused, and the failed hover was not retried."""
    pilot = bench.airborne()
    bench.driver.answers = False
    bench.driver.report(state=FlightState.FLYING)
    bench.driver.fail = {"apply"}
    bench.driver.link(LinkState.LOST, "a dead downlink")
    bench.tick()
    pilot.command(Land(), automatic=True)
    bench.driver.fail = set()
    bench.run(1.0, lambda: pilot.command(Land(), repeat=True, automatic=True))
    assert set(bench.driver.told) == {Hover()}


def test_a_software_hover_is_refused_while_the_vehicle_is_silent() -> None:
    with Bench({"velocity"}) as bench:
        bench.driver.report(altitude_m=2.0, state=FlightState.FLYING)
        pilot = bench.pilot()
        bench.driver.link(LinkState.LOST)
        pilot.command(Land())
        assert pilot.refusals() == [Refusal.VEHICLE_LINK_LOST], "its motion is unknown"


def test_a_lost_vehicle_link_refuses_commands_until_fresh_ones_come(bench: Bench) -> None:
    pilot = bench.airborne()
    pilot.command(Velocity(0.5))
    bench.driver.link(LinkState.LOST, "no navdata")
    (event,) = [event for event in pilot.told(EventKind.VEHICLE_LINK) if event.data["state"] == "lost"]
    assert event.data["reason"] == "no navdata"
    pilot.command(Velocity(0.6))
    assert pilot.refusals() == [Refusal.VEHICLE_LINK_LOST]
    bench.tick()
    assert bench.driver.told == [Velocity(0.5), Hover()]  # the driver does not continue it when the link is back
    feedback = pilot.last_feedback()
    assert (feedback.vehicle_link, feedback.failsafe) == ("lost", "hover")
    bench.driver.link(LinkState.UP)
    pilot.command(Velocity(0.6), repeat=True)
    assert pilot.refusals() == [Refusal.VEHICLE_LINK_LOST], "it is over: its repeats get the same answer"
    pilot.command(Velocity(0.7))
    assert bench.driver.told == [Velocity(0.5), Hover(), Hover(), Velocity(0.7)]  # the first may have been lost
    bench.tick()
    assert pilot.last_feedback().failsafe == "none"


def test_a_link_lost_and_back_between_two_ticks_also_ends_intents(bench: Bench) -> None:
    pilot = bench.airborne()
    pilot.command(Velocity(0.5))
    bench.driver.link(LinkState.LOST)
    bench.driver.link(LinkState.UP)
    pilot.command(Velocity(0.5), repeat=True)
    assert pilot.refusals() == [Refusal.NOT_FRESH]
    assert bench.driver.told == [Velocity(0.5), Hover()]


def test_a_degraded_link_can_be_flown_with(bench: Bench) -> None:
    pilot = bench.airborne()
    bench.driver.link(LinkState.DEGRADED, "few samples")
    pilot.command(Velocity(0.5))
    assert bench.driver.told == [Velocity(0.5)]


def test_ten_thousand_random_packets_leave_the_flight_undisturbed(bench: Bench) -> None:
    pilot = bench.airborne()
    dice = random.Random(7)
    good = encode(Command(10**9, 1, 10**9, bench.clock(), Velocity(9.0)))
    fuzzers = [bench.join(f"fuzzer {number}") for number in range(10)]

    def step() -> None:
        for fuzzer in fuzzers:  # one each in 20 ms: just below the rate that ends a connection
            assert fuzzer.end.send(_random_packet(dice, good))
        pilot.command(Velocity(0.5))

    bench.run(20.0, step)
    assert bench.driver.told == [Velocity(0.5)] * 1000
    statistics = pilot.ask(GetStatistics())
    assert isinstance(statistics, Statistics)
    assert statistics.counters["packets.malformed"] == 10_000
    told = pilot.told(EventKind.PACKET_MALFORMED)
    assert len(told) <= 10 * 21
    assert {event.app for event in told} == {fuzzer.name for fuzzer in fuzzers}
    assert steps_taken(pilot) == 0


def steps_taken(app: App) -> int:
    return len(app.told(EventKind.FAILSAFE))


def _random_packet(dice: random.Random, good: bytes) -> bytes:
    kind = dice.randrange(4)
    if kind == 0:
        return dice.randbytes(dice.randrange(1, 200))
    if kind == 1:
        return good[: dice.randrange(1, len(good))]
    if kind == 2:
        return good + dice.randbytes(dice.choice((1, 1000, 59_000)))
    return good[:12] + dice.randbytes(len(good) - 12)


def test_too_many_malformed_packets_restart_the_channel(bench: Bench) -> None:
    observer, bad = bench.join("observer"), bench.join("bad")
    for _ in range(50):
        bad.end.send(b"nonsense")
    bad.sync()
    bad.end.send(b"nonsense")
    assert "malformed" in bad.closed_by.get(timeout=WAIT_S)
    (first,) = observer.told(EventKind.PACKET_MALFORMED)
    assert first.app == "bad"
    bench.run(1.0)
    assert observer.told(EventKind.PACKET_MALFORMED)[-1].data["count"] == 50


def test_malformed_packets_at_a_slower_pace_do_not(bench: Bench) -> None:
    bad = bench.join("bad")

    def send() -> None:
        bad.end.send(b"nonsense")
        bad.sync()

    bench.run(4.0, send)
    assert bad.closed_by.empty()


@pytest.mark.parametrize(
    "sample",
    [Feedback(captured_ns=1), Event(EventKind.EMERGENCY, "ha", 1), Annotation("me", "front", 1, 4, 3)],
    ids=["feedback", "event", "annotation before Hello"],
)
def test_samples_that_applications_may_not_send_are_malformed(
    bench: Bench, sample: Feedback | Event | Annotation
) -> None:
    witness, stranger = bench.join("witness"), bench.stranger()
    stranger.end.send(encode(sample))
    stranger.ask(RequestAuthority())
    assert len(witness.told(EventKind.PACKET_MALFORMED)) == 1


def test_statistics_count_the_commands(bench: Bench) -> None:
    pilot = bench.airborne()
    for age_ms in (1, 2, 3):
        pilot.command(Velocity(0.1), sent_ns=bench.clock() - age_ms * 1_000_000)
    pilot.command(Velocity(math.nan))
    statistics = pilot.ask(GetStatistics())
    assert isinstance(statistics, Statistics)
    counters = statistics.counters
    assert counters["commands.received"] == 5
    assert counters["commands.applied"] == 4
    assert counters["commands.refused"] == counters["commands.refused.non_finite"] == 1
    assert counters["commands.delay.max_s"] == 0.003
    assert counters["commands.delay.median_s"] == 0.002
    assert counters["applications"] == 1


def test_echoes_are_made_only_for_subscribers(bench: Bench) -> None:
    pilot: App = bench.airborne()
    pilot.end.subscribe("commands", False)
    pilot.command(Velocity(0.1))
    assert all(echo.asked != Velocity(0.1) for echo in pilot.applied)


@pytest.mark.parametrize("action", [Hover(), Velocity(), Velocity(up=1.0), Attitude()])
def test_above_limits_altitude_the_vehicle_descends_while_it_is_steered(bench: Bench, action: AnyAction) -> None:
    pilot = bench.airborne()
    bench.driver.report(altitude_m=7.4)
    for at in range(5):
        pilot.command(action, repeat=at > 0)
    applied = bench.driver.told[-1]
    assert isinstance(applied, Velocity | Attitude)
    assert (applied.up if isinstance(applied, Velocity) else applied.climb) == -1.0
    (told,) = pilot.told(EventKind.COMMAND_CLAMPED)
    assert told.data["limit"] == "limits.altitude"
    bench.driver.report(altitude_m=5.0)
    pilot.command(Hover())
    assert bench.driver.told[-1] == Hover()


def test_a_vehicle_refuses_a_software_action() -> None:
    with Bench(actions={"attitude"}) as bench:
        pilot = bench.pilot()
        bench.driver.report(altitude_m=0.0)
        bench.driver.answers = False  # it keeps standing
        bench.driver.refuses = "it can't be armed: THROTTLE"
        pilot.command(Takeoff())
        assert pilot.refusals() == [Refusal.WRONG_STATE]  # waiting would not help
        assert "it can't be armed: THROTTLE" in pilot.told(EventKind.COMMAND_REFUSED)[-1].text
        bench.driver.refuses = ""
        pilot.command(Takeoff())
        bench.run(0.1)
        assert isinstance(bench.driver.told[-1], Attitude)
        bench.driver.refuses = "it refused to arm"  # from now on, while it is still standing
        bench.run(0.1)
        bench.driver.refuses = ""
        bench.driver.told.clear()
        bench.run(0.2)
        assert bench.driver.told == [], "the take-off is over"
