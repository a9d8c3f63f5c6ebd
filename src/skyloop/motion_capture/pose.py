"""Poses from a motion capture system: conversion to Skyloop's axes, tracking over time and calibration. Pure.

The calibration is the rotation between a tracked body's axes, as defined by the system, and those of the drone. The
procedure is the same as in MAVwork: the drone rests for two seconds, the poses are averaged, and the calibration is
refused if they vary too much. The drone's own roll and pitch determine its attitude at rest. Its nose must point along
the world's x axis unless ``heading`` is given.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from skyloop.clock import NS_PER_S, nanoseconds
from skyloop.errors import MissingExtraError, UsageError
from skyloop.messages.geometry import quaternion_from_euler

if TYPE_CHECKING:
    from scipy.spatial.transform import RigidTransform, Rotation


Vector = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]


@dataclass(frozen=True, slots=True)
class BodyPose:
    """The pose of a body.

    World axes are those of the capture volume, with z up. Body axes are defined by the system or, after a calibration,
    are those of the drone: x forward, y left, z up (ROS REP 103).
    """

    body: str
    captured_ns: int  #: capture time on this host's monotonic clock
    position_m: Vector  #: position [m]
    quaternion: Quaternion  #: rotation from body to world axes: x, y, z, w
    velocity_m_s: Vector | None = None  #: velocity in world axes [m/s]; None before there are enough poses

    @property
    def yaw_rad(self) -> float:
        """Heading [rad] of the body's x axis relative to the world's x axis, counter-clockwise as seen from above."""
        x, y, z, w = self.quaternion
        return math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))

    @property
    def rotation(self) -> Rotation:
        """Rotation from body axes to world axes.

        Raises:
            MissingExtraError: SciPy is not installed or too old.
        """
        found: Rotation = scipy_types().Rotation.from_quat(self.quaternion)
        return found

    @property
    def transform(self) -> RigidTransform:
        """Pose of the body in world axes.

        Raises:
            MissingExtraError: SciPy is not installed or too old.
        """
        found: RigidTransform = scipy_types().RigidTransform.from_components(self.position_m, self.rotation)
        return found


def multiply(a: Quaternion, b: Quaternion) -> Quaternion:
    """Return the Hamilton product of two quaternions (x, y, z, w): a rotation by ``b``, then by ``a``."""
    ax, ay, az, aw = a
    bx, by, bz, bw = b
    return (
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
        aw * bw - ax * bx - ay * by - az * bz,
    )


def z_up(position: Vector, quaternion: Quaternion) -> tuple[Vector, Quaternion]:
    """Convert from axes with y up (x right, y up, z backward, Motive's default for streaming) to axes with z up.

    World and body axes are both rotated by a quarter turn about x, so an upright body stays upright. Quaternions are x,
    y, z, w.
    """
    x, y, z = position
    qx, qy, qz, qw = quaternion
    return (x, -z, y), (qx, -qz, qy, qw)


def plausible(position: Vector, quaternion: Quaternion) -> bool:
    """Return whether the values form a valid pose: they are finite, and the quaternion's norm is within 1 % of 1."""
    if not all(map(math.isfinite, (*position, *quaternion))):
        return False
    return abs(math.sqrt(sum(part * part for part in quaternion)) - 1.0) < 0.01


def scipy_types() -> Any:
    """Import the rotation and transform types of SciPy 1.16 or newer."""
    try:
        from scipy.spatial import transform

        transform.RigidTransform  # noqa: B018  SciPy 1.16 and newer
    except (ImportError, AttributeError):
        raise MissingExtraError("a pose as SciPy's Rotation and RigidTransform", "control") from None
    return transform


REST_S: Final = 2.0  #: time for collecting poses for a calibration
MAX_SPREAD_M: Final = 0.005  #: maximum spread of positions at rest; more indicates motion or poor tracking
MAX_SPREAD_RAD: Final = math.radians(1.0)  #: maximum spread of rotations at rest
MIN_POSES: Final = 20  #: minimum number of poses for a calibration


@dataclass(frozen=True, slots=True)
class Calibration:
    """Converts poses of a tracked body to poses of the drone."""

    turn: Quaternion = (0.0, 0.0, 0.0, 1.0)  #: rotation from the drone's axes to the tracked body's; x, y, z, w
    spread_m: float = 0.0  #: root mean square distance of the poses from their mean
    spread_rad: float = 0.0  #: root mean square angle between the poses and their mean
    poses: int = 0  #: number of poses that were averaged
    yaw_offset: float | None = None  #: reported yaw minus heading in world axes [rad]; None without a reported yaw

    def apply(self, pose: BodyPose) -> BodyPose:
        """Convert a pose of the tracked body to a pose of the drone."""
        return replace(pose, quaternion=multiply(pose.quaternion, self.turn))


def calibrate(
    poses: Sequence[BodyPose],
    *,
    roll: float = 0.0,
    pitch: float = 0.0,
    yaw: float | None = None,
    heading: float = 0.0,
    max_spread_m: float = MAX_SPREAD_M,
    max_spread_rad: float = MAX_SPREAD_RAD,
) -> Calibration:
    """Compute the calibration from poses at rest.

    Args:
        poses: At least 20 poses.
        roll: The drone's reported roll [rad]; right side down is positive.
        pitch: The drone's reported pitch [rad]; nose down is positive.
        yaw: The drone's reported yaw [rad]; None if it doesn't report one.
        heading: Heading of the drone's nose in world axes [rad], counter-clockwise from x.
        max_spread_m: Maximum root mean square distance of the poses from their mean.
        max_spread_rad: Maximum root mean square angle between the poses and their mean.

    Raises:
        UsageError: There are too few poses, or they vary beyond the limits because the drone moved or the tracking is
            poor.
    """
    if len(poses) < MIN_POSES:
        raise UsageError(f"a calibration needs at least {MIN_POSES} poses, got {len(poses)}: is the body tracked?")
    mean = mean_quaternion([pose.quaternion for pose in poses])
    spread_m = _spread(np.array([pose.position_m for pose in poses]))
    angles = [_angle(mean, pose.quaternion) for pose in poses]
    spread_rad = math.sqrt(sum(angle * angle for angle in angles) / len(angles))
    if spread_m > max_spread_m or spread_rad > max_spread_rad:
        raise UsageError(
            f"the poses spread by {spread_m * 1e3:.1f} mm and {math.degrees(spread_rad):.2f}°, but at most "
            f"{max_spread_m * 1e3:.1f} mm and {math.degrees(max_spread_rad):.2f}° are allowed: keep the drone still"
        )
    stands = quaternion_from_euler(roll, pitch, heading)
    offset = None if yaw is None else math.remainder(yaw - heading, math.tau)
    return Calibration(multiply(conjugate(mean), stands), spread_m, spread_rad, len(poses), offset)


def conjugate(quaternion: Quaternion) -> Quaternion:
    """Return the inverse rotation of a unit quaternion."""
    x, y, z, w = quaternion
    return -x, -y, -z, w


def mean_quaternion(quaternions: Sequence[Quaternion]) -> Quaternion:
    """Return the mean rotation, irrespective of the quaternions' signs.

    It is the dominant eigenvector of the sum of their outer products (Markley et al., "Averaging Quaternions", 2007).
    """
    parts = np.array(quaternions)
    _, vectors = np.linalg.eigh(parts.T @ parts)
    x, y, z, w = vectors[:, -1].tolist()
    return x, y, z, w


def _angle(a: Quaternion, b: Quaternion) -> float:
    along = abs(sum(one * other for one, other in zip(a, b, strict=True)))
    return 2.0 * math.acos(min(1.0, along))


def _spread(places: NDArray[np.float64]) -> float:
    return float(np.sqrt(((places - places.mean(axis=0)) ** 2).sum(axis=1).mean()))


LOST_AFTER_S: Final = 0.2  #: time without poses after which a body counts as lost (ten poses at 50 Hz)
FROZEN_AFTER_S: Final = 0.5  #: time after which a bit-identical pose no longer counts as a measurement
WINDOW_S: Final = 0.1  #: time window for computing the velocity from poses
LEAST_POSES: Final = 4  #: minimum number of poses for computing a velocity


class TrackState(StrEnum):
    """Whether a body's pose is reliable."""

    WAITING = "waiting"  #: the body has not been seen yet
    TRACKED = "tracked"
    LOST = "lost"  #: the body was seen before, but there are no new poses
    ENDED = "ended"  #: the motion capture has been closed


class Track:
    """Poses of a body over time.

    The velocity is the slope of a straight line fitted to the positions of the last :data:`WINDOW_S` by least squares.
    It lags by half the window but has much less noise than the difference between two poses.
    """

    def __init__(self, body: str, *, may_freeze: bool = False) -> None:
        """Initialise a body that has not been seen; ``may_freeze`` is for simulators without noise."""
        self.body = body
        self.state = TrackState.WAITING
        self.pose: BodyPose | None = None  #: the newest pose while the body is tracked, otherwise None
        self._may_freeze = may_freeze
        self._recent: deque[tuple[int, Vector]] = deque()
        self._seen_ns = 0
        self._moved_ns = 0
        self._last: tuple[Vector, Quaternion] | None = None

    def add(self, captured_ns: int, position: Vector, quaternion: Quaternion) -> BodyPose | None:
        """Update with a pose [m; x, y, z, w]; return it with its velocity, or None if it is frozen or not new."""
        if captured_ns <= self._seen_ns:
            return None
        self._seen_ns = captured_ns
        if (position, quaternion) != self._last:
            self._last, self._moved_ns = (position, quaternion), captured_ns
        elif not self._may_freeze and captured_ns - self._moved_ns >= nanoseconds(FROZEN_AFTER_S):
            return None
        if self.state is not TrackState.TRACKED:
            self._recent.clear()
        self.state = TrackState.TRACKED
        self._recent.append((captured_ns, position))
        while captured_ns - self._recent[0][0] > nanoseconds(WINDOW_S):
            self._recent.popleft()
        self.pose = BodyPose(self.body, captured_ns, position, quaternion, velocity_m_s=self._velocity())
        return self.pose

    def update(self, now_ns: int) -> bool:
        """Update the state for a given time [ns]; return whether the body has just been lost."""
        if self.pose is None or now_ns - self.pose.captured_ns < nanoseconds(LOST_AFTER_S):
            return False
        self.state, self.pose = TrackState.LOST, None
        return True

    def end(self) -> None:
        """End the track because no more poses will arrive."""
        self.state, self.pose = TrackState.ENDED, None

    def _velocity(self) -> Vector | None:
        if len(self._recent) < LEAST_POSES:
            return None
        times = np.array([at_ns - self._recent[-1][0] for at_ns, _ in self._recent]) / NS_PER_S
        times -= times.mean()
        places = np.array([place for _, place in self._recent])
        x, y, z = (times @ places / (times @ times)).tolist()
        return x, y, z
