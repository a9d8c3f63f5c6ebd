"""Land all, stop all: from any pilot's page, with any drone open and any pilot flying."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager

import pytest
from starlette.websockets import WebSocketDisconnect

from skyloop.client import Drone
from skyloop.cockpit.discovery import FoundProxy
from skyloop.cockpit.fleet import CockpitFleet, observe
from skyloop.errors import LinkError
from skyloop.messages import EmergencyStop, FlightState, Land, Role
from tests.support.cockpit import Node, Nodes, cockpit, open_socket, this_user, until
from tests.support.cockpit_page import Page, count, page
from tests.support.testclient import TestClient


@pytest.fixture
def nodes() -> Iterator[tuple[Node, Node]]:
    nodes = Node("alpha"), Node("beta")
    yield nodes
    for node in nodes:
        node.stop()


@contextmanager
def everybody(client: TestClient) -> Iterator[Page]:
    with open_socket(client, "control") as socket:
        yield Page(socket)


def test_stop_all_cuts_the_motors_of_drones_that_no_page_shows(nodes: tuple[Node, Node]) -> None:
    with (
        cockpit(CockpitFleet(Nodes(*nodes), search_s=0.05)) as client,
        everybody(client) as pilot,
        nodes[0].connect("demo", priority=0, on_exit="hover") as demo,
    ):
        demo.takeoff()
        pilot.say("stop_all", n=4)
        assert pilot.wait("sent", do="stop_all", n=4)["drones"] == ["alpha", "beta"]
        told = {pilot.wait("each", do="stop_all", state="sent")["drone"] for _ in nodes}
        assert told == {"alpha", "beta"}
        until(lambda: all(node.flyer.state is FlightState.EMERGENCY for node in nodes))


@pytest.mark.parametrize("do", ["stop_all", "land_all"])
def test_unreachable_drones_are_reported_as_not_stopped(nodes: tuple[Node, Node], do: str) -> None:
    """It was left out, and all seemed to be stopped."""

    def connect(found: FoundProxy) -> Drone:
        if found.name == "beta":
            raise LinkError("beta does not answer")
        return observe(found)

    fleet = CockpitFleet(Nodes(*nodes), connect, search_s=0.05)
    with cockpit(fleet) as client, everybody(client) as pilot:
        until(lambda: fleet.problems)
        pilot.say(do)
        assert pilot.wait("sent", do=do)["drones"] == ["alpha", "beta"]
        assert pilot.wait("each", drone="beta", state="refused")["why"]
        pilot.wait("each", drone="alpha", state="done")


def test_land_all_lands_what_others_fly_and_gives_control_back(nodes: tuple[Node, Node]) -> None:
    alpha, beta = nodes
    with (
        cockpit(CockpitFleet(Nodes(*nodes), search_s=0.05)) as client,
        everybody(client) as pilot,
        alpha.connect("demo", on_exit="hover") as demo,
        page(client, "beta") as flies,
    ):
        demo.takeoff()
        flies.take(8).take_off()
        pilot.say("land_all")
        assert {pilot.wait("each", state="done")["drone"] for _ in nodes} == {"alpha", "beta"}
        assert [node.flyer.state for node in nodes] == [FlightState.LANDED] * 2
        demo.wait(lambda feedback: feedback.owner == "demo", 5)
        assert count(alpha, Land())
        assert count(beta, Land())


def test_drones_that_do_not_land_are_reported_with_the_reason(nodes: tuple[Node, Node]) -> None:
    alpha, beta = nodes
    with (
        cockpit(CockpitFleet(Nodes(*nodes), search_s=0.05)) as client,
        everybody(client) as pilot,
        alpha.connect("demo", priority=0, on_exit="hover") as demo,
        beta.connect("other", on_exit="hover") as other,
    ):
        demo.takeoff()
        other.takeoff()
        pilot.say("land_all")
        assert "demo" in pilot.wait("each", drone="alpha", state="refused")["why"]
        pilot.wait("each", drone="beta", state="done")


def test_a_drone_whose_motors_are_being_stopped_is_not_landed(nodes: tuple[Node, Node]) -> None:
    """The landing took the authority during the stop, and a vehicle that had not received the stop obeyed it."""
    fleet = CockpitFleet(Nodes(*nodes), search_s=0.05)
    with cockpit(fleet) as client, everybody(client) as pilot:
        until(lambda: len(fleet.stations) == 2)
        fleet.stations["alpha"]._stops = 1
        pilot.say("land_all")
        assert "emergency stop" in pilot.wait("each", drone="alpha", state="refused")["why"]
        pilot.wait("each", drone="beta", state="done")


def test_landing_all_continues_without_the_page(nodes: tuple[Node, Node]) -> None:
    with (
        cockpit(CockpitFleet(Nodes(*nodes), search_s=0.05)) as client,
        nodes[0].connect("demo", on_exit="hover") as demo,
    ):
        demo.takeoff()
        with everybody(client) as pilot:
            pilot.say("land_all")
            pilot.wait("sent", do="land_all")
        until(lambda: nodes[0].flyer.state is FlightState.LANDED)


def test_old_commands_to_all_are_refused(nodes: tuple[Node, Node]) -> None:
    with cockpit(CockpitFleet(Nodes(*nodes), search_s=0.05)) as client, everybody(client) as pilot:
        pilot.say("stop_all", at_s=time.monotonic() - 3.0)
        assert "3.0 s after" in pilot.wait("refused", do="stop_all")["why"]
        pilot.say("land_all", at_s=time.monotonic() - 1.0)
        pilot.wait("refused", do="land_all")
        pilot.socket.send_text('{"do":"takeoff"}')
        assert "not understood" in pilot.wait("refused", do="")["why"]
        pilot.say("ping", n=3)
        assert pilot.wait("pong", n=3)["now_s"] <= time.monotonic()
        assert not any(count(node, EmergencyStop()) for node in nodes)


def test_a_recording_is_not_landed_or_stopped(node: Node) -> None:
    played = Node("played", uri="replay:///home/me/flight.mcap")
    try:
        with cockpit(CockpitFleet(Nodes(node, played), search_s=0.05)) as client, everybody(client) as pilot:
            pilot.say("stop_all")
            assert pilot.wait("sent")["drones"] == ["alpha"]
            until(lambda: node.flyer.state is FlightState.EMERGENCY)
            assert not played.flyer.applied
    finally:
        played.stop()


def test_an_observer_cannot_stop_drones(nodes: tuple[Node, Node]) -> None:
    with (
        cockpit(CockpitFleet(Nodes(*nodes)), this_user(Role.OBSERVER)) as client,
        open_socket(client, "control") as socket,
    ):
        socket.send_json({"do": "stop_all", "at_s": time.monotonic()})
        with pytest.raises(WebSocketDisconnect) as ended:
            socket.receive_json()
        assert ended.value.code == 4403
    assert not any(node.flyer.applied for node in nodes)
