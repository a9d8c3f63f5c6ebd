"""A world prepared for rendering: its textures in one atlas, its fixed parts as quads, and what moves as templates."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from skyloop.errors import UsageError
from skyloop.sim.render import models
from skyloop.sim.render.atlas import AtlasBuilder
from skyloop.sim.render.base import SceneState
from skyloop.sim.render.figures import figure
from skyloop.sim.render.quads import Quads, concatenate, move_each
from skyloop.sim.render.room import SIDES, static_quads
from skyloop.sim.render.shadows import Shadow
from skyloop.sim.world import BoardTarget, FigureTarget, PlatformTarget, World

_FADES_AT_M = 4.0  # a drone this high above a surface leaves no visible shadow on it


@dataclass(frozen=True, slots=True, eq=False)
class Posed:
    """Everything of a scene at one time. ``drone``: whose body a quad belongs to, -1 for none, (n,)."""

    quads: Quads
    drone: NDArray[np.intp]
    shadows: tuple[Shadow, ...]


class Scene:
    """What can be rendered of a world with a number of drones.

    Building it draws all textures (some tenths of a second); after that it never changes, so renderers in several
    threads may share it.

    Raises:
        UsageError: A texture, a marker dictionary or an id does not exist.
    """

    def __init__(self, world: World, drones: int = 1) -> None:
        atlas = AtlasBuilder()
        self.world = world
        self.drones = drones
        self._static = static_quads(world, atlas)
        self._figures = [figure(atlas, t) if isinstance(t, FigureTarget) else None for t in world.targets]
        self._targets = [
            models.target(atlas, target) if shape is None else shape.standing()
            for target, shape in zip(world.targets, self._figures, strict=True)
        ]
        self._stand = models.stand(atlas)
        hulls = [models.drone(atlas, hull) for hull in models.HULLS[: max(1, drones)]]
        self._hulls = [hulls[k % len(hulls)] for k in range(drones)]
        standing = [
            part
            for target, template in zip(world.targets, self._targets, strict=True)
            for part in ([template, self._stand] if isinstance(target, BoardTarget) else [template])
        ]
        # Everything in the order of ``posed``, for what doesn't change when it moves.
        self._everything = concatenate([self._static, *standing, *self._hulls])
        #: Which target of the world a quad belongs to, -1 for none, (n,).
        self.target_of = np.concatenate(
            [np.full(len(self._static), -1, np.intp)]
            + [
                np.full(len(template) + (len(self._stand) if isinstance(target, BoardTarget) else 0), k, np.intp)
                for k, (target, template) in enumerate(zip(world.targets, self._targets, strict=True))
            ]
            + [np.full(len(hull), -1, np.intp) for hull in self._hulls]
        )
        #: Which box of the world a quad belongs to, -1 for none, (n,).
        self.box_of = np.full(len(self.target_of), -1, np.intp)
        sides = np.repeat(np.arange(len(world.solids())), SIDES)
        first = len(self._static) - len(world.panels) - len(world.markers) - len(sides)
        self.box_of[first : first + len(sides)] = np.where(sides < len(world.boxes), sides, -1)
        owners = [np.full(len(self._static) + sum(map(len, standing)), -1, np.intp)]
        owners += [np.full(len(hull), k, np.intp) for k, hull in enumerate(self._hulls)]
        self._owner = np.concatenate(owners)
        self._swarm = concatenate(self._hulls) if self._hulls else None
        self.atlas = atlas.pack()
        # Where shadows can fall: upright solids, as cosine and sine of the yaw, centre, half width and depth, and top.
        self._tops = [
            (
                math.cos(box.yaw_rad),
                math.sin(box.yaw_rad),
                *map(float, box.position_m[:2]),
                *(side / 2 for side in map(float, box.size_m[:2])),
                float(box.position_m[2] + box.size_m[2] / 2),
            )
            for box in world.solids()
        ]

    def posed(self, state: SceneState) -> Posed:
        """Place everything that moves as a state says.

        Raises:
            UsageError: The state has another number of drones or targets.
        """
        shape = np.shape(state.drone_positions_m), np.shape(state.drone_rotations)
        if shape != ((self.drones, 3), (self.drones, 3, 3)):
            raise UsageError(
                f"the scene has {self.drones} drones: positions must be ({self.drones}, 3) and rotations "
                f"({self.drones}, 3, 3), not {shape[0]} and {shape[1]}"
            )
        if len(state.targets) != len(self._targets):
            raise UsageError(f"the world has {len(self._targets)} moving targets, the state {len(state.targets)}")
        vectors, starts = self._everything.vectors.copy(), self._everything.starts.copy()
        done = len(self._static)
        shadows: list[Shadow] = []
        for template, figure_, target, now in zip(
            self._targets, self._figures, self.world.targets, state.targets, strict=True
        ):
            position, turn = np.array(now.position_m), _yaw(now.yaw_rad)
            part = slice(done, done + len(template))
            done = part.stop
            if figure_ is not None:
                posed = figure_.posed(position, turn, now.walked_m)
                vectors[part], starts[part] = posed.vectors, posed.starts
                shadows += figure_.shadows(position, turn)
                continue
            move_each(template, position[None], turn[None], vectors[part], starts[part])
            on_floor = np.array([position[0], position[1], 0.0])
            if isinstance(target, BoardTarget):
                part = slice(done, done + len(self._stand))
                done = part.stop
                move_each(self._stand, on_floor[None], turn[None], vectors[part], starts[part])
                shadows.append(Shadow(on_floor, 0.32, 0.45))
            elif isinstance(target, PlatformTarget):
                shadows.append(Shadow(on_floor, 0.75 * math.hypot(*target.size_m[:2]), 0.45))
        if self._swarm is not None:
            move_each(self._swarm, state.drone_positions_m, state.drone_rotations, vectors[done:], starts[done:])
            shadows += filter(None, map(self._drone_shadow, state.drone_positions_m.tolist()))
        return Posed(replace(self._everything, vectors=vectors, starts=starts), self._owner, tuple(shadows))

    def _drone_shadow(self, position_m: list[float]) -> Shadow | None:
        """The soft spot on whatever surface is below a drone; None if it is too high above it."""
        x, y, z = position_m
        surface = 0.0
        for c, s, at_x, at_y, half_x, half_y, top in self._tops:
            dx, dy = x - at_x, y - at_y
            if surface < top <= z and abs(c * dx + s * dy) < half_x and abs(c * dy - s * dx) < half_y:
                surface = top
        above = z - surface
        fade = 1.0 - above / _FADES_AT_M
        if fade <= 0.0:
            return None
        return Shadow(np.array([x, y, surface]), models.DRONE_RADIUS_M * (1.1 + 0.35 * above), 0.6 * fade**1.5)


def _yaw(angle: float) -> NDArray[np.float64]:
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
