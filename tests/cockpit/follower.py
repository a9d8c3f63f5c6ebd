"""A stand-in for what follows a target: it sees the box where it was, and flies forward."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from skyloop.client import Frame
from skyloop.errors import UsageError
from skyloop.messages import CameraInfo, Feedback, Polyline, Velocity
from skyloop.messages.annotation import Shape
from skyloop.vision import Detection

Box = tuple[float, float, float, float]


@dataclass(frozen=True)
class Status:
    """What it says of its target."""

    phase: str = "following"
    box: Box | None = None
    confidence: float | None = 0.9
    predicted_px: tuple[float, float] | None = (16.0, 12.0)
    range_m: float | None = 4.0
    range_deviation_m: float | None = 0.5
    bearing_rad: float | None = 0.1
    speed_m_s: float | None = None
    lost_s: float = 0.0
    problem: str = ""


@dataclass
class StandIn:
    """Counts what it is called with; a test may change what it says, and make it fail or wait."""

    camera: CameraInfo
    box: Box
    class_name: str | None
    mode: Any
    settings: Any
    action: Velocity = field(default_factory=lambda: Velocity(forward=0.25))
    over: bool = False
    fails: Exception | None = None
    waits: threading.Event | None = None  #: each look waits for it
    frames: list[int] = field(default_factory=list)  #: captures
    samples: list[Feedback] = field(default_factory=list)
    detections: list[tuple[list[Detection], int]] = field(default_factory=list)
    threads: set[str] = field(default_factory=set)

    def __post_init__(self) -> None:
        self.status = Status(box=self.box)

    def feedback(self, feedback: Feedback) -> None:
        self.threads.add(threading.current_thread().name)
        self.samples.append(feedback)

    def look(self, frame: Frame) -> list[Shape]:
        self.threads.add(threading.current_thread().name)
        if self.waits is not None:
            self.waits.wait(5)
        if self.fails is not None:
            raise self.fails
        self.frames.append(frame.captured_ns)
        x, y, width, height = self.box
        corners = ((x, y), (x + width, y), (x + width, y + height), (x, y + height))
        return [Polyline(corners, closed=True)]

    def step(self, now_ns: int) -> Velocity:
        assert self.frames, "it has begun"
        assert now_ns >= self.frames[-1]
        self.threads.add(threading.current_thread().name)
        return self.action

    def detected(self, detections: Sequence[Detection], captured_ns: int) -> None:
        self.detections.append((list(detections), captured_ns))

    def says(self, **values: Any) -> None:
        self.status = replace(self.status, **values)


class StandIns:
    """Makes them, and keeps them for a test."""

    def __init__(self, prepare: Callable[[StandIn], None] = lambda _: None) -> None:
        self.made: list[StandIn] = []
        self.prepare = prepare

    def __call__(self, camera: CameraInfo, *, box: Box, class_name: str | None, mode: Any, settings: Any) -> StandIn:
        if class_name == "unicorn":
            raise UsageError("there are no unicorns")
        one = StandIn(camera, box, class_name, mode, settings)
        self.prepare(one)
        self.made.append(one)
        return one

    @property
    def last(self) -> StandIn:
        return self.made[-1]
