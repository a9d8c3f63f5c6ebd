"""A fake drone that records a controller's calls, and the frames that the controller sees."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, Self

import numpy as np

from skyloop.client.frame import FeedbackHistory, Frame, ReceivedFrame
from skyloop.messages import CameraInfo, Capabilities, Encoding, EventKind, Feedback, FrameHeader, Severity
from tests.support.marker_pictures import INTRINSICS, facing, picture

FORWARD = (0.0, 0.0, 1.0, -1.0, 0.0, 0.0, 0.0, -1.0, 0.0)


class Recorder:
    """Stands in for the drone and records calls."""

    def __init__(self) -> None:
        cameras = (CameraInfo("front", 320, 240, 15.0, rotation=FORWARD), CameraInfo("bottom", 320, 240, 15.0))
        self.capabilities = Capabilities("sim", frozenset({"velocity"}), cameras)
        self.authority = SimpleNamespace(state="held")
        self.velocities: list[dict[str, float]] = []
        self.hovers = 0
        self.drawn: list[list[Any]] = []
        self.told: list[tuple[str, Severity]] = []

    def velocity(self, **values: float) -> None:
        self.velocities.append(values)

    @property
    def _piloting(self) -> Self:
        return self

    def let_go(self, reason: str, *, land: bool) -> None:
        assert reason
        self.hovers += 1

    def emit(self, kind: EventKind, text: str, severity: Severity) -> None:
        self.told.append((text, severity))

    def annotate(self, frame: Frame, shapes: list[Any], source: str) -> None:
        self.drawn.append(shapes)


def state(captured_ns: int) -> Feedback:
    return Feedback(
        captured_ns=captured_ns,
        roll_rad=0.0,
        pitch_rad=0.0,
        yaw_rad=0.0,
        altitude_m=1.0,
        velocity_m_s=(0, 0, 0),
        angular_velocity_rad_s=(0, 0, 0),
    )


def frame(captured_ns: int, markers: list[tuple[int, list[float]]], known: bool = True) -> Frame:
    image = picture([(number, facing(), np.array(place)) for number, place in markers])
    history = FeedbackHistory()
    if known:
        history.add(state(captured_ns))
    header = FrameHeader("front", 1, captured_ns, captured_ns, 320, 240, Encoding.BGR8, image.size, INTRINSICS)
    return ReceivedFrame(header, image.reshape(-1), captured_ns, 0, history).frame()
