"""The renderer for machines with OpenGL: MuJoCo's, with cast shadows."""

from __future__ import annotations

import ctypes.util
import os
import sys
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from skyloop.errors import MissingExtraError, UnsupportedError, UsageError
from skyloop.messages.geometry import rotation_from_euler
from skyloop.sim.camera import CameraModel, CameraPose
from skyloop.sim.render.base import Image, SceneState
from skyloop.sim.render.brightness import dimmed
from skyloop.sim.render.opencv import cv2
from skyloop.sim.world import World

#: Ways to draw off screen, as MuJoCo names them in ``MUJOCO_GL``, and the library each needs.
_BACKENDS: Final = {"egl": "EGL", "osmesa": "OSMesa"}
_INSTALL: Final = (
    "install OpenGL for drawing off screen (on Debian and Ubuntu: apt-get install libegl1 libgl1-mesa-dri, or "
    "libosmesa6; MUJOCO_GL=egl or osmesa chooses between them), or take renderer=planar, which needs none"
)
_HIDDEN_M: Final = np.array([0.0, 0.0, -2000.0])
_FINER: Final = 2.0  # pixels of the larger picture to one behind a lens


def _load() -> Any:
    """MuJoCo, set to draw off screen. Its choice is made when it is imported, and it would look for a display."""
    if sys.platform == "linux" and "MUJOCO_GL" not in os.environ:
        backend = next((name for name, library in _BACKENDS.items() if ctypes.util.find_library(library)), None)
        if backend is None:
            raise UnsupportedError(f"the renderer mujoco finds neither EGL nor OSMesa here: {_INSTALL}")
        os.environ["MUJOCO_GL"] = backend
    try:
        import mujoco
    except ImportError as error:
        raise MissingExtraError("the renderer mujoco", "mujoco", cause=str(error)) from error
    except (AttributeError, OSError, RuntimeError) as error:  # what a half-installed OpenGL or a wrong MUJOCO_GL gives
        raise UnsupportedError(f"MuJoCo can't load OpenGL ({error}): {_INSTALL}") from error
    return mujoco


mujoco = _load()

from skyloop.sim.render.mujoco_model import FARTHEST_M, NEAREST_M, build_stage  # noqa: E402  only where MuJoCo is


def require_opengl() -> None:
    """Check that OpenGL works, by rendering an empty image.

    Raises:
        UnsupportedError: It does not work.
    """
    _open_context(mujoco.MjSpec().compile(), 16, 16).close()


def _open_context(model: Any, width: int, height: int) -> Any:
    """What draws pictures of a size, with an OpenGL context of its own in the calling thread."""
    model.vis.global_.offwidth, model.vis.global_.offheight = width, height
    try:
        return mujoco.Renderer(model, height, width)
    except (ImportError, AttributeError, OSError, RuntimeError, mujoco.FatalError) as error:
        raise UnsupportedError(f"MuJoCo can't draw {width}x{height} off screen ({error}): {_INSTALL}") from error


class MujocoRenderer:
    """Renders a world with a number of drones by MuJoCo. Implements :class:`~skyloop.sim.render.base.Renderer`.

    To be created, used and dropped in one thread, to which its OpenGL belongs. Creating it builds the model (some
    tenths of a second); the first image of each size creates an OpenGL context.

    Raises:
        UsageError: A texture, a marker dictionary or an id does not exist.
    """

    def __init__(self, world: World, drones: int = 1) -> None:
        self._world = world
        self._stage = build_stage(world, drones)
        self._data = mujoco.MjData(self._stage.model)
        self._rasters: dict[tuple[object, ...], _Raster] = {}
        self._contexts: dict[tuple[int, int], Any] = {}
        self._posed: tuple[SceneState, int | None] | None = None

    def render(self, state: SceneState, pose: CameraPose, model: CameraModel, out: Image | None = None) -> Image:
        """Render an image; see :meth:`skyloop.sim.render.base.Renderer.render`.

        Raises:
            UsageError: ``out`` or the state does not fit, or the model's distortion can't be inverted.
            UnsupportedError: OpenGL does not work.
        """
        shape = (model.height, model.width, 3)
        if out is None:
            out = np.empty(shape, np.uint8)
        elif out.shape != shape or out.dtype != np.uint8:
            raise UsageError(f"out is {out.dtype} of shape {out.shape}; this camera's image is uint8 of {shape}")
        raster = self._raster(model)
        self._put(state, pose.drone)
        context = self._context(raster.width, raster.height)
        context.update_scene(self._data)
        for camera in context.scene.camera:  # the two eyes, here in one place
            _aim(camera, pose, raster)
        picture = context.render()
        if raster.places is not None:
            picture = cv2.remap(picture, *raster.places, cv2.INTER_LINEAR)
        cv2.cvtColor(picture, cv2.COLOR_RGB2BGR, dst=out)
        return out if state.light == 1.0 else dimmed(out, state.light)

    def close(self) -> None:
        """Free what OpenGL holds, in the thread that used it; the renderer can be used again."""
        for context in self._contexts.values():
            context.close()
        self._contexts.clear()

    def _put(self, state: SceneState, hidden: int | None) -> None:
        """Everything where the state says it is, but for the body of the drone that carries the camera."""
        if self._posed is not None and self._posed[0] is state and self._posed[1] == hidden:
            return
        self._check(state)
        stage = self._stage
        for body, stand, now in zip(stage.targets, stage.stands, state.targets, strict=True):
            turn = rotation_from_euler(0.0, 0.0, now.yaw_rad)
            self._place(body, np.array(now.position_m), turn)
            if stand is not None:
                self._place(stand, np.array([now.position_m[0], now.position_m[1], 0.0]), turn)
        for number, drone in enumerate(stage.drones):
            position, rotation = state.drone_positions_m[number], state.drone_rotations[number]
            self._place(drone.upper, position, rotation)
            self._place(drone.rest, _HIDDEN_M if number == hidden else position, rotation)
        mujoco.mj_kinematics(stage.model, self._data)
        mujoco.mj_camlight(stage.model, self._data)
        self._posed = state, hidden

    def _place(self, body: int, position_m: NDArray[np.float64], rotation: NDArray[np.float64]) -> None:
        self._data.mocap_pos[body] = position_m
        mujoco.mju_mat2Quat(self._data.mocap_quat[body], np.ascontiguousarray(rotation).ravel())

    def _check(self, state: SceneState) -> None:
        drones, targets = len(self._stage.drones), len(self._stage.targets)
        shape = np.shape(state.drone_positions_m), np.shape(state.drone_rotations)
        if shape != ((drones, 3), (drones, 3, 3)):
            raise UsageError(
                f"the scene has {drones} drones: positions must be ({drones}, 3) and rotations ({drones}, 3, 3), not "
                f"{shape[0]} and {shape[1]}"
            )
        if len(state.targets) != targets:
            raise UsageError(f"the world has {targets} moving targets, the state {len(state.targets)}")

    def _raster(self, model: CameraModel) -> _Raster:
        key = (model.width, model.height, model.fx, model.fy, model.cx, model.cy, model.distortion)
        if key not in self._rasters:
            self._rasters[key] = _Raster.of(model)
        return self._rasters[key]

    def _context(self, width: int, height: int) -> Any:
        """What draws pictures of a size."""
        if (width, height) not in self._contexts:
            self._contexts[width, height] = _open_context(self._stage.model, width, height)
        return self._contexts[width, height]


@dataclass(frozen=True, slots=True)
class _Raster:
    """The image that OpenGL renders for a lens.

    Attributes ``left`` to ``bottom`` are x/z and y/z of its edges (y down); ``places`` is where in it each pixel of the
    lens lies, as ``cv2.remap`` takes it, None where it is the lens's own image.
    """

    width: int
    height: int
    left: float
    right: float
    top: float
    bottom: float
    places: tuple[NDArray[np.float32], NDArray[np.float32]] | None

    @staticmethod
    def of(model: CameraModel) -> _Raster:
        if not model.distorted:
            return _Raster.pinhole(model.width, model.height, model.fx, model.fy, model.cx, model.cy, None)
        x, y = np.meshgrid(np.arange(model.width), np.arange(model.height))
        rays = model.rays(np.column_stack([x.ravel(), y.ravel()]).astype(np.float64))
        fx, fy = _FINER * model.fx, _FINER * model.fy
        low = np.floor(rays.min(axis=0) * (fx, fy)) - 1.0
        high = np.ceil(rays.max(axis=0) * (fx, fy)) + 1.0
        places = (rays * (fx, fy) - low).reshape(model.height, model.width, 2).astype(np.float32)
        width, height = (int(n) for n in high - low + 1.0)
        maps = np.ascontiguousarray(places[..., 0]), np.ascontiguousarray(places[..., 1])
        return _Raster.pinhole(width, height, fx, fy, -float(low[0]), -float(low[1]), maps)

    @staticmethod
    def pinhole(
        width: int,
        height: int,
        fx: float,
        fy: float,
        cx: float,
        cy: float,
        places: tuple[NDArray[np.float32], NDArray[np.float32]] | None,
    ) -> _Raster:
        """Edges lie half a pixel outside of the centres of the outermost pixels."""
        left, right = (-0.5 - cx) / fx, (width - 0.5 - cx) / fx
        top, bottom = (-0.5 - cy) / fy, (height - 0.5 - cy) / fy
        return _Raster(width, height, left, right, top, bottom, places)


def _aim(camera: Any, pose: CameraPose, raster: _Raster) -> None:
    camera.pos = pose.position_m
    camera.forward = pose.rotation[:, 2]
    camera.up = -pose.rotation[:, 1]
    camera.frustum_near, camera.frustum_far = NEAREST_M, FARTHEST_M
    camera.frustum_center = NEAREST_M * 0.5 * (raster.left + raster.right)
    camera.frustum_width = NEAREST_M * 0.5 * (raster.right - raster.left)  # half of it, in spite of the name
    camera.frustum_top, camera.frustum_bottom = -NEAREST_M * raster.top, -NEAREST_M * raster.bottom
