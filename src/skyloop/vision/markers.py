"""ArUco and AprilTag markers: where they are in a picture, and in metres from the camera.

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

from skyloop.errors import MissingExtraError, UnknownNameError, UsageError
from skyloop.messages import CameraInfo, Intrinsics

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class MarkerSighting:
    """One marker in one picture. Camera axes are optical: x right, y down, z forward."""

    id: int
    corners: Array  #: (4, 2) pixels: the printed marker's top left, top right, bottom right, bottom left
    position: Array  #: (3,) the marker's centre in the camera's optical axes [m]
    normal: Array  #: (3,) unit vector out of the marker's face, optical axes
    ambiguity: float  #: how well the second best pose explains the corners: 0 not at all, 1 as well as the best

    @property
    def distance_m(self) -> float:
        """From the camera's optical centre to the marker's centre."""
        return float(np.linalg.norm(self.position))

    def position_in_body(self, camera: CameraInfo) -> Array:
        """The marker's centre in the vehicle's body axes (x forward, y left, z up), shape (3,) [m].

        Raises :class:`UsageError` if the camera does not say how it is mounted.
        """
        offset = np.zeros(3) if camera.position is None else np.asarray(camera.position)
        return mounting_rotation(camera) @ self.position + offset

    def normal_in_body(self, camera: CameraInfo) -> Array:
        """The unit vector out of the marker's face in body axes, shape (3,). Raises as :meth:`position_in_body`."""
        return mounting_rotation(camera) @ self.normal


def mounting_rotation(camera: CameraInfo) -> Array:
    """Rotation from the camera's optical axes to body axes, shape (3, 3).

    Raises :class:`UsageError` if the camera does not say how it is mounted.
    """
    if camera.rotation is None:
        raise UsageError(f"camera {camera.name!r} does not tell how it is mounted: give its CameraInfo a rotation")
    return np.asarray(camera.rotation, dtype=np.float64).reshape(3, 3)


class MarkerDetector:
    """Finds the markers of one dictionary and one size. Holds OpenCV's scratch memory: one detector a thread."""

    def __init__(self, dictionary: str = "4x4_50", size_m: float = 0.3) -> None:
        """``dictionary`` by OpenCV's name, with or without ``DICT_``; ``size_m`` is the edge of the black square.

        Raises :class:`UsageError` for a bad size, :class:`UnknownNameError` for a dictionary that OpenCV does not
        have, :class:`MissingExtraError` without OpenCV.
        """
        if not (isinstance(size_m, (int, float)) and math.isfinite(size_m) and size_m > 0):
            raise UsageError(f"size_m is {size_m!r} and must be the marker's edge in metres, above 0")
        self.dictionary = dictionary
        self.size_m = float(size_m)
        self._cv = _opencv()
        self._detector = _make_detector(self._cv, dictionary)
        half = self.size_m / 2
        # The order and axes that SOLVEPNP_IPPE_SQUARE asks for: x right, y up, z out of the face.
        self._square = np.array([[-half, half, 0], [half, half, 0], [half, -half, 0], [-half, -half, 0]])

    def detect(self, image: NDArray[np.uint8], intrinsics: Intrinsics | None = None) -> list[MarkerSighting]:
        """All markers in a picture, in the order of their ids.

        ``image`` is a :class:`skyloop.Frame` or any uint8 array, (h, w, 3) BGR or (h, w) grey; ``intrinsics`` are
        taken from the frame if not given. Raises :class:`UsageError` for another array, or if intrinsics are missing.
        """
        grey, intrinsics = self._checked(image, intrinsics)
        quads, ids, _ = self._detector.detectMarkers(grey)
        if ids is None:
            return []
        found = [
            self._sighting(int(number), np.asarray(quad, dtype=np.float64).reshape(4, 2), intrinsics)
            for number, quad in zip(np.ravel(ids), quads, strict=True)
        ]
        return sorted((one for one in found if one is not None), key=lambda one: one.id)

    def _checked(self, image: NDArray[np.uint8], intrinsics: Intrinsics | None) -> tuple[NDArray[np.uint8], Intrinsics]:
        if intrinsics is None:
            intrinsics = getattr(image, "intrinsics", None)
        if intrinsics is None:
            raise UsageError("the picture carries no intrinsics: give the camera's as intrinsics=Intrinsics(fx, …)")
        pixels = np.asarray(image)
        if pixels.dtype != np.uint8 or not (pixels.ndim == 2 or (pixels.ndim == 3 and pixels.shape[2] == 3)):
            raise UsageError(
                f"the picture has shape {pixels.shape} and type {pixels.dtype} and must be uint8, (h, w, 3) or (h, w)"
            )
        if pixels.size == 0:
            raise UsageError("the picture is empty")
        grey = self._cv.cvtColor(pixels, self._cv.COLOR_BGR2GRAY) if pixels.ndim == 3 else pixels
        return grey, intrinsics

    def _sighting(self, number: int, corners: Array, intrinsics: Intrinsics) -> MarkerSighting | None:
        """None for corners that no square in front of the camera explains."""
        rays = _normalised(self._cv, corners, intrinsics)
        count, turns, places, errors = self._cv.solvePnPGeneric(
            self._square, rays, np.eye(3), None, flags=self._cv.SOLVEPNP_IPPE_SQUARE
        )
        if not count:
            return None
        position = np.asarray(places[0], dtype=np.float64).reshape(3)
        if not np.isfinite(position).all() or position[2] <= 0:
            return None
        normal = self._cv.Rodrigues(turns[0])[0][:, 2]
        residuals = np.ravel(errors)
        ambiguity = float(residuals[0] / residuals[1]) if len(residuals) > 1 and residuals[1] > 0 else 0.0
        return MarkerSighting(number, corners, position, np.asarray(normal, dtype=np.float64), ambiguity)


def _opencv() -> Any:
    try:
        import cv2
    except ImportError as error:
        raise MissingExtraError("marker detection", "vision", cause=str(error)) from error
    return cv2


def _make_detector(cv: Any, dictionary: str) -> Any:
    known = {name[5:].lower(): name for name in dir(cv.aruco) if name.startswith("DICT_")}
    name = known.get(dictionary.lower().removeprefix("dict_"))
    if name is None:
        raise UnknownNameError("marker dictionary", dictionary, known)
    parameters = cv.aruco.DetectorParameters()
    # Corners to a fraction of a pixel: the range of a marker is only as good as its edges.
    parameters.cornerRefinementMethod = cv.aruco.CORNER_REFINE_SUBPIX
    # Half a cell each way: at OpenCV's 0.3 corners are 0.46 px off (median over 150 noisy poses), at this 0.31 px.
    parameters.relativeCornerRefinmentWinSize = 0.5
    # The edge of the white card is a square of its own near the marker's; at OpenCV's 0.125 it can hide the marker.
    parameters.minMarkerDistanceRate = 0.05
    return cv.aruco.ArucoDetector(cv.aruco.getPredefinedDictionary(getattr(cv.aruco, name)), parameters)


def _normalised(cv: Any, corners: Array, intrinsics: Intrinsics) -> Array:
    """Pixels to the plane at z = 1, distortion taken out; shape (4, 2)."""
    distortion = np.asarray(intrinsics.distortion, dtype=np.float64) if intrinsics.distortion else None
    points = corners.reshape(-1, 1, 2)
    if intrinsics.model == "fisheye":
        flat = cv.fisheye.undistortPoints(points, intrinsics.matrix, np.zeros(4) if distortion is None else distortion)
    elif intrinsics.model == "pinhole":
        flat = cv.undistortPoints(points, intrinsics.matrix, distortion)
    else:
        raise UsageError(f"the intrinsics' model is {intrinsics.model!r} and must be 'pinhole' or 'fisheye'")
    return np.asarray(flat, dtype=np.float64).reshape(-1, 2)
