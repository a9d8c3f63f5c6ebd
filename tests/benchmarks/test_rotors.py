"""``python -m benchmarks.rotors``: its figures, which docs/rotors.md contains."""

from __future__ import annotations

import math

import pytest

from benchmarks import rotors
from skyloop.sim.vehicles import CRAZYFLIE, IRIS
from tests.support.pages import rows, section

PAGE = "docs/rotors.md"


def test_a_second_order_response_overshoots_as_in_theory() -> None:
    for one in rotors.IDENTIFIED:
        damping = -one.damping / (2 * math.sqrt(-one.stiffness))
        found = rotors.identified_step(one)
        assert found.overshoot == pytest.approx(
            math.exp(-math.pi * damping / math.sqrt(1 - damping * damping)), abs=0.01
        )
        assert 0 < found.tenth_s < found.half_s < found.nine_tenths_s < 0.2


def test_the_times_of_a_response_lie_between_its_samples() -> None:
    found = rotors.response([0.0, 0.5, 1.0, 1.2, 1.0], 1.0, 0.1)
    assert found == pytest.approx((0.12, 0.2, 0.28, 0.2))
    assert math.isnan(rotors.response([0.0, 0.1], 1.0, 0.1).half_s)


def test_the_simulated_crazyflie_rolls_as_real_ones_do() -> None:
    ours = rotors.attitude_step(CRAZYFLIE)
    real = [rotors.identified_step(one) for one in rotors.IDENTIFIED]
    for figure in ("half_s", "nine_tenths_s"):
        times = [getattr(one, figure) for one in real]
        assert 0.9 * min(times) < getattr(ours, figure) < 1.1 * max(times)
    assert 0.05 < ours.overshoot < 0.15


def test_the_lag_of_the_thrust_is_the_rotors() -> None:
    rotor = IRIS.rotors
    assert rotor is not None
    assert rotors.thrust_lag_s(IRIS) == pytest.approx(rotor.speed_up_s, abs=0.0015)


def test_the_page_has_what_is_measured(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rotors, "VEHICLES", {"Crazyflie": CRAZYFLIE})
    for table, heading in zip(rotors.tables(), ("## Step responses", "## Thrust, drag and hover"), strict=True):
        shown = rows(section(PAGE, heading))
        for row in table.rows:
            assert list(row) in shown
