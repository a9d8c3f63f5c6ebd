"""A page's last command counts, and the cockpit never takes a drone from others automatically."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import pytest

from skyloop.client.parameters import Config
from skyloop.cockpit.commands import LATE_S, UNTOUCHED_S, Fly, HandWatch
from skyloop.cockpit.control_session import GONE_S
from skyloop.cockpit.fleet import CockpitFleet
from skyloop.messages import Failsafe, FlightState, Hover, Land, Position, Velocity
from tests.cockpit.follower import StandIns
from tests.support.cockpit import ORIGIN, Node, Nodes, cockpit, until
from tests.support.cockpit_page import BOX, FORWARD, Marker, Page, count, page
from tests.support.testclient import TestClient

FAR = {"name": "far", "speed": 1.0, "waypoints": [{"x": 30.0, "y": 0.0, "z": 1.0}]}


@pytest.fixture
def client(node: Node) -> Iterator[TestClient]:
    with cockpit(CockpitFleet(Nodes(node), search_s=0.05), follower=StandIns()) as client:
        client.headers.update(ORIGIN)
        yield client


@contextmanager
def slow_parameters(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[], None]]:
    """Delay the list of parameters like a slow network; the result waits until it is requested."""
    asked, go_on = threading.Event(), threading.Event()

    def slow(real: Callable[[Config], object]) -> Callable[[Config], object]:
        def read(config: Config) -> object:
            asked.set()
            go_on.wait(5)
            return real(config)

        return read

    with monkeypatch.context() as patch:
        patch.setattr(Config, "items", slow(Config.items))
        patch.setattr(Config, "parameters", slow(Config.parameters))

        def until_asked() -> None:
            assert asked.wait(5)

        try:
            yield until_asked
            go_on.set()
        finally:
            go_on.set()


@pytest.mark.parametrize("newer", ["hover", "land", "fly"])
def test_following_a_target_that_waits_for_answers_does_not_override_later_presses(
    client: TestClient, node: Node, newer: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A landing was broken off by a target that was marked before it."""
    with page(client) as first:
        pilot = Marker(first)
        pilot.take().take_off()
        with pilot.staying():
            pilot.select()
            with slow_parameters(monkeypatch) as until_asked:
                pilot.say("follow", camera="front", captured_ns=str(pilot.since_ns), box=BOX, mode="follow")
                until_asked()
                pilot.say(newer)
                if newer == "fly":
                    until(lambda: count(node, Velocity()))
                else:
                    pilot.wait("sent", do=newer)
            assert "another command was given" in pilot.wait("refused", do="follow")["why"]
            assert not count(node, FORWARD)


@pytest.mark.parametrize("newer", ["hover", "land", "goto"])
def test_a_route_still_being_checked_does_not_override_later_presses(
    client: TestClient, node: Node, newer: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    with page(client) as pilot:
        pilot.take().take_off()
        number = client.post("/api/drones/alpha/route/check", json=FAR).json()["id"]
        with pilot.staying():
            with slow_parameters(monkeypatch) as until_asked:
                pilot.say("route", id=number)
                until_asked()
                pilot.say(newer, **({"x": 0.1, "y": 0.0, "z": 0.3} if newer == "goto" else {}))
                pilot.wait("sent", do=newer)
            why = pilot.wait("refused", do="route")["why"]
            assert "another command was given" in why
            assert node.flyer.place[0] < 1.0


def test_following_a_target_does_not_start_if_the_answers_took_too_long(
    client: TestClient, node: Node, monkeypatch: pytest.MonkeyPatch
) -> None:
    with page(client) as first:
        pilot = Marker(first)
        pilot.take().take_off()
        with pilot.staying():
            pilot.select()
            with slow_parameters(monkeypatch) as until_asked:
                pilot.say("follow", camera="front", captured_ns=str(pilot.since_ns), box=BOX, mode="follow")
                until_asked()
                time.sleep(LATE_S + 0.1)
            assert "after it was requested" in pilot.wait("refused", do="follow")["why"]
            assert not count(node, FORWARD)


def test_a_page_that_was_away_meanwhile_flies_no_route(
    client: TestClient, node: Node, monkeypatch: pytest.MonkeyPatch
) -> None:
    with page(client) as pilot:
        pilot.take().take_off()
        number = client.post("/api/drones/alpha/route/check", json=FAR).json()["id"]
        with slow_parameters(monkeypatch) as until_asked:
            pilot.say("route", id=number)
            until_asked()
            pilot.say("hover", automatic=True)
            pilot.wait("sent", do="hover")
        assert "the page was silent" in pilot.wait("refused", do="route")["why"]


# Undecided -------------------------------------------------------------------------------------------------------


def go_to(client: TestClient, pilot: Page) -> None:
    pilot.say("goto", x=30, y=0, z=1)


def fly_a_route(client: TestClient, pilot: Page) -> None:
    number = client.post("/api/drones/alpha/route/check", json=FAR).json()["id"]
    pilot.say("route", id=number)


def follow(client: TestClient, pilot: Page) -> None:
    marker = Marker(pilot)
    marker.mark(mode="follow")


def steer(client: TestClient, pilot: Page) -> None:
    pilot.say("fly", forward=0.4)


FLIGHTS = pytest.mark.parametrize("begin", [go_to, fly_a_route, follow, steer])


@FLIGHTS
@pytest.mark.parametrize("leaves", [False, True])
def test_a_safety_pilot_who_chooses_another_mode_keeps_the_drone(
    client: TestClient, node: Node, begin: Callable[[TestClient, Page], None], *, leaves: bool
) -> None:
    """The page's go-to or route, or the closed page, took it back 0.6 s later with its own hover."""
    with page(client) as pilot, node.connect("watcher", access="observe") as watcher:
        pilot.take().take_off()
        with pilot.staying():
            begin(client, pilot)
            until(lambda: node.flyer.state is FlightState.FLYING)
            node.flyer.others = "RTL"
            watcher.wait(lambda feedback: feedback.others is not None, 5)
            if begin is steer:
                pilot.say("hover", automatic=True)  # the page's sticks are released
                pilot.wait("sent", do="hover")
            if not leaves:
                begun_s = time.monotonic()
                watcher.wait(lambda _: time.monotonic() - begun_s > 1.0, 5)
    if leaves:
        watcher_gone = node.connect("later", access="observe")
        with watcher_gone as later:
            later.wait(lambda feedback: feedback.owner is None, 5)
    assert node.flyer.taken == []
    assert node.flyer.others == "RTL"


@pytest.mark.parametrize("begin", [go_to, follow])
def test_a_page_that_pings_without_receiving_flies_nothing(
    client: TestClient, node: Node, begin: Callable[[TestClient, Page], None]
) -> None:
    """It followed its target without end: each report of the tracker was a new command of a silent pilot."""
    with page(client) as pilot:
        pilot.take().take_off()
        heard_s = time.monotonic()
        begin(client, pilot)
        until(lambda: node.flyer.state is FlightState.FLYING)
        until_s = heard_s + GONE_S + 0.5
        while Hover() not in node.flyer.applied and time.monotonic() < until_s:
            pilot.say("ping", seen_s=heard_s)  # no pong since
            time.sleep(0.05)
        assert Hover() in node.flyer.applied
        at = len(node.flyer.applied)
        for _ in range(10):
            pilot.say("ping", seen_s=heard_s)
            time.sleep(0.05)
        assert not any(isinstance(action, Velocity) for action in node.flyer.applied[at:][1:])


def test_a_person_takes_control_back(client: TestClient, node: Node) -> None:
    with page(client) as pilot, node.connect("watcher", access="observe") as watcher:
        pilot.take().take_off()
        pilot.say("fly", forward=0.4)
        until(lambda: node.flyer.state is FlightState.FLYING)
        node.flyer.others = "LOITER"
        watcher.wait(lambda feedback: feedback.others is not None, 5)
        pilot.say("hover")
        until(lambda: node.flyer.taken == [Hover()])


@pytest.mark.parametrize("begin", [go_to, fly_a_route, follow])
def test_a_low_battery_return_is_ended_only_by_a_person(
    client: TestClient, node: Node, begin: Callable[[TestClient, Page], None]
) -> None:
    """The end of a go-to or a route, or a closing tab, made it hover until its battery was empty."""
    with node.connect("watcher", access="observe") as watcher:
        with page(client) as pilot:
            pilot.take().say("set", name="battery.return", value=0.5)
            pilot.wait("done", do="set")
            pilot.take_off()
            with pilot.staying():
                begin(client, pilot)
                until(lambda: node.flyer.place[0] > 0.8)
                node.flyer.battery = 0.4
                watcher.wait(lambda feedback: feedback.failsafe is Failsafe.LAND, 5)
                at = len(node.flyer.applied)
                until(lambda: len(node.flyer.applied) > at + 5)
        watcher.wait("landed", 20)
    assert abs(node.flyer.place[0]) < 0.6, "at its start"
    assert Hover() not in node.flyer.applied[at:]
    assert not any(isinstance(action, Position) for action in node.flyer.applied[at:])
    assert count(node, Land())


# Hands -------------------------------------------------------------------------------------------------------------


def test_untouched_sticks_count_as_released() -> None:
    watch = HandWatch()
    held = Fly(forward=0.5, touches=7)

    def flies(sticks: Fly, from_s: float, for_s: float) -> list[bool]:
        return [watch.holds(sticks, from_s + step * 0.05) for step in range(round(for_s / 0.05))]

    assert all(flies(held, 0.0, UNTOUCHED_S - 0.1))
    assert not any(flies(held, UNTOUCHED_S + 0.1, 30.0)[1:]), "as a gamepad whose radio link broke"
    at_s = UNTOUCHED_S + 30.1
    assert all(flies(Fly(forward=0.5, touches=8), at_s, 1.0)), "a hand is there again"
    trembling = [watch.holds(Fly(forward=1.0, touches=step // 100), at_s + step * 0.05) for step in range(2000)]
    assert all(trembling), "at the stick's end for 100 s, and a sign of the hand every 5 s"
    at_s += 120.0
    assert not watch.holds(Fly(forward=1.0, touches=19), at_s), "a network that paused is no hand"
    assert watch.holds(Fly(forward=1.0, touches=20), at_s + 1.0), "let go, and pushed again"
    assert all(flies(Fly(forward=0.5), at_s, 60.0)), "a program without hands"


def test_a_page_whose_sticks_no_hand_moves_hovers(
    client: TestClient, node: Node, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("skyloop.cockpit.commands.UNTOUCHED_S", 0.3)
    with page(client) as pilot:
        pilot.take().take_off()
        hovers, deadline = count(node, Hover()), time.monotonic() + 5
        while count(node, Hover()) == hovers:
            assert time.monotonic() < deadline
            pilot.say("fly", forward=0.4, touches=3)
            time.sleep(0.03)
        assert "no hand has moved" in pilot.wait("refused", do="fly")["why"]
        pilot.say("fly", forward=0.4, touches=4)
        until(lambda: node.flyer.state is FlightState.FLYING)
