"""Flying from a page: a real proxy over the memory transport, and an obedient vehicle."""

from __future__ import annotations

import math
import threading
import time
from typing import Any

import pytest
from starlette.websockets import WebSocketDisconnect

from skyloop.client import AuthorityStatus, Drone
from skyloop.cockpit.commands import decode_command
from skyloop.cockpit.control_session import SILENT_S
from skyloop.cockpit.fleet import CockpitFleet
from skyloop.cockpit.station import PilotConnection
from skyloop.control import Controller
from skyloop.control.follow import FollowMarker
from skyloop.errors import DecodeError, RefusedError
from skyloop.messages import (
    EmergencyStop,
    Feedback,
    FlightState,
    Hover,
    Land,
    LinkState,
    Role,
    Takeoff,
    Velocity,
)
from tests.support.cockpit import Node, Nodes, cockpit, open_socket, this_user, until
from tests.support.cockpit_page import count, page
from tests.support.testclient import TestClient


def links() -> int:
    """Connections of this process to proxies."""
    return sum(thread.name == "skyloop-link" for thread in threading.enumerate())


def test_a_flight_from_the_page(client: TestClient, node: Node) -> None:
    with page(client) as pilot:
        assert pilot.wait("authority")["state"] == "none"
        told = pilot.take(7).told[-1]
        assert told["state"] == "held"
        assert told["priority"] == 7
        assert told["holder"].startswith("cockpit ")
        pilot.take_off()
        pilot.say("fly", forward=0.4, yaw_rate=-0.2)
        until(lambda: count(node, Velocity(forward=0.4, yaw_rate=-0.2)))
        pilot.say("hover")
        pilot.wait("done", do="hover")
        until(lambda: node.flyer.applied[-1] == Hover())
        pilot.say("land")
        pilot.wait("done", do="land")
        assert node.flyer.state is FlightState.LANDED
        pilot.say("release")
        assert pilot.wait("authority", mine=False)["holder"] is None
        pilot.say("ping", n=3)
        assert pilot.wait("pong")["n"] == 3
    assert node.flyer.applied[0] == Takeoff()
    assert count(node, Land())


def test_without_control_nothing_is_flown(client: TestClient, node: Node) -> None:
    with page(client) as pilot:
        for order in ("takeoff", "hover", "land", "reset"):
            pilot.say(order)
            assert pilot.wait("refused", do=order)["why"] == "take control first"
        pilot.say("goto", x=1, y=1, z=1)
        pilot.wait("refused", do="goto")
        pilot.say("set", name="limits.tilt", value=0.2)
        pilot.wait("refused", do="set")
        for _ in range(5):
            pilot.say("fly", forward=1.0)
        pilot.say("ping")
        pilot.wait("pong")
        assert sum(told.get("do") == "fly" for told in pilot.told) == 1, "sticks are not refused twenty times a second"
        assert not node.flyer.applied


@pytest.mark.parametrize(
    "text",
    [
        "",
        "[]",
        "{}",
        '{"do":"loop"}',
        '{"do":"take"}',
        '{"do":"take","priority":32}',
        '{"do":"take","priority":-1}',
        '{"do":"take","priority":1.5}',
        '{"do":"fly","forward":NaN}',
        '{"do":"fly","forward":"1"}',
        '{"do":"fly","sideways":1}',
        '{"do":"goto","x":1,"y":2}',
        '{"do":"set","name":"","value":1}',
        '{"do":"set","name":"a","value":{}}',
        "[" * 4000,
    ],
)
def test_nonsense_is_not_a_command(text: str) -> None:
    with pytest.raises(DecodeError, match="not understood"):
        decode_command(text)


def test_nonsense_is_refused_and_flies_nothing(client: TestClient, node: Node) -> None:
    with page(client) as pilot:
        pilot.take()
        pilot.socket.send_text("{")
        assert "not understood" in pilot.wait("refused")["why"]
        pilot.socket.send_text('{"do":"fly","forward":1e999}')
        pilot.wait("refused")
        pilot.socket.send_bytes(b"\xff\xfe")
        assert "not understood" in pilot.wait("refused")["why"]
        pilot.say("ping")
        pilot.wait("pong")
        assert not node.flyer.applied


def test_a_refusal_by_the_proxy_reaches_the_page_with_its_reason(client: TestClient, node: Node) -> None:
    with page(client) as pilot:
        pilot.take().say("fly", forward=0.5)
        assert "landed" in pilot.wait("refused", do="fly")["why"]
        pilot.say("reset")
        pilot.wait("done", do="reset")
        assert pilot.wait("refused", do="reset")["why"]


def test_a_silent_page_leaves_a_hovering_drone(client: TestClient, node: Node) -> None:
    with page(client) as pilot:
        pilot.take().take_off()
        begin = time.monotonic()
        for _ in range(3):
            pilot.say("fly", forward=0.4)
            pilot.say("ping")
        told = pilot.wait("refused", do="fly")
        assert "silent" in told["why"]
        assert SILENT_S * 0.9 < time.monotonic() - begin < SILENT_S + 0.4
        until(lambda: node.flyer.state is FlightState.HOVERING)
        pilot.say("fly", forward=0.3)
        until(lambda: count(node, Velocity(forward=0.3)), "a page that speaks again flies again")


def test_a_pre_empted_page_gets_no_message_about_silence(client: TestClient, node: Node) -> None:
    with page(client) as first, page(client) as second:
        first.take(10).take_off()
        first.say("fly", forward=0.3)
        second.take(5)
        first.wait("authority", state="preempted")
        second.say("fly", up=0.1)
        second.wait("refused", do="fly")  # the second page is the silent one: longer than the first could be
        first.say("ping")
        first.wait("pong")
        assert not [told for told in first.told if "silent" in (told.get("why") or "")]


def test_a_page_that_dies_in_flight_leaves_a_hovering_drone(client: TestClient, node: Node) -> None:
    with node.connect("watcher", access="observe") as watcher:
        with page(client) as pilot:
            pilot.take().take_off()
            pilot.say("fly", forward=0.4)
            until(lambda: node.flyer.state is FlightState.FLYING)
            hovers = count(node, Hover())
        until(lambda: count(node, Hover()) > hovers)
        watcher.wait(lambda feedback: feedback.owner is None, 5)
        watcher.wait("hovering", 5)  # the first sample without an owner may predate the vehicle's hover
        # The proxy's ladder then continues: no pilot is connected, so it lands.
        with node.connect("me") as owner:
            owner.config["failsafe.land_after_s"] = 0.1
        watcher.wait("landed", 5)


def test_emergency_stop_needs_no_authority(client: TestClient, node: Node) -> None:
    with node.connect("demo", priority=0, on_exit="hover") as demo:
        demo.takeoff()
        with page(client) as pilot:
            pilot.say("stop")
            pilot.wait("done", do="stop")
            until(lambda: node.flyer.state is FlightState.EMERGENCY)
            assert demo.authority.state == "held"
    assert count(node, EmergencyStop())


def test_emergency_stop_by_the_pilot(client: TestClient, node: Node) -> None:
    with page(client) as pilot:
        pilot.take().take_off()
        pilot.say("fly", forward=0.4)
        pilot.say("stop")
        pilot.wait("done", do="stop")
        until(lambda: node.flyer.state is FlightState.EMERGENCY)
        pilot.say("reset")
        pilot.wait("done", do="reset")
        until(lambda: node.flyer.state is FlightState.LANDED)


def test_flying_to_a_place(client: TestClient, node: Node) -> None:
    with page(client) as pilot:
        pilot.take().say("goto", x=0.3, y=-0.2, z=0.3, yaw=0.3)
        assert "take off first" in pilot.wait("refused", do="goto")["why"]
        pilot.take_off()
        with open_socket(client, "drones/alpha/telemetry") as telemetry:
            pilot.say("goto", x=0.3, y=-0.2, z=0.3, yaw=0.3)
            state: dict[str, Any] = {}
            while not state.get("waypoints"):
                state = telemetry.receive_json()
            assert state["waypoints"][0]["position"] == [0.3, -0.2, 0.3]
        with pilot.staying():
            pilot.wait("done", do="goto")
        assert math.dist(node.flyer.place, (0.3, -0.2, 0.3)) < 0.2
        assert node.flyer.yaw == pytest.approx(0.3, abs=0.15)
        until(lambda: node.flyer.state is FlightState.HOVERING)


def test_the_outcome_of_a_flight_to_a_place_carries_its_command_number(client: TestClient, node: Node) -> None:
    """The page mistook the result of an earlier one for the newest's: it hovered, or did not when released."""
    with page(client) as pilot:
        pilot.take().take_off()
        with pilot.staying():
            pilot.say("goto", x=0.3, y=0.0, z=0.3, n=71)
            assert pilot.wait("done", do="goto")["n"] == 71
        pilot.say("goto", x=2.0, y=0.0, z=0.3, n=72)
        pilot.say("goto", x=3.0, y=0.0, z=0.3, n=73)
        refused = pilot.wait("refused", do="goto")
        assert (refused["n"], "silent" in refused["why"]) == (73, True)


def test_returning_to_the_start(client: TestClient, node: Node) -> None:
    with page(client) as pilot:
        pilot.take().say("return")
        assert "take off first" in pilot.wait("refused", do="return")["why"]
        pilot.say("set", name="return.height", value=0.0)
        pilot.wait("done", do="set")
        pilot.take_off()
        pilot.say("goto", x=1.2, y=0.3, z=0.5)
        with pilot.staying():
            pilot.wait("done", do="goto")
        pilot.say("return")
        assert "silent" in pilot.wait("refused", do="return")["why"]
        until(lambda: node.flyer.state is FlightState.HOVERING)
        with open_socket(client, "drones/alpha/telemetry") as telemetry:
            pilot.say("return")
            state: dict[str, Any] = {}
            while [goal["position"] for goal in state.get("waypoints", [])] != [[0.0, 0.0, 0.0]]:
                state = telemetry.receive_json()
            assert state["start"] == [0.0, 0.0, 0.0]
        with pilot.staying():
            pilot.wait("done", do="return")
        until(lambda: node.flyer.state is FlightState.LANDED)
        assert math.dist(node.flyer.place[:2], (0.0, 0.0)) < 0.4


def test_a_page_that_falls_silent_on_the_way_stops_there(client: TestClient, node: Node) -> None:
    with page(client) as pilot:
        pilot.take().take_off()
        pilot.say("goto", x=50, y=0, z=1)
        assert "silent" in pilot.wait("refused", do="goto")["why"]
        until(lambda: node.flyer.state is FlightState.HOVERING)
        assert node.flyer.place[0] < 2.0


def test_sticks_end_the_way_to_a_place(client: TestClient, node: Node) -> None:
    with page(client) as pilot:
        pilot.take().take_off()
        pilot.say("goto", x=50, y=0, z=1)
        until(lambda: node.flyer.state is FlightState.FLYING)
        pilot.say("fly", left=0.1)
        until(lambda: count(node, Velocity(left=0.1)))
        pilot.say("hover")
        until(lambda: node.flyer.applied[-1] == Hover())
        pilot.say("ping")
        pilot.wait("pong")
        assert node.flyer.applied[-1] == Hover()


def test_a_place_refused_by_the_proxy_is_reported_with_its_reason(client: TestClient, node: Node) -> None:
    with page(client) as pilot:
        pilot.take().take_off()
        pilot.say("set", name="safety.box.x_high", value=2.0)
        pilot.wait("done", do="set")
        pilot.say("goto", x=3, y=0, z=1)
        assert "outside the safety box" in pilot.wait("refused", do="goto")["why"]
        until(lambda: node.flyer.state is FlightState.HOVERING)
        pilot.say("goto", x=0.5, y=0, z=0.3)
        with pilot.staying():
            pilot.wait("done", do="goto")


@pytest.mark.parametrize(("said", "method"), [("reset", "reset_emergency"), ("fly", "velocity")])
def test_a_refused_replacement_of_a_flight_leaves_it_hovering(
    client: TestClient, node: Node, monkeypatch: pytest.MonkeyPatch, said: str, method: str
) -> None:
    """The place stayed in force, but the page no longer watched the flight there."""
    with page(client) as pilot:
        pilot.take().take_off()
        pilot.say("goto", x=50, y=0, z=1)
        until(lambda: node.flyer.state is FlightState.FLYING)

        def refuse(self: PilotConnection, **_: float) -> bool:
            raise RefusedError("not now")

        monkeypatch.setattr(PilotConnection, method, refuse)
        with pilot.staying():
            pilot.say(said)
            assert pilot.wait("refused", do=said)["why"] == "not now"
            until(lambda: node.flyer.state is FlightState.HOVERING)


def test_a_flight_stays_watched_after_a_command_that_replaced_nothing(client: TestClient, node: Node) -> None:
    """The proxy's refusal was taken for older than the newest command, which had flown nothing."""
    with page(client) as pilot:
        pilot.take().take_off()
        pilot.say("goto", x=50, y=0, z=1)
        until(lambda: node.flyer.state is FlightState.FLYING)
        with pilot.staying():
            pilot.say("route_skip")
            assert "not flying a route" in pilot.wait("refused", do="route_skip")["why"]
            pilot.say("set", name="safety.box.x_high", value=20.0)
            assert "outside the safety box" in pilot.wait("refused", do="goto")["why"]
        until(lambda: node.flyer.state is FlightState.HOVERING)


def test_a_flight_ended_by_something_else_is_reported(client: TestClient, node: Node) -> None:
    with page(client) as pilot:
        pilot.take().take_off()
        pilot.say("goto", x=50, y=0, z=1)
        until(lambda: node.flyer.state is FlightState.FLYING)
        with pilot.staying():
            node.flyer.link(LinkState.LOST)
            pilot.wait("refused", do="goto")
            node.flyer.link(LinkState.UP)
        until(lambda: node.flyer.state is FlightState.HOVERING)
        assert node.flyer.place[0] < 40.0


def test_no_place_without_a_position() -> None:
    blind = Node(position=False)
    try:
        with cockpit(CockpitFleet(Nodes(blind))) as client, page(client) as pilot:
            pilot.take().say("goto", x=1, y=1, z=1)
            assert "does not report its position" in pilot.wait("refused", do="goto")["why"]
    finally:
        blind.stop()


def test_parameters_are_read_written_and_refused(client: TestClient, node: Node) -> None:
    listed = {one["name"]: one for one in client.get("/api/drones/alpha/parameters").json()}
    tilt = listed["limits.tilt"]
    assert (tilt["type"], tilt["unit"], tilt["minimum"], tilt["maximum"]) == ("float", "rad", 0.02, 1.0)
    assert (tilt["default"], tilt["read_only"], tilt["choices"]) == (0.35, False, [])
    assert "tilt" in tilt["description"]
    assert client.get("/api/drones/beta/parameters").status_code == 404
    with page(client) as pilot:
        pilot.take().say("set", name="limits.tilt", value=0.2)
        assert pilot.wait("done", do="set") == {"type": "done", "do": "set", "name": "limits.tilt", "value": 0.2}
        pilot.say("set", name="limits.tilt", value=9)
        assert "at most" in pilot.wait("refused", do="set")["why"]
        pilot.say("set", name="limits.tilt", value="steep")
        pilot.wait("refused", do="set")
        pilot.say("set", name="limits.tlt", value=1)
        assert "did you mean 'limits.tilt'" in pilot.wait("refused", do="set")["why"]
    listed = {one["name"]: one for one in client.get("/api/drones/alpha/parameters").json()}
    assert listed["limits.tilt"]["value"] == 0.2


# Authority ------------------------------------------------------------------------------------------------------


def test_a_lower_priority_is_refused_and_takes_nothing(client: TestClient, node: Node) -> None:
    with node.connect("demo", priority=4) as demo, page(client) as pilot:
        assert not pilot.wait("authority", holder="demo", priority=4, state="none")["mine"]
        pilot.say("take", priority=4)
        assert "demo has control with priority 4" in pilot.wait("refused", do="take")["why"]
        assert demo.authority.state == "held"
        pilot.take(3)
        assert demo.wait(lambda feedback: feedback.owner != "demo", 5).owner_priority == 3


def test_a_pre_empted_page_is_notified_and_gets_control_back(client: TestClient, node: Node) -> None:
    with page(client) as first, page(client) as second:
        first.take(10).take_off()
        first.say("fly", forward=0.3)
        until(lambda: node.flyer.state is FlightState.FLYING)
        second.take(5)
        told = first.wait("authority", mine=False, state="preempted", priority=5)  # once the feedback names the holder
        assert told["holder"].startswith("cockpit")
        until(lambda: node.flyer.state is FlightState.HOVERING, "it hovers before it changes hands")
        first.say("fly", forward=0.3)
        assert "has control" in first.wait("refused", do="fly")["why"]
        second.say("release")
        first.wait("authority", mine=True)
        assert node.flyer.applied[-1] != Velocity(forward=0.3), "nothing old is resumed by itself"
        first.say("fly", forward=0.2)
        until(lambda: count(node, Velocity(forward=0.2)))


class Turning(Controller):
    """Turns all the time, and remembers its notifications."""

    def __init__(self, drone: Drone) -> None:
        super().__init__(drone)
        self.told: list[AuthorityStatus] = []

    def on_feedback(self, feedback: Feedback) -> None:
        self.drone.velocity(yaw_rate=0.25)

    def on_authority(self, status: AuthorityStatus) -> None:
        self.told.append(status)


class Following(FollowMarker):
    """The demo's controller, which sees no marker here and searches."""

    def __init__(self, drone: Drone) -> None:
        super().__init__(drone)
        self.told: list[AuthorityStatus] = []

    def on_authority(self, status: AuthorityStatus) -> None:
        self.told.append(status)


@pytest.mark.parametrize("kind", [Turning, Following])
def test_a_controller_is_notified_of_a_takeover_and_continues_afterwards(
    client: TestClient, node: Node, kind: type[Turning | Following]
) -> None:
    with node.connect("demo") as drone, page(client) as pilot:
        drone.takeoff()
        controller = kind(drone)
        running = threading.Thread(target=controller.run)
        running.start()
        try:
            until(lambda: node.flyer.state is FlightState.FLYING)
            pilot.take(4)
            until(lambda: controller.told, "the controller was told")
            assert controller.told[0].state == "preempted"
            assert controller.told[0].holder == pilot.told[-1]["holder"]
            pilot.say("hover")
            pilot.wait("done", do="hover")
            until(lambda: node.flyer.state is FlightState.HOVERING)
            taken = len(node.flyer.applied)
            pilot.say("fly", up=0.1)
            until(lambda: count(node, Velocity(up=0.1)))
            others = {type(action) for action in node.flyer.applied[taken:] if action != Velocity(up=0.1)}
            assert others <= {Hover}, "the controller's commands are refused meanwhile"
            pilot.say("release")
            until(lambda: len(controller.told) == 2, "the controller was told again")
            assert controller.told[1].state == "held"
            until(lambda: node.flyer.state is FlightState.FLYING, "it flies on")
            assert running.is_alive()
        finally:
            controller.stop()
            running.join(5)
        assert not running.is_alive()
        drone.wait(lambda feedback: feedback.owner == "demo", 5)


def test_a_controller_that_ends_while_a_person_flies_leaves_the_drone_to_the_person(
    client: TestClient, node: Node
) -> None:
    with page(client) as pilot:
        with node.connect("demo") as drone:
            drone.takeoff()
            controller = Turning(drone)
            running = threading.Thread(target=controller.run)
            running.start()
            until(lambda: node.flyer.state is FlightState.FLYING)
            pilot.take(4)
            until(lambda: controller.told)
            controller.stop()
            running.join(5)
        pilot.say("fly", up=0.1)
        until(lambda: count(node, Velocity(up=0.1)))
        assert not count(node, Land())


# Lost and found -------------------------------------------------------------------------------------------------


def test_after_a_proxys_death_the_person_must_take_control_again(client: TestClient, node: Node) -> None:
    with page(client) as pilot, open_socket(client, "drones/alpha/telemetry") as telemetry, pilot.staying():
        pilot.take()
        node.stop()
        told = pilot.wait("authority", mine=False, state="none", holder=None)
        assert "nobody has control" in told["why"]
        assert "unknown" in told["why"]
        message: dict[str, Any] = {"type": ""}
        while message["type"] != "state" or message["links"]["application"] != "lost":
            message = telemetry.receive_json()
        assert message["alarms"][0]["text"].startswith("link to the proxy lost")
        assert message["set_points"] is None, "what is applied now is not known"
        pilot.say("takeoff")
        pilot.wait("refused", do="takeoff")
        pilot.say("take", priority=4)
        assert "link to the proxy is lost" in pilot.wait("refused", do="take")["why"]
        node.restart()
        while message["type"] != "state" or message["links"]["application"] != "up":
            message = telemetry.receive_json()
        told = pilot.wait("authority", mine=False)
        assert "did meanwhile is unknown" in told["why"]
        with node.connect("witness", access="observe") as witness:
            for _ in range(20):
                assert witness.next_feedback().owner is None, "control does not come back by itself"
        pilot.take()
        assert pilot.told[-1]["why"] is None
        pilot.take_off()


def test_a_stop_over_a_lost_link_says_so(client: TestClient, node: Node) -> None:
    with node.connect("watcher", access="observe") as watcher, page(client) as pilot:
        until(lambda: any("cockpit stop connected" in event.text for event in watcher.recent_events()))
        for _ in range(3):
            watcher.next_feedback()
        node.stop()
        pilot.say("stop", at_s=time.monotonic() - 1.5)
        assert "not sent" in pilot.wait("refused", do="stop")["why"]


def test_a_refusal_is_reported_once_and_nothing_happens_later(client: TestClient, node: Node) -> None:
    with page(client) as pilot, node.connect("watcher", access="observe") as watcher:
        pilot.take().say("stop")
        watcher.wait("emergency", 5)
        pilot.wait("done", do="stop")
        stops = -1
        while stops != (stops := count(node, EmergencyStop())):  # a repeat still under way would stop it again
            for _ in range(10):
                watcher.next_feedback()
        pilot.say("takeoff")
        assert "emergency" in pilot.wait("refused", do="takeoff")["why"]
        node.flyer.state = FlightState.LANDED
        watcher.wait("landed", 5)
        pilot.say("ping")
        pilot.wait("pong")
        assert watcher.next_feedback().state is FlightState.LANDED
        assert not count(node, Takeoff())
        assert sum((told["type"], told.get("do")) == ("refused", "takeoff") for told in pilot.told) == 1


def test_an_observer_gets_no_controls(node: Node) -> None:
    with (
        cockpit(CockpitFleet(Nodes(node)), this_user(Role.OBSERVER)) as client,
        open_socket(client, "drones/alpha/control") as socket,
    ):
        socket.send_json({"do": "take", "priority": 0})
        socket.send_json({"do": "stop"})
        with pytest.raises(WebSocketDisconnect) as ended:
            socket.receive_json()
        assert ended.value.code == 4403
    assert not node.flyer.applied


def test_pilot_connections_are_released(client: TestClient, node: Node) -> None:
    with node.connect("watcher", access="observe") as watcher:
        before = links()
        with page(client) as pilot:
            pilot.take()
            pilot.say("release")
            pilot.wait("done", do="release")
        until(lambda: links() == before, "no thread is left")

        def gone() -> int:
            return sum("ended" in event.text for event in watcher.recent_events())

        until(lambda: gone() == 2, "the pilot's connection is gone, and the one for emergency stops")
