"""A vehicle for tests, which follows commands at once and reports its state at a steady rate."""

from __future__ import annotations

import threading
from collections.abc import Iterator

import numpy as np
import pytest

from skyloop.clock import monotonic_ns
from skyloop.drivers.base import Driver, Sink
from skyloop.drivers.uri import VehicleUri
from skyloop.messages import (
    ACTION_NAMES,
    Action,
    AnyAction,
    Attitude,
    CameraInfo,
    Capabilities,
    EmergencyStop,
    Feedback,
    FlightState,
    Hover,
    Land,
    LinkState,
    ResetEmergency,
    Takeoff,
    Vector,
    Velocity,
)
from skyloop.proxy.proxy import Proxy
from skyloop.transport.memory import MemoryServer

PERIOD_S = 0.02
NEXT: dict[type[Action], FlightState] = {
    Takeoff: FlightState.HOVERING,
    Hover: FlightState.HOVERING,
    Land: FlightState.LANDED,
    Velocity: FlightState.FLYING,
    Attitude: FlightState.FLYING,
    EmergencyStop: FlightState.EMERGENCY,
    ResetEmergency: FlightState.LANDED,
}


class FakeVehicle(Driver):
    """A vehicle with a camera ``front`` of 32 × 24 pixels that shows the frame's number."""

    def __init__(self, *, can_fly: bool = True) -> None:
        super().__init__(VehicleUri("fake", text="fake://test"))
        self.can_fly = can_fly
        self.state = FlightState.LANDED
        self.applied: list[AnyAction] = []
        self.link_state = LinkState.UP
        self.position_m: Vector | None = None
        self.mute = threading.Event()  #: reports nothing while set
        self._ended = threading.Event()
        self._thread: threading.Thread | None = None

    def capabilities(self) -> Capabilities:
        return Capabilities(
            "fake",
            frozenset(ACTION_NAMES.values()) if self.can_fly else frozenset(),
            (CameraInfo("front", 32, 24, 1 / PERIOD_S),),
            why_not="" if self.can_fly else "it is a picture only",
        )

    def _open(self, sink: Sink) -> None:
        self._ended.clear()
        sink.link(LinkState.UP)
        self._thread = threading.Thread(target=self._run, args=(sink,), daemon=True, name="fake-vehicle")
        self._thread.start()

    def _close(self) -> None:
        self._ended.set()
        if self._thread is not None:
            self._thread.join()

    def _apply(self, action: AnyAction) -> AnyAction:
        self.applied.append(action)
        self.state = NEXT.get(type(action), self.state)
        return action

    def _run(self, sink: Sink) -> None:
        number = 0
        while not self._ended.wait(PERIOD_S):
            if self.mute.is_set():
                continue
            number += 1
            now_ns = monotonic_ns()
            yaw_rad, position_m = number * 0.01, self.position_m
            sink.feedback(
                Feedback(captured_ns=now_ns, state=self.state, yaw_rad=yaw_rad, altitude_m=1.0, position_m=position_m)
            )
            if sink.wants("front"):
                picture = np.full((24, 32, 3), number % 256, np.uint8)
                sink.frame("front", picture, now_ns, width=32, height=24)


WAIT_S = 10.0


class Node:
    """A proxy that can be killed and started again on the same address."""

    def __init__(self, vehicle: FakeVehicle) -> None:
        self.vehicle = vehicle
        self.server = MemoryServer("alpha")
        self.proxy = Proxy(vehicle, self.server, name="alpha")

    def restart(self) -> None:
        self.proxy.end()
        self.proxy = Proxy(self.vehicle, self.server, name="alpha")
        self.proxy.start()


@pytest.fixture
def node() -> Iterator[Node]:
    node = Node(FakeVehicle())
    node.proxy.start()
    yield node
    node.proxy.end()
