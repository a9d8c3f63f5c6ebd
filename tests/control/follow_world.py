"""A small kinematic world for the follower's law: a vehicle with lag and delay, a camera with latency and noise, and a
board that moves about. No images: the camera's view is computed."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, field

import numpy as np

from skyloop.clock import NS_PER_S, nanoseconds
from skyloop.control.follow import FollowLaw
from skyloop.messages import Feedback, FlightState, Velocity
from skyloop.messages.geometry import rotation_from_euler, wrap_angle

DT = 0.01
HALF_WIDTH = math.tan(math.radians(32))
HALF_HEIGHT = math.tan(math.radians(25))
FROM_SIDE = math.radians(65)  # seen from further aside than this, a marker is not recognised


@dataclass
class Board:
    """Moves around the origin within a ring, facing the centre, with random speed and turns."""

    rng: np.random.Generator
    speed: float = 0.5
    position: np.ndarray = field(default_factory=lambda: np.array([2.6, 0.0, 1.2]))
    hidden: bool = False

    def __post_init__(self) -> None:
        angle = self.rng.uniform(-math.pi, math.pi)
        self.position = np.array([2.6 * math.cos(angle), 2.6 * math.sin(angle), 1.2])
        self._way = self.rng.choice([-1.0, 1.0])
        self._radial = self._climb = 0.0

    def move(self) -> None:
        if self.rng.random() < DT / 4.0:
            self._way = -self._way
        self._radial += self.rng.normal(0, 0.5) * math.sqrt(DT) - self._radial * DT
        self._climb += self.rng.normal(0, 0.2) * math.sqrt(DT) - self._climb * DT
        x, y, z = self.position
        radius, angle = math.hypot(x, y), math.atan2(y, x)
        radius = min(3.2, max(2.0, radius + self._radial * self.speed * DT))
        angle += self._way * self.speed / radius * DT
        z = min(1.6, max(0.9, z + self._climb * DT))
        self.position = np.array([radius * math.cos(angle), radius * math.sin(angle), z])

    @property
    def face(self) -> np.ndarray:
        return np.array([-self.position[0], -self.position[1], 0.0]) / math.hypot(*self.position[:2])


class FollowWorld:
    """Flies the law for a while and records whether the marker was in view, and its distance."""

    def __init__(self, seed: int, *, fps: float = 15.0, speed: float = 0.5) -> None:
        self.rng = np.random.default_rng(seed)
        self.board = Board(self.rng, speed)
        self.law = FollowLaw()
        self.position = np.array([0.0, 0.0, 1.0])
        self.velocity = np.zeros(3)
        self.yaw = float(self.rng.uniform(-3, 3))
        self.yaw_rate = self.roll = self.pitch = 0.0
        self.wind = np.zeros(3)
        self.period = 1.0 / fps
        self.now_ns = NS_PER_S
        self._pending: deque[tuple[int, Velocity]] = deque()
        self._pictures: deque[tuple[int, tuple[np.ndarray, np.ndarray, Feedback, int] | None]] = deque()
        self._command = Velocity()
        self.first_seen_ns: int | None = None
        self.frames = self.seen = 0
        self.range_errors: list[float] = []

    def run(self, seconds: float) -> None:
        next_picture = next_feedback = 0.0
        for step in range(round(seconds / DT)):
            now = step * DT
            self._move()
            if now >= next_feedback:
                self.law.feedback(self._feedback(noisy=True))
                next_feedback += 1 / 30
            if now >= next_picture:
                self._pictures.append((self.now_ns + nanoseconds(0.08), self._look()))
                next_picture += self.period
            while self._pictures and self._pictures[0][0] <= self.now_ns:
                self._decide(self._pictures.popleft()[1])

    def _decide(self, sight: tuple[np.ndarray, np.ndarray, Feedback, int] | None) -> None:
        if sight is not None:
            self.law.see(*sight)
        self._pending.append((self.now_ns + nanoseconds(0.05), self.law.step(self.now_ns)))

    def _move(self) -> None:
        self.now_ns += nanoseconds(DT)
        self.board.move()
        while self._pending and self._pending[0][0] <= self.now_ns:
            self._command = self._pending.popleft()[1]
        self.wind += self.rng.normal(0, 0.5, 3) * math.sqrt(DT) - self.wind * DT
        level = rotation_from_euler(0, 0, self.yaw)
        wanted = level @ [self._command.forward, self._command.left, self._command.up]
        acceleration = np.clip((wanted - self.velocity) / 0.3, -4, 4)
        self.velocity = self.velocity + (acceleration + 0.3 * self.wind) * DT
        self.position = self.position + self.velocity * DT
        body = level.T @ acceleration
        self.pitch += (math.atan2(body[0], 9.81) - self.pitch) * DT / 0.1
        self.roll += (-math.atan2(body[1], 9.81) - self.roll) * DT / 0.1
        self.yaw_rate += (self._command.yaw_rate - self.yaw_rate) * DT / 0.15
        self.yaw = wrap_angle(self.yaw + self.yaw_rate * DT)

    def _feedback(self, *, noisy: bool) -> Feedback:
        level = rotation_from_euler(0, 0, self.yaw)
        velocity = level.T @ self.velocity + (self.rng.normal(0, 0.04, 3) if noisy else 0)
        tilt = self.rng.normal(0, 0.008, 2) if noisy else np.zeros(2)
        return Feedback(
            captured_ns=self.now_ns,
            state=FlightState.FLYING,
            roll_rad=self.roll + tilt[0],
            pitch_rad=self.pitch + tilt[1],
            yaw_rad=self.yaw,
            altitude_m=float(self.position[2]),
            velocity_m_s=(float(velocity[0]), float(velocity[1]), float(velocity[2])),
            angular_velocity_rad_s=(0.0, 0.0, self.yaw_rate),
        )

    def _look(self) -> tuple[np.ndarray, np.ndarray, Feedback, int] | None:
        to_body = rotation_from_euler(self.roll, self.pitch, self.yaw).T
        offset = self.board.position - self.position
        seen = to_body @ offset
        distance = float(np.linalg.norm(offset))
        from_side = math.acos(np.clip(-self.board.face @ offset / distance, -1, 1))
        edge = 0.12 / max(0.1, seen[0])
        in_view = (
            not self.board.hidden
            and 0.4 < seen[0] < 5.5
            and abs(seen[1] / seen[0]) + edge < HALF_WIDTH
            and abs(seen[2] / seen[0]) + edge < HALF_HEIGHT
            and from_side < FROM_SIDE
            and self.rng.random() > 0.02
        )
        if self.first_seen_ns is None and in_view:
            self.first_seen_ns = self.now_ns
        if self.first_seen_ns is not None:
            self.frames += 1
            self.seen += in_view
            if self.now_ns - self.first_seen_ns > 6 * NS_PER_S:
                self.range_errors.append(distance - 1.5)
        if not in_view:
            return None
        seen = seen * (1 + self.rng.normal(0, 0.008)) + self.rng.normal(0, 0.004, 3) * seen[0]
        normal = to_body @ self.board.face + self.rng.normal(0, 0.15, 3)
        return seen, normal / np.linalg.norm(normal), self._feedback(noisy=True), self.now_ns
