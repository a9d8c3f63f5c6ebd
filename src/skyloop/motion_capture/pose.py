"""Poses of bodies from a motion capture system in Skyloop's axes, and the calibration of their own. Pure.

The calibration is the rotation between a tracked body's axes, as the system defines them, and the drone's. As MAVwork
did it: the drone stands still for two seconds, the poses are averaged, and the calibration is refused when they are
spread too much. At rest the drone's own roll and pitch show how it stands; its heading is taken from the way it is put
down: nose along the world's x axis, or as given by ``heading``.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from skyloop.errors import MissingExtraError, UsageError
from skyloop.messages.geometry import quaternion_from_euler

if TYPE_CHECKING:
    from scipy.spatial.transform import RigidTransform, Rotation

Vector = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]


@dataclass(frozen=True, slots=True)
class BodyPose:
    """The pose of a body.

    World axes are those of the capture volume, with z up. Body axes are as the system defines them, or after a
    calibration those of the drone: x forward, y left, z up (ROS REP 103).
    """

    body: str
    captured_ns: int  #: on this host's monotonic clock
    position_m: Vector  #: [m]
    quaternion: Quaternion  #: x, y, z, w: turns body axes into world axes
    velocity_m_s: Vector | None = None  #: [m/s], world axes; None until there are enough poses

    @property
    def yaw_rad(self) -> float:
        """Heading [rad]: of the body's x axis, from the world's x axis, counter-clockwise seen from above."""
        x, y, z, w = self.quaternion
        return math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))

    @property
    def rotation(self) -> Rotation:
        """Rotation from body axes to world axes.

        Raises:
            MissingExtraError: SciPy is not installed, or too old.
        """
        found: Rotation = scipy_types().Rotation.from_quat(self.quaternion)
        return found

    @property
    def transform(self) -> RigidTransform:
        """The body's pose in the world.

        Raises:
            MissingExtraError: SciPy is not installed, or too old.
        """
        found: RigidTransform = scipy_types().RigidTransform.from_components(self.position_m, self.rotation)
        return found


def multiply(a: Quaternion, b: Quaternion) -> Quaternion:
    """Return the Hamilton product of quaternions (x, y, z, w): the rotation ``b``, then ``a``."""
    ax, ay, az, aw = a
    bx, by, bz, bw = b
    return (
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
        aw * bw - ax * bx - ay * by - az * bz,
    )


def z_up(position: Vector, quaternion: Quaternion) -> tuple[Vector, Quaternion]:
    """Convert from axes with y up (x right, y up, z backward, as Motive streams by default) to axes with z up.

    This is a quarter turn about x, of the world and of the body alike, so that an upright body stays upright.

    Args:
        position: [m]
        quaternion: x, y, z, w.
    """
    x, y, z = position
    qx, qy, qz, qw = quaternion
    return (x, -z, y), (qx, -qz, qy, qw)


def plausible(position: Vector, quaternion: Quaternion) -> bool:
    """Whether this can be a pose: finite, with a quaternion whose length is 1 within 1 %."""
    if not all(map(math.isfinite, (*position, *quaternion))):
        return False
    return abs(math.sqrt(sum(part * part for part in quaternion)) - 1.0) < 0.01


def matrix(quaternion: Quaternion) -> NDArray[np.float64]:
    """Return the rotation matrix of a quaternion (x, y, z, w), shape (3, 3), float64."""
    x, y, z, w = quaternion
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def scipy_types() -> Any:
    """Import SciPy's module of rotations and transforms.

    Raises:
        MissingExtraError: SciPy is not installed, or older than 1.16.
    """
    try:
        from scipy.spatial import transform

        transform.RigidTransform  # noqa: B018  SciPy 1.16 and newer
    except (ImportError, AttributeError):
        raise MissingExtraError("a pose as SciPy's Rotation and RigidTransform", "control") from None
    return transform


REST_S: Final = 2.0
MAX_SPREAD_M: Final = 0.005
MAX_SPREAD_RAD: Final = math.radians(1.0)
MIN_POSES: Final = 20


@dataclass(frozen=True, slots=True)
class Calibration:
    """Turns the poses of a tracked body into those of the drone."""

    turn: Quaternion = (0.0, 0.0, 0.0, 1.0)  #: from the drone's axes to the tracked body's; x, y, z, w
    spread_m: float = 0.0  #: root mean square distance of the poses from their mean
    spread_rad: float = 0.0  #: root mean square angle between the poses and their mean
    poses: int = 0  #: how many were averaged
    yaw_offset: float | None = None  #: the drone's own yaw minus its heading in the world [rad], if it reports its yaw

    def apply(self, pose: BodyPose) -> BodyPose:
        """Return the drone's pose for one of the tracked body."""
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
        poses: At least 20.
        roll: As the drone reports it, averaged over the same time [rad]; right side down is positive.
        pitch: As the drone reports it [rad]; nose down is positive.
        yaw: As the drone reports it [rad]; None if it does not.
        heading: Of its nose in the world [rad], counter-clockwise from x.
        max_spread_m: Greatest root mean square distance of the poses from their mean.
        max_spread_rad: Greatest root mean square angle between the poses and their mean.

    Raises:
        UsageError: There are too few poses, or they are spread more than the limits: the drone moved, or the tracking
            is poor.
    """
    if len(poses) < MIN_POSES:
        raise UsageError(
            f"{len(poses)} poses are too few for a calibration, at least {MIN_POSES}: is the body tracked?"
        )
    mean = mean_quaternion([pose.quaternion for pose in poses])
    spread_m = _spread(np.array([pose.position_m for pose in poses]))
    angles = [_angle(mean, pose.quaternion) for pose in poses]
    spread_rad = math.sqrt(sum(angle * angle for angle in angles) / len(angles))
    if spread_m > max_spread_m or spread_rad > max_spread_rad:
        raise UsageError(
            f"the poses are spread by {spread_m * 1e3:.1f} mm and {math.degrees(spread_rad):.2f}°, at most "
            f"{max_spread_m * 1e3:.1f} mm and {math.degrees(max_spread_rad):.2f}° are allowed: let it stand still"
        )
    stands = quaternion_from_euler(roll, pitch, heading)
    offset = None if yaw is None else math.remainder(yaw - heading, math.tau)
    return Calibration(multiply(conjugate(mean), stands), spread_m, spread_rad, len(poses), offset)


def conjugate(quaternion: Quaternion) -> Quaternion:
    """Return the inverse rotation of a unit quaternion."""
    x, y, z, w = quaternion
    return -x, -y, -z, w


def mean_quaternion(quaternions: Sequence[Quaternion]) -> Quaternion:
    """Return the mean rotation, whatever the signs of the quaternions.

    It is the largest eigenvector of the sum of their outer products (Markley et al., "Averaging Quaternions", 2007).
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
