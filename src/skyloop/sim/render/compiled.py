"""Drawing by the ``kernels``, compiled by Numba where it is installed: the picture of ``plain``, several times faster.

Importing Numba takes the better part of a second, and compiling some more; afterwards the machine code is in Numba's
cache on the disk. Neither holds up a picture: both happen on a thread of their own.
"""

from __future__ import annotations

import atexit
import logging
import threading
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from skyloop.sim.camera import BOTTOM_CAMERA, CameraModel, CameraPose
from skyloop.sim.render import kernels, shading
from skyloop.sim.render.atlas import GAP, Atlas, AtlasBuilder
from skyloop.sim.render.base import Image
from skyloop.sim.render.painter import Painter, Singles
from skyloop.sim.render.quads import QuadBuilder, Quads
from skyloop.sim.render.raster import Raster
from skyloop.sim.render.shadows import Placed
from skyloop.sim.render.visibility import EDGE_ON_M, PRIORITY_SHARE

_log = logging.getLogger(__name__)
_CONSTANTS: Final = np.array(
    [EDGE_ON_M, shading.AMBIENT, shading.DIRECT, shading.UNIT, shading.FOOTPRINT, *shading.TO_SUN], dtype=np.float64
)


@dataclass(frozen=True, slots=True)
class Kernels:
    """The functions of ``kernels``; by default as they are, uncompiled."""

    prepare: Callable[..., int] = kernels.prepare
    fill: Callable[..., None] = kernels.fill
    resolve: Callable[..., int] = kernels.resolve
    shade: Callable[..., None] = kernels.shade
    darken: Callable[..., None] = kernels.darken


KERNELS: Final = tuple(field.name for field in fields(Kernels))


class CompiledPainter(Painter):
    """Draws with kernels; see :class:`Painter`."""

    def __init__(self, raster: Raster, model: CameraModel, atlas: Atlas, functions: Kernels) -> None:
        super().__init__(raster, model, atlas)
        grid, pixels = raster.grid, raster.lookup.shape[1]
        self._do = functions
        self._texels = atlas.image.view(np.int32)[..., 0]
        self._grid = np.array([grid.width, grid.height, grid.fx, grid.fy, grid.cx, grid.cy], dtype=np.float64)
        self._lookup = raster.lookup.view(np.uint32)  # unsigned: no place is counted from the end
        self._nearest = np.empty((kernels.BAND, grid.width), np.float32)
        self._seen = np.empty((grid.height, grid.width), np.int32)
        self._numbers = np.empty(pixels, np.int32)
        self._mixed = np.empty(pixels, np.int32)

    def find(self, quads: Quads, shown: NDArray[np.bool_], pose: CameraPose) -> tuple[NDArray[np.int32], Singles]:
        """See :meth:`Painter.find`."""
        n, atlas = len(quads), self.atlas
        scene = (
            quads.corners,
            quads.normals,
            quads.u_slope,
            quads.v_slope,
            quads.u_start,
            quads.v_start,
            quads.two_sided,
            quads.lit,
            shown,
            1.0 + PRIORITY_SHARE * quads.priority,
            quads.density,
            np.stack([atlas.x0[quads.texture], atlas.y0[quads.texture], atlas.span[quads.texture]], axis=1),
            np.asarray(pose.position_m, dtype=np.float64),
            np.asarray(pose.rotation, dtype=np.float64),
        )
        edges, planes, box = np.empty((n, 4, 3)), np.empty((n, 3)), np.empty((n, 4), np.int64)
        table = np.empty((13, n + 1), np.float32)
        # In one piece each: of another layout Numba would compile the function anew.
        whole = [np.ascontiguousarray(part) for part in scene]
        count = self._do.prepare(*whole, _CONSTANTS, self._grid, self.pixel_area, edges, planes, box, table)
        self._do.fill(count, edges, planes, box, self._nearest, self._seen)
        return self._seen.reshape(-1), table

    def resolve(self, seen: NDArray[np.int32]) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
        """See :meth:`Painter.resolve`."""
        count = self._do.resolve(seen, self._lookup, self._numbers, self._mixed)
        return self._numbers, self._mixed[:count]

    def shade(
        self,
        table: Singles,
        numbers: NDArray[np.int32],
        ray_x: Singles,
        ray_y: Singles,
        colours: NDArray[np.uint8],
        inverse_depth: Singles,
    ) -> None:
        """See :meth:`Painter.shade`."""
        packed = colours.view(np.int32)[:, 0]
        farthest = float(shading.FARTHEST)
        self._do.shade(table, numbers, ray_x, ray_y, self._texels, float(GAP), farthest, packed, inverse_depth)

    def darken(self, picture: Image, shadow: Placed, inverse_depth: Singles) -> None:
        """See :meth:`Painter.darken`."""
        rays = self.raster.rays
        self._do.darken(picture, rays.x, rays.y, inverse_depth, shadow.box, shadow.axes, shadow.numbers)


class Compiler:
    """Compiles the kernels for this process, once, on a thread of its own.

    The end of the process doesn't wait for all of it, only for the function that is being compiled just then: LLVM must
    not lose the ground under its feet.

    Args:
        load: Returns them, compiled when they are called first. Raises ``ImportError`` where Numba is not installed.
    """

    def __init__(self, load: Callable[[], Kernels] | None = None) -> None:
        self.kernels: Kernels | None = None  #: once they are compiled
        self.problem = ""  #: why there are no kernels, once that is known
        self._load = load or load_kernels
        self._lock = threading.Lock()
        self._compiling = threading.Lock()
        self._thread: threading.Thread | None = None

    def start(self) -> threading.Thread:
        """Start the compiling unless it was; return its thread."""
        with self._lock:
            if self._thread is None:
                self._thread = threading.Thread(target=self._run, name="skyloop-sim-compiler", daemon=True)
                atexit.register(self._compiling.acquire)  # for good: no other function is begun
                self._thread.start()
            return self._thread

    def _run(self) -> None:
        try:
            functions = self._load()
            _draw_once(Kernels(*(self._one_by_one(getattr(functions, name)) for name in KERNELS)))
            self.kernels = functions
        except ImportError as error:
            self.problem = f"Numba is not there: {error}"
        except Exception as error:  # noqa: BLE001  of a compiler anything; the other way of drawing needs none
            self.problem = f"Numba can't compile here: {(str(error) or repr(error)).splitlines()[0]}"
            _log.warning("pictures are drawn without compiled code, which takes several times longer: %s", self.problem)

    def _one_by_one(self, function: Callable[..., Any]) -> Callable[..., Any]:
        def call(*args: object) -> object:
            with self._compiling:
                return function(*args)

        return call


def load_kernels() -> Kernels:
    """Return the kernels as Numba's functions, which it compiles, or loads from its cache, when they are called first.

    Raises:
        ImportError: Numba is not installed.
        RuntimeError: Its cache can't be written: without one each start would compile for seconds.
    """
    import numba

    compile_ = numba.njit(cache=True, nogil=True, error_model="numpy")
    return Kernels(*(compile_(getattr(kernels, name)) for name in KERNELS))


def _draw_once(functions: Kernels) -> None:
    """Draw a tiny picture, because Numba compiles a function when it is called with types that are new to it."""
    textures, shapes = AtlasBuilder(), QuadBuilder()
    grey = textures.add("grey", lambda: np.full((8, 8, 3), 128, np.uint8))
    shapes.rectangle((-1, -1, 0), (2, 0, 0), (0, 2, 0), grey)
    model = replace(BOTTOM_CAMERA, width=8, height=8, cx=3.5, cy=3.5)
    pose = model.pose(np.array([0.0, 0.0, 1.0]), np.eye(3))
    raster = Raster.of(model, samples=4)
    shadow = Placed((0, 8, 0, 8), np.eye(3, dtype=np.float32), np.ones(7, np.float32))
    painter = CompiledPainter(raster, model, textures.pack(), functions)
    painter.paint(shapes.build(), np.ones(1, np.bool_), [shadow], pose, np.empty((8, 8, 3), np.uint8))


#: Of this process.
COMPILER: Final = Compiler()
