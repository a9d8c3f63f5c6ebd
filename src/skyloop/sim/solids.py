"""The solid things of a world as arrays, and the distances of drones from them."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from skyloop.sim.streams import Floats
from skyloop.sim.targets import TargetTrack, top_speed
from skyloop.sim.world import FigureTarget, FixedYaw, PlatformTarget, Vec3, World


@dataclass(frozen=True, slots=True)
class Overlap:
    """A drone within a solid (or outside of the room).

    Attributes:
        normal: The way out.
        depth_m: How far.
        surface_m_s: Velocity of the solid's surface at the drone's centre.
        spin_rad_s: How fast the surface turns, counter-clockwise from above.
    """

    normal: Vec3
    depth_m: float
    surface_m_s: Vec3 = (0.0, 0.0, 0.0)
    spin_rad_s: float = 0.0


class Solids:
    """Boxes, gate bars, platforms and figures that move, the walls and ceiling of the room; not the floor."""

    def __init__(self, world: World, tracks: tuple[TargetTrack, ...]) -> None:
        boxes = world.solids()
        movers = [(track, track.target) for track in tracks if isinstance(track.target, PlatformTarget | FigureTarget)]
        self._fixed = len(boxes)
        self._movers = [track for track, _ in movers]
        self._lifts = [isinstance(target, PlatformTarget) for _, target in movers]
        sizes = [box.size_m for box in boxes] + [target.size_m for _, target in movers]
        self._half = np.array(sizes).reshape(-1, 3).T[:, :, None] / 2  # (3, boxes, 1)
        self._centre = np.zeros((3, len(sizes), 1))
        self._cos, self._sin = np.ones((len(sizes), 1)), np.zeros((len(sizes), 1))
        self._velocity = np.zeros((3, len(sizes)))
        self._spin = np.zeros(len(sizes))
        for number, box in enumerate(boxes):
            self._place(number, np.array(box.position_m), box.yaw_rad)
        size_x, size_y, height = world.room.size_m
        self._room_low = np.array([[-size_x / 2], [-size_y / 2], [-np.inf]])
        self._room_high = np.array([[size_x / 2], [size_y / 2], [height]])
        self.top_speed_m_s = max((_top_speed(target) for _, target in movers), default=0.0)
        self.move(0.0)

    @property
    def moving(self) -> bool:
        """Whether any of the solids moves."""
        return bool(self._movers)

    def move(self, time_s: float) -> None:
        """Move the moving solids to where they are at a time."""
        for number, (track, lifts) in enumerate(zip(self._movers, self._lifts, strict=True), self._fixed):
            state = track.at(time_s)
            centre = np.array(state.position_m)  # of a platform's top, of a figure's foot print
            centre[2] += self._half[2, number, 0] * (-1.0 if lifts else 1.0)
            self._place(number, centre, state.yaw_rad)
            self._velocity[:, number] = state.velocity_m_s
            self._spin[number] = state.yaw_rate_rad_s

    def clearance(self, points: Floats, hulls: Floats) -> Floats:
        """Return the distance to the nearest solid, wall or ceiling, (m,).

        Never more than the true distance; negative within.

        Args:
            points: Of the drones, (3, m).
            hulls: Radius, radius, half height, (3, m).
        """
        room = np.minimum(points - self._room_low, self._room_high - points) - hulls
        nearest: Floats = room.min(axis=0)
        if self._half.shape[1]:
            outside = np.abs(self._local(points)) - (self._half + hulls[:, None, :])
            nearest = np.minimum(nearest, outside.max(axis=0).min(axis=0))
        return nearest

    def overlap(self, point: Floats, hull: Floats, *, moving: bool = True) -> Overlap | None:
        """Return the deepest overlap of one drone, or None. ``point`` and ``hull`` are (3,)."""
        low = self._room_low[:, 0] + hull - point
        high = point - (self._room_high[:, 0] - hull)
        axis = int(np.maximum(low, high).argmax())
        depth = float(max(low[axis], high[axis]))
        worst = None
        if depth > 0:
            normal = [0.0, 0.0, 0.0]
            normal[axis] = 1.0 if low[axis] > high[axis] else -1.0
            worst = Overlap((normal[0], normal[1], normal[2]), depth)
        count = self._half.shape[1] if moving else self._fixed
        if count:
            local = self._local(point[:, None])[:, :count, 0]
            inside = self._half[:, :count, 0] + hull[:, None] - np.abs(local)
            depths = inside.min(axis=0)
            box = int(depths.argmax())
            if depths[box] > max(depth, 0.0):
                worst = self._way_out(box, local[:, box], inside[:, box])
        return worst

    def _way_out(self, box: int, local: Floats, inside: Floats) -> Overlap:
        axis = int(inside.argmin())
        if box >= self._fixed and self._lifts[box - self._fixed] and local[2] > 0:
            axis = 2  # a platform lifts what is on it, however it moves
        sign = 1.0 if local[axis] >= 0 else -1.0
        c, s = float(self._cos[box, 0]), float(self._sin[box, 0])
        if axis == 2:
            normal = (0.0, 0.0, sign)
        else:
            normal = (c * sign, s * sign, 0.0) if axis == 0 else (-s * sign, c * sign, 0.0)
        vx, vy, vz = self._velocity[:, box].tolist()
        spin, (x, y, _) = float(self._spin[box]), local.tolist()
        surface = (vx - spin * (s * x + c * y), vy + spin * (c * x - s * y), vz)
        return Overlap(normal, float(inside[axis]), surface, spin)

    def _place(self, number: int, centre: Floats, yaw_rad: float) -> None:
        self._centre[:, number, 0] = centre
        self._cos[number, 0], self._sin[number, 0] = np.cos(yaw_rad), np.sin(yaw_rad)

    def _local(self, points: Floats) -> Floats:
        """Points (3, m) in the axes of each box, (3, boxes, m)."""
        away = points[:, None, :] - self._centre
        local = away.copy()
        local[0] = self._cos * away[0] + self._sin * away[1]
        local[1] = self._cos * away[1] - self._sin * away[0]
        return local


def _top_speed(target: PlatformTarget | FigureTarget) -> float:
    """Return a speed [m/s] that no point of a target exceeds, those at its corners included."""
    turn = 0.0 if isinstance(target.yaw, FixedYaw) else target.yaw.turn_rate_rad_s
    return top_speed(target.path) + turn * math.hypot(*target.size_m[:2]) / 2


Indices = NDArray[np.intp]
