"""The ground in a downward camera's frames."""

from __future__ import annotations

import math

import numpy as np
import pytest
from msgspec.structs import replace

from skyloop.messages import CameraInfo, Feedback, FlightState, Intrinsics
from skyloop.vision.flow import GroundTracker


def test_a_new_frame_size_restarts_the_tracking() -> None:
    """A camera that changed its resolution in flight ended the position hold."""
    noise = np.random.default_rng(1).integers(0, 255, (60, 80), np.uint8)
    camera = CameraInfo("bottom", 320, 240, 30.0, rotation=(0.0, -1.0, 0.0, -1.0, 0.0, 0.0, 0.0, 0.0, -1.0))
    tracker = GroundTracker(camera)
    level = Feedback(
        captured_ns=0, state=FlightState.HOVERING, roll_rad=0.0, pitch_rad=0.0, yaw_rad=0.0, altitude_m=1.0
    )
    for scale in (4, 4, 8, 8, 4, 4):
        image = noise.repeat(scale, axis=0).repeat(scale, axis=1)
        lens = Intrinsics(60.0 * scale, 60.0 * scale, 40.0 * scale, 30.0 * scale)
        found = tracker.see(image, level, lens)
    assert found is not None
    assert np.abs(found[0]).max() < 0.01, "the vehicle has not moved"


@pytest.mark.parametrize("name", ["altitude_m", "roll_rad", "yaw_rad"])
@pytest.mark.parametrize("wrong", [math.nan, math.inf])
def test_a_number_that_is_not_finite_ends_the_tracking_for_one_frame_only(name: str, wrong: float) -> None:
    """After one such sample the position stayed unknown, and the vehicle drifted."""
    image = np.random.default_rng(1).integers(0, 255, (60, 80), np.uint8).repeat(4, axis=0).repeat(4, axis=1)
    lens = Intrinsics(240.0, 240.0, 160.0, 120.0)
    camera = CameraInfo("bottom", 320, 240, 30.0, rotation=(0.0, -1.0, 0.0, -1.0, 0.0, 0.0, 0.0, 0.0, -1.0))
    tracker = GroundTracker(camera)
    level = Feedback(
        captured_ns=0, state=FlightState.HOVERING, roll_rad=0.0, pitch_rad=0.0, yaw_rad=0.0, altitude_m=1.0
    )
    for sample in (level, level, replace(level, **{name: wrong}), level, level, level):
        found = tracker.see(image, sample, lens)
    assert found is not None
    assert np.abs(found[0]).max() < 0.01
