"""Estimation of a target's position, motion and size from its box in images; pure, with times on the proxy's clock.

The estimate is an extended Kalman filter (Bar-Shalom, Li and Kirubarajan, "Estimation with Applications to Tracking and
Navigation", Wiley 2001, section 10.3) of the position of the target's foot, its horizontal velocity, the foot's height
and the logarithm of the target's height. Each box provides an azimuth and the slopes to its lower and upper edges. The
range and its uncertainty are derived from all available cues: the known size of a class or target, the ground below the
target (if the vehicle knows its own height) and the vehicle's motion, because close objects grow faster. If there is no
cue, a nominal initial range is assumed. All ranges are then proportional to this initial range, and the control law
keeps the apparent size constant, as in image-based following (Pestana, Sanchez-Lopez, Campoy and Saripalli, "Vision
based GPS-denied object tracking and following for unmanned aerial vehicles", SSRR 2013).

Directions are in *odometry axes* (see :mod:`.airframe`). The attitude at the time of capture is used to level the
directions, so that the vehicle's roll and pitch don't move an object. Edges outside the image only give bounds.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np

from skyloop.clock import seconds
from skyloop.control.limiting import Array, within
from skyloop.errors import UsageError
from skyloop.estimation import corrected, drift
from skyloop.messages import CameraInfo, Feedback, Intrinsics
from skyloop.poses import mounting_rotation
from skyloop.vision.lens import project, unproject
from skyloop.vision.tracking import Box

_CUT_PX: Final = 2.0  # distance to the image's edge within which a box may be cut off [px], ...
_CUT: Final = 0.07  # ... or this fraction of the box's height if that is more
_BESIDE: Final = 0.75  # maximum distance from the optical axis as a fraction of the image size; 0.5 is the edge
_STEEPEST: Final = 0.15  # minimum cosine of the elevation: objects almost straight above or below have no azimuth
_TILT_RAD: Final = 0.008  # error of roll and pitch at the time of capture, which shifts both edges equally
_YAW_RAD: Final = 0.006  # error of the yaw at the time of capture
_UNTIMELY_S: Final = 0.06  # delay of images stamped on arrival, due to encoding, network and decoding


@dataclass(frozen=True, slots=True, eq=False)
class CameraPose:
    """The pose of a camera when it captured an image."""

    position: Array  #: position in odometry axes, (3,) [m]; the third value is the height above the ground, if known
    rotation: Array  #: rotation from optical axes to odometry axes, (3, 3)
    intrinsics: Intrinsics
    size: tuple[int, int]  #: width and height of the image [px]
    yaw_rad: float = _YAW_RAD  #: standard deviation of the yaw at the time of capture
    tilt_rad: float = _TILT_RAD  #: standard deviation of the tilt
    #: climb integrated from the vehicle's velocity, regardless of the ground [m]; None if unknown
    rise_m: float | None = None

    @classmethod
    def at(
        cls,
        mounting: CameraInfo,
        feedback: Feedback,
        body: Array,
        intrinsics: Intrinsics,
        size: tuple[int, int],
        rates_rad_s: tuple[float, float] = (0.0, 0.0),
        risen_m: float | None = None,
    ) -> CameraPose | None:
        """Determine a camera's pose; None if the attitude is unknown.

        ``body`` is the vehicle's position, (3,) [m]; its third value is the height above the ground, if known. If
        images and attitude have no common clock, the rates of yaw and tilt determine the attitude's uncertainty at
        capture. ``risen_m`` is the climb integrated from the vehicle's velocity; None if unknown.
        """
        if feedback.roll_rad is None or feedback.pitch_rad is None or feedback.yaw_rad is None:
            return None
        to_level = feedback.rotation
        yaw_rad = math.hypot(_YAW_RAD, _UNTIMELY_S * rates_rad_s[0])
        tilt_rad = math.hypot(_TILT_RAD, _UNTIMELY_S * rates_rad_s[1])
        offset = np.zeros(3) if mounting.position_m is None else np.asarray(mounting.position_m)
        aside, rotation = to_level @ offset, to_level @ mounting_rotation(mounting)
        rise_m = None if risen_m is None else risen_m + float(aside[2])
        return cls(body + aside, rotation, intrinsics, size, yaw_rad, tilt_rad, rise_m)

    def pixel(self, point: Array) -> tuple[float, float] | None:
        """Return the image coordinates [px] of a point (3,) in or slightly outside the image; None if further out.

        A lens model is only valid within the image: far outside, the distortion polynomial folds points back into it.
        """
        ray = self.rotation.T @ (point - self.position)
        lens, (columns, rows) = self.intrinsics, self.size
        beside = np.abs(ray[:2]) > _BESIDE * ray[2] * np.array([columns / lens.fx, rows / lens.fy])
        if ray[2] <= 0.0 or beside.any():
            return None
        x, y = project(ray[None, :], self.intrinsics)[0].tolist()
        return (x, y) if math.isfinite(x) and math.isfinite(y) else None

    def shows(self, point: Array) -> bool:
        """Return whether a point (3,) lies within the image; it may still be hidden by something."""
        pixel = self.pixel(point)
        return pixel is not None and 0.0 <= pixel[0] < self.size[0] and 0.0 <= pixel[1] < self.size[1]


@dataclass(frozen=True, slots=True, eq=False)
class BoxView:
    """The directions of the centre and edges of a box."""

    azimuth: float  #: azimuth of the centre, counter-clockwise from the odometry's x axis [rad]
    bottom: float | None  #: tangent of the lower edge's elevation; None if outside the image
    top: float | None  #: tangent of the upper edge's elevation; None if outside the image
    azimuth_rad: float  #: standard deviation of the azimuth
    edge: float  #: standard deviation of each edge's slope, independent of the other edge
    #: upper bound for the tangent of the lower edge's elevation if the edge is outside the image; otherwise None
    below: float | None = None
    #: lower bound for the tangent of the upper edge's elevation if the edge is outside the image; otherwise None
    above: float | None = None
    tilt: float = _TILT_RAD  #: standard deviation common to both edges

    @classmethod
    def of(cls, box: Sequence[float], camera: CameraPose, noise: float = 0.04) -> BoxView | None:
        """Compute the directions for a box (x, y, width, height [px]); None if it is almost straight above or below.

        ``noise`` is the standard deviation of an edge as a fraction of the box's height; one pixel is added. The result
        is also None for boxes that this camera can't see.
        """
        x, y, width, height = box
        columns, rows = camera.size
        middle = x + (width - 1) / 2
        edges = [(middle, y), (middle, y + height - 1), (middle, y + (height - 1) / 2)]
        rays = unproject(edges, camera.intrinsics) @ camera.rotation.T
        flat = np.hypot(rays[:, 0], rays[:, 1])
        if not (np.isfinite(rays).all() and (flat > _STEEPEST).all()):
            return None
        top, bottom, _ = (rays[:, 2] / flat).tolist()
        focal = math.sqrt(camera.intrinsics.fx * camera.intrinsics.fy)
        edge = (1.0 + noise * height) / focal
        across = (1.0 + noise * width) / focal
        near = max(_CUT_PX, _CUT * height)
        if x < near or x + width > columns - near:
            across += 0.3 * width / focal  # the centre of the visible part is not the object's centre
        cut_below, cut_above = y + height > rows - near, y < near
        return cls(
            azimuth=math.atan2(rays[2, 1], rays[2, 0]),
            bottom=None if cut_below else bottom,
            top=None if cut_above else top,
            azimuth_rad=math.hypot(across, camera.yaw_rad),
            edge=edge,
            below=bottom if cut_below else None,
            above=top if cut_above else None,
            tilt=camera.tilt_rad,
        )


def predicted_box(camera: CameraPose, foot: Array, height_m: float, share: float = 0.4) -> Box | None:
    """Return an upright object's approximate box [px], given its aspect ratio; None if it is not fully in view."""
    low, high = camera.pixel(foot), camera.pixel(foot + np.array([0.0, 0.0, height_m]))
    if low is None or high is None or low[1] - high[1] < 1.0:
        return None
    height = low[1] - high[1] + 1.0
    width = share * height
    return (low[0] + high[0]) / 2 - (width - 1.0) / 2, high[1], width, height


_NEAREST_M: Final = 0.3  # minimum range
_RECKONING_M2_S3: Final = 0.5  # noise intensity of dead reckoning, from gusts and an inaccurate drag constant
_LATE_S: Final = 0.5  # maximum age of a useful box
_ADAPTING: Final = 0.3  # weight of a single box in the average surprise
_USUAL: Final = 1.5  # maximum surprise that is still attributed to noise
_MOST_SURPRISE: Final = 4.0  # maximum contribution of a single box to the average surprise
_STRAIGHT_S: Final = 4.0  # maximum time over which an unseen target is assumed to move in a straight line
_GONE_S: Final = 0.2  # minimum time out of view before a target counts as hidden ...
_GONE_INTERVALS: Final = 2.5  # ... and the minimum time in intervals between boxes
_BEFORE_S: Final = 0.2  # time before a loss at which boxes are assumed to be unoccluded
_GATE: Final = 4.0  # maximum azimuth error in standard deviations
_EDGE_GATE: Final = 3.0  # maximum edge error in standard deviations; beyond it, the edge is hidden or not the target's
_OUTGROWN: Final = 3.0  # error of both edges, in standard deviations, above which a box is too large
_PACE_PER_S: Final = 0.2  # standard deviation of the velocity per metre of the guessed range
LEAST_SLOPE: Final = 0.04  # minimum slope at which an edge's height reveals the range
SURE_OF_SIZE: Final = 0.4  # standard deviation of the log height at which the size counts as unknown


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


@dataclass(frozen=True, slots=True)
class Traits:
    """Prior knowledge about a kind of target."""

    height_m: float | None = None
    height_share: float = 0.1  #: standard deviation of the height, as a fraction of the height
    radius_m: float = 0.0  #: distance from the target's centre to its visible lower edge
    #: intensity of the random acceleration; its square root is the typical velocity change in one second
    intensity_m2_s3: float = 1.0
    #: Whether the target is on the ground. If None, targets with a class are assumed to be on the ground; for others
    #: this is one of several hypotheses (:mod:`.target_range`).
    on_ground: bool | None = None

    def __post_init__(self) -> None:
        if self.height_m is not None and not (_is_number(self.height_m) and 0.01 <= self.height_m <= 100.0):
            raise UsageError(f"height_m is {self.height_m!r} and must be from 0.01 to 100 m, or None")
        for name in ("height_share", "radius_m", "intensity_m2_s3"):
            value = getattr(self, name)
            if not (_is_number(value) and 0.0 <= value < math.inf):
                raise UsageError(f"{name} is {value!r} and must be a finite number, 0 or more")


#: Traits by class name, with the typical spread of heights. Buses and cars are separate classes.
TRAITS: Final = {
    "person": Traits(height_m=1.74, height_share=0.06, radius_m=0.25, intensity_m2_s3=0.6),
    "car": Traits(height_m=1.45, height_share=0.2, radius_m=1.2, intensity_m2_s3=3.0),
    "truck": Traits(height_m=2.8, height_share=0.4, radius_m=1.5, intensity_m2_s3=4.0),
    "bus": Traits(height_m=3.0, height_share=0.2, radius_m=1.5, intensity_m2_s3=4.0),
    "bicycle": Traits(height_m=1.5, height_share=0.3, radius_m=0.4, intensity_m2_s3=1.5),
    "dog": Traits(height_m=0.55, height_share=0.4, radius_m=0.2, intensity_m2_s3=2.0),
    "box": Traits(radius_m=0.3, intensity_m2_s3=0.05),
}
UNKNOWN: Final = Traits(radius_m=0.1)  #: traits of targets without a class


@dataclass(frozen=True, slots=True, eq=False)
class TargetState:
    """The state of a target at a point in time."""

    at_ns: int  #: time of the state on the proxy's clock
    foot: Array  #: position of the target's foot in odometry axes, (3,) [m], with z above the ground
    velocity: Array  #: horizontal velocity, (2,) [m/s]; relative to the air if the vehicle does not report its own
    height_m: float
    place_m: float  #: standard deviation of the position: the root of the sum of the horizontal variances
    range_m: float  #: horizontal distance from the camera that last saw the target
    range_deviation_m: float  #: standard deviation of the range
    range_known: bool = True  #: whether the range is good enough for flying; False if it is only a guess
    margin_m: float = 0.0  #: extra clearance because the target may be closer; 0 for targets on the ground

    @property
    def middle(self) -> Array:
        """The target's centre, (3,) [m]."""
        return np.add(self.foot, (0.0, 0.0, self.height_m / 2))


class _Estimate(NamedTuple):
    at_ns: int
    state: Array
    covariance: Array


class TargetEstimator:
    """The filter for one target."""

    def __init__(self, traits: Traits = UNKNOWN, *, nominal_m: float = 4.0, relative: bool = False) -> None:
        """Initialise the filter; ``nominal_m`` is the initial range if there is no cue.

        With ``relative``, the vehicle's own velocity comes from dead reckoning, whose changing error adds to the
        target's motion.
        """
        self.traits = traits  #: prior knowledge about the target
        self.refused = 0  #: number of consecutive boxes that did not fit
        self.seen_ns: int | None = None  #: capture time of the last box that fit; None before :meth:`start`
        self._nominal_m, self._relative = nominal_m, relative
        self._intensity = traits.intensity_m2_s3 + (_RECKONING_M2_S3 if relative else 0.0)
        self._at_ns = 0
        self._state = np.zeros(6)  # x, y, their velocities, height of the foot, log of the target's height
        self._covariance = np.eye(6)
        self._surprise = 1.0  # recent mean of the squared Mahalanobis distance of boxes, normally about 1
        self._eye: Array = np.zeros(3)  # position of the camera that last saw the target
        self._before: deque[_Estimate] = deque()  # estimates from earlier boxes, up to _BEFORE_S old
        self._interval_s = 0.0  # time between the last two boxes

    def start(self, view: BoxView, camera: CameraPose, at_ns: int, *, ground: bool) -> None:
        """Start from a first box; ``ground`` states whether the camera's height above the ground is known."""
        traits, height = self.traits, float(camera.position[2])
        ground = ground and traits.on_ground is not False
        guesses = [(self._nominal_m, 0.5)]  # range and its relative deviation
        if ground and view.bottom is not None and view.bottom < -LEAST_SLOPE:
            share = math.hypot(view.edge / -view.bottom, 0.05 / max(0.1, height)) + view.tilt / -view.bottom
            guesses.append((height / -view.bottom + traits.radius_m, share))
        if traits.height_m is not None and view.bottom is not None and view.top is not None:
            slopes = max(1e-3, view.top - view.bottom)
            guesses.append((traits.height_m / slopes, math.hypot(traits.height_share, 1.5 * view.edge / slopes)))
        if ground and traits.height_m is not None and view.top is not None and abs(view.top) > LEAST_SLOPE:
            above = traits.height_m - height  # height of the target's top above the camera
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
        if not known:  # if the target is further away than assumed, it is also larger
            covariance[:2, 5] = covariance[5, :2] = radial / distance * along
            covariance[5, 5] += share**2
        self._begin(self._state, covariance, camera, at_ns)

    def start_at(self, distance_m: float, share: float, view: BoxView, camera: CameraPose, at_ns: int) -> None:
        """Start from a first box at a guessed range, with the target size that explains the box.

        ``share`` is the relative standard deviation of the range. The foot's position and height scale with it.
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
        """Assume that the target's speed is proportional to its range; call this right after the start.

        Without this, boxes that hardly move would favour the most distant of several guesses.
        """
        pace = _PACE_PER_S * distance_m
        self._intensity += self.traits.intensity_m2_s3 * (pace**2 - 1.0)
        self._covariance[2:4, 2:4] = np.eye(2) * pace**2

    def _begin(self, state: Array, covariance: Array, camera: CameraPose, at_ns: int) -> None:
        self._state, self._covariance = state, covariance
        self._at_ns = self.seen_ns = at_ns
        self._eye = camera.position
        self.refused, self._surprise = 0, 1.0
        self._before.clear()
        self._remember(at_ns)

    def distance(self, view: BoxView, camera: CameraPose, at_ns: int) -> tuple[float, float]:
        """Measure how badly a box fits.

        Return the squared Mahalanobis distance divided by the number of measurements (about 1 for the target's own
        boxes), and the box's doubled negative log-likelihood, up to a constant shared by all filters. Both are infinite
        if the box extends too far both upwards and downwards, because occlusion can only make boxes smaller.
        """
        state, covariance = self._predict(at_ns)
        off, jacobian, noise = _innovation(view, camera, state, self.traits.radius_m)
        spread = jacobian @ covariance @ jacobian.T + noise
        share = off / np.sqrt(np.diag(spread))
        if len(share) == 3 and -share[1] > _OUTGROWN and share[2] > _OUTGROWN:
            return math.inf, math.inf
        squared = float(off @ np.linalg.solve(spread, off))
        return squared / len(off), squared + float(np.linalg.slogdet(spread)[1] - np.linalg.slogdet(noise)[1])

    def update(self, view: BoxView, camera: CameraPose, at_ns: int) -> bool:
        """Update with a box and return whether it was used; ignore boxes over half a second older than the newest.

        Edges far from where they are expected count as hidden and are ignored. Boxes in other directions are refused.
        """
        if self.seen_ns is None:
            raise UsageError("no target yet: call start() with its first box")
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
        """Predict the target's state; motion continues for at most four seconds, but the uncertainty keeps growing.

        For a hidden target, the motion shortly before the loss is used, because the occluder cut off the latest boxes.
        """
        if self.seen_ns is None:
            raise UsageError("no target yet: call start() with its first box")
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
        """Return a new filter for the same target, to be started once the target is back in view."""
        return TargetEstimator(self.traits, nominal_m=self.at(at_ns).range_m, relative=self._relative)

    def _predict(self, at_ns: int) -> tuple[Array, Array]:
        """Return the predicted state and covariance for a given time.

        For times shortly before the newest box (detections from other processes arrive late), the state is moved back
        and the covariance stays the same.
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
        # The boxes of a turning target keep deviating from the prediction, so assume a higher acceleration.
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


def _innovation(view: BoxView, camera: CameraPose, state: Array, radius_m: float) -> tuple[Array, Array, Array]:
    """Return measured minus expected values (azimuth first), their Jacobian for the state, and the noise covariance."""
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
            slope = bound  # if further away, the edge would be visible: the target is at least this close
        if slope is None:
            continue
        rows.append(slope - expected)
        jacobian.append([-expected / away * ux, -expected / away * uy, 0.0, 0.0, 1.0 / away, by_height / away])
        deviations.append(view.edge)
    noise = np.diag(np.square(deviations))
    noise[1:, 1:] += view.tilt**2
    return np.array(rows), np.array(jacobian), noise
