"""The law of image-based servoing alone: unusable views."""

from __future__ import annotations

import math

import numpy as np
import pytest

from skyloop.clock import nanoseconds
from skyloop.control.image_servo import ImageServoLaw, ServoPhase
from skyloop.errors import UsageError
from skyloop.messages import CameraInfo, Feedback, FlightState

FORWARD = CameraInfo("front", 320, 240, 15.0, rotation=(0.0, 0.0, 1.0, -1.0, 0.0, 0.0, 0.0, -1.0, 0.0))
WANTED = np.array([[-0.1, -0.1], [0.1, -0.1], [0.1, 0.1], [-0.1, 0.1]])


def tilted(at_s: float, pitch: float) -> Feedback:
    return Feedback(captured_ns=nanoseconds(at_s), state=FlightState.FLYING, roll_rad=0.0, pitch_rad=pitch, yaw_rad=0.0)


def phase_at(law: ImageServoLaw, at_s: float) -> ServoPhase:
    law.step(nanoseconds(at_s))
    return law.phase


def test_a_view_from_a_vehicle_tilted_too_far_is_ignored() -> None:
    law = ImageServoLaw(FORWARD, WANTED, 1.5)
    law.see(WANTED + 0.05, tilted(0.0, 0.0), 0)
    assert phase_at(law, 0.1) is ServoPhase.SERVOING
    error = law.error
    law.see(WANTED, tilted(0.5, math.pi / 2), nanoseconds(0.5))  # it looks straight down
    for at_s in np.arange(0.5, 2.0, 0.1):
        held = law.step(nanoseconds(float(at_s)))
    assert phase_at(law, 2.0) is ServoPhase.HOLDING
    assert law.error == error
    assert (held.forward, held.left, held.up, held.yaw_rate) == pytest.approx((0.0, 0.0, 0.0, 0.0), abs=1e-6)
    law.see(WANTED + 0.05, tilted(2.0, 0.0), nanoseconds(2.0))
    assert phase_at(law, 2.0) is ServoPhase.SERVOING


def test_a_view_stamped_ahead_is_not_flown_by_until_then() -> None:
    law = ImageServoLaw(FORWARD, WANTED, 1.5)
    law.see(WANTED + 0.05, tilted(9.0, 0.0), nanoseconds(9.0))
    law.feedback(tilted(1.0, 0.0))
    for at_s in np.arange(1.0, 4.0, 0.1):
        law.feedback(tilted(float(at_s), 0.0))
        held = law.step(nanoseconds(float(at_s)))
    assert law.phase is ServoPhase.SEARCHING
    assert (held.forward, held.left, held.up) == pytest.approx((0.0, 0.0, 0.0), abs=1e-6)


def test_a_camera_with_unknown_mounting_is_refused_before_the_flight() -> None:
    with pytest.raises(UsageError, match="mounted"):
        ImageServoLaw(CameraInfo("front", 320, 240, 15.0), WANTED, 1.5)
