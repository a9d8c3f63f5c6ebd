"""Range estimation for targets that may not be on the ground, using bearings to choose between hypotheses. Pure.

A box drawn by a user may contain a person on the ground, a picture on a wall or a lamp. Its lower edge gives the range
only if the target is on the ground: a picture on a wall whose lower edge is just below the vehicle would seem far away,
and the filter would be overconfident. Being on the ground is therefore only one of several hypotheses. The others
assume ranges from near to far, and each has its own filter (T. R. Kronhamn, "Bearings-only target motion analysis based
on a multihypothesis Kalman filter and adaptive ownship motion control", IEE Proceedings 145(4), 1998; N. Peach, IEE
Proceedings 142(1), 1995). While the vehicle is at rest, all hypotheses fit. Once the vehicle has moved, hypotheses with
a wrong range no longer fit. Vertical motion works best, because targets hardly move vertically. An altimeter that
drifts or passes over rising ground reports motion that did not happen. For a target that may be off the ground, the
camera's height is therefore taken from the vehicle's own climb and follows the altimeter only slowly.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import replace
from typing import Final

import numpy as np

from skyloop.clock import seconds
from skyloop.control.limiting import within
from skyloop.control.target_estimate import (
    LEAST_SLOPE,
    SURE_OF_SIZE,
    UNKNOWN,
    BoxView,
    CameraPose,
    TargetEstimator,
    TargetState,
    Traits,
)

_RANGES_M: Final = tuple(0.7 * 1.7**n for n in range(8))  # initial ranges of the hypotheses, up to 29 m
_SHARE: Final = 0.3  # standard deviation of each range, as a fraction of the range
_ON_GROUND: Final = 0.5  # prior probability that the target is on the ground
_AS_BEFORE: Final = 0.5  # standard deviation of the log range of a target that was seen before
_TOGETHER_S: Final = 0.3  # time within which several boxes count as one, because a tracker's errors persist
_WORST: Final = 50.0  # maximum cost of a single box for a hypothesis
_LEAST: Final = 1e-3  # minimum probability of a hypothesis; less likely ones are dropped
_KNOWN: Final = 0.2  # relative deviation below which the range counts as known
_UNKNOWN: Final = 0.4  # relative deviation above which the range counts as unknown again
_STIRRED_M: Final = 0.1  # distance from the vehicle's recent position at which boxes get their full weight
_OF_LATE_S: Final = 2.0  # averaging time for the recent position
_BASELINE: Final = 0.015  # minimum ratio of the vehicle's displacement to the range before the range is known
_JUMP_M: Final = 0.15  # maximum sudden change of the vehicle's height ...
_JUMP_M_S: Final = 1.0  # ... plus this per second; beyond that, the altimeter sees another surface
_JUMPING_S: Final = 0.5  # maximum time that a filtered altimeter needs to follow a jump
_STEADY_S: Final = 30.0  # time constant with which the camera's height follows the altimeter if the climb is known
_APART_M: Final = 3.0  # maximum difference between altimeter and climb; beyond it, the climb is no longer valid


class RangeEstimator(TargetEstimator):
    """The filters for a target that may or may not be on the ground."""

    def __init__(
        self, traits: Traits, *, nominal_m: float = 4.0, relative: bool = False, before: TargetState | None = None
    ) -> None:
        """Initialise the filters; ``before`` is the state in which the target was lost, if its range was known."""
        super().__init__(traits, nominal_m=nominal_m, relative=relative)
        self._seen_before = before
        self._guesses: list[TargetEstimator] = []
        self._weights = np.ones(0)
        self._on_ground: TargetEstimator | None = None  # hypothesis that the target is on the ground; None once dropped
        self._sight = self._about = np.zeros(3)  # initial line of sight, and recent mean position of the vehicle
        self._stirred_m = 0.0  # maximum distance from that position so far, measured across the initial line of sight
        self._heights: deque[tuple[int, float]] = deque()  # recent times and heights
        self._jumped_ns: int | None = None  # time of the last jump of the height
        self._base_m = 0.0  # averaged difference between altimeter and climb [m]
        self._size_known = self._known = self._learns = False

    def start(self, view: BoxView, camera: CameraPose, at_ns: int, *, ground: bool) -> None:
        """Start from the first box, as in :meth:`TargetEstimator.start`.

        If the camera's height is unknown, the hypotheses can't be distinguished. There is then only one filter, whose
        range follows from the target's size or, if that is unknown, is nominal: the control law then keeps the apparent
        size constant.
        """
        self._size_known = self.traits.height_m is not None and self.traits.height_share < SURE_OF_SIZE
        self._base_m = _off_climb(camera)
        self._guesses, weights = [], []
        self._on_ground, self._known, self._learns = None, not ground, ground
        below = view.bottom is None or view.bottom < -LEAST_SLOPE
        if ground and below and self.traits.on_ground is not False:
            self._on_ground = self._member(view, camera, at_ns, on_ground=True)
            weights.append(_ON_GROUND)
        stood = self._on_ground is not None and self.traits.on_ground  # prior knowledge
        if not stood and (self._size_known or not ground):
            self._member(view, camera, at_ns, on_ground=False)
            weights.append(1.0 - _ON_GROUND)
        elif not stood:
            for distance_m in _RANGES_M:
                self._guesses.append(guess := TargetEstimator(self.traits, relative=self._relative))
                guess.start_at(distance_m, _SHARE, view, camera, at_ns)
                weights.append((1.0 - _ON_GROUND) / len(_RANGES_M) * self._as_before(distance_m))
        self._weights = np.array(weights) / sum(weights)
        self.seen_ns, self.refused = at_ns, 0
        azimuth = view.azimuth
        self._sight = np.array([math.cos(azimuth), math.sin(azimuth), 0.0])
        self._about, self._stirred_m = camera.position, 0.0
        self._heights.append((at_ns, float(camera.position[2])))
        self._judge(self.at(at_ns))

    def distance(self, view: BoxView, camera: CameraPose, at_ns: int) -> tuple[float, float]:
        """Measure how badly a box fits the best hypothesis and the mixture; see :meth:`TargetEstimator.distance`."""
        seen_from = self._seen_from(camera, self._steady(camera))
        fits, costs = zip(*(guess.distance(view, one, at_ns) for guess, one in seen_from), strict=True)
        likelihood = float(self._weights @ np.exp(-np.minimum(costs, 700.0) / 2.0))
        return min(fits), -2.0 * math.log(likelihood) if math.isfinite(min(costs)) and likelihood > 0.0 else math.inf

    def update(self, view: BoxView, camera: CameraPose, at_ns: int) -> bool:
        """Update with a box, as in :meth:`TargetEstimator.update`, and drop hypotheses that no longer fit.

        The filters restart if the measured height jumps, because someone walks below, the vehicle flies over a table,
        or its height was unknown. Such apparent motion would otherwise "prove" that the target is far away.
        """
        if self.seen_ns is None:
            return super().update(view, camera, at_ns)  # raises UsageError
        apart_m, since_s = _off_climb(camera) - self._base_m, seconds(at_ns - self.seen_ns)
        if self._learns and (self._jumps(camera, at_ns) or abs(apart_m) > _APART_M):
            self._seen_before = self.at(at_ns) if self._known else self._seen_before
            self.start(view, camera, at_ns, ground=True)
            return True
        self._base_m += apart_m * within(since_s / _STEADY_S, 0.0, 1.0)
        steady = self._steady(camera)
        seen_from = self._seen_from(camera, steady)
        costs = np.minimum([guess.distance(view, one, at_ns)[1] for guess, one in seen_from], 1e9)
        used = [guess.update(view, one, at_ns) for guess, one in seen_from]
        if not any(used):
            self.refused += 1
            return False
        self.seen_ns, self.refused = max(at_ns, self.seen_ns), 0
        # Boxes seen while the vehicle is at rest carry no information, but would slowly favour the stillest hypothesis.
        stirred = self._stir(steady, since_s) / _STIRRED_M
        weight = 1.0 if self._size_known else within(stirred**2, 0.0, 1.0)
        worse = np.minimum(costs - costs.min(), _WORST)
        self._weights = self._weights * np.exp(-0.5 * worse * weight * within(since_s / _TOGETHER_S, 0.0, 1.0))
        self._drop()
        self._judge(self.at(self.seen_ns))
        return True

    def at(self, at_ns: int) -> TargetState:
        """Predict the target's state, as in :meth:`TargetEstimator.at`: the mean and deviation of all hypotheses."""
        if self.seen_ns is None:
            return super().at(at_ns)  # raises UsageError
        states = [guess.at(at_ns) for guess in self._guesses]
        weights = self._weights

        def mean(values: list[float]) -> float:
            return float(weights @ np.array(values))

        foot = weights @ np.array([one.foot for one in states])
        distance = mean([one.range_m for one in states])
        apart = [float((one.foot[:2] - foot[:2]) @ (one.foot[:2] - foot[:2])) for one in states]
        deviation_m = math.sqrt(mean([one.range_deviation_m**2 + (one.range_m - distance) ** 2 for one in states]))
        return TargetState(
            at_ns=at_ns,
            foot=foot,
            velocity=weights @ np.array([one.velocity for one in states]),
            height_m=mean([one.height_m for one in states]),
            place_m=math.sqrt(mean([one.place_m**2 + off for one, off in zip(states, apart, strict=True)])),
            range_m=distance,
            range_deviation_m=deviation_m,
            range_known=self._known,
            margin_m=deviation_m if self.on_ground is False and self._learns else 0.0,
        )

    @property
    def on_ground(self) -> bool | None:
        """Whether the target is on the ground; None while unknown."""
        if self._on_ground is None:
            return False
        likeliest = self._guesses[int(np.argmax(self._weights))]
        return True if self._known and likeliest is self._on_ground else None

    def again(self, at_ns: int) -> TargetEstimator:
        """Return a new filter for the same target, to be started once the target is back in view."""
        before, stands = self.at(at_ns), self.on_ground
        traits = self.traits if stands is None else replace(self.traits, on_ground=stands)
        return RangeEstimator(
            traits, nominal_m=before.range_m, relative=self._relative, before=before if self._known else None
        )

    def _member(self, view: BoxView, camera: CameraPose, at_ns: int, *, on_ground: bool) -> TargetEstimator:
        member = TargetEstimator(self.traits, nominal_m=self._nominal_m, relative=self._relative)
        member.start(view, camera, at_ns, ground=on_ground)
        if on_ground and not self._size_known:
            member.loosen(member.at(at_ns).range_m)
        self._guesses.append(member)
        return member

    def _as_before(self, distance_m: float) -> float:
        if self._seen_before is None:
            return 1.0
        return math.exp(-0.5 * (math.log(distance_m / self._seen_before.range_m) / _AS_BEFORE) ** 2)

    def _drop(self) -> None:
        self._weights = self._weights / self._weights.sum()
        kept = np.flatnonzero(self._weights >= min(_LEAST, float(self._weights.max())))
        self._guesses = [self._guesses[n] for n in kept]
        self._weights = self._weights[kept] / self._weights[kept].sum()
        if self._on_ground not in self._guesses:
            self._on_ground = None

    def _steady(self, camera: CameraPose) -> CameraPose:
        """Return the camera with a height derived from the vehicle's own climb."""
        if camera.rise_m is None:
            return camera
        x, y, _ = camera.position
        return replace(camera, position=np.array([x, y, camera.rise_m + self._base_m]))

    def _seen_from(self, camera: CameraPose, steady: CameraPose) -> list[tuple[TargetEstimator, CameraPose]]:
        """Return each hypothesis with its camera; the ground hypothesis uses the altimeter's height."""
        return [(guess, camera if guess is self._on_ground else steady) for guess in self._guesses]

    def _jumps(self, camera: CameraPose, at_ns: int) -> bool:
        """Return whether the height is jumping or has just jumped."""
        height, heights = float(camera.position[2]), self._heights
        while len(heights) > 1 and abs(seconds(at_ns - heights[0][0])) > _JUMPING_S:
            heights.popleft()
        if any(abs(height - was) > _JUMP_M + _JUMP_M_S * abs(seconds(at_ns - ns)) for ns, was in heights):
            self._jumped_ns = at_ns
        heights.append((at_ns, height))
        return self._jumped_ns is not None and abs(seconds(at_ns - self._jumped_ns)) < _JUMPING_S

    def _stir(self, camera: CameraPose, since_s: float) -> float:
        """Return the vehicle's distance [m] from its recent position, measured across the initial line of sight."""
        self._about = self._about + (camera.position - self._about) * within(since_s / _OF_LATE_S, 0.0, 1.0)
        x, y, z = (camera.position - self._about).tolist()
        off_m = math.hypot(float(self._sight[0] * y - self._sight[1] * x), z)
        self._stirred_m = max(self._stirred_m, off_m)
        return off_m

    def _judge(self, state: TargetState) -> None:
        """Decide whether the range is known, either from the target's size or from the vehicle's own motion."""
        share = state.range_deviation_m / state.range_m
        if self._known:
            self._known = share < _UNKNOWN or len(self._guesses) == 1
        else:
            sure = self._size_known or self.traits.on_ground
            moved = self._stirred_m > _BASELINE * state.range_m
            self._known = share < _UNKNOWN if sure else moved and share < _KNOWN


def _off_climb(camera: CameraPose) -> float:
    """Return the camera's height minus the vehicle's climb [m]; 0 if the climb is unknown."""
    return 0.0 if camera.rise_m is None else float(camera.position[2]) - camera.rise_m


def estimator_of(
    class_name: str | None, traits: Traits | None, *, nominal_m: float = 4.0, relative: bool = False
) -> TargetEstimator:
    """Create an unstarted filter for a target; ``class_name`` is None for a box drawn by a user."""
    if traits is not None and (class_name is not None or traits.on_ground is not None):
        return TargetEstimator(traits, nominal_m=nominal_m, relative=relative)
    return RangeEstimator(traits or UNKNOWN, nominal_m=nominal_m, relative=relative)
