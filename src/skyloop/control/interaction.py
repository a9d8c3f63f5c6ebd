"""Image-based visual servoing with points: interaction matrix, level camera, four degrees of freedom. Pure.

The method is that of Chaumette and Hutchinson, "Visual servo control, part I: basic approaches", IEEE Robotics &
Automation Magazine 13(4), 2006, whose equation numbers are given below. Camera axes are optical: x right, y down, z
forward. Points are the intersections of their rays with the plane at z = 1, shape (n, 2). A multirotor must tilt to
fly, which shifts even fixed points in the image. Points are therefore first converted to the image of a *virtual level
camera* that has the vehicle's yaw but not its roll and pitch (Jabbari, Oriolo and Bolandi, "An adaptive scheme for
image-based visual servoing of an underactuated UAV", Int. J. Robotics and Automation 29(1), 2014), and the twist is
restricted to motions of the levelled vehicle: forward, left, up and yaw.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from skyloop.errors import UsageError
from skyloop.messages import CameraInfo
from skyloop.messages.geometry import rotation_from_euler
from skyloop.poses import mounting_rotation

Array = NDArray[np.float64]


def interaction_matrix(points: Array, depths_m: Array) -> Array:
    """Return the interaction matrix (2n, 6) of points (n, 2), their image motion per camera twist (equation 11).

    The twist is the camera's velocity [m/s] and angular velocity [rad/s] along and about its own axes, (6,). The rows
    are x and y of each point in turn.
    """
    points, depths = np.asarray(points, np.float64), np.asarray(depths_m, np.float64)
    if points.ndim != 2 or points.shape[1] != 2 or depths.shape != (len(points),):
        raise UsageError(f"points need shape (n, 2) and depths (n,), got {points.shape} and {depths.shape}")
    if not (np.isfinite(points).all() and np.isfinite(depths).all() and (depths > 0.0).all()):
        raise UsageError("points must be finite, and depths above 0")
    x, y, z, none = points[:, 0], points[:, 1], 1.0 / depths, np.zeros(len(points))
    along_x = np.column_stack([-z, none, x * z, x * y, -(1.0 + x * x), y])
    along_y = np.column_stack([none, -z, y * z, 1.0 + y * y, -x * y, -x])
    return np.stack([along_x, along_y], axis=1).reshape(-1, 6)


def camera_twist(camera: CameraInfo) -> Array:
    """Return the matrix (6, 4) that converts the levelled vehicle's motion to the twist of a level camera.

    The columns are forward, left, up [m/s] and yaw rate [rad/s]. The camera's position in the body matters, because a
    camera mounted ahead of the centre swings when the vehicle turns.
    """
    to_camera = mounting_rotation(camera).T
    place = np.zeros(3) if camera.position_m is None else np.asarray(camera.position_m)
    up = np.array([0.0, 0.0, 1.0])
    twist = np.zeros((6, 4))
    twist[:3, :3] = to_camera
    twist[:3, 3] = to_camera @ np.cross(up, place)
    twist[3:, 3] = to_camera @ up
    return twist


def levelled(points: Array, camera: CameraInfo, roll: float, pitch: float) -> Array:
    """Return points (n, 2) as a level camera would see them; UsageError if one would not be in front of it."""
    mounting = mounting_rotation(camera)
    turn = mounting.T @ rotation_from_euler(roll, pitch, 0.0) @ mounting
    rays = np.column_stack([points, np.ones(len(points))]) @ turn.T
    if (rays[:, 2] <= 1e-3).any():
        raise UsageError("a level camera would not see these points: the vehicle is tilted too far")
    return np.asarray(rays[:, :2] / rays[:, 2:])


def servo(points: Array, wanted: Array, depths_m: Array, camera: CameraInfo, gain: float) -> Array:
    """Compute the motion that brings the level camera's points (n, 2) to their wanted positions at an exponential rate.

    The result is ``-gain · (L·T)⁺ · e`` (equation 5, with T from :func:`camera_twist`): forward, left, up [m/s] and yaw
    rate [rad/s], (4,). The gain is in 1/s.
    """
    if np.shape(points) != np.shape(wanted) or len(points) < 2:
        raise UsageError(f"servo needs two or more points, and equal shapes: {np.shape(points)}, {np.shape(wanted)}")
    jacobian = interaction_matrix(points, depths_m) @ camera_twist(camera)
    error = (np.asarray(points) - np.asarray(wanted)).reshape(-1)
    return np.asarray(-gain * (np.linalg.pinv(jacobian, rcond=1e-3) @ error))
