"""Gymnasium environments for one drone, or for many in one simulation, observed as numbers, images or both."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any, ClassVar, Final, Literal, get_args

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from skyloop.errors import MissingExtraError, UsageError
from skyloop.gym.tasks import (
    ACTIONS,
    MOTION,
    MOTIONS,
    OBSERVATIONS,
    PERIOD_S,
    Arena,
    Floats,
    Following,
    Hovering,
    Infos,
    Observation,
    Racing,
    Reaching,
)
from skyloop.sim.camera import look_at

#: Rings to draw, each with its centre in the cell [m], normal (None: facing the camera) and radius [m].
Rings = Iterable[tuple[Floats, Floats | None, float]]
Observe = Literal["state", "pixels", "both"]
#: An observation: a state vector, an image, or a dict with an image and the motion.
Seen = Observation | NDArray[np.uint8] | dict[str, NDArray[Any]]

SIZES_PX: Final = (16, 512)  #: smallest and largest edge length of an observed image
SIZE: Final = (320, 240)  #: width and height of a rendered image [px]
ONBOARD_PX: Final = 64  #: default edge length of the onboard camera's images
_FOCAL_PX: Final = 260.0  #: focal length of the rendering camera
_ONBOARD_FOCAL: Final = 40.0 / 64.0  # focal length divided by the edge length: 77° field of view
_FROM: Final = np.array([-5.5, -3.0, 3.2])  #: rendering camera's offset from the centre of the first cell's floor [m]
_AT: Final = np.array([0.0, 0.0, 1.8])  #: point at which the rendering camera looks, in the same axes [m]
_EYE_M: Final = np.array([0.12, 0.0, 0.0])  # onboard camera, just in front of the drone's body
_AHEAD: Final = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])  # rotates optical axes into body axes
_RED: Final = (40, 40, 230)  # the next goal's colour, BGR
_LATER: Final = (40, 160, 230)  # the following goal's colour, BGR
_NEAREST_M: Final = 0.05  #: near plane: rings with closer points are not drawn
_TURN: Final = np.linspace(0.0, 2.0 * np.pi, 25)
_CIRCLE: Final = np.stack([np.cos(_TURN), np.sin(_TURN)], axis=1)  # (25, 2)


class _Observer:
    """Makes observations in the requested form for all drones of a task."""

    def __init__(self, task: Reaching, form: Observe, size_px: int) -> None:
        if form not in get_args(Observe):
            raise UsageError(f"observe is {form!r} and must be one of {', '.join(get_args(Observe))}")
        least, most = SIZES_PX
        if isinstance(size_px, bool) or not isinstance(size_px, int) or not least <= size_px <= most:
            raise UsageError(f"size_px is {size_px!r} and must be a whole number from {least} to {most}")
        pixels = spaces.Box(0, 255, (size_px, size_px, 3), np.uint8)
        choices: dict[str, spaces.Space[Any]] = {
            "state": OBSERVATIONS,
            "pixels": pixels,
            "both": spaces.Dict({"pixels": pixels, "motion": MOTIONS}),
        }
        self.space = choices[form]  #: the observation space of one drone
        self._size_px = size_px
        self._task = task
        self._form = form
        self._camera: View | None = None

    def renew(self) -> None:
        """Switch to the new world, keeping the renderer because it is slow to create."""
        if self._camera is not None:
            self._camera.arena = self._task.arena

    def all(self) -> Any:
        """Return the observations of all drones, with a leading axis."""
        if self._form == "state":
            return self._task.observe()
        if self._camera is None:
            self._camera = on_board(self._task.arena, self._size_px)
        pixels = np.stack([self._camera.aboard(drone, self._task.rings(drone)) for drone in range(self._task.drones)])
        return pixels if self._form == "pixels" else {"pixels": pixels, "motion": self._task.observe()[:, MOTION]}

    def first(self) -> Seen:
        """Return the observation of the first drone."""
        found = self.all()
        return {name: rows[0] for name, rows in found.items()} if isinstance(found, dict) else found[0]


class TaskEnv(gymnasium.Env[Seen, NDArray[np.float32]]):
    """An environment with one drone and one task, which subclasses choose.

    An action, shape (4,), float32, from -1 to 1, lasts 40 ms: velocity forward, left and up in units of 1 m/s, and
    counter-clockwise turn rate in units of 1.5 rad/s. The observation with ``observe="state"``, shape (10,), float32:
    position of the goal (forward, left, up) [m]; the drone's own velocity estimate [m/s]; roll (positive right side
    down) and pitch (positive nose down) [rad]; sine and cosine of the turn to the desired heading. With ``"pixels"``:
    the front camera's image, RGB, shape (size_px, size_px, 3), uint8, showing the goal as a red ring. With ``"both"``:
    a dict of ``pixels`` and ``motion`` (velocity, roll and pitch). ``info`` contains ``is_success`` and ``distance_m``,
    including after a reset. Leaving the 7 m cell costs 5 and ends the episode. ``vehicle`` is one of
    ``skyloop.sim.vehicles.VEHICLES``. ``render_mode="rgb_array"`` renders an image of the drone and its goal.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": round(1 / PERIOD_S)}  # noqa: RUF012
    task: ClassVar[type[Reaching]]
    action_space = ACTIONS

    def __init__(
        self,
        *,
        seconds: float = 8.0,
        gusts_m_s: float = 0.3,
        observe: Observe = "state",
        size_px: int = ONBOARD_PX,
        vehicle: str = "quadrotor",
        render_mode: str | None = None,
    ) -> None:
        if render_mode not in (None, "rgb_array"):
            raise UsageError(f'render_mode is {render_mode!r} and must be "rgb_array" or None')
        self.render_mode = render_mode
        self._task = self.task(1, seconds, gusts_m_s, vehicle)
        self._observer = _Observer(self._task, observe, size_px)
        self.observation_space = self._observer.space
        self._picture: View | None = None

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Seen, dict[str, Any]]:
        super().reset(seed=seed, options=options)
        if seed is not None or not self._task.begun:
            self._task.begin(int(self.np_random.integers(2**31)))
            self._observer.renew()
        self._task.restart(np.array([True]), self.np_random)
        return self._observer.first(), _one(self._task.infos())

    def step(self, action: NDArray[np.float32]) -> tuple[Seen, float, bool, bool, dict[str, Any]]:
        rewards, ended, over, infos = self._task.step(np.asarray(action, dtype=float).reshape(1, 4))
        truncated = bool(over[0] and not ended[0])
        return self._observer.first(), float(rewards[0]), bool(ended[0]), truncated, _one(infos)

    def render(self) -> NDArray[np.uint8] | None:
        """Return an RGB image, shape (240, 320, 3), uint8; None if no render mode was chosen."""
        if self.render_mode is None:
            return None
        arena = self._task.arena
        if self._picture is None:
            self._picture = View(arena, *SIZE, _FOCAL_PX)
        self._picture.arena = arena
        return self._picture.outside(self._task.rings(0))


class TaskVectorEnv(VectorEnv[Any, NDArray[np.float32], NDArray[Any]]):
    """Many drones in one simulation, which is many times faster than one simulation per drone.

    Like :class:`TaskEnv`, but with a leading axis; a finished episode starts over in the next step
    (``AutoresetMode.NEXT_STEP``).
    """

    metadata = {"autoreset_mode": AutoresetMode.NEXT_STEP}  # noqa: RUF012
    task: ClassVar[type[Reaching]]

    def __init__(
        self,
        num_envs: int = 16,
        *,
        seconds: float = 8.0,
        gusts_m_s: float = 0.3,
        observe: Observe = "state",
        size_px: int = ONBOARD_PX,
        vehicle: str = "quadrotor",
    ) -> None:
        if isinstance(num_envs, bool) or not isinstance(num_envs, int) or not 1 <= num_envs <= 1000:
            raise UsageError(f"num_envs is {num_envs!r} and must be a whole number from 1 to 1000")
        self.num_envs = num_envs
        self._task = self.task(num_envs, seconds, gusts_m_s, vehicle)
        self._observer = _Observer(self._task, observe, size_px)
        self.single_action_space, self.single_observation_space = ACTIONS, self._observer.space
        self.action_space = batch_space(ACTIONS, num_envs)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self._ended = np.zeros(num_envs, dtype=np.bool_)

    def reset(
        self, *, seed: int | list[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed[0] if isinstance(seed, list) else seed, options=options)
        if seed is not None or not self._task.begun:
            self._task.begin(int(self.np_random.integers(2**31)))
            self._observer.renew()
        self._task.restart(np.ones(self.num_envs, dtype=np.bool_), self.np_random)
        self._ended[:] = False
        return self._observer.all(), dict(self._task.infos())

    def step(
        self, actions: NDArray[np.float32]
    ) -> tuple[Any, NDArray[Any], NDArray[Any], NDArray[Any], dict[str, Any]]:
        again = self._ended.copy()
        if again.any():
            self._task.restart(again, self.np_random)
        rewards, ended, over, infos = self._task.step(np.asarray(actions, dtype=float))
        # The first step of a new episode only resets it: it earns no reward and cannot end the episode.
        rewards[again], ended[again], over[again] = 0.0, False, False
        over &= ~ended
        self._ended = ended | over
        return self._observer.all(), rewards, ended, over, dict(infos)


def _one(infos: Infos) -> dict[str, Any]:
    return {name: values[0].item() for name, values in infos.items()}


class ReachEnv(TaskEnv):
    """Fly to a position and stay there. The reward is up to 0.1 per step, reduced by distance and jerky actions."""

    task = Reaching


class HoverEnv(TaskEnv):
    """Hold a position in gusts, with the same reward as :class:`ReachEnv`."""

    task = Hovering


class FollowEnv(TaskEnv):
    """Follow a walking target from 1.5 m away, keeping it in the middle of the image."""

    task = Following


class GatesEnv(TaskEnv):
    """Fly through four gates in order. Each gate and each metre of progress earns 1; the last gate ends the episode."""

    task = Racing


class ReachVectorEnv(TaskVectorEnv):
    """:class:`ReachEnv` for many drones."""

    task = Reaching


class HoverVectorEnv(TaskVectorEnv):
    """:class:`HoverEnv` for many drones."""

    task = Hovering


class FollowVectorEnv(TaskVectorEnv):
    """:class:`FollowEnv` for many drones."""

    task = Following


class GatesVectorEnv(TaskVectorEnv):
    """:class:`GatesEnv` for many drones."""

    task = Racing


class View:
    """Draws rings and one of an arena's drones. Other drones are not drawn: they share the world only to save time.

    Raises :class:`MissingExtraError` without OpenCV.
    """

    def __init__(self, arena: Arena, width: int, height: int, focal_px: float) -> None:
        try:
            from skyloop.sim.camera import CameraModel, CameraPose
            from skyloop.sim.render import PlanarRenderer, Scene, SceneState
        except ImportError:
            raise MissingExtraError("drawing the simulator's world", "sim") from None
        self.arena = arena  #: replaceable by any arena with as many drones: their worlds are identical
        self._model = CameraModel("view", width, height, 25.0, focal_px, focal_px, width / 2, height / 2)
        self._pose: Any = CameraPose
        self._state = SceneState
        self._renderer = PlanarRenderer(Scene(arena.world, 1))

    def outside(self, rings: Rings) -> NDArray[np.uint8]:
        """Draw the first drone for a human viewer, with the next goal as a red ring."""
        middle = np.array([*self.arena.centres[0], 0.0])
        return self._draw(0, middle + _FROM, look_at(_FROM, _AT), rings)

    def aboard(self, drone: int, rings: Rings) -> NDArray[np.uint8]:
        """Draw what a drone's front camera sees, with the next goal as a red ring."""
        positions, rotations = self.arena.poses()
        rotation = rotations[drone]
        return self._draw(drone, positions[drone] + rotation @ _EYE_M, rotation @ _AHEAD, rings)

    def _draw(self, drone: int, eye: Floats, rotation: Floats, rings: Rings) -> NDArray[np.uint8]:
        """Return an RGB image, shape (height, width, 3), uint8, as seen from a point in world axes."""
        import cv2

        positions, rotations = self.arena.poses()
        alone = self._state(positions[drone : drone + 1], rotations[drone : drone + 1])
        image = self._renderer.render(alone, self._pose(eye, rotation), self._model)
        middle = np.array([*self.arena.centres[drone], 0.0])
        for number, (centre, normal, radius) in reversed(list(enumerate(rings))):
            points = _circle(centre + middle, rotation[:, 2] if normal is None else normal, radius)
            seen = (points - eye) @ rotation
            if (seen[:, 2] < _NEAREST_M).any():
                continue
            pixels = self._model.fx * seen[:, :2] / seen[:, 2:] + [self._model.cx, self._model.cy]
            corners = np.round(np.clip(pixels, -4096, 4096)).astype(np.int32)
            cv2.polylines(image, [corners], True, _LATER if number else _RED, 2, cv2.LINE_AA)
        return np.ascontiguousarray(image[:, :, ::-1])


def on_board(arena: Arena, size_px: int = ONBOARD_PX) -> View:
    """Return the view of an arena's front cameras, with square images."""
    return View(arena, size_px, size_px, _ONBOARD_FOCAL * size_px)


def _circle(centre: Floats, normal: Floats, radius: float) -> Floats:
    """Return points on a circle perpendicular to a normal, shape (25, 3)."""
    x, y, z = normal.tolist()
    level = abs(z) < 0.9
    aside = np.array([y, -x, 0.0] if level else [0.0, z, -y]) / math.hypot(*((x, y) if level else (y, z)))
    a, b, c = aside.tolist()
    points: Floats = centre + radius * (_CIRCLE @ np.array([aside, [y * c - z * b, z * a - x * c, x * b - y * a]]))
    return points
