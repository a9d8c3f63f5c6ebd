"""Poses of flat objects of known size, such as gates, and detection of markers (ArUco and AprilTag).

Camera axes are optical: x right, y down, z forward. A flat object's own axes are x right, y up, z out of its face.

Candidates for markers are found by OpenCV's ``ArucoDetector`` (Garrido-Jurado et al., "Automatic generation and
detection of highly reliable fiducial markers under occlusion", Pattern Recognition 47(6), 2014), and read and fitted by
:mod:`skyloop.vision.marker_fit`; poses are both solutions of IPPE for squares (Collins and Bartoli, "Infinitesimal
Plane-Based Pose Estimation", IJCV 109, 2014), refined with the corners' covariance.
"""

from __future__ import annotations

import math
from collections import Counter
from contextlib import suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, Self

import numpy as np
from numpy.typing import NDArray

from skyloop.errors import UsageError
from skyloop.messages import CameraInfo, Intrinsics
from skyloop.poses import mounting_rotation, transform
from skyloop.vision.lens import Array, checked, normalised, project
from skyloop.vision.marker_fit import Codes, QuadFinder, fit_pattern, line_quads
from skyloop.vision.marker_fit import read as read_markers
from skyloop.vision.marker_pose import PoseChoice, solutions
from skyloop.vision.opencv import marker_dictionary, opencv

if TYPE_CHECKING:
    from scipy.spatial.transform import RigidTransform


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class PlanarSighting:
    """One flat object in one image."""

    corners: Array  #: the object's top left, top right, bottom right, bottom left, (4, 2) pixels
    position_m: Array  #: centre of the object in the camera's optical axes, (3,) [m]
    rotation: Array  #: (3, 3), from the object's axes (x right, y up, z out of its face) to optical axes
    ambiguity: float  #: how well the second-best pose fits: 0 not at all, 1 as well as the best

    @property
    def normal(self) -> Array:
        """Unit vector pointing out of the object's face, in optical axes, shape (3,)."""
        return self.rotation[:, 2]

    @property
    def pose(self) -> RigidTransform:
        """Pose of the object in the camera's optical axes.

        Raises:
            MissingExtraError: SciPy is not installed.
        """
        return transform(self.position_m, self.rotation)

    @property
    def distance_m(self) -> float:
        """Distance between the camera's optical centre and the object's centre."""
        return float(np.linalg.norm(self.position_m))

    @property
    def outline(self) -> tuple[tuple[float, float], ...]:
        """The corners, for annotations."""
        return tuple((float(x), float(y)) for x, y in self.corners)

    def position_in_body(self, camera: CameraInfo) -> Array:
        """Return the object's centre in the vehicle's body axes (x forward, y left, z up), shape (3,) [m].

        Raises:
            UsageError: The camera's mounting is unknown.
        """
        offset = np.zeros(3) if camera.position_m is None else np.asarray(camera.position_m)
        return mounting_rotation(camera) @ self.position_m + offset

    def normal_in_body(self, camera: CameraInfo) -> Array:
        """Return the unit vector pointing out of the object's face in body axes, shape (3,).

        Raises:
            UsageError: The camera's mounting is unknown.
        """
        return mounting_rotation(camera) @ self.normal


@dataclass(frozen=True, slots=True, eq=False)
class PlanarPose:
    """The pose of a flat object in optical axes."""

    position: Array  #: position of the centre, (3,) [m]
    rotation: Array  #: rotation from the object's axes, (3, 3)
    ambiguity: float

    @classmethod
    def of(cls, cv: Any, outline_m: Array, rays: Array, method: int) -> Self | None:
        """Estimate the pose from the four corners; None if no pose in front of the camera fits them.

        ``outline_m`` uses the object's own axes, (4, 3); ``rays`` are x/z and y/z of each corner; ``method`` is one of
        OpenCV's IPPE variants.
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
    """Return a rectangle's corners in its own axes, (4, 3) [m], in the order of :attr:`PlanarSighting.corners`."""
    x, y = width_m / 2, height_m / 2
    return np.array([[-x, y, 0], [x, y, 0], [x, -y, 0], [-x, -y, 0]])


#: The largest dictionary of each family, which contains the smaller ones' markers with the same ids.
_FAMILIES: Final = (
    *("4x4_1000", "5x5_1000", "6x6_1000", "7x7_1000", "aruco_original"),
    *("apriltag_16h5", "apriltag_25h9", "apriltag_36h10", "apriltag_36h11", "aruco_mip_36h12"),
)
_SIZES: Final = (50, 100, 250, 1000)
_OTHERS_EVERY: Final = 8  #: images between attempts, made until a marker is found
_LINES_SIGMA_PX: Final = 0.2  #: standard deviation of corners whose pattern could not be fitted
_MOST_FITTED: Final = 8  #: markers of an image whose pattern is fitted, for some 10 ms each: the largest ones
_FEW_IMAGES: Final = 30  #: minimum number of images for a diagnosis


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class MarkerSighting(PlanarSighting):
    """One marker in one image. Its top-left corner matches that of the printed marker."""

    id: int
    error_px: float  #: root mean square distance between the corners and those of the pose
    #: Covariance of the pose, (6, 6): of ``position_m`` [m], then of a small rotation vector [rad] that is applied
    #: after ``rotation``; both along the camera's optical axes. Covers noise and blur, not a wrong lens or ``size_m``.
    covariance: Array
    #: The other pose that a square allows, and its ``error_px``; None if there is only one. Distinguishing them takes
    #: perspective, which small markers seen nearly from the front hardly show.
    other: tuple[Array, Array, float] | None  #: position (3,) [m], rotation (3, 3), error [px]


class MarkerDetector:
    """Detects markers of one dictionary and one size. A detector keeps OpenCV's working memory, so use one per thread.

    Attributes:
        dictionary: The dictionary's name, as given.
        size_m: Edge of the black square.
    """

    def __init__(self, dictionary: str = "4x4_50", size_m: float = 0.3) -> None:
        """Prepare the detector.

        Args:
            dictionary: OpenCV's name, with or without ``DICT_``.
            size_m: Edge of the black square.

        Raises:
            UsageError: The size is not a finite number greater than 0.
            UnknownNameError: OpenCV has no such dictionary.
            MissingExtraError: OpenCV is not installed.
        """
        if not (isinstance(size_m, (int, float)) and math.isfinite(size_m) and size_m > 0):
            raise UsageError(f"size_m is {size_m!r} and must be the marker's edge in metres, above 0")
        self.dictionary = dictionary
        self.size_m = float(size_m)
        self._cv = opencv("marker detection")
        self._codes = Codes(marker_dictionary(self._cv, dictionary))
        self._finder = QuadFinder(self._cv, self._codes.size + 2)
        # The order and axes that SOLVEPNP_IPPE_SQUARE expects: x right, y up, z out of the face.
        self._square = rectangle(self.size_m, self.size_m)
        self._images = self._seen = 0
        self._others: Counter[tuple[str, int]] = Counter()  # count of tags from other dictionaries, by family and id
        self._other_codes: dict[str, Codes] = {}
        self._choices: dict[int, PoseChoice] = {}
        self._steady = False  # whether the choices are made in world axes

    def why_nothing(self) -> str:
        """Explain why no marker was found.

        Until a marker is found, some images are also searched for markers from other dictionaries.

        Returns:
            An explanation; empty after only a few images, or if any image contained a marker.
        """
        if self._seen or self._images < _FEW_IMAGES:
            return ""
        nothing = f"no marker of {self.dictionary} was found in {self._images} images"
        if not self._others:
            return f"{nothing}, nor of another dictionary: is it in view, lit and printed with a white margin?"
        tags = ", ".join(f"{number} of {_smallest(family, number)}" for family, number in sorted(self._others))
        return f"{nothing}, but markers of other dictionaries were: {tags}"

    def detect(
        self,
        image: NDArray[np.uint8],
        intrinsics: Intrinsics | None = None,
        *,
        camera: CameraInfo | None = None,
    ) -> list[MarkerSighting]:
        """Detect all markers in an image.

        A square has two poses that fit nearly equally well. In a series of frames, the one that also fits the earlier
        frames is chosen; a single image gets the one that fits best.

        Args:
            image: A :class:`skyloop.Frame` or a uint8 array, (h, w, 3) BGR or (h, w) grey.
            intrinsics: Intrinsics of the camera; defaults to the frame's own.
            camera: With its mounting, the frame's attitude separates the camera's own turns from the marker's, so that
                the choice between the two poses is surer.

        Returns:
            The sightings, ordered by id.

        Raises:
            UsageError: The array has a wrong shape or type, or there are no intrinsics.
        """
        pixels, intrinsics = checked(image, intrinsics)
        grey = self._cv.cvtColor(pixels, self._cv.COLOR_BGR2GRAY) if pixels.ndim == 3 else pixels
        quads = self._finder.find(grey)
        read = self._read(grey, quads, self._codes)
        self._images += 1
        if not read:
            if not self._seen and self._images % _OTHERS_EVERY == 0:
                self._look_for_others(grey, quads)
            return []
        self._seen += 1
        at_ns, turn = getattr(image, "captured_ns", None), _camera_turn(image, camera)
        if self._steady is (turn is None):  # normals in world axes and in the camera's can't be compared
            self._steady = turn is not None
            self._choices.clear()
        turn, counts = np.eye(3) if turn is None else turn, Counter(number for number, _ in read)
        sizes = [self._cv.contourArea(corners.astype(np.float32)) for _, corners in read]
        fitted = np.argsort(sizes)[-_MOST_FITTED:]
        found: list[MarkerSighting | None] = []
        for n, (number, corners) in enumerate(read):
            if alike := counts[number] > 1:  # several markers with this id: which one was seen earlier is unknown
                self._choices.pop(number, None)
            when = None if alike else at_ns
            found.append(self._sighting(grey, number, corners, intrinsics, when, turn, fit=n in fitted))
        return sorted((one for one in found if one is not None), key=lambda one: one.id)

    def _read(self, grey: NDArray[np.uint8], quads: Array, codes: Codes) -> list[tuple[int, Array]]:
        if not len(quads):
            return []
        with np.errstate(all="ignore"):  # some quadrilaterals are so flat that they have no homography
            return read_markers(self._cv, grey, line_quads(self._cv, grey, quads, codes.size + 2), codes)

    def _look_for_others(self, grey: NDArray[np.uint8], quads: Array) -> None:
        """Search for markers of another family, choosing a different family each time."""
        known = {name for name in dir(self._cv.aruco) if name.startswith("DICT_")}
        families = [family for family in _FAMILIES if f"DICT_{family.upper()}" in known]
        family = families[self._images // _OTHERS_EVERY % len(families)]
        # Without correction, so that a square object in the room is not mistaken for a tag.
        if family not in self._other_codes:
            self._other_codes[family] = Codes(marker_dictionary(self._cv, family), corrected=0.0)
        self._others.update((family, number) for number, _ in self._read(grey, quads, self._other_codes[family]))

    def _sighting(
        self,
        grey: NDArray[np.uint8],
        number: int,
        corners: Array,
        intrinsics: Intrinsics,
        at_ns: int | None,
        turn: Array,
        *,
        fit: bool,
    ) -> MarkerSighting | None:
        """Return the marker's pose; None if no square in front of the camera fits the corners."""
        focal, centre = np.array([intrinsics.fx, intrinsics.fy]), np.array([intrinsics.cx, intrinsics.cy])

        def to_pixels(ideal: Array) -> Array:
            if intrinsics.model == "pinhole" and not any(intrinsics.distortion):
                return ideal
            return project(np.column_stack([(ideal - centre) / focal, np.ones(len(ideal))]), intrinsics)

        corners = line_quads(self._cv, grey, corners[None], self._codes.size + 2, close=True)[0]
        ideal = normalised(corners, intrinsics) * focal + centre
        if not np.isfinite(ideal).all():
            return None
        covariance = np.eye(8) * _LINES_SIGMA_PX**2
        found, pattern = None, self._codes.patterns[number]
        with suppress(np.linalg.LinAlgError):
            found = fit_pattern(self._cv, grey, ideal, pattern, to_pixels, self._finder.noise) if fit else None
        if found is not None and all(np.isfinite(each).all() for each in found):
            ideal, covariance = found
            corners = to_pixels(ideal)
        scale = np.tile(focal, 4)
        rays = (ideal - centre) / focal
        poses = solutions(self._cv, self._square, rays, covariance / np.outer(scale, scale))
        if not poses:
            return None
        best = 0
        if at_ns is not None:
            choice = self._choices.setdefault(number, PoseChoice())
            best = choice.choose([pose.cost for pose in poses], [turn @ pose.normal for pose in poses], at_ns)
        pose, *others = poses[best], *poses[:best], *poses[best + 1 :]
        errors = [one.error * intrinsics.fx for one in (pose, *others)]
        return MarkerSighting(
            id=number,
            corners=corners,
            position_m=pose.position,
            rotation=pose.rotation,
            ambiguity=min(1.0, errors[0] / max(errors[1], 1e-9)) if others else 0.0,
            error_px=errors[0],
            covariance=pose.covariance,
            other=(others[0].position, others[0].rotation, errors[1]) if others else None,
        )


def _camera_turn(image: Any, camera: CameraInfo | None) -> Array | None:
    """Return the rotation from optical to world axes when the image was taken; None while it is unknown."""
    feedback = getattr(image, "feedback", None)
    if camera is None or camera.rotation is None or feedback is None:
        return None
    try:
        return np.asarray(feedback.rotation @ mounting_rotation(camera))
    except ValueError:  # the attitude is unknown
        return None


def _smallest(family: str, number: int) -> str:
    """Return the smallest dictionary of a family that contains a marker."""
    kind, _, size = family.rpartition("_")
    return f"{kind}_{next(one for one in _SIZES if number < one)}" if size == "1000" else family
