"""Where a thing is, how it moves and how large it is, from its box in images. Pure: times are on the proxy's clock.

An extended Kalman filter (Bar-Shalom, Li and Kirubarajan, "Estimation with Applications to Tracking and Navigation",
Wiley 2001, section 10.3) of the place where the thing stands, its horizontal velocity, the height of its foot and the
logarithm of its height. Each box gives an azimuth and the slopes to the lower and the upper edge. So the range comes
from all there is, with an uncertainty to go by: from the known size of a class or a thing, from the ground that it
stands on where the vehicle knows its own height, and from the vehicle's motion, as what is near grows faster. Where
none of these is known, the range at the start is taken to be a nominal one, and all ranges scale with it: the law then
keeps the apparent size, as in image-based following (Pestana, Sanchez-Lopez, Campoy and Saripalli, "Vision based
GPS-denied object tracking and following for unmanned aerial vehicles", SSRR 2013).
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from skyloop.clock import seconds
from skyloop.control.limiting import within
from skyloop.control.target_view import BoxView, Camera
from skyloop.errors import UsageError
from skyloop.estimation import corrected, drift

Array = NDArray[np.float64]

_NEAREST_M: Final = 0.3
_RECKONING_M2_S3: Final = 0.5  # intensity of dead reckoning's error: gusts, and a drag other than the assumed one
_LATE_S: Final = 0.5  # a box that is later than this is of no use
_ADAPTING: Final = 0.3  # of the surprise, by one box
_USUAL: Final = 1.5  # surprise that is taken for noise
_MOST_SURPRISE: Final = 4.0
_STRAIGHT_S: Final = 4.0  # nothing unseen is thought to go straight on for longer
_GONE_S: Final = 0.2  # a thing that was not seen for longer, and for more images than one or two, is hidden
_GONE_INTERVALS: Final = 2.5
_BEFORE_S: Final = 0.2  # before it was seen last: what hid it had not begun to cut its box off then
_GATE: Final = 4.0  # standard deviations, of the azimuth
_EDGE_GATE: Final = 3.0  # of an edge: a farther one is hidden by something, or the image of something else
_OUTGROWN: Final = 3.0  # standard deviations of both edges, outwards
_PACE_PER_S: Final = 0.2  # deviation of a velocity, by a range that is only a guess
LEAST_SLOPE: Final = 0.04  # of an edge, below which its height says nothing about the range
SURE_OF_SIZE: Final = 0.4  # deviation of the logarithm of the height, from which on it counts as unknown


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


@dataclass(frozen=True, slots=True)
class Traits:
    """What is known beforehand of a kind of thing.

    Attributes:
        height_m: How high it is; None: not known.
        height_share: Standard deviation of that, as a share of it.
        radius_m: From its middle to where its lower edge is seen.
        intensity_m2_s3: Of the random acceleration: within a second the velocity wanders by the root of it.
        on_ground: Whether it stands on the ground. None: what has a class is taken to; of anything else that is one
            guess among others (:mod:`.target_range`).

    Raises:
        UsageError: A number is out of its range.
    """

    height_m: float | None = None
    height_share: float = 0.1
    radius_m: float = 0.0
    intensity_m2_s3: float = 1.0
    on_ground: bool | None = None

    def __post_init__(self) -> None:
        if self.height_m is not None and not (_is_number(self.height_m) and 0.01 <= self.height_m <= 100.0):
            raise UsageError(f"height_m is {self.height_m!r} and must be from 0.01 to 100 m, or None")
        for name in ("height_share", "radius_m", "intensity_m2_s3"):
            value = getattr(self, name)
            if not (_is_number(value) and 0.0 <= value < math.inf):
                raise UsageError(f"{name} is {value!r} and must be a finite number, 0 or more")


#: By the name of a class. Heights of people and cars vary by about this much; a bus is no car.
TRAITS: Final = {
    "person": Traits(height_m=1.74, height_share=0.06, radius_m=0.25, intensity_m2_s3=0.6),
    "car": Traits(height_m=1.45, height_share=0.2, radius_m=1.2, intensity_m2_s3=3.0),
    "truck": Traits(height_m=2.8, height_share=0.4, radius_m=1.5, intensity_m2_s3=4.0),
    "bus": Traits(height_m=3.0, height_share=0.2, radius_m=1.5, intensity_m2_s3=4.0),
    "bicycle": Traits(height_m=1.5, height_share=0.3, radius_m=0.4, intensity_m2_s3=1.5),
    "dog": Traits(height_m=0.55, height_share=0.4, radius_m=0.2, intensity_m2_s3=2.0),
    "box": Traits(radius_m=0.3, intensity_m2_s3=0.05),
}
UNKNOWN: Final = Traits(radius_m=0.1)  #: of what has no class


@dataclass(frozen=True, slots=True, eq=False)
class TargetState:
    """A target at one time.

    Attributes:
        at_ns: On the proxy's clock.
        foot: Where it stands, (3,) [m]: odometry axes, the third above the ground.
        velocity: Horizontal, (2,) [m/s]; through the air, where the vehicle does not report its own.
        height_m: How high it is.
        place_m: Standard deviation of its place: the root of the sum of its horizontal variances.
        range_m: Horizontal distance from the camera that saw it last.
        range_deviation_m: Standard deviation along the line of sight.
        range_known: Whether the range is good enough to fly by; False while nothing but a guess tells it.
        margin_m: How much nearer it may be, for which a vehicle stays farther off; 0 for a target on the ground.
    """

    at_ns: int
    foot: Array
    velocity: Array
    height_m: float
    place_m: float
    range_m: float
    range_deviation_m: float
    range_known: bool = True
    margin_m: float = 0.0

    @property
    def middle(self) -> Array:
        """Its middle, (3,) [m]."""
        return np.add(self.foot, (0.0, 0.0, self.height_m / 2))


class _Estimate(NamedTuple):
    at_ns: int
    state: Array
    covariance: Array


class TargetEstimator:
    """The filter of one thing.

    Attributes:
        traits: What was known beforehand.
        refused: Boxes in a row that did not fit.
        seen_ns: Capture of the last box that fitted; None before :meth:`start`.
    """

    def __init__(self, traits: Traits = UNKNOWN, *, nominal_m: float = 4.0, relative: bool = False) -> None:
        """Initialise the filter.

        Args:
            traits: What is known of the thing.
            nominal_m: Its distance at the start where nothing tells it.
            relative: Whether the vehicle's own velocity is known by dead reckoning only, whose changing error adds to
                the thing's motion.
        """
        self.traits = traits
        self.refused = 0
        self.seen_ns: int | None = None
        self._nominal_m, self._relative = nominal_m, relative
        self._intensity = traits.intensity_m2_s3 + (_RECKONING_M2_S3 if relative else 0.0)
        self._at_ns = 0
        self._state = np.zeros(6)  # x, y, velocities, foot's height, log of the height
        self._covariance = np.eye(6)
        self._surprise = 1.0  # of late: the squared Mahalanobis distance of an azimuth and a size, about 1
        self._eye: Array = np.zeros(3)  # of the camera that saw it last
        self._before: deque[_Estimate] = deque()  # of the boxes before, as far back as _BEFORE_S
        self._interval_s = 0.0  # between the last two boxes

    def start(self, view: BoxView, camera: Camera, at_ns: int, *, ground: bool) -> None:
        """Start from the first box.

        Args:
            view: What the box shows.
            camera: That took the image.
            at_ns: Its capture.
            ground: Whether the camera's height above the ground is known.
        """
        traits, height = self.traits, float(camera.position[2])
        ground = ground and traits.on_ground is not False
        guesses = [(self._nominal_m, 0.5)]  # range, relative deviation
        if ground and view.bottom is not None and view.bottom < -LEAST_SLOPE:
            share = math.hypot(view.edge / -view.bottom, 0.05 / max(0.1, height)) + view.tilt / -view.bottom
            guesses.append((height / -view.bottom + traits.radius_m, share))
        if traits.height_m is not None and view.bottom is not None and view.top is not None:
            slopes = max(1e-3, view.top - view.bottom)
            guesses.append((traits.height_m / slopes, math.hypot(traits.height_share, 1.5 * view.edge / slopes)))
        if ground and traits.height_m is not None and view.top is not None and abs(view.top) > LEAST_SLOPE:
            above = traits.height_m - height  # of the camera
            share = math.hypot(traits.height_share * traits.height_m / max(0.05, abs(above)), view.edge / abs(view.top))
            if above / view.top > 0.0:
                guesses.append((above / view.top, share + view.tilt / abs(view.top)))
        distance, share = min(guesses, key=lambda guess: guess[1])
        distance = max(_NEAREST_M, distance)
        share = min(0.5, 1.3 * share + 0.02)
        known = traits.height_m is not None and traits.height_share < SURE_OF_SIZE
        foot = 0.0 if ground else height + distance * (view.bottom if view.bottom is not None else -0.2)
        if known and traits.height_m is not None:
            log_height, log_deviation = math.log(traits.height_m), traits.height_share
        else:
            upper = height + distance * (view.top if view.top is not None else 0.2)
            log_height, log_deviation = math.log(max(0.05, upper - foot)), 0.15
        along = np.array([math.cos(view.azimuth), math.sin(view.azimuth)])
        aside = np.array([-along[1], along[0]])
        place = camera.position[:2] + distance * along
        self._state = np.array([*place, 0.0, 0.0, foot, log_height])
        covariance = np.zeros((6, 6))
        radial, tangential = (share * distance) ** 2, (view.azimuth_rad * distance + 0.05) ** 2
        covariance[:2, :2] = radial * np.outer(along, along) + tangential * np.outer(aside, aside)
        covariance[2:4, 2:4] = np.eye(2) * (1.0 if self._intensity < 3.0 else 4.0)
        covariance[4, 4] = 0.05**2 if ground else (0.1 * distance) ** 2
        covariance[5, 5] = log_deviation**2
        if not known:  # what is farther than it was taken to be is larger, too
            covariance[:2, 5] = covariance[5, :2] = radial / distance * along
            covariance[5, 5] += share**2
        self._begin(self._state, covariance, camera, at_ns)

    def start_at(self, distance_m: float, share: float, view: BoxView, camera: Camera, at_ns: int) -> None:
        """Start from the first box, at a range that is only a guess: wherever the thing is, its box is as it is.

        Args:
            distance_m: The range; foot and height go along with it.
            share: Standard deviation of that, as a share of it.
            view: What the box shows.
            camera: That took the image.
            at_ns: Its capture.
        """
        bottom = -0.2 if view.bottom is None else view.bottom
        top = 0.2 if view.top is None else view.top
        slopes, edge = max(1e-3, top - bottom), math.hypot(view.edge, view.tilt)
        along = np.array([math.cos(view.azimuth), math.sin(view.azimuth)])
        aside = np.array([-along[1], along[0]])
        foot, log_height = camera.position[2] + distance_m * bottom, math.log(max(0.01, slopes * distance_m))
        outwards = np.array([*along, 0.0, 0.0, bottom, 1.0 / distance_m])
        covariance = (share * distance_m) ** 2 * np.outer(outwards, outwards)
        covariance[:2, :2] += (view.azimuth_rad * distance_m + 0.05) ** 2 * np.outer(aside, aside)
        covariance[4, 4] += ((edge if view.bottom is not None else 0.3) * distance_m) ** 2
        covariance[5, 5] += (1.5 * edge / slopes) ** 2 if None not in (view.bottom, view.top) else 0.5**2
        place = camera.position[:2] + distance_m * along
        self._begin(np.array([*place, 0.0, 0.0, foot, log_height]), covariance, camera, at_ns)
        self.loosen(distance_m)

    def loosen(self, distance_m: float) -> None:
        """Count on a faster target the farther it is, directly after the start.

        Else the likelihood of boxes that hardly move would speak for the farthest of several guesses.

        Args:
            distance_m: The range that is guessed.
        """
        pace = _PACE_PER_S * distance_m
        self._intensity += self.traits.intensity_m2_s3 * (pace**2 - 1.0)
        self._covariance[2:4, 2:4] = np.eye(2) * pace**2

    def _begin(self, state: Array, covariance: Array, camera: Camera, at_ns: int) -> None:
        self._state, self._covariance = state, covariance
        self._at_ns = self.seen_ns = at_ns
        self._eye = camera.position
        self.refused, self._surprise = 0, 1.0
        self._before.clear()
        self._remember(at_ns)

    def distance(self, view: BoxView, camera: Camera, at_ns: int) -> tuple[float, float]:
        """Return how badly a box fits.

        Returns:
            The squared Mahalanobis distance divided by the number of what was measured, which is about 1 for its own
            boxes; and the negative logarithm of its likelihood, up to what all filters have in common for this box.
            Both are infinite for a box that is too large above and below: something may hide a part of a thing, but
            add nothing to it.
        """
        state, covariance = self._predict(at_ns)
        off, jacobian, noise = _innovation(view, camera, state, self.traits.radius_m)
        spread = jacobian @ covariance @ jacobian.T + noise
        share = off / np.sqrt(np.diag(spread))
        if len(share) == 3 and -share[1] > _OUTGROWN and share[2] > _OUTGROWN:
            return math.inf, math.inf
        squared = float(off @ np.linalg.solve(spread, off))
        return squared / len(off), squared + float(np.linalg.slogdet(spread)[1] - np.linalg.slogdet(noise)[1])

    def update(self, view: BoxView, camera: Camera, at_ns: int) -> bool:
        """Update with a box.

        An edge far from where it is expected is left out: something hides it. A box in another direction is refused.

        Args:
            view: What the box shows.
            camera: That took the image.
            at_ns: Its capture.

        Returns:
            Whether the box was used; False also for one that is more than half a second older than the newest.

        Raises:
            UsageError: :meth:`start` was not called.
        """
        if self.seen_ns is None:
            raise UsageError("the target was never seen: call start() with its first box")
        late_s = max(0.0, seconds(self._at_ns - at_ns))
        if late_s > _LATE_S:
            return False
        state, covariance = self._predict(at_ns)
        off, jacobian, noise = _innovation(view, camera, state, self.traits.radius_m)
        spread = jacobian @ covariance @ jacobian.T + noise
        share = np.abs(off) / np.sqrt(np.diag(spread))
        if share[0] > _GATE:
            self.refused += 1
            return False
        used = np.flatnonzero(share <= [_GATE] + [_EDGE_GATE] * (len(off) - 1))
        off, jacobian, noise = off[used], jacobian[used], noise[np.ix_(used, used)]
        fit = float(off @ np.linalg.solve(spread[np.ix_(used, used)], off)) / len(off)
        self._surprise += _ADAPTING * (min(_MOST_SURPRISE, fit) - self._surprise)
        state, self._covariance = corrected(state, covariance, off, jacobian, noise)
        self._state = _moved(state, late_s)
        self._remember(max(at_ns, self._at_ns))
        self._at_ns = self.seen_ns = max(at_ns, self._at_ns)
        if late_s == 0.0:
            self._eye = camera.position
        self.refused = 0
        return True

    def at(self, at_ns: int) -> TargetState:
        """Predict the target's state. It is not moved on for more than four seconds, but ever less certain.

        A thing that is hidden goes on as it went shortly before it was: what hides it cuts off its last boxes.

        Args:
            at_ns: The time to predict for.

        Raises:
            UsageError: :meth:`start` was not called.
        """
        if self.seen_ns is None:
            raise UsageError("the target was never seen: call start() with its first box")
        state, covariance = self._predict(at_ns)
        away = state[:2] - self._eye[:2]
        distance = max(_NEAREST_M, float(np.hypot(*away)))
        sight = away / distance
        place = covariance[:2, :2]
        return TargetState(
            at_ns=at_ns,
            foot=np.array([state[0], state[1], state[4]]),
            velocity=state[2:4].copy(),
            height_m=math.exp(float(state[5])),
            place_m=math.sqrt(max(0.0, float(np.trace(place)))),
            range_m=distance,
            range_deviation_m=math.sqrt(max(0.0, float(sight @ place @ sight))),
        )

    def again(self, at_ns: int) -> TargetEstimator:
        """Return a filter, not started yet, for the same thing where it comes into view again."""
        return TargetEstimator(self.traits, nominal_m=self.at(at_ns).range_m, relative=self._relative)

    def _predict(self, at_ns: int) -> tuple[Array, Array]:
        """Return state and covariance at a time.

        Shortly before the newest box, as detections of other processes come, the state is moved back and the covariance
        kept.
        """
        dt = seconds(at_ns - self._at_ns)
        if dt <= 0.0:
            return _moved(self._state, max(-_LATE_S, dt)), self._covariance
        if dt > max(_GONE_S, _GONE_INTERVALS * self._interval_s):
            from_ns, from_state, from_covariance = self._before[0]
            dt = seconds(at_ns - from_ns)
        else:
            from_state, from_covariance = self._state, self._covariance
        move, wander = np.eye(6), np.zeros((6, 6))
        # A thing that turns surprises the filter again and again: it is believed to turn harder then.
        harder = max(1.0, self._surprise / _USUAL) ** 2
        move[:4, :4], wander[:4, :4] = drift(dt, self._intensity * harder, axes=2)
        wander[4, 4] = 0.02**2 * dt
        wander[5, 5] = 0.01**2 * dt
        return _moved(from_state, min(dt, _STRAIGHT_S)), move @ from_covariance @ move.T + wander

    def _remember(self, at_ns: int) -> None:
        self._interval_s = seconds(at_ns - self._before[-1].at_ns) if self._before else 0.0
        self._before.append(_Estimate(at_ns, self._state, self._covariance))
        while len(self._before) > 1 and seconds(at_ns - self._before[1].at_ns) >= _BEFORE_S:
            self._before.popleft()


def _moved(state: Array, dt_s: float) -> Array:
    moved = state.copy()
    moved[:2] += state[2:4] * dt_s
    return moved


def _innovation(view: BoxView, camera: Camera, state: Array, radius_m: float) -> tuple[Array, Array, Array]:
    """Return measured minus expected, its derivative by the state, and the noise's covariance; azimuth first."""
    eye = camera.position
    dx, dy = float(state[0] - eye[0]), float(state[1] - eye[1])
    distance = max(_NEAREST_M, math.hypot(dx, dy))
    ux, uy = dx / distance, dy / distance
    height = math.exp(within(float(state[5]), -4.0, 5.0))
    off = view.azimuth - math.atan2(dy, dx)
    rows = [math.atan2(math.sin(off), math.cos(off))]
    jacobian = [[-uy / distance, ux / distance, 0.0, 0.0, 0.0, 0.0]]
    deviations = [view.azimuth_rad]
    near = max(_NEAREST_M, distance - radius_m)
    for slope, bound, side, level, away, by_height in (
        (view.bottom, view.below, -1.0, float(state[4]), near, 0.0),
        (view.top, view.above, 1.0, float(state[4]) + height, distance, height),
    ):
        expected = (level - float(eye[2])) / away
        if slope is None and bound is not None and side * (expected - bound) < 0.0:
            slope = bound  # it would be seen: so it is at least as near
        if slope is None:
            continue
        rows.append(slope - expected)
        jacobian.append([-expected / away * ux, -expected / away * uy, 0.0, 0.0, 1.0 / away, by_height / away])
        deviations.append(view.edge)
    noise = np.diag(np.square(deviations))
    noise[1:, 1:] += view.tilt**2
    return np.array(rows), np.array(jacobian), noise
