"""Detection of gates of a known colour and size, and their poses.

A gate is a frame of one colour around an opening. Of what has that colour, a hole that is bounded by four straight
sides is an opening. The sides are fitted to the hole's edge after the lens distortion is removed (OpenCV's ``fitLine``
with Huber's weights), so that the corners, where they meet, are better than a pixel. The pose is IPPE (Collins and
Bartoli, "Infinitesimal Plane-Based Pose Estimation", IJCV 109, 2014).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from skyloop.errors import UsageError
from skyloop.messages import Intrinsics
from skyloop.vision.colour import ColourMask, Rgb
from skyloop.vision.lens import normalised, project
from skyloop.vision.opencv import opencv
from skyloop.vision.planar import Array, PlanarPose, PlanarSighting, checked, rectangle

_LEAST_AREA_PX: Final = 150.0  # smaller openings say little about the distance
_FARTHEST_M: Final = 8.0  # a farther one is more likely a patch of the same colour
_SIDE_SHARE: Final = 0.15  # of each side, at both ends, that is not fitted: the corners are round
_FILLED: Final = 0.6  # of the four-sided hull: something of the same colour behind the gate may reach into the hole
_OFF_PX: Final = 1.5  # the edge's root mean square distance from its four sides


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class GateSighting(PlanarSighting):
    """One gate's opening in one image; its face is the side that the camera sees."""


class GateDetector:
    """Detects gates of one colour whose opening has one size, in images that are upright within about 30°.

    Attributes:
        colour: Red, green, blue, 0 to 255.
        inner_size_m: Width and height of the opening.
    """

    def __init__(self, colour: Rgb, inner_size_m: tuple[float, float] = (1.2, 1.2)) -> None:
        """Prepare the detector.

        Args:
            colour: Red, green, blue, 0 to 255.
            inner_size_m: Width and height of the opening.

        Raises:
            UsageError: That is no colour with a hue, or no size.
            MissingExtraError: OpenCV is not installed.
        """
        if not (len(inner_size_m) == 2 and all(math.isfinite(side) and side > 0 for side in inner_size_m)):
            raise UsageError(f"inner_size_m is {inner_size_m!r} and must be width and height in metres, above 0")
        self.colour = colour
        self.inner_size_m = inner_size_m
        self._cv = opencv("gate detection")
        self._mask = ColourMask(colour)
        self._outline = rectangle(*inner_size_m)

    def detect(self, image: NDArray[np.uint8], intrinsics: Intrinsics | None = None) -> list[GateSighting]:
        """Detect all gates in an image.

        Args:
            image: A :class:`skyloop.Frame` or a uint8 array, (h, w, 3) BGR.
            intrinsics: Of the camera; None takes the frame's.

        Returns:
            The sightings, the nearest first.

        Raises:
            UsageError: The array has another shape or type, or there are no intrinsics.
        """
        pixels, intrinsics = checked(image, intrinsics, colour=True)
        found = (self._sighting(hole, intrinsics) for hole in self._holes(self._mask.of(pixels)))
        return sorted((one for one in found if one is not None), key=lambda one: one.distance_m)

    def _holes(self, mask: NDArray[np.uint8]) -> list[Array]:
        """Return the edges of the holes, each (n, 2) pixels: the innermost pixels of the gate's frame."""
        contours, tree = self._cv.findContours(mask, self._cv.RETR_CCOMP, self._cv.CHAIN_APPROX_NONE)
        if tree is None:
            return []
        return [
            np.asarray(edge, np.float64).reshape(-1, 2)
            for edge, (_, _, _, parent) in zip(contours, tree[0], strict=True)
            if parent >= 0 and self._cv.contourArea(edge) >= _LEAST_AREA_PX
        ]

    def _sighting(self, edge: Array, intrinsics: Intrinsics) -> GateSighting | None:
        """Return the opening that a hole's edge bounds; None if it is none."""
        rough = self._four_corners(edge)
        if rough is None:
            return None
        rays = self._meeting_sides(edge, rough, intrinsics)
        if rays is None:
            return None
        pose = PlanarPose.of(self._cv, self._outline, rays, self._cv.SOLVEPNP_IPPE)
        if pose is None or pose.position[2] > _FARTHEST_M or pose.rotation[1, 1] > -0.7:  # its up is the picture's
            return None
        corners = project(np.column_stack([rays, np.ones(len(rays))]), intrinsics)
        return GateSighting(corners=corners, position_m=pose.position, rotation=pose.rotation, ambiguity=pose.ambiguity)

    def _four_corners(self, edge: Array) -> Array | None:
        """Return rough corners, (4, 2) pixels, from the top left clockwise; None for another shape."""
        cv = self._cv
        hull = cv.convexHull(edge.astype(np.float32))
        length = cv.arcLength(hull, True)
        for share in (0.02, 0.04, 0.06, 0.08):
            quad = cv.approxPolyDP(hull, share * length, True).reshape(-1, 2)
            if len(quad) <= 4:
                break
        if len(quad) != 4 or cv.contourArea(edge.astype(np.float32)) < _FILLED * cv.contourArea(hull):
            return None
        around = quad - quad.mean(axis=0)
        clockwise = quad[np.argsort(np.arctan2(around[:, 1], around[:, 0]))]  # y is down
        first = int(np.argmin(clockwise.sum(axis=1)))
        return np.asarray(np.roll(clockwise, -first, axis=0), np.float64)

    def _meeting_sides(self, edge: Array, rough: Array, intrinsics: Intrinsics) -> Array | None:
        """Return x/z and y/z of the corners, (4, 2), where the sides' lines meet; None unless all are straight."""
        lines = []
        for begin, end in zip(rough, np.roll(rough, -1, axis=0), strict=True):
            side = _along(edge, begin, end)
            if len(side) < 4:
                return None
            flat = normalised(side, intrinsics)
            if not np.isfinite(flat).all():
                return None
            vx, vy, x, y = np.ravel(self._cv.fitLine(flat.astype(np.float32), self._cv.DIST_HUBER, 0, 0.01, 0.001))
            normal = np.array([-vy, vx])  # into the opening: the corners go clockwise, and y is down
            along = normalised(np.array([begin, end]), intrinsics)
            if float(normal @ np.array([-(along[1] - along[0])[1], (along[1] - along[0])[0]])) < 0:
                normal = -normal
            off = (flat - (x, y)) @ normal * intrinsics.fx
            if math.sqrt(float(np.mean(off**2))) > _OFF_PX:
                return None
            # The edge's pixels are the frame's last ones: the opening begins half a pixel further in.
            lines.append(np.array([*normal, -float(normal @ (x, y)) - 0.5 / intrinsics.fx]))
        meeting = [np.cross(before, after) for before, after in zip(lines[-1:] + lines[:-1], lines, strict=True)]
        if any(abs(point[2]) < 1e-6 for point in meeting):
            return None
        return np.array([point[:2] / point[2] for point in meeting])


def _along(edge: Array, begin: Array, end: Array) -> Array:
    """Return the edge's points along one side, without its ends, (n, 2)."""
    way = end - begin
    length = float(np.linalg.norm(way))
    if length < 1.0:
        return np.empty((0, 2))
    ahead = (edge - begin) @ way / length**2
    aside = np.abs((edge - begin) @ np.array([-way[1], way[0]])) / length
    near = aside < max(2.0, 0.03 * length)
    kept: Array = edge[near & (ahead > _SIDE_SHARE) & (ahead < 1.0 - _SIDE_SHARE)]
    return kept
