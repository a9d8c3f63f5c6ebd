"""A stand-in for a follower: it sees the box at its original place, and flies forward."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from skyloop.client import Frame
from skyloop.control.chase_law import FollowMode
from skyloop.control.target_follower import FollowStatus
from skyloop.errors import UsageError
from skyloop.messages import CameraInfo, Feedback, Polyline, Velocity
from skyloop.messages.relayed import Shape
from skyloop.vision import Detection
from skyloop.vision.tracking import Box, outline


@dataclass
class StandIn:
    """Counts its calls; a test may change its answers, and make it fail or wait."""

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
        self.status = FollowStatus(
            phase="following",
            mode=FollowMode.FOLLOW,
            box=self.box,
            confidence=0.9,
            class_name=self.class_name,
            predicted_px=(16.0, 12.0),
            range_m=4.0,
            range_deviation_m=0.5,
            bearing_rad=0.1,
        )

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
        return [Polyline(outline(self.box), closed=True)]

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
    """Creates them, and keeps them for a test."""

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
