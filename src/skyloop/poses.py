"""Compute poses of the body, its cameras and targets, as SciPy's ``RigidTransform``. Requires the extra ``control``.

``a_in_b`` is the pose of ``a`` in the axes of ``b``; it converts a point from ``a``'s axes to ``b``'s axes. ``*``
chains poses, and ``inv()`` inverts them. World axes are x east, y north, z up; body axes are x forward, y left, z up
(ROS REP 103); a camera's optical axes are x right, y down, z forward. Metres.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from skyloop.errors import MissingExtraError, UsageError
from skyloop.messages import CameraInfo, Feedback
from skyloop.messages.feedback import NO_POSITION, POSITION_SOURCES

if TYPE_CHECKING:
    from scipy.spatial.transform import RigidTransform, Rotation


def transform(position: ArrayLike, rotation: ArrayLike) -> RigidTransform:
    """Create a pose from a position (3,) and a rotation matrix, (3, 3) or (9,) row by row.

    Raises :class:`UsageError` if a value is not finite or the matrix is not a rotation.
    """
    place = np.asarray(position, dtype=np.float64)
    turn = np.asarray(rotation, dtype=np.float64)
    if place.shape != (3,) or turn.size != 9:
        raise UsageError(f"a position needs 3 numbers and a rotation 3×3, got {place.shape} and {turn.shape}")
    turn = turn.reshape(3, 3)
    if not (np.isfinite(place).all() and np.isfinite(turn).all()):
        raise UsageError("a pose must be finite")
    if not np.allclose(turn @ turn.T, np.eye(3), atol=1e-6) or np.linalg.det(turn) < 0.0:
        raise UsageError("this matrix is not a rotation: its rows must have length 1, be orthogonal and right-handed")
    transforms = _scipy()
    pose: RigidTransform = transforms.RigidTransform.from_components(place, transforms.Rotation.from_matrix(turn))
    return pose


def attitude(feedback: Feedback) -> Rotation:
    """Return the rotation from body axes to world axes. Raises :class:`UsageError` while the attitude is unknown."""
    rotation: Rotation = _scipy().Rotation.from_matrix(_rotation(feedback))
    return rotation


def body_in_world(feedback: Feedback, position: ArrayLike | None = None) -> RigidTransform:
    """Return the pose of the vehicle; ``position`` (3,) [m], if given, replaces the vehicle's own position.

    Raises :class:`UsageError` while the attitude or the position is unknown.
    """
    place = feedback.position_m if position is None else position
    if place is None:
        raise UsageError(f"{NO_POSITION}: give a known position, or {POSITION_SOURCES}")
    return transform(place, _rotation(feedback))


def camera_in_body(camera: CameraInfo) -> RigidTransform:
    """Return the pose in which a camera is mounted; an unknown position is assumed to be the body's centre.

    Raises :class:`UsageError` if its orientation is unknown.
    """
    return transform((0.0, 0.0, 0.0) if camera.position_m is None else camera.position_m, mounting_rotation(camera))


def camera_in_world(camera: CameraInfo, feedback: Feedback, position: ArrayLike | None = None) -> RigidTransform:
    """Return a camera's pose when the vehicle is in the state ``feedback`` (``frame.feedback`` for an image).

    ``position`` and the errors are the same as for :func:`body_in_world` and :func:`camera_in_body`.
    """
    return body_in_world(feedback, position) * camera_in_body(camera)


def target_in_world(
    target_in_camera: RigidTransform, camera: CameraInfo, feedback: Feedback, position: ArrayLike | None = None
) -> RigidTransform:
    """Return the pose of something that a camera sees, such as :attr:`MarkerSighting.pose`, given ``feedback``."""
    return camera_in_world(camera, feedback, position) * target_in_camera


def mounting_rotation(camera: CameraInfo) -> NDArray[np.float64]:
    """Return the rotation from a camera's optical axes to body axes, shape (3, 3). Requires no extra.

    Raises :class:`UsageError` if the camera's mounting is unknown.
    """
    if camera.rotation is None:
        raise UsageError(f"camera {camera.name!r} does not say how it is mounted: give its CameraInfo a rotation")
    return np.asarray(camera.rotation, dtype=np.float64).reshape(3, 3)


def _rotation(feedback: Feedback) -> NDArray[np.float64]:
    try:
        return feedback.rotation
    except ValueError as error:
        raise UsageError(str(error)) from None


def _scipy() -> Any:
    try:
        from scipy.spatial import transform as transforms
    except ImportError as error:
        raise MissingExtraError("a pose", "control", cause=str(error)) from error
    if not hasattr(transforms, "RigidTransform"):
        raise MissingExtraError("a pose", "control", cause="SciPy is older than 1.16")
    return transforms
