"""The renderer's input and output, textured convex quadrilaterals stored as arrays, and shapes with their textures.

All textures are in one image; each has its smaller versions (mip levels) next to it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from skyloop.errors import MissingExtraError
from skyloop.sim.world import TargetState

try:
    import cv2
except ImportError as error:
    raise MissingExtraError("the simulator", "sim", cause=str(error)) from error

__all__ = ["cv2"]  # re-exported; all other names are defined in this module

Image = NDArray[np.uint8]  # BGR, shape (height, width, 3)


@dataclass(frozen=True, slots=True, eq=False)
class SceneState:
    """The poses of all moving objects at a point in time.

    The renderer may cache results for as long as it receives the same state object, so the arrays of a state must not
    be modified afterwards.
    """

    drone_positions_m: NDArray[np.float64]  #: positions of the bodies' origins in world axes, shape (n, 3)
    drone_rotations: NDArray[np.float64]  #: world from body, shape (n, 3, 3)
    targets: tuple[TargetState, ...] = ()  #: one state for each target in the world, in the world's order
    #: Brightness of the whole image, where 1 means full brightness. See :class:`~skyloop.sim.world.Light`.
    light: float = 1.0


LEVELS = 7  # sizes of each texture: the full one, and six that are each half as large
BORDER = 4  # pixels repeated around each level, so that interpolation at the edge stays within the level
GAP = 2 * BORDER
_STEP = 1 << (LEVELS - 1)  # padded sizes are multiples of this step, so that every level can be halved exactly
_LIMIT = 32000  # cv2.remap accepts source images of at most 32767 pixels per side


@dataclass(frozen=True, slots=True)
class Texture:
    """A texture's number in the atlas and its size in texels."""

    index: int
    width: int
    height: int


@dataclass(frozen=True, slots=True)
class Atlas:
    """All textures in one image. Level k of a texture starts at column x0 + span (1 - 2^-k) + GAP k."""

    image: NDArray[np.uint8]  #: the image in BGRA (OpenCV samples four channels twice as fast as three)
    x0: NDArray[np.float64]  #: column where each texture's level 0 starts; float64, shape (number of textures,)
    y0: NDArray[np.float64]  #: row where each texture's level 0 starts; same type and shape
    span: NDArray[np.float64]  #: twice the padded width of each texture


class AtlasBuilder:
    """Collects textures by key, draws each one once, and packs them."""

    def __init__(self) -> None:
        self._known: dict[object, Texture] = {}
        self.images: list[Image] = []  #: textures added so far, in the order of their numbers, BGR, shape (h, w, 3)

    def add(self, key: object, make: Callable[[], NDArray[np.uint8]]) -> Texture:
        """Return the texture for ``key``. If there is none yet, ``make`` draws the texture (BGR, shape (h, w, 3))."""
        if key not in self._known:
            image = make()
            self._known[key] = Texture(len(self.images), image.shape[1], image.shape[0])
            self.images.append(image)
        return self._known[key]

    def pack(self) -> Atlas:
        """Pack all textures on shelves, starting with the tallest."""
        sizes = [(_padded(i.shape[1]), _padded(i.shape[0])) for i in self.images]
        width = max(2048, *(_footprint(w) for w, _ in sizes))
        spots: dict[int, tuple[int, int]] = {}
        x = y = shelf = 0
        for k in sorted(range(len(sizes)), key=lambda k: (-sizes[k][1], k)):
            w, h = sizes[k]
            if x + _footprint(w) > width:
                x, y, shelf = 0, y + shelf, 0
            spots[k] = (x + BORDER, y + BORDER)
            x += _footprint(w)
            shelf = max(shelf, h + GAP)
        height = y + shelf
        if width > _LIMIT or height > _LIMIT:
            raise ValueError(f"the scene's textures need {width}x{height} texels, more than {_LIMIT} a side")
        image = np.zeros((height, width, 4), np.uint8)
        for k, source in enumerate(self.images):
            _place(image, source, *spots[k], *sizes[k])
        corners = np.array([spots[k] for k in range(len(sizes))], dtype=np.float64)
        span = np.array([2.0 * w for w, _ in sizes])
        return Atlas(image, corners[:, 0].copy(), corners[:, 1].copy(), span)


def _padded(side: int) -> int:
    return -(-side // _STEP) * _STEP


def _footprint(padded_width: int) -> int:
    return 2 * padded_width + GAP * LEVELS


def _place(image: NDArray[np.uint8], source: NDArray[np.uint8], x: int, y: int, width: int, height: int) -> None:
    level = cv2.cvtColor(source, cv2.COLOR_BGR2BGRA)
    rows, columns = height - level.shape[0], width - level.shape[1]
    level = cv2.copyMakeBorder(level, 0, rows, 0, columns, cv2.BORDER_REPLICATE)
    for number in range(LEVELS):
        framed = cv2.copyMakeBorder(level, BORDER, BORDER, BORDER, BORDER, cv2.BORDER_REPLICATE)
        left = x + 2 * (width - level.shape[1]) + GAP * number - BORDER
        image[y - BORDER : y - BORDER + framed.shape[0], left : left + framed.shape[1]] = framed
        if number < LEVELS - 1:
            level = cv2.resize(level, (level.shape[1] // 2, level.shape[0] // 2), interpolation=cv2.INTER_AREA)


Floats = NDArray[np.float64]
_CORNERS = 4  # number of corners, a quad's first vectors; the normal and the slopes of u and v follow


@dataclass(frozen=True, slots=True)
class Quads:
    """``n`` flat convex quadrilaterals. A triangle is stored with one corner repeated.

    The texel of a point X in the plane is u = ``u_slope · X + u_start`` to the right and v = ``v_slope · X + v_start``
    down from the texture's top left corner.
    """

    vectors: Floats  #: corners, normal, slopes of u and of v, in one array to move them together, (n, 7, 3)
    starts: Floats  #: offsets of u and v, (n, 2) [texel]
    texture: NDArray[np.intp]  #: number in the atlas, (n,)
    two_sided: NDArray[np.bool_]  #: whether the quad is also visible from behind, (n,)
    priority: NDArray[np.intp]  #: priority, (n,); the quad with the highest priority in a plane is visible
    lit: NDArray[np.bool_]  #: whether the quad is brighter when it faces the light, (n,); false for the sky
    density: Floats  #: texels per area, (n,) [texel/m²]

    def __len__(self) -> int:
        return len(self.vectors)

    @property
    def corners(self) -> Floats:
        """Corners [m], (n, 4, 3), counter-clockwise as seen from the front."""
        return self.vectors[:, :_CORNERS]

    @property
    def normals(self) -> Floats:
        """Unit normals that point to the front, (n, 3)."""
        return self.vectors[:, _CORNERS]

    @property
    def u_slope(self) -> Floats:
        """Slope of u [texel/m], (n, 3)."""
        return self.vectors[:, _CORNERS + 1]

    @property
    def v_slope(self) -> Floats:
        """Slope of v [texel/m], (n, 3)."""
        return self.vectors[:, _CORNERS + 2]

    @property
    def u_start(self) -> Floats:
        """Value of u at the origin [texel], (n,)."""
        return self.starts[:, 0]

    @property
    def v_start(self) -> Floats:
        """Value of v at the origin [texel], (n,)."""
        return self.starts[:, 1]

    def joined(self, other: Quads) -> Quads:
        """Return these quads with other quads appended."""
        return concatenate([self, other])

    def moved(self, position_m: Floats, rotation: Floats) -> Quads:
        """Return the same quads after a rotation (3, 3) and a translation (3,)."""
        return moved_each(self, position_m[None], rotation[None])


def moved_each(many: Quads, positions_m: Floats, rotations: Floats) -> Quads:
    """Return quads of ``n`` equal bodies, body by body, each after a rotation (n, 3, 3) and a translation (n, 3)."""
    vectors, starts = np.empty_like(many.vectors), np.empty_like(many.starts)
    move_each(many, positions_m, rotations, vectors, starts)
    return replace(many, vectors=vectors, starts=starts)


def move_each(many: Quads, positions_m: Floats, rotations: Floats, vectors: Floats, starts: Floats) -> None:
    """Write the vectors and starts of :func:`moved_each` into contiguous arrays of the same shape."""
    bodies = len(positions_m)
    np.matmul(many.vectors.reshape(bodies, -1, 3), rotations.transpose(0, 2, 1), out=vectors.reshape(bodies, -1, 3))
    of_bodies = vectors.reshape(bodies, -1, _CORNERS + 3, 3)
    of_bodies[:, :, :_CORNERS] += positions_m[:, None, None]
    under = np.matmul(of_bodies[:, :, _CORNERS + 1 :].reshape(bodies, -1, 3), positions_m[:, :, None])
    np.subtract(many.starts, under.reshape(starts.shape), out=starts)


def concatenate(parts: list[Quads]) -> Quads:
    """Return all quads from several batches, in order."""
    return Quads(*(np.concatenate([getattr(part, field.name) for part in parts]) for field in fields(Quads)))


class QuadBuilder:
    """Collects quads one at a time."""

    def __init__(self) -> None:
        self._rows: list[tuple[Floats, Floats, Floats, Floats, float, float, int, bool, int, bool]] = []

    def rectangle(
        self,
        lower_left: ArrayLike,
        right: ArrayLike,
        up: ArrayLike,
        texture: Texture,
        *,
        two_sided: bool = False,
        priority: int = 0,
        lit: bool = True,
        uv: tuple[float, float, float, float] | None = None,
    ) -> None:
        """Add a rectangle as seen from the front: its lower left corner and its edges to the right and upwards [m].

        Of the quads in a plane, the one with the highest priority is visible; a ``lit`` quad is brighter when it faces
        the light. ``uv`` is the visible part of the texture (left, top, right, bottom in texels); None for all of it.
        """
        origin, e_right, e_up = (np.asarray(v, dtype=np.float64) for v in (lower_left, right, up))
        corners = np.array([origin, origin + e_right, origin + e_right + e_up, origin + e_up])
        self.polygon(corners, origin, e_right, e_up, texture, two_sided=two_sided, priority=priority, lit=lit, uv=uv)

    def polygon(
        self,
        corners: ArrayLike,
        lower_left: Floats,
        right: Floats,
        up: Floats,
        texture: Texture,
        *,
        two_sided: bool = False,
        priority: int = 0,
        lit: bool = True,
        uv: tuple[float, float, float, float] | None = None,
    ) -> None:
        """Add a quad (4, 3) cut from the textured rectangle that is defined by the corner and the two edges."""
        left, top, u_end, bottom = uv or (0.0, 0.0, float(texture.width), float(texture.height))
        normal = np.cross(right, up)
        u_slope = right * ((u_end - left) / (right @ right))
        v_slope = up * ((top - bottom) / (up @ up))
        self._rows.append(
            (
                np.asarray(corners, dtype=np.float64),
                normal / np.linalg.norm(normal),
                u_slope,
                v_slope,
                left - float(u_slope @ lower_left),
                bottom - float(v_slope @ lower_left),
                texture.index,
                two_sided,
                priority,
                lit,
            )
        )

    def box(
        self, low: ArrayLike, high: ArrayLike, sides: Texture | tuple[Texture, Texture], ends: Texture | None = None
    ) -> None:
        """Add an upright box that is visible from outside and extends from its lowest to its highest corner [m].

        A pair of ``sides`` holds the textures of the faces normal to x and to y; ``ends`` is for top and bottom, and by
        default the texture of the faces normal to x.
        """
        (x0, y0, z0), (x1, y1, z1) = np.asarray(low, dtype=np.float64), np.asarray(high, dtype=np.float64)
        dx, dy, dz = x1 - x0, y1 - y0, z1 - z0
        for_x, for_y = sides if isinstance(sides, tuple) else (sides, sides)
        ends = ends or for_x
        self.rectangle((x1, y0, z0), (0, dy, 0), (0, 0, dz), for_x)
        self.rectangle((x0, y1, z0), (0, -dy, 0), (0, 0, dz), for_x)
        self.rectangle((x1, y1, z0), (-dx, 0, 0), (0, 0, dz), for_y)
        self.rectangle((x0, y0, z0), (dx, 0, 0), (0, 0, dz), for_y)
        self.rectangle((x0, y0, z1), (dx, 0, 0), (0, dy, 0), ends)
        self.rectangle((x0, y1, z0), (dx, 0, 0), (0, -dy, 0), ends)

    def disc(self, centre: ArrayLike, radius_m: float, texture: Texture) -> None:
        """Add a level regular octagon, with the whole texture on its enclosing square, visible from both sides."""
        middle = np.asarray(centre, dtype=np.float64)
        angle = np.pi / 8 + np.arange(8) * (np.pi / 4)
        rim = middle + radius_m * np.column_stack([np.cos(angle), np.sin(angle), np.zeros(8)])
        start = middle - (radius_m, radius_m, 0.0)
        right, up = np.array([2 * radius_m, 0.0, 0.0]), np.array([0.0, 2 * radius_m, 0.0])
        for a, b, c, d in ((0, 1, 2, 3), (0, 3, 4, 7), (4, 5, 6, 7)):
            self.polygon(rim[[a, b, c, d]], start, right, up, texture, two_sided=True)

    def build(self) -> Quads:
        """Return the collected quads."""
        corners, normals, u_slope, v_slope, u_start, v_start, texture, two_sided, priority, lit = zip(
            *self._rows, strict=True
        )
        return Quads(
            np.concatenate([np.array(corners), np.array([normals, u_slope, v_slope]).transpose(1, 0, 2)], axis=1),
            np.array([u_start, v_start], dtype=np.float64).T.copy(),
            np.array(texture, dtype=np.intp),
            np.array(two_sided, dtype=np.bool_),
            np.array(priority, dtype=np.intp),
            np.array(lit, dtype=np.bool_),
            np.linalg.norm(np.cross(u_slope, v_slope), axis=1),
        )
