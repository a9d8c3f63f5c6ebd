"""Paths: does the velocity match the position, and are speeds, ends and corners as configured?"""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import assume, example, given
from hypothesis import strategies as st

from skyloop.control.path import Circle, FunctionPath, Lemniscate, MotionProfile, Path, Polyline, Spline
from skyloop.errors import UsageError

SQUARE = [(0, 0, 1), (2, 0, 1), (2, 2, 1), (0, 2, 1), (0, 0, 1)]
PATHS: dict[str, Path] = {
    "stops": Polyline(SQUARE),
    "rounded": Polyline(SQUARE, corner_m=0.3, speed_m_s=0.7),
    "circle": Circle((1, 2, 1), 1.5, laps=1.5, clockwise=True),
    "eight": Lemniscate((0, 0, 1), 2.0, yaw_rad=0.5),
    "function": FunctionPath(lambda t: (math.sin(t) ** 2, 0.0, 1.0), 2 * math.pi),
    "told": FunctionPath(lambda t: (t**2, 0, 1), 2.0, lambda t: (2 * t, 0, 0)),
}


def spline() -> Spline:
    pytest.importorskip("scipy", reason="splines are SciPy's")
    return Spline([(0, 0, 1), (1, 1, 1.5), (2, 0, 1)], [0.0, 3.0, 5.0])


def path(name: str) -> Path:
    return spline() if name == "spline" else PATHS[name]


@pytest.mark.parametrize("name", [*PATHS, "spline"])
def test_the_velocity_matches_the_position(name: str) -> None:
    flown = path(name)
    end, h = flown.duration_s, 1e-4
    for t in np.linspace(0.01, end - 0.01, 500):
        slope = (flown.position(t + h) - flown.position(t - h)) / (2 * h)
        assert flown.velocity(t) == pytest.approx(slope, abs=0.02)
    assert flown.velocity(-1.0) == pytest.approx([0, 0, 0])
    assert flown.velocity(end + 1.0) == pytest.approx([0, 0, 0])
    assert flown.position(-1.0) == pytest.approx(flown.position(0.0))
    assert flown.position(end + 1.0) == pytest.approx(flown.position(end), abs=1e-6)


@pytest.mark.parametrize(("name", "speed"), [("stops", 0.5), ("rounded", 0.7), ("circle", 0.5), ("eight", 0.5)])
def test_speed_and_acceleration_stay_within_their_limits(name: str, speed: float) -> None:
    flown = path(name)
    times = np.arange(0, flown.duration_s, 0.01)
    velocities = np.array([flown.velocity(t) for t in times])
    speeds = np.linalg.norm(velocities, axis=1)
    assert speeds.max() == pytest.approx(speed, rel=0.01)
    changes = np.linalg.norm(np.diff(velocities, axis=0), axis=1) / 0.01
    # at most 0.8 along the path, plus v²/r across it, as much again on arcs
    assert changes.max() < 0.8 * math.sqrt(2) + 0.02


def test_a_square_with_stops_takes_the_expected_time() -> None:
    leg = 2 / 0.5 + 0.5 / 0.8  # the trapezoid loses v/a
    assert Polyline(SQUARE).duration_s == pytest.approx(4 * leg)
    assert Polyline(SQUARE).position(leg) == pytest.approx([2, 0, 1])
    assert Polyline(SQUARE).velocity(leg) == pytest.approx([0, 0, 0], abs=1e-6)
    assert Polyline(SQUARE).velocity(leg / 2) == pytest.approx([0.5, 0, 0])


def test_corners_are_cut_as_configured() -> None:
    flown = PATHS["rounded"]
    points = np.array([flown.position(t) for t in np.arange(0, flown.duration_s, 0.01)])
    nearest = np.min(np.linalg.norm(points - [2, 0, 1], axis=1))
    assert nearest == pytest.approx(0.3 * (math.sqrt(2) - 1), abs=0.01), "an arc of 90° and radius 0.3"
    assert flown.duration_s < Polyline(SQUARE, speed_m_s=0.7).duration_s


def test_a_way_back_and_a_straight_joint() -> None:
    back = Polyline([(0, 0, 1), (1, 0, 1), (0, 0, 1)], corner_m=0.3)
    assert min(np.linalg.norm(back.position(t) - [1, 0, 1]) for t in np.arange(0, 6, 0.01)) < 1e-3
    straight = Polyline([(0, 0, 1), (1, 0, 1), (1, 0, 1), (2, 0, 1)], corner_m=0.3)
    assert straight.position(straight.duration_s) == pytest.approx([2, 0, 1])


def test_values_that_can_not_be_divided_by_are_refused() -> None:
    for numbers in (
        {"speed_m_s": 5e-324},
        {"acceleration_m_s2": 5e-324},
        {"speed_m_s": 1e300},
        {"speed_m_s": math.nan},
    ):
        for make in (
            lambda **one: Polyline(SQUARE, **one),
            lambda **one: Circle((0, 0, 1), 1.0, **one),
            lambda **one: Lemniscate((0, 0, 1), 1.0, **one),
        ):
            with pytest.raises(UsageError, match="must be from 1e-06 to 1e"):
                make(**numbers)
    for radius in (5e-324, 1e300):
        with pytest.raises(UsageError, match="radius_m"):
            Circle((0, 0, 1), radius)
        with pytest.raises(UsageError, match="half_width_m"):
            Lemniscate((0, 0, 1), radius)
    with pytest.raises(UsageError, match="at most"):
        Polyline([(0, 0, 0), (1e300, 0, 0)])
    with pytest.raises(UsageError, match="at least"):
        Spline([(0, 0, 0), (1, 0, 0)], [0.0, 5e-324])
    with pytest.raises(UsageError, match="never ends"):
        MotionProfile([(1.0, 0.0)], 1.0)


@given(
    st.lists(st.tuples(st.floats(0.0, 10.0), st.floats(0.01, 5.0)), min_size=1, max_size=8),
    st.floats(0.05, 10.0),
)
@example([(0.5, 1.0), (5e-324, 1.0)], 0.4)
@example([(5e-324, 1.0), (0.5, 1.0), (1e-200, 0.01)], 0.05)
def test_profiles_keep_each_stretch_s_limit(stretches: list[tuple[float, float]], acceleration: float) -> None:
    total = sum(length for length, _ in stretches)
    assume(total > 0.01)
    profile = MotionProfile(stretches, acceleration)
    assert profile.length_m == pytest.approx(total, rel=1e-6)
    ends = np.cumsum([length for length, _ in stretches])
    before = (0.0, 0.0)
    for t in np.linspace(0.0, profile.duration_s, 60):
        way, speed = profile.at(float(t))
        assert way >= before[0] - 1e-9
        k = min(int(np.searchsorted(ends, way - 1e-6)), len(stretches) - 1)
        assert speed <= stretches[k][1] + 1e-3 * (1 + speed)
        before = way, speed
    assert profile.at(profile.duration_s) == (profile.length_m, 0.0)
    assert profile.at(0.0) == (0.0, 0.0)


def test_a_circle_has_the_right_direction() -> None:
    left = Circle((0, 0, 1), 1.0, begin_rad=math.pi / 2)
    assert left.position(0.0) == pytest.approx([0, 1, 1])
    assert left.velocity(1.0)[0] < 0.0, "counter-clockwise from the north is westward"
    assert left.position(left.duration_s) == pytest.approx([0, 1, 1])


@pytest.mark.parametrize(
    "make",
    [
        lambda: Polyline([(0, 0, 1)]),
        lambda: Polyline([(0, 0, 1), (0, 0, 1)]),
        lambda: Polyline([(0, 0), (1, 1)]),
        lambda: Polyline(SQUARE, speed_m_s=0.0),
        lambda: Polyline(SQUARE, corner_m=-1.0),
        lambda: Polyline([(0, 0, math.nan), (1, 1, 1)]),
        lambda: Circle((0, 0, 1), 0.0),
        lambda: Circle((0, 0, 1), 1.0, laps=math.inf),
        lambda: Lemniscate((0, 0, 1), -1.0),
        lambda: FunctionPath(lambda t: (t, 0, 1), 0.0),
        lambda: Spline([(0, 0, 1)], [0.0]),
        lambda: Spline([(0, 0, 1), (1, 0, 1)], [0.0, 0.0]),
        lambda: Spline([(0, 0, 1), (1, 0, 1)], [1.0, 2.0]),
    ],
)
def test_invalid_arguments(make: object) -> None:
    with pytest.raises(UsageError):
        make()  # type: ignore[operator]
