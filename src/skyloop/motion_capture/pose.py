"""A body as a motion capture system sees it, in Skyloop's axes."""

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
    """Where a body is. World axes of the capture volume: z up; body axes as the system defines them, or after a
    calibration those of the drone: x forward, y left, z up (ROS REP 103)."""

    body: str
    captured_ns: int  #: on this host's monotonic clock
    position: Vector  #: [m]
    quaternion: Quaternion  #: x, y, z, w: turns body axes into world axes
    velocity: Vector | None = None  #: [m/s], world axes; None until there are enough poses

    @property
    def yaw(self) -> float:
        """Heading [rad]: of the body's x axis, from the world's x axis, counter-clockwise seen from above."""
        x, y, z, w = self.quaternion
        return math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))

    @property
    def rotation(self) -> Rotation:
        """Body axes to world axes. Raises :class:`MissingExtraError` without SciPy."""
        found: Rotation = scipy_types().Rotation.from_quat(self.quaternion)
        return found

    @property
    def transform(self) -> RigidTransform:
        """The pose of the body in the world."""
        found: RigidTransform = scipy_types().RigidTransform.from_components(self.position, self.rotation)
        return found


def multiply(a: Quaternion, b: Quaternion) -> Quaternion:
    """Hamilton product: first ``b``, then ``a``; x, y, z, w."""
    ax, ay, az, aw = a
    bx, by, bz, bw = b
    return (
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
        aw * bw - ax * bx - ay * by - az * bz,
    )


def z_up(position: Vector, quaternion: Quaternion) -> tuple[Vector, Quaternion]:
    """From axes with y up (x right, y up, z backward, as Motive streams by default) to such with z up: a quarter turn
    about x, of the world and of the body alike, so that a body that stands upright keeps standing."""
    x, y, z = position
    qx, qy, qz, qw = quaternion
    return (x, -z, y), (qx, -qz, qy, qw)


def plausible(position: Vector, quaternion: Quaternion) -> bool:
    """Whether this can be a pose: finite, and a quaternion of length 1 within 1 %."""
    if not all(map(math.isfinite, (*position, *quaternion))):
        return False
    return abs(math.sqrt(sum(part * part for part in quaternion)) - 1.0) < 0.01


def matrix(quaternion: Quaternion) -> NDArray[np.float64]:
    """The rotation matrix of a quaternion, shape (3, 3), float64."""
    x, y, z, w = quaternion
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def scipy_types() -> Any:
    """SciPy's module of rotations and transforms. Raises :class:`MissingExtraError` without it, or for an old one."""
    try:
        from scipy.spatial import transform

        transform.RigidTransform  # noqa: B018  SciPy 1.16 and newer
    except (ImportError, AttributeError):
        raise MissingExtraError("poses as SciPy's Rotation and RigidTransform", "control") from None
    return transform
