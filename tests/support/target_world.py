"""A small world for tests of following: upright objects before the simulator's front camera, without pictures."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from skyloop.clock import nanoseconds
from skyloop.control.airframe import Motion, TiltVelocity
from skyloop.control.chase_law import ChaseLaw, ChaseSettings, FollowMode, TargetPhase
from skyloop.control.target_estimate import TRAITS, BoxView, CameraPose, TargetEstimator, TargetState, Traits
from skyloop.control.target_range import estimator_of
from skyloop.messages import Attitude, Feedback, FlightState
from skyloop.messages.geometry import wrap_angle
from skyloop.sim.camera import FRONT_CAMERA
from skyloop.vision.tracking import Box

Array = NDArray[np.float64]
SIZE = (FRONT_CAMERA.width, FRONT_CAMERA.height)
PERSON = TRAITS["person"]
GRAVITY = 9.81
PERIOD_S = 1 / 15
START_S = 1.0


def state(at_s: float = 0.0, *, roll: float = 0.0, pitch: float = 0.0, yaw: float = 0.0) -> Feedback:
    return Feedback(captured_ns=nanoseconds(at_s), roll_rad=roll, pitch_rad=pitch, yaw_rad=yaw)


def camera_at(
    x: float = 0.0, y: float = 0.0, z: float = 1.2, *, roll: float = 0.0, pitch: float = 0.0, yaw: float = 0.0
) -> CameraPose:
    """Return the front camera of a vehicle."""
    attitude = state(roll=roll, pitch=pitch, yaw=yaw)
    camera = CameraPose.at(FRONT_CAMERA.info(), attitude, np.array([x, y, z]), FRONT_CAMERA.intrinsics(), SIZE)
    assert camera is not None
    return camera


def box_of(camera: CameraPose, foot: Array, height_m: float = 1.72, width_m: float = 0.5) -> Box | None:
    """Return the box of a flat, upright object that faces the camera, cut at the image's edge; None if out of view."""
    away = foot[:2] - camera.position[:2]
    aside = np.array([-away[1], away[0], 0.0]) / max(1e-9, float(np.hypot(*away))) * width_m / 2
    up = np.array([0.0, 0.0, height_m])
    corners = np.array([foot + side + share * up for side in (-aside, aside) for share in (0.0, 0.5, 1.0)])
    rays = (corners - camera.position) @ camera.rotation
    if (rays[:, 2] < 0.1).any():
        return None
    pixels = FRONT_CAMERA.project(rays)
    left, top = np.maximum(pixels.min(axis=0), 0.0).tolist()
    right, bottom = np.minimum(pixels.max(axis=0), np.array(SIZE) - 1.0).tolist()
    if right - left < 1.0 or bottom - top < 2.0:
        return None
    return left, top, right - left + 1.0, bottom - top + 1.0


def view_of(camera: CameraPose, foot: Array, height_m: float = 1.72, rng: np.random.Generator | None = None) -> BoxView:
    """Return what the box of a visible object shows, with a detector's noise."""
    box = box_of(camera, foot, height_m)
    assert box is not None, "the test's thing is out of view"
    view = BoxView.of(box if rng is None else noisy(box, rng), camera)
    assert view is not None
    return view


def noisy(box: Box, rng: np.random.Generator) -> Box:
    x, y, width, height = box
    left, right = rng.normal(0.0, 0.5 + 0.03 * width, 2)
    up, down = rng.normal(0.0, 0.5 + 0.03 * height, 2)
    return x + left, y + up, max(2.0, width + right - left), max(2.0, height + down - up)


Path = Callable[[float], tuple[float, float]]


def walk(x: float, y: float, forward: float = 0.0, left: float = 0.0) -> Path:
    """Return a straight path at constant velocity from the start."""
    return lambda t: (x + forward * t, y + left * t)


class ChaseWorld:
    """A vehicle that follows a velocity after 0.4 s or an attitude after 0.15 s, and a target that it sees as boxes.

    Attributes:
        phases: The phase in each step.
        ranges: True horizontal distance in each step [m].
        bearings: Bearing of the vehicle from the target in each step [rad].
        commands: The set-points that the law returned.
        speeds: Speed towards the target in each step [m/s].
        azimuths: Azimuth of the target from straight ahead [rad].
        places: Position of the vehicle, (3,) each.

    With ``drift_m_s``, its reported velocity is off by this much to the east, and its position is known.
    """

    def __init__(
        self,
        path: Path,
        *,
        settings: ChaseSettings | None = None,
        mode: FollowMode = FollowMode.FOLLOW,
        hidden: Callable[[float], bool] = lambda t: False,
        relative: bool = False,
        seed: int | None = 1,
        altitude: bool = True,
        traits: Traits = PERSON,
        drift_m_s: float = 0.0,
        others: Callable[[int], list[TargetState]] = lambda now_ns: [],
    ) -> None:
        self._drift, self._others = np.array([drift_m_s, 0.0, 0.0]), others
        self.law = ChaseLaw(settings, mode)
        self.position, self.velocity, self.yaw = np.array([0.0, 0.0, 1.2]), np.zeros(3), 0.0
        self.tilt = np.zeros(2)  # roll and pitch
        self.estimator: TargetEstimator | None = None
        self.phases: list[TargetPhase] = []
        self.ranges: list[float] = []
        self.bearings: list[float] = []
        self.azimuths: list[float] = []
        self.speeds: list[float] = []
        self.places: list[Array] = []
        self.commands: list[object] = []
        self._path, self._hidden, self._relative, self._altitude = path, hidden, relative, altitude
        self._rng = None if seed is None else np.random.default_rng(seed)
        self._traits = traits
        self._seen_ns: int | None = None
        self._rate, self._steps = 0.0, 0
        self._tilts = TiltVelocity()
        self._reckoned, self._airspeed = np.zeros(3), np.zeros(3)  # if the vehicle reports no velocity

    @property
    def time_s(self) -> float:
        return self._steps * PERIOD_S

    def run(self, seconds: float) -> None:
        for _ in range(round(seconds / PERIOD_S)):
            self.step()

    def step(self) -> None:
        now_ns = nanoseconds(START_S + self.time_s)
        foot = np.array([*self._path(self.time_s), 0.0])
        if not self._hidden(self.time_s):
            self._look(foot, now_ns)
        position, velocity = (self._reckoned, self._airspeed) if self._relative else (self.position, self.velocity)
        drift = self._drift
        motion = Motion(now_ns, position + drift * self.time_s, velocity + drift, self.yaw, self._rate)
        altitude_m = float(self.position[2]) if self._altitude else None
        x, y, z = self.position.tolist()
        command = self.law.step(
            now_ns,
            motion,
            altitude_m,
            self.estimator,
            self._seen_ns,
            self._others(now_ns),
            relative=self._relative,
            position=(x, y, z) if drift.any() else None,
        )
        self._note(foot, command)
        if isinstance(command, Attitude):
            self.tilt += (np.array([command.roll, command.pitch]) - self.tilt) * (1 - math.exp(-PERIOD_S / 0.15))
            ahead, left = GRAVITY * math.tan(self.tilt[1]), -GRAVITY * math.tan(self.tilt[0])
            self.velocity[:2] += (self._turned(ahead, left) - 0.3 * self.velocity[:2]) * PERIOD_S
            up, turn = command.climb, command.yaw_rate
        else:
            wanted = self._turned(command.forward, command.left)
            self.velocity[:2] += (wanted - self.velocity[:2]) * (1 - math.exp(-PERIOD_S / 0.4))
            up, turn = command.up, command.yaw_rate
        self.velocity[2] += (up - self.velocity[2]) * (1 - math.exp(-PERIOD_S / 0.4))
        self._rate += (turn - self._rate) * (1 - math.exp(-PERIOD_S / 0.1))
        self.position = self.position + self.velocity * PERIOD_S
        self.yaw = wrap_angle(self.yaw + self._rate * PERIOD_S)
        self._reckon()
        self._steps += 1

    def _reckon(self) -> None:
        """Return the motion estimated from the vehicle's attitude."""
        roll, pitch = self.tilt.tolist()
        ns = nanoseconds(START_S + self.time_s)
        tilted = Feedback(captured_ns=ns, state=FlightState.FLYING, roll_rad=roll, pitch_rad=pitch, yaw_rad=self.yaw)
        forward, left, _ = self._tilts.step(tilted) or (0.0, 0.0, 0.0)
        self._airspeed[:2] = self._turned(forward, left)
        self._reckoned = self._reckoned + self._airspeed * PERIOD_S

    def _look(self, foot: Array, now_ns: int) -> None:
        roll, pitch = self.tilt.tolist()
        drifted = self._drift * self.time_s
        x, y = ((self._reckoned if self._relative else self.position) + drifted)[:2].tolist()
        camera = camera_at(x, y, float(self.position[2]), roll=roll, pitch=pitch, yaw=self.yaw)
        shown = np.add(foot, [*(self._reckoned - self.position)[:2], 0.0]) if self._relative else foot + drifted
        box = box_of(camera, shown)
        view = None if box is None else BoxView.of(box if self._rng is None else noisy(box, self._rng), camera)
        if view is None:
            return
        if self.estimator is None:
            known = self._traits.height_m is not None
            self.estimator = estimator_of("thing" if known else None, self._traits, relative=self._relative)
            self.estimator.start(view, camera, now_ns, ground=self._altitude)
            self._seen_ns = now_ns
        elif self.estimator.update(view, camera, now_ns):
            self._seen_ns = now_ns

    def _note(self, foot: Array, command: object) -> None:
        away = foot[:2] - self.position[:2]
        distance = float(np.hypot(*away))
        self.phases.append(self.law.phase)
        self.ranges.append(distance)
        self.bearings.append(math.atan2(-away[1], -away[0]))
        self.azimuths.append(wrap_angle(math.atan2(away[1], away[0]) - self.yaw))
        self.speeds.append(float(self.velocity[:2] @ away) / distance)
        self.places.append(self.position.copy())
        self.commands.append(command)

    def _turned(self, forward: float, left: float) -> Array:
        c, s = math.cos(self.yaw), math.sin(self.yaw)
        return np.array([c * forward - s * left, s * forward + c * left])
