"""Drawing with the ``kernels``, compiled by Numba if it is installed: the same images, but several times faster.

Importing Numba takes almost a second, and the first compilation takes longer; from then on, the machine code is in
Numba's cache on disk. No image has to wait for either of these, because both happen on a separate thread.
"""

from __future__ import annotations

import atexit
import logging
import os
import threading
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from functools import partial
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from skyloop.sim.camera import BOTTOM_CAMERA, CameraModel, CameraPose
from skyloop.sim.render import kernels, shading
from skyloop.sim.render.painter import Painter, Raster
from skyloop.sim.render.quads import GAP, Atlas, AtlasBuilder, Floats, Image, QuadBuilder, Quads
from skyloop.sim.render.shading import EDGE_ON_M, PRIORITY_SHARE, Placed

_log = logging.getLogger(__name__)
_CONSTANTS: Final = np.array(
    [EDGE_ON_M, shading.AMBIENT, shading.DIRECT, shading.UNIT, shading.FOOTPRINT, *shading.TO_SUN], dtype=np.float64
)


@dataclass(frozen=True, slots=True)
class Kernels:
    """The functions of ``kernels``, uncompiled by default."""

    prepare: Callable[..., int] = kernels.prepare
    draw: Callable[..., None] = kernels.draw


KERNELS: Final = tuple(field.name for field in fields(Kernels))


class CompiledPainter(Painter):
    """Draws with the functions from ``kernels``."""

    def __init__(self, raster: Raster, model: CameraModel, atlas: Atlas, functions: Kernels) -> None:
        super().__init__(raster, model, atlas)
        grid = raster.grid
        self._do = functions
        texels = atlas.image.view(np.int32)
        # An overlapping view, in which each number is a texel and the next one.
        self._pairs = np.ndarray((texels.size - 1,), np.int64, texels.data, 0, (4,))
        self._grid = np.array([grid.width, grid.height, grid.fx, grid.fy, grid.cx, grid.cy], dtype=np.float64)
        self._fixed: tuple[NDArray[np.intp], Floats, Floats] | None = None
        self._rows_for, kept = _rows(raster)
        self._nearest = np.empty((kernels.BAND, grid.width), np.float32)
        self._numbers = np.empty((kernels.BAND, grid.width), np.int32)
        self._seen = np.empty((kept, grid.width), np.int16)

    def paint(
        self, quads: Quads, shown: NDArray[np.bool_], shadows: list[Placed], pose: CameraPose, picture: Image
    ) -> None:
        n, atlas = len(quads), self.atlas
        if self._fixed is None or self._fixed[0] is not quads.texture:  # these do not change while parts move
            weight: Floats = np.asarray(1.0 + PRIORITY_SHARE * quads.priority, dtype=np.float64)
            origin = np.stack([atlas.x0[quads.texture], atlas.y0[quads.texture], atlas.span[quads.texture]], axis=1)
            self._fixed = quads.texture, weight, origin
        else:
            _, weight, origin = self._fixed
        scene = (
            quads.vectors,
            quads.starts,
            quads.two_sided,
            quads.lit,
            shown,
            weight,
            quads.density,
            origin,
            np.asarray(pose.position_m, dtype=np.float64),
            np.asarray(pose.rotation, dtype=np.float64),
        )
        edges, planes, box = np.empty((n, 4, 3)), np.empty((n, 3)), np.empty((n, 4), np.int64)
        table = np.empty((13, n + 1), np.float32)
        # Contiguous arrays, because Numba would recompile the function for a different layout.
        whole = [np.ascontiguousarray(part) for part in scene]
        count = self._do.prepare(*whole, _CONSTANTS, self._grid, self.pixel_area, edges, planes, box, table)
        raster, pixels = self.raster, picture.shape[0] * picture.shape[1]
        self._do.draw(
            count,
            edges,
            planes,
            box,
            table,
            raster.samples,
            raster.to_grid,
            self._rows_for,
            raster.rays.x,
            raster.rays.y,
            raster.sample_x,
            raster.sample_y,
            self._nearest,
            self._numbers,
            self._seen,
            self._pairs,
            atlas.image.shape[:2],
            float(GAP),
            float(shading.FARTHEST),
            np.array([shadow.box for shadow in shadows], dtype=np.int64).reshape(-1, 4),
            np.ascontiguousarray(pose.rotation, dtype=np.float32),
            np.array([shadow.numbers for shadow in shadows], dtype=np.float32).reshape(-1, 7),
            picture,
            np.ndarray((pixels - 1,), np.int32, picture.data, 0, (3,)),
        )


def _rows(raster: Raster) -> tuple[NDArray[np.int64], int]:
    """Return the number of grid rows needed for each image row, and how many of the last grid rows to keep."""
    height, width = raster.rays.x.shape
    row = raster.lookup.reshape(height, width) // raster.grid.width
    # Include the row below, whose samples are needed and must be compared with those above.
    rows_for = np.minimum(np.maximum.accumulate(row.max(axis=1)) + 2, raster.grid.height).astype(np.int64)
    at_once = -(-kernels.BLOCK // width) + 1  # number of image rows
    first = np.minimum.accumulate(row.min(axis=1)[::-1])[::-1]
    bands = -(-rows_for // kernels.BAND) * kernels.BAND
    needed = max(bands[min(start + at_once, height) - 1] - first[start] for start in range(height))
    return rows_for, 1 << (int(needed) - 1).bit_length()


class Compiler:
    """Compiles the kernels once for this process, on a separate thread.

    When the process ends, it waits only for the function that is being compiled at that moment, not for all functions;
    LLVM must not be torn down while it is working. ``load`` returns kernels that are compiled on their first call;
    without Numba, it raises ``ImportError``.
    """

    def __init__(self, load: Callable[[], Kernels] | None = None) -> None:
        self.kernels: Kernels | None = None  #: None until compilation finishes
        self.problem = ""  #: reason why there are no kernels; empty while unknown
        self._load = load or load_kernels
        self._lock = threading.Lock()
        self._compiling = threading.Lock()
        self._thread: threading.Thread | None = None

    def start(self) -> threading.Thread:
        """Start compiling unless compilation has already been started; return the compiling thread."""
        with self._lock:
            if self._thread is None:
                self._thread = threading.Thread(target=self._run, name="skyloop-sim-compiler", daemon=True)
                atexit.register(partial(self._hold, os.getpid()))
                self._thread.start()
            return self._thread

    def _hold(self, process: int) -> None:
        """Block further compilation permanently, unless this is a forked child, which has no usable lock."""
        if process == os.getpid():
            self._compiling.acquire()

    def _run(self) -> None:
        try:
            functions = self._load()
            _draw_once(Kernels(*(self._one_by_one(getattr(functions, name)) for name in KERNELS)))
            self.kernels = functions
        except ImportError as error:
            self.problem = f"Numba is not installed: {error}"
        except Exception as error:  # noqa: BLE001 compilers raise all kinds of errors; drawing works without one
            self.problem = f"Numba can't compile here: {(str(error) or repr(error)).splitlines()[0]}"
            _log.warning("pictures are drawn without compiled code, which takes several times longer: %s", self.problem)

    def _one_by_one(self, function: Callable[..., Any]) -> Callable[..., Any]:
        def call(*args: object) -> object:
            with self._compiling:
                return function(*args)

        return call


def load_kernels() -> Kernels:
    """Return the kernels as Numba functions, which are compiled or loaded from the cache on their first call.

    Raise RuntimeError if Numba's cache is not writable, because every start would then spend seconds compiling.
    """
    import numba

    compile_ = numba.njit(cache=True, nogil=True, error_model="numpy")
    return Kernels(*(compile_(getattr(kernels, name)) for name in KERNELS))


def _draw_once(functions: Kernels) -> None:
    """Draw a tiny image, because Numba compiles a function on its first call with new types."""
    textures, shapes = AtlasBuilder(), QuadBuilder()
    grey = textures.add("grey", lambda: np.full((8, 8, 3), 128, np.uint8))
    shapes.rectangle((-1, -1, 0), (2, 0, 0), (0, 2, 0), grey)
    model = replace(BOTTOM_CAMERA, width=8, height=8, cx=3.5, cy=3.5)
    pose = model.pose(np.array([0.0, 0.0, 1.0]), np.eye(3))
    raster = Raster.of(model, samples=4)
    shadow = Placed((0, 8, 0, 8), np.eye(3, dtype=np.float32), np.ones(7, np.float32))
    painter = CompiledPainter(raster, model, textures.pack(), functions)
    painter.paint(shapes.build(), np.ones(1, np.bool_), [shadow], pose, np.empty((8, 8, 3), np.uint8))


#: The compiler shared by the whole process.
COMPILER: Final = Compiler()
