"""A driver for ``toy://``: a point that moves as commanded."""

from __future__ import annotations

import math
import threading
import time

from skyloop.drivers.base import Driver, Sink, reject_unknown_options
from skyloop.drivers.uri import VehicleUri
from skyloop.errors import ParameterError, UnknownNameError
from skyloop.messages import (
    AnyAction,
    Capabilities,
    EmergencyStop,
    Feedback,
    FlightState,
    LinkState,
    Parameter,
    ParameterType,
    Value,
    Velocity,
)

PERIOD_S = 0.02


class ToyDriver(Driver):
    """Takes velocities. The proxy makes take-off, hover and landing out of them."""

    def __init__(self, uri: VehicleUri) -> None:
        super().__init__(uri)
        reject_unknown_options(uri, {"speed"})
        self._limit = uri.number("speed", 1.0, minimum=0.1, maximum=5.0)
        self._target = Velocity()
        self._stopped = False  # by an emergency stop
        self._x = self._y = self._z = self._yaw = 0.0
        self._closing = threading.Event()
        self._thread: threading.Thread | None = None

    def capabilities(self) -> Capabilities:
        actions = frozenset({"velocity", "emergency_stop", "reset_emergency"})
        return Capabilities(vehicle="toy", actions=actions, description="a point that moves as commanded")

    def parameters(self) -> list[Parameter]:
        limit = Parameter(
            name="limits.speed",
            type=ParameterType.FLOAT,
            value=self._limit,
            unit="m/s",
            minimum=0.1,
            maximum=5.0,
            default=1.0,
            description="maximum speed along each axis",
        )
        return [limit]

    def set_parameter(self, name: str, value: Value) -> Value:
        if name != "limits.speed":
            raise UnknownNameError("parameter", name, ["limits.speed"])
        if not isinstance(value, (int, float)):
            raise ParameterError("limits.speed is a number")
        self._limit = float(value)
        return self._limit

    def _open(self, sink: Sink) -> None:
        self._closing.clear()
        self._thread = threading.Thread(target=self._run, args=(sink,), name="toy", daemon=True)
        self._thread.start()

    def _close(self) -> None:
        self._closing.set()
        if self._thread is not None:
            self._thread.join()
            self._thread = None

    def _apply(self, action: AnyAction) -> AnyAction:
        if isinstance(action, Velocity):
            self._target = Velocity(
                forward=self._limited(action.forward),
                left=self._limited(action.left),
                up=self._limited(action.up),
                yaw_rate=action.yaw_rate,
            )
            return self._target
        self._stopped = isinstance(action, EmergencyStop)
        self._target = Velocity()
        return action

    def _limited(self, speed: float) -> float:
        return max(-self._limit, min(self._limit, speed))

    def _run(self, sink: Sink) -> None:
        sink.link(LinkState.UP)
        due = time.monotonic()
        while not self._closing.is_set():
            sink.feedback(self._step())
            due = max(due + PERIOD_S, time.monotonic())  # absolute deadlines, without catching up after a pause
            self._closing.wait(due - time.monotonic())

    def _step(self) -> Feedback:
        asked = self._target
        on_ground = self._z <= 0.0 and asked.up <= 0.0
        moving = Velocity() if on_ground else asked
        if self._stopped:
            moving = Velocity(up=-2.0 if self._z > 0.0 else 0.0)
        cos, sin = math.cos(self._yaw), math.sin(self._yaw)
        self._x += (cos * moving.forward - sin * moving.left) * PERIOD_S
        self._y += (sin * moving.forward + cos * moving.left) * PERIOD_S
        self._z = max(0.0, self._z + moving.up * PERIOD_S)
        self._yaw = math.remainder(self._yaw + moving.yaw_rate * PERIOD_S, 2 * math.pi)
        state = FlightState.LANDED if on_ground else FlightState.FLYING
        return Feedback(
            captured_ns=time.monotonic_ns(),
            state=FlightState.EMERGENCY if self._stopped else state,
            roll_rad=0.0,
            pitch_rad=0.0,
            yaw_rad=self._yaw,
            altitude_m=self._z,
            velocity_m_s=(moving.forward, moving.left, moving.up),
            position_m=(self._x, self._y, self._z),
        )
