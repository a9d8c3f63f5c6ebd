"""See and avoid: fly ahead, and past what is in the way, by a colour and fuzzy rules.

What is in the way is tracked by its colour, and kept out of the middle of the picture by a fuzzy controller, as in
Olivares-Mendez, Campoy, Mellado-Bataller and Mejias, "See-and-avoid quadcopter using fuzzy control optimized by
cross-entropy", FUZZ-IEEE 2012. Here the rules are over where it is and how wide it looks, and say how fast to go aside.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum
from typing import TYPE_CHECKING

import numpy as np

from skyloop.clock import seconds
from skyloop.control.behaviour import Behaviour
from skyloop.control.fuzzy import FuzzyController, Rule, triangles
from skyloop.control.limiting import SetpointLimiter, SetpointLimits, clamped
from skyloop.control.target import Odometry
from skyloop.errors import UsageError
from skyloop.messages import Feedback, Polyline, Text, Velocity
from skyloop.messages.annotation import Colour, Shape
from skyloop.messages.geometry import wrap_angle
from skyloop.vision import BlobDetector, BlobSighting

if TYPE_CHECKING:
    from skyloop.client import Drone, Frame

_CLEAR: Colour = (64, 220, 100)
_NEAR: Colour = (255, 120, 60)


def avoidance() -> FuzzyController:
    """Sideways speed, 1 to the left to -1 to the right, by ``bearing`` [rad, left positive] and ``width`` [rad]."""
    variables = {
        "bearing": triangles({"right": -0.5, "ahead right": -0.2, "ahead": 0.0, "ahead left": 0.2, "left": 0.5}),
        "width": triangles({"far": 0.08, "near": 0.25, "close": 0.5}),
    }
    aside = {"right": (0.0, 0.0, 0.3), "ahead right": (0.0, 0.5, 0.9), "ahead": (-0.1, -0.8, -1.0)}
    mirrored = {"ahead left": aside["ahead right"], "left": aside["right"]}
    rules = [
        Rule({"bearing": bearing, "width": width}, then if bearing in aside else -then)
        for bearing, line in {**aside, **mirrored}.items()
        for width, then in zip(variables["width"], line, strict=True)
    ]
    return FuzzyController(variables, rules)


class AvoidPhase(StrEnum):
    CLEAR = "nothing in the way"
    AVOIDING = "going past something"
    ARRIVED = "arrived"


@dataclass(frozen=True, slots=True)
class AvoidSettings:
    """How it flies."""

    speed_m_s: float = 0.6  #: ahead
    aside_m_s: float = 0.7  #: at most
    close_rad: float = 0.9  #: so wide it looks when there is no going ahead any more
    back_share: float = 0.25  #: of the speed, where there is no way on
    avoiding_rad: float = 0.15  #: narrower ones are far
    passing_s: float = 2.5  #: for so long after it left the picture at one side it is not flown to that side
    yaw_gain: float = 1.5  #: [1/s]
    acceleration_m_s2: float = 2.0


class AvoidLaw:
    """What is in the way in, velocities out. Pure: times are on the proxy's clock [ns]."""

    def __init__(self, distance_m: float, settings: AvoidSettings | None = None) -> None:
        self.settings = s = settings or AvoidSettings()
        self.phase = AvoidPhase.CLEAR
        self.ahead_m = 0.0  #: how far it has come
        self._distance_m = distance_m
        self._rules = avoidance()
        self._odometry = Odometry()
        self._begin: np.typing.NDArray[np.float64] | None = None
        self._yaw = 0.0
        self._seen: list[BlobSighting] = []
        self._beside: dict[float, int] = {}  # side (1 left, -1 right): when something was last seen there
        self._limiter = SetpointLimiter(SetpointLimits(acceleration_m_s2=s.acceleration_m_s2))
        self._last_ns: int | None = None

    def feedback(self, feedback: Feedback) -> None:
        """Take the vehicle's newest state."""
        self._odometry.add(feedback)

    def see(self, seen: list[BlobSighting], captured_ns: int) -> None:
        """Take what is before the vehicle, the widest first."""
        self._seen = seen
        for one in seen:
            if one.width_rad > self.settings.avoiding_rad and abs(one.bearing_rad) > 0.25:
                self._beside[math.copysign(1.0, one.bearing_rad)] = captured_ns

    def step(self, now_ns: int) -> Velocity:
        """What to ask the vehicle for now."""
        s, motion = self.settings, self._odometry.at(now_ns)
        if motion is None:
            return Velocity()
        if self._begin is None:
            self._begin, self._yaw = motion.position, motion.yaw
        way = motion.position - self._begin
        self.ahead_m = float(way[0] * math.cos(self._yaw) + way[1] * math.sin(self._yaw))
        if self.ahead_m >= self._distance_m:
            self.phase = AvoidPhase.ARRIVED
            return Velocity()
        widest = self._seen[0] if self._seen else None
        near = widest is not None and widest.width_rad > s.avoiding_rad
        self.phase = AvoidPhase.AVOIDING if near else AvoidPhase.CLEAR
        aside, share = self._aside(now_ns), self._share()
        if share < 0.05 and abs(aside) < 0.05:
            share = -s.back_share  # there is no way on from here: back to where it came from
        wanted = np.array([s.speed_m_s * share, s.aside_m_s * aside])
        turn = clamped(s.yaw_gain * wrap_angle(self._yaw - motion.yaw), 1.0)
        dt_s = 0.0 if self._last_ns is None else seconds(now_ns - self._last_ns)
        self._last_ns = now_ns
        return self._limiter.step(np.array([*wanted, -0.8 * way[2], turn]), dt_s)

    def _share(self) -> float:
        """Of the speed ahead: the less, the wider something looks that is in the way."""
        in_the_way = (one.width_rad for one in self._seen if abs(one.bearing_rad) < one.width_rad / 2 + 0.2)
        return max(0.0, 1.0 - max(in_the_way, default=0.0) / self.settings.close_rad)

    def _aside(self, now_ns: int) -> float:
        """The rules' answers to all that is seen, together, unless something is there beside the vehicle."""
        aside = clamped(sum(self._rules.step(bearing=one.bearing_rad, width=one.width_rad) for one in self._seen), 1.0)
        side = math.copysign(1.0, aside)
        seen_ns = self._beside.get(side)
        in_view = any(one.bearing_rad * side > 0.25 for one in self._seen)
        blocked = seen_ns is not None and seconds(now_ns - seen_ns) < self.settings.passing_s and not in_view
        return 0.0 if blocked else aside


class SeeAndAvoid(Behaviour):
    """Flies ahead for a distance, keeps its height and yaw, and goes past whatever has the colour; then hovers."""

    name = "see and avoid"

    def __init__(
        self,
        drone: Drone,
        distance_m: float,
        colour: tuple[int, int, int] = (235, 110, 20),
        *,
        camera: str | None = None,
        settings: AvoidSettings | None = None,
    ) -> None:
        """``distance_m``: how far ahead; ``colour``: red, green, blue of what to avoid. Raises :class:`UsageError`,
        :class:`UnknownNameError` for a camera that is not there, :class:`MissingExtraError` without OpenCV."""
        if not 0.0 < distance_m < math.inf:
            raise UsageError(f"distance_m is {distance_m!r} and must be a finite number above 0")
        self._avoid_law = AvoidLaw(distance_m, settings)
        self._detector = BlobDetector(colour)
        super().__init__(drone, self._avoid_law, camera)

    @property
    def phase(self) -> AvoidPhase:
        """What it is doing."""
        return self._avoid_law.phase

    @property
    def ahead_m(self) -> float:
        """How far it has come."""
        return self._avoid_law.ahead_m

    def look(self, frame: Frame) -> list[Shape]:
        """Find what has the colour."""
        if self.phase is AvoidPhase.ARRIVED:
            self.finish(f"{self.ahead_m:.1f} m ahead")
            return []
        seen = self._detector.detect(frame)
        self._avoid_law.see(seen, frame.captured_ns)
        colour = _NEAR if self.phase is AvoidPhase.AVOIDING else _CLEAR
        boxes: list[Shape] = [Polyline(one.outline, True, colour) for one in seen]
        return [*boxes, Text(f"{self.phase.value}, {self.ahead_m:.1f} m", (8.0, 16.0), colour)]
