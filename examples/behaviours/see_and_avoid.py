"""See and avoid: fly ahead and past orange pillars, by fuzzy rules on the nearest one's bearing and apparent width.

python examples/behaviours/see_and_avoid.py             # in a simulated hall
python examples/behaviours/see_and_avoid.py alpha 6     # a running proxy, 6 m ahead

This is a complete custom behaviour with its own law. A fuzzy controller keeps an obstacle, detected by its colour, out
of the middle of the image, as in Olivares-Mendez, Campoy, Mellado-Bataller and Mejias, "See-and-avoid quadcopter using
fuzzy control optimized by cross-entropy", FUZZ-IEEE 2012. Here the rules map the obstacle's bearing and apparent width
to the sideways speed.

The rules are zero-order Takagi-Sugeno: each concludes a number, and the output is their mean, weighted by the rules'
truth, the product of the truths of its conditions (Takagi and Sugeno, "Fuzzy identification of systems and its
applications to modeling and control", IEEE Trans. SMC 15(1), 1985).
"""

from __future__ import annotations

import itertools
import math
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import TYPE_CHECKING

import numpy as np

import skyloop
from skyloop.clock import seconds
from skyloop.control.airframe import Part, VelocityLaw
from skyloop.control.behaviour import Behaviour
from skyloop.control.limiting import Array, SetpointLimits, clamped
from skyloop.errors import UnknownNameError, UsageError
from skyloop.messages import Polyline, Text
from skyloop.messages.geometry import wrap_angle
from skyloop.messages.relayed import Colour, Shape
from skyloop.vision import BlobDetector, BlobSighting

if TYPE_CHECKING:
    from skyloop.client import Drone, Frame

_CLEAR: Colour = (64, 220, 100)
_NEAR: Colour = (255, 120, 60)


@dataclass(frozen=True, slots=True)
class Trapezoid:
    """Membership function: 0 up to ``a``, rising to 1 at ``b``, 1 up to ``c``, falling to 0 at ``d``.

    Infinite ``a`` and ``b``, or ``c`` and ``d``, keep that side at 1.

    Raises:
        UsageError: The corners do not satisfy ``a`` ≤ ``b`` ≤ ``c`` ≤ ``d``.
    """

    a: float
    b: float
    c: float
    d: float

    def __post_init__(self) -> None:
        if not self.a <= self.b <= self.c <= self.d:
            raise UsageError(f"a trapezoid's corners must rise: {self.a}, {self.b}, {self.c}, {self.d}")

    def __call__(self, value: float) -> float:
        """Return the membership of a value, 0 to 1."""
        if self.b <= value <= self.c:
            return 1.0
        if value < self.b:
            return 0.0 if value <= self.a else (value - self.a) / (self.b - self.a)
        return 0.0 if value >= self.d else (self.d - value) / (self.d - self.c)


def triangles(peaks: Mapping[str, float]) -> dict[str, Trapezoid]:
    """Return triangular terms of one variable, each 1 at its peak and 0 at the next ones.

    The terms add up to 1 everywhere; the outermost ones stay at 1 beyond their peaks.

    Args:
        peaks: Value at which each term is 1, by name; at least two, in rising order.

    Raises:
        UsageError: There are fewer than two peaks, or they do not rise.
    """
    names, at = list(peaks), list(peaks.values())
    if len(at) < 2 or any(not low < high for low, high in itertools.pairwise(at)):
        raise UsageError(f"peaks need two or more values in rising order, got {dict(peaks)}")
    lows, highs = [-math.inf, *at[:-1]], [*at[1:], math.inf]
    return {
        name: Trapezoid(low, -math.inf if low == -math.inf else peak, math.inf if high == math.inf else peak, high)
        for name, low, peak, high in zip(names, lows, at, highs, strict=True)
    }


@dataclass(frozen=True, slots=True)
class Rule:
    """If every variable matches ``when``, the output is ``then``."""

    when: Mapping[str, str]  #: term of each variable; a variable without one may have any value
    then: float


class FuzzyController:
    """Rules over variables with linguistic terms."""

    def __init__(self, variables: Mapping[str, Mapping[str, Trapezoid]], rules: Sequence[Rule]) -> None:
        """Check and store the rules.

        Args:
            variables: Membership functions by variable and term.
            rules: One rule or more.

        Raises:
            UsageError: There is no rule.
            UnknownNameError: A rule names a variable or term that does not exist.
        """
        if not rules:
            raise UsageError("there is no rule")
        for rule in rules:
            for variable, term in rule.when.items():
                if variable not in variables:
                    raise UnknownNameError("fuzzy variable", variable, variables)
                if term not in variables[variable]:
                    raise UnknownNameError(f"term of {variable}", term, variables[variable])
        self._variables = {name: dict(terms) for name, terms in variables.items()}
        self._rules = tuple(rules)

    def step(self, **values: float) -> float:
        """Compute the output.

        Args:
            **values: A value for each variable.

        Returns:
            The weighted mean of the rules' conclusions; 0 if no rule applies.

        Raises:
            UsageError: A variable has no value, or its value is NaN.
        """
        missing = [name for name in self._variables if math.isnan(values.get(name, math.nan))]
        if missing:
            raise UsageError(f"no value of {', '.join(missing)}")
        weights = [
            math.prod(self._variables[name][term](values[name]) for name, term in rule.when.items())
            for rule in self._rules
        ]
        total = sum(weights)
        return sum(w * rule.then for w, rule in zip(weights, self._rules, strict=True)) / total if total > 0 else 0.0


def avoidance() -> FuzzyController:
    """Return the rules for the sideways speed.

    Their inputs are ``bearing`` [rad, left positive] and apparent ``width`` [rad] of an obstacle; the output ranges
    from 1 (to the left) to -1 (to the right).
    """
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
    """The phases of :class:`AvoidLaw`."""

    CLEAR = "the way is clear"
    AVOIDING = "passing an obstacle"
    ARRIVED = "arrived"


@dataclass(frozen=True, slots=True)
class AvoidSettings:
    """Speeds and distances of :class:`AvoidLaw`."""

    speed_m_s: float = 0.6  #: forward speed
    aside_m_s: float = 0.7  #: maximum sideways speed
    close_rad: float = 0.9  #: apparent width of an obstacle at which the speed ahead is 0
    back_share: float = 0.25  #: fraction of the speed used to back off when blocked
    avoiding_rad: float = 0.15  #: obstacles with a larger apparent width are avoided
    passing_s: float = 2.5  #: a side stays blocked for this long after an obstacle left the image there
    yaw_gain: float = 1.5  #: [1/s]
    acceleration_m_s2: float = 2.0


class AvoidLaw(VelocityLaw):
    """Computes velocities from sightings of obstacles. Pure: times are on the proxy's clock [ns].

    Attributes:
        phase: The phase after the last step.
        ahead_m: Distance flown ahead, along the yaw at the start.
    """

    def __init__(self, distance_m: float, settings: AvoidSettings | None = None) -> None:
        """Initialise the law.

        Args:
            distance_m: Distance to fly straight ahead.
            settings: None means the defaults.
        """
        self.settings = s = settings or AvoidSettings()
        super().__init__(SetpointLimits(acceleration_m_s2=s.acceleration_m_s2), Part.VELOCITY)
        self.phase = AvoidPhase.CLEAR
        self.ahead_m = 0.0  #: distance flown
        self._distance_m = distance_m
        self._rules = avoidance()
        self._begin: Array | None = None
        self._yaw = 0.0
        self._seen: list[BlobSighting] = []
        self._beside: dict[float, int] = {}  # side (1 left, -1 right): last sighting there

    def see(self, seen: list[BlobSighting], captured_ns: int) -> None:
        """Update with the obstacles in a frame.

        Args:
            seen: Obstacles, the widest first; empty if there are none. One with a NaN edge counts as close.
            captured_ns: Capture time of the frame [ns].
        """
        self._seen = [self._placed(one) for one in seen]
        for one in self._seen:
            if one.width_rad > self.settings.avoiding_rad and abs(one.bearing_rad) > 0.25:
                self._beside[math.copysign(1.0, one.bearing_rad)] = captured_ns

    def _setpoint(self, now_ns: int) -> Array:
        s, motion = self.settings, self._motion(now_ns)
        if self._begin is None:
            self._begin, self._yaw = motion.position, motion.yaw
        way = motion.position - self._begin
        self.ahead_m = float(way[0] * math.cos(self._yaw) + way[1] * math.sin(self._yaw))
        if self.ahead_m >= self._distance_m:
            self.phase = AvoidPhase.ARRIVED
            return np.zeros(4)
        widest = self._seen[0] if self._seen else None
        near = widest is not None and widest.width_rad > s.avoiding_rad
        self.phase = AvoidPhase.AVOIDING if near else AvoidPhase.CLEAR
        aside, share = self._aside(now_ns), self._share()
        if share < 0.05 and abs(aside) < 0.05:
            share = -s.back_share  # blocked ahead and to both sides: back off
        wanted = np.array([s.speed_m_s * share, s.aside_m_s * aside])
        turn = clamped(s.yaw_gain * wrap_angle(self._yaw - motion.yaw), 1.0)
        return np.array([*wanted, -0.8 * way[2], turn])

    def _placed(self, one: BlobSighting) -> BlobSighting:
        """Return a sighting, widened to a close obstacle if the lens model can't place all of it."""
        edges = [edge for edge in (one.left_rad, one.right_rad) if math.isfinite(edge)]
        if len(edges) == 2:
            return one
        at, half = (edges or [0.0])[0], self.settings.close_rad / 2
        return replace(one, left_rad=at + half, right_rad=at - half)

    def _share(self) -> float:
        """Return the fraction of the forward speed, which falls with the width of an obstacle ahead."""
        in_the_way = (one.width_rad for one in self._seen if abs(one.bearing_rad) < one.width_rad / 2 + 0.2)
        return max(0.0, 1.0 - max(in_the_way, default=0.0) / self.settings.close_rad)

    def _aside(self, now_ns: int) -> float:
        """Return the sum of the rules' outputs for all obstacles, or 0 if one that left the image blocks that side."""
        aside = clamped(sum(self._rules.step(bearing=one.bearing_rad, width=one.width_rad) for one in self._seen), 1.0)
        side = math.copysign(1.0, aside)
        seen_ns = self._beside.get(side)
        in_view = any(one.bearing_rad * side > 0.25 for one in self._seen)
        blocked = seen_ns is not None and seconds(now_ns - seen_ns) < self.settings.passing_s and not in_view
        return 0.0 if blocked else aside


class SeeAndAvoid(Behaviour):
    """Flies straight ahead at a constant height and yaw, avoids obstacles of one colour, and hovers at the end."""

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
        """Initialise the behaviour.

        Args:
            drone: The drone to fly; it must be airborne when :meth:`run` is called.
            distance_m: Distance to fly straight ahead.
            colour: Red, green, blue of the obstacles, 0 to 255.
            camera: Camera to use; None is the vehicle's first camera.
            settings: Settings of the law; None means the defaults.

        Raises:
            UsageError: The distance is not a finite number above 0, or the colour has no hue.
            UnknownNameError: The vehicle has no such camera.
            MissingExtraError: OpenCV is not installed.
        """
        if not 0.0 < distance_m < math.inf:
            raise UsageError(f"distance_m is {distance_m!r} and must be a finite number above 0")
        self._avoid_law = AvoidLaw(distance_m, settings)
        self._detector = BlobDetector(colour)
        super().__init__(drone, self._avoid_law, camera)

    @property
    def phase(self) -> AvoidPhase:
        """The current phase."""
        return self._avoid_law.phase

    @property
    def ahead_m(self) -> float:
        """Distance flown straight ahead [m]."""
        return self._avoid_law.ahead_m

    def look(self, frame: Frame) -> list[Shape]:
        """Detect obstacles by their colour."""
        if self.phase is AvoidPhase.ARRIVED:
            self.finish(f"{self.ahead_m:.1f} m ahead")
            return []
        seen = self._detector.detect(frame)
        self._avoid_law.see(seen, frame.captured_ns)
        colour = _NEAR if self.phase is AvoidPhase.AVOIDING else _CLEAR
        boxes: list[Shape] = [Polyline(one.outline, True, colour) for one in seen]
        return [*boxes, Text(f"{self.phase.value}, {self.ahead_m:.1f} m", (8.0, 16.0), colour)]


def main(target: str = "sim://?world=pillars&cameras=front&fps=15", distance_m: float | str = 12.5) -> None:
    rules = avoidance()
    print("aside, 1 left to -1 right, by bearing (across, left positive) and width (down):")
    bearings = (0.4, 0.2, 0.0, -0.2, -0.4)
    print("      ", *(f"{bearing:6.1f}" for bearing in bearings))
    for width in (0.1, 0.25, 0.5):
        print(f"{width:6.2f}", *(f"{rules.step(bearing=bearing, width=width):6.2f}" for bearing in bearings))
    with skyloop.connect(target) as drone:
        drone.takeoff()
        flight = SeeAndAvoid(drone, float(distance_m))
        with drone.on_event(lambda event: print(event.text)):
            print(flight.run(seconds=90.0))
        print(f"{flight.ahead_m:.1f} m ahead", "and arrived" if flight.done else "")


if __name__ == "__main__":
    main(*sys.argv[1:])
