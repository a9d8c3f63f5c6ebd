"""The landing's law in a kinematic world with a platform, and its behaviour without sightings."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from skyloop.clock import NS_PER_S, nanoseconds
from skyloop.control.landing_law import LandingLaw, LandingPhase, LandingSettings, SpiralSearch
from skyloop.control.response import ResponseSettings
from skyloop.errors import UsageError
from skyloop.messages import Feedback, Velocity
from skyloop.messages.geometry import rotation_from_euler

DT = 1 / 15
TOP_M = 0.2
#: For a vehicle that takes on each velocity at the next step, without leaning.
EXACT = ResponseSettings(gain_per_s=1 / DT, lag_s=0.001, delay_s=0.0)


class World:
    """A vehicle that follows set-points exactly, over a platform in straight motion."""

    def __init__(self, position: tuple[float, float, float], speed: float = 0.3) -> None:
        self.position, self.velocity = np.array(position), Velocity()
        self.platform, self.speed = np.array([0.0, 0.0, TOP_M]), np.array([speed, 0.0, 0.0])
        self.now_ns = NS_PER_S
        self.law = LandingLaw(LandingSettings(response=EXACT))

    def step(self, *, visible: bool = True) -> None:
        v = self.velocity
        self.position = self.position + DT * np.array([v.forward, v.left, v.up])
        self.platform = self.platform + DT * self.speed
        self.now_ns += nanoseconds(DT)
        state = self.state()
        self.law.feedback(state)
        seen = self.platform - self.position
        depth = -seen[2] - 0.03
        if visible and depth > 0.0 and abs(seen[0]) + 0.15 < 0.375 * depth and abs(seen[1]) + 0.15 < 0.5 * depth:
            self.law.see(seen, state, self.now_ns)
        self.velocity = self.law.step(self.now_ns)

    def phase(self) -> LandingPhase:
        return self.law.phase

    def state(self) -> Feedback:
        v = self.velocity
        return Feedback(
            captured_ns=self.now_ns,
            roll_rad=0.0,
            pitch_rad=0.0,
            yaw_rad=0.0,
            altitude_m=float(self.position[2]) - 0.06,
            velocity_m_s=(v.forward, v.left, v.up),
            angular_velocity_rad_s=(0.0, 0.0, v.yaw_rate),
        )

    @property
    def off(self) -> float:
        return math.hypot(*(self.platform - self.position)[:2])


@pytest.mark.parametrize("speed", [0.0, 0.3, -0.5])
def test_lands_on_a_moving_platform(speed: float) -> None:
    world = World((0.3, -0.2, 2.0), speed)
    phases = []
    for _ in range(600):
        world.step()
        phases.append(world.phase())
        if world.phase() is LandingPhase.DOWN:
            break
    assert phases[-1] is LandingPhase.DOWN
    assert LandingPhase.COMMITTED in phases
    assert world.off < 0.08
    assert world.position[2] - 0.06 - TOP_M < 0.1
    assert world.law.step(world.now_ns) == Velocity(), "after touch-down it stays down"
    assert world.law.target_speed_m_s == pytest.approx(abs(speed), abs=0.08)


def test_after_losing_it_high_up_it_climbs_then_searches() -> None:
    world = World((0.0, 0.0, 2.0))
    for _ in range(30):
        world.step()
    assert world.phase() is LandingPhase.DESCENDING
    for _ in range(12):
        world.step(visible=False)
    assert world.phase() is LandingPhase.RECOVERING
    assert world.velocity.up > 0.0
    for _ in range(60):
        world.step(visible=False)
    assert world.phase() is LandingPhase.SEARCHING
    assert world.law.height_m is None


def test_it_waits_above_a_platform_that_turns() -> None:
    world = World((0.0, 0.0, 1.4))
    for tick in range(200):
        world.speed = 0.4 * np.array([math.cos(tick * DT * 1.5), math.sin(tick * DT * 1.5), 0.0])
        world.step()
    assert world.phase() is not LandingPhase.DOWN
    world.speed = np.zeros(3)
    for _ in range(600):
        world.step()
    assert world.phase() is LandingPhase.DOWN


def test_after_a_takeover_on_the_ground_it_searches_again() -> None:
    """It stayed in phase DOWN: given back at 2 m, the vehicle was landed wherever it was."""
    world = World((0.0, 0.0, 2.0), 0.0)
    while world.phase() is not LandingPhase.DOWN:
        world.step()
    world.law.forget()
    assert world.phase() is LandingPhase.DOWN, "a gap in the feedback does not abort a nearly finished landing"
    world.law.pause()
    assert world.phase() is LandingPhase.SEARCHING
    world.position, world.velocity = np.array([0.4, 0.0, 2.0]), Velocity()
    world.step()
    assert world.phase() is not LandingPhase.DOWN
    while world.phase() is not LandingPhase.DOWN:
        world.step()
    assert world.off < 0.08


def hovering(roll_rate: float, late_s: float, sights: list[tuple[float, float, float]]) -> LandingLaw:
    """Return a law that saw these places, in levelled axes, while rolling; attitudes are ``late_s`` old."""
    law, rate = LandingLaw(), (roll_rate, 0.0, 0.0)
    for k, sight in enumerate(sights):
        now_ns = NS_PER_S + nanoseconds(k * DT)
        state = Feedback(
            captured_ns=now_ns,
            roll_rad=0.0,
            pitch_rad=0.0,
            yaw_rad=0.0,
            velocity_m_s=(0.0, 0.0, 0.0),
            angular_velocity_rad_s=rate,
        )
        law.feedback(state)
        seen = rotation_from_euler(roll_rate * late_s, 0.0, 0.0).T @ np.array(sight)
        law.see(seen, state, now_ns + nanoseconds(late_s))
    law.step(now_ns)
    return law


def test_an_attitude_older_than_the_frame_is_extrapolated() -> None:
    law = hovering(1.0, 0.02, [(0.0, 0.0, -2.0)] * 15)
    assert law.off_m is not None
    assert law.off_m < 0.01  # unextrapolated, the marker would be 0.04 m off


def test_sightings_while_turning_fast_count_less() -> None:
    sights = [(0.0, 0.0, -2.0)] * 15 + [(0.06, 0.0, -2.0)]
    steady, turning = (hovering(rate, 0.0, sights).off_m for rate in (0.0, 2.0))
    assert steady is not None
    assert turning is not None
    assert turning < 0.7 * steady


def test_set_points_are_zero_before_the_first_feedback() -> None:
    assert LandingLaw().step(NS_PER_S) == Velocity()
    assert LandingLaw().target_speed_m_s is None


@given(st.lists(st.tuples(*[st.floats(-20, 20)] * 3), min_size=1, max_size=20))
def test_any_sighting_gives_a_finite_set_point_within_limits(sights: list[tuple[float, float, float]]) -> None:
    world = World((0.0, 0.0, 1.0))
    for sight in sights:
        state = world.state()
        world.law.feedback(state)
        world.law.see(np.array(sight), state, world.now_ns)
        asked = world.law.step(world.now_ns)
        assert asked.finite
        assert math.hypot(asked.forward, asked.left) <= world.law.settings.speed_m_s + 1e-9
        world.now_ns += nanoseconds(DT)


def test_the_spiral_covers_every_place_and_restarts() -> None:
    search, place = SpiralSearch(lane_m=1.0, speed_m_s=0.7, largest_m=4.0), np.zeros(2)
    way = [place]
    for _ in range(3000):
        place = place + 0.05 * search.step(place)
        way.append(place)
    places = np.array(way)
    for x in np.arange(-1.4, 1.5, 0.4):
        for y in np.arange(-1.4, 1.5, 0.4):
            assert np.linalg.norm(places - (x, y), axis=1).min() < 0.75
    assert np.abs(places).max() < 3.1
    assert np.linalg.norm(places[1500:], axis=1).min() < 0.25, "it returned"


def test_a_spiral_needs_positive_numbers() -> None:
    with pytest.raises(UsageError, match="lane_m"):
        SpiralSearch(lane_m=0.0)
