"""A vehicle that is only a source of samples and a sink of commands, so that nothing but Skyloop is measured."""

from __future__ import annotations

import time
from typing import Final

from skyloop.bench.contract import Image, Received
from skyloop.bench.schedule import COMMAND
from skyloop.drivers.base import Driver, Sink
from skyloop.drivers.uri import parse_uri
from skyloop.messages import (
    ACTION_NAMES,
    AnyAction,
    CameraInfo,
    Capabilities,
    FlightState,
    LinkState,
    Velocity,
)
from skyloop.messages.typical import typical_feedback

CAMERA: Final = "bench"
USUAL_CAMERA: Final = CameraInfo(CAMERA, 320, 240, 15.0)
_WRAPS_NS: Final = 1 << 40  # 18 minutes
_UNIT_M_S: Final = 2.0**-46


def stamped(sent_ns: int) -> float:
    """Encode a time as a climb rate of less than 2 cm/s, which a command carries to the last bit within all limits."""
    return (sent_ns % _WRAPS_NS) * _UNIT_M_S


def stamp_of(up: float, now_ns: int) -> int:
    """Return the time within the last 18 minutes that :func:`stamped` made this of [ns].

    Args:
        up: The climb rate [m/s].
        now_ns: The present time, on the same clock.
    """
    return now_ns - (now_ns - round(up / _UNIT_M_S)) % _WRAPS_NS


class BenchVehicle(Driver):
    """A vehicle that hovers for ever, and gives feedback and frames on request.

    Args:
        received: Called with each new set-point, on the thread that applies it.
        camera: Its camera.
    """

    shared = False

    def __init__(self, received: Received, camera: CameraInfo = USUAL_CAMERA) -> None:
        super().__init__(parse_uri("bench://"))
        self._camera = camera
        self._received = received
        self._last_up = 0.0

    def capabilities(self) -> Capabilities:
        return Capabilities("bench", frozenset(ACTION_NAMES.values()), (self._camera,))

    def _open(self, sink: Sink) -> None:
        sink.link(LinkState.UP)
        self.publish_feedback(time.monotonic_ns())

    def _close(self) -> None:
        """There is nothing to give back."""

    def _apply(self, action: AnyAction) -> AnyAction:
        now_ns = time.monotonic_ns()
        if type(action) is Velocity and action.up != self._last_up:  # each call has another one: equal ones are repeats
            self._last_up = action.up
            self._received(COMMAND, stamp_of(action.up, now_ns))
        return action

    def show(self, captured_ns: int, image: Image) -> None:
        """Give a frame."""
        sink = self._sink
        if sink is not None:
            height, width, _ = image.shape
            sink.frame(CAMERA, image, captured_ns, width=width, height=height)

    def publish_feedback(self, captured_ns: int) -> None:
        """Give feedback with as many values as a real vehicle's."""
        sink = self._sink
        if sink is None:
            return
        sink.feedback(typical_feedback(captured_ns, FlightState.HOVERING))
