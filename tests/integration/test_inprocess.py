"""Client, transport and proxy in one process, with a vehicle that obeys commands at once."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest

from skyloop.client import Authority, Drone, Frame
from skyloop.client.drone import open_drone
from skyloop.control import Controller
from skyloop.errors import AuthorityError, ParameterError, UnknownNameError, UnsupportedError
from skyloop.messages import (
    Applied,
    Attitude,
    Command,
    Event,
    EventKind,
    Failsafe,
    Feedback,
    FlightState,
    Hello,
    Hover,
    Land,
    LinkState,
    Request,
    Takeoff,
    Velocity,
    encode,
)
from skyloop.proxy.core.flight import BELIEF_NS
from skyloop.proxy.proxy import Proxy
from skyloop.transport.base import video
from tests.support.fake_vehicle import WAIT_S, FakeVehicle, Node, node
from tests.support.systems import STEP_NS

__all__ = ["node"]  # a fixture


@contextmanager
def connected(
    node: Node, app: str = "me", *, priority: int = 16, wait_s: float = 0.0, **options: Any
) -> Iterator[Drone]:
    with open_drone(
        node.server.dial, app=app, **options, authority=Authority(priority=priority, wait_s=wait_s)
    ) as drone:
        yield drone


@pytest.fixture
def drone(node: Node) -> Iterator[Drone]:
    with connected(node) as drone:
        yield drone


def applied(node: Node, action: object) -> bool:
    return action in list(node.vehicle.applied)


def test_a_flight_and_the_landing_at_its_end(node: Node) -> None:
    with connected(node) as drone:
        drone.takeoff()
        assert drone.feedback().state is FlightState.HOVERING
        assert drone.feedback().owner == "me"
        assert drone.velocity(forward=0.5)
        drone.wait("flying", WAIT_S)
        assert drone.attitude(pitch=0.1)
        drone.wait(lambda _: applied(node, Attitude(pitch=0.1)), WAIT_S)
        assert applied(node, Velocity(forward=0.5))
    assert node.vehicle.applied[0] == Takeoff()
    assert node.vehicle.applied[-1] == Land()
    assert node.vehicle.state is FlightState.LANDED


def test_a_controller_flies_by_its_camera(node: Node, drone: Drone) -> None:
    class Turning(Controller):
        turned = 0

        def on_frame(self, frame: Frame) -> None:
            assert int(frame[0, 0, 0]) > 0
            assert frame.age_s < 1.0
            self.drone.velocity(yaw_rate=0.2)
            self.turned += 1

    drone.takeoff()
    controller = Turning(drone)
    summary = controller.run(seconds=WAIT_S, until=lambda: controller.turned == 10)
    assert summary.frames == 10
    assert applied(node, Velocity(yaw_rate=0.2))


def test_a_frame_knows_the_state_at_its_capture(node: Node, drone: Drone) -> None:
    frame = drone.next_frame(timeout_s=WAIT_S)
    drone.wait(lambda feedback: feedback.captured_ns > frame.captured_ns, WAIT_S)
    assert frame.feedback is not None
    assert frame.feedback_reach_s is not None
    assert frame.feedback_reach_s < 0.5
    assert frame.feedback.yaw_rad is not None
    frames_of_yaw = frame.feedback.yaw_rad / 0.01
    assert frames_of_yaw % 256 == pytest.approx(int(frame[0, 0, 0]), abs=0.01), "the picture and the state disagree"


def test_parameters(node: Node, drone: Drone) -> None:
    drone.config["limits.tilt"] = 0.2
    assert drone.config["limits.tilt"] == 0.2
    assert node.proxy.parameters.get("limits.tilt").value == 0.2
    with pytest.raises(ParameterError) as error:
        drone.config["limits.tilt"] = 7.0
    assert error.value.code == "out_of_range"
    with pytest.raises(ParameterError, match="float"):
        drone.config["limits.tilt"] = "steep"
    with pytest.raises(ParameterError, match="finite"):
        drone.config["limits.tilt"] = float("nan")
    with pytest.raises(UnknownNameError, match=r"did you mean 'limits\.tilt'"):
        drone.config["limits.tlt"] = 0.1
    assert {"limits.tilt", "command.max_age_s"} <= set(drone.config)


def test_set_points_beyond_a_limit_are_clamped_with_an_event(node: Node, drone: Drone) -> None:
    echoes: list[Applied] = []
    drone.takeoff()
    with drone.on_command(echoes.append):
        drone.velocity(up=9.0)
        drone.wait(lambda _: any(echo.asked == Velocity(up=9.0) for echo in echoes), WAIT_S)
        drone.wait(lambda _: any(e.kind is EventKind.COMMAND_CLAMPED for e in drone.recent_events()), WAIT_S)
    echo = next(echo for echo in echoes if echo.asked == Velocity(up=9.0))
    assert isinstance(echo.applied, Velocity)
    assert echo.applied.up == pytest.approx(1.0)
    assert echo.app_id == drone.app_id


def test_pre_emption_by_priority_and_the_return(node: Node, drone: Drone) -> None:
    drone.takeoff()
    drone.velocity(forward=0.5)
    drone.wait("flying", WAIT_S)
    with connected(node, "boss", priority=0, on_exit="hover") as boss:
        drone.wait(lambda _: drone.authority.state == "preempted", WAIT_S)
        assert drone.authority.holder == "boss"
        with pytest.raises(AuthorityError, match="boss took over"):
            drone.velocity(forward=0.5)
        drone.wait("hovering", WAIT_S)
        boss.velocity(left=0.3)
        boss.wait(lambda state: state.state is FlightState.FLYING and state.owner == "boss", WAIT_S)
    drone.wait(lambda _: drone.authority.state == "held", WAIT_S)
    node.vehicle.applied.clear()
    seq = drone.feedback().seq
    drone.wait(lambda feedback: feedback.seq > seq + 10, WAIT_S)
    assert not any(isinstance(action, Velocity) for action in node.vehicle.applied), "an old set-point was resumed"
    assert drone.velocity(forward=0.25)
    drone.wait(lambda _: applied(node, Velocity(forward=0.25)), WAIT_S)


def test_waiting_pilots_are_served_in_order(node: Node, drone: Drone) -> None:
    with pytest.raises(AuthorityError, match="me holds the authority"), connected(node, "late"):
        pass
    order: list[str] = []
    joined = [threading.Event(), threading.Event()]

    def fly(name: str) -> None:
        with connected(node, name, wait_s=WAIT_S):
            order.append(name)

    threads = []
    with connected(node, "watcher", access="observe") as watcher:

        def on_event(event: Event) -> None:
            if event.kind is EventKind.AUTHORITY_QUEUED:
                joined[0 if event.app == "one" else 1].set()

        watcher.on_event(on_event)
        for name, event in zip(("one", "two"), joined, strict=True):
            threads.append(threading.Thread(target=fly, args=(name,)))
            threads[-1].start()
            assert event.wait(WAIT_S)
        drone.release_authority()
        for thread in threads:
            thread.join(WAIT_S)
    assert order == ["one", "two"]


def test_one_flies_and_others_observe(node: Node, drone: Drone) -> None:
    with connected(node, "eye", access="observe") as eye, connected(node, "ear", access="observe") as ear:
        drone.takeoff()
        eye.wait("hovering", WAIT_S)
        assert ear.feedback().owner == "me"
        assert eye.next_frame(timeout_s=WAIT_S).shape == (24, 32, 3)
        with pytest.raises(AuthorityError, match="observes"):
            eye.land()
    assert drone.authority.state == "held"


def test_a_restarted_proxy(node: Node, drone: Drone) -> None:
    states: list[LinkState] = []
    frames: list[int] = []
    drone.on_link(lambda status: states.append(status.application))
    drone.on_frame(lambda frame: frames.append(frame.seq))
    drone.config["limits.tilt"] = 0.2
    drone.takeoff()
    drone.velocity(forward=0.5)
    drone.wait("flying", WAIT_S)
    node.proxy.end()
    node.vehicle.applied.clear()
    node.proxy = Proxy(node.vehicle, node.server, name="alpha")
    node.proxy.handler.flight.began_before(
        node.proxy.clock() + BELIEF_NS
    )  # as a killed named proxy learns from the flight record
    started_s = time.monotonic()
    node.proxy.start()
    drone.wait(lambda _: drone.link.application is LinkState.UP and drone.authority.state == "held", WAIT_S)
    assert time.monotonic() - started_s < 5.0
    drone.wait(lambda _: node.proxy.parameters.get("limits.tilt").value == 0.2, WAIT_S)
    seen = len(frames)
    drone.wait(lambda _: len(frames) > seen + 2, WAIT_S)
    assert LinkState.LOST in states
    assert not any(isinstance(action, Velocity) for action in node.vehicle.applied)
    drone.velocity(forward=0.4)
    drone.wait(lambda _: applied(node, Velocity(forward=0.4)), WAIT_S)


def test_the_vehicle_s_link(node: Node, drone: Drone) -> None:
    drone.takeoff()
    node.proxy.publisher.link(LinkState.LOST, "cable")
    drone.wait(lambda _: drone.link.vehicle is LinkState.LOST, WAIT_S)
    assert "cable" in drone.link.reason
    assert drone.authority.state == "held"
    node.proxy.publisher.link(LinkState.UP)
    drone.wait(lambda _: drone.link.vehicle is LinkState.UP, WAIT_S)
    drone.velocity(forward=0.1)
    drone.wait(lambda _: applied(node, Velocity(forward=0.1)), WAIT_S)


def test_emergency(node: Node, drone: Drone) -> None:
    drone.takeoff()
    with connected(node, "by-stander", access="observe") as eye, pytest.raises(AuthorityError):
        eye.emergency_stop()
    assert drone.emergency_stop()
    drone.wait("emergency", WAIT_S)
    assert drone.reset_emergency()
    drone.wait("landed", WAIT_S)
    drone.takeoff()


def test_the_vehicle_hovers_then_lands_when_the_pilots_link_is_cut(node: Node) -> None:
    steps: list[Failsafe] = []
    with connected(node, "eye", access="observe") as eye:
        eye.on_feedback(lambda feedback: steps.append(feedback.failsafe), inline=True)
        pilot = open_drone(node.server.dial, app="pilot")
        pilot.config["failsafe.hover_after_s"] = 0.1
        pilot.config["failsafe.land_after_s"] = 0.4
        pilot.takeoff()
        pilot.velocity(forward=0.5)
        pilot.wait("flying", WAIT_S)
        pilot._supervisor.close()  # as if it were killed
        eye.wait("landed", WAIT_S)
        pilot.close()
    order = [step for number, step in enumerate(steps) if number == 0 or step is not steps[number - 1]]
    assert order[:3] == [Failsafe.NONE, Failsafe.HOVER, Failsafe.LAND]


def test_an_idle_client_keeps_a_vehicle_hovering(node: Node, drone: Drone) -> None:
    drone.config["failsafe.hover_after_s"] = 0.1
    drone.takeoff()
    since_ns = drone.feedback().captured_ns
    feedback = drone.wait(lambda feedback: feedback.captured_ns - since_ns > 600_000_000, WAIT_S)
    assert feedback.failsafe is Failsafe.NONE
    assert feedback.state is FlightState.HOVERING


class Deaf:
    """Receives nothing."""

    def packet(self, packet: bytes) -> None: ...
    def frame(self, header: object, pixels: object, topic: str = "") -> None: ...
    def closed(self, reason: str) -> None: ...


def test_forged_commands_change_nothing(node: Node, drone: Drone) -> None:
    drone.takeoff()
    wrong = Velocity(forward=1.9)
    intruder = node.server.dial(Deaf())
    intruder.send(encode(Request(1, Hello("intruder"))))
    now_ns, lease = time.monotonic_ns(), drone.authority.lease
    for seq, (named, sent_ns) in enumerate([(lease, now_ns), (lease + 1, now_ns), (lease, now_ns - 10**10)]):
        assert intruder.send(encode(Command(seq, named, 10**6 + seq, sent_ns, wrong)))
    intruder.send(b"nonsense")

    def told() -> set[object]:
        return {event.data.get("reason") for event in drone.recent_events() if event.app == "intruder"}

    drone.wait(lambda _: {"no_authority", "foreign_lease", "stale"} <= told(), WAIT_S)
    intruder.close()
    assert wrong not in node.vehicle.applied
    assert drone.authority.state == "held"


def test_statistics_of_all_channels(node: Node, drone: Drone) -> None:
    drone.takeoff()
    drone.frame()
    drone.wait(lambda _: drone._state.video.channels["front"].counter.count > 10, WAIT_S)
    stats = drone.stats
    for name in ("command", "feedback", "video/front"):
        delay = stats[name].delay_s
        assert delay is not None
        assert delay.median > 0.0 or STEP_NS
        assert 0.0 <= delay.median < 0.1
        assert stats[name].rate_hz > 5.0
        assert stats[name].malformed == 0


def test_a_vehicle_that_cannot_fly() -> None:
    node = Node(FakeVehicle(can_fly=False))
    node.proxy.start()
    try:
        with connected(node) as drone:
            assert drone.authority.state == "held"
            with pytest.raises(UnsupportedError, match="a picture only"):
                drone.takeoff()
            assert drone.next_frame(timeout_s=WAIT_S).camera == "front"
    finally:
        node.proxy.end()


def test_annotations_reach_the_others(node: Node, drone: Drone) -> None:
    got: list[str] = []
    with connected(node, "eye", access="observe") as eye, eye.on_annotation(lambda drawn: got.append(drawn.source)):
        frame = drone.next_frame(timeout_s=WAIT_S)
        eye.wait(lambda _: node.server.subscribers("annotations") == 1, WAIT_S)
        assert drone.annotate(frame, [], source="tracker")
        eye.wait(lambda _: got == ["tracker"], WAIT_S)


def test_unsubscribed_cameras_cost_nothing(node: Node, drone: Drone) -> None:
    with drone.on_frame(lambda frame: None):
        drone.wait(lambda _: node.server.subscribers(video("front")) == 1, WAIT_S)
    drone.wait(lambda _: node.server.subscribers(video("front")) == 0, WAIT_S)


def test_hover_is_held_and_feedback_flows(node: Node, drone: Drone) -> None:
    seen: list[Feedback] = []
    drone.takeoff()
    with drone.on_feedback(seen.append, inline=True):
        assert drone.hover()
        drone.wait(lambda _: len(seen) > 10, WAIT_S)
    assert applied(node, Hover())
    assert [one.seq for one in seen] == list(range(seen[0].seq, seen[0].seq + len(seen)))
