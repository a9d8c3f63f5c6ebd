"""Cameras of simulated drones: lens and mounting, rate, latency and sensor imperfections.

Pixels follow OpenCV: x right, y down, with the centre of the top left pixel at (0, 0). Optical axes: x right, y down, z
forward. Body axes: x forward, y left, z up. A rotation "body from optical" converts optical vectors to body vectors.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from skyloop.errors import UsageError
from skyloop.messages.frame import LOOKING_DOWN, LOOKING_FORWARD, CameraInfo, Intrinsics, Rotation9

Vec3 = tuple[float, float, float]
Distortion = tuple[float, float, float, float, float]

_BLOCK: Final = 16384  #: number of points that are undistorted at a time


def looking_up(tilt_rad: float) -> Rotation9:
    """Return "body from optical" for a camera that looks forward, tilted up by an angle, with its image's top up."""
    s, c = math.sin(tilt_rad), math.cos(tilt_rad)
    return (0.0, s, c, -1.0, 0.0, 0.0, 0.0, -c, s)


def look_at(eye: NDArray[np.float64], target: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return "world from optical" (x right, y down, z forward) for a camera at one point that looks at another."""
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(forward, right), forward], axis=1)


@dataclass(frozen=True, slots=True)
class CameraPose:
    """The pose of a camera in the world."""

    position_m: NDArray[np.float64]  #: position of the optical centre, shape (3,)
    rotation: NDArray[np.float64]  #: rotation from optical to world axes, shape (3, 3)
    #: number of the drone that carries the camera and is therefore not rendered; None for a free camera
    drone: int | None = None


@dataclass(frozen=True, slots=True)
class CameraModel:
    """A camera mounted on a drone."""

    name: str
    width: int  #: width of the image [px]
    height: int  #: height of the image [px]
    fps: float
    fx: float  #: focal lengths and principal point [px]
    fy: float
    cx: float
    cy: float
    distortion: Distortion = (0.0, 0.0, 0.0, 0.0, 0.0)  #: k1, k2, p1, p2, k3 in OpenCV's order
    position_m: Vec3 = (0.0, 0.0, 0.0)  #: position of the optical centre in body axes
    rotation: Rotation9 = LOOKING_FORWARD  #: body from optical, row by row
    latency_s: float = 0.0  #: time from the middle of the exposure until the frame is delivered
    noise_sigma: float = 0.0  #: standard deviation of each pixel's channels, on the scale of 0 … 255
    exposure_s: float = 0.0  #: opening time of the shutter, which blurs the image of a turning drone
    exposure_gain: float = 1.0  #: brightness of the image relative to that of the scene
    vignetting: float = 0.0  #: fraction of the light lost in the corners, 0 … 1

    def __post_init__(self) -> None:
        if not (1 <= self.width <= 8192 and 1 <= self.height <= 8192):
            raise UsageError(f"camera {self.name!r}: {self.width}x{self.height} pixels; sides must be 1 to 8192")
        for what in ("fps", "fx", "fy", "exposure_gain", "latency_s", "noise_sigma", "exposure_s"):
            value, may_be_zero = getattr(self, what), what in ("latency_s", "noise_sigma", "exposure_s")
            if not (0.0 < value < math.inf or (may_be_zero and value == 0.0)):
                allowed = "not negative" if may_be_zero else "above 0"
                raise UsageError(f"camera {self.name!r}: {what} is {value}; it must be finite and {allowed}")
        if not 0.0 <= self.vignetting <= 1.0:
            raise UsageError(f"camera {self.name!r}: vignetting is {self.vignetting}; it must be from 0 to 1")
        if not np.isfinite([self.cx, self.cy, *self.distortion, *self.position_m]).all():
            raise UsageError(f"camera {self.name!r}: principal point, distortion and position must be finite")
        turn = self.rotation_matrix
        if not np.allclose(turn @ turn.T, np.eye(3), atol=1e-6) or np.linalg.det(turn) < 0.0:
            raise UsageError(f"camera {self.name!r}: rotation is not a rotation matrix (nine numbers, row by row)")

    @property
    def matrix(self) -> NDArray[np.float64]:
        """The camera matrix K with shape (3, 3)."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    @property
    def rotation_matrix(self) -> NDArray[np.float64]:
        """Rotation "body from optical", shape (3, 3)."""
        return np.array(self.rotation, dtype=np.float64).reshape(3, 3)

    @property
    def distorted(self) -> bool:
        """Whether the lens bends straight lines."""
        return any(k != 0.0 for k in self.distortion)

    def intrinsics(self) -> Intrinsics:
        """Return the intrinsics that accompany each frame."""
        distortion = self.distortion if self.distorted else ()
        return Intrinsics(fx=self.fx, fy=self.fy, cx=self.cx, cy=self.cy, distortion=distortion)

    def info(self) -> CameraInfo:
        """Return the camera's description, as drivers report it before the first frame."""
        return CameraInfo(
            name=self.name,
            width=self.width,
            height=self.height,
            fps=self.fps,
            intrinsics=self.intrinsics(),
            rotation=self.rotation,
            position_m=self.position_m,
        )

    def pose(
        self, body_position_m: NDArray[np.float64], body_rotation: NDArray[np.float64], drone: int | None = None
    ) -> CameraPose:
        """Return the camera's pose for its drone's position (3,) and rotation (3, 3), world from body."""
        position = np.asarray(body_position_m, dtype=np.float64) + body_rotation @ np.asarray(self.position_m)
        return CameraPose(position, body_rotation @ self.rotation_matrix, drone)

    def scaled(self, factor: float) -> CameraModel:
        """Return the same lens with a different image size: a factor of 2 turns 320×240 into 640×480."""
        if not (math.isfinite(factor) and factor > 0.0):
            raise UsageError(f"a camera can't be scaled by {factor}; the factor must be finite and above 0")
        return replace(
            self,
            width=round(self.width * factor),
            height=round(self.height * factor),
            fx=self.fx * factor,
            fy=self.fy * factor,
            cx=(self.cx + 0.5) * factor
            - 0.5,  # the image's edge, half a pixel from the first centre, stays at the edge
            cy=(self.cy + 0.5) * factor - 0.5,
        )

    def project(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Project points (n, 3) in optical axes [m], all in front of the camera (z > 0), to pixels (n, 2)."""
        points = np.asarray(points, dtype=np.float64)
        bent = distort(points[:, :2] / points[:, 2:], self.distortion)
        return bent * (self.fx, self.fy) + (self.cx, self.cy)

    def rays(self, pixels: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return x/z and y/z in optical axes for the given pixels; both arrays have shape (n, 2).

        Raises:
            UsageError: The distortion can't be inverted for one of the pixels.
        """
        bent = (np.asarray(pixels, dtype=np.float64) - (self.cx, self.cy)) / (self.fx, self.fy)
        straight = undistort(bent, self.distortion) if self.distorted else bent
        if straight is None:
            raise UsageError(f"camera {self.name!r}: distortion {self.distortion} has no inverse at some pixels")
        return straight


def distort(points: NDArray[np.float64], distortion: Distortion) -> NDArray[np.float64]:
    """Map x/z, y/z, shape (n, 2), through a lens. Source: the Brown-Conrady model as in OpenCV's ``calib3d``."""
    k1, k2, p1, p2, k3 = distortion
    x, y = points[:, 0], points[:, 1]
    r2 = x * x + y * y
    radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    bent_x = x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x)
    bent_y = y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y
    return np.column_stack([bent_x, bent_y])


def undistort(points: NDArray[np.float64], distortion: Distortion) -> NDArray[np.float64] | None:
    """Invert :func:`distort` by Newton's method; return None if there is no inverse near the optical axis."""
    straight = np.empty_like(points)
    for first in range(0, len(points), _BLOCK):  # processed in blocks so that intermediate values stay in the CPU cache
        part = slice(first, first + _BLOCK)
        if (block := _undistort(points[part], distortion)) is None:
            return None
        straight[part] = block
    return straight


def _undistort(points: NDArray[np.float64], distortion: Distortion) -> NDArray[np.float64] | None:
    k1, k2, p1, p2, k3 = distortion
    guess = points.copy()
    for _ in range(25):
        x, y = guess[:, 0], guess[:, 1]
        r2 = x * x + y * y
        radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
        slope = 2.0 * (k1 + r2 * (2.0 * k2 + 3.0 * r2 * k3))
        xx = radial + x * x * slope + 2.0 * p1 * y + 6.0 * p2 * x
        yy = radial + y * y * slope + 6.0 * p1 * y + 2.0 * p2 * x
        xy = x * y * slope + 2.0 * p1 * x + 2.0 * p2 * y
        det = xx * yy - xy * xy
        if (det <= 1e-6).any():
            return None
        error = distort(guess, distortion) - points
        guess -= (
            np.column_stack([yy * error[:, 0] - xy * error[:, 1], xx * error[:, 1] - xy * error[:, 0]]) / det[:, None]
        )
        if np.abs(error).max(initial=0.0) < 1e-12:
            return guess
    return guess if np.abs(distort(guess, distortion) - points).max(initial=0.0) < 1e-9 else None


# 320×240 images with Parrot's diagonal fields of view for its AR.Drone: 92° forward and 64° down.
# The forward lens is wide-angle: with this barrel distortion, its focal length matches published calibrations.
FRONT_CAMERA = CameraModel(
    name="front",
    width=320,
    height=240,
    fps=30.0,
    fx=244.0,
    fy=244.0,
    cx=159.5,
    cy=119.5,
    distortion=(-0.28, 0.08, 0.0, 0.0, 0.0),
    position_m=(0.12, 0.0, 0.0),
    rotation=LOOKING_FORWARD,
    latency_s=0.03,
    noise_sigma=2.5,
    exposure_s=0.006,
    vignetting=0.25,
)
BOTTOM_CAMERA = CameraModel(
    name="bottom",
    width=320,
    height=240,
    fps=30.0,
    fx=320.0,
    fy=320.0,
    cx=159.5,
    cy=119.5,
    position_m=(0.0, 0.0, -0.03),
    rotation=LOOKING_DOWN,
    latency_s=0.02,
    noise_sigma=3.0,
    exposure_s=0.006,
    vignetting=0.15,
)
# A racing pilot's view: 100° by 76° (120° diagonally), as with a wide 2.1 mm lens, tilted for fast flight. Rate,
# latency and short exposure are estimates for an analogue camera.
FPV_CAMERA = CameraModel(
    name="fpv",
    width=320,
    height=240,
    fps=90.0,
    fx=172.0,
    fy=172.0,
    cx=159.5,
    cy=119.5,
    distortion=(-0.2, 0.03, 0.0, 0.0, 0.0),
    position_m=(0.08, 0.0, 0.02),
    rotation=looking_up(math.radians(25.0)),
    latency_s=0.02,
    noise_sigma=4.0,
    exposure_s=0.004,
    vignetting=0.3,
)
