"""The cameras of simulated drones: exposure times, and the thread that renders and delivers frames."""

from __future__ import annotations

import heapq
import itertools
import math
import threading
from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from typing import Final, Protocol

import numpy as np
from numpy.typing import NDArray

from skyloop.clock import monotonic_ns, nanoseconds, seconds
from skyloop.messages.subscription import RateLimiter
from skyloop.sim.camera import CameraModel, CameraPose
from skyloop.sim.render import PlanarRenderer, Quality, Scene, SceneState, SensorEffects
from skyloop.sim.world import World

_LONGEST_WAIT_S: Final = 0.5  # a notification or a due frame normally ends the rendering thread's wait sooner
#: Ratio of rendered to used frames if fewer frames are used than the camera takes. A consumer that selects frames by
#: its own count then always finds one in time.
RATE_MARGIN: Final = 1.25


class Screen(Protocol):
    """Receives the frames of a drone."""

    def show(self, model: CameraModel, pixels: NDArray[np.uint8], captured_ns: int) -> None: ...

    def failed(self, error: Exception) -> None: ...


class Shutter:
    """Decides when a camera exposes, using absolute simulation times. Pure."""

    def __init__(self, offset_s: float = 0.0) -> None:
        self._next_s = offset_s  # time of the first exposure
        self.count = 0  #: number of exposures so far, including those that were not rendered

    def due(self, now_s: float, fps: float) -> bool:
        """Return whether an exposure is due. Exposures that were missed during a pause are not made up for."""
        if now_s < self._next_s:
            return False
        self._next_s = max(self._next_s + 1.0 / fps, now_s + 0.5 / fps)
        self.count += 1
        return True


@dataclass(eq=False, slots=True)
class PipelineCamera:
    """A camera of a drone."""

    model: CameraModel
    drone: int
    screen: Screen
    seed: int
    shutter: Shutter
    dropped: int = 0  #: number of exposures superseded by newer ones before they were rendered
    gone: bool = False  #: whether the camera's observer was detached
    _effects: tuple[CameraModel, SensorEffects] | None = field(default=None, init=False)
    _limiter: RateLimiter = field(default_factory=lambda: RateLimiter(None), init=False)

    def wanted(self, captured_ns: int, fps: float) -> bool:
        """Return whether to render the exposure that is due, given the frames per second in use (0 to inf)."""
        if not fps:
            return False
        enough = fps * RATE_MARGIN
        self._limiter.max_hz = enough if enough < self.model.fps else math.inf
        return self._limiter.in_time(captured_ns)

    def finish(self, picture: NDArray[np.uint8], number: int, rates_rad_s: NDArray[np.float64]) -> NDArray[np.uint8]:
        """Apply the sensor's imperfections to an ideal image."""
        if self._effects is None or self._effects[0] is not self.model:
            self._effects = self.model, SensorEffects(self.model, self.seed)
        return self._effects[1].apply(picture, number, rates_rad_s)


@dataclass(frozen=True, slots=True, eq=False)
class Exposure:
    """A camera's view at a point in time, to be rendered."""

    camera: PipelineCamera
    model: CameraModel
    state: SceneState
    pose: CameraPose
    rates_rad_s: NDArray[np.float64]
    number: int
    captured_ns: int
    due_ns: int  #: time at which to deliver the frame


class Pipeline(ABC):
    """Renders exposures and delivers each frame when it is due."""

    def __init__(self) -> None:
        self._finished: list[tuple[int, int, Exposure, NDArray[np.uint8]]] = []  # a heap ordered by due time
        self._order = itertools.count()
        self._delivering = threading.RLock()  # reentrant, because a screen may detach its cameras during a delivery

    @abstractmethod
    def expose(self, exposures: list[Exposure]) -> None:
        """Render exposures."""

    @abstractmethod
    def stop(self) -> None:
        """End. Frames that have not been delivered are lost."""

    def hand_out(self, now_ns: int) -> None:
        """Deliver the frames that are due now."""
        while self._finished and self._finished[0][0] <= now_ns:
            _, _, exposure, picture = heapq.heappop(self._finished)
            with self._delivering:
                if not exposure.camera.gone:
                    exposure.camera.screen.show(exposure.model, picture, exposure.captured_ns)

    def forget(self, cameras: tuple[PipelineCamera, ...]) -> None:
        """Stop delivering frames from these cameras. After this returns, no other thread delivers any of them."""
        with self._delivering:
            for camera in cameras:
                camera.gone = True

    def _develop(self, renderer: PlanarRenderer, exposure: Exposure) -> None:
        picture = renderer.render(exposure.state, exposure.pose, exposure.model)
        picture = exposure.camera.finish(picture, exposure.number, exposure.rates_rad_s)
        heapq.heappush(self._finished, (exposure.due_ns, next(self._order), exposure, picture))


class CameraPipeline(Pipeline):
    """Renders each camera's newest exposure on a separate thread and delivers each frame when it is due.

    Creating the scene takes a few tenths of a second, so the pipeline is started when the first frame is requested.
    """

    def __init__(self, world: World, drones: int, quality: str) -> None:
        """Initialise without starting the thread; ``quality`` is ``fast``, ``smooth`` or ``best``."""
        super().__init__()
        self._world = world
        self._drones = drones
        self._quality = quality
        self._changed = threading.Condition()
        self._waiting: dict[PipelineCamera, Exposure] = {}  # the camera that has waited longest is first
        self._stopping = False
        self._thread = threading.Thread(target=self._run, name="skyloop-sim-cameras", daemon=True)

    def start(self) -> None:
        """Start the thread. The thread first creates the scene; meanwhile newer exposures replace older ones."""
        self._thread.start()

    def stop(self) -> None:
        """End the thread. Undelivered frames are lost."""
        with self._changed:
            self._stopping = True
            self._changed.notify()
        if self._thread is not threading.current_thread():
            self._thread.join()

    def expose(self, exposures: list[Exposure]) -> None:
        """Queue exposures. A new exposure replaces a waiting one of the same camera."""
        with self._changed:
            for exposure in exposures:
                if exposure.camera in self._waiting:
                    exposure.camera.dropped += 1
                self._waiting[exposure.camera] = exposure
            self._changed.notify()

    def _run(self) -> None:
        try:
            renderer = make_renderer(self._world, self._drones, self._quality)
        except Exception as error:  # noqa: BLE001  reported to the drivers, because no more frames will follow
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
        """Return the next exposure to render, delivering due frames while waiting; None means stop."""
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


class SteppedCameraPipeline(Pipeline):
    """Renders exposures immediately and delivers due frames on request, for a world that is stepped on one thread."""

    def __init__(self, world: World, drones: int, quality: str) -> None:
        super().__init__()
        self._renderer = make_renderer(world, drones, quality)

    def expose(self, exposures: list[Exposure]) -> None:
        for exposure in exposures:
            self._develop(self._renderer, exposure)

    def stop(self) -> None:
        """Drop the undelivered frames."""
        self._finished.clear()


def make_renderer(world: World, drones: int, quality: str) -> PlanarRenderer:
    """Create a renderer. Call this on the rendering thread, which owns the renderer."""
    return PlanarRenderer(Scene(world, drones), Quality(quality))


def expose(
    camera: PipelineCamera, state: SceneState, rates_rad_s: NDArray[np.float64], captured_ns: int, speed: float
) -> Exposure:
    """Return a camera's exposure for a state. The frame is due after the camera's latency."""
    model, drone = camera.model, camera.drone
    pose = model.pose(state.drone_positions_m[drone], state.drone_rotations[drone], drone)
    due_ns = captured_ns + nanoseconds(model.latency_s / speed)
    return Exposure(camera, model, state, pose, rates_rad_s, camera.shutter.count, captured_ns, due_ns)
