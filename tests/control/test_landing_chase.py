"""The landing's law over fast platforms: a vehicle that leans, with delay, lag, drag and gusts; no images."""

from __future__ import annotations

import math
from collections import deque

import numpy as np
import pytest

from skyloop.clock import NS_PER_S, nanoseconds
from skyloop.control.landing_law import LandingLaw, LandingPhase, LandingSettings
from skyloop.errors import UsageError
from skyloop.messages import Feedback, Velocity
from skyloop.messages.geometry import rotation_from_euler

DT, FEEDBACK, FRAME, TOP_M = 0.005, 5, 13, 0.2
GRAVITY = 9.80665
LIMITS = {"limits.speed": 5.0, "limits.climb": 0.7, "limits.altitude": 3.0, "limits.tilt": 0.21}
FAST = {**LIMITS, "limits.speed": 8.0, "limits.tilt": 0.5}


class ChaseWorld:
    """A platform passes below on a straight line or a circle; set-points arrive 50 ms later."""

    def __init__(self, speed: float, radius: float = math.inf, *, gust: float = 0.0, **settings: float) -> None:
        self.rng = np.random.default_rng(4)
        limits = FAST if speed > 2.0 else LIMITS
        self.most_m_s2 = GRAVITY * math.tan(limits["limits.tilt"])
        self.speed, self.radius, self.gust = speed, radius, gust
        self.law = LandingLaw(LandingSettings(wait_s=30.0, **settings).within(limits))  # type: ignore[arg-type]
        self.position, self.velocity, self.lean = np.array([0.0, 0.1, 2.5]), np.zeros(3), np.zeros(2)
        self.wind = np.zeros(2)
        self.now_ns, self.begin_ns = NS_PER_S, NS_PER_S
        self.asked, self.yaw = Velocity(), 0.3
        self.under_way: deque[Velocity] = deque([Velocity()] * 10, maxlen=10)
        self.hidden = False
        self.shift = np.zeros(2)
        self.phases: list[LandingPhase] = []
        self.ticks = 0

    @property
    def platform(self) -> np.ndarray:
        way = self.speed * ((self.now_ns - self.begin_ns) / NS_PER_S - 3.0)
        x, y = (way, 0.0)
        if math.isfinite(self.radius):
            angle = way / self.radius
            x, y = self.radius * math.sin(angle), self.radius * (1.0 - math.cos(angle))
        return np.array([x + self.shift[0], y + self.shift[1], TOP_M])

    @property
    def off(self) -> float:
        return math.hypot(*(self.platform - self.position)[:2])

    def run(self, seconds: float) -> LandingPhase:
        for _ in range(round(seconds / DT)):
            self._move()
            if self.ticks % FEEDBACK == 0:
                self.law.feedback(self._state())
            if self.ticks % FRAME == 0:
                self._look()
            if self.ticks % FEEDBACK == 0:
                self.asked = self.law.step(self.now_ns)
            self.phases.append(self.law.phase)
            if self.law.phase is LandingPhase.DOWN:
                break
        return self.law.phase

    def _move(self) -> None:
        self.ticks += 1
        self.now_ns += nanoseconds(DT)
        late = self.under_way[0]
        self.under_way.append(self.asked)
        c, s = math.cos(self.yaw), math.sin(self.yaw)
        asked = np.array([c * late.forward - s * late.left, s * late.forward + c * late.left])
        lean = 2.0 * (asked - self.velocity[:2])
        lean *= min(1.0, self.most_m_s2 / max(1e-9, float(np.hypot(*lean))))
        self.lean += (lean - self.lean) * DT / 0.1
        self.wind += -self.wind * DT + self.gust * math.sqrt(2 * DT) * self.rng.normal(size=2)
        push = -0.5 * (self.velocity[:2] - self.wind)
        self.velocity[:2] += (self.lean + push) * DT
        self.velocity[2] += 3.0 * (late.up - self.velocity[2]) * DT
        self.yaw += late.yaw_rate * DT
        self.position = self.position + self.velocity * DT

    def _state(self) -> Feedback:
        c, s = math.cos(self.yaw), math.sin(self.yaw)
        forward, left = c * self.velocity[0] + s * self.velocity[1], c * self.velocity[1] - s * self.velocity[0]
        ahead, aside = c * self.lean[0] + s * self.lean[1], c * self.lean[1] - s * self.lean[0]
        return Feedback(
            captured_ns=self.now_ns,
            roll_rad=-math.atan(aside / GRAVITY),
            pitch_rad=math.atan(ahead / GRAVITY),
            yaw_rad=self.yaw,
            altitude_m=float(self.position[2]) - 0.06,
            velocity_m_s=(forward, left, float(self.velocity[2])),
            angular_velocity_rad_s=(0.0, 0.0, self.asked.yaw_rate),
        )

    def _look(self) -> None:
        state = self._state()
        assert state.roll_rad is not None
        assert state.pitch_rad is not None
        seen = rotation_from_euler(state.roll_rad, state.pitch_rad, self.yaw).T @ (self.platform - self.position)
        depth = -seen[2] - 0.03
        whole = depth > 0.0 and abs(seen[0]) + 0.12 < 0.375 * depth and abs(seen[1]) + 0.12 < 0.5 * depth
        if whole and not self.hidden:
            self.law.see(seen + self.rng.normal(0, 0.004, 3), state, self.now_ns)


@pytest.mark.parametrize(
    ("speed", "radius", "gust"),
    [(2.0, math.inf, 0.0), (2.0, 10.0, 0.0), (1.0, 8.0, 1.0), (3.0, math.inf, 0.0), (3.0, 10.0, 0.0)],
)
def test_lands_on_a_passing_platform(speed: float, radius: float, gust: float) -> None:
    world = ChaseWorld(speed, radius, gust=gust)
    assert world.run(40.0) is LandingPhase.DOWN
    assert world.off < 0.12
    assert float(np.hypot(*world.velocity[:2])) == pytest.approx(speed, abs=0.3)
    assert LandingPhase.COMMITTED in world.phases


def touching_down(**settings: float) -> ChaseWorld:
    """A world in which the law has just begun to touch down."""
    world = ChaseWorld(1.0, **settings)
    for _ in range(800):
        if world.run(0.05) is LandingPhase.COMMITTED:
            return world
    raise AssertionError(f"never touched down: {world.law.phase}")


def test_a_touch_down_that_would_miss_is_aborted_with_a_climb_and_tried_again() -> None:
    world = touching_down()
    world.velocity[1] += 1.5  # a blow from the side
    world.run(1.0)
    assert world.law.aborted == 1
    assert LandingPhase.DOWN not in world.phases
    assert world.position[2] > TOP_M + 0.3, "it climbed, and did not touch"
    assert world.run(30.0) is LandingPhase.DOWN
    assert world.off < 0.12


def test_a_touch_down_on_a_platform_off_its_predicted_place_is_aborted() -> None:
    world = touching_down()
    world.shift = np.array([-0.14, 0.0])  # still in view, along the longer side of the image
    world.run(0.6)
    assert world.law.aborted == 1


def test_a_touch_down_without_sight_is_aborted_in_time() -> None:
    world = touching_down(final_descent_m_s=0.2)
    world.hidden = True
    world.run(2.0)
    assert world.law.aborted == 1
    assert world.law.phase is LandingPhase.RECOVERING
    assert world.position[2] > TOP_M + 0.1


def test_after_too_many_attempts_it_gives_up_at_a_safe_height() -> None:
    world = touching_down(attempts=1)
    world.velocity[1] += 1.5
    world.run(1.0)
    assert world.law.phase is LandingPhase.GIVEN_UP
    assert not world.law.safe(world.now_ns)
    world.run(8.0)
    assert world.law.phase is LandingPhase.GIVEN_UP, "even when it sees the marker again"
    assert world.law.safe(world.now_ns)
    assert float(np.linalg.norm(world.velocity)) < 0.1
    assert world.position[2] > 2.3


def test_after_too_long_a_time_it_gives_up() -> None:
    world = ChaseWorld(2.0, give_up_s=5.0)
    world.hidden = True
    assert world.run(4.8) is LandingPhase.SEARCHING
    world.run(2.0)
    assert world.law.phase is LandingPhase.GIVEN_UP
    assert world.law.safe(world.now_ns)


def test_set_points_stay_within_the_limits() -> None:
    world = ChaseWorld(2.0, 10.0, gust=1.0)
    for _ in range(600):
        world.run(0.05)
        assert math.hypot(world.asked.forward, world.asked.left) <= LIMITS["limits.speed"]
        assert abs(world.asked.up) <= LIMITS["limits.climb"]
        assert world.position[2] - 0.06 <= LIMITS["limits.altitude"]


def test_settings_are_clamped_to_the_limits() -> None:
    settings = LandingSettings(search_height_m=4.0).within(LIMITS)
    assert settings.search_height_m == pytest.approx(2.8)
    assert settings.response.tilt_rad == 0.21
    assert settings.final_descent_m_s <= 0.7
    assert LandingSettings().within({}) == LandingSettings()
    with pytest.raises(UsageError, match="commit_m"):
        LandingSettings().within({"limits.altitude": 0.6})


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ({"position_gain": 0.0}, "position_gain"),
        ({"descent_m_s": math.nan}, "descent_m_s"),
        ({"attempts": 0}, "attempts"),
        ({"wait_s": math.inf}, "wait_s"),
        ({"touch_m": 0.2}, "touch_m"),
    ],
)
def test_settings_out_of_range_are_refused(setting: dict[str, float], message: str) -> None:
    with pytest.raises(UsageError, match=message):
        LandingSettings(**setting)  # type: ignore[arg-type]
