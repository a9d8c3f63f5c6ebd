"""Directions of an object from its box in an image. Pure.

Directions are in *odometry axes* (see :mod:`.airframe`). They are levelled by the attitude at the time of capture, so
the vehicle's roll and pitch don't move an object. For an edge cut off by the image, only a bound is known.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from skyloop.messages import CameraInfo, Feedback, Intrinsics
from skyloop.poses import mounting_rotation
from skyloop.vision.lens import project, unproject
from skyloop.vision.tracking import Box

Array = NDArray[np.float64]

_CUT_PX: Final = 2.0  # distance from the image's edge within which a box may be cut off ...
_CUT: Final = 0.07
_BESIDE: Final = 0.75  # distance from the optical axis in image sizes; 0.5 is the edge
_STEEPEST: Final = 0.15  # minimum cosine of the elevation; an object almost straight above or below has no azimuth
_TILT_RAD: Final = 0.008  # error of the attitude at the time of capture, which moves both edges equally
_YAW_RAD: Final = 0.006  # error of the yaw at the time of capture
_UNTIMELY_S: Final = 0.06  # delay of images stamped on arrival, from encoding, network and decoding


@dataclass(frozen=True, slots=True, eq=False)
class Camera:
    """The pose of a camera when it captured an image."""

    position: Array  #: position in odometry axes, (3,) [m]; the third value is the height above the ground, if known
    rotation: Array  #: rotation from optical axes to odometry axes, (3, 3)
    intrinsics: Intrinsics
    size: tuple[int, int]  #: width and height of the image [px]
    yaw_rad: float = _YAW_RAD  #: standard deviation of the yaw at the time of capture
    tilt_rad: float = _TILT_RAD  #: standard deviation of the tilt
    #: climb by the vehicle's integrated velocity, regardless of the ground [m]; None if unknown
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
    ) -> Camera | None:
        """Determine a camera's pose; None if the attitude is unknown.

        The body's position is (3,) [m], the third value its height above the ground, if known. Where images and
        attitude have no common clock, the rates of yaw and tilt tell how uncertain the attitude at the time of capture
        is. ``risen_m`` is the climb by the vehicle's integrated velocity; None if unknown.
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
        """Return the pixel of a point (3,) in the image or slightly outside it [px]; None if it is further out.

        A lens model is valid only within the image: far outside, the distortion's polynomial folds back into it.
        """
        ray = self.rotation.T @ (point - self.position)
        lens, (columns, rows) = self.intrinsics, self.size
        beside = np.abs(ray[:2]) > _BESIDE * ray[2] * np.array([columns / lens.fx, rows / lens.fy])
        if ray[2] <= 0.0 or beside.any():
            return None
        x, y = project(ray[None, :], self.intrinsics)[0].tolist()
        return (x, y) if math.isfinite(x) and math.isfinite(y) else None

    def shows(self, point: Array) -> bool:
        """Return whether a point (3,) is within the image, provided that nothing hides it."""
        pixel = self.pixel(point)
        return pixel is not None and 0.0 <= pixel[0] < self.size[0] and 0.0 <= pixel[1] < self.size[1]


@dataclass(frozen=True, slots=True, eq=False)
class BoxView:
    """The directions of a box's middle and edges."""

    azimuth: float  #: azimuth of the middle, counter-clockwise from x of odometry axes [rad]
    bottom: float | None  #: tangent of the lower edge's elevation; None if the image cuts it off
    top: float | None  #: tangent of the upper edge's elevation; None if the image cuts it off
    azimuth_rad: float  #: standard deviation of the azimuth
    edge: float  #: standard deviation of each edge, independent of the other
    #: if the image cuts off the lower edge: tangent of the elevation that the edge lies below; otherwise None
    below: float | None = None
    #: if the image cuts off the upper edge: tangent of the elevation that the edge lies above; otherwise None
    above: float | None = None
    tilt: float = _TILT_RAD  #: standard deviation common to both edges

    @classmethod
    def of(cls, box: Sequence[float], camera: Camera, noise: float = 0.04) -> BoxView | None:
        """Compute the directions of a box (x, y, width, height [px]); None if it is almost straight up or down.

        ``noise`` is the standard deviation of an edge as a fraction of the box's height; one pixel is added. None also
        for a box that this camera can't show.
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
            across += 0.3 * width / focal  # the middle of the visible part is not the object's middle
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


def predicted_box(camera: Camera, foot: Array, height_m: float, share: float = 0.4) -> Box | None:
    """Return the approximate box [px] of an upright object, so much wider than high; None if not all is in view."""
    low, high = camera.pixel(foot), camera.pixel(foot + np.array([0.0, 0.0, height_m]))
    if low is None or high is None or low[1] - high[1] < 1.0:
        return None
    height = low[1] - high[1] + 1.0
    width = share * height
    return (low[0] + high[0]) / 2 - (width - 1.0) / 2, high[1], width, height
