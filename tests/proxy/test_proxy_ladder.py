"""The failsafe ladder in the whole proxy: exact times, reports, and who may end it."""

from __future__ import annotations

import pytest

from skyloop.errors import DriverError
from skyloop.messages import (
    AnyAction,
    Attitude,
    Event,
    EventKind,
    Failsafe,
    Fate,
    Feedback,
    FlightState,
    Hover,
    Idle,
    Land,
    LinkState,
    Refusal,
    ReleaseAuthority,
    RequestAuthority,
    SetParameter,
    Takeoff,
    Velocity,
)
from skyloop.proxy.core.flight import BELIEF_NS, Whose
from skyloop.transport.testing import wait_until
from tests.support.proxy_bench import ALL, App, Bench, messages, steps


def test_a_silent_pilot(bench: Bench) -> None:
    pilot, witness = bench.airborne(), bench.join("witness")
    pilot.command(Velocity(0.5))
    bench.run(0.48)
    assert bench.driver.told == [Velocity(0.5)]
    bench.run(0.02)
    assert bench.driver.told == [Velocity(0.5), Hover()]
    assert steps(witness) == [("hover", "silent")]
    assert witness.last_feedback().failsafe is Failsafe.HOVER
    assert witness.applied[-1].app_id == 0
    bench.run(4.48)
    assert bench.driver.told == [Velocity(0.5), Hover()]
    bench.run(0.02)
    assert bench.driver.told == [Velocity(0.5), Hover(), Land()]
    assert steps(witness)[-1] == ("land", "silent")
    bench.driver.report(state=FlightState.LANDED)
    bench.run(0.02)
    assert steps(witness)[-1] == ("none", "landed")
    assert witness.last_feedback().failsafe is Failsafe.NONE


@pytest.mark.parametrize("leaves", ["killed", "releases"])
def test_a_landing_that_does_not_show_yet_continues_without_its_pilot(bench: Bench, leaves: str) -> None:
    """``land()`` as the last line of a program: the vehicle hovered first, and landed 5 s later."""
    pilot, witness = bench.airborne(), bench.join("witness")
    bench.driver.answers = False
    pilot.command(Land())
    if leaves == "killed":
        pilot.end.close()
        wait_until(lambda: bench.proxy.handler.authority.holder is None, "its end is noticed")
    else:
        pilot.ask(ReleaseAuthority())
    bench.run(4.0)
    witness.sync()
    assert set(bench.driver.told) == {Land()}
    bench.driver.report(state=FlightState.LANDED)
    bench.run(0.1)
    bench.driver.told.clear()
    bench.driver.report(state=FlightState.LANDED)
    bench.run(6.0)
    assert bench.driver.told == [], "it is over"


def test_the_ladder_keeps_repeating_its_landing_while_the_vehicle_is_silent(bench: Bench) -> None:
    """A driver keeps a landing for 3 s. After it had shown before the loss of the link, it was not repeated."""
    bench.airborne()
    bench.run(5.1)
    assert bench.driver.told[-1] == Land()
    bench.driver.answers = False
    bench.driver.report(state=FlightState.LANDING)
    bench.driver.told.clear()
    bench.run(1.0)
    assert bench.driver.told == [], "it shows"
    bench.driver.link(LinkState.LOST)
    bench.run(4.0)
    assert bench.driver.told == [Land()] * len(bench.driver.told)
    assert len(bench.driver.told) > 10
    bench.driver.link(LinkState.UP)
    bench.driver.told.clear()
    bench.driver.report(state=FlightState.LANDING)
    bench.run(1.0)
    assert bench.driver.told == []


@pytest.mark.parametrize("noticed", [True, False])
def test_a_pilots_landing_survives_a_broken_link(bench: Bench, noticed: bool) -> None:
    """It ended with the link, the vehicle got a hover when that was back, and the pilot waited forever."""
    pilot, witness = bench.airborne(), bench.join("witness")
    bench.driver.answers = False
    pilot.command(Land())
    bench.driver.link(LinkState.LOST, "a dead downlink")
    if noticed:
        bench.run(4.0, lambda: pilot.command(Idle(), repeat=True))
        assert len(bench.driver.told) > 10, "a driver keeps it for only 3 s"
    bench.driver.link(LinkState.UP)
    bench.driver.report(state=FlightState.HOVERING)
    bench.run(0.6, lambda: pilot.command(Idle(), repeat=True))
    assert set(bench.driver.told) == {Land()}
    bench.driver.told.clear()
    bench.run(0.6, lambda: pilot.command(Idle(), repeat=True))
    assert len(bench.driver.told) >= 2
    assert set(bench.driver.told) == {Land()}, "it is in the air, and no one wants anything else"
    assert steps(witness) == []
    outcome = pilot.last_feedback().outcome
    assert outcome is not None
    assert outcome.fate is Fate.UNDER_WAY
    bench.driver.report(state=FlightState.LANDED)
    bench.tick()
    outcome = pilot.last_feedback().outcome
    assert outcome is not None
    assert outcome.fate is Fate.COMPLETED
    bench.driver.told.clear()
    bench.driver.report(state=FlightState.HOVERING)
    bench.run(1.0, lambda: pilot.command(Idle(), repeat=True))
    assert bench.driver.told == [], "it is over"


def in_the_dark(bench: Bench, seconds: int, app: App, action: AnyAction) -> None:
    """Let time pass in steps of a second while an application repeats this, with patience for both."""
    for _ in range(seconds):
        bench.clock.advance(1.0)
        bench.tick()
        app.command(action, repeat=True)


def be_patient(app: App) -> None:
    for name in ("failsafe.hover_after_s", "failsafe.land_after_s", "authority.timeout_s"):
        app.ask(SetParameter(name, 3600.0, app.lease))


@pytest.mark.parametrize("state", [FlightState.FLYING, FlightState.LANDING, FlightState.LANDED, FlightState.UNKNOWN])
def test_a_landing_requested_during_silence_is_abandoned_after_a_minute(bench: Bench, state: FlightState) -> None:
    """A vehicle back after ten minutes was landed at once: by then it may be on another flight."""
    pilot = bench.airborne()
    be_patient(pilot)
    bench.driver.answers = False
    bench.driver.report(state=state)
    bench.driver.link(LinkState.LOST, "a dead downlink")
    in_the_dark(bench, 30, pilot, Idle())
    pilot.command(Land())
    in_the_dark(bench, 59, pilot, Land())
    assert messages(pilot, "landing_given_up") == []
    assert bench.driver.told[-1] == Land()
    in_the_dark(bench, 1, pilot, Land())
    (text,) = messages(pilot, "landing_given_up")
    assert "silent for 60 s" in text
    outcome = pilot.last_feedback().outcome
    assert outcome is not None
    assert (outcome.fate, outcome.reason) == (Fate.TIMED_OUT, Refusal.VEHICLE_LINK_LOST)
    bench.driver.told.clear()
    in_the_dark(bench, 5, pilot, Land())
    bench.driver.link(LinkState.UP)
    bench.driver.report(state=FlightState.FLYING)
    bench.run(0.5, lambda: pilot.command(Land(), repeat=True))
    assert Land() not in bench.driver.told
    assert len(messages(pilot, "landing_given_up")) == 1
    pilot.command(Land())
    assert bench.driver.told[-1] == Land(), "requested again, it lands"


@pytest.mark.parametrize("ends", ["stays", "leaves", "hovers"])
def test_an_abandoned_landing_is_not_aborted(bench: Bench, ends: str) -> None:
    """A hover followed: a vehicle landing from high up that received but was not received hung in the air."""
    pilot = bench.airborne()
    be_patient(pilot)
    bench.driver.answers = False
    bench.driver.report(state=FlightState.FLYING)
    bench.driver.link(LinkState.LOST, "a dead downlink")
    in_the_dark(bench, 2, pilot, Idle())
    pilot.command(Land())
    in_the_dark(bench, 60, pilot, Land())
    assert len(messages(pilot, "landing_given_up")) == 1
    bench.driver.told.clear()
    in_the_dark(bench, 5, pilot, Land())
    assert bench.driver.told == []
    if ends == "leaves":
        for name in ("failsafe.hover_after_s", "failsafe.land_after_s"):
            pilot.ask(SetParameter(name, 5.0, pilot.lease))
        pilot.ask(ReleaseAuthority())
        for _ in range(8):
            bench.clock.advance(1.0)
            bench.tick()
        assert set(bench.driver.told) == {Land()}, "without a pilot it is landed"
    elif ends == "hovers":
        pilot.command(Hover())
        in_the_dark(bench, 1, pilot, Hover())
        assert set(bench.driver.told) == {Hover()}


@pytest.mark.parametrize("asked", ["velocity", "hover"])
def test_a_hover_that_nothing_shows_is_abandoned_after_a_minute_and_later_flights_are_left_alone(
    bench: Bench, asked: str
) -> None:
    """On a link without answers, with a pilot who stayed, hovers went to whatever flew there, forever."""
    pilot = bench.airborne()
    be_patient(pilot)
    bench.driver.answers = False
    pilot.command(Velocity(0.5))
    bench.driver.report(state=FlightState.FLYING)
    bench.driver.link(LinkState.LOST, "a dead downlink")
    bench.tick()
    action: AnyAction = Velocity(0.5) if asked == "velocity" else Hover()
    pilot.command(action)
    in_the_dark(bench, 58, pilot, action)
    assert bench.driver.told.count(Hover()) > 50
    assert messages(pilot, "hover_given_up") == []
    in_the_dark(bench, 3, pilot, action)
    (text,) = messages(pilot, "hover_given_up")
    assert "the hover was abandoned" in text
    bench.driver.told.clear()
    in_the_dark(bench, 5, pilot, action)
    assert bench.driver.told == []
    bench.driver.link(LinkState.UP)
    bench.driver.report(state=FlightState.FLYING)
    bench.run(1.0, lambda: pilot.command(action, repeat=True))
    assert bench.driver.told == []
    assert bench.proxy.handler.flight.whose is Whose.OTHERS
    pilot.command(Hover())
    assert bench.driver.told == [Hover()], "requested again, it is accepted"


def test_a_hover_requested_again_during_silence_is_its_pilots_for_another_minute(bench: Bench) -> None:
    pilot = bench.airborne()
    be_patient(pilot)
    bench.driver.answers = False
    bench.driver.report(state=FlightState.FLYING)
    bench.driver.link(LinkState.LOST, "a dead downlink")
    in_the_dark(bench, 70, pilot, Idle())
    bench.driver.told.clear()
    pilot.command(Hover())
    in_the_dark(bench, 58, pilot, Idle())
    assert bench.driver.told.count(Hover()) > 50
    bench.driver.link(LinkState.UP)
    bench.driver.report(state=FlightState.FLYING)
    bench.tick()
    assert bench.proxy.handler.flight.ours
    assert bench.driver.told[-1] == Hover()


def test_an_abandoned_hover_ends_in_a_landing_when_its_pilot_leaves(bench: Bench) -> None:
    """It may receive, although it is not received."""
    pilot = bench.airborne()
    be_patient(pilot)
    bench.driver.answers = False
    bench.driver.report(state=FlightState.FLYING)
    bench.driver.link(LinkState.LOST, "a dead downlink")
    in_the_dark(bench, 65, pilot, Idle())
    bench.driver.told.clear()
    for name in ("failsafe.hover_after_s", "failsafe.land_after_s"):
        pilot.ask(SetParameter(name, 5.0, pilot.lease))
    pilot.ask(ReleaseAuthority())
    for _ in range(8):
        bench.clock.advance(1.0)
        bench.tick()
    assert set(bench.driver.told) == {Land()}


def _given_up(bench: Bench) -> App:
    """Return a pilot whose vehicle was silent for 65 s, so that its hover was abandoned."""
    pilot = bench.airborne()
    be_patient(pilot)
    bench.driver.answers = False
    bench.driver.report(state=FlightState.FLYING)
    bench.driver.link(LinkState.LOST, "a dead downlink")
    in_the_dark(bench, 65, pilot, Idle())
    assert messages(pilot, "hover_given_up")
    return pilot


def test_a_landing_requested_after_an_abandoned_hover_continues_when_the_link_is_back(bench: Bench) -> None:
    pilot = _given_up(bench)
    bench.driver.refuses = "busy"
    pilot.command(Land())
    in_the_dark(bench, 2, pilot, Land())
    bench.driver.refuses = ""
    bench.driver.told.clear()
    bench.driver.link(LinkState.UP)
    bench.driver.report(state=FlightState.FLYING)
    bench.run(2.0, lambda: pilot.command(Land(), repeat=True))
    assert set(bench.driver.told) == {Land()}


def test_the_ladders_landing_after_an_abandoned_hover_continues_when_the_link_is_back(bench: Bench) -> None:
    pilot = _given_up(bench)
    for name in ("failsafe.hover_after_s", "failsafe.land_after_s"):
        pilot.ask(SetParameter(name, 5.0, pilot.lease))
    pilot.ask(ReleaseAuthority())
    for _ in range(8):
        bench.clock.advance(1.0)
        bench.tick()
    bench.driver.told.clear()
    bench.driver.link(LinkState.UP)
    bench.driver.report(state=FlightState.FLYING)
    bench.run(12.0)
    assert Land() in bench.driver.told
    assert bench.proxy.handler.flight.ours


def test_a_link_that_returns_during_the_ladders_check_leaves_the_flight_to_others(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    pilot = _given_up(bench)
    bench.driver.told.clear()
    inner = bench.driver.left_to
    back: list[bool] = []

    def left_to() -> str | None:
        if not back:
            back.append(True)
            bench.driver.link(LinkState.UP)
            bench.driver.report(state=FlightState.FLYING)
        return inner()

    monkeypatch.setattr(bench.driver, "left_to", left_to)
    bench.run(2.0, lambda: pilot.command(Idle(), repeat=True))
    assert bench.driver.told == []
    assert bench.proxy.handler.flight.whose is Whose.OTHERS


@pytest.mark.parametrize("stays", [True, False])
def test_a_flight_found_after_an_abandoned_landing_is_left_alone(bench: Bench, stays: bool) -> None:
    """Once, a hover was sent to whichever vehicle had been found by then."""
    pilot = bench.airborne()
    be_patient(pilot)
    bench.driver.answers = False
    bench.driver.report(state=FlightState.FLYING)
    bench.driver.link(LinkState.LOST, "a dead downlink")
    in_the_dark(bench, 2, pilot, Idle())
    pilot.command(Land())
    if not stays:
        pilot.ask(ReleaseAuthority())
    in_the_dark(bench, 60, pilot, Idle())
    bench.driver.told.clear()
    in_the_dark(bench, 5, pilot, Idle())
    bench.driver.link(LinkState.UP)
    bench.driver.report(state=FlightState.FLYING)
    bench.run(10.0, lambda: pilot.command(Idle(), repeat=True))
    assert bench.driver.told == []
    assert bench.proxy.handler.flight.whose is Whose.OTHERS


@pytest.mark.parametrize("pilot_stays", [True, False])
def test_a_landing_in_progress_survives_a_broken_link_for_a_minute(bench: Bench, pilot_stays: bool) -> None:
    pilot = bench.airborne()
    be_patient(pilot)
    bench.driver.answers = False
    pilot.command(Land())
    in_the_dark(bench, 10, pilot, Idle())
    bench.driver.link(LinkState.LOST, "a dead downlink")
    if not pilot_stays:
        pilot.ask(ReleaseAuthority())
    bench.driver.told.clear()
    in_the_dark(bench, 59, pilot, Idle())
    assert bench.driver.told == [Land()] * 59, "a driver keeps it for only 3 s"
    assert bench.published(EventKind.VEHICLE_MESSAGE) == []
    in_the_dark(bench, 1, pilot, Idle())
    bench.driver.told.clear()
    in_the_dark(bench, 5, pilot, Idle())
    bench.driver.link(LinkState.UP)
    bench.driver.report(state=FlightState.FLYING)
    bench.run(0.5)
    assert Land() not in bench.driver.told
    told = [event.data["reason"] for event in bench.published(EventKind.VEHICLE_MESSAGE)]
    assert told == ["landing_given_up", "others"]


@pytest.mark.parametrize("native", [ALL, ALL - {"land"}], ids=["native", "software"])
@pytest.mark.parametrize("found", ["flying", "landed"])
def test_the_failsafes_own_landing_is_abandoned_after_a_minute_of_silence(native: frozenset[str], found: str) -> None:
    """It repeated forever: another vehicle found minutes later was landed."""
    with Bench(native) as bench:
        pilot, witness = bench.airborne(), bench.join("witness")
        bench.driver.answers = False
        bench.driver.report(state=FlightState.FLYING)
        bench.driver.link(LinkState.LOST, "a dead downlink")
        pilot.end.close()
        wait_until(lambda: bench.proxy.handler.authority.holder is None, "its end is noticed")

        def told() -> list[str]:
            return [str(event.data["reason"]) for event in witness.told(EventKind.VEHICLE_MESSAGE)]

        def pass_time(seconds: int) -> None:
            for _ in range(seconds):
                bench.clock.advance(1.0)
                bench.tick()

        pass_time(64)
        assert "landing_given_up" not in told()
        sinks = Land() if "land" in native else bench.driver.told[-1]
        assert bench.driver.told[-1] == sinks
        assert steps(witness)[-1][0] == "land"
        pass_time(2)
        assert told().count("landing_given_up") == 1
        bench.driver.told.clear()
        pass_time(5)
        bench.driver.link(LinkState.UP)
        bench.driver.report(state=FlightState.FLYING if found == "flying" else FlightState.LANDED)
        bench.run(10.0, lambda: bench.driver.report())
        assert bench.driver.told == [], "no one here knows whose it is by now"
        assert told().count("landing_given_up") == 1
        assert steps(witness)[-1][0] == "none"
        if found == "flying":
            assert bench.proxy.handler.flight.whose is Whose.OTHERS


def test_a_software_flown_vehicle_is_abandoned_as_well() -> None:
    with Bench({"velocity"}) as software:
        software.driver.report(altitude_m=2.0, state=FlightState.FLYING)
        pilot = software.pilot()
        be_patient(pilot)
        pilot.command(Hover())
        software.driver.link(LinkState.LOST)
        software.tick()
        pilot.command(Land())
        in_the_dark(software, 60, pilot, Land())
        assert len(messages(pilot, "landing_given_up")) == 1
        software.driver.link(LinkState.UP)
        software.driver.report(altitude_m=2.0, state=FlightState.FLYING)
        software.driver.told.clear()
        software.run(0.5, lambda: pilot.command(Land(), repeat=True))
        assert all(action.up >= 0.0 for action in software.driver.told if isinstance(action, Velocity))


@pytest.mark.parametrize("leaves", ["falls silent", "is killed", "releases"])
def test_no_hover_aborts_a_landing_requested_by_its_pilot(bench: Bench, leaves: str) -> None:
    """Neither the ladder's, nor that between two pilots."""
    pilot = bench.airborne()
    pilot.command(Land())
    assert bench.driver.now.state is FlightState.LANDING
    if leaves == "is killed":
        pilot.end.close()
        wait_until(lambda: bench.proxy.handler.authority.holder is None, "its end is noticed")
    elif leaves == "releases":
        pilot.ask(ReleaseAuthority())
    bench.run(3.0)
    bench.pilot("other")
    bench.run(0.2)
    assert Hover() not in bench.driver.told


def landing_in_the_dark(bench: Bench) -> App:
    """Return a pilot who requested a landing before the link broke; by now it is back, and the vehicle hovers."""
    pilot = bench.airborne()
    bench.driver.answers = False
    pilot.command(Land())
    bench.driver.link(LinkState.LOST, "a dead downlink")
    bench.run(0.5, lambda: pilot.command(Idle(), repeat=True))
    bench.driver.link(LinkState.UP)
    bench.driver.report(state=FlightState.HOVERING)
    return pilot


@pytest.mark.parametrize("action", [Hover(), Takeoff(), Velocity(0.5)], ids=lambda action: action.name)
def test_a_newer_command_ends_such_a_landing(bench: Bench, action: AnyAction) -> None:
    pilot = landing_in_the_dark(bench)
    pilot.command(action)
    bench.driver.told.clear()
    bench.run(0.4, lambda: pilot.command(action, repeat=True))
    assert Land() not in bench.driver.told


def test_even_a_refused_newer_command_ends_such_a_landing(bench: Bench) -> None:
    pilot = bench.airborne()
    bench.driver.answers = False
    pilot.command(Land())
    bench.driver.link(LinkState.LOST, "a dead downlink")
    bench.tick()
    pilot.command(Velocity(0.5))
    bench.tick()
    assert bench.driver.told[-1] == Hover()
    bench.driver.link(LinkState.UP)
    bench.driver.told.clear()
    bench.run(0.4, lambda: pilot.command(Idle(), repeat=True))
    assert set(bench.driver.told) == {Hover()}


def test_automatic_commands_do_not_end_such_a_landing(bench: Bench) -> None:
    pilot = landing_in_the_dark(bench)
    pilot.command(Hover(), automatic=True)
    bench.run(0.4, lambda: pilot.command(Hover(), automatic=True, repeat=True))
    assert set(bench.driver.told) == {Land()}


def test_a_controller_that_has_taken_the_vehicle_is_left_alone(bench: Bench) -> None:
    """Even if the pilot's own repeats continue, which are not a new decision."""
    pilot = bench.airborne()
    bench.driver.answers = False
    pilot.command(Land())
    bench.driver.link(LinkState.LOST, "a dead downlink")
    bench.run(0.5, lambda: pilot.command(Land(), repeat=True))
    bench.driver.told.clear()
    bench.driver.left = "LOITER"
    bench.driver.link(LinkState.UP)
    bench.driver.report(state=FlightState.FLYING)
    bench.run(0.5, lambda: pilot.command(Land(), repeat=True))
    assert bench.driver.told == []


def test_a_landing_requested_during_silence_is_executed_once_the_vehicle_is_back() -> None:
    """A vehicle that only the software can fly is refused while its motion is unknown."""
    with Bench({"velocity"}) as software:
        software.driver.report(altitude_m=2.0, state=FlightState.FLYING)
        pilot = software.pilot()
        pilot.command(Hover())
        software.driver.link(LinkState.LOST)
        software.tick()
        pilot.command(Land())
        assert pilot.refusals() == [Refusal.VEHICLE_LINK_LOST]
        software.driver.link(LinkState.UP)
        software.driver.report(altitude_m=2.0, state=FlightState.FLYING)
        software.driver.told.clear()
        software.run(0.1)
        assert software.driver.told[-1] == Velocity(up=-0.4)


def test_a_position_jump_ends_no_landing_that_continues_without_its_pilot(bench: Bench) -> None:
    pilot, witness = bench.airborne(), bench.join("witness")
    bench.driver.answers = False
    bench.driver.report(position_m=(0.0, 0.0, 1.0))
    bench.tick()
    pilot.command(Land())
    pilot.ask(ReleaseAuthority())
    bench.clock.advance(0.02)
    bench.driver.report(position_m=(20.0, 0.0, 1.0))
    bench.tick()
    (text,) = messages(witness, "position_jumped")
    assert text.endswith("it keeps landing")
    bench.run(1.0)
    assert set(bench.driver.told) == {Land()}


def test_the_next_pilot_adopts_such_a_landing(bench: Bench) -> None:
    pilot = bench.airborne()
    bench.driver.answers = False
    pilot.command(Land())
    pilot.ask(ReleaseAuthority())
    bench.run(0.1)
    other = bench.pilot("other")
    other.command(Hover())
    bench.driver.told.clear()
    bench.run(0.4)
    assert Land() not in bench.driver.told


def test_an_automatic_set_point_does_not_abort_the_ladders_landing(bench: Bench) -> None:
    pilot = bench.airborne()
    bench.run(5.1)
    assert bench.driver.told[-1] == Land()
    bench.driver.told.clear()
    pilot.take_authority()
    pilot.command(Velocity(0.5), automatic=True)
    bench.run(0.2)
    assert bench.driver.told == []
    pilot.command(Velocity(0.5))
    assert bench.driver.told == [Hover()], "a returning pilot does"


def test_a_killed_pilot(bench: Bench) -> None:
    pilot, witness = bench.airborne(), bench.join("witness")
    pilot.command(Velocity(0.5))
    pilot.end.close()
    witness.sync()
    bench.run(0.02)
    assert bench.driver.told == [Velocity(0.5), Hover()]
    assert steps(witness) == [("hover", "gone")]
    bench.run(4.96)
    assert bench.driver.told[2:] == []
    bench.run(0.02)
    assert bench.driver.told[2:] == [Land()]


@pytest.mark.parametrize("leaves", ["is killed", "falls silent", "releases"])
def test_the_vehicle_hovers_before_anything_is_published(
    bench: Bench, leaves: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Three events were sent first, to every application, and each takes time."""
    pilot, witness = bench.airborne(), bench.join("witness")
    pilot.command(Velocity(0.5))
    told_first: list[list[Event]] = []
    apply, before = bench.driver._apply, len(bench.events)

    def applied(action: AnyAction) -> AnyAction:
        told_first.append(bench.events[before:])
        return apply(action)

    monkeypatch.setattr(bench.driver, "_apply", applied)
    if leaves == "is killed":
        pilot.end.close()
        wait_until(lambda: bench.proxy.handler.authority.holder is None, "its end is noticed")
    elif leaves == "releases":
        pilot.ask(ReleaseAuthority())
        before = len(bench.events)
    bench.run(0.5)
    witness.sync()
    assert bench.driver.told == [Velocity(0.5), Hover()]
    assert told_first == [[]]
    kinds = [event.kind for event in witness.events if event.kind is not EventKind.AUTHORITY_GRANTED]
    if leaves == "is killed":
        assert kinds[-3:] == [EventKind.APPLICATION_LINK, EventKind.AUTHORITY_LOST, EventKind.FAILSAFE]
    assert kinds[-1] is EventKind.FAILSAFE


def test_a_pilot_that_released(bench: Bench) -> None:
    pilot = bench.airborne()
    pilot.command(Velocity(0.5))
    pilot.ask(ReleaseAuthority())
    bench.run(0.48)
    assert bench.driver.told == [Velocity(0.5)]
    bench.run(0.02)
    assert bench.driver.told == [Velocity(0.5), Hover()]
    assert steps(pilot) == [("hover", "released")]


def test_a_returning_pilot_ends_the_step_only_with_a_fresh_command(bench: Bench) -> None:
    pilot = bench.airborne()
    pilot.command(Velocity(0.5))
    bench.run(0.6)
    pilot.command(Velocity(0.5), repeat=True)
    pilot.command(Idle())
    assert pilot.refusals() == [Refusal.NOT_FRESH]
    assert steps(pilot) == [("hover", "silent")]
    pilot.command(Velocity(0.2))
    assert steps(pilot) == [("hover", "silent"), ("none", "fresh command")]
    assert bench.driver.told == [Velocity(0.5), Hover(), Velocity(0.2)]


def test_a_returning_pilot_aborts_the_ladders_landing(bench: Bench) -> None:
    pilot = bench.airborne()
    pilot.command(Velocity(0.5))
    bench.run(5.0)
    assert bench.driver.told == [Velocity(0.5), Hover(), Land()]
    pilot.take_authority()
    bench.run(0.4, lambda: pilot.command(Idle(), repeat=True))
    assert bench.driver.told[3:] == []  # presence is not enough
    pilot.command(Velocity(0.2))
    pilot.command(Velocity(0.2), repeat=True)
    assert bench.driver.told[3:] == [Hover(), Velocity(0.2)]
    assert steps(pilot)[-1] == ("none", "fresh command")


def test_a_low_battery(bench: Bench) -> None:
    pilot = bench.airborne()
    bench.driver.report(battery=0.19)
    bench.run(0.1, lambda: pilot.command(Velocity(0.1)))
    assert len(pilot.told(EventKind.BATTERY_LOW)) == 1
    assert Land() not in bench.driver.told
    bench.driver.report(battery=0.09)
    bench.run(0.02)
    assert bench.driver.told[-1] == Land()
    assert steps(pilot) == [("land", "battery")]
    pilot.command(Velocity(0.1))
    pilot.command(Takeoff())
    assert pilot.refusals() == [Refusal.WRONG_STATE]
    assert bench.driver.told[-1] == Land()
    bench.driver.report(state=FlightState.LANDED)
    bench.run(0.02)
    pilot.command(Takeoff())
    assert bench.driver.told[-1] == Land()
    assert "battery" in pilot.told(EventKind.COMMAND_REFUSED)[-1].text


def test_a_failing_driver_is_retried_at_a_bounded_pace(bench: Bench) -> None:
    pilot = bench.airborne()
    bench.driver.fail = {"apply"}
    bench.run(3.5)
    errors = pilot.told(EventKind.DRIVER_ERROR)
    assert 3 <= len(errors) <= 4  # one at once, then a sum each second
    tries = sum(count for event in errors if isinstance(count := event.data["count"], int))
    assert 9 <= tries <= 13  # 4 a second, some not reported yet
    bench.driver.fail = set()
    bench.run(0.26)
    assert bench.driver.told == [Hover()]


def test_a_driver_that_fails_to_report_who_flies_delays_no_failsafe(bench: Bench) -> None:
    pilot = bench.airborne()
    pilot.command(Velocity(0.5))
    bench.driver.fail = {"left_to"}
    for _ in range(255):  # 5.1 s
        bench.clock.advance(0.02)
        with pytest.raises(Exception, match="left_to is broken"):  # counted and reported by the ticker
            bench.tick()
    assert bench.driver.told == [Velocity(0.5), Hover(), Land()]


@pytest.mark.parametrize("where", ["command", "link", "others"])
def test_unsendable_texts_of_a_driver_delay_nothing(bench: Bench, where: str) -> None:
    """With the name of a file that is not UTF-8, feedback ended, and a step of the ladder was not reported."""
    pilot = bench.airborne()
    odd = "/dev/tty\udcff"
    if where == "command":
        bench.driver.refuses = odd
        pilot.command(Velocity(0.5))
        bench.driver.refuses = ""
    elif where == "link":
        bench.driver.link(LinkState.DEGRADED, odd)
    else:
        bench.driver.left = odd
        bench.driver.report(state=FlightState.FLYING)
        bench.run(0.1)
    seq = pilot.last_feedback().seq
    bench.driver.report(state=FlightState.FLYING)
    bench.run(0.7)
    assert pilot.last_feedback().seq > seq
    assert (Hover() in bench.driver.told) is (where != "others")


def test_nothing_is_done_on_the_ground(bench: Bench) -> None:
    pilot = bench.pilot()
    bench.run(6.0)
    assert bench.driver.told == []
    assert steps(pilot) == []


def test_an_earlier_runs_flight_waits_for_its_pilot_and_is_ended() -> None:
    bench = Bench()
    bench.driver.now = Feedback(captured_ns=0)
    bench.proxy.handler.flight.began_before(bench.clock() + BELIEF_NS)
    with bench:
        witness = bench.join("witness")
        bench.run(20.0)  # until the vehicle is received
        bench.driver.report(state=FlightState.FLYING)
        bench.run(0.5)
        assert bench.driver.told == []
        bench.run(0.02)
        assert steps(witness) == [("hover", "none")]
        bench.run(4.5)
        assert bench.driver.told == [Hover(), Land()]
        assert "before its restart" in messages(witness, "flight")[0]


def test_a_vehicle_without_a_state_is_watched_from_its_first_command_on(bench: Bench) -> None:
    bench.driver.answers = False
    bench.driver.report(state=FlightState.UNKNOWN)
    pilot = bench.pilot()
    bench.run(0.6)
    assert bench.driver.told == []
    pilot.take_authority()
    pilot.command(Takeoff())
    bench.run(5.0)
    assert bench.driver.told == [Takeoff(), Hover(), Land()]


def test_landing_before_the_end(bench: Bench) -> None:
    pilot = bench.airborne()
    assert bench.proxy.handler.order_landing(bench.clock())
    assert bench.driver.told == [Land()]
    pilot.command(Velocity(0.5))
    assert pilot.refusals() == [Refusal.WRONG_STATE]
    bench.driver.report(state=FlightState.LANDED)
    assert bench.proxy.end(1.0, reason="it is late")
    # Packets published before the end still arrive, on the pilot's own thread.
    wait_until(lambda: any(event.kind is EventKind.PROXY_CLOSING for event in pilot.events), "the pilot hears of it")
    assert "it is late" in next(event.text for event in pilot.events if event.kind is EventKind.PROXY_CLOSING)
    assert bench.driver.told == [Land()]
    assert bench.driver.closed


def test_ending_in_the_air_leaves_it_hovering(bench: Bench) -> None:
    pilot = bench.airborne()
    pilot.command(Velocity(0.5))
    bench.proxy.end()
    assert bench.driver.told == [Velocity(0.5), Hover()]


def test_a_vehicle_that_lacks_hover_gets_it_from_the_autopilot() -> None:
    with Bench(actions={"takeoff", "land", "attitude"}) as bench:
        pilot = bench.airborne()
        pilot.command(Attitude(0.1))
        bench.run(0.6)
        assert steps(pilot) == [("hover", "silent")]
        assert bench.driver.told[0] == Attitude(0.1)
        assert {type(action) for action in bench.driver.told} == {Attitude}
        bench.run(4.5)
        assert bench.driver.told[-1] == Land()
        after = len(bench.driver.told)
        bench.run(0.2)
        assert len(bench.driver.told) == after  # the vehicle lands: the autopilot no longer steers


def test_a_driver_whose_failsafe_raises_against_its_contract_is_retried(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    pilot = bench.airborne()

    def broken(action: Hover | Land) -> bool:
        raise RuntimeError("it may not")

    monkeypatch.setattr(bench.driver, "failsafe", broken)
    bench.run(0.6)
    assert "it may not" in pilot.told(EventKind.DRIVER_ERROR)[0].text
    monkeypatch.undo()
    bench.run(0.3)
    assert bench.driver.told == [Hover()]


@pytest.mark.parametrize("by", ["its pilot", "the failsafe"])
@pytest.mark.parametrize("action", [Hover(), Land()])
def test_software_steering_stops_if_the_vehicle_fails_to_hover_or_land(
    monkeypatch: pytest.MonkeyPatch, action: Hover | Land, by: str
) -> None:
    """The previous velocity continued while the driver failed."""
    with Bench(actions=ALL - {"velocity", "position"}) as bench:
        pilot = bench.airborne()
        level = {"velocity_m_s": (0.0, 0.0, 0.0), "roll_rad": 0.0, "pitch_rad": 0.0, "yaw_rad": 0.0}
        bench.driver.report(state=FlightState.FLYING, **level)
        pilot.command(Velocity(1.0))
        bench.run(0.1, lambda: bench.driver.report())
        assert bench.driver.told[-1].pitch > 0.1  # type: ignore[union-attr]
        apply = bench.driver._apply

        def broken(told: AnyAction) -> AnyAction:
            if isinstance(told, Hover | Land):
                raise DriverError("no answer")
            return apply(told)

        monkeypatch.setattr(bench.driver, "_apply", broken)
        if by == "its pilot":
            pilot.command(action)

            def go_on() -> None:
                bench.driver.report()
                pilot.command(action, repeat=True)

            bench.run(0.3, go_on)
        else:
            bench.run(0.7 if action == Hover() else 5.4, lambda: bench.driver.report())
        assert abs(bench.driver.told[-1].pitch) < 0.05  # type: ignore[union-attr]


def test_pilots_that_hang_one_after_another_keep_it_in_the_air_no_longer_than_one(bench: Bench) -> None:
    """Ten programs wait in the queue and hang: each gets the authority, and sends nothing."""
    bench.airborne()
    for number in range(10):
        bench.join(f"pilot {number}").ask(RequestAuthority(16, queue=True))
    bench.run(4.98)
    assert Land() not in bench.driver.told
    assert bench.proxy.handler.authority.granted > 2
    bench.run(0.04)
    assert bench.driver.told[-1] == Land()


def test_a_landing_is_repeated_until_the_vehicle_shows_it(bench: Bench) -> None:
    """It flew, and has reported nothing since the ladder's landing was sent."""
    bench.airborne()
    bench.tick()
    bench.driver.answers = False
    bench.driver.report(state=FlightState.UNKNOWN)
    bench.run(7.0)
    assert bench.driver.told.count(Land()) >= 7
    bench.driver.report(state=FlightState.LANDING)
    count = len(bench.driver.told)
    bench.run(1.0)
    assert len(bench.driver.told) == count


def test_from_a_grant_until_the_end_of_the_flight_nothing_is_at_rest(bench: Bench) -> None:
    """A proxy at rest may be ticked rarely: neither a pilot on the ground nor a flight is rest."""
    bench.driver.report(state=FlightState.LANDED)
    bench.run(1.1)
    assert bench.proxy.at_rest
    pilot = bench.pilot()
    assert not bench.proxy.at_rest
    bench.take_off(pilot)
    pilot.end.close()
    bench.run(10.0, lambda: pytest.fail("it flies") if bench.proxy.at_rest else None)
    assert bench.driver.told[-1] == Land()
    bench.driver.report(state=FlightState.LANDED)
    bench.run(1.1)
    assert bench.proxy.at_rest


def test_a_broken_link_and_due_feedback_are_not_rest(bench: Bench) -> None:
    bench.driver.report(state=FlightState.LANDED)
    bench.run(1.1)
    bench.driver.link(LinkState.UP)
    bench.run(0.1)
    assert bench.proxy.at_rest
    bench.driver.link(LinkState.LOST)
    assert not bench.proxy.at_rest
    bench.run(0.1)
    assert bench.proxy.at_rest
    bench.proxy.publisher.stamp({})
    assert not bench.proxy.at_rest


def test_a_flight_of_others_is_not_at_rest(bench: Bench) -> None:
    bench.driver.report(state=FlightState.FLYING)
    bench.run(1.1)
    assert bench.proxy.handler.flight.others
    assert not bench.proxy.at_rest


def test_in_a_fork_the_proxy_leaves_its_vehicle_to_the_parent(bench: Bench) -> None:
    pilot = bench.airborne()
    bench.proxy.forked()
    bench.proxy.end()
    assert bench.driver.told == []
    assert not bench.driver.closed
    bench.proxy.ended = False  # the parent's
    assert pilot.told(EventKind.PROXY_CLOSING) == []
