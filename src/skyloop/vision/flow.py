"""Visual odometry from the optical flow of the ground, for a camera that looks down.

Corners (Shi and Tomasi, "Good features to track", CVPR 1994) are tracked from frame to frame by pyramidal
Lucas-Kanade (Bouguet, "Pyramidal implementation of the Lucas Kanade feature tracker", Intel 2000), forward and back.
Each ray is levelled by the attitude and intersected with the ground at the measured height. A corner that was first
seen from a known position yields the vehicle's current position; the result is the median over all corners. The
position drifts only when corners leave the image and are replaced by new ones.
"""

from __future__ import annotations

import math
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from skyloop.messages import CameraInfo, Feedback, Intrinsics
from skyloop.poses import mounting_rotation
from skyloop.vision.lens import Array, checked, normalised
from skyloop.vision.opencv import opencv

_MOST: Final = 80  # maximum number of tracked corners
_ENOUGH: Final = 8  # minimum number of corners for a position
_REFILL: Final = 50  # minimum number of corners; if there are fewer, new ones are detected
_APART_PX: Final = 12  # minimum distance between corners
_RETURN_PX: Final = 0.7  # maximum distance between a corner and where it returns after tracking forward and back
_LOWEST_M: Final = 0.15  # minimum height; any closer to the ground, the image has no corners to track


class GroundTracker:
    """Tracks the ground in a downward camera's frames and computes the vehicle's position relative to its start."""

    def __init__(self, camera: CameraInfo) -> None:
        """Initialise the tracker.

        Args:
            camera: The camera, including its mounting.

        Raises:
            UsageError: The camera's mounting is unknown.
            MissingExtraError: OpenCV is not installed.
        """
        self._cv: Any = opencv("optical flow")
        self._mounting = mounting_rotation(camera)
        self._offset = np.zeros(3) if camera.position_m is None else np.asarray(camera.position_m, np.float64)
        self._grey: NDArray[np.uint8] | None = None
        self._corners = np.empty((0, 2), np.float32)  # pixels in the last frame
        self._ground = np.empty((0, 2))  # positions of the corners on the ground, in the same axes as ``place``
        self.place = np.zeros(2)  #: the vehicle's position at the last frame: along yaw 0 and to the left [m]

    @property
    def points(self) -> tuple[tuple[float, float], ...]:
        """The tracked corners in the last frame [px]."""
        return tuple((float(x), float(y)) for x, y in self._corners)

    def forget(self) -> None:
        """Drop all corners, so that tracking restarts at the current position with the next frame."""
        self._grey, self._corners, self._ground = None, np.empty((0, 2), np.float32), np.empty((0, 2))

    def see(
        self, image: NDArray[np.uint8], at_capture: Feedback, intrinsics: Intrinsics | None = None
    ) -> tuple[Array, int] | None:
        """Track the ground in the next frame.

        Args:
            image: A :class:`skyloop.Frame` or a uint8 array, (h, w, 3) BGR or (h, w) grey.
            at_capture: Feedback with the attitude and altitude at the time of capture.
            intrinsics: Intrinsics of the camera; defaults to the frame's own.

        Returns:
            Position (2,) [m] along yaw 0 and to its left, and the number of corners. None for the first frame, if too
            few corners were found again, if the attitude or height is unknown, or below 0.15 m; tracking then restarts
            at the last position.

        Raises:
            UsageError: The array has a wrong shape or type, or there are no intrinsics.
        """
        pixels, intrinsics = checked(image, intrinsics)
        grey = self._cv.cvtColor(pixels, self._cv.COLOR_BGR2GRAY) if pixels.ndim == 3 else pixels.copy()
        height = at_capture.altitude_m
        known = (height, at_capture.roll_rad, at_capture.pitch_rad, at_capture.yaw_rad)
        # A non-finite value would stay in the position forever.
        if height is None or height < _LOWEST_M or any(one is None or not math.isfinite(one) for one in known):
            self.forget()
            return None
        if self._grey is not None and self._grey.shape != grey.shape:
            self.forget()  # the image size changed, so the corners are no longer there
        began = self._grey is None
        self._track(grey)
        below, good = self._below(self._corners, at_capture, intrinsics)
        self._corners, self._ground, below = self._corners[good], self._ground[good], below[good]
        count = len(below)
        found = count >= _ENOUGH
        if found:
            self.place = np.median(self._ground - below, axis=0)
            kept = np.linalg.norm(self._ground - below - self.place, axis=1) < 0.05 + 0.05 * height
            self._corners, self._ground = self._corners[kept], self._ground[kept]
        elif not began:
            self.forget()
        self._grey = grey
        if len(self._corners) < _REFILL:
            self._refill(grey, at_capture, intrinsics)
        return (self.place.copy(), count) if found else None

    def _track(self, grey: NDArray[np.uint8]) -> None:
        if self._grey is None or not len(self._corners):
            return
        cv = self._cv
        before = self._corners.reshape(-1, 1, 2)
        after, forth, _ = cv.calcOpticalFlowPyrLK(self._grey, grey, before, None, winSize=(15, 15), maxLevel=3)
        again, back, _ = cv.calcOpticalFlowPyrLK(grey, self._grey, after, None, winSize=(15, 15), maxLevel=3)
        off = np.linalg.norm((again - before).reshape(-1, 2), axis=1)
        kept = (forth.ravel() == 1) & (back.ravel() == 1) & (off < _RETURN_PX)
        self._corners, self._ground = after.reshape(-1, 2)[kept], self._ground[kept]

    def _refill(self, grey: NDArray[np.uint8], at_capture: Feedback, intrinsics: Intrinsics) -> None:
        free = np.full(grey.shape, 255, np.uint8)
        for x, y in self._corners:
            self._cv.circle(free, (round(float(x)), round(float(y))), _APART_PX, 0, -1)
        wanted = _MOST - len(self._corners)
        found = self._cv.goodFeaturesToTrack(grey, wanted, 0.01, _APART_PX, mask=free, blockSize=5)
        if found is None:
            return
        corners = found.reshape(-1, 2).astype(np.float32)
        below, good = self._below(corners, at_capture, intrinsics)
        self._corners = np.concatenate([self._corners, corners[good]])
        self._ground = np.concatenate([self._ground, below[good] + self.place])

    def _below(
        self, corners: NDArray[Any], at_capture: Feedback, intrinsics: Intrinsics
    ) -> tuple[Array, NDArray[np.bool_]]:
        """Return where the corners' rays hit the ground, relative to the vehicle, (n, 2) [m], and which rays hit it."""
        if not len(corners):
            return np.empty((0, 2)), np.empty(0, np.bool_)
        rays = normalised(np.asarray(corners, np.float64), intrinsics)
        turn = at_capture.rotation
        level = np.column_stack([rays, np.ones(len(rays))]) @ (turn @ self._mounting).T
        lever = turn @ self._offset
        good = level[:, 2] < -0.2  # rays closer to the horizon would amplify errors of the attitude
        depth = np.where(good, -((at_capture.altitude_m or 0.0) + lever[2]) / np.where(good, level[:, 2], 1.0), 0.0)
        return level[:, :2] * depth[:, None] + lever[:2], good
