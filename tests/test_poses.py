"""Poses compared with known values, and with the truth of a simulated flight."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

pytest.importorskip("scipy", minversion="1.16", reason="poses are SciPy's transforms")

from skyloop.errors import UsageError
from skyloop.messages import CameraInfo, Feedback
from skyloop.poses import attitude, body_in_world, camera_in_body, camera_in_world, target_in_world, transform
from skyloop.sim.camera import BOTTOM_CAMERA, FRONT_CAMERA

FRONT = FRONT_CAMERA.info()
angles = st.floats(-1.4, 1.4)


def test_a_point_ahead_of_a_camera_that_looks_forward() -> None:
    north = Feedback(captured_ns=0, position_m=(1.0, 2.0, 1.5), roll_rad=0.0, pitch_rad=0.0, yaw_rad=math.pi / 2)
    assert camera_in_world(FRONT, north).apply([0.0, 0.0, 2.0]) == pytest.approx([1.0, 4.12, 1.5])
    assert camera_in_world(FRONT, north).apply([0.5, 0.0, 2.0]) == pytest.approx([1.5, 4.12, 1.5]), "right is east"
    down = Feedback(captured_ns=0, position_m=(0.0, 0.0, 1.5), roll_rad=0.0, pitch_rad=0.3, yaw_rad=0.0)
    assert camera_in_world(FRONT, down).apply([0.0, 0.0, 2.0])[2] < 1.5 - 2 * math.sin(0.29), "nose down looks down"
    assert attitude(down).apply([0.0, 0.0, 1.0]) == pytest.approx([math.sin(0.3), 0.0, math.cos(0.3)])


@given(roll=angles, pitch=angles, yaw=angles, place=st.tuples(*[st.floats(-50, 50)] * 3))
def test_cameras_are_where_the_simulator_has_them(
    roll: float, pitch: float, yaw: float, place: tuple[float, float, float]
) -> None:
    feedback = Feedback(captured_ns=0, position_m=place, roll_rad=roll, pitch_rad=pitch, yaw_rad=yaw)
    for model in (FRONT_CAMERA, BOTTOM_CAMERA):
        expected = model.pose(np.array(place), feedback.rotation)
        found = camera_in_world(model.info(), feedback)
        assert found.translation == pytest.approx(expected.position_m)
        assert found.rotation.as_matrix() == pytest.approx(expected.rotation, abs=1e-9)
    back = body_in_world(feedback).inv() * camera_in_world(FRONT, feedback)
    assert back.as_matrix() == pytest.approx(camera_in_body(FRONT).as_matrix(), abs=1e-9)


def test_a_given_position_takes_precedence() -> None:
    feedback = Feedback(captured_ns=0, position_m=(9.0, 9.0, 9.0), roll_rad=0.0, pitch_rad=0.0, yaw_rad=0.0)
    assert body_in_world(feedback, (1.0, 2.0, 3.0)).translation == pytest.approx([1.0, 2.0, 3.0])


def test_missing_values_and_invalid_poses_are_refused() -> None:
    with pytest.raises(UsageError, match="does not report its position"):
        body_in_world(Feedback(captured_ns=0, roll_rad=0.0, pitch_rad=0.0, yaw_rad=0.0))
    with pytest.raises(UsageError, match="attitude"):
        body_in_world(Feedback(captured_ns=0, position_m=(0.0, 0.0, 0.0)))
    with pytest.raises(UsageError, match="how it is mounted"):
        camera_in_body(CameraInfo("front", 320, 240, 30.0))
    for position, rotation in (
        ((0, 0), np.eye(3)),
        ((0, 0, math.nan), np.eye(3)),
        ((0, 0, 0), np.diag([1.0, 1.0, -1.0])),
        ((0, 0, 0), np.eye(3) * 2),
    ):
        with pytest.raises(UsageError):
            transform(position, rotation)


def test_a_moving_marker_is_located_in_the_world_from_a_flight() -> None:
    """With the simulator's noise in pictures, attitude and position, and the state at each picture's capture."""
    pytest.importorskip("cv2", reason="markers are found with OpenCV")
    from skyloop.stepping.rehearsal import rehearse
    from skyloop.vision import MarkerDetector

    detector, errors = MarkerDetector("4x4_50", 0.3), []
    with rehearse("sim://?cameras=front&seed=1&fps=5") as drone:
        drone.takeoff()
        drone.velocity(yaw_rate=0.6)
        for frame in drone.frames():
            drone.velocity(yaw_rate=0.6)
            state = frame.feedback
            for sighting in detector.detect(frame):
                if sighting.id == 7 and sighting.distance_m < 3.5 and state is not None and state.native is not None:
                    place = target_in_world(sighting.pose, drone.capabilities.cameras[0], state).translation
                    true = [state.native[f"truth.target.{axis}"] for axis in "xyz"]
                    errors.append(float(np.linalg.norm(place - np.array(true, dtype=np.float64))))
            if len(errors) >= 8 or frame.seq > 200:
                break
    assert len(errors) >= 8
    assert np.median(errors) < 0.12
