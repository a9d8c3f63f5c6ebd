"""The place of the world axes on the earth, and the checks of a driver's numbers."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from skyloop.messages import Feedback
from skyloop.messages.feedback import EarthOrigin, is_on_earth

ZURICH = EarthOrigin(47.397742, 8.545594, 488.0, 6_371_000.0)
NEAR = st.floats(-5_000.0, 5_000.0)


@given(st.floats(-80.0, 80.0), st.floats(-180.0, 180.0), st.tuples(NEAR, NEAR, NEAR))
def test_round_trip(latitude: float, longitude: float, position: tuple[float, float, float]) -> None:
    origin = EarthOrigin(latitude, longitude, 100.0, 6_371_000.0)
    place = origin.place_of(position)
    assert abs(place[1]) <= 180.0
    assert origin.position_of(*place) == pytest.approx(position, abs=1e-3)


def test_x_is_east_y_is_north_and_z_up() -> None:
    x, y, z = ZURICH.position_of(47.398742, 8.546594, 500.0)
    metres_per_deg = math.radians(1.0) * 6_371_000.0
    assert (x, y, z) == pytest.approx((0.001 * metres_per_deg * math.cos(math.radians(47.398)), 111.19, 12.0), rel=1e-3)
    assert x < y, "meridians converge towards the pole"


def test_the_shorter_way_round_counts() -> None:
    x, _, _ = EarthOrigin(0.0, 179.9999, 0.0, 6_371_000.0).position_of(0.0, -179.9999, 0.0)
    assert x == pytest.approx(22.24, abs=0.01)


def test_a_driver_publishes_the_origin_in_native() -> None:
    assert Feedback(captured_ns=1, native={**ZURICH.native(), "wifi": 3}).origin == ZURICH
    assert Feedback(captured_ns=1).origin is None
    assert Feedback(captured_ns=1, native={}).origin is None


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("origin.latitude_deg", 90.0),
        ("origin.latitude_deg", math.nan),
        ("origin.longitude_deg", 200.0),
        ("origin.longitude_deg", "8.5"),
        ("origin.altitude_amsl_m", math.inf),
        ("origin.radius_m", 0.0),
        ("origin.radius_m", (1.0, 2.0)),
    ],
)
def test_nonsensical_origins_are_ignored(key: str, value: float | str | tuple[float, ...]) -> None:
    assert Feedback(captured_ns=1, native={**ZURICH.native(), key: value}).origin is None


def test_there_is_no_east_at_a_pole() -> None:
    assert is_on_earth(-89.0, 180.0)
    assert not is_on_earth(90.0, 0.0)
    assert not is_on_earth(math.nan, 0.0)
