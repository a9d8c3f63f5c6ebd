"""A world's solids: distances from drones to them, overlaps, and free starting positions for drones."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from skyloop.errors import UsageError
from skyloop.sim.parameters import VehicleParameters
from skyloop.sim.streams import Floats
from skyloop.sim.targets import TargetTrack, top_speed
from skyloop.sim.world import FigureTarget, FixedYaw, PlatformTarget, Spawn, Vec3, World


class Overlap(NamedTuple):
    """A drone's overlap with a solid or with the room's walls and ceiling."""

    normal: Vec3  #: direction out of the solid
    depth_m: float  #: depth of the overlap along that direction
    surface_m_s: Vec3 = (0.0, 0.0, 0.0)  #: velocity of the solid's surface at the drone's centre
    spin_rad_s: float = 0.0  #: turn rate of the surface, counter-clockwise from above


class Solids:
    """Boxes, gate bars, moving platforms and figures, the room's walls and its ceiling, but not the floor."""

    def __init__(self, world: World, tracks: tuple[TargetTrack, ...]) -> None:
        boxes = world.solids()
        movers = [(track, track.target) for track in tracks if isinstance(track.target, PlatformTarget | FigureTarget)]
        self.fixed = len(boxes)  #: number of fixed solids
        self._movers = [track for track, _ in movers]
        self.moving = bool(movers)  #: whether any of the solids is moving
        self._lifts = [isinstance(target, PlatformTarget) for _, target in movers]
        sizes = [box.size_m for box in boxes] + [target.size_m for _, target in movers]
        self._half = np.array(sizes).reshape(-1, 3).T[:, :, None] / 2  # (3, boxes, 1)
        self._centre = np.zeros((3, len(sizes), 1))
        self._cos, self._sin = np.ones((len(sizes), 1)), np.zeros((len(sizes), 1))
        # The same values as plain numbers, which are faster for a single box: centre, half the size, cosine and sine of
        # yaw, velocity, and turn rate.
        self._boxes = [(0.0,) * 8 for _ in sizes]
        self._motions: list[tuple[Vec3, float]] = [((0.0, 0.0, 0.0), 0.0) for _ in sizes]
        for number, box in enumerate(boxes):
            self._place(number, box.position_m, box.yaw_rad)
        self._bounds = np.zeros((3, len(sizes))), np.zeros((3, len(sizes)))
        self._bounded_m = math.nan  # radius of the hulls for which ``_bounds`` is valid
        size_x, size_y, height = world.room.size_m
        self.room_low = np.array([[-size_x / 2], [-size_y / 2], [-np.inf]])
        self.room_high = np.array([[size_x / 2], [size_y / 2], [height]])
        self._room = size_x / 2, size_y / 2, height
        self._enclosed = world.room.enclosed
        self.top_speed_m_s = max((_top_speed(target) for _, target in movers), default=0.0)
        self.move(0.0)

    def __len__(self) -> int:
        """Return the number of boxes, platforms and figures. Solids are numbered, with the moving ones last."""
        return len(self._boxes)

    def move(self, time_s: float) -> None:
        """Move the moving solids to their positions at a point in time."""
        for number, (track, lifts) in enumerate(zip(self._movers, self._lifts, strict=True), self.fixed):
            state = track.at(time_s)
            x, y, z = state.position_m  # for a platform, its top; for a figure, its footprint
            half = float(self._half[2, number, 0])
            centre = (x, y, z - half if lifts else z + half)
            self._place(number, centre, state.yaw_rad, state.velocity_m_s, state.yaw_rate_rad_s)

    def bounds(self, seconds: float, radius_m: float) -> tuple[Floats, Floats]:
        """Return bounding boxes, low and high, each (3, boxes) [m]. The bounds are valid until the next call.

        Moving solids stay within their boxes for ``seconds``, and a hull of ``radius_m`` touches a solid only if their
        bounding boxes overlap.
        """
        if radius_m != self._bounded_m:
            self._bounded_m = radius_m
            self._bound(slice(0, self.fixed), 0.0)
        if self._movers:
            self._bound(slice(self.fixed, None), self.top_speed_m_s * seconds)
        return self._bounds

    def _bound(self, which: slice, reach_m: float) -> None:
        """Compute the bounding boxes of the given solids, enlarged by this reach on all sides."""
        c, s = np.abs(self._cos[which]), np.abs(self._sin[which])
        x, y, z = self._half[:, which]
        # For :meth:`overlap`, a hull is a square turned like the box, so it reaches further at the corners.
        corner = (c + s - 1.0) * self._bounded_m + reach_m
        around = np.array([c * x + s * y + corner, s * x + c * y + corner, z + reach_m])
        low, high = self._bounds
        low[:, which] = (self._centre[:, which] - around)[:, :, 0]
        high[:, which] = (self._centre[:, which] + around)[:, :, 0]

    def within(self, points: Floats, numbers: Indices, sizes: Floats) -> Indices:
        """Return which of the points (3, m), m > 0, are inside their solids, as indices in ascending order.

        For each point, ``numbers`` has the index of its solid, (m,), and ``sizes`` has the result of :meth:`sizes` for
        that solid and the point's hull.
        """
        x, y, z = points - self._centre[:, :, 0].take(numbers, axis=1)
        c, s = self._cos[:, 0].take(numbers), self._sin[:, 0].take(numbers)
        away = np.array([c * x + s * y, c * y - s * x, z])
        found: Indices = (np.abs(away) < sizes).all(axis=0).nonzero()[0]
        return found

    def sizes(self, numbers: Indices, hulls: Floats) -> Floats:
        """Return the half sizes of solids, enlarged by hulls (3, m), shape (3, m)."""
        grown: Floats = self._half[:, :, 0].take(numbers, axis=1) + hulls
        return grown

    def clearance(self, points: Floats, hulls: Floats) -> Floats:
        """Return the distance between the points (3, m) of drones and the nearest solid, wall or ceiling, (m,).

        It never exceeds the true distance, and is negative inside a solid. ``hulls`` are radius, radius, half height,
        (3, m).
        """
        room = np.minimum(points - self.room_low, self.room_high - points) - hulls
        nearest: Floats = room.min(axis=0)
        if self._half.shape[1]:
            outside = np.abs(self._local(points)) - (self._half + hulls[:, None, :])
            nearest = np.minimum(nearest, outside.max(axis=0).min(axis=0))
        return nearest

    def overlap(
        self, point: Sequence[float], radius: float, half_height: float, among: Iterable[int] | None = None
    ) -> Overlap | None:
        """Return a drone's deepest overlap with the room or the solids ``among`` (None: all); None if it has none."""
        x, y, z = point
        wide, deep, tall = self._room
        deepest, worst = 0.0, None
        beyond_x, beyond_y, beyond_z = abs(x) + radius - wide, abs(y) + radius - deep, z + half_height - tall
        if beyond_x > 0.0 or beyond_y > 0.0 or beyond_z > 0.0:
            deepest = max(beyond_x, beyond_y, beyond_z)
            if deepest == beyond_x:
                normal = (-1.0 if x > 0 else 1.0, 0.0, 0.0)
            elif deepest == beyond_y:
                normal = (0.0, -1.0 if y > 0 else 1.0, 0.0)
            else:
                normal = (0.0, 0.0, -1.0)
            worst = Overlap(normal, deepest)
        found = -1
        local = inside = (0.0, 0.0, 0.0)
        for number in range(len(self)) if among is None else among:
            centre_x, centre_y, centre_z, half_x, half_y, half_z, c, s = self._boxes[number]
            up = z - centre_z
            inside_z = half_z + half_height - abs(up)
            if inside_z <= deepest:
                continue
            east, north = x - centre_x, y - centre_y
            ahead, left = c * east + s * north, c * north - s * east
            inside_x, inside_y = half_x + radius - abs(ahead), half_y + radius - abs(left)
            if inside_x > deepest and inside_y > deepest:
                deepest, found = min(inside_x, inside_y, inside_z), number
                local, inside = (ahead, left, up), (inside_x, inside_y, inside_z)
        return worst if found < 0 else self._way_out(found, local, inside)

    def distance_along(self, point: Vec3, direction: Vec3, time_s: float) -> float:
        """Return the distance [m] along a unit vector to the first solid, floor, or visible wall or ceiling at a time.

        It is infinite if there is none. A point below the floor counts as on the floor.
        """
        if self._movers:
            self.move(time_s)
        nearest = math.inf
        wide, deep, _ = self._room
        bounds = zip(point, direction, (-wide, -deep, 0.0), self._room, strict=True)
        for axis, (start, way, low, high) in enumerate(bounds):
            if way < 0.0 and (axis == 2 or self._enclosed):
                nearest = min(nearest, max(0.0, (low - start) / way))
            elif way > 0.0 and self._enclosed:
                nearest = min(nearest, max(0.0, (high - start) / way))
        if not self._boxes:
            return nearest
        away = np.array(point)[:, None] - self._centre[:, :, 0]
        c, s = self._cos[:, 0], self._sin[:, 0]
        x, y, z = direction
        starts = np.array([c * away[0] + s * away[1], c * away[1] - s * away[0], away[2]])
        ways = np.array([c * x + s * y, c * y - s * x, np.full_like(c, z)])
        # Treat a beam that is parallel to a face as almost parallel.
        ways[np.abs(ways) < 1e-12] = 1e-12
        half = self._half[:, :, 0]
        one, other = (-half - starts) / ways, (half - starts) / ways
        enters, leaves = np.minimum(one, other).max(axis=0), np.maximum(one, other).min(axis=0)
        hit = (enters <= leaves) & (leaves >= 0.0)
        return min(nearest, float(np.maximum(enters[hit], 0.0).min())) if hit.any() else nearest

    def _way_out(self, number: int, local: Vec3, inside: Vec3) -> Overlap:
        axis = inside.index(min(inside))
        if number >= self.fixed and self._lifts[number - self.fixed] and local[2] > 0:
            axis = 2  # a platform lifts everything on it, regardless of its direction of motion
        sign = 1.0 if local[axis] >= 0 else -1.0
        *_, c, s = self._boxes[number]
        if axis == 2:
            normal = (0.0, 0.0, sign)
        else:
            normal = (c * sign, s * sign, 0.0) if axis == 0 else (-s * sign, c * sign, 0.0)
        (vx, vy, vz), spin = self._motions[number]
        x, y, _ = local
        surface = (vx - spin * (s * x + c * y), vy + spin * (c * x - s * y), vz)
        return Overlap(normal, inside[axis], surface, spin)

    def _place(
        self, number: int, centre: Vec3, yaw_rad: float, velocity: Vec3 = (0.0, 0.0, 0.0), spin: float = 0.0
    ) -> None:
        c, s = math.cos(yaw_rad), math.sin(yaw_rad)
        self._centre[:, number, 0] = centre
        self._cos[number, 0], self._sin[number, 0] = c, s
        half_x, half_y, half_z = self._half[:, number, 0].tolist()
        self._boxes[number] = (*centre, half_x, half_y, half_z, c, s)
        self._motions[number] = velocity, spin

    def _local(self, points: Floats) -> Floats:
        """Return points (3, m) in each box's axes, (3, boxes, m)."""
        away = points[:, None, :] - self._centre
        local = away.copy()
        local[0] = self._cos * away[0] + self._sin * away[1]
        local[1] = self._cos * away[1] - self._sin * away[0]
        return local


def _top_speed(target: PlatformTarget | FigureTarget) -> float:
    """Return an upper bound for the speed [m/s] of all points of a target, including corners."""
    turn = 0.0 if isinstance(target.yaw, FixedYaw) else target.yaw.turn_rate_rad_s
    return top_speed(target.path) + turn * math.hypot(*target.size_m[:2]) / 2


Indices = NDArray[np.intp]


def overlapping(low: Floats, high: Floats, movable: int) -> tuple[Indices, Indices]:
    """Return the pairs of overlapping boxes, found by a sweep along the axis on which they are spread widest.

    Boxes extend from ``low`` to ``high``, each (3, n) [m]; boxes that touch count as overlapping. At least one box of
    each pair is among the first ``movable`` boxes. Pairs are sorted by their lower number, then by their higher number.
    """
    if low.shape[1] < 2:
        return np.zeros(0, np.intp), np.zeros(0, np.intp)
    axis = int((low.max(axis=1) - low.min(axis=1)).argmax())
    order = low[axis].argsort(kind="stable")
    begins, ends = low[axis, order], high[axis, order]
    # In this order, the boxes that a box overlaps along the axis are the later boxes that begin before it ends.
    numbers = np.arange(len(order))
    counts = begins.searchsorted(ends, side="right") - numbers - 1
    first = numbers.repeat(counts)
    before = counts.cumsum() - counts  # number of pairs found for the preceding boxes
    second = np.arange(len(first)) - (before - numbers - 1).repeat(counts)
    one, other = order.take(first), order.take(second)
    for across in {0, 1, 2} - {axis}:
        begins, ends = low[across], high[across]
        overlap = (begins.take(one) <= ends.take(other)) & (begins.take(other) <= ends.take(one))
        one, other = one.compress(overlap), other.compress(overlap)
    lesser, greater = np.minimum(one, other), np.maximum(one, other)
    wanted = (lesser < movable).nonzero()[0]
    wanted = wanted.take((lesser.take(wanted) * len(order) + greater.take(wanted)).argsort())
    return lesser.take(wanted), greater.take(wanted)


_MARGINS_M = (0.6, 0.3, 0.15)  # distances between hulls and to obstacles; the first one that leaves enough room is used


def place(world: World, parameters: Sequence[VehicleParameters], solids: Solids) -> list[Spawn]:
    """Return a free starting position for each drone: first the world's own, then a grid around the first of them."""
    spawns = list(world.spawns[: len(parameters)])
    for spawn, drone in zip(spawns, parameters, strict=False):
        if not _is_clear(spawn, drone, solids, 0.0):
            raise UsageError(f"world {world.name!r}: the spawn {spawn.name!r} leaves no room for a drone to stand")
    if len(spawns) == len(parameters):
        return spawns
    for margin in _MARGINS_M:
        placed = _fill(world, parameters, solids, spawns, margin)
        if len(placed) == len(parameters):
            return placed
    raise UsageError(f"world {world.name!r} has room for only {len(placed)} drones, not for {len(parameters)}")


def _fill(
    world: World, parameters: Sequence[VehicleParameters], solids: Solids, first: list[Spawn], margin_m: float
) -> list[Spawn]:
    spawns = list(first)
    spacing = 2 * max(drone.radius_m for drone in parameters) + margin_m
    yaw = spawns[0].yaw_rad if spawns else 0.0
    for x, y in _grid(world, spacing, spawns[0] if spawns else None):
        if len(spawns) == len(parameters):
            break
        spawn = Spawn(f"spawn {len(spawns) + 1}", (x, y, 0.0), yaw)
        apart = all(math.hypot(x - s.position_m[0], y - s.position_m[1]) >= spacing - 1e-9 for s in spawns)
        if apart and _is_clear(spawn, parameters[len(spawns)], solids, margin_m):
            spawns.append(spawn)
    return spawns


def _grid(world: World, spacing: float, around: Spawn | None) -> list[tuple[float, float]]:
    """Return the points of a square grid over the floor, starting with the points nearest to ``around``."""
    x0, y0 = around.position_m[:2] if around else (0.0, 0.0)
    reach_x, reach_y = (math.ceil(world.room.size_m[axis] / spacing) for axis in (0, 1))
    points = [
        (x0 + column * spacing, y0 + row * spacing)
        for column in range(-reach_x, reach_x + 1)
        for row in range(-reach_y, reach_y + 1)
    ]
    return sorted(points, key=lambda p: (round(math.hypot(p[0] - x0, p[1] - y0), 6), p))


def _is_clear(spawn: Spawn, drone: VehicleParameters, solids: Solids, margin_m: float) -> bool:
    x, y, z = spawn.position_m
    radius = drone.radius_m + margin_m
    return solids.overlap((x, y, z + drone.half_height_m + 1e-6), radius, drone.half_height_m) is None
