"""Detection of ArUco and AprilTag markers, and their poses.

Detection is OpenCV's ``ArucoDetector`` (Garrido-Jurado et al., "Automatic generation and detection of highly reliable
fiducial markers under occlusion", Pattern Recognition 47(6), 2014); the pose is IPPE for squares (Collins and Bartoli,
"Infinitesimal Plane-Based Pose Estimation", IJCV 109, 2014).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from skyloop.errors import UsageError
from skyloop.messages import Intrinsics
from skyloop.vision.lens import normalised
from skyloop.vision.opencv import marker_dictionary, opencv
from skyloop.vision.planar import Array, PlanarPose, PlanarSighting, checked, rectangle


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class MarkerSighting(PlanarSighting):
    """One marker in one image; its top left is that of the printed marker."""

    id: int


class MarkerDetector:
    """Detects markers of one dictionary and one size. Holds OpenCV's scratch memory: use one detector per thread.

    Attributes:
        dictionary: As it was given.
        size_m: Edge of the black square.
    """

    def __init__(self, dictionary: str = "4x4_50", size_m: float = 0.3) -> None:
        """Prepare the detector.

        Args:
            dictionary: OpenCV's name of it, with or without ``DICT_``.
            size_m: Edge of the black square.

        Raises:
            UsageError: The size is not a finite number above 0.
            UnknownNameError: OpenCV has no such dictionary.
            MissingExtraError: OpenCV is not installed.
        """
        if not (isinstance(size_m, (int, float)) and math.isfinite(size_m) and size_m > 0):
            raise UsageError(f"size_m is {size_m!r} and must be the marker's edge in metres, above 0")
        self.dictionary = dictionary
        self.size_m = float(size_m)
        self._cv = opencv("marker detection")
        self._detector = _make_detector(self._cv, dictionary)
        # The order and axes that SOLVEPNP_IPPE_SQUARE asks for: x right, y up, z out of the face.
        self._square = rectangle(self.size_m, self.size_m)

    def detect(self, image: NDArray[np.uint8], intrinsics: Intrinsics | None = None) -> list[MarkerSighting]:
        """Detect all markers in an image.

        Args:
            image: A :class:`skyloop.Frame` or a uint8 array, (h, w, 3) BGR or (h, w) grey.
            intrinsics: Of the camera; None takes the frame's.

        Returns:
            The sightings, in the order of their ids.

        Raises:
            UsageError: The array has another shape or type, or there are no intrinsics.
        """
        pixels, intrinsics = checked(image, intrinsics)
        grey = self._cv.cvtColor(pixels, self._cv.COLOR_BGR2GRAY) if pixels.ndim == 3 else pixels
        quads, ids, _ = self._detector.detectMarkers(grey)
        if ids is None:
            return []
        found = [
            self._sighting(int(number), np.asarray(quad, dtype=np.float64).reshape(4, 2), intrinsics)
            for number, quad in zip(np.ravel(ids), quads, strict=True)
        ]
        return sorted((one for one in found if one is not None), key=lambda one: one.id)

    def _sighting(self, number: int, corners: Array, intrinsics: Intrinsics) -> MarkerSighting | None:
        """Return the marker's pose; None if no square in front of the camera explains the corners."""
        rays = normalised(corners, intrinsics)
        if not np.isfinite(rays).all():
            return None
        pose = PlanarPose.of(self._cv, self._square, rays, self._cv.SOLVEPNP_IPPE_SQUARE)
        if pose is None:
            return None
        return MarkerSighting(
            id=number, corners=corners, position_m=pose.position, rotation=pose.rotation, ambiguity=pose.ambiguity
        )


def _make_detector(cv: Any, dictionary: str) -> Any:
    markers = marker_dictionary(cv, dictionary)
    parameters = cv.aruco.DetectorParameters()
    # Corners to a fraction of a pixel: the range of a marker is only as good as its edges.
    parameters.cornerRefinementMethod = cv.aruco.CORNER_REFINE_SUBPIX
    # Half a cell each way: at OpenCV's 0.3 corners are 0.46 px off (median over 150 noisy poses), at this 0.31 px.
    parameters.relativeCornerRefinmentWinSize = 0.5
    # The edge of the white card is a square of its own near the marker's; at OpenCV's 0.125 it can hide the marker.
    parameters.minMarkerDistanceRate = 0.05
    return cv.aruco.ArucoDetector(markers, parameters)
