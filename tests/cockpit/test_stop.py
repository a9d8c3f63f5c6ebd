"""A page's emergency stop: no other action of the page can lose it, and "done" means that the vehicle shows it."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from skyloop.cockpit import station
from skyloop.cockpit.control_session import ControlSession
from skyloop.cockpit.station import PilotConnection
from skyloop.errors import DriverError, UnsupportedError
from skyloop.messages import AnyAction, EmergencyStop, Fate, FlightState, Hover, Outcome, Refusal, Velocity
from tests.support.cockpit import Node, open_socket, until
from tests.support.cockpit_page import Page, count, page
from tests.support.testclient import TestClient


@contextmanager
def sticks_held(pilot: Page) -> Iterator[None]:
    """Press like a gamepad's pilot: the sticks stay deflected, twenty times a second."""
    ended = threading.Event()

    def hold() -> None:
        while not ended.wait(0.05):
            pilot.say("fly", forward=0.5)

    thread = threading.Thread(target=hold)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()


def test_a_stop_whose_first_packets_are_lost_comes_while_the_sticks_are_held(client: TestClient, node: Node) -> None:
    """Held sticks replaced the stop: after one lost packet it flew on, while the page reported it as done."""
    with page(client) as pilot:
        pilot.take().take_off()
        with sticks_held(pilot):
            until(lambda: node.flyer.state is FlightState.FLYING)
            node.stops_lost = 3
            pilot.say("stop", n=70)
            pilot.wait("done", do="stop")
            assert node.flyer.state is FlightState.EMERGENCY
            assert node.stops_lost == 0
            assert "emergency stop is under way" in next(
                told["why"] for told in pilot.told if told.get("do") == "fly" and told["type"] == "refused"
            )
    kinds = [type(action) for action in node.flyer.applied]
    assert Velocity not in kinds[kinds.index(EmergencyStop) :]


def test_sticks_that_a_stop_overtakes_are_refused_and_the_stop_is_not(
    client: TestClient, node: Node, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A set-point under way was refused because of the stop, and the page reported the stop as refused."""
    asked: list[int] = []

    def overtaken(pilot: PilotConnection, first: int) -> Outcome | None:
        asked.append(first)
        if len(asked) > 1:
            return None
        return Outcome(pilot.app_id, first, Fate.REFUSED, Refusal.WRONG_STATE, "velocity refused: an emergency")

    with page(client) as pilot:
        pilot.take().take_off()
        pilot.say("fly", forward=0.5)
        until(lambda: node.flyer.state is FlightState.FLYING)
        pilot.say("stop", n=70)
        pilot.wait("done", do="stop")
        monkeypatch.setattr(PilotConnection, "refusal", overtaken)
        pilot.wait("refused")
        assert {told["do"] for told in pilot.told if told["type"] == "refused"} == {"fly"}


def test_a_refusal_to_a_page_does_not_repeat_the_pages_own_name(client: TestClient, node: Node) -> None:
    with page(client) as pilot:
        pilot.take()
        pilot.say("fly", forward=0.5)
        assert pilot.wait("refused", do="fly")["why"].startswith("velocity refused: velocity is not possible")


def test_a_stop_that_does_not_show_is_never_done_and_the_drone_hovers(
    client: TestClient, node: Node, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The page said "done" for a stop without any effect."""
    monkeypatch.setattr(station, "SHOWN_S", 0.5)
    with page(client) as pilot:
        pilot.take().take_off()
        with pilot.staying():
            pilot.say("fly", forward=0.5)
            until(lambda: node.flyer.state is FlightState.FLYING)
            node.stops_lost = 1000
            pilot.say("stop", n=71)
            pilot.wait("sent", do="stop", n=71)
            pilot.say("land")
            assert "under way" in pilot.wait("refused", do="land")["why"], "nothing takes its place meanwhile"
            assert "has not shown" in pilot.wait("refused", do="stop", n=71)["why"]
            until(lambda: node.flyer.applied[-1] == Hover(), "what it flew is not flown on")
            assert not [told for told in pilot.told if told["type"] == "done" and told["do"] == "stop"]
            pilot.say("land")
            pilot.wait("done", do="land")


def test_a_stop_of_all_silences_the_sticks_of_every_page(client: TestClient, node: Node) -> None:
    with page(client) as pilot, open_socket(client, "control") as socket:
        pilot.take().take_off()
        everybody = Page(socket)
        with sticks_held(pilot):
            until(lambda: node.flyer.state is FlightState.FLYING)
            node.stops_lost = 3
            everybody.say("stop_all")
            everybody.wait("each", drone="alpha", state="sent")
            everybody.wait("each", drone="alpha", state="done")
            assert node.flyer.state is FlightState.EMERGENCY
    assert count(node, EmergencyStop()) >= 1


def test_a_fault_in_a_session_does_not_prevent_a_stop(
    client: TestClient, node: Node, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(self: ControlSession, why: str) -> None:
        raise ZeroDivisionError(why)

    with page(client) as pilot, open_socket(client, "control") as socket:
        pilot.take().take_off()
        monkeypatch.setattr(ControlSession, "stand_down", fail)
        everybody = Page(socket)
        everybody.say("stop_all")
        everybody.wait("each", drone="alpha", state="done")
        assert node.flyer.state is FlightState.EMERGENCY


def test_a_stop_refused_by_the_vehicle_is_reported_with_its_reason(
    client: TestClient, node: Node, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(station, "SHOWN_S", 0.5)

    def refuse(action: AnyAction) -> AnyAction:
        if isinstance(action, EmergencyStop):
            raise DriverError("its motors can't be cut above 10 m")
        return obey(action)

    obey = node.flyer._apply
    with page(client) as pilot:
        pilot.take().take_off()
        with pilot.staying():
            monkeypatch.setattr(node.flyer, "_apply", refuse)
            pilot.say("stop", n=72)
            assert "above 10 m" in pilot.wait("refused", do="stop", n=72)["why"]
            pilot.say("land")
            pilot.wait("done", do="land")


def test_an_unsupported_stop_is_reported_at_once_and_the_drone_hovers(
    client: TestClient, node: Node, monkeypatch: pytest.MonkeyPatch
) -> None:
    def cannot(_: object) -> bool:
        raise UnsupportedError("emergency_stop is not possible: the vehicle cannot stop its motors")

    monkeypatch.setattr(PilotConnection, "emergency_stop", cannot)
    with page(client) as pilot:
        pilot.take().take_off()
        with pilot.staying():
            pilot.say("fly", forward=0.5)
            until(lambda: node.flyer.state is FlightState.FLYING)
            pilot.say("stop", n=73)
            assert "cannot stop its motors" in pilot.wait("refused", do="stop", n=73)["why"]
            until(lambda: node.flyer.applied[-1] == Hover())
