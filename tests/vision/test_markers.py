"""Markers drawn by a homography are found at their places."""

from __future__ import annotations

import builtins
import contextlib
import sys
import time
from typing import Any

import cv2
import numpy as np
import pytest

from skyloop.errors import MissingExtraError, UnknownNameError, UsageError
from skyloop.messages import CameraInfo, Feedback, FlightState, Intrinsics
from skyloop.vision import MarkerDetector, MarkerSighting
from skyloop.vision.marker_fit import fit_pattern
from skyloop.vision.marker_pose import PoseChoice, solutions
from skyloop.vision.planar import rectangle
from tests.support.marker_pictures import INTRINSICS, facing, picture, project, square

FORWARD = (0.0, 0.0, 1.0, -1.0, 0.0, 0.0, 0.0, -1.0, 0.0)


def see(rotation: np.ndarray, position: list[float], **kwargs: Any) -> MarkerSighting:
    image = picture([(7, rotation, np.array(position))])
    (sighting,) = MarkerDetector().detect(image, INTRINSICS, **kwargs)
    return sighting


@pytest.mark.parametrize("turn", [0.0, 0.5, -0.8])
@pytest.mark.parametrize("nod", [0.0, 0.3])
@pytest.mark.parametrize("position", [[0.0, 0.0, 1.5], [0.4, -0.25, 1.2], [-0.5, 0.3, 2.5]])
def test_pose_of_a_marker(turn: float, nod: float, position: list[float]) -> None:
    rotation = facing(turn, nod)
    sighting = see(rotation, position)
    assert sighting.id == 7
    expected = project(square(rotation, np.array(position), 0.3))
    assert np.abs(sighting.corners - expected).max() < 0.7
    assert sighting.distance_m == pytest.approx(np.linalg.norm(position), rel=0.02)
    assert np.linalg.norm(sighting.position_m - position) < 0.03 * sighting.distance_m
    # Nearly from the front, both directions of rotation look the same: only clear rotations must be recovered.
    angle = np.arccos(np.clip(sighting.normal @ rotation[:, 2], -1, 1))
    assert angle < (0.15 if sighting.ambiguity < 0.3 else 0.9)


def degraded(
    image: np.ndarray, blur_px: float = 0.0, motion_px: int = 0, noise: float = 2.0, seed: int = 0
) -> np.ndarray:
    """The image blurred, smeared sideways and with noise."""
    seen = image.astype(np.float64)
    if blur_px:
        seen = np.asarray(cv2.GaussianBlur(seen, (0, 0), blur_px), np.float64)
    if motion_px:
        seen = np.asarray(cv2.blur(seen, (motion_px, 1)), np.float64)
    seen += np.random.default_rng(seed).normal(0.0, noise, seen.shape)
    return seen.round().clip(0, 255).astype(np.uint8)


@pytest.mark.parametrize(
    ("turn", "nod", "distance", "how"),
    [
        (0.35, 0.2, 1.6, {}),
        (1.0, 0.1, 1.6, {}),
        (0.35, 0.2, 3.2, {}),
        (0.35, 0.2, 1.6, {"blur_px": 2.0}),
        (0.35, 0.2, 1.6, {"motion_px": 7}),
        (0.35, 0.2, 1.6, {"noise": 10.0}),
    ],
)
def test_corners_are_exact_to_a_tenth_of_a_pixel(turn: float, nod: float, distance: float, how: dict[str, Any]) -> None:
    """Blur, motion and tilt moved them by 0.3 to 1.3 px when each corner was refined by its surroundings."""
    rotation, position = facing(turn, nod), np.array([0.21, -0.13, distance])
    image = degraded(picture([(7, rotation, position)]), **how)
    (sighting,) = MarkerDetector().detect(image, INTRINSICS)
    off = np.linalg.norm(sighting.corners - project(square(rotation, position, 0.3)), axis=1)
    assert off.mean() < 0.1
    assert sighting.distance_m == pytest.approx(np.linalg.norm(position), rel=0.003)


def test_a_sharp_shadow_moves_no_corner() -> None:
    rotation, position = facing(0.3), np.array([0.1, 0.05, 1.2])
    image = picture([(7, rotation, position)]).astype(np.float64)
    image[:, 185:] *= 0.5
    (sighting,) = MarkerDetector().detect(degraded(image), INTRINSICS)
    assert np.abs(sighting.corners - project(square(rotation, position, 0.3))).max() < 0.3


def test_covariance_covers_the_errors() -> None:
    rotation, position = facing(0.5, 0.2), np.array([0.2, -0.1, 2.0])
    image, detector = picture([(7, rotation, position)]), MarkerDetector()
    ratios = []
    for seed in range(30):
        (sighting,) = detector.detect(degraded(image, blur_px=0.7, noise=8.0, seed=seed), INTRINSICS)
        turned = cv2.Rodrigues(rotation @ sighting.rotation.T)[0].ravel()
        error = np.concatenate([position - sighting.position_m, turned])
        assert sighting.covariance.shape == (6, 6)
        ratios.append(error @ np.linalg.solve(sighting.covariance, error) / 6)
    assert 0.2 < np.mean(ratios) < 3.0


def test_both_poses_of_a_square_are_given() -> None:
    sighting = see(facing(0.5), [0.0, 0.0, 2.0])
    assert sighting.other is not None
    _, rotation, error_px = sighting.other
    assert sighting.error_px < error_px
    assert sighting.normal[0] * rotation[0, 2] < 0.0  # the other one turns the other way
    assert sighting.ambiguity == pytest.approx(sighting.error_px / error_px)


def test_the_right_pose_is_chosen_by_motion() -> None:
    """The marker's normal stays while the camera passes it, and the other pose's turns."""
    rng, choice, alone, together = np.random.default_rng(1), PoseChoice(), [], []
    for n in range(60):
        aside = 0.1 + 0.5 * n / 60
        right, other = np.array([0.0, 0.0, -1.0]), np.array([np.sin(2 * aside), 0.0, -np.cos(2 * aside)])
        costs = rng.normal((6.0, 7.0), 1.5)
        alone.append(int(np.argmin(costs)))
        together.append(choice.choose(costs.tolist(), [right, other], 1_000_000_000 + n * 33_000_000))
    assert sum(alone) > 10
    assert sum(together[5:]) == 0
    # After a second out of view, only the image counts.
    assert choice.choose([9.0, 2.0], [right, other], 10_000_000_000) == 1


def test_a_pose_is_not_its_own_rival() -> None:
    """Refining both solutions of IPPE often led to the same pose, as if the marker were ambiguous."""
    rng, outline = np.random.default_rng(1), rectangle(0.3, 0.3)
    sigma, ambiguities = 0.1 / 280.0, []
    for _ in range(300):
        position = np.array([*rng.uniform(-0.3, 0.3, 2), 1.0]) * rng.uniform(0.5, 1.5)
        seen = square(facing(*rng.uniform(-0.3, 0.3, 2)), position, 0.3)
        rays = seen[:, :2] / seen[:, 2:] + rng.normal(0.0, sigma, (4, 2))
        first, other = solutions(cv2, outline, rays, np.eye(8) * sigma**2)
        ambiguities.append(first.error / other.error)
    assert np.mean(np.array(ambiguities) > 0.9) < 0.05


class Photo(np.ndarray):
    """An image with what a frame knows about it."""

    captured_ns = 0
    feedback: Any = None


def photo(image: np.ndarray, captured_s: float, feedback: Feedback | None = None) -> Photo:
    taken = image.view(Photo)
    taken.captured_ns, taken.feedback = round((1.0 + captured_s) * 1e9), feedback
    return taken


def test_an_attitude_that_is_unknown_for_a_moment_does_not_turn_a_marker() -> None:
    """Normals in world axes were compared with those in the camera's, and the wrong pose was nearer."""
    camera = CameraInfo("front", 320, 240, 30.0, rotation=FORWARD)
    rotation = facing(0.5, 0.1)
    how: dict[str, Any] = {"blur_px": 0.7, "noise": 6.0}
    image = picture([(7, rotation, np.array([0.2, 0.1, 5.5]))])
    (alone,) = MarkerDetector().detect(degraded(image, **how), INTRINSICS)
    assert alone.other is not None
    # An attitude in which the right normal in world axes is the wrong one in the camera's.
    mounting = np.array(FORWARD).reshape(3, 3)
    body = facing(-1.0) @ facing().T @ mounting.T
    yaw, pitch = np.arctan2(body[1, 0], body[0, 0]), -np.arcsin(body[2, 0])
    roll = np.arctan2(body[2, 1], body[2, 2])
    known = Feedback(captured_ns=0, state=FlightState.FLYING, roll_rad=roll, pitch_rad=pitch, yaw_rad=yaw)
    assert np.allclose(known.rotation, body)
    assert np.linalg.norm(known.rotation @ mounting @ alone.normal - alone.other[1][:, 2]) < 0.4
    detector = MarkerDetector()
    for n in range(12):
        feedback = None if n in (5, 9) else known
        noisy = photo(degraded(image, seed=n, **how), n / 30, feedback)
        (sighting,) = detector.detect(noisy, INTRINSICS, camera=camera)
        assert sighting.normal @ rotation[:, 2] > 0.95, n


def test_markers_with_the_same_id_do_not_turn_one_another() -> None:
    left, right = facing(0.5, 0.1), facing(-0.5, 0.1)
    image = picture([(7, left, np.array([-0.6, 0.1, 5.5])), (7, right, np.array([0.6, 0.1, 5.5]))])
    detector = MarkerDetector()
    for n in range(8):
        noisy = degraded(image, blur_px=0.7, noise=6.0, seed=n)
        together = detector.detect(photo(noisy, n / 30), INTRINSICS)
        alone = MarkerDetector().detect(noisy, INTRINSICS)
        assert len(together) == 2
        for one, other in zip(together, alone, strict=True):
            assert one.normal @ other.normal > 0.99, n


def test_corners_that_meet_are_fitted_in_no_time() -> None:
    """The first guess of the blur grew with the inverse of the area: its kernel would have filled the memory."""
    image, pattern = np.full((240, 320), 90, np.uint8), np.zeros((6, 6), dtype=bool)
    corners = np.array([[100.0, 100.0], [112.0, 100.02], [112.0, 100.0], [100.0, 100.02]])
    begin = time.perf_counter()
    with contextlib.suppress(np.linalg.LinAlgError):
        fit_pattern(cv2, image, corners, pattern, lambda points: points, 1.0)
    assert time.perf_counter() - begin < 1.0


def test_a_marker_of_twelve_pixels_is_found() -> None:
    found = 0
    for seed in range(10):
        x, y = np.random.default_rng(seed).uniform(-0.5, 0.5, 2)
        image = degraded(picture([(7, facing(0.3), np.array([x, y, 7.0]))]), seed=seed)
        found += [one.id for one in MarkerDetector().detect(image, INTRINSICS)] == [7]
    assert found >= 9


def test_far_marker_is_still_found() -> None:
    assert see(facing(), [0.5, 0.2, 5.0]).distance_m == pytest.approx(5.03, rel=0.05)


def test_without_markers() -> None:
    empty = np.full((240, 320, 3), 90, np.uint8)
    noise = np.random.default_rng(1).integers(0, 255, (240, 320, 3), dtype=np.uint8)
    detector = MarkerDetector()
    assert detector.detect(empty, INTRINSICS) == []
    assert detector.detect(noise, INTRINSICS) == []
    turned_away = picture([(7, facing(np.pi), np.array([0, 0, 1.5]))])
    assert [s.id for s in detector.detect(turned_away, INTRINSICS)] != [7]


def test_several_in_the_order_of_their_ids() -> None:
    places = {9: [-0.5, 0.0, 2.0], 3: [0.5, 0.1, 2.2], 21: [0.0, -0.5, 2.5]}
    image = picture([(number, facing(), np.array(place)) for number, place in places.items()])
    seen = MarkerDetector().detect(image, INTRINSICS)
    assert [s.id for s in seen] == [3, 9, 21]
    for sighting in seen:
        assert np.linalg.norm(sighting.position_m - places[sighting.id]) < 0.06


def test_many_markers_do_not_take_a_flight_s_time(monkeypatch: pytest.MonkeyPatch) -> None:
    """A wall of 48 took half a second of a processor; the nearest ones are fitted, and the others keep their lines."""
    fitted: list[np.ndarray] = []

    def fit(cv: Any, image: np.ndarray, corners: np.ndarray, *others: Any) -> Any:
        fitted.append(corners)
        return fit_pattern(cv, image, corners, *others)

    monkeypatch.setattr("skyloop.vision.planar.fit_pattern", fit)
    places = [np.array([0.45 * (n % 4) - 0.7, 0.45 * (n // 4) - 0.45, 1.8 + 0.1 * n]) for n in range(12)]
    found = MarkerDetector().detect(picture([(n, facing(), place) for n, place in enumerate(places)]), INTRINSICS)
    assert [one.id for one in found] == list(range(12))
    assert len(fitted) == 8
    assert max(corners[:, 1].max() for corners in fitted) < found[-1].corners[0, 1], "the farthest is not among them"
    for one, place in zip(found, places, strict=True):
        assert np.abs(one.corners - project(square(facing(), place, 0.3))).max() < 0.5


def test_body_axes() -> None:
    sighting = see(facing(), [0.3, 0.2, 1.5])
    camera = CameraInfo("front", 320, 240, 30.0, rotation=FORWARD, position_m=(0.1, 0.0, -0.02))
    right, down, ahead = sighting.position_m
    assert sighting.position_in_body(camera) == pytest.approx([ahead + 0.1, -right, -down - 0.02])
    assert sighting.normal_in_body(camera)[0] < -0.9
    with pytest.raises(UsageError, match="mounted"):
        sighting.position_in_body(CameraInfo("front", 320, 240, 30.0))


def test_distorted_lens() -> None:
    lens = Intrinsics(280.0, 280.0, 159.5, 119.5, distortion=(-0.25, 0.05, 0.001, -0.001, 0.0))
    straight = picture([(7, facing(0.4), np.array([0.35, 0.2, 1.5]))])
    x, y = np.meshgrid(np.arange(320.0), np.arange(240.0))
    pixels = np.stack([x.ravel(), y.ravel()], axis=1).reshape(-1, 1, 2)
    ideal = cv2.undistortPoints(pixels, lens.matrix, np.array(lens.distortion), P=lens.matrix)
    x, y = np.moveaxis(ideal.reshape(240, 320, 2).astype(np.float32), 2, 0)
    bent = np.asarray(cv2.remap(straight, x, y, cv2.INTER_LINEAR), np.uint8)
    (sighting,) = MarkerDetector().detect(bent, lens)
    assert np.linalg.norm(sighting.position_m - [0.35, 0.2, 1.5]) < 0.03


def test_fisheye_model_is_understood() -> None:
    lens = Intrinsics(280.0, 280.0, 159.5, 119.5, distortion=(0.0, 0.0, 0.0, 0.0), model="fisheye")
    straight = picture([(7, facing(), np.array([0.0, 0.0, 1.5]))])
    (sighting,) = MarkerDetector().detect(straight, lens)
    # In the middle a fisheye and a pinhole are the same to a few per mille.
    assert sighting.distance_m == pytest.approx(1.5, rel=0.03)


def test_grey_pictures_and_frames_with_intrinsics() -> None:
    class Seen(np.ndarray):
        intrinsics = INTRINSICS

    image = picture([(7, facing(), np.array([0.0, 0.0, 1.5]))])
    assert len(MarkerDetector().detect(image[:, :, 0], INTRINSICS)) == 1
    frame = image.view(Seen)
    frame.flags.writeable = False
    assert len(MarkerDetector().detect(frame)) == 1


def test_bad_input_is_reported() -> None:
    good = np.zeros((4, 4), np.uint8)
    with pytest.raises(UsageError, match="edge in metres"):
        MarkerDetector(size_m=-1)
    with pytest.raises(UnknownNameError, match="4x4_50"):
        MarkerDetector("4x4_5")
    with pytest.raises(UsageError, match="no intrinsics"):
        MarkerDetector().detect(good)
    with pytest.raises(UsageError, match="empty"):
        MarkerDetector().detect(np.zeros((0, 4), np.uint8), INTRINSICS)
    with pytest.raises(UsageError, match="float64"):
        MarkerDetector().detect(np.zeros((4, 4)), INTRINSICS)  # type: ignore[arg-type]
    with pytest.raises(UsageError, match="'pinhole' or 'fisheye'"):
        MarkerDetector().detect(
            picture([(7, facing(), np.array([0.0, 0.0, 1.5]))]), Intrinsics(280.0, 280.0, 160.0, 120.0, model="omni")
        )


def test_names_of_dictionaries() -> None:
    image = picture([(7, facing(), np.array([0.0, 0.0, 1.5]))])
    assert len(MarkerDetector("DICT_4X4_50").detect(image, INTRINSICS)) == 1
    assert MarkerDetector("apriltag_36h11").detect(image, INTRINSICS) == []


def test_without_opencv(monkeypatch: pytest.MonkeyPatch) -> None:
    real = builtins.__import__

    def refuse(name: str, *args: Any, **kwargs: Any) -> Any:
        if name == "cv2":
            raise ImportError("No module named 'cv2'")
        return real(name, *args, **kwargs)

    monkeypatch.delitem(sys.modules, "cv2")
    monkeypatch.setattr(builtins, "__import__", refuse)
    with pytest.raises(MissingExtraError, match="skyloop install vision"):
        MarkerDetector()


def test_a_detector_of_the_wrong_dictionary_says_which_tags_it_saw() -> None:
    """A beginner's valid but wrong dictionary: the flight ended well, without any hint."""
    image = np.full((240, 320, 3), 255, np.uint8)
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_6X6_250)
    for at, number in ((40, 7), (200, 60)):
        image[70:150, at : at + 80] = cv2.aruco.generateImageMarker(dictionary, number, 80)[:, :, None]
    detector = MarkerDetector("4x4_50")
    for _ in range(8 * 10):
        assert detector.detect(image, INTRINSICS) == []
    others = "7 of 6x6_50, 60 of 6x6_100"
    nothing = "no marker of 4x4_50 was found in 80 images"
    assert detector.why_nothing() == f"{nothing}, but markers of other dictionaries were: {others}"
    right = MarkerDetector("6x6_250")
    right.detect(image, INTRINSICS)
    assert right.why_nothing() == ""


def test_a_detector_that_sees_nothing_says_so_after_some_images() -> None:
    detector, empty = MarkerDetector(), np.full((240, 320, 3), 90, np.uint8)
    assert detector.why_nothing() == ""
    for _ in range(100):
        detector.detect(empty, INTRINSICS)
    assert detector.why_nothing().startswith("no marker of 4x4_50 was found in 100 images, nor of another")
