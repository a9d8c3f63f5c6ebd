"""The gate's law in a kinematic world, and its behaviour without sightings."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from skyloop.clock import NS_PER_S, nanoseconds
from skyloop.control.gate_law import GateLaw, GatePhase
from skyloop.messages import Feedback, Velocity
from skyloop.messages.geometry import rotation_from_euler, wrap_angle

DT = 1 / 15
GATE, WAY = np.array([5.0, 0.5, 1.4]), 0.3


class World:
    """A vehicle that follows set-points exactly, and a gate."""

    def __init__(self, position: tuple[float, float, float], yaw: float = 0.0) -> None:
        self.position, self.yaw = np.array(position), yaw
        self.velocity = Velocity()
        self.now_ns = NS_PER_S
        self.law = GateLaw()
        self.crossed: list[np.ndarray] = []

    def step(self, *, visible: bool = True) -> None:
        level = rotation_from_euler(0.0, 0.0, self.yaw)
        v = self.velocity
        before = self._along()
        self.position = self.position + DT * level @ np.array([v.forward, v.left, v.up])
        self.yaw = wrap_angle(self.yaw + DT * v.yaw_rate)
        if before[0] < 0.0 <= self._along()[0]:
            self.crossed.append(self._along())
        self.now_ns += nanoseconds(DT)
        state = self.state()
        self.law.feedback(state)
        seen = rotation_from_euler(0.0, 0.0, self.yaw).T @ (GATE - self.position)
        if visible and seen[0] > 1.5 and abs(math.atan2(seen[1], seen[0])) < 0.5 and self._along()[0] < 0.0:
            normal = -np.array([math.cos(WAY - self.yaw), math.sin(WAY - self.yaw), 0.0])
            self.law.see(seen, normal, state, self.now_ns)
        self.velocity = self.law.step(self.now_ns)

    def phase(self) -> GatePhase:
        return self.law.phase

    def state(self) -> Feedback:
        v = self.velocity
        return Feedback(
            captured_ns=self.now_ns,
            roll_rad=0.0,
            pitch_rad=0.0,
            yaw_rad=self.yaw,
            altitude_m=float(self.position[2]),
            velocity_m_s=(v.forward, v.left, v.up),
            angular_velocity_rad_s=(0.0, 0.0, v.yaw_rate),
        )

    def _along(self) -> np.ndarray:
        return np.asarray(rotation_from_euler(0.0, 0.0, WAY).T @ (self.position - GATE))


@pytest.mark.parametrize("start", [(0.0, 0.0, 1.0), (1.0, -2.5, 2.0), (2.5, 2.0, 0.8), (3.1, 0.0, 1.4)])
def test_flies_through_the_middle(start: tuple[float, float, float]) -> None:
    world = World(start, yaw=math.atan2(GATE[1] - start[1], GATE[0] - start[0]))
    for _ in range(600):
        world.step()
        if world.phase() is GatePhase.PASSED:
            break
    assert world.phase() is GatePhase.PASSED
    assert len(world.crossed) == 1
    assert np.abs(world.crossed[0][1:]).max() < 0.15
    assert world.velocity == Velocity() or abs(world.velocity.forward) < 0.8


def test_searches_in_the_given_direction_and_stays() -> None:
    for turning in (1.0, -1.0):
        world = World((0.0, 0.0, 1.0))
        world.law.next_gate(turning=turning)
        for _ in range(45):
            world.step(visible=False)
            assert (world.velocity.forward, world.velocity.left) == (0.0, 0.0)
        assert world.velocity.yaw_rate * turning > 0.5
        assert world.phase() is GatePhase.SEARCHING


def test_a_gate_lost_on_the_way_is_not_flown_to() -> None:
    world = World((0.0, 0.0, 1.0))
    for _ in range(15):
        world.step()
    assert world.phase() is GatePhase.ALIGNING
    for _ in range(15):
        world.step(visible=False)
    assert world.phase() is GatePhase.RECOVERING
    assert (world.velocity.forward, world.velocity.left, world.velocity.up) == pytest.approx((0.0, 0.0, 0.0), abs=0.05)
    for _ in range(45):
        world.step(visible=False)
    assert world.phase() is GatePhase.SEARCHING
    assert world.law.axis is None
    for _ in range(300):
        world.step()
    assert world.phase() is GatePhase.PASSED, "seen again, it is flown through"


def test_next_gate_forgets_the_last() -> None:
    world = World((0.0, 0.0, 1.0))
    for _ in range(300):
        world.step()
    world.law.next_gate()
    assert world.phase() is GatePhase.SEARCHING
    world.step(visible=False)
    assert world.velocity.yaw_rate != 0.0


def test_set_points_are_zero_before_the_first_feedback() -> None:
    assert GateLaw().step(NS_PER_S) == Velocity()


@given(st.lists(st.tuples(*[st.floats(-20, 20)] * 6), min_size=1, max_size=20))
def test_any_sighting_gives_a_finite_set_point_within_limits(sights: list[tuple[float, ...]]) -> None:
    world = World((0.0, 0.0, 1.0))
    for sight in sights:
        state = world.state()
        world.law.feedback(state)
        world.law.see(np.array(sight[:3]), np.array(sight[3:]), state, world.now_ns)
        asked = world.law.step(world.now_ns)
        s = world.law.settings
        assert asked.finite
        assert math.hypot(asked.forward, asked.left) <= s.speed_m_s + 1e-9
        assert abs(asked.up) <= s.climb_m_s + 1e-9
        assert abs(asked.yaw_rate) <= s.turn_rad_s + 1e-9
        world.now_ns += nanoseconds(DT)
