"""The cameras of simulated drones: when they expose, and the thread that renders and delivers their frames."""

from __future__ import annotations

import heapq
import itertools
import math
import threading
from dataclasses import dataclass, field
from typing import Final, Protocol

import numpy as np
from numpy.typing import NDArray

from skyloop.clock import monotonic_ns, nanoseconds, seconds
from skyloop.messages.subscription import RateLimiter
from skyloop.sim.camera import CameraModel, CameraPose
from skyloop.sim.render import PlanarRenderer, Quality, Scene, SceneState, SensorEffects
from skyloop.sim.world import World

_LONGEST_WAIT_S: Final = 0.5
#: Where fewer pictures are used than a camera takes, so many times as many are rendered: whoever chooses some of them,
#: by a count of its own, finds one in time.
SPARE: Final = 1.25


class Screen(Protocol):
    """Where a drone's frames go."""

    def show(self, model: CameraModel, pixels: NDArray[np.uint8], captured_ns: int) -> None: ...

    def failed(self, error: Exception) -> None: ...


class Exposing(Protocol):
    """What renders exposures, and delivers the frames when they are due."""

    def expose(self, exposures: list[Exposure]) -> None: ...

    def forget(self, cameras: tuple[Camera, ...]) -> None: ...

    def stop(self) -> None: ...


class Shutter:
    """Decides when a camera exposes, by absolute times of the simulation. Pure."""

    def __init__(self, offset_s: float = 0.0) -> None:
        """Set the time of the first exposure [s]."""
        self._next_s = offset_s
        self.count = 0  #: exposures so far, including those without an observer

    def due(self, now_s: float, fps: float) -> bool:
        """Whether it exposes now. After a pause it continues from here, without making up for missed exposures."""
        if now_s < self._next_s:
            return False
        self._next_s = max(self._next_s + 1.0 / fps, now_s + 0.5 / fps)
        self.count += 1
        return True


@dataclass(eq=False, slots=True)
class Camera:
    """One camera of one drone."""

    model: CameraModel
    drone: int
    screen: Screen
    seed: int
    shutter: Shutter
    dropped: int = 0  #: exposures that were replaced by a newer one before they were rendered
    gone: bool = False  #: whether its observer was detached
    _effects: tuple[CameraModel, SensorEffects] | None = field(default=None, init=False)
    _limiter: RateLimiter = field(default_factory=lambda: RateLimiter(None), init=False)

    def wanted(self, captured_ns: int, fps: float) -> bool:
        """Return whether the exposure that is due now is worth rendering.

        Args:
            captured_ns: When it is.
            fps: How many pictures a second are used: 0: none; infinity: all.
        """
        if not fps:
            return False
        enough = fps * SPARE
        self._limiter.max_hz = enough if enough < self.model.fps else math.inf
        return self._limiter.in_time(captured_ns)

    def finish(self, picture: NDArray[np.uint8], number: int, rates_rad_s: NDArray[np.float64]) -> NDArray[np.uint8]:
        """Apply the sensor's flaws to an ideal image."""
        if self._effects is None or self._effects[0] is not self.model:
            self._effects = self.model, SensorEffects(self.model, self.seed)
        return self._effects[1].apply(picture, number, rates_rad_s)


@dataclass(frozen=True, slots=True, eq=False)
class Exposure:
    """What a camera saw at one time, to be rendered."""

    camera: Camera
    model: CameraModel
    state: SceneState
    pose: CameraPose
    rates_rad_s: NDArray[np.float64]
    number: int
    captured_ns: int
    due_ns: int  #: when the frame is delivered


class _Frames:
    """Finished pictures, each delivered when it is due."""

    def __init__(self) -> None:
        self._finished: list[tuple[int, int, Exposure, NDArray[np.uint8]]] = []  # a heap by due time
        self._order = itertools.count()
        self._handing = threading.RLock()

    def hand_out(self, now_ns: int) -> None:
        """Deliver the frames that are due by then."""
        while self._finished and self._finished[0][0] <= now_ns:
            _, _, exposure, picture = heapq.heappop(self._finished)
            with self._handing:
                if not exposure.camera.gone:
                    exposure.camera.screen.show(exposure.model, picture, exposure.captured_ns)

    def forget(self, cameras: tuple[Camera, ...]) -> None:
        """Stop delivering frames of these cameras; on return no other thread delivers one."""
        with self._handing:
            for camera in cameras:
                camera.gone = True

    def _develop(self, renderer: PlanarRenderer, exposure: Exposure) -> None:
        picture = renderer.render(exposure.state, exposure.pose, exposure.model)
        picture = exposure.camera.finish(picture, exposure.number, exposure.rates_rad_s)
        heapq.heappush(self._finished, (exposure.due_ns, next(self._order), exposure, picture))


class CameraPipeline(_Frames):
    """Renders exposures on its own thread, the newest of each camera, and delivers each frame when it is due.

    The scene is created at the start, which takes some tenths of a second: start it when the first frame is wanted.
    """

    def __init__(self, world: World, drones: int, quality: str) -> None:
        """Initialise without starting the thread.

        Args:
            world: The world.
            drones: How many it has.
            quality: Of the images: ``fast``, ``smooth`` or ``best``.
        """
        super().__init__()
        self._world = world
        self._drones = drones
        self._quality = quality
        self._changed = threading.Condition()
        self._waiting: dict[Camera, Exposure] = {}  # oldest camera first
        self._stopping = False
        self._thread = threading.Thread(target=self._run, name="skyloop-sim-cameras", daemon=True)

    def start(self) -> None:
        """Start the thread; it creates the scene first, and exposures meanwhile are replaced by newer ones."""
        self._thread.start()

    def stop(self) -> None:
        """End the thread; frames that were not delivered yet are lost."""
        with self._changed:
            self._stopping = True
            self._changed.notify()
        if self._thread is not threading.current_thread():
            self._thread.join()

    def expose(self, exposures: list[Exposure]) -> None:
        """Queue exposures; each replaces one of the same camera that still waits."""
        with self._changed:
            for exposure in exposures:
                if exposure.camera in self._waiting:
                    exposure.camera.dropped += 1
                self._waiting[exposure.camera] = exposure
            self._changed.notify()

    def _run(self) -> None:
        try:
            renderer = make_renderer(self._world, self._drones, self._quality)
        except Exception as error:  # noqa: BLE001  reported to the drivers: there will be no frames
            with self._changed:
                screens = {camera.screen for camera in self._waiting}
            for screen in screens:
                screen.failed(error)
            return
        while (exposure := self._next()) is not None:
            try:
                self._develop(renderer, exposure)
            except Exception as error:  # noqa: BLE001  reported to the driver; the next frame may succeed
                exposure.camera.screen.failed(error)

    def _next(self) -> Exposure | None:
        """Return the next exposure to render, delivering meanwhile what is due; None to stop."""
        while True:
            self.hand_out(monotonic_ns())
            with self._changed:
                if self._stopping:
                    return None
                if self._waiting:
                    return self._waiting.pop(next(iter(self._waiting)))
                wait_s = _LONGEST_WAIT_S
                if self._finished:
                    wait_s = min(wait_s, seconds(self._finished[0][0] - monotonic_ns()))
                if wait_s > 0:
                    self._changed.wait(wait_s)


class SteppedCameraPipeline(_Frames):
    """Renders each exposure at once, and delivers what is due on demand, all on one thread.

    For a world whose time stands still between two steps.
    """

    def __init__(self, world: World, drones: int, quality: str) -> None:
        """Create the renderer."""
        super().__init__()
        self._renderer = make_renderer(world, drones, quality)

    def expose(self, exposures: list[Exposure]) -> None:
        """Render exposures."""
        for exposure in exposures:
            self._develop(self._renderer, exposure)

    def stop(self) -> None:
        """Drop the frames that were not delivered yet."""
        self._finished.clear()


def make_renderer(world: World, drones: int, quality: str) -> PlanarRenderer:
    """Create a renderer; to be called on the thread that renders, to which it belongs."""
    return PlanarRenderer(Scene(world, drones), Quality(quality))


def expose(
    camera: Camera, state: SceneState, rates_rad_s: NDArray[np.float64], captured_ns: int, speed: float
) -> Exposure:
    """Expose a camera to a state; the frame is due after the camera's latency."""
    model, drone = camera.model, camera.drone
    pose = model.pose(state.drone_positions_m[drone], state.drone_rotations[drone], drone)
    due_ns = captured_ns + nanoseconds(model.latency_s / speed)
    return Exposure(camera, model, state, pose, rates_rad_s, camera.shutter.count, captured_ns, due_ns)
