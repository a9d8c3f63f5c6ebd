"""Arming, flying, switching and landing by others is observed, reported and not interfered with; and takeovers."""

from __future__ import annotations

import threading
from pathlib import Path

import pytest

from skyloop.errors import DriverError
from skyloop.messages import (
    AnyAction,
    Attitude,
    EventKind,
    Failsafe,
    Feedback,
    FlightState,
    Hover,
    Land,
    LinkState,
    Refusal,
    ReleaseAuthority,
    Takeoff,
    Velocity,
)
from skyloop.proxy.records import LIFE_S, FlightRecord
from skyloop.transport.testing import wait_until
from tests.support.proxy_bench import Bench, messages, steps


@pytest.mark.parametrize("state", [FlightState.TAKING_OFF, FlightState.HOVERING, FlightState.FLYING])
def test_a_proxy_does_nothing_while_others_fly_the_vehicle(bench: Bench, state: FlightState) -> None:
    bench.driver.report(state=state)
    bench.run(20.0)
    bench.driver.report(battery=0.05)
    bench.run(1.0)
    for link in (LinkState.LOST, LinkState.UP):
        bench.driver.link(link, "")
        bench.run(1.0)
    assert not bench.proxy.handler.order_landing(bench.clock())
    bench.proxy.end()
    assert bench.driver.told == []
    assert bench.published(EventKind.FAILSAFE) == []
    (told,) = [event.text for event in bench.published(EventKind.VEHICLE_MESSAGE)]
    assert "left alone until an application" in told


def test_the_authority_alone_does_not_take_it(bench: Bench) -> None:
    bench.driver.report(state=FlightState.FLYING)
    first = bench.pilot("first")
    bench.run(1.0)
    second = bench.pilot("second", priority=3)
    second.ask(ReleaseAuthority())
    first.end.close()
    bench.run(20.0)
    assert bench.driver.told == []


@pytest.mark.parametrize("action", [Hover(), Land(), Takeoff()])
def test_a_new_command_takes_it_and_is_reported(bench: Bench, action: AnyAction) -> None:
    bench.driver.report(state=FlightState.FLYING)
    pilot = bench.pilot()
    pilot.command(action)
    assert bench.driver.told == [Hover() if isinstance(action, Takeoff) else action]
    (told,) = messages(pilot, "taken")
    assert told.startswith("pilot took the vehicle by ")
    bench.driver.report(state=FlightState.FLYING)
    bench.run(0.5)
    assert bench.driver.told[-1] == Hover(), "from here on, it is this proxy's to look after"


@pytest.mark.parametrize("action", [Hover(), Land()])
def test_automatic_commands_take_nothing_from_others(bench: Bench, action: AnyAction) -> None:
    """A safety pilot switches the mode; then a program ends, fails or lets a key go: its hover is not a decision."""
    pilot = bench.airborne()
    pilot.command(Velocity(0.5))
    bench.driver.told.clear()
    bench.driver.left = "RTL"
    bench.driver.report(state=FlightState.FLYING)
    bench.tick()
    pilot.command(action, automatic=True)
    bench.run(1.0, lambda: pilot.command(action, automatic=True, repeat=True))
    assert bench.driver.told == []
    assert set(pilot.refusals()) == {Refusal.WRONG_STATE}
    assert "an automatic command does not take it back" in pilot.told(EventKind.COMMAND_REFUSED)[0].text
    assert bench.proxy.handler.flight.others
    pilot.command(action)
    assert bench.driver.told == [action], "the application's own is a decision"


def test_an_automatic_hover_flies_our_vehicle_and_aborts_no_landing(bench: Bench) -> None:
    pilot = bench.airborne()
    pilot.command(Hover(), automatic=True)
    assert bench.driver.told == [Hover()]
    pilot.command(Land())
    bench.driver.report(state=FlightState.LANDING)
    pilot.command(Hover(), automatic=True)
    assert bench.driver.told == [Hover(), Land()]
    pilot.command(Hover())
    assert bench.driver.told == [Hover(), Land(), Hover()], "a person may"


def test_an_automatic_hover_does_not_end_the_landing_of_the_failsafe(bench: Bench) -> None:
    pilot = bench.airborne()
    pilot.command(Velocity(0.5))
    bench.run(5.2)
    assert bench.driver.told[-1] == Land()
    assert steps(pilot)[-1][0] == "land"
    pilot.take_authority()
    count = len(bench.driver.told)
    bench.run(1.0, lambda: pilot.command(Hover(), automatic=True))
    assert bench.driver.told[count:] in ([], [Land()])
    assert steps(pilot)[-1][0] == "land"
    pilot.command(Hover())
    assert bench.driver.told[-1].name == "hover"


@pytest.mark.parametrize("action", [Velocity(0.5), Attitude(0.1)])
def test_a_set_point_does_not_take_it_and_is_refused_with_the_reason(bench: Bench, action: AnyAction) -> None:
    bench.driver.report(state=FlightState.FLYING)
    pilot = bench.pilot()
    for _ in range(3):
        pilot.command(action)
    assert bench.driver.told == []
    assert pilot.refusals() == [Refusal.WRONG_STATE]
    assert "flown by others: hover, take off or land first" in pilot.told(EventKind.COMMAND_REFUSED)[0].text
    pilot.command(Hover())
    pilot.command(action)
    assert bench.driver.told == [Hover(), action]


@pytest.mark.parametrize("state", [FlightState.LANDING, FlightState.FLYING, FlightState.HOVERING])
@pytest.mark.parametrize("action", [Takeoff(), Hover(), Land(), Velocity(0.5)])
def test_no_repeat_takes_the_vehicle_back_from_others(bench: Bench, state: FlightState, action: AnyAction) -> None:
    """A take-off in progress, a hover, a landing or a set-point: the library repeats each 32 times a second."""
    pilot = bench.airborne()
    pilot.command(action)
    bench.driver.told.clear()
    bench.driver.left = "LAND"
    bench.driver.report(state=state)
    bench.run(3.0, lambda: pilot.command(action, repeat=True))
    assert bench.driver.told == []
    assert set(pilot.refusals()) == {Refusal.WRONG_STATE}
    assert "in LAND, which was not chosen here" in pilot.told(EventKind.COMMAND_REFUSED)[0].text
    bench.run(20.0)
    assert bench.driver.told == [], "nor does the ladder, when the pilot is silent"
    assert steps(pilot) == []


def test_a_set_points_decay_to_hover_is_not_a_new_command(bench: Bench) -> None:
    pilot = bench.airborne()
    pilot.command(Velocity(0.5))
    bench.driver.told.clear()
    bench.driver.left = "LAND"
    bench.driver.report(state=FlightState.LANDING)
    bench.tick()
    for _ in range(5):
        pilot.command(Velocity(0.5))  # a program that has not noticed
    assert bench.driver.told == []
    bench.run(2.0, lambda: pilot.command(Hover(), repeat=True))
    assert bench.driver.told == []


def test_a_step_of_the_ladder_ends_when_others_take_the_vehicle(bench: Bench) -> None:
    pilot = bench.airborne()
    pilot.command(Velocity(0.5))
    bench.run(0.6)
    assert bench.driver.told[-1] == Hover()
    bench.driver.left = "LOITER"
    bench.driver.report(state=FlightState.FLYING)
    count = len(bench.driver.told)
    bench.run(10.0)
    assert len(bench.driver.told) == count
    assert steps(pilot)[-1] == ("none", "others")
    assert pilot.last_feedback().failsafe is Failsafe.NONE


def test_a_software_steered_vehicle_is_released() -> None:
    with Bench(actions={"attitude", "takeoff", "land"}) as bench:
        pilot = bench.airborne()
        pilot.command(Velocity(0.3))
        bench.run(0.1)
        assert bench.driver.told
        bench.driver.told.clear()
        bench.driver.answers = False
        bench.proxy.handler._executor._driver.left_to = lambda: "STABILIZE"  # type: ignore[method-assign]
        bench.run(0.02)
        bench.driver.told.clear()
        bench.run(2.0)
        assert bench.driver.told == []


def test_a_landing_by_others_continues_when_an_application_wants_the_same(bench: Bench) -> None:
    pilot = bench.airborne()
    bench.driver.left = "LAND"
    bench.driver.report(state=FlightState.LANDING)
    bench.tick()
    pilot.command(Land())
    assert bench.driver.told == []
    assert pilot.refusals() == []


def test_the_driver_learns_which_commands_are_new(bench: Bench) -> None:
    pilot = bench.airborne()
    pilot.command(Hover())
    assert bench.driver.repeats == 0
    pilot.command(Hover(), repeat=True)
    pilot.command(Hover(), repeat=True)
    assert (len(bench.driver.told), bench.driver.repeats) == (3, 2)
    pilot.command(Hover())
    assert (len(bench.driver.told), bench.driver.repeats) == (4, 2)


def test_a_refusal_by_the_vehicle_is_reported_once_in_its_newest_words(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    reasons = iter(["System not initialised", *["GPS has no fix"] * 100])

    def refuse(_: AnyAction, *, new: bool = True) -> AnyAction:
        raise DriverError(f"the vehicle does not start yet: {next(reasons)}")

    monkeypatch.setattr(bench.driver, "apply", refuse)
    pilot = bench.pilot()
    pilot.command(Takeoff())
    bench.run(1.1, lambda: pilot.command(Takeoff()))
    told = [event.text for event in pilot.told(EventKind.COMMAND_REFUSED)]
    assert told[0] == "pilot: takeoff refused: the vehicle does not start yet: System not initialised"
    assert "GPS has no fix" in told[1]
    assert pilot.told(EventKind.DRIVER_ERROR) == []


# The note of a flight ----------------------------------------------------------------------------------------------


def fly_and_die(path: Path) -> None:
    """Run a proxy that starts a flight and ends without landing."""
    with Bench() as bench:
        bench.proxy.keep_record(record := FlightRecord(path, "fake://"))
        record.start()
        bench.airborne()
        wait_until(path.exists, "the flight is noted")
        bench.run(0.1)
        record.close()


def test_a_killed_proxy_ends_its_own_flight_after_its_restart(tmp_path: Path) -> None:
    path = tmp_path / "alpha.flight"
    fly_and_die(path)
    again = Bench()
    again.proxy.keep_record(FlightRecord(path, "fake://"))
    with again:
        again.driver.report(state=FlightState.FLYING)
        again.run(6.0)
        assert again.driver.told == [Hover(), Land()]
        again.driver.report(state=FlightState.LANDED)
        again.run(1.1)
        wait_until(lambda: not path.exists(), "the note goes with the flight")


def test_a_flight_found_long_after_the_proxy_was_killed_is_others(tmp_path: Path) -> None:
    """The vehicle was away for a new battery, and returns in the air."""
    path = tmp_path / "alpha.flight"
    fly_and_die(path)
    again = Bench()
    again.proxy.keep_record(FlightRecord(path, "fake://"))
    again.driver.now = Feedback(captured_ns=0)
    with again:
        again.run(LIFE_S + 1.0)
        wait_until(lambda: not path.exists(), "it is not looked for any more")
        again.driver.report(state=FlightState.FLYING)
        again.run(6.0)
        assert again.driver.told == []
        assert again.proxy.handler.flight.others


def test_the_note_of_a_flight_goes_when_the_vehicle_is_found_standing(tmp_path: Path) -> None:
    path = tmp_path / "alpha.flight"
    fly_and_die(path)
    again = Bench()
    again.proxy.keep_record(FlightRecord(path, "fake://"))
    with again:
        assert path.exists()
        again.run(1.1)
        wait_until(lambda: not path.exists(), "it is over")


@pytest.mark.parametrize("what", ["another vehicle", "old", "damaged", "of the future"])
def test_a_note_that_may_be_of_another_flight_does_not_count(tmp_path: Path, what: str) -> None:
    path = tmp_path / "alpha.flight"
    fly_and_die(path)
    at_s = path.stat().st_mtime
    later_s = {"old": LIFE_S + 5.0, "of the future": -5.0}.get(what, 1.0)
    if what == "damaged":
        path.write_bytes(b"\xff\x00")
    vehicle = "mavlink://udpin:0.0.0.0:1" if what == "another vehicle" else "fake://"
    assert (FlightRecord(path, "fake://", lambda: at_s + 1.0).left_s() > 0.0) is (what != "damaged")
    assert FlightRecord(path, vehicle, lambda: at_s + later_s).left_s() == 0.0


def test_an_unwritable_note_stops_nothing(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    record = FlightRecord(tmp_path / "missing" / "alpha.flight", "fake://")
    assert record.left_s() == 0.0
    record.start()
    record.set(True)
    wait_until(lambda: "can't be written" in caplog.text, "it is told")
    record.close()


def test_a_flight_taken_by_others_is_no_longer_noted(tmp_path: Path) -> None:
    path = tmp_path / "alpha.flight"
    with Bench() as bench:
        bench.proxy.keep_record(record := FlightRecord(path, "fake://"))
        record.start()
        bench.airborne()
        wait_until(path.exists, "the flight is noted")
        bench.driver.left = "RTL"
        bench.run(0.1)
        wait_until(lambda: not path.exists(), "it is somebody else's")


def test_the_last_state_of_a_flight_is_written(tmp_path: Path) -> None:
    """A change during the write just before the end was lost: a landed flight stayed noted."""
    record = FlightRecord(tmp_path / "alpha.flight", "fake://")
    writing, go_on = threading.Event(), threading.Event()
    write = record._write

    def slow() -> None:
        write()
        writing.set()
        go_on.wait(10)

    record._write = slow  # type: ignore[method-assign]
    record.start()
    record.set(True)
    assert writing.wait(10)
    assert record.path.exists()
    record.set(False)
    record._closing = True  # close() was called during the write
    go_on.set()
    record.close()
    assert not record.path.exists()
