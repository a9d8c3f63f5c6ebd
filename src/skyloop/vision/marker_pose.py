"""The two poses that four corners of a square allow, with their covariance, and the choice between them over time."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np

from skyloop.clock import seconds
from skyloop.vision.lens import Array

_STEPS: Final = 5
_SAME_RAD: Final = 0.03  # between normals: refining both poses led to the same one
_FORGET_S: Final = 1.0  # without a sighting
_MOST_COST: Final = 20.0  # cost by which one pose can lag behind: a wrong choice is corrected within some frames
_TURN_RAD, _TURN_RAD_S = 0.08, 0.6  # a marker's turn between frames: standard deviation, and its growth with time
_SHARE: Final = 0.25  # weight of the corners' costs, because errors of successive frames are alike


@dataclass(frozen=True, slots=True, eq=False)
class SquarePose:
    """One pose in optical axes."""

    position: Array  #: (3,) [m]
    rotation: Array  #: (3, 3), from the object's axes
    covariance: Array  #: (6, 6), of the position, then of a rotation vector applied after ``rotation``
    error: float  #: root mean square distance of the corners' x/z and y/z
    cost: float  #: sum of squared errors in standard deviations

    @property
    def normal(self) -> Array:
        return self.rotation[:, 2]


def solutions(cv: Any, outline_m: Array, rays: Array, covariance: Array) -> list[SquarePose]:
    """Return the poses in front of the camera, the likeliest first.

    Args:
        cv: OpenCV.
        outline_m: Corners in the square's own axes, (4, 3), as ``SOLVEPNP_IPPE_SQUARE`` requires.
        rays: x/z and y/z of the corners, (4, 2).
        covariance: Of the rays, (8, 8).
    """
    count, turns, places, _ = cv.solvePnPGeneric(outline_m, rays, np.eye(3), None, flags=cv.SOLVEPNP_IPPE_SQUARE)
    inverse: Array = np.asarray(np.linalg.inv(covariance), dtype=np.float64)
    found = []
    for turn, place in zip(turns[:count], places[:count], strict=True):
        position: Array = np.asarray(place, dtype=np.float64).reshape(3)
        rotation: Array = np.asarray(cv.Rodrigues(turn)[0], dtype=np.float64)
        pose = _refined(cv, outline_m, rays, inverse, (position, rotation))
        if pose is not None:
            found.append(pose)
    if len(found) == 2 and math.dist(found[0].normal, found[1].normal) < _SAME_RAD:  # a step went beyond the ridge
        unrefined = _refined(cv, outline_m, rays, inverse, (position, rotation), steps=1)
        found[1:] = [unrefined] if unrefined else []
    return sorted(found, key=lambda pose: pose.cost)


def _refined(
    cv: Any, outline_m: Array, rays: Array, inverse: Array, start: tuple[Array, Array], steps: int = _STEPS
) -> SquarePose | None:
    """Return the pose with the least cost near a first one (Gauss-Newton); None if it is not in front of the camera."""
    position, rotation = start
    best: SquarePose | None = None
    for _ in range(steps):
        turned = outline_m @ rotation.T
        points = turned + position
        if not np.isfinite(points).all() or (points[:, 2] <= 1e-6).any():
            break
        depth = points[:, 2]
        seen = points[:, :2] / depth[:, None]
        off = (rays - seen).ravel()
        slope = np.zeros((4, 2, 6))  # of x/z and y/z by position and rotation
        by_point = np.zeros((4, 2, 3))
        by_point[:, 0, 0] = by_point[:, 1, 1] = 1 / depth
        by_point[:, :, 2] = -seen / depth[:, None]
        slope[:, :, :3] = by_point
        slope[:, :, 3:] = np.cross(turned[:, None], by_point)
        rows = slope.reshape(8, 6)
        normal = rows.T @ inverse @ rows
        cost = float(off @ inverse @ off)
        if best is not None and cost >= best.cost:
            break
        try:
            spread: Array = np.asarray(np.linalg.inv(normal), dtype=np.float64)
        except np.linalg.LinAlgError:
            break
        best = SquarePose(position, rotation, spread, float(np.sqrt((off**2).sum() / 4)), cost)
        step = spread @ rows.T @ inverse @ off
        position = position + step[:3]
        rotation = np.asarray(cv.Rodrigues(step[3:])[0]) @ rotation
    return best


@dataclass(slots=True)
class PoseChoice:
    """Chooses between the two poses of one marker: the right one is steady, the wrong one turns as the camera moves.

    The costs of all chains of poses are accumulated (Viterbi). A turn of the marker's normal from one frame to the next
    costs the more, the larger it is.
    """

    _at_ns: int | None = None
    _costs: list[float] = field(default_factory=list)
    _normals: list[Array] = field(default_factory=list)

    def choose(self, costs: Sequence[float], normals: Sequence[Array], at_ns: int) -> int:
        """Return the number of the likeliest pose, from each pose's cost and normal (3,) in steady axes."""
        total = [_SHARE * cost for cost in costs]
        if self._at_ns is not None and 0 <= seconds(at_ns - self._at_ns) < _FORGET_S:
            sigma = _TURN_RAD + _TURN_RAD_S * seconds(at_ns - self._at_ns)
            for n, normal in enumerate(normals):
                total[n] += min(
                    before + 0.5 * (float(np.linalg.norm(normal - earlier)) / sigma) ** 2
                    for before, earlier in zip(self._costs, self._normals, strict=True)
                )
        least = min(total)
        self._at_ns, self._normals = at_ns, list(normals)
        self._costs = [min(_MOST_COST, cost - least) for cost in total]
        return int(np.argmin(total))
