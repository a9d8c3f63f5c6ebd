"""How fast a vehicle is by its attitude alone."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from skyloop.clock import nanoseconds
from skyloop.control.dead_reckoning import DRAG_PER_S, Tilting, TiltVelocity
from skyloop.messages import Feedback, FlightState

GRAVITY = 9.80665


def tilted(at_s: float, *, state: FlightState = FlightState.FLYING, **angles: float | None) -> Feedback:
    given: dict[str, Any] = {"roll_rad": 0.0, "pitch_rad": 0.0, "yaw_rad": 0.0, **angles}
    return Feedback(captured_ns=nanoseconds(1.0 + at_s), state=state, **given)


def held(seconds: float, estimate: TiltVelocity | None = None, **angles: Any) -> tuple[float, float, float]:
    estimate = estimate or TiltVelocity()
    velocity = None
    for n in range(round(seconds * 40) + 1):
        velocity = estimate.step(tilted(n / 40, **angles))
    assert velocity is not None
    return velocity


def test_a_tilt_accelerates_until_drag_balances_it() -> None:
    push = GRAVITY * math.tan(0.1)
    assert held(0.1, pitch_rad=0.1)[0] == pytest.approx(0.1 * push, rel=0.05)
    for seconds in (1.0, 3.0, 20.0):
        expected = push / DRAG_PER_S * (1.0 - math.exp(-DRAG_PER_S * seconds))
        assert held(seconds, pitch_rad=0.1) == pytest.approx((expected, 0.0, 0.0), abs=1e-6)


def test_the_axes_are_those_of_feedback() -> None:
    assert held(1.0, pitch_rad=0.1)[0] > 0.5, "nose down: forward"
    forward, left, up = held(1.0, roll_rad=0.1)
    assert (forward, up) == pytest.approx((0.0, 0.0), abs=1e-9)
    assert left < -0.5, "right side down: to the right"


def test_the_velocity_stays_where_it_was_when_the_vehicle_turns() -> None:
    estimate = TiltVelocity()
    forward, _, _ = held(1.0, estimate, pitch_rad=0.1)
    turned = estimate.step(tilted(1.0 + 1e-6, yaw_rad=math.pi / 2))
    assert turned == pytest.approx((0.0, -forward, 0.0), abs=1e-3), "it moves to the right of its nose now"


def test_a_vehicle_that_landed_is_at_rest() -> None:
    estimate = TiltVelocity()
    held(2.0, estimate, pitch_rad=0.2)
    assert estimate.step(tilted(2.1, state=FlightState.LANDED, pitch_rad=0.2)) == (0.0, 0.0, 0.0)


@pytest.mark.parametrize("name", ["roll_rad", "pitch_rad", "yaw_rad"])
def test_nothing_is_known_without_the_attitude(name: str) -> None:
    assert TiltVelocity().step(tilted(0.0, **dict[str, Any]({name: None}))) is None


def test_neither_gaps_nor_late_samples_are_integrated_over() -> None:
    estimate = TiltVelocity()
    estimate.step(tilted(0.0, pitch_rad=0.1))
    after_gap = estimate.step(tilted(60.0, pitch_rad=0.1))
    assert after_gap is not None
    assert 0.0 < after_gap[0] < 0.6 * GRAVITY * math.tan(0.1), "as of half a second"
    late = estimate.step(tilted(59.0, pitch_rad=-0.3))
    assert late == after_gap


def test_a_vehicle_on_its_side_is_no_rocket() -> None:
    assert np.hypot(*held(0.5, roll_rad=math.pi / 2)[:2]) < 2.0 * GRAVITY


def test_how_fast_it_tilts_is_told_by_the_last_samples() -> None:
    tilting = Tilting()
    assert tilting.rate_rad_s == 0.0
    for n in range(5):
        tilting.add(tilted(n / 10, pitch_rad=0.1))
    assert tilting.rate_rad_s == 0.0, "it is held"
    tilting.add(tilted(0.5, pitch_rad=-0.1))
    assert tilting.rate_rad_s == pytest.approx(0.2 / 0.15)
    tilting.add(tilted(0.45, pitch_rad=1.0))
    tilting.add(tilted(0.55, pitch_rad=None))
    assert tilting.rate_rad_s == pytest.approx(0.2 / 0.15), "neither late nor unknown samples count"
    for n in range(6, 12):
        tilting.add(tilted(n / 10, pitch_rad=-0.1))
    assert tilting.rate_rad_s == 0.0, "that was long ago"
