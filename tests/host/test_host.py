"""A vehicle whose driver hangs or raises ends alone: the others fly on, without a failsafe."""

from __future__ import annotations

import threading
from functools import partial

import pytest

from skyloop.drivers.uri import parse_uri
from skyloop.errors import NameTakenError, RefusedError, UnknownNameError
from skyloop.host import vehicle as vehicles
from skyloop.host.fleet import VehicleSettings
from skyloop.host.threads import Ticker
from skyloop.messages import (
    EventKind,
    Failsafe,
    FlightState,
    Hover,
    Land,
    ListParameters,
    Overview,
    Parameter,
    ParameterType,
    ParameterValue,
    SetParameter,
    Value,
    Velocity,
)
from skyloop.proxy import Proxy
from skyloop.transport.base import OVERVIEW
from skyloop.transport.local import LocalServer, list_names
from skyloop.transport.testing import wait_until
from tests.host.fleet import Flight, Hosting, closing_reason
from tests.support.proxy_bench import WAIT_S, FakeDriver


def test_a_vehicle_removed_just_before_it_starts_is_not_served(hosting: Hosting) -> None:
    """It counted as ended, and was then served without the host's knowledge."""
    hosting.vehicle("a")
    vehicle = hosting.host._make(hosting.settings("a"), None)
    vehicle.condition = vehicles.Condition.STARTING  # the host's state before it calls start()
    ending = threading.Thread(target=vehicle.end, args=(0.0, "it was removed"))
    ending.start()
    ending.join(0.1)
    vehicle.start()
    ending.join()
    assert not vehicle.runs


def test_a_driver_that_blocks_in_a_command_ends_only_its_own_vehicle(hosting: Hosting) -> None:
    stuck = hosting.add("stuck")
    hosting.add("good")
    witness = hosting.app("stuck")
    pilot = hosting.airborne("stuck")
    with Flight(hosting, "good") as flight:
        stuck.hangs = {"velocity"}
        pilot.command(Velocity(0.3, 0.0, 0.0, 0.0), sync=False)
        assert stuck.stuck.wait(10.0)
        flight.goes_on()
        wait_until(lambda: hosting.condition("stuck") == "failed", "it was dropped")
        assert "its driver hangs" in closing_reason(witness)
        flight.goes_on()
        late = hosting.app("good")  # late subscribers are served, and requests answered
        late.sync()
    stalls = [event for event in witness.events if event.kind is EventKind.DRIVER_ERROR]
    assert [event.data["where"] for event in stalls] == ["host"]
    (row,) = [row for row in hosting.host.status() if row.name == "stuck"]
    assert "a call has not returned" in row.failed
    assert hosting.condition("good") == "running"
    hosting.drivers["stuck"] = type(stuck)()
    hosting.add("stuck")  # it can be served again under its name
    assert hosting.condition("stuck") == "running"
    stuck.let_go.set()


def test_a_driver_that_blocks_for_a_moment_continues_beside_the_others(hosting: Hosting) -> None:
    slow = hosting.add("slow")
    hosting.add("good")
    pilot = hosting.airborne("slow")
    with Flight(hosting, "good") as flight:
        slow.hangs = {"velocity"}
        pilot.command(Velocity(0.3, 0.0, 0.0, 0.0), sync=False)
        wait_until(lambda: any("has been blocking" in line for line in hosting.lines), "the stall is reported")
        slow.hangs = set()
        slow.let_go.set()
        pilot.sync()
        flight.goes_on()
    assert hosting.condition("slow") == "running"
    assert hosting.shared("slow").server.reactor is not hosting.shared("good").server.reactor


def test_a_driver_that_blocks_in_a_failsafe_ends_only_its_own_vehicle(hosting: Hosting) -> None:
    """The ticker shared by all vehicles calls it."""
    stuck = hosting.add("stuck")
    hosting.add("good")
    hosting.airborne("stuck")
    witness = hosting.app("stuck")
    with Flight(hosting, "good") as flight:
        stuck.hangs = {"hover"}  # for lack of commands
        assert stuck.stuck.wait(10.0)
        flight.goes_on()
        assert "its driver hangs" in closing_reason(witness)
        assert hosting.condition("stuck") == "failed"
        flight.goes_on()
    silent = flight.pilot  # the others' failsafes work
    wait_until(lambda: any(f.failsafe is Failsafe.HOVER for f in silent.feedback), "the good one hovers")


def test_a_driver_that_fails_at_each_tick_ends_only_its_own_vehicle(hosting: Hosting) -> None:
    bad = hosting.add("bad")
    hosting.add("good")
    witness = hosting.app("bad")
    with Flight(hosting, "good") as flight:
        bad.fail = {"left_to"}
        assert "left_to is broken" in closing_reason(witness)
        wait_until(lambda: hosting.condition("bad") == "failed", "it was dropped")
        flight.goes_on()
    first = next(event for event in witness.events if event.kind is EventKind.DRIVER_ERROR)
    assert first.data["where"] == "tick"
    assert bad.closed


def test_a_tick_that_fails_now_and_then_ends_nothing(hosting: Hosting) -> None:
    bad = hosting.add("bad")
    witness = hosting.app("bad")
    bad.fail = {"left_to"}
    wait_until(lambda: any(event.kind is EventKind.DRIVER_ERROR for event in witness.events), "it failed")
    bad.fail = set()
    count = len(witness.feedback)
    wait_until(lambda: len(witness.feedback) > count + 3, "its ticks continue")
    assert hosting.condition("bad") == "running"


def test_a_driver_that_fails_in_a_command_is_reported_and_flies_on(hosting: Hosting) -> None:
    bad = hosting.add("bad")
    pilot = hosting.airborne("bad")
    bad.fail = {"apply"}
    pilot.command(Velocity(0.1, 0.0, 0.0, 0.0))
    assert any("apply is broken" in event.text for event in pilot.told(EventKind.DRIVER_ERROR))
    bad.fail = set()
    pilot.command(Velocity(0.2, 0.0, 0.0, 0.0))
    assert isinstance(bad.told[-1], Velocity)


def test_a_driver_that_does_not_open_delays_no_other(hosting: Hosting, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(vehicles, "OPEN_S", 2.0)  # the others are open by then, on any machine
    hosting.vehicle("stuck").hangs = {"open"}
    hosting.vehicle("broken").fail = {"open"}
    hosting.vehicle("good")
    problems = hosting.host.add_all([hosting.settings(name) for name in ("stuck", "broken", "good")])
    assert "did not open within" in problems.pop("stuck")
    assert "open is broken" in problems.pop("broken")
    assert problems == {}
    assert [hosting.condition(name) for name in ("stuck", "broken", "good")] == ["failed", "failed", "running"]
    hosting.app("good").sync()
    assert any(line.startswith("failed stuck: ") for line in hosting.lines)


def test_a_driver_that_does_not_close_delays_no_other(hosting: Hosting, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(vehicles, "OPEN_S", 2.0)  # the others are open by then, on any machine
    hosting.add("stuck").hangs = {"close"}
    hosting.add("good")
    hosting.host.remove("stuck")
    hosting.app("good").sync()
    assert [row.name for row in hosting.host.status() if row.condition == "running"] == ["good"]


def test_a_request_that_hangs_delays_only_its_own_vehicle(hosting: Hosting) -> None:
    stuck = hosting.vehicle("stuck")
    stuck.native = [Parameter("gain", ParameterType.FLOAT, 1.0)]
    stuck.hangs = {"set_parameter"}
    for name in ("stuck", "good"):
        hosting.add(name)
    pilot = hosting.airborne("stuck")
    number = pilot.post(SetParameter("gain", 2.0, pilot.lease))
    assert stuck.stuck.wait(10.0)
    other = hosting.app("good")
    for _ in range(10):
        other.ask(ListParameters(0))
    pilot.command(Velocity(0.1, 0.0, 0.0, 0.0))  # it can still be flown
    stuck.let_go.set()
    assert isinstance(pilot.answer(number), ParameterValue)


def test_names_in_use_are_refused_and_the_others_start(hosting: Hosting) -> None:
    lone = Proxy(FakeDriver(lambda: 0), LocalServer("taken"), name="taken")
    with lone:
        for name in ("taken", "good"):
            hosting.vehicle(name)
        problems = hosting.host.add_all([hosting.settings(name) for name in ("taken", "good")])
        assert list(problems) == ["taken"]
        assert "in use by a running proxy" in problems["taken"]
        assert hosting.condition("good") == "running"
    with pytest.raises(NameTakenError, match="skyloop host remove good"):
        hosting.add("good")
    hosting.add("taken")  # the name is free now
    assert hosting.condition("taken") == "running"


def test_a_vehicle_that_flies_under_a_lease_is_removed_only_on_request(hosting: Hosting) -> None:
    driver = hosting.add("alpha")
    pilot = hosting.airborne("alpha")
    pilot.command(Hover())
    with pytest.raises(RefusedError, match=r"pilot has the authority.*host remove alpha --land") as refused:
        hosting.host.remove("alpha")
    assert refused.value.code == "flown"
    assert Land() not in driver.told
    last = hosting.host.remove("alpha", land=True)
    assert last.state == FlightState.LANDED
    assert driver.told[-1] == Land()
    assert driver.closed
    assert "removed from its host" in closing_reason(pilot)
    assert hosting.host.vehicles == {}
    assert list_names() == []
    assert hosting.condition("alpha") == "stopped"  # its name can be added again


def test_a_vehicle_that_does_not_land_stays(hosting: Hosting) -> None:
    driver = hosting.add("alpha")
    hosting.airborne("alpha")
    driver.lands = False
    with pytest.raises(RefusedError, match="has not landed within") as refused:
        hosting.host.remove("alpha", land=True, timeout_s=0.1)
    assert refused.value.code == "flying"
    assert hosting.condition("alpha") == "running"


def test_an_unknown_vehicle_is_not_removed(hosting: Hosting) -> None:
    hosting.add("alpha")
    with pytest.raises(UnknownNameError, match="did you mean 'alpha'"):
        hosting.host.remove("alpa")


def test_all_land_at_the_end_though_one_hangs(hosting: Hosting) -> None:
    for name in ("stuck", "one", "two"):
        hosting.add(name)
        hosting.airborne(name)
    hosting.drivers["stuck"].hangs = {"land"}
    landing = threading.Thread(target=hosting.host.close, args=("it is late", 20.0))
    landing.start()
    for name in ("one", "two"):
        wait_until(partial(hosting.drivers[name].told.__contains__, Land()), "it lands")
    landing.join(20.0)
    assert not landing.is_alive(), "it must not wait for a hanging vehicle that was dropped"
    with pytest.raises(RefusedError, match="shutting down"):
        hosting.add("late")


def test_presets_are_in_force_from_the_start(hosting: Hosting) -> None:
    driver = hosting.vehicle("alpha")

    def tilt(value: float) -> list[Parameter]:
        return [Parameter("limits.tilt", ParameterType.FLOAT, value, minimum=0.05, maximum=1.0)]

    driver.native = tilt(0.5)
    driver.while_setting = lambda: driver.native.__setitem__(slice(None), tilt(0.2))
    presets: dict[str, Value] = {"limits.speed": 0.5, "limits.tilt": 0.2}
    hosting.host.add(VehicleSettings("alpha", parse_uri("fake://alpha"), presets=presets))
    proxy = hosting.shared("alpha").proxy
    assert proxy is not None
    wait_until(
        lambda: proxy.handler.checks.airspace.settings.limits.tilt == 0.2, "the vehicle's own parameter was written"
    )
    assert proxy.handler.checks.airspace.settings.limits.speed == 0.5
    pilot = hosting.airborne("alpha")
    pilot.command(Velocity(2.0, 0.0, 0.0, 0.0))
    flown = driver.told[-1]
    assert isinstance(flown, Velocity)
    assert flown.forward == pytest.approx(0.5)


def test_a_vehicle_that_can_not_be_created_is_listed_as_failed(hosting: Hosting) -> None:
    with pytest.raises(RefusedError, match="KeyError"):
        hosting.host.add(VehicleSettings("nobody", parse_uri("fake://nobody")))
    assert hosting.condition("nobody") == "failed"


def test_nothing_is_left_behind() -> None:
    before = set(threading.enumerate())

    def left() -> list[str]:
        return [thread.name for thread in threading.enumerate() if thread not in before]

    with Hosting() as hosting:
        hosting.add("alpha")
        hosting.app("alpha").sync()
        hosting.host.remove("alpha")
        wait_until(lambda: "skyloop-audit" not in left(), "its threads have ended")
    wait_until(lambda: not left(), "all have ended")


def test_an_overview_shows_all_vehicles_of_the_host_but_no_failed_one(hosting: Hosting) -> None:
    for name in ("one", "two", "three"):
        hosting.add(name)
    witness = hosting.app("one")
    witness.end.subscribe(OVERVIEW)

    def names() -> list[str]:
        pages = [sample for sample in witness.others if isinstance(sample, Overview)]
        return [row.name for row in pages[-1].vehicles] if pages else []

    wait_until(lambda: names() == ["one", "three", "two"], "all are shown")
    stuck = hosting.drivers["two"]
    pilot = hosting.airborne("two")
    stuck.hangs = {"velocity"}
    pilot.command(Velocity(0.3, 0.0, 0.0, 0.0), sync=False)
    wait_until(lambda: hosting.condition("two") == "failed", "it was dropped")
    wait_until(lambda: names() == ["one", "three"], "it is no longer shown")
    stuck.let_go.set()


def test_a_vehicle_removed_while_it_starts_leaves_no_proxy_without_ticks(hosting: Hosting) -> None:
    """It kept serving, and a dead pilot's drone was never landed."""
    driver = hosting.vehicle("alpha")
    driver.hangs = {"open"}
    adding = threading.Thread(target=hosting.host.add, args=(hosting.settings("alpha"),))
    adding.start()
    assert driver.stuck.wait(WAIT_S)
    removing = threading.Thread(target=hosting.host.remove, args=("alpha",))
    removing.start()
    removing.join(0.1)
    driver.let_go.set()
    adding.join(WAIT_S)
    removing.join(WAIT_S)
    assert not removing.is_alive()
    assert driver.closed, "its proxy has ended"
    assert "alpha" not in hosting.host.vehicles
    assert hosting.host._ticker.empty, "and is not ticked"
    driver.hangs = set()
    hosting.add("alpha")
    assert hosting.condition("alpha") == "running"


def test_a_vehicle_that_blocks_repeatedly_keeps_its_one_loop(hosting: Hosting) -> None:
    """Each further stall left an empty loop behind, with a thread and two descriptors, until none were left."""
    hosting.add("alpha")
    hosting.add("bravo")
    host, proxy = hosting.host, hosting.shared("alpha").proxy
    assert proxy is not None
    counts = []
    for _ in range(5):
        loops = [loop for loop in host._loops if isinstance(loop, Ticker) and proxy in loop._failures]
        assert len(loops) == 1
        host._on_stall(loops[0], proxy)
        counts.append(len(host._loops))
    assert counts == [4] * 5
    assert sum("has been blocking" in line for line in hosting.lines) == 1
    host.remove("alpha")
    assert len(host._loops) == 3, "its own loop closes with it"
