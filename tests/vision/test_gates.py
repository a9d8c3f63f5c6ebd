"""Gates in images of a simulated hall: found, placed, and not found where there are none."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from skyloop.errors import UsageError
from skyloop.messages import Feedback, Intrinsics
from skyloop.messages.geometry import rotation_from_euler, wrap_angle
from skyloop.sim.camera import BOTTOM_CAMERA, FRONT_CAMERA, CameraModel, CameraPose
from skyloop.sim.render import PlanarRenderer, Scene, SceneState, SensorEffects
from skyloop.sim.world_file import load_world
from skyloop.vision import BlobDetector, GateDetector, GroundTracker

Picture = NDArray[np.uint8]
WORLD = load_world("gates")
GREY = np.full((240, 320, 3), 90, np.uint8)


@pytest.fixture(scope="module")
def renderer() -> PlanarRenderer:
    return PlanarRenderer(Scene(WORLD, drones=1))


def taken(
    renderer: PlanarRenderer,
    model: CameraModel,
    position: NDArray[np.float64],
    attitude: tuple[float, float, float],
    number: int = 0,
) -> tuple[Picture, CameraPose]:
    turn = rotation_from_euler(*attitude)
    pose = model.pose(position, turn, 0)
    picture = renderer.render(SceneState(position[None], turn[None], ()), pose, model)
    return SensorEffects(model, 3).apply(picture, number), pose


def test_gates_are_found_and_placed(renderer: PlanarRenderer) -> None:
    rng, away, turned, found = np.random.default_rng(5), [], [], 0
    for number in range(60):
        gate = WORLD.gates[number % 5]
        bearing = gate.yaw_rad + math.pi + rng.uniform(-0.4, 0.4)
        distance = rng.uniform(2.0, 4.0)
        position = np.array(gate.position_m) + distance * np.array([math.cos(bearing), math.sin(bearing), 0.0])
        position[2] += rng.uniform(-0.2, 0.2)
        attitude = (rng.normal(0, 0.05), rng.normal(0, 0.05), bearing + math.pi + rng.uniform(-0.1, 0.1))
        picture, pose = taken(renderer, FRONT_CAMERA, position, attitude, number)
        seen = GateDetector(gate.colour, gate.inner_size_m).detect(picture, FRONT_CAMERA.intrinsics())
        if not seen:
            continue
        found += 1
        away.append(float(np.linalg.norm(pose.rotation @ seen[0].position_m + pose.position_m - gate.position_m)))
        normal = pose.rotation @ seen[0].normal
        turned.append(abs(wrap_angle(math.atan2(-normal[1], -normal[0]) - gate.yaw_rad)))
        assert len(seen[0].outline) == 4
    assert found >= 55
    # The image shows the side of the frame, half its thickness of 8 cm in front of the middle.
    assert np.median(away) < 0.07
    assert max(away) < 0.2
    assert np.median(turned) < 0.05


def test_nothing_is_found_without_gates(renderer: PlanarRenderer) -> None:
    picture, _ = taken(renderer, FRONT_CAMERA, np.array([-5.5, -3.5, 1.0]), (0.0, 0.0, math.pi))
    for gate in WORLD.gates:
        assert GateDetector(gate.colour).detect(picture, FRONT_CAMERA.intrinsics()) == []
    assert BlobDetector((235, 110, 20)).detect(GREY, FRONT_CAMERA.intrinsics()) == []


def hole(*corners: tuple[float, float]) -> Picture:
    """A red patch with a hole of this shape."""
    picture = GREY.copy()
    cv2.rectangle(picture, (40, 20), (280, 220), (0, 0, 255), -1)
    cv2.fillPoly(picture, [np.array(corners, np.int32)], (90, 90, 90))
    return picture


def round_hole(radius: float) -> Picture:
    return hole(*((160 + radius * math.cos(a), 120 + radius * math.sin(a)) for a in np.linspace(0, math.tau, 60)))


SQUARE = ((100, 60), (220, 60), (220, 180), (100, 180))


@pytest.mark.parametrize(
    ("picture", "found"),
    [
        (hole(*SQUARE), 1),
        (hole((160, 50), (230, 190), (90, 190)), 0),  # three corners
        (hole((100, 60), (220, 60), (160, 120), (220, 180), (100, 180)), 0),  # a bite is missing
        (round_hole(60), 0),  # no straight sides
        (hole((157, 117), (163, 117), (163, 123), (157, 123)), 0),  # too small
        (hole((100, 60), (101, 60), (101, 180), (100, 180)), 0),  # a slit
        (cv2.rectangle(GREY.copy(), (40, 20), (280, 220), (0, 0, 255), -1), 0),  # no hole
    ],
    ids=["square", "triangle", "bitten", "round", "tiny", "slit", "whole"],
)
def test_only_openings_of_four_straight_sides_are_gates(picture: Picture, found: int) -> None:
    seen = GateDetector((255, 0, 0)).detect(picture, FRONT_CAMERA.intrinsics())
    assert len(seen) == found
    for gate in seen:
        assert gate.corners == pytest.approx(np.array(SQUARE), abs=1.5)


def test_a_gate_too_far_away_is_ignored() -> None:
    picture = hole(*SQUARE)
    assert len(GateDetector((255, 0, 0)).detect(picture, FRONT_CAMERA.intrinsics())) == 1
    assert GateDetector((255, 0, 0), (40.0, 40.0)).detect(picture, FRONT_CAMERA.intrinsics()) == []


def test_invalid_arguments_are_refused() -> None:
    with pytest.raises(UsageError, match="too grey"):
        GateDetector((90, 90, 90))
    with pytest.raises(UsageError, match="from 0 to 255"):
        GateDetector((256, 0, 0))
    with pytest.raises(UsageError, match="inner_size_m"):
        GateDetector((255, 0, 0), (0.0, 1.0))
    with pytest.raises(UsageError, match="shape"):
        GateDetector((255, 0, 0)).detect(GREY[..., 0], FRONT_CAMERA.intrinsics())
    with pytest.raises(UsageError, match="no intrinsics"):
        GateDetector((255, 0, 0)).detect(GREY)


def test_blobs_give_bearing_and_width() -> None:
    picture = GREY.copy()
    picture[50:200, 100:130] = (20, 110, 235)
    picture[50:60, 200:204] = (20, 110, 235)  # too narrow
    intrinsics = Intrinsics(fx=280.0, fy=280.0, cx=159.5, cy=119.5)
    (blob,) = BlobDetector((235, 110, 20)).detect(picture, intrinsics)
    assert blob.bearing_rad == pytest.approx(math.atan(45 / 280), abs=0.005)
    assert blob.width_rad == pytest.approx(30 / 280, abs=0.01)
    assert blob.outline[0] == pytest.approx((100, 50), abs=1)


def test_the_ground_gives_the_path_in_spite_of_tilt_and_rotation(renderer: PlanarRenderer) -> None:
    tracker = GroundTracker(BOTTOM_CAMERA.info())
    begin = np.array([-4.0, -1.0, 1.2])
    errors, picture = [], GREY
    for number in range(60):
        t = number / 15
        place = begin + np.array([0.4 * t, 0.2 * math.sin(t), 0.1 * math.sin(2 * t)])
        attitude = (0.08 * math.sin(3 * t), 0.06 * math.cos(2 * t), 0.3 * math.sin(0.5 * t))
        picture, _ = taken(renderer, BOTTOM_CAMERA, place, attitude, number)
        state = Feedback(
            captured_ns=number,
            roll_rad=attitude[0],
            pitch_rad=attitude[1],
            yaw_rad=attitude[2],
            altitude_m=float(place[2]),
        )
        found = tracker.see(picture, state, BOTTOM_CAMERA.intrinsics())
        assert (found is None) == (number == 0)
        if found is not None:
            errors.append(float(np.linalg.norm(found[0] - (place - begin)[:2])))
    assert max(errors) < 0.06
    assert len(tracker.points) >= 8
    assert tracker.see(picture, Feedback(captured_ns=99), BOTTOM_CAMERA.intrinsics()) is None
    assert tracker.points == ()


def test_ground_without_texture_is_not_tracked() -> None:
    tracker = GroundTracker(BOTTOM_CAMERA.info())
    state = Feedback(captured_ns=0, roll_rad=0.0, pitch_rad=0.0, yaw_rad=0.0, altitude_m=1.0)
    for _ in range(3):
        assert tracker.see(GREY, state, BOTTOM_CAMERA.intrinsics()) is None
