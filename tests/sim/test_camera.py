from __future__ import annotations

from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from skyloop.errors import UsageError
from skyloop.messages.frame import LOOKING_DOWN, LOOKING_FORWARD
from skyloop.messages.geometry import rotation_from_euler
from skyloop.sim.camera import (
    BOTTOM_CAMERA,
    FPV_CAMERA,
    FRONT_CAMERA,
    CameraModel,
    distort,
    looking_up,
    undistort,
)

PLAIN = replace(FRONT_CAMERA, distortion=(0.0,) * 5)


def seen_at(camera: CameraModel, body_point: tuple[float, float, float]) -> NDArray[np.float64]:
    """Return the pixel of a point in body axes, for a drone at the origin."""
    pose = camera.pose(np.zeros(3), np.eye(3))
    pixel: NDArray[np.float64] = camera.project((np.array([body_point]) - pose.position_m) @ pose.rotation)[0]
    return pixel


def test_front_camera_sees_left_on_the_left_and_up_at_the_top() -> None:
    x, y = seen_at(FRONT_CAMERA, (3.0, 0.5, 0.4))
    assert x < FRONT_CAMERA.cx
    assert y < FRONT_CAMERA.cy


def test_bottom_camera_sees_ahead_at_the_top_and_left_on_the_left() -> None:
    x, y = seen_at(BOTTOM_CAMERA, (0.2, 0.1, -1.0))
    assert x < BOTTOM_CAMERA.cx
    assert y < BOTTOM_CAMERA.cy


@pytest.mark.parametrize("rotation", [LOOKING_FORWARD, LOOKING_DOWN])
def test_mountings_are_rotations(rotation: tuple[float, ...]) -> None:
    turn = np.reshape(rotation, (3, 3))
    assert np.allclose(turn @ turn.T, np.eye(3))
    assert np.linalg.det(turn) == pytest.approx(1.0)


@pytest.mark.parametrize(("camera", "degrees"), [(FRONT_CAMERA, 92.0), (BOTTOM_CAMERA, 64.0)])
def test_presets_have_their_stated_fields_of_view(camera: CameraModel, degrees: float) -> None:
    corners = np.array([[-0.5, -0.5], [camera.width - 0.5, camera.height - 0.5]])
    rays = np.column_stack([camera.rays(corners), np.ones(2)])
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    assert np.degrees(np.arccos(rays[0] @ rays[1])) == pytest.approx(degrees, abs=1.0)


def test_the_pose_follows_the_rotated_body() -> None:
    body = rotation_from_euler(0.0, 0.0, np.pi / 2)  # facing north
    pose = FRONT_CAMERA.pose(np.array([1.0, 2.0, 3.0]), body, drone=4)
    assert pose.position_m == pytest.approx([1.0, 2.0 + FRONT_CAMERA.position_m[0], 3.0])
    assert pose.rotation[:, 2] == pytest.approx([0.0, 1.0, 0.0], abs=1e-12)
    assert pose.drone == 4


def test_projection_agrees_with_opencv() -> None:
    camera = replace(FRONT_CAMERA, distortion=(-0.28, 0.08, 0.002, -0.003, 0.01))
    rng = np.random.default_rng(1)
    points = rng.uniform((-0.8, -0.6, 1.0), (0.8, 0.6, 1.0), (50, 3)) * rng.uniform(0.5, 6.0, (50, 1))
    expected, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), camera.matrix, np.array(camera.distortion))
    assert camera.project(points) == pytest.approx(expected[:, 0], abs=1e-9)


@given(st.floats(0, 319), st.floats(0, 239))
def test_a_pixels_ray_projects_to_the_pixel(x: float, y: float) -> None:
    ray = FRONT_CAMERA.rays(np.array([[x, y]]))
    assert FRONT_CAMERA.project(np.array([[*ray[0], 1.0]]))[0] == pytest.approx([x, y], abs=1e-6)


def test_scaling_keeps_rays_in_place() -> None:
    double = FRONT_CAMERA.scaled(2.0)
    assert (double.width, double.height) == (640, 480)
    # the top left corner of the picture, in either resolution
    assert double.rays(np.array([[-0.5, -0.5]])) == pytest.approx(FRONT_CAMERA.rays(np.array([[-0.5, -0.5]])))


def test_the_intrinsics_of_frames() -> None:
    info = FRONT_CAMERA.info()
    assert (info.name, info.width, info.height, info.rotation) == ("front", 320, 240, LOOKING_FORWARD)
    assert info.intrinsics is not None
    assert info.intrinsics.distortion == FRONT_CAMERA.distortion
    assert PLAIN.intrinsics().distortion == ()


def test_a_lens_that_folds_its_image_is_refused() -> None:
    with pytest.raises(UsageError, match="no inverse"):
        replace(FRONT_CAMERA, distortion=(-0.9, 0.0, 0.0, 0.0, 0.0)).rays(np.array([[0.0, 0.0]]))


@pytest.mark.parametrize(
    ("change", "word"),
    [
        ({"width": 0}, "pixels"),
        ({"fps": 0.0}, "fps"),
        ({"fx": float("nan")}, "fx"),
        ({"latency_s": -0.1}, "latency_s"),
        ({"noise_sigma": float("inf")}, "noise_sigma"),
        ({"vignetting": 1.5}, "vignetting"),
        ({"cx": float("nan")}, "principal point"),
        ({"rotation": (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, -1.0)}, "rotation"),
    ],
)
def test_impossible_values_are_refused_by_name(change: dict[str, Any], word: str) -> None:
    with pytest.raises(UsageError, match=word):
        replace(FRONT_CAMERA, **change)
    with pytest.raises(UsageError, match="scaled"):
        FRONT_CAMERA.scaled(0.0)


def test_a_large_image_is_undistorted_in_parts_as_in_one_go() -> None:
    points = np.random.default_rng(0).uniform(-0.5, 0.5, (40_000, 2))
    bent = (-0.05, 0.1, 0.001, -0.006, 0.0)
    straight = undistort(points, bent)
    assert straight is not None
    np.testing.assert_allclose(distort(straight, bent), points, atol=1e-9)
    folded = np.vstack([points, [(9.0, 9.0)]])
    assert undistort(folded, (-0.3, 0.0, 0.0, 0.0, 0.0)) is None


def test_the_racers_camera_is_wide_and_looks_up() -> None:
    camera = FPV_CAMERA
    assert (camera.width, camera.height) == (320, 240)
    left, right = camera.rays(np.array([[-0.5, 119.5], [319.5, 119.5]]))[:, 0]
    assert np.degrees(np.arctan(right) - np.arctan(left)) == pytest.approx(100.0, abs=1.5)
    ahead = camera.rotation_matrix @ [0.0, 0.0, 1.0]
    assert np.degrees(np.arctan2(ahead[2], ahead[0])) == pytest.approx(25.0)
    assert camera.rotation_matrix @ [1.0, 0.0, 0.0] == pytest.approx([0.0, -1.0, 0.0])  # its right is the body's right
    assert looking_up(0.0) == pytest.approx(LOOKING_FORWARD)
