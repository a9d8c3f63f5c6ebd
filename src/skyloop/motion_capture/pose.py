"""Poses of bodies from a motion capture system, in Skyloop's axes."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from skyloop.errors import MissingExtraError

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
