"""How a vehicle answers velocity set-points, by a model of such a vehicle."""

from __future__ import annotations

import math

import numpy as np
import pytest

from skyloop.clock import nanoseconds
from skyloop.control.response import ResponseSettings, VelocityResponse
from skyloop.errors import UsageError
from skyloop.messages import Feedback

STEP_S = 0.025
GRAVITY = 9.80665


def flown(push: float, wanted: float = 1.0, seconds: float = 6.0) -> tuple[list[float], VelocityResponse]:
    """Velocities ahead of a vehicle with a velocity loop, behind a delay, that the air pushes ahead [m/s²]."""
    settings = ResponseSettings(delay_s=0.1)
    response, under_way = VelocityResponse(settings), [0.0] * 4
    velocity, lean, velocities = 0.0, 0.0, []
    for n in range(round(seconds / STEP_S)):
        now_ns = nanoseconds(1.0 + n * STEP_S)
        response.add(
            Feedback(
                captured_ns=now_ns,
                roll_rad=0.0,
                pitch_rad=math.atan2(lean, GRAVITY),
                yaw_rad=0.0,
                velocity_m_s=(velocity, 0.0, 0.0),
            )
        )
        predicted = response.predict(now_ns)
        assert predicted is not None
        setpoint = response.setpoint(3.0 * (np.array([wanted, 0.0]) - predicted.velocity), predicted)
        response.sent(setpoint, now_ns)
        under_way.append(float(setpoint[0]))
        lean += (STEP_S / 0.1) * (2.0 * (under_way.pop(0) - velocity) - lean)
        velocity += (lean + push) * STEP_S
        velocities.append(velocity)
    return velocities, response


@pytest.mark.parametrize("push", [0.0, 0.8, -0.8])
def test_takes_up_a_velocity_whatever_pushes(push: float) -> None:
    velocities, response = flown(push)
    assert velocities[-1] == pytest.approx(1.0, abs=0.05)
    assert max(velocities) < 1.35
    predicted = response.predict(nanoseconds(7.0))
    assert predicted is not None
    assert predicted.push[0] == pytest.approx(push, abs=0.2)


def test_knows_nothing_before_feedback() -> None:
    response = VelocityResponse()
    assert response.predict(0) is None
    response.add(Feedback(captured_ns=1, velocity_m_s=(1.0, 0.0, 0.0)))  # without attitude
    assert response.predict(2) is None


@pytest.mark.parametrize("wrong", [{"gain_per_s": 0.0}, {"delay_s": -0.1}, {"lag_s": math.nan}, {"tilt_rad": 1.6}])
def test_bad_settings_are_refused(wrong: dict[str, float]) -> None:
    with pytest.raises(UsageError):
        ResponseSettings(**wrong)
