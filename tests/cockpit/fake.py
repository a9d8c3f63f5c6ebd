"""A drone that is not there: hands the cockpit whatever a test puts in, through the client's own types."""

from __future__ import annotations

import time
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np

from skyloop.client.frame import Arrival, Frame
from skyloop.client.history import FeedbackHistory
from skyloop.client.statistics import ChannelStats, Distribution
from skyloop.errors import NoAnswerError
from skyloop.messages import (
    Annotation,
    CameraInfo,
    Capabilities,
    Encoding,
    Event,
    EventKind,
    Feedback,
    FlightState,
    FrameHeader,
    LinkState,
)


class Listening:
    """What registering gives back."""

    def __init__(self, where: list[Any], function: Callable[[Any], None]) -> None:
        self._where = where
        self._function = function
        where.append(function)

    def cancel(self) -> None:
        if self._function in self._where:
            self._where.remove(self._function)


class FakeDrone:
    """As much of a drone as the cockpit looks at."""

    name = "alpha"
    uri = "sim://?seed=1"

    def __init__(self, width: int = 64, height: int = 48) -> None:
        cameras = (CameraInfo("front", width, height, 15.0), CameraInfo("bottom", width, height, 15.0))
        self.capabilities = Capabilities("sim", frozenset({"velocity"}), cameras, "simulated quadrotor")
        self.link = SimpleNamespace(application=LinkState.UP, vehicle=LinkState.UP, reason="")
        delay = Distribution(0.0002, 0.0009, 0.002, 0.0003, 100)
        self.stats = {"feedback": ChannelStats(count=100, rate_hz=32.0, delay_s=delay, age_s=0.01)}
        self.newest: Feedback | None = None
        self.told: list[Event] = []
        self.processors: dict[str, list[Any]] = {"front": [], "bottom": []}
        self.event_listeners: list[Any] = []
        self.annotation_listeners: list[Any] = []
        self._size = width, height
        self._seq = 0

    def feedback(self) -> Feedback:
        if self.newest is None:
            raise NoAnswerError("no feedback yet")
        return self.newest

    def recent_events(self) -> list[Event]:
        return list(self.told)

    def on_event(self, function: Callable[[Event], None]) -> Listening:
        return Listening(self.event_listeners, function)

    def on_annotation(self, function: Callable[[Annotation], None]) -> Listening:
        return Listening(self.annotation_listeners, function)

    def add_processor(self, function: Callable[[Frame], None], camera: str, name: str) -> Listening:
        return Listening(self.processors[camera], function)

    # What a test does ------------------------------------------------------------------------------------------

    def show(self, shade: int = 0, camera: str = "front", image: np.ndarray | None = None) -> Frame:
        """The camera takes a picture, all of one shade unless given."""
        width, height = self._size
        pixels = np.full((height, width, 3), shade, np.uint8) if image is None else image
        self._seq += 1
        now = time.monotonic_ns()
        header = FrameHeader(camera, self._seq, now, now, width, height, Encoding.BGR8, pixels.size)
        frame = Arrival(header, pixels.reshape(-1), now, 0, FeedbackHistory()).frame()
        for function in list(self.processors[camera]):
            function(frame)
        return frame

    def tell(self, text: str, kind: EventKind = EventKind.VEHICLE_MESSAGE, **values: Any) -> None:
        event = Event(kind, text, time.monotonic_ns(), **values)
        self.told.append(event)
        for function in list(self.event_listeners):
            function(event)

    def draw(self, annotation: Annotation) -> None:
        for function in list(self.annotation_listeners):
            function(annotation)


def flying(**values: Any) -> Feedback:
    """Feedback of a vehicle in the air."""
    known: dict[str, Any] = {
        "captured_ns": time.monotonic_ns(),
        "state": FlightState.FLYING,
        "battery": 0.8,
        "roll": 0.1,
        "pitch": -0.05,
        "yaw": 1.0,
        "altitude": 1.25,
        "velocity": (0.3, -0.1, 0.0),
        "vehicle_link": LinkState.UP,
        "owner": "demo",
        "owner_id": 1,
        "owner_priority": 16,
        "lease": 3,
    }
    return Feedback(**(known | values))
