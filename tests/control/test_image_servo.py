"""Image-based servoing: the interaction matrix and four degrees of freedom against a camera, and the law alone."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from skyloop.clock import nanoseconds
from skyloop.control.image_servo import ImageServoLaw, ServoPhase, camera_twist, interaction_matrix, levelled, servo
from skyloop.errors import UsageError
from skyloop.messages import CameraInfo, Feedback, FlightState
from skyloop.messages.geometry import rotation_from_euler

Array = NDArray[np.float64]
FORWARD = CameraInfo(
    "front", 320, 240, 15.0, rotation=(0.0, 0.0, 1.0, -1.0, 0.0, 0.0, 0.0, -1.0, 0.0), position_m=(0.12, 0.0, 0.0)
)
SQUARE = np.array([[-0.15, 0.15], [0.15, 0.15], [0.15, -0.15], [-0.15, -0.15]])
small = st.floats(-0.5, 0.5)


def seen(position: Array, yaw: float, roll: float = 0.0, pitch: float = 0.0) -> tuple[Array, Array]:
    """Return a camera's view of a square at x = 2 that faces the vehicle: points and depths."""
    world = np.column_stack([np.full(4, 2.0), -SQUARE[:, 0], SQUARE[:, 1]])
    body = (world - position) @ rotation_from_euler(roll, pitch, yaw)
    assert FORWARD.position_m is not None
    optical = (body - np.asarray(FORWARD.position_m)) @ np.asarray(FORWARD.rotation).reshape(3, 3)
    return optical[:, :2] / optical[:, 2:], optical[:, 2]


@given(st.lists(st.tuples(small, small, st.floats(0.5, 5.0)), min_size=1, max_size=4), st.tuples(*[small] * 6))
def test_points_move_as_the_interaction_matrix_predicts(
    points: list[tuple[float, float, float]], twist: tuple[float, ...]
) -> None:
    rays, depths = np.array([p[:2] for p in points]), np.array([p[2] for p in points])
    places = np.column_stack([rays * depths[:, None], depths])
    velocity, turning = np.array(twist[:3]), np.array(twist[3:])
    dt = 1e-6
    moved = places - dt * (velocity + np.cross(turning, places))  # fixed points move relative to the camera
    expected = (moved[:, :2] / moved[:, 2:] - rays).reshape(-1) / dt
    assert interaction_matrix(rays, depths) @ np.array(twist) == pytest.approx(expected, abs=1e-4)


@pytest.mark.parametrize("motion", [(1, 0, 0, 0), (0, 1, 0, 0), (0, 0, 1, 0), (0, 0, 0, 1)])
def test_points_move_with_the_vehicles_motion(motion: tuple[int, ...]) -> None:
    dt = 1e-6
    points, depths = seen(np.zeros(3), 0.0)
    after, _ = seen(np.array(motion[:3]) * dt, motion[3] * dt)
    rates = interaction_matrix(points, depths) @ camera_twist(FORWARD) @ np.array(motion, float)
    assert rates == pytest.approx(((after - points) / dt).reshape(-1), abs=1e-4)


@given(roll=small, pitch=small)
def test_tilt_is_compensated(roll: float, pitch: float) -> None:
    # Rotate about the camera's own centre, so that only the tilt differs and the lever arm plays no part.
    level, _ = seen(np.zeros(3), 0.0)
    assert FORWARD.position_m is not None
    lever = np.asarray(FORWARD.position_m)
    place = lever - rotation_from_euler(roll, pitch, 0.0) @ lever
    tilted, _ = seen(place, 0.0, roll, pitch)
    assert levelled(tilted, FORWARD, roll, pitch) == pytest.approx(level, abs=1e-9)


@pytest.mark.slow
@given(st.tuples(st.floats(-1.0, 0.7), small, small), st.floats(-0.4, 0.4))
def test_flies_to_the_wanted_view(start: tuple[float, float, float], yaw: float) -> None:
    wanted, _ = seen(np.zeros(3), 0.0)
    place, errors = np.array(start), []
    for _ in range(300):
        points, depths = seen(place, yaw)
        errors.append(float(np.abs(points - wanted).max()))
        forward, left, up, turn = servo(points, wanted, depths, FORWARD, gain=1.0)
        place = place + 0.05 * rotation_from_euler(0.0, 0.0, yaw) @ np.array([forward, left, up])
        yaw += 0.05 * turn
    assert errors[-1] < 1e-3
    assert np.linalg.norm(place) < 0.05
    assert abs(yaw) < 0.03


def test_invalid_arguments_are_refused() -> None:
    with pytest.raises(UsageError, match="shape"):
        interaction_matrix(np.zeros((2, 3)), np.ones(2))
    with pytest.raises(UsageError, match="above 0"):
        interaction_matrix(np.zeros((2, 2)), np.array([1.0, 0.0]))
    with pytest.raises(UsageError, match="two or more points"):
        servo(np.zeros((1, 2)), np.zeros((1, 2)), np.ones(1), FORWARD, 1.0)
    with pytest.raises(UsageError, match="tilted too far"):
        levelled(np.array([[0.0, 0.0]]), FORWARD, 0.0, math.pi / 2)


CENTRED = CameraInfo("front", 320, 240, 15.0, rotation=(0.0, 0.0, 1.0, -1.0, 0.0, 0.0, 0.0, -1.0, 0.0))
WANTED = np.array([[-0.1, -0.1], [0.1, -0.1], [0.1, 0.1], [-0.1, 0.1]])


def tilted(at_s: float, pitch: float) -> Feedback:
    return Feedback(captured_ns=nanoseconds(at_s), state=FlightState.FLYING, roll_rad=0.0, pitch_rad=pitch, yaw_rad=0.0)


def phase_at(law: ImageServoLaw, at_s: float) -> ServoPhase:
    law.step(nanoseconds(at_s))
    return law.phase


def test_a_view_from_a_vehicle_tilted_too_far_is_ignored() -> None:
    law = ImageServoLaw(CENTRED, WANTED, 1.5)
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
    law = ImageServoLaw(CENTRED, WANTED, 1.5)
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
