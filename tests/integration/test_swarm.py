"""Swarms: client, transport and proxies in one process, with vehicles that obey commands at once."""

from __future__ import annotations

import contextlib
import logging
import math
import sys
import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from typing import Any

import pytest

import skyloop
from skyloop.client import Drone, Swarm
from skyloop.client.commands import cancelled
from skyloop.client.swarm import choose, in_parallel
from skyloop.errors import (
    AuthorityError,
    ClosedError,
    LinkError,
    RefusedError,
    SwarmError,
    UnknownNameError,
    UnsupportedError,
    UsageError,
)
from skyloop.messages import FlightState, Hover, Land, LinkState, Velocity
from skyloop.proxy.proxy import Proxy
from skyloop.transport.testing import wait_until
from tests.integration.field import NAMES, Field
from tests.support.systems import STEP_NS


@pytest.fixture
def field() -> Iterator[Field]:
    field = Field()
    yield field
    field.stop()


@contextmanager
def swarming(field: Field, **options: Any) -> Iterator[Swarm]:
    """A swarm that is closed without a report at the end, whatever happened."""
    drones = field.swarm(**options)
    try:
        yield drones
    finally:
        drones.close()


def gone(field: Field, drones: Swarm, name: str) -> None:
    """Kill one drone's proxy, and wait until the swarm's side has noticed."""
    field.proxies[name].end()
    wait_until(lambda: drones[name].link.application is LinkState.LOST, "the link is lost")


def test_commands_go_to_all_and_all_land_at_the_end(field: Field) -> None:
    with field.swarm() as drones:
        drones.takeoff()
        assert drones.velocity(forward=0.3, yaw_rate=0.1) == dict.fromkeys(NAMES, True)
        flying = drones.wait_all("flying", 5.0)
        assert list(flying) == list(NAMES)
        assert all(Velocity(0.3, yaw_rate=0.1) in vehicle.applied for vehicle in field.vehicles.values())
        drones.hover()
        drones.wait_all("hovering", 5.0)
        drones.attitude(pitch=0.05)
        drones.wait_all(lambda feedback: feedback.state == "flying", 5.0)
        assert {name: feedback.state for name, feedback in drones.feedback(max_age_s=5.0).items()} == dict.fromkeys(
            NAMES, FlightState.FLYING
        )
        assert drones.idle() == dict.fromkeys(NAMES, True)
    assert field.states() == {FlightState.LANDED}
    with pytest.raises(ClosedError):
        drones.hover()
    assert drones._leave() == {}


def test_it_is_a_collection_of_drones(field: Field) -> None:
    with field.swarm() as drones:
        assert drones.names == NAMES
        assert len(drones) == 3
        assert "alpha" in drones
        assert "delta" not in drones
        assert [drone.name for drone in drones] == list(NAMES)
        assert [(name, drone.name) for name, drone in drones.items()] == [(name, name) for name in NAMES]
        assert drones["bravo"].name == "bravo"
        with pytest.raises(UnknownNameError, match="did you mean 'bravo'"):
            drones["brabo"]
        assert repr(drones) == "<Swarm alpha, bravo, charlie>"


def test_one_that_fails_is_set_aside_and_the_others_continue(field: Field, caplog: pytest.LogCaptureFixture) -> None:
    field.broken("bravo")

    def fly() -> None:
        with field.swarm() as drones:
            go_on(drones)

    def go_on(drones: Swarm) -> None:
        drones.takeoff()
        assert list(drones.active) == ["alpha", "charlie"]
        assert isinstance(drones.errors["bravo"], RefusedError)
        assert "set aside: bravo" in repr(drones)
        assert set(drones.velocity(forward=0.2)) == {"alpha", "charlie"}
        assert set(drones.wait_all("flying", 5.0)) == {"alpha", "charlie"}
        assert drones.send({"bravo": Velocity(1.0)}) == {}
        assert Velocity(1.0) not in field.vehicles["bravo"].applied

    with caplog.at_level(logging.WARNING, "skyloop"), pytest.raises(SwarmError) as raised:
        fly()
    assert "takeoff of bravo failed" in caplog.text
    assert list(raised.value.errors) == ["bravo"]
    assert raised.value.total == 3
    assert str(raised.value).startswith(
        "the flight failed for 1 of 3 drones:\n  bravo: RefusedError: test: takeoff refused"
    )
    assert field.states() == {FlightState.LANDED, FlightState.EMERGENCY}


def test_a_failed_drone_can_be_taken_back(field: Field) -> None:
    field.broken("bravo")
    with field.swarm() as drones:
        drones.takeoff()
        field.mended("bravo")
        with pytest.raises(UnknownNameError):
            drones.readmit("delta")
        drones.readmit("bravo")
        assert drones.errors == {}
        drones["bravo"].takeoff()
        assert set(drones.hover()) == set(NAMES)
        drones.readmit()
    assert field.states() == {FlightState.LANDED}


def test_when_no_drone_remains_it_says_so(field: Field) -> None:
    field.broken(*NAMES)
    with swarming(field) as drones, pytest.raises(SwarmError) as raised:
        drones.takeoff()
    assert set(raised.value.errors) == set(NAMES)
    assert str(raised.value).count("\n") == 3


def test_raise_does_not_affect_the_others(field: Field) -> None:
    field.broken("alpha")
    with swarming(field, on_error="raise") as drones:
        with pytest.raises(SwarmError) as raised:
            drones.takeoff()
        assert list(raised.value.errors) == ["alpha"]
        assert drones.errors == {}
        assert list(drones.active) == list(NAMES)
        assert field.vehicles["charlie"].state is FlightState.HOVERING


def test_stop_makes_the_others_hover(field: Field) -> None:
    with swarming(field, on_error="stop") as drones:
        drones.takeoff()
        drones.velocity(forward=0.5)
        drones.wait_all("flying", 5.0)
        gone(field, drones, "alpha")
        with pytest.raises(SwarmError, match="alpha: LinkError: the command was not sent: the link is lost"):
            drones.velocity(forward=0.5)
        for name in ("bravo", "charlie"):
            drones[name].wait("hovering", 5.0)


def test_land_lands_the_others(field: Field) -> None:
    with swarming(field, on_error="land") as drones:
        drones.takeoff()
        gone(field, drones, "charlie")
        with pytest.raises(SwarmError) as raised:
            drones.hover()
        assert list(raised.value.errors) == ["charlie"]
        assert isinstance(raised.value.errors["charlie"], LinkError)
        assert {field.vehicles[name].state for name in ("alpha", "bravo")} == {FlightState.LANDED}


def test_a_drone_whose_link_was_lost_takes_part_again_when_it_is_back(field: Field) -> None:
    with field.swarm() as drones:
        drones.takeoff()
        gone(field, drones, "bravo")
        assert drones.velocity(forward=0.1) == {"alpha": True, "bravo": False, "charlie": True}
        assert drones.errors == {}
        proxy = field.proxies["bravo"] = Proxy(field.vehicles["bravo"], field.servers["bravo"], name="bravo")
        proxy.start()
        wait_until(lambda: drones["bravo"].authority.state == "held", "it is back")
        assert drones.hover()["bravo"]
        drones.wait_all("hovering", 5.0)


def test_a_lost_link_is_not_taken_for_hovering(field: Field) -> None:
    with swarming(field) as drones:
        drones.takeoff()
        gone(field, drones, "bravo")
        assert set(drones.wait_all("hovering", 0.1)) == {"alpha", "charlie"}
        assert "it is hovering, and its link is lost" in str(drones.errors["bravo"])


def test_waiting_for_all_names_each_that_did_not_arrive(field: Field) -> None:
    with swarming(field, on_error="raise") as drones:
        drones["alpha"].takeoff()
        with pytest.raises(SwarmError) as raised:
            drones.wait_all(lambda feedback: feedback.state == "hovering", 0.1)
        assert list(raised.value.errors) == ["bravo", "charlie"]
        assert "was not as wanted within 0.1 s: it is landed" in str(raised.value)
        with pytest.raises(UnknownNameError, match="hovering"):
            drones.wait_all("hoovering")
        with pytest.raises(ZeroDivisionError):  # an error in the user's code is not attributed to a drone
            drones.wait_all(lambda feedback: bool(1 / 0))


def test_all_must_fulfil_the_condition_at_the_same_time(field: Field) -> None:
    looks: list[str] = []

    def turns(feedback: skyloop.Feedback) -> bool:
        looks.append(feedback.state)
        return len(looks) != 4  # false on the first look after all had fulfilled it once

    with swarming(field) as drones:
        assert set(drones.wait_all(turns, 5.0)) == set(NAMES)
        assert len(looks) > 6


def test_a_drone_closed_while_all_are_awaited_has_failed(field: Field, monkeypatch: pytest.MonkeyPatch) -> None:
    with swarming(field) as drones:
        bravo = drones["bravo"]
        read = bravo.feedback

        def feedback() -> skyloop.Feedback:
            bravo.close()  # by another thread, when it already fulfilled the condition
            return read()

        monkeypatch.setattr(bravo, "feedback", feedback)
        assert set(drones.wait_all("landed", 5.0)) == {"alpha", "charlie"}
        assert isinstance(drones.errors["bravo"], ClosedError)


def test_a_drone_that_is_taken_over_rejoins_automatically(field: Field) -> None:
    with field.swarm() as drones:
        drones.takeoff()
        boss = field.connect("bravo", app="boss", priority=0)
        wait_until(lambda: drones["bravo"].authority.state == "preempted", "it is taken over")
        assert set(drones.velocity(forward=0.1)) == {"alpha", "charlie"}
        assert isinstance(drones.errors["bravo"], AuthorityError)
        assert "boss" in str(drones.errors["bravo"])
        boss.close()
        wait_until(lambda: drones["bravo"].authority.state == "held", "it is given back")
        assert set(drones.hover()) == set(NAMES)
        assert drones.errors == {}


def test_an_exception_in_the_block_lands_all_and_reports_other_failures(field: Field) -> None:
    field.broken("alpha")

    def fly() -> None:
        with field.swarm() as drones:
            drones.takeoff()
            assert field.vehicles["bravo"].state is FlightState.HOVERING
            raise KeyError("mine")

    with pytest.raises(KeyError) as raised:
        fly()
    assert field.states() == {FlightState.LANDED, FlightState.EMERGENCY}
    assert "alpha: RefusedError" in raised.value.__notes__[0]


@pytest.mark.slow
def test_a_drone_that_can_not_land_does_not_stop_the_others_from_landing(
    field: Field, monkeypatch: pytest.MonkeyPatch
) -> None:
    land = Drone.land

    def briefly(self: Drone, *, wait: bool = True, timeout_s: float = 20.0) -> None:
        land(self, wait=wait, timeout_s=0.3 if self.name == "alpha" else timeout_s)

    monkeypatch.setattr(Drone, "land", briefly)
    field.vehicles["alpha"].ignores = {Land}
    drones = field.swarm()
    drones.takeoff()
    with pytest.raises(SwarmError, match="alpha: NoAnswerError: land was not completed") as raised:
        drones.__exit__(None, None, None)
    assert list(raised.value.errors) == ["alpha"]
    assert {field.vehicles[name].state for name in ("bravo", "charlie")} == {FlightState.LANDED}
    assert Land() in field.vehicles["alpha"].applied


def test_set_points_are_sent_at_one_tick_and_the_spread_is_measured(field: Field) -> None:
    with field.swarm() as drones:
        assert drones.spread is None
        drones.takeoff()
        before = drones.spread
        for count in range(5):
            sent = drones.send({name: Velocity(0.1 * count, 0.01 * n) for n, name in enumerate(NAMES)})
            assert sent == dict.fromkeys(NAMES, True)
            assert max(drone._commands.schedule.open_ns for drone in drones) <= time.monotonic_ns() + 5_000_000
        spread = drones.spread
        assert before is None
        assert spread is not None
        assert spread.count == 5
        assert spread.median > 0.0 or STEP_NS
        assert spread.median <= spread.maximum
        last = {name: Velocity(0.4, 0.01 * n) for n, name in enumerate(NAMES)}
        wait_until(lambda: all(last[name] in field.vehicles[name].applied for name in NAMES), "the last")


def test_nothing_is_sent_if_one_command_is_wrong(field: Field) -> None:
    with field.swarm() as drones:
        drones.takeoff()
        with pytest.raises(UsageError, match="NaN"):
            drones.send({"alpha": Velocity(0.7), "bravo": Velocity(math.nan)})
        with pytest.raises(UnknownNameError, match="delta"):
            drones.send({"alpha": Velocity(0.7), "delta": Velocity()})
        with pytest.raises(UsageError, match="a command must be one of"):
            drones.send({"alpha": "hover"})  # type: ignore[dict-item]
        with pytest.raises(UsageError, match="forward is 'fast'"):
            drones.velocity(forward="fast")  # type: ignore[arg-type]
        assert Velocity(0.7) not in field.vehicles["alpha"].applied


def test_the_emergency_stop_also_reaches_drones_set_aside(field: Field) -> None:
    field.broken("bravo")
    with swarming(field) as drones:
        drones.takeoff()
        assert list(drones.errors) == ["bravo"]
        assert drones.emergency_stop() == dict.fromkeys(NAMES, True)
        wait_until(lambda: field.states() == {FlightState.EMERGENCY}, "all have stopped")
        drones.readmit()
        drones.wait_all("emergency", 5.0)
        drones.reset_emergency()
        drones.wait_all("landed", 5.0)
        gone(field, drones, "alpha")
        with pytest.raises(SwarmError, match="emergency_stop failed for 1 of 3 drones"):
            drones.emergency_stop()


def test_rate_keeps_absolute_deadlines(field: Field) -> None:
    with field.swarm() as drones:
        ticks = list(drones.ticks(100.0, seconds=0.1))
        assert [tick.number for tick in ticks] == list(range(len(ticks)))
        assert 1 <= len(ticks) <= 10
        assert all(0.01 * n - 1e-6 <= tick.elapsed_s < 0.1 for n, tick in enumerate(ticks))
        with pytest.raises(UsageError, match="rate_hz"):
            next(drones.ticks(0.0))
        for tick in drones.ticks(100.0):
            if tick.number == 2:
                break
        assert tick.elapsed_s > 0.019


@pytest.mark.parametrize("end", [None, KeyboardInterrupt, ValueError, SystemExit])
def test_when_a_loop_ends_the_drones_it_flew_hover_at_once(field: Field, end: type[BaseException] | None) -> None:
    """The last velocity continued for ``stall_s``: set-points that no loop commanded any longer."""
    with Swarm({name: field.connect(name, stall_s=math.inf) for name in NAMES}) as drones:
        drones.takeoff()
        drones["bravo"].land(wait=False)
        with contextlib.suppress(KeyboardInterrupt, ValueError, SystemExit):
            for tick in drones.ticks(100.0):
                drones.send({name: Velocity(0.5) for name in ("alpha", "charlie")})
                if tick.number == 5:
                    if end is None:
                        break
                    raise end
        commands = {name: drone._commands for name, drone in drones.items()}
        assert type(commands["alpha"].newest) is type(commands["charlie"].newest) is Hover
        assert type(commands["bravo"].newest) is not Hover, "the loop did not fly it"
        wait_until(lambda: type(field.vehicles["alpha"].applied[-1]) is Hover, "it hovers")


def test_a_function_for_each_runs_on_separate_threads(field: Field) -> None:
    with swarming(field, on_error="raise") as drones:
        assert drones.each(lambda drone: drone.capabilities.vehicle) == dict.fromkeys(NAMES, "fake")

        def refuse(drone: Drone) -> None:
            if drone.name != "alpha":
                raise UnsupportedError("not with me")

        with pytest.raises(SwarmError, match="refuse failed for 2 of 3 drones"):
            drones.each(refuse)
        with pytest.raises(ZeroDivisionError):
            drones.each(lambda drone: 1 / 0)


def test_invalid_swarms(field: Field) -> None:
    with pytest.raises(UsageError, match="at least one"):
        Swarm({})
    with pytest.raises(UsageError, match="on_error is 'panic'"), field.connect("alpha") as drone:
        Swarm({"alpha": drone}, on_error="panic")  # type: ignore[arg-type]
    for options in ({"on_error": "x"}, {"missing": "x"}):
        with pytest.raises(UsageError, match="is 'x' and must be"):
            skyloop.swarm("alpha", **options)  # type: ignore[arg-type]


RUNNING = ["drone1", "drone2", "other"]
CHOICES: list[tuple[tuple[str | Mapping[str, str], ...], dict[str, str]]] = [
    (("alpha", "bravo"), {"alpha": "alpha", "bravo": "bravo"}),
    (("drone*",), {"drone1": "drone1", "drone2": "drone2"}),
    (("other", "drone[13]"), {"other": "other", "drone1": "drone1"}),
    (("sim://", "sim://?seed=1", "fake://x"), {"sim1": "sim://", "sim2": "sim://?seed=1", "fake1": "fake://x"}),
    (({"left": "sim://", "right": "alpha"},), {"left": "sim://", "right": "alpha"}),
]


@pytest.mark.parametrize(("targets", "chosen"), CHOICES, ids=str)
def test_names_patterns_addresses_and_own_names(
    targets: tuple[str | Mapping[str, str], ...], chosen: dict[str, str]
) -> None:
    assert choose(targets, lambda: RUNNING) == chosen


def test_invalid_selections() -> None:
    with pytest.raises(UsageError, match="'drone1' is named twice"):
        choose(["drone*", "drone1"], lambda: RUNNING)
    with pytest.raises(UnknownNameError, match="no running proxy named 'dron_\\*'"):
        choose(["dron_*"], lambda: RUNNING)
    with pytest.raises(UsageError, match="at least one drone"):
        choose([], lambda: RUNNING)
    for wrong in ("", 3, {"a": ""}, {"": "sim://"}):
        with pytest.raises(UsageError):
            choose([wrong], lambda: RUNNING)  # type: ignore[list-item]


def test_without_threads_the_rest_runs_in_turn(monkeypatch: pytest.MonkeyPatch) -> None:
    """The end of a swarm raised "can't start new thread", and some drones were not landed."""
    begin, begun = threading.Thread.start, list[str]()

    def start(thread: threading.Thread) -> None:
        if thread.name.startswith("skyloop-swarm") and begun:
            raise RuntimeError("can't start new thread")
        begun.append(thread.name)
        begin(thread)

    monkeypatch.setattr(threading.Thread, "start", start)
    results, errors = in_parallel({"a": lambda: 1, "b": lambda: 2, "c": lambda: 3})
    assert (results, errors) == ({"a": 1, "b": 2, "c": 3}, {})
    assert not cancelled.get()(), "the caller's own cancellation"


def test_an_interrupt_ends_the_work_done_in_turn_without_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    """Ctrl-C in the first take-off was held back, and the next drone took off."""

    def none(_: threading.Thread) -> None:
        raise RuntimeError("can't start new thread")

    def interrupted() -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(threading.Thread, "start", none)
    begun = list[str]()
    with pytest.raises(KeyboardInterrupt):
        in_parallel({"a": interrupted, "b": lambda: begun.append("b")})
    assert begun == []


def test_parallel_work_ends_whatever_one_of_them_does() -> None:
    results, errors = in_parallel({"a": lambda: 1, "b": lambda: [].pop if False else 2})
    assert (results, errors) == ({"a": 1, "b": 2}, {})


def test_connecting_reports_all_that_failed_and_leaves_the_others(
    field: Field, monkeypatch: pytest.MonkeyPatch
) -> None:
    def connect(target: str, **options: Any) -> Drone:
        if target not in NAMES:
            raise UnknownNameError("running proxy", target, NAMES)
        return field.connect(target, **options)

    monkeypatch.setattr(sys.modules["skyloop.client.swarm"], "connect", connect)
    with pytest.raises(SwarmError) as raised:
        skyloop.swarm("alpha", "delta", "echo")
    assert list(raised.value.errors) == ["delta", "echo"]
    assert "connecting failed for 2 of 3 drones" in str(raised.value)
    with field.connect("alpha") as drone:  # it is no longer held
        assert drone.authority.state == "held"
    with skyloop.swarm("alpha", "delta", missing="skip") as drones:
        assert drones.names == ("alpha",)
        assert list(drones.errors) == ["delta"]
    with pytest.raises(SwarmError):
        skyloop.swarm("delta", missing="skip")


def test_two_swarms_do_not_share_a_drone(field: Field) -> None:
    with field.swarm() as drones, ExitStack() as stack:
        with pytest.raises(AuthorityError):
            stack.enter_context(field.connect("alpha", app="other"))
        assert set(drones.active) == set(NAMES)
