"""Frames and feedback with one thing in view, and a follower that is flown by them."""

from __future__ import annotations

from typing import Any

import numpy as np

from benchmarks.tracking_scenes import texture
from skyloop.client.frame import FeedbackHistory, Frame, ReceivedFrame
from skyloop.clock import nanoseconds
from skyloop.control.target_follower import TargetFollower
from skyloop.messages import Encoding, Feedback, FrameHeader
from skyloop.sim.camera import FRONT_CAMERA
from skyloop.vision.tracking import Box
from tests.support.target_world import PERIOD_S, box_of, camera_at

INTRINSICS = FRONT_CAMERA.intrinsics()


def state(at_s: float, **values: Any) -> Feedback:
    known: dict[str, Any] = {
        "roll_rad": 0.0,
        "pitch_rad": 0.0,
        "yaw_rad": 0.0,
        "altitude_m": 1.2,
        "velocity_m_s": (0.0, 0.0, 0.0),
    }
    return Feedback(captured_ns=nanoseconds(at_s), **(known | values))


FOOT = np.array([4.0, -0.5, 0.0])


def picture(
    at_s: float, *, shown: bool = True, known: bool = True, intrinsics: Any = INTRINSICS, **values: Any
) -> Frame:
    """A frame with a thing in it, whose feedback is that of its capture."""
    image = texture(np.random.default_rng(7), 320, 240)
    box = the_box()
    if shown:
        x, y, width, height = (round(part) for part in box)
        image[y : y + height, x : x + width] = texture(np.random.default_rng(3), width, height, (180, 90, 40))
    history = FeedbackHistory()
    if known:
        history.add(state(at_s, **values))
    at_ns = nanoseconds(at_s)
    header = FrameHeader("front", 1, at_ns, at_ns, 320, 240, Encoding.BGR8, image.size, intrinsics)
    return ReceivedFrame(header, image.reshape(-1), at_ns, 0, history).frame()


def the_box() -> Box:
    box = box_of(camera_at(), FOOT)
    assert box is not None
    return box


def flown(
    follower: TargetFollower, seconds: float, *, start: float = 1.0, shown: bool = True, **values: Any
) -> list[Any]:
    command: Any = None
    for n in range(round(seconds / PERIOD_S)):
        at_s = start + n * PERIOD_S
        follower.feedback(state(at_s, **values))
        drawn = follower.look(picture(at_s, shown=shown, **values))
        command = follower.step(nanoseconds(at_s))
    return [command, drawn]


def follower_of(**values: Any) -> TargetFollower:
    return TargetFollower(FRONT_CAMERA.info(), **({"box": the_box()} | values))
