"""Lenses: round trips, against formulas written down here, and images without distortion."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from skyloop.errors import UsageError
from skyloop.messages import Intrinsics
from skyloop.sim.camera import FRONT_CAMERA
from skyloop.vision import project, undistort, unproject
from skyloop.vision.lens import normalised
from tests.support.board_pictures import FISHEYE, PINHOLE

pixels = st.lists(st.tuples(st.floats(0, 639), st.floats(0, 479)), min_size=1, max_size=20)


@given(pixels, st.floats(0.1, 30.0))
@pytest.mark.parametrize("lens", [PINHOLE, FISHEYE], ids=["pinhole", "fisheye"])
def test_round_trip(lens: Intrinsics, seen: list[tuple[float, float]], distance: float) -> None:
    given_pixels = np.array(seen)
    rays = unproject(given_pixels, lens)
    assert np.linalg.norm(rays, axis=1) == pytest.approx(1.0)
    assert project(rays * distance, lens) == pytest.approx(given_pixels, abs=1e-3)


def test_pinhole_is_the_simulator_s() -> None:
    points = np.array([[0.3, -0.2, 1.0], [-0.5, 0.4, 2.0]])
    assert project(points, FRONT_CAMERA.intrinsics()) == pytest.approx(FRONT_CAMERA.project(points))
    seen = np.array([[10.0, 20.0], [300.0, 200.0]])
    assert normalised(seen, FRONT_CAMERA.intrinsics()) == pytest.approx(FRONT_CAMERA.rays(seen), abs=1e-6)


def test_fisheye_is_opencv_s() -> None:
    rng = np.random.default_rng(4)
    points = np.column_stack([rng.uniform(-2, 2, (50, 2)), rng.uniform(0.3, 2, 50)])
    expected, _ = cv2.fisheye.projectPoints(
        points.reshape(-1, 1, 3), np.zeros(3), np.zeros(3), FISHEYE.matrix, np.array(FISHEYE.distortion)
    )
    assert project(points, FISHEYE) == pytest.approx(np.asarray(expected).reshape(-1, 2), abs=1e-6)
    centre = unproject([[FISHEYE.cx, FISHEYE.cy]], FISHEYE)
    assert centre == pytest.approx(np.array([[0.0, 0.0, 1.0]]))


def test_directions_that_a_lens_cannot_show() -> None:
    assert np.isnan(project([[0.0, 0.0, -1.0], [1.0, 0.0, 0.0]], PINHOLE)).all()
    beside = project([[1.0, 0.0, -0.05]], FISHEYE)
    assert np.isfinite(beside).all(), "a fisheye also sees a little behind itself"
    assert np.isnan(normalised(beside, FISHEYE)).all(), "a plane in front of it does not"
    folded = Intrinsics(250.0, 250.0, 320.0, 240.0, (-0.3, 0.0, 0.0, 0.0), "fisheye")
    assert np.isnan(project([[1.0, 0.0, 0.1]], folded)).all()
    assert np.isnan(unproject([[620.0, 240.0]], folded)).all()
    assert unproject(np.empty((0, 2)), PINHOLE).shape == (0, 3)
    with pytest.raises(UsageError, match="shape"):
        project([[1.0, 2.0]], PINHOLE)
    with pytest.raises(UsageError, match="'pinhole' or 'fisheye'"):
        unproject([[1.0, 2.0]], Intrinsics(1.0, 1.0, 0.0, 0.0, (), "mirror"))


@pytest.mark.parametrize("lens", [PINHOLE, FISHEYE], ids=["pinhole", "fisheye"])
def test_straight_lines_are_straight_without_distortion(lens: Intrinsics) -> None:
    """The image of a line in space: bent before, straight after, and where the new camera predicts it."""
    line = np.column_stack([np.linspace(-0.5, 0.5, 400), np.full(400, -0.3), np.full(400, 1.0)])
    bent = np.zeros((480, 640), np.uint8)
    for x, y in project(line, lens):
        cv2.circle(bent, (round(x), round(y)), 2, 255, -1)
    straight, ideal = undistort(bent, lens, balance=0.3)
    assert straight.shape == bent.shape
    assert ideal.distortion == ()
    expected = project(line, ideal)
    rows = []
    for x in np.linspace(expected[20, 0], expected[-20, 0], 8).astype(int):
        lit = np.flatnonzero(straight[:, x] > 60)
        assert len(lit)
        rows.append(lit.mean())
    assert np.ptp(rows) < 1.5
    assert np.mean(rows) == pytest.approx(expected[0, 1], abs=1.5)
    assert undistort(bent, lens, balance=0.0)[1].fx >= ideal.fx >= undistort(bent, lens, balance=1.0)[1].fx
    again, _ = undistort(bent, lens, balance=0.3)
    assert (again == straight).all()


def test_images_that_cannot_be_undistorted() -> None:
    with pytest.raises(UsageError, match="intrinsics"):
        undistort(np.zeros((4, 4), np.uint8))
    with pytest.raises(UsageError, match="uint8"):
        undistort(np.zeros((4, 4)), PINHOLE)  # type: ignore[arg-type]
    with pytest.raises(UsageError, match="balance"):
        undistort(np.zeros((4, 4), np.uint8), PINHOLE, balance=2.0)


def test_pixels_beyond_the_fold_of_a_pinholes_distortion_have_no_direction() -> None:
    """The directions to such pixels were finite, and wrong by tens of degrees."""
    lens = Intrinsics(250.0, 250.0, 320.0, 240.0, (-0.3, 0.0, 0.0, 0.0))  # 0.703 f from the axis is the maximum
    pixels = [[320.0 + 250.0 * 0.69, 240.0], [320.0 + 250.0 * 0.72, 240.0], [320.0, 240.0 - 250.0 * 2.0]]
    rays = unproject(pixels, lens)
    assert np.isfinite(rays[0]).all()
    assert project(rays[:1], lens) == pytest.approx(np.array(pixels[:1]), abs=0.02)
    assert np.isnan(rays[1:]).all()
    assert np.isnan(normalised(pixels[1:], lens)).all()
    shown = project([[1.0, 0.0, 1.0], [1.2, 0.0, 1.0], [5.0, 0.0, 1.0]], lens)
    assert np.isfinite(shown[0]).all()
    assert np.isnan(shown[1:]).all(), "it would fold back into the image"
    wide = Intrinsics(250.0, 250.0, 320.0, 240.0, (0.3, 0.1, 0.0, 0.0))
    assert np.isfinite(project([[5.0, 0.0, 1.0]], wide)).all(), "this one has no fold"
