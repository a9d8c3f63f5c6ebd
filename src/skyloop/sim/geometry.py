"""The geometry of a simulated world, for maps."""

from __future__ import annotations

from skyloop.messages.parameter import Card, Opening, Solid, Start, WorldGeometry
from skyloop.sim.world import World


def geometry_of(world: World) -> WorldGeometry:
    """Return the fixed geometry of a world, without textures and moving objects."""
    x, y, z = world.room.size_m
    return WorldGeometry(
        name=world.name[:64],
        low=(-x / 2, -y / 2, 0.0),
        high=(x / 2, y / 2, z),
        enclosed=world.room.enclosed,
        solids=tuple(
            Solid(b.name, _rounded(b.position_m), _rounded(b.size_m), round(b.yaw_rad, 4)) for b in world.boxes
        ),
        gates=tuple(
            Opening(g.name, _rounded(g.position_m), g.inner_size_m, round(g.yaw_rad, 4), g.frame_m) for g in world.gates
        ),
        markers=tuple(
            Card(
                m.name,
                _rounded(m.pose.position_m),
                m.pattern.size_m,
                round(m.pose.yaw_rad, 4),
                round(m.pose.elevation_rad, 4),
            )
            for m in world.markers
        ),
        starts=tuple(Start(s.name, _rounded(s.position_m), round(s.yaw_rad, 4)) for s in world.spawns),
    )


def _rounded(place: tuple[float, float, float]) -> tuple[float, float, float]:
    """Round to millimetres, to keep the text short."""
    return round(place[0], 3), round(place[1], 3), round(place[2], 3)
