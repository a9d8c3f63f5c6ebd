"""Where drones stand at the start: the world's own places first, then a grid around the first of them."""

from __future__ import annotations

import math
from collections.abc import Sequence

from skyloop.errors import UsageError
from skyloop.sim.parameters import VehicleParameters
from skyloop.sim.solids import Solids
from skyloop.sim.world import Spawn, World

_MARGINS_M = (0.6, 0.3, 0.15)  # between hulls, and to what stands around: the first that leaves enough places


def place(world: World, parameters: Sequence[VehicleParameters], solids: Solids) -> list[Spawn]:
    """Return a free place for each drone: the world's own first.

    Raises:
        UsageError: There are not enough, or one of the world's own is within something solid.
    """
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
    raise UsageError(f"world {world.name!r} has place for {len(placed)} drones only, not for {len(parameters)}")


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
    """Points of a square grid over the floor, nearest to ``around`` first."""
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
