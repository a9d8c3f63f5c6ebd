"""Flat things of known size in an image: what markers and gates have in common.

Camera axes are optical: x right, y down, z forward. A flat thing's own axes are x right, y up, z out of its face.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from numpy.typing import NDArray

from skyloop.errors import UsageError
from skyloop.messages import CameraInfo, Intrinsics
from skyloop.poses import mounting_rotation, transform

if TYPE_CHECKING:
    from scipy.spatial.transform import RigidTransform

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class PlanarSighting:
    """One flat thing in one image."""

    corners: Array  #: (4, 2) pixels: its own top left, top right, bottom right, bottom left
    position_m: Array  #: (3,) its centre in the camera's optical axes [m]
    rotation: Array  #: (3, 3) from its own axes (x right, y up, z out of its face) to optical axes
    ambiguity: float  #: how well the second best pose explains the corners: 0 not at all, 1 as well as the best

    @property
    def normal(self) -> Array:
        """Unit vector out of its face, optical axes, shape (3,)."""
        return self.rotation[:, 2]

    @property
    def pose(self) -> RigidTransform:
        """Its pose in the camera's optical axes.

        Raises:
            MissingExtraError: SciPy is not installed.
        """
        return transform(self.position_m, self.rotation)

    @property
    def distance_m(self) -> float:
        """Distance from the camera's optical centre to its centre."""
        return float(np.linalg.norm(self.position_m))

    @property
    def outline(self) -> tuple[tuple[float, float], ...]:
        """The corners, for annotations."""
        return tuple((float(x), float(y)) for x, y in self.corners)

    def position_in_body(self, camera: CameraInfo) -> Array:
        """Return its centre in the vehicle's body axes (x forward, y left, z up), shape (3,) [m].

        Raises:
            UsageError: The camera does not say how it is mounted.
        """
        offset = np.zeros(3) if camera.position_m is None else np.asarray(camera.position_m)
        return mounting_rotation(camera) @ self.position_m + offset

    def normal_in_body(self, camera: CameraInfo) -> Array:
        """Return the unit vector out of its face in body axes, shape (3,).

        Raises:
            UsageError: The camera does not say how it is mounted.
        """
        return mounting_rotation(camera) @ self.normal


@dataclass(frozen=True, slots=True, eq=False)
class PlanarPose:
    """The pose of a flat thing in optical axes."""

    position: Array  #: (3,) [m]
    rotation: Array  #: (3, 3)
    ambiguity: float

    @classmethod
    def of(cls, cv: Any, outline_m: Array, rays: Array, method: int) -> Self | None:
        """Estimate the pose from four corners.

        Args:
            cv: The module ``cv2``.
            outline_m: The corners in the thing's own axes, (4, 3).
            rays: x/z and y/z of each corner in the image, (4, 2).
            method: One of OpenCV's IPPE methods.

        Returns:
            The best pose; None if nothing in front of the camera explains the corners.
        """
        count, turns, places, errors = cv.solvePnPGeneric(outline_m, rays, np.eye(3), None, flags=method)
        if not count:
            return None
        position = np.asarray(places[0], dtype=np.float64).reshape(3)
        if not np.isfinite(position).all() or position[2] <= 0:
            return None
        rotation = np.asarray(cv.Rodrigues(turns[0])[0], dtype=np.float64)
        residuals = np.ravel(errors)
        ambiguity = float(residuals[0] / residuals[1]) if len(residuals) > 1 and residuals[1] > 0 else 0.0
        return cls(position, rotation, ambiguity)


def rectangle(width_m: float, height_m: float) -> Array:
    """Return the corners of a rectangle in its own axes, (4, 3) [m], in the order of :attr:`PlanarSighting.corners`."""
    x, y = width_m / 2, height_m / 2
    return np.array([[-x, y, 0], [x, y, 0], [x, -y, 0], [-x, -y, 0]])


def checked(
    image: NDArray[np.uint8], intrinsics: Intrinsics | None, *, colour: bool = False
) -> tuple[NDArray[np.uint8], Intrinsics]:
    """Check an image, and return its pixels as a plain array with its intrinsics.

    Args:
        image: A :class:`skyloop.Frame` or a uint8 array, (h, w, 3) BGR or, unless ``colour``, (h, w) grey.
        intrinsics: Of the camera; None takes the frame's.
        colour: Whether a grey image is refused.

    Raises:
        UsageError: The array has another shape or type, is empty, or there are no intrinsics.
    """
    if intrinsics is None:
        intrinsics = getattr(image, "intrinsics", None)
    if intrinsics is None:
        raise UsageError("the image has no intrinsics: give the camera's as intrinsics=Intrinsics(fx, …)")
    return pixels_of(image, colour=colour), intrinsics


def pixels_of(image: NDArray[np.uint8], *, colour: bool = False) -> NDArray[np.uint8]:
    """Check an image, and return its pixels as a plain array, the same memory.

    Args:
        image: A :class:`skyloop.Frame` or a uint8 array, (h, w, 3) BGR or, unless ``colour``, (h, w) grey.
        colour: Whether a grey image is refused.

    Raises:
        UsageError: The array has another shape or type, or is empty.
    """
    pixels = np.asarray(image)
    grey = pixels.ndim == 2 and not colour
    if pixels.dtype != np.uint8 or not (grey or (pixels.ndim == 3 and pixels.shape[2] == 3)):
        wanted = "(h, w, 3)" if colour else "(h, w, 3) or (h, w)"
        raise UsageError(f"the image has shape {pixels.shape} and type {pixels.dtype} and must be uint8, {wanted}")
    if pixels.size == 0:
        raise UsageError("the image is empty")
    return pixels
