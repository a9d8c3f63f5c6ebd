"""A vehicle that is nothing but a source of samples and a sink of commands, so that only Skyloop is measured."""

from __future__ import annotations

import time

import numpy as np

from skyloop.bench.rounds import Channel, paced
from skyloop.drivers.base import Driver, Sink
from skyloop.drivers.uri import parse_uri
from skyloop.messages import (
    ACTION_NAMES,
    AnyAction,
    CameraInfo,
    Capabilities,
    Feedback,
    FlightState,
    LinkState,
)

CAMERA = "bench"


class BenchVehicle(Driver):
    """Hovers for ever; gives feedback and frames when it is told to."""

    def __init__(self) -> None:
        super().__init__(parse_uri("bench://"))

    def capabilities(self) -> Capabilities:
        return Capabilities("bench", frozenset(ACTION_NAMES.values()), (CameraInfo(CAMERA, 320, 240, 15.0),))

    def _open(self, sink: Sink) -> None:
        sink.link(LinkState.UP)
        self._tell(sink)

    def _close(self) -> None:
        """There is nothing to give back."""

    def _apply(self, action: AnyAction) -> AnyAction:
        return action

    def produce(self, channel: Channel, count: int) -> None:
        """Give ``count`` samples of the channel at its period."""
        sink = self._sink
        assert sink is not None
        image = np.random.default_rng(1).integers(0, 255, channel.frame_bytes, np.uint8)
        for _ in paced(count, channel.period_s):
            if channel.width:
                now = time.monotonic_ns()
                sink.frame(CAMERA, image, now, width=channel.width, height=channel.height)
            else:
                self._tell(sink)

    def _tell(self, sink: Sink) -> None:
        """Feedback as full as a real vehicle's."""
        sink.feedback(
            Feedback(
                captured_ns=time.monotonic_ns(),
                state=FlightState.HOVERING,
                battery=0.8,
                battery_v=11.4,
                roll=0.01,
                pitch=-0.02,
                yaw=0.5,
                altitude=1.2,
                velocity=(0.1, 0.0, 0.0),
                angular_velocity=(0.0, 0.01, 0.0),
                acceleration=(0.0, 0.1, 9.8),
                position=(0.5, 0.25, 1.2),
            )
        )
