"""Detection of objects of one colour, of gates of a known size with their poses, and of upright poles.

A gate is a frame of one colour around an opening: a hole in that colour's mask with four straight sides. After the lens
distortion is removed, lines are fitted to the hole's edge (OpenCV's ``fitLine`` with Huber's weights) and intersected,
so that the corners are accurate to less than a pixel. The pose is computed by IPPE (Collins and Bartoli,
"Infinitesimal Plane-Based Pose Estimation", IJCV 109, 2014).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from skyloop.errors import UsageError
from skyloop.messages import CameraInfo, Intrinsics
from skyloop.vision.lens import Array, checked, normalised, project
from skyloop.vision.opencv import opencv
from skyloop.vision.planar import PlanarPose, PlanarSighting, rectangle

Rgb = tuple[int, int, int]

_HUE_DEG: Final = 16.0  # tolerance on either side of the colour's hue
_SATURATION: Final = 0.5  # minimum saturation as a fraction of the colour's own; covers paint in light and shade
_LEAST_SATURATION: Final = 80  # 0 to 255: less saturated colours are too grey to distinguish
_LEAST_VALUE: Final = 35  # 0 to 255: darker pixels have no reliable hue
_LEAST_AREA_PX: Final = 150.0  # minimum area; smaller openings are unreliable for the distance
_FARTHEST_M: Final = 8.0  # maximum distance; anything further away is more likely a patch of the same colour
_SIDE_SHARE: Final = 0.15  # fraction of each side left out at both ends, because corners look rounded
_FILLED: Final = 0.6  # minimum fraction of the hull; similarly coloured objects behind may reach into the hole
_OFF_PX: Final = 1.5  # maximum RMS distance between the edge and its four sides
_LEAST_HEIGHT_PX: Final = 20  # minimum height of a pole
_SLIM: Final = 3.0  # minimum ratio of a pole's height to its width
_ABOVE_PX: Final = 6  # height of the area above a pole that is searched for something hiding its top
_COLOURFUL: Final = 100  # saturation from which a pixel counts as colourful, 0 to 255
_LEAST_SHARE: Final = 0.8  # minimum fraction of a pole's rows in one piece; overlapping poles have fewer


class ColourMask:
    """Selects pixels by hue at any brightness, if their saturation is high enough."""

    def __init__(self, colour: Rgb) -> None:
        """Prepare the mask; raise UsageError if the colour is invalid or too grey to have a hue."""
        if len(colour) != 3 or not all(isinstance(part, int) and 0 <= part <= 255 for part in colour):
            raise UsageError(f"colour is {colour!r} and must be red, green and blue, each from 0 to 255")
        self._cv = opencv("finding a colour")
        hue, saturation, _ = self._cv.cvtColor(np.array([[colour[::-1]]], np.uint8), self._cv.COLOR_BGR2HSV)[0, 0]
        if saturation < _LEAST_SATURATION:
            raise UsageError(f"colour {colour!r} is too grey to distinguish from its surroundings")
        self._hue, self._saturation = int(hue), int(saturation * _SATURATION)

    def of(self, pixels: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Return the mask (h, w), uint8, of a BGR image (h, w, 3): 255 where the pixel has the colour, else 0."""
        cv = self._cv
        hsv = cv.cvtColor(cv.GaussianBlur(pixels, (3, 3), 0), cv.COLOR_BGR2HSV)
        reach = round(_HUE_DEG / 2)  # OpenCV's hue has 180 steps per turn
        turned = hsv.copy()
        turned[..., 0] = (hsv[..., 0].astype(np.int16) - self._hue + 90) % 180
        mask = cv.inRange(turned, (90 - reach, self._saturation, _LEAST_VALUE), (90 + reach, 255, 255))
        return np.asarray(cv.morphologyEx(mask, cv.MORPH_CLOSE, np.ones((3, 3), np.uint8)), np.uint8)


@dataclass(frozen=True, slots=True)
class BlobSighting:
    """One object of a given colour in one image."""

    box: tuple[float, float, float, float]  #: left, top, right, bottom [px]
    left_rad: float  #: angle of the left edge from the optical axis, positive to the left
    right_rad: float  #: angle of the right edge with the same sign convention, smaller than ``left_rad``

    @property
    def bearing_rad(self) -> float:
        """Angle of the object's centre from the optical axis, positive to the left."""
        return (self.left_rad + self.right_rad) / 2

    @property
    def width_rad(self) -> float:
        """Apparent width of the object."""
        return self.left_rad - self.right_rad

    @property
    def outline(self) -> tuple[tuple[float, float], ...]:
        """The corners of the box, for annotations."""
        left, top, right, bottom = self.box
        return (left, top), (right, top), (right, bottom), (left, bottom)


class BlobDetector:
    """Detects sufficiently large connected areas of a colour."""

    def __init__(self, colour: Rgb, least_px: int = 12) -> None:
        """Prepare the detector.

        Args:
            colour: Red, green, blue, 0 to 255.
            least_px: Ignore areas narrower or shorter than this [px].

        Raises:
            UsageError: The colour is invalid, or too grey to have a hue.
            MissingExtraError: OpenCV is not installed.
        """
        self._mask = ColourMask(colour)
        self._cv = opencv("finding a colour")
        self._least_px = least_px

    def detect(self, image: NDArray[np.uint8], intrinsics: Intrinsics | None = None) -> list[BlobSighting]:
        """Detect all objects of the colour.

        Args:
            image: A :class:`skyloop.Frame` or a uint8 array, (h, w, 3) BGR.
            intrinsics: Intrinsics of the camera; defaults to the frame's own.

        Returns:
            The sightings, the widest first.

        Raises:
            UsageError: The array has a wrong shape or type, or there are no intrinsics.
        """
        pixels, intrinsics = checked(image, intrinsics, colour=True)
        count, _, boxes, _ = self._cv.connectedComponentsWithStats(self._mask.of(pixels))
        found = []
        for x, y, width, height, _ in boxes[1:count].tolist():
            if width < self._least_px or height < self._least_px:
                continue
            middle = y + height / 2
            edges = np.array([[x, middle], [x + width - 1, middle]], np.float64)
            left, right = np.arctan(-normalised(edges, intrinsics)[:, 0]).tolist()
            found.append(BlobSighting((x, y, x + width, y + height), left, right))
        return sorted(found, key=lambda one: -one.width_rad)


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class GateSighting(PlanarSighting):
    """The opening of one gate in one image; its face is the visible side."""


class GateDetector:
    """Detects gates of one colour and one opening size in images that are upright to within about 30°.

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
            UsageError: The colour has no hue, or the size is invalid.
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
            intrinsics: Intrinsics of the camera; defaults to the frame's own.

        Returns:
            The sightings, the nearest first.

        Raises:
            UsageError: The array has a wrong shape or type, or there are no intrinsics.
        """
        pixels, intrinsics = checked(image, intrinsics, colour=True)
        found = (self._sighting(hole, intrinsics) for hole in self._holes(self._mask.of(pixels)))
        return sorted((one for one in found if one is not None), key=lambda one: one.distance_m)

    def _holes(self, mask: NDArray[np.uint8]) -> list[Array]:
        """Return the edges of the mask's holes, each (n, 2) pixels: the innermost pixels of the gate's frame."""
        contours, tree = self._cv.findContours(mask, self._cv.RETR_CCOMP, self._cv.CHAIN_APPROX_NONE)
        if tree is None:
            return []
        return [
            np.asarray(edge, np.float64).reshape(-1, 2)
            for edge, (_, _, _, parent) in zip(contours, tree[0], strict=True)
            if parent >= 0 and self._cv.contourArea(edge) >= _LEAST_AREA_PX
        ]

    def _sighting(self, edge: Array, intrinsics: Intrinsics) -> GateSighting | None:
        """Return the opening bounded by a hole's edge; None if the hole is not an opening."""
        rough = self._four_corners(edge)
        if rough is None:
            return None
        rays = self._meeting_sides(edge, rough, intrinsics)
        if rays is None:
            return None
        pose = PlanarPose.of(self._cv, self._outline, rays, self._cv.SOLVEPNP_IPPE)
        if pose is None or pose.position[2] > _FARTHEST_M or pose.rotation[1, 1] > -0.7:  # its top is over 45° from up
            return None
        corners = project(np.column_stack([rays, np.ones(len(rays))]), intrinsics)
        return GateSighting(corners=corners, position_m=pose.position, rotation=pose.rotation, ambiguity=pose.ambiguity)

    def _four_corners(self, edge: Array) -> Array | None:
        """Return rough corners, (4, 2) pixels, clockwise from the top left; None for any other shape."""
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
        """Return x/z and y/z of the sides' intersections, (4, 2); None unless all sides are straight."""
        lines = []
        for begin, end in zip(rough, np.roll(rough, -1, axis=0), strict=True):
            side = _along(edge, begin, end)
            if len(side) < 4:
                return None
            flat = normalised(side, intrinsics)
            if not np.isfinite(flat).all():
                return None
            vx, vy, x, y = np.ravel(self._cv.fitLine(flat.astype(np.float32), self._cv.DIST_HUBER, 0, 0.01, 0.001))
            normal = np.array([-vy, vx])  # points into the opening, because the corners are clockwise and y is down
            along = normalised(np.array([begin, end]), intrinsics)
            if float(normal @ np.array([-(along[1] - along[0])[1], (along[1] - along[0])[0]])) < 0:
                normal = -normal
            off = (flat - (x, y)) @ normal * intrinsics.fx
            if math.sqrt(float(np.mean(off**2))) > _OFF_PX:
                return None
            # The edge's pixels still belong to the frame, so the opening begins half a pixel further in.
            lines.append(np.array([*normal, -float(normal @ (x, y)) - 0.5 / intrinsics.fx]))
        meeting = [np.cross(before, after) for before, after in zip(lines[-1:] + lines[:-1], lines, strict=True)]
        if any(abs(point[2]) < 1e-6 for point in meeting):
            return None
        return np.array([point[:2] / point[2] for point in meeting])


def _along(edge: Array, begin: Array, end: Array) -> Array:
    """Return the edge's points along one side, excluding both ends, (n, 2)."""
    way = end - begin
    length = float(np.linalg.norm(way))
    if length < 1.0:
        return np.empty((0, 2))
    ahead = (edge - begin) @ way / length**2
    aside = np.abs((edge - begin) @ np.array([-way[1], way[0]])) / length
    near = aside < max(2.0, 0.03 * length)
    kept: Array = edge[near & (ahead > _SIDE_SHARE) & (ahead < 1.0 - _SIDE_SHARE)]
    return kept


@dataclass(frozen=True, slots=True, eq=False)
class PoleSighting:
    """One pole in one image."""

    top: Array  #: the middle of the pole's upper end, (2,) pixels
    ray: Array  #: ray through the top, in optical axes, (3,), z = 1
    width_px: float  #: width at half the pole's height

    def ray_in_body(self, camera: CameraInfo) -> Array:
        """Return the ray in body axes, (3,)."""
        turned: Array = np.asarray(camera.rotation, dtype=np.float64).reshape(3, 3) @ self.ray
        return turned


class PoleDetector:
    """Detects poles of one colour in images that are upright to within about 30°."""

    def __init__(self, colour: Rgb) -> None:
        """Prepare the detector.

        Args:
            colour: Red, green, blue, 0 to 255.

        Raises:
            UsageError: The colour is invalid, or too grey to have a hue.
            MissingExtraError: OpenCV is not installed.
        """
        self._cv = opencv("pole detection")
        self._mask = ColourMask(colour)

    def detect(self, image: NDArray[np.uint8], intrinsics: Intrinsics | None = None) -> list[PoleSighting]:
        """Detect all poles in an image.

        Args:
            image: A :class:`skyloop.Frame` or a uint8 array, (h, w, 3) BGR.
            intrinsics: Intrinsics of the camera; defaults to the frame's own.

        Returns:
            The sightings, the widest first.

        Raises:
            UsageError: The array has a wrong shape or type, or there are no intrinsics.
        """
        pixels, intrinsics = checked(image, intrinsics, colour=True)
        count, labels, boxes, _ = self._cv.connectedComponentsWithStats(self._mask.of(pixels))
        found = []
        for label, (x, y, width, height, area) in enumerate(boxes[:count].tolist()):
            if label == 0 or height < _LEAST_HEIGHT_PX or area * _SLIM > height * height:
                continue
            if x == 0 or y == 0 or x + width == pixels.shape[1]:  # the pole is cut off at the side or the top
                continue
            line = _line(labels[y : y + height, x : x + width] == label)
            if line is None:
                continue
            middle, width_px = line
            if self._hidden(pixels, x + middle, y):
                continue
            top = np.array([x + middle, y - 0.5])
            flat = normalised(top[None], intrinsics)[0]
            if np.isfinite(flat).all():
                found.append(PoleSighting(top, np.array([*flat, 1.0]), width_px))
        return sorted(found, key=lambda one: -one.width_px)

    def _hidden(self, pixels: NDArray[np.uint8], x: float, y: int) -> bool:
        """Return whether something colourful is directly above the pole: probably a gate's bar that hides its top."""
        column = min(max(round(x), 0), pixels.shape[1] - 1)
        above = pixels[max(0, y - _ABOVE_PX) : max(1, y - 1), column : column + 1]
        return bool((self._cv.cvtColor(above, self._cv.COLOR_BGR2HSV)[..., 1] > _COLOURFUL).any())


def _line(shape: NDArray[np.bool_]) -> tuple[float, float] | None:
    """Return the horizontal position of a leaning pole's top and its width; None if the pole is not in one piece."""
    rows = np.arange(len(shape))
    first, last = shape.argmax(axis=1), shape.shape[1] - 1 - shape[:, ::-1].argmax(axis=1)
    whole = shape.any(axis=1) & (shape.sum(axis=1) == last - first + 1)
    if whole.mean() < _LEAST_SHARE:
        return None
    upper = whole & (rows <= len(shape) // 2)
    if upper.sum() < 2:
        return None
    middle = float(np.polyval(np.polyfit(rows[upper], (first + last)[upper] / 2, 1), 0.0))
    return middle, float(np.median((last - first + 1)[whole]))
