"""The model of a vehicle's response, against a vehicle with delay, lean, lag and wind."""

from __future__ import annotations

import math
from collections import deque

import numpy as np
import pytest
from msgspec.structs import replace

from skyloop.clock import NS_PER_S, nanoseconds
from skyloop.control.response import ResponseSettings, VelocityResponse
from skyloop.errors import UsageError
from skyloop.messages import Feedback

DT = 0.005
GRAVITY = 9.80665


class Vehicle:
    """Leans by the velocity error, with a delay; one axis, forward; limited lean."""

    def __init__(self, gain: float = 2.0, lag: float = 0.1, delay: float = 0.05, wind: float = 0.0) -> None:
        self.gain, self.lag, self.wind = gain, lag, wind
        self.velocity = self.position = self.lean = 0.0
        self.now_ns = NS_PER_S
        steps = max(1, round(delay / DT))
        self._under_way: deque[float] = deque([0.0] * steps, maxlen=steps)

    def step(self, setpoint: float, most: float) -> None:
        late = self._under_way[0]
        self._under_way.append(setpoint)
        asked = max(-most, min(most, self.gain * (late - self.velocity)))
        self.lean += (asked - self.lean) * DT / self.lag
        self.velocity += (self.lean + self.wind) * DT
        self.position += self.velocity * DT
        self.now_ns += nanoseconds(DT)

    def feedback(self) -> Feedback:
        return Feedback(
            captured_ns=self.now_ns,
            roll_rad=0.0,
            pitch_rad=math.atan(self.lean / GRAVITY),
            yaw_rad=0.0,
            velocity_m_s=(self.velocity, 0.0, 0.0),
        )


def hold(vehicle: Vehicle, seconds: float = 12.0) -> list[float]:
    """Hold a position with gains at which a loop without prediction oscillates; return the positions."""
    response = VelocityResponse()
    most = response.settings.most_m_s2
    places, setpoint = [], 0.0
    for k in range(round(seconds / DT)):
        if k % 5 == 0:
            response.add(vehicle.feedback())
            motion = response.predict(vehicle.now_ns)
            assert motion is not None
            place = vehicle.position + motion.moved[0]
            wanted = 12.0 * (1.0 - place) - 6.0 * motion.velocity[0]
            setpoint = float(response.setpoint(np.array([wanted, 0.0]), motion)[0])
            response.sent(np.array([setpoint, 0.0]), vehicle.now_ns)
        vehicle.step(setpoint, most)
        places.append(vehicle.position)
    return places


@pytest.mark.parametrize(
    ("gain", "lag", "delay"),
    [(2.0, 0.1, 0.05), (1.5, 0.1, 0.05), (2.6, 0.1, 0.05), (2.0, 0.16, 0.05), (2.0, 0.1, 0.1), (2.0, 0.1, 0.0)],
)
def test_holds_a_position_against_wind_even_with_a_slightly_wrong_model(gain: float, lag: float, delay: float) -> None:
    late = hold(Vehicle(gain, lag, delay, wind=0.8))[round(8.0 / DT) :]
    assert max(late) - 1.0 < 0.02
    assert 1.0 - min(late) < 0.02


@pytest.mark.parametrize("push", [0.0, 0.8, -0.8])
def test_reaches_a_velocity_against_any_push(push: float) -> None:
    vehicle, response = Vehicle(delay=0.1, wind=push), VelocityResponse(ResponseSettings(delay_s=0.1))
    velocities = []
    for k in range(round(6.0 / DT)):
        if k % 5 == 0:
            response.add(vehicle.feedback())
            motion = response.predict(vehicle.now_ns)
            assert motion is not None
            setpoint = response.setpoint(3.0 * (np.array([1.0, 0.0]) - motion.velocity), motion)
            response.sent(setpoint, vehicle.now_ns)
        vehicle.step(float(setpoint[0]), 5.0)
        velocities.append(vehicle.velocity)
    assert velocities[-1] == pytest.approx(1.0, abs=0.05)
    assert max(velocities) < 1.35


def test_learns_the_wind() -> None:
    vehicle, response = Vehicle(wind=-1.2), VelocityResponse()
    for k in range(600):
        vehicle.step(0.5, 3.0)
        if k % 5 == 0:
            response.sent(np.array([0.5, 0.0]), vehicle.now_ns)
            response.add(vehicle.feedback())
    motion = response.predict(vehicle.now_ns)
    assert motion is not None
    assert motion.push == pytest.approx([-1.2, 0.0], abs=0.1)
    assert motion.at_ns == vehicle.now_ns + nanoseconds(0.05)


def test_set_points_stay_within_the_lean() -> None:
    response = VelocityResponse(ResponseSettings(tilt_rad=0.2))
    response.add(Vehicle().feedback())
    motion = response.predict(2 * NS_PER_S)
    assert motion is not None
    setpoint = response.setpoint(np.array([50.0, 0.0]), motion)
    assert setpoint == pytest.approx([GRAVITY * math.tan(0.2) / 2.0, 0.0])


def test_predicts_nothing_before_feedback() -> None:
    response = VelocityResponse()
    assert response.predict(0) is None
    response.add(Feedback(captured_ns=1, velocity_m_s=(1.0, 0.0, 0.0), yaw_rad=0.0))
    assert response.predict(NS_PER_S) is None, "without an attitude"


def test_a_sample_stamped_ahead_freezes_nothing() -> None:
    """Until then it kept that velocity and commanded the opposite one, whatever the vehicle did."""
    vehicle, response = Vehicle(), VelocityResponse()
    for _ in range(200):
        vehicle.step(1.0, 5.0)
        response.add(vehicle.feedback())
    response.add(replace(vehicle.feedback(), captured_ns=vehicle.now_ns + 8 * NS_PER_S))
    for _ in range(400):
        vehicle.step(0.0, 5.0)
        response.add(vehicle.feedback())
    motion = response.predict(vehicle.now_ns)
    assert motion is not None
    assert motion.velocity == pytest.approx([vehicle.velocity, 0.0], abs=0.05)
    assert response.setpoint(3.0 * -motion.velocity, motion) == pytest.approx([0.0, 0.0], abs=0.1)


@pytest.mark.parametrize("setting", [{"gain_per_s": 0.0}, {"lag_s": math.nan}, {"delay_s": -0.1}, {"tilt_rad": 2.0}])
def test_settings_out_of_range_are_refused(setting: dict[str, float]) -> None:
    with pytest.raises(UsageError, match=next(iter(setting))):
        ResponseSettings(**setting)
