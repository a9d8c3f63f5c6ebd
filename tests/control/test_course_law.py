"""The law of a course with a map in a kinematic world, where gates and poles are off their places on the map."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from skyloop.clock import NS_PER_S, nanoseconds
from skyloop.control.course_law import CourseLaw, CourseSettings, GatePlace, Pole
from skyloop.control.gate_law import GatePhase
from skyloop.messages import Feedback, Velocity
from skyloop.messages.geometry import rotation_from_euler, wrap_angle

DT = 1 / 20
GATES = (GatePlace(4.0, 0.0, 1.2, 0.0), GatePlace(4.5, 3.0, 1.6, math.pi))
POLES = (Pole(2.0, 0.05), Pole(5.8, 1.5))
LOOSE = replace(CourseSettings(), map_m=0.25)


class World:
    """A vehicle that follows set-points with a lag; everything is shifted by ``off`` from the map."""

    def __init__(self, off: tuple[float, float] = (0.0, 0.0), settings: CourseSettings | None = None) -> None:
        self.off = np.array([*off, 0.0])
        self.position, self.yaw, self.velocity = np.array([0.0, 0.0, 1.0]), 0.0, Velocity()
        self.now_ns, self.flown = NS_PER_S, np.zeros(3)
        self.law = CourseLaw(GATES, (1.2, 1.2), POLES, settings=settings)
        self.crossed: list[tuple[int, float]] = []  # gate, distance from its middle
        self.nearest_m = math.inf  # to a pole
        self.passed = 0

    def step(self, *, visible: bool = True) -> None:
        level, v = rotation_from_euler(0.0, 0.0, self.yaw), self.velocity
        share = 1.0 - math.exp(-DT / 0.2)
        self.flown = self.flown + share * (np.array([v.forward, v.left, v.up]) - self.flown)
        forward, left, up = self.flown.tolist()
        v = Velocity(forward=forward, left=left, up=up, yaw_rate=v.yaw_rate)
        before = [self.along(number) for number in range(len(GATES))]
        self.position = self.position + DT * level @ np.array([v.forward, v.left, v.up])
        self.yaw = wrap_angle(self.yaw + DT * v.yaw_rate)
        self.now_ns += nanoseconds(DT)
        for number, old in enumerate(before):
            new = self.along(number)
            if old[0] < 0.0 <= new[0] and np.abs(new[1:]).max() < 0.6:
                self.crossed.append((number, float(np.abs(new[1:]).max())))
        poles = [np.array(pole[:2]) + self.off[:2] for pole in POLES]
        self.nearest_m = min([self.nearest_m, *(math.dist(self.position[:2], pole) for pole in poles)])
        state = Feedback(
            captured_ns=self.now_ns,
            roll_rad=0.0,
            pitch_rad=0.0,
            yaw_rad=self.yaw,
            altitude_m=float(self.position[2]),
            velocity_m_s=(v.forward, v.left, v.up),
            angular_velocity_rad_s=(0.0, 0.0, v.yaw_rate),
        )
        self.law.feedback(state)
        if visible:
            self.look(state)
        self.velocity = self.law.step(self.now_ns)
        if self.law.phase is GatePhase.PASSED:
            self.passed += 1
            self.law.next_gate()

    def look(self, state: Feedback) -> None:
        into_body = rotation_from_euler(0.0, 0.0, self.yaw).T
        if self.law.number < len(GATES):
            gate = GATES[self.law.number]
            seen = into_body @ (np.array(gate[:3]) + self.off - self.position)
            if seen[0] > 2.2 and abs(math.atan2(seen[1], seen[0])) < 0.8:
                turn = gate.heading_rad - self.yaw
                self.law.see(seen, -np.array([math.cos(turn), math.sin(turn), 0.0]), state, self.now_ns)
        for pole in POLES:
            top = into_body @ (np.array([pole.x_m, pole.y_m, pole.height_m]) + self.off - self.position)
            if top[0] > 0.5 * abs(top[1]):
                self.law.see_pole(top, state, self.now_ns)

    def along(self, number: int) -> np.ndarray:
        gate = GATES[number]
        turn = rotation_from_euler(0.0, 0.0, gate.heading_rad).T
        return np.asarray(turn @ (self.position - np.array(gate[:3]) - self.off))


@pytest.mark.parametrize(
    ("off", "settings"), [((0.0, 0.0), None), ((0.2, -0.15), None), ((0.3, 0.25), LOOSE), ((-0.2, -0.3), LOOSE)]
)
def test_flies_through_all_gates_around_the_poles(off: tuple[float, float], settings: CourseSettings | None) -> None:
    world = World(off, settings)
    for _ in range(1200):
        world.step()
        if world.passed == len(GATES):
            break
    assert [number for number, _ in world.crossed] == [0, 1]
    assert max(miss for _, miss in world.crossed) < 0.25
    assert world.nearest_m > 0.3
    assert world.law.stuck is None


def test_an_unseen_gate_is_not_flown_through() -> None:
    world = World()
    for _ in range(3000):
        world.step(visible=False)
        if world.law.stuck is not None:
            break
    assert world.law.stuck == "the gate is not seen where it should be"
    assert world.crossed == []
    assert world.law.phase is GatePhase.SEARCHING


def test_a_gate_far_from_its_place_is_another_one() -> None:
    world = World()
    for _ in range(20):
        world.step()
    before = world.law.axis
    state = Feedback(captured_ns=world.now_ns, roll_rad=0.0, pitch_rad=0.0, yaw_rad=world.yaw)
    world.law.see(np.array([7.0, 2.0, 0.0]), np.array([-1.0, 0.0, 0.0]), state, world.now_ns)
    world.law.step(world.now_ns)
    assert world.law.axis.along_m == pytest.approx(before.along_m, abs=0.1)


def test_a_vehicle_that_does_not_get_through_gives_up() -> None:
    world = World()
    while world.law.phase is not GatePhase.PASSING:
        world.step()
    for _ in range(300):
        world.velocity, world.flown = Velocity(), np.zeros(3)  # blocked
        world.step(visible=False)
    assert world.law.stuck == "the vehicle does not get through the gate"


def test_it_stays_before_the_first_feedback() -> None:
    law = CourseLaw(GATES, (1.2, 1.2))
    assert law.step(NS_PER_S) == Velocity()
    law.see(np.array([3.0, 0.0, 0.0]), np.array([-1.0, 0.0, 0.0]), Feedback(captured_ns=NS_PER_S), NS_PER_S)
    law.see_pole(np.array([1.0, 0.0, 1.0]), Feedback(captured_ns=NS_PER_S), NS_PER_S)
    assert law.step(NS_PER_S) == Velocity()
