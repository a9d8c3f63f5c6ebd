"""A target from its boxes: directions against a simulated camera, position with and without knowledge and ground."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from skyloop.clock import nanoseconds
from skyloop.control.target_estimate import (
    TRAITS,
    UNKNOWN,
    BoxView,
    CameraPose,
    TargetEstimator,
    TargetState,
    Traits,
    predicted_box,
)
from skyloop.errors import UsageError
from skyloop.messages import CameraInfo, Feedback
from skyloop.messages.geometry import wrap_angle
from skyloop.sim.camera import FRONT_CAMERA
from tests.support.target_world import PERIOD_S, PERSON, SIZE, Path, box_of, camera_at, state, view_of, walk

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
    assert CameraPose.at(FRONT_CAMERA.info(), Feedback(captured_ns=1, yaw_rad=0.0), origin, lens, SIZE) is None


def test_a_camera_needs_a_known_orientation_but_no_position() -> None:
    lens, origin = FRONT_CAMERA.intrinsics(), np.zeros(3)
    with pytest.raises(UsageError, match="mounted"):
        CameraPose.at(CameraInfo("front", 320, 240, 15.0), state(), origin, lens, SIZE)
    plain = CameraInfo("front", 320, 240, 15.0, rotation=FRONT_CAMERA.rotation)
    camera = CameraPose.at(plain, state(), origin, lens, SIZE)
    assert camera is not None
    assert camera.position.tolist() == [0.0, 0.0, 0.0]


CASE_OF_SIZE = replace(PERSON, on_ground=False)
CASE_OF_GROUND = replace(UNKNOWN, radius_m=0.25)


def watched(
    traits: Traits,
    path: Path,
    *,
    seconds: float = 6.0,
    ground: bool = False,
    seed: int = 1,
    eye: Callable[[float], tuple[float, float]] = lambda t: (0.0, 0.0),
    at: list[TargetState] | None = None,
) -> TargetEstimator:
    """Return a filter after the boxes of a person on a path, seen from a moving vehicle."""
    estimator, rng = TargetEstimator(traits), np.random.default_rng(seed)
    for n in range(round(seconds / PERIOD_S) + 1):
        now = n * PERIOD_S
        x, y = path(now)
        ex, ey = eye(now)
        camera = camera_at(ex, ey, yaw=math.atan2(y - ey, x - ex))
        foot, at_ns = np.array([x, y, 0.0]), nanoseconds(now)
        view = view_of(camera, foot, rng=rng)
        if n == 0:
            estimator.start(view, camera, at_ns, ground=ground)
        else:
            assert estimator.update(view, camera, at_ns)
        if at is not None:
            at.append(estimator.at(at_ns))
    return estimator


def off(state: TargetState, path: Path, seconds: float) -> float:
    return float(np.hypot(*(state.foot[:2] - np.array(path(seconds)))))


@pytest.mark.parametrize(
    ("traits", "ground"),
    [(CASE_OF_SIZE, False), (CASE_OF_GROUND, True), (PERSON, True)],
    ids=["size", "ground", "both"],
)
@pytest.mark.parametrize("path", [walk(5.0, -2.0, 0.0, 0.8), walk(6.0, 1.0, -0.5, -0.3)], ids=["across", "nearer"])
def test_place_and_velocity_converge(traits: Traits, ground: bool, path: Path) -> None:
    found = watched(traits, path, ground=ground).at(nanoseconds(6.0))
    assert off(found, path, 6.0) < 0.5
    velocity = np.subtract(path(1.0), path(0.0))
    assert found.velocity == pytest.approx(velocity, abs=0.35)
    assert found.range_deviation_m < 0.5
    assert found.height_m == pytest.approx(1.72, rel=0.12)
    assert found.middle == pytest.approx(np.add(found.foot, [0.0, 0.0, found.height_m / 2]))


def test_an_unknown_target_starts_at_the_nominal_distance() -> None:
    camera = camera_at()
    for nominal_m in (2.0, 4.0, 7.0):
        estimator = TargetEstimator(nominal_m=nominal_m)
        estimator.start(view_of(camera, np.array([6.0, 0.0, 0.0])), camera, 0, ground=False)
        found = estimator.at(0)
        assert found.range_m == pytest.approx(nominal_m)
        assert found.range_deviation_m > 0.3 * nominal_m


def test_the_vehicles_own_motion_reveals_the_range_of_an_unknown_target() -> None:
    still, path = replace(UNKNOWN, intensity_m2_s3=0.02), walk(6.5, 0.0)
    for seed in range(3):
        standing = watched(still, path, seconds=7.0, seed=seed).at(nanoseconds(7.0))
        moving = watched(still, path, eye=lambda t: (0.4 * t, 0.2 * t), seconds=7.0, seed=seed).at(nanoseconds(7.0))
        assert moving.range_deviation_m < 0.7 * standing.range_deviation_m < 0.7 * 2.0
        assert off(moving, path, 7.0) < 0.7 * off(standing, path, 7.0)


@pytest.mark.parametrize(
    ("traits", "ground"),
    [(CASE_OF_SIZE, False), (CASE_OF_GROUND, True), (PERSON, True)],
    ids=["size", "ground", "both"],
)
def test_the_deviation_is_honest(traits: Traits, ground: bool) -> None:
    path, within, total = walk(4.0, -2.0, 0.1, 0.7), 0, 0
    for seed in range(6):
        states: list[TargetState] = []
        watched(traits, path, seconds=4.0, ground=ground, seed=seed, at=states)
        for n, each in list(enumerate(states))[5:]:
            total += 1
            within += off(each, path, n * PERIOD_S) < 3.0 * max(each.place_m, 0.05)
    assert within / total > 0.9


def test_with_the_ground_an_oversized_target_does_not_seem_far() -> None:
    tall = replace(PERSON, height_m=1.5)
    found = watched(tall, walk(5.0, 0.0), ground=True).at(nanoseconds(6.0))
    assert found.range_m == pytest.approx(5.0 - 0.12, abs=0.7)


def test_a_hidden_target_keeps_its_motion_from_before_its_boxes_were_cut() -> None:
    """The middle of a cut-off box lags behind at the edge of a wall."""
    path, camera = walk(5.0, -1.0, 0.0, 1.2), camera_at()
    estimator = watched(PERSON, path, ground=True, seconds=2.0, eye=lambda t: (0.0, 0.0))
    last_s = 2.0
    for n in range(1, 4):  # three boxes, each with less of him
        x, y = path(last_s + n * PERIOD_S)
        cut = view_of(camera_at(yaw=math.atan2(y, x)), np.array([x, y - 0.12 * n, 0.0]))
        assert estimator.update(cut, camera, nanoseconds(last_s + n * PERIOD_S))
    last_s += 3 * PERIOD_S
    newest = estimator.at(nanoseconds(last_s))
    naive = newest.foot[:2] + newest.velocity * 2.0
    found = estimator.at(nanoseconds(last_s + 2.0))
    assert off(found, path, last_s + 2.0) < 0.6 * float(np.hypot(*(naive - path(last_s + 2.0))))
    assert off(estimator.at(nanoseconds(last_s + 0.1)), path, last_s + 0.1) > 0.1, (
        "one or two missed images change nothing"
    )


def test_a_box_may_be_too_small_but_not_too_large() -> None:
    path, camera = walk(6.0, 0.0), camera_at()
    estimator = watched(PERSON, path, ground=True, seconds=2.0)
    x, y, width, height = box_of(camera, np.array([6.0, 0.0, 0.0])) or (0.0, 0.0, 0.0, 0.0)
    boxes = {
        "its own": (x, y, width, height),
        "somebody nearer": (x, y - 0.3 * height, width, 1.6 * height),
        "its upper half": (x, y, width, 0.5 * height),
    }
    fits = {}
    for name, box in boxes.items():
        view = BoxView.of(box, camera)
        assert view is not None
        fits[name] = estimator.distance(view, camera, nanoseconds(2.0))[0]
    assert fits["its own"] < 2.0
    assert math.isinf(fits["somebody nearer"])
    assert math.isfinite(fits["its upper half"])


def test_infrequent_boxes_do_not_mean_hiding() -> None:
    path, estimator = walk(5.0, -1.0, 0.0, 0.6), TargetEstimator(PERSON)
    for n in range(12):  # two images per second
        x, y = path(n / 2)
        view = view_of(camera_at(yaw=math.atan2(y, x)), np.array([x, y, 0.0]))
        if n == 0:
            estimator.start(view, camera_at(), 0, ground=True)
        assert estimator.update(view, camera_at(), nanoseconds(n / 2))
    now = estimator.at(nanoseconds(5.5))
    assert estimator.at(nanoseconds(6.0)).foot[:2] == pytest.approx(now.foot[:2] + 0.5 * now.velocity)


def test_an_unseen_target_becomes_less_and_less_certain() -> None:
    estimator = watched(PERSON, walk(5.0, 0.0, 0.0, 0.5), ground=True, seconds=3.0)
    states = [estimator.at(nanoseconds(3.0 + later)) for later in (0.0, 1.0, 2.0, 5.0)]
    assert [one.place_m for one in states] == sorted(one.place_m for one in states)
    assert states[-1].place_m > 3 * states[0].place_m
    # The prediction does not move it forever.
    way = states[3].foot[:2] - states[0].foot[:2]
    assert float(np.hypot(*way)) == pytest.approx(3.8 * float(np.hypot(*states[0].velocity)), rel=0.1)


def test_a_box_in_another_direction_is_refused() -> None:
    estimator = watched(PERSON, walk(5.0, 0.0), ground=True, seconds=2.0)
    camera, before = camera_at(), estimator.at(nanoseconds(2.1))
    elsewhere = view_of(camera, np.array([5.0, 2.5, 0.0]))
    assert not estimator.update(elsewhere, camera, nanoseconds(2.1))
    assert estimator.refused == 1
    assert estimator.at(nanoseconds(2.1)).foot == pytest.approx(before.foot)
    assert estimator.seen_ns == nanoseconds(2.0)
    fit, _ = estimator.distance(elsewhere, camera, nanoseconds(2.1))
    own, _ = estimator.distance(view_of(camera, np.array([5.0, 0.0, 0.0])), camera, nanoseconds(2.1))
    assert own < 3.0 < 20.0 < fit
    assert estimator.update(view_of(camera, np.array([5.0, 0.0, 0.0])), camera, nanoseconds(2.2))
    assert estimator.refused == 0


@pytest.mark.parametrize("hidden", ["foot", "head"])
def test_a_hidden_edge_is_ignored(hidden: str) -> None:
    estimator = watched(PERSON, walk(5.0, 0.0), ground=True, seconds=3.0)
    camera = camera_at()
    whole = view_of(camera, np.array([5.0, 0.0, 0.0]))
    assert whole.top is not None
    assert whole.bottom is not None
    middle = (whole.top + whole.bottom) / 2
    half = replace(whole, bottom=middle) if hidden == "foot" else replace(whole, top=middle)
    for n in range(1, 16):
        assert estimator.update(half, camera, nanoseconds(3.0 + n * PERIOD_S))
    found = estimator.at(nanoseconds(4.0))
    assert found.range_m == pytest.approx(5.0 - 0.12, abs=0.5)
    assert found.height_m == pytest.approx(1.72, rel=0.1)


def test_a_bound_moves_only_an_edge_beyond_it() -> None:
    camera = camera_at()
    foot = np.array([4.0, 0.0, 0.0])
    for below, nearer in ((-0.28, False), (-0.37, True)):
        estimator = watched(PERSON, walk(4.0, 0.0), ground=True, seconds=0.2)
        before = estimator.at(nanoseconds(0.3)).range_m
        cut = replace(view_of(camera, foot), top=None, bottom=None, below=below)
        assert estimator.update(cut, camera, nanoseconds(0.3))
        after = estimator.at(nanoseconds(0.3)).range_m
        assert (after < before - 0.02) is nearer
        assert after <= before + 0.02


@pytest.mark.parametrize(("late_s", "used"), [(0.1, True), (0.3, True), (0.45, True), (0.55, False), (3.0, False)])
def test_a_late_box_is_used_for_half_a_second(late_s: float, used: bool) -> None:
    path = walk(5.0, -1.0, 0.0, 1.0)
    estimator, camera = watched(CASE_OF_SIZE, path, seconds=2.0), camera_at()
    before = estimator.at(nanoseconds(2.0))
    late = view_of(camera, np.array([*path(2.0 - late_s), 0.0]))
    assert estimator.update(late, camera, nanoseconds(2.0 - late_s)) is used
    after = estimator.at(nanoseconds(2.0))
    assert (after.place_m < before.place_m) is used
    assert off(after, path, 2.0) < off(before, path, 2.0) + 0.1
    assert estimator.seen_ns == nanoseconds(2.0), "there was a newer box"


def test_it_catches_up_with_a_turning_target() -> None:
    def path(t: float) -> tuple[float, float]:
        return (5.0, -1.5 + 1.2 * t) if t < 3.0 else (5.0 - 1.2 * (t - 3.0), 2.1)

    found = watched(PERSON, path, ground=True, seconds=5.0).at(nanoseconds(5.0))
    assert off(found, path, 5.0) < 0.5
    assert found.velocity == pytest.approx([-1.2, 0.0], abs=0.5)


def test_without_the_vehicles_velocity_it_expects_harder_turns() -> None:
    camera, foot = camera_at(), np.array([5.0, 0.0, 0.0])
    deviations = []
    for relative in (False, True):
        estimator = TargetEstimator(PERSON, relative=relative)
        estimator.start(view_of(camera, foot), camera, 0, ground=True)
        deviations.append(estimator.at(nanoseconds(1.0)).place_m)
    assert deviations[1] > 1.04 * deviations[0]


def cut_off(**edges: float | None) -> tuple[BoxView, CameraPose]:
    camera = camera_at()
    return replace(view_of(camera, np.array([4.0, 0.0, 0.0])), **edges), camera  # type: ignore[arg-type]


@pytest.mark.parametrize("traits", [PERSON, UNKNOWN, CASE_OF_SIZE], ids=["person", "unknown", "size"])
@pytest.mark.parametrize("ground", [True, False])
@pytest.mark.parametrize(
    "edges",
    [{"bottom": None}, {"top": None}, {"bottom": None, "top": None}, {"bottom": 0.01}, {"top": -0.01}, {"top": 0.0}],
    ids=["no foot", "no head", "neither", "level foot", "head below", "level head"],
)
def test_it_starts_with_any_visible_edges(traits: Traits, ground: bool, edges: dict[str, float | None]) -> None:
    view, camera = cut_off(**edges)
    estimator = TargetEstimator(traits)
    estimator.start(view, camera, 0, ground=ground)
    found = estimator.at(0)
    assert 0.3 <= found.range_m < 100.0
    assert found.range_deviation_m > 0.0
    assert found.height_m > 0.0
    assert np.isfinite([*found.foot, *found.velocity, found.place_m]).all()
    assert math.atan2(found.foot[1], found.foot[0]) == pytest.approx(0.0, abs=0.02)
    for n in range(1, 5):
        assert estimator.update(view, camera, nanoseconds(n * PERIOD_S))
    assert np.isfinite(estimator.at(nanoseconds(1.0)).foot).all()


def test_head_and_ground_give_the_range_of_a_person_with_hidden_feet() -> None:
    camera = camera_at()
    estimator = TargetEstimator(PERSON)
    view = replace(view_of(camera, np.array([3.0, 0.0, 0.0])), bottom=None, below=-0.2)
    estimator.start(view, camera, 0, ground=True)
    found = estimator.at(0)
    assert found.range_m == pytest.approx(2.88, rel=0.15)
    assert found.range_deviation_m < 1.5, "2 m without them"


def test_a_filter_not_started_raises() -> None:
    estimator, camera = TargetEstimator(), camera_at()
    with pytest.raises(UsageError, match="no target yet"):
        estimator.at(0)
    with pytest.raises(UsageError, match="no target yet"):
        estimator.update(view_of(camera, np.array([4.0, 0.0, 0.0])), camera, 0)


@pytest.mark.parametrize(
    ("given", "why"),
    [
        ({"height_m": 0.0}, r"height_m is 0\.0 and must be from 0\.01 to 100"),
        ({"height_m": -1.7}, "height_m is -1.7"),
        ({"height_m": 101.0}, "height_m is 101"),
        ({"height_m": math.nan}, "height_m is nan"),
        ({"height_m": math.inf}, "height_m is inf"),
        ({"height_m": "1.7"}, "height_m is '1.7'"),
        ({"height_share": -0.1}, r"height_share is -0\.1 and must be a finite number, 0 or more"),
        ({"height_share": math.nan}, "height_share is nan"),
        ({"radius_m": math.inf}, "radius_m is inf"),
        ({"radius_m": None}, "radius_m is None"),
        ({"intensity_m2_s3": -1.0}, "intensity_m2_s3 is -1"),
    ],
)
def test_invalid_traits_are_refused(given: dict[str, object], why: str) -> None:
    with pytest.raises(UsageError, match=why):
        Traits(**given)  # type: ignore[arg-type]


def test_known_classes_are_plausible() -> None:
    assert {"person", "car"} <= set(TRAITS)
    assert all(each.radius_m < 3.0 for each in TRAITS.values())
    assert UNKNOWN.height_m is None
