"""Directions from boxes, against points of a known thing projected by the simulator's camera."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from skyloop.control.target_estimate import BoxView, Camera, predicted_box
from skyloop.errors import UsageError
from skyloop.messages import CameraInfo, Feedback
from skyloop.messages.geometry import wrap_angle
from skyloop.sim.camera import FRONT_CAMERA
from tests.support.target_world import SIZE, box_of, camera_at, state

ANGLES = {
    "roll": st.floats(-0.25, 0.25),
    "pitch": st.floats(-0.25, 0.25),
    "yaw": st.floats(-math.pi, math.pi),
    "aside": st.floats(-0.4, 0.4),
    "distance": st.floats(2.5, 9.0),
    "height": st.floats(0.7, 2.0),
}


@given(**ANGLES)
def test_azimuth_and_slopes_match_the_thing_at_any_attitude(
    roll: float, pitch: float, yaw: float, aside: float, distance: float, height: float
) -> None:
    camera = camera_at(3.0, -2.0, height, roll=roll, pitch=pitch, yaw=yaw)
    foot = camera.position + distance * np.array([math.cos(yaw + aside), math.sin(yaw + aside), 0.0])
    foot[2] = 0.0
    box = box_of(camera, foot, 1.0, width_m=0.1)
    assume(box is not None)
    assert box is not None
    view = BoxView.of(box, camera)
    assert view is not None
    # A thing that leans in the image, or is bent by the lens, has a wider box, whose middle is off its ends.
    slack = 0.01 + 0.1 * abs(aside) + 0.6 * abs(roll) / distance
    assert wrap_angle(view.azimuth - (yaw + aside)) == pytest.approx(0.0, abs=slack)
    if view.bottom is not None:
        assert view.bottom == pytest.approx(-camera.position[2] / distance, abs=slack)
    if view.top is not None:
        assert view.top == pytest.approx((1.0 - camera.position[2]) / distance, abs=slack)


@given(**ANGLES)
def test_a_predicted_box_matches_the_view(
    roll: float, pitch: float, yaw: float, aside: float, distance: float, height: float
) -> None:
    camera = camera_at(1.0, 2.0, height, pitch=pitch, yaw=yaw)
    foot = np.array([1 + distance * math.cos(yaw + aside), 2 + distance * math.sin(yaw + aside), 0.0])
    box, expected = box_of(camera, foot, 1.7), predicted_box(camera, foot, 1.7, share=0.3)
    assume(box is not None and expected is not None and box[1] > 0.0 and box[1] + box[3] < SIZE[1])
    assert box is not None
    assert expected is not None
    # An upright thing leans in the image of a camera that looks up or down, and the lens bends it.
    assert expected[1] == pytest.approx(box[1], abs=6.0)
    assert expected[3] == pytest.approx(box[3], abs=9.0)
    assert expected[0] + expected[2] / 2 == pytest.approx(box[0] + box[2] / 2, abs=9.0)
    assert expected[2] == pytest.approx(0.3 * expected[3])


@pytest.mark.parametrize(
    ("distance", "pitch", "cut"),
    [(4.0, 0.0, ""), (4.0, -0.35, "below"), (4.0, 0.35, "above"), (0.9, 0.0, "both")],
)
def test_an_edge_cut_off_by_the_image_gives_only_a_bound(distance: float, pitch: float, cut: str) -> None:
    camera = camera_at(pitch=pitch)
    box = box_of(camera, np.array([distance + 0.12, 0.0, 0.0]))
    assert box is not None
    view = BoxView.of(box, camera)
    assert view is not None
    low, high = (-1.2 / distance, 0.52 / distance)
    assert (view.bottom is None, view.below is not None) == ((cut in ("below", "both")),) * 2
    assert (view.top is None, view.above is not None) == ((cut in ("above", "both")),) * 2
    if view.below is not None:
        assert view.below > low - 0.02, "its foot is below the visible part"
    if view.above is not None:
        assert view.above < high + 0.02, "its head is above the visible part"


def test_a_box_at_the_side_of_the_image_has_an_uncertain_middle() -> None:
    inside, beside = BoxView.of((150, 60, 40, 100), camera_at()), BoxView.of((0, 60, 40, 100), camera_at())
    assert inside is not None
    assert beside is not None
    assert beside.azimuth_rad > 1.5 * inside.azimuth_rad
    rougher = BoxView.of((150, 60, 40, 100), camera_at(), noise=0.1)
    assert rougher is not None
    assert rougher.edge > 1.5 * inside.edge


@pytest.mark.parametrize("pitch", [1.4, -1.4])
def test_a_thing_straight_above_or_below_has_no_azimuth(pitch: float) -> None:
    assert BoxView.of((140, 100, 40, 40), camera_at(pitch=pitch)) is None


def test_a_box_with_nan_shows_nothing() -> None:
    assert BoxView.of((math.nan, 10.0, 20.0, 20.0), camera_at()) is None


@pytest.mark.parametrize(
    ("point", "pixel", "shown"),
    [
        ((5.12, 0.0, 1.2), (159.5, 119.5), True),
        ((-5.0, 0.0, 1.2), None, False),
        ((0.12, 3.0, 1.2), None, False),
        ((1.12, 6.0, 1.2), None, False),
        ((1.12, 0.0, -3.0), None, False),
    ],
)
def test_only_points_in_front_of_the_camera_have_a_pixel(
    point: tuple[float, float, float], pixel: tuple[float, float] | None, shown: bool
) -> None:
    camera = camera_at()
    found = camera.pixel(np.array(point))
    assert found == (None if pixel is None else pytest.approx(pixel, abs=0.01))
    assert camera.shows(np.array(point)) is shown


def test_a_point_just_outside_the_image_has_a_pixel_but_is_not_shown() -> None:
    camera = camera_at(yaw=0.72)
    point = np.array([5.0, 0.0, 1.2])
    pixel = camera.pixel(point)
    assert pixel is not None
    assert pixel[0] > SIZE[0]
    assert not camera.shows(point)


@pytest.mark.parametrize("foot", [(-4.0, 0.0, 0.0), (0.5, 0.0, 0.0), (4.0, 9.0, 0.0)])
def test_a_thing_not_entirely_visible_has_no_predicted_box(foot: tuple[float, float, float]) -> None:
    assert predicted_box(camera_at(), np.array(foot), 1.7) is None


def test_a_thing_too_small_to_see_has_no_predicted_box() -> None:
    assert predicted_box(camera_at(), np.array([400.0, 0.0, 0.0]), 0.5) is None


def test_a_camera_has_no_pose_before_the_attitude_is_known() -> None:
    lens, origin = FRONT_CAMERA.intrinsics(), np.zeros(3)
    assert Camera.at(FRONT_CAMERA.info(), Feedback(captured_ns=1, yaw_rad=0.0), origin, lens, SIZE) is None


def test_a_camera_needs_a_known_orientation_but_no_position() -> None:
    lens, origin = FRONT_CAMERA.intrinsics(), np.zeros(3)
    with pytest.raises(UsageError, match="mounted"):
        Camera.at(CameraInfo("front", 320, 240, 15.0), state(), origin, lens, SIZE)
    plain = CameraInfo("front", 320, 240, 15.0, rotation=FRONT_CAMERA.rotation)
    camera = Camera.at(plain, state(), origin, lens, SIZE)
    assert camera is not None
    assert camera.position.tolist() == [0.0, 0.0, 0.0]
