"""A world as a MuJoCo model: the same shapes and textures as the planar renderer's, as meshes under a lamp.

What moves are mocap bodies. Nothing in the model collides or falls: the simulation's own dynamics decide where things
are, and MuJoCo only draws them.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from skyloop.sim.render import models
from skyloop.sim.render.atlas import AtlasBuilder
from skyloop.sim.render.quads import Quads, concatenate
from skyloop.sim.render.room import static_quads
from skyloop.sim.render.shading import SUN
from skyloop.sim.world import BoardTarget, World

NEAREST_M = 0.02  #: what is nearer to a camera is not drawn
FARTHEST_M = 1000.0  #: the sky's corners are 700 m away
_PRINT_M = 0.0005  # how far a print stands before what it is stuck on, each step of priority
_SHADOW_TEXELS = 4096
_MULTISAMPLES = 4
_FACES_UP = 0.5  # upward part of the normal
_SUNWARDS = SUN / np.linalg.norm(SUN)
_AMBIENT, _LAMP, _FILL = 0.74, 0.22, 0.08

Vector = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class DroneBodies:
    """Mocap numbers of one drone. ``upper`` holds the faces that look up, the ones the lamp sees; ``rest`` the others.

    A camera below or among faces that look up does not see them (they are seen from their front only), while their
    shadow falls: so the drone that carries a camera shows its upper part alone.
    """

    upper: int
    rest: int


@dataclass(frozen=True, slots=True)
class Stage:
    """A compiled model.

    Attributes:
        model: MuJoCo's.
        targets: Mocap numbers, one for each target of the world.
        stands: The same of their stands; None for a target without one.
        drones: The bodies of each drone.
    """

    model: Any
    targets: tuple[int, ...]
    stands: tuple[int | None, ...]
    drones: tuple[DroneBodies, ...]


def build_stage(world: World, drones: int) -> Stage:
    """Build the model of a world with a number of drones."""
    atlas = AtlasBuilder()
    still = static_quads(world, atlas, painted_shadows=False)
    targets = [models.target(atlas, t) for t in world.targets]
    stand = models.stand(atlas)
    hulls = [models.drone(atlas, models.HULLS[n % len(models.HULLS)]) for n in range(drones)]
    maker = _Maker(atlas)
    maker.add_static(still)
    target_bodies = tuple(maker.add_moving(quads) for quads in targets)
    stands = tuple(maker.add_moving(stand) if isinstance(t, BoardTarget) else None for t in world.targets)
    bodies = tuple(_add_drone(maker, hull) for hull in hulls)
    _light(maker.spec, world)
    _visual(maker.spec)
    return Stage(maker.spec.compile(), target_bodies, stands, bodies)


def _add_drone(maker: _Maker, hull: Quads) -> DroneBodies:
    quads = _one_sided(hull)
    up = quads.normals[:, 2] > _FACES_UP
    return DroneBodies(maker.add_moving(_chosen(quads, up)), maker.add_moving(_chosen(quads, ~up)))


class _Maker:
    """Collects meshes into a specification."""

    def __init__(self, atlas: AtlasBuilder) -> None:
        self.spec = mujoco.MjSpec()
        self._images = atlas.images
        self._materials: dict[tuple[int, bool], str] = {}
        self._meshes: dict[bytes, str] = {}
        self._moving = 0

    def add_static(self, quads: Quads) -> None:
        self._add(self.spec.worldbody, quads)

    def add_moving(self, quads: Quads) -> int:
        """A body to be put anywhere; returns its mocap number."""
        self._add(self.spec.worldbody.add_body(name=f"moving {self._moving}", mocap=True), quads)
        self._moving += 1
        return self._moving - 1

    def _add(self, body: Any, quads: Quads) -> None:
        """A geom for each texture."""
        quads = _one_sided(quads)
        for texture, lit in sorted({(int(t), bool(b)) for t, b in zip(quads.texture, quads.lit, strict=True)}):
            part = _chosen(quads, (quads.texture == texture) & (quads.lit == lit))
            body.add_geom(
                type=mujoco.mjtGeom.mjGEOM_MESH,
                meshname=self._mesh(part),
                material=self._material(texture, lit),
                contype=0,
                conaffinity=0,
            )

    def _mesh(self, quads: Quads) -> str:
        """Two triangles for each quad; of those with a corner twice one has no area, and is left out."""
        corners = quads.corners + (_PRINT_M * quads.priority)[:, None, None] * quads.normals[:, None, :]
        image = self._images[int(quads.texture[0])]
        u = np.einsum("nci,ni->nc", quads.corners, quads.u_slope) + quads.u_start[:, None]
        v = np.einsum("nci,ni->nc", quads.corners, quads.v_slope) + quads.v_start[:, None]
        first = 4 * np.arange(len(quads))[:, None, None]
        faces = (first + np.array([[0, 1, 2], [0, 2, 3]])).reshape(-1, 3)
        points = corners.reshape(-1, 3)
        a, b, c = (points[faces[:, k]] for k in range(3))
        faces = faces[np.linalg.norm(np.cross(b - a, c - a), axis=1) > 1e-9]
        texels = np.stack([u / image.shape[1], v / image.shape[0]], axis=-1)
        key = points.tobytes() + texels.tobytes() + faces.tobytes()
        if key not in self._meshes:
            self._meshes[key] = f"mesh {len(self._meshes)}"
            mesh = self.spec.add_mesh(name=self._meshes[key])
            mesh.uservert = points.ravel()
            # What is unlit has its own light already; with its normals turned away the sun adds none.
            normals = np.where(quads.lit[:, None], quads.normals, -_SUNWARDS)
            mesh.usernormal = np.repeat(normals, 4, axis=0).ravel()
            mesh.usertexcoord = texels.ravel()
            mesh.userface = faces.ravel()
            mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL  # flat things have no volume
        return self._meshes[key]

    def _material(self, texture: int, lit: bool) -> str:
        name = f"texture {texture}" + ("" if lit else " unlit")
        if (texture, lit) not in self._materials:
            self._materials[texture, lit] = name
            image = self._images[texture]
            rgb = np.ascontiguousarray(image[..., ::-1])
            made = self.spec.add_texture(
                name=name,
                type=mujoco.mjtTexture.mjTEXTURE_2D,
                width=image.shape[1],
                height=image.shape[0],
                nchannel=3,
            )
            made.data = rgb.tobytes()
            material = self.spec.add_material(
                name=name, specular=0.0, shininess=0.0, reflectance=0.0, emission=0.0 if lit else 1.0
            )
            roles = material.textures
            roles[mujoco.mjtTextureRole.mjTEXROLE_RGB] = name
            material.textures = roles
        return name


def _light(spec: Any, world: World) -> None:
    """Add ambient light, and one light that casts shadows.

    Outdoors that is the sun, indoors a lamp as wide as the ceiling that shines straight down (a slanted one would leave
    the room in the shadow of its own walls), with a little of the sun besides, without shadows, so that walls differ.
    Together they are about as bright as the planar renderer's.
    """
    room = world.room
    reach = 0.5 * float(np.hypot(*room.size_m[:2])) + 1.0
    if room.enclosed:
        _add_light(spec, np.array([0.0, 0.0, room.size_m[2] - NEAREST_M]), np.array([0.0, 0.0, -1.0]), _LAMP, True)
        _add_light(spec, _SUNWARDS, -_SUNWARDS, _FILL, False)
    else:
        _add_light(spec, _SUNWARDS * (reach + room.size_m[2]), -_SUNWARDS, _LAMP + _FILL, True)
    head = spec.visual.headlight
    head.ambient, head.diffuse, head.specular = [_AMBIENT] * 3, [0.0] * 3, [0.0] * 3
    spec.visual.map.shadowclip = reach  # in units of the extent


def _add_light(spec: Any, start: Vector, direction: Vector, strength: float, shadows: bool) -> None:
    light = spec.worldbody.add_light(pos=start, dir=direction, castshadow=shadows)
    light.type = mujoco.mjtLightType.mjLIGHT_DIRECTIONAL
    light.ambient, light.diffuse, light.specular = [0.0] * 3, [strength] * 3, [0.0] * 3


def _visual(spec: Any) -> None:
    spec.stat.extent = 1.0  # so that distances in ``visual`` are metres
    spec.stat.center = [0.0, 0.0, 0.0]
    spec.visual.map.znear, spec.visual.map.zfar = NEAREST_M, FARTHEST_M
    spec.visual.quality.shadowsize = _SHADOW_TEXELS
    spec.visual.quality.offsamples = _MULTISAMPLES


def _chosen(quads: Quads, rows: NDArray[np.bool_]) -> Quads:
    return Quads(*(getattr(quads, field.name)[rows] for field in fields(Quads)))


def _one_sided(quads: Quads) -> Quads:
    """Those seen from both sides as two, back to back."""
    both = _chosen(quads, quads.two_sided)
    vectors = both.vectors.copy()
    vectors[:, :4], vectors[:, 4] = both.corners[:, ::-1], -both.normals
    back = replace(both, vectors=vectors)
    joined = concatenate([quads, back])
    return replace(joined, two_sided=np.zeros(len(joined), np.bool_))
