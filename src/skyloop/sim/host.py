"""A world with drones that keeps its own time and is rendered for the drones' observers (drivers and emulators)."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, Protocol

import numpy as np

from skyloop.clock import monotonic_ns, nanoseconds
from skyloop.errors import UsageError
from skyloop.sim.dynamics import STEP_S
from skyloop.sim.options import Pacer, SimOptions, SlownessWatch
from skyloop.sim.reports import Occurrence, OccurrenceKind, VehicleFeedback, VehicleTruth
from skyloop.sim.simulation import Simulation
from skyloop.sim.world import TargetState, Wind

if TYPE_CHECKING:
    from skyloop.sim.camera import CameraModel
    from skyloop.sim.camera_pipeline import Pipeline, PipelineCamera, Screen

TICK_S: Final = 0.008  #: time between batches of steps


@dataclass(frozen=True, slots=True)
class Report:
    """The estimated and true state of a drone, and the targets, at a point in time."""

    believed: VehicleFeedback
    truth: VehicleTruth
    targets: tuple[TargetState, ...]
    captured_ns: int


class Observer(Protocol):
    """Callbacks for a host, called on the thread that steps the world. They must return quickly and never raise."""

    def report(self, report: Report) -> None: ...

    def happened(self, occurrence: Occurrence) -> None: ...

    def wanted_fps(self, camera: str) -> float:
        """Return how many frames per second of this camera are in use: 0 for none, infinity for all."""

    def failed(self, error: Exception) -> None:
        """Handle a failure of the simulation, after which there are no more reports."""


class SimHost:
    """Several drones in one world, numbered from 0. Each has one :class:`Observer`: a driver or emulated firmware.

    The world is stepped while at least one observer is attached.
    """

    def __init__(self, options: SimOptions | None = None, drones: int = 1) -> None:
        """Load the world and place the drones in it."""
        self.drones = drones
        self.options = options or SimOptions()  #: options of the world and its drones
        world = self.options.load_world()
        self.wind = self.options.blowing(world.wind)  #: the current wind
        self.simulation = Simulation(
            world,
            drones,
            seed=self.options.seed,
            parameters=self.options.vehicle(),
            charge=self.options.battery,
            wind=self.wind,
        )
        self.stepping = threading.Lock()  #: held while stepping, because a thread that is ending may still be in a step
        self._lock = threading.Lock()
        #: Observers and cameras by drone; always replaced as a whole, never modified.
        self.observers: dict[int, tuple[Observer, tuple[PipelineCamera, ...]]] = {}
        self._stepper: Stepper | None = None

    def set_wind(self, wind: Wind) -> None:
        """Change the wind for all drones."""
        self.wind = wind
        self.simulation.set_wind(wind)

    def attach(
        self, drone: int, observer: Observer, screen: Screen, models: list[CameraModel]
    ) -> tuple[PipelineCamera, ...]:
        """Start reporting a drone to an observer and rendering its cameras. The first observer starts the world.

        Reports arrive on the thread that steps the world; ``screen`` receives the frames on the rendering thread.
        Raises UsageError if there is no such drone, or it already has an observer.
        """
        if not 0 <= drone < self.drones:
            raise UsageError(f"no drone {drone}: they are numbered from 0 to {self.drones - 1}")
        with self._lock:
            if drone in self.observers:
                raise UsageError(f"drone {drone} of this world is already taken")
            cameras = self._cameras(drone, screen, models)
            self.observers = {**self.observers, drone: (observer, cameras)}
            if self._stepper is None:
                self._stepper = self._make_stepper()
            return cameras

    def detach(self, drone: int, observer: Observer) -> None:
        """Stop reporting to an observer, or do nothing if a different one is attached. No report is running afterwards.

        The world stops when its last observer is detached.
        """
        with self._lock:
            entry = self.observers.get(drone)
            stepper = self._stepper
            if entry is None or entry[0] is not observer or stepper is None:
                return
            self.observers = {n: other for n, other in self.observers.items() if n != drone}
            last = not self.observers
            if last:
                self._stepper = None
        if last:
            stepper.stop()
        else:
            stepper.forget(entry[1])

    def _make_stepper(self) -> Stepper:
        return _RealTimeStepper(self)

    def _cameras(self, drone: int, screen: Screen, models: list[CameraModel]) -> tuple[PipelineCamera, ...]:
        if not models:
            return ()
        from skyloop.sim.camera_pipeline import PipelineCamera, Shutter

        cameras = []
        for place, model in enumerate(models, drone * len(models)):
            offset_s = self.simulation.time_s + place / (self.drones * len(models)) / model.fps
            cameras.append(PipelineCamera(model, drone, screen, self.options.seed * 1000 + place, Shutter(offset_s)))
        return tuple(cameras)


class Stepper(Protocol):
    """Steps a host's world while an observer is attached."""

    def stop(self) -> None: ...

    def forget(self, cameras: tuple[PipelineCamera, ...]) -> None:
        """Stop delivering frames from these cameras, after the current round of reports has ended."""


class ReportPublisher:
    """Publishes reports to a host's observers and, after each batch of steps, triggers the cameras that are due."""

    def __init__(self, host: SimHost, make_pipeline: Callable[[], Pipeline]) -> None:
        """Initialise the publisher; ``make_pipeline`` is called when the first frame is requested."""
        self.pipeline: Pipeline | None = None  #: created when a frame is requested for the first time
        self._host = host
        self._make_pipeline = make_pipeline
        self._period_ns = nanoseconds(1.0 / host.options.rate_hz)
        self._report_ns = 0

    def publish(self, captured_ns: int) -> None:
        """Publish the reports and exposures that are due at a time on the observers' clock."""
        simulation, observers = self._host.simulation, self._host.observers
        for occurrence in simulation.take_occurrences():
            if occurrence.drone in observers:
                observers[occurrence.drone][0].happened(occurrence)
        if captured_ns >= self._report_ns:
            self._report_ns = max(self._report_ns + self._period_ns, captured_ns)
            targets = simulation.target_states()
            for drone, (observer, _) in observers.items():
                report = Report(simulation.feedback(drone), simulation.truth(drone), targets, captured_ns)
                observer.report(report)
        self._expose(simulation.time_s, captured_ns)

    def _expose(self, now_s: float, captured_ns: int) -> None:
        due = [
            camera
            for observer, cameras in self._host.observers.values()
            for camera in cameras
            if camera.shutter.due(now_s, camera.model.fps)
            and camera.wanted(captured_ns, observer.wanted_fps(camera.model.name))
        ]
        if not due:
            return
        from skyloop.sim.camera_pipeline import expose
        from skyloop.sim.render import SceneState

        if self.pipeline is None:
            self.pipeline = self._make_pipeline()
        simulation = self._host.simulation
        positions, rotations = simulation.poses()
        state = SceneState(positions, rotations, simulation.target_states(), simulation.light())
        rates = {camera.drone: np.array(simulation.truth(camera.drone).angular_velocity_rad_s) for camera in due}
        speed = self._host.options.speed
        self.pipeline.expose([expose(camera, state, rates[camera.drone], captured_ns, speed) for camera in due])


class _RealTimeStepper:
    """Runs a world in real time: one thread steps it and publishes reports, and another thread renders."""

    def __init__(self, host: SimHost) -> None:
        self._host = host
        self._simulation = host.simulation
        self._publisher = ReportPublisher(host, self._start_pipeline)
        self._stop = threading.Event()
        self._publishing = threading.Lock()
        self._thread = threading.Thread(target=self._run, name="skyloop-sim", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        self._stop.set()
        if self._thread is not threading.current_thread():
            self._thread.join()
        if self._publisher.pipeline is not None:
            self._publisher.pipeline.stop()

    def forget(self, cameras: tuple[PipelineCamera, ...]) -> None:
        if self._thread is not threading.current_thread():
            with self._publishing:  # waits for the current round of reports
                pass
        if self._publisher.pipeline is not None:
            self._publisher.pipeline.forget(cameras)

    def _run(self) -> None:
        options, simulation = self._host.options, self._simulation
        with self._host.stepping:
            pacer = Pacer(simulation.step, speed=options.speed, most_lag_s=options.most_lag_s)
            slowness, begun_s = SlownessWatch(monotonic_ns()), simulation.time_s
            least_s = STEP_S if options.autopilot is not None else TICK_S  # firmware needs evenly timed steps
            try:
                while not self._stop.wait(max(pacer.run_due(), least_s)):
                    with self._publishing:
                        self._publisher.publish(pacer.clock_ns(simulation.time_s - begun_s))
                        if (share := slowness.update(pacer.lost_s, monotonic_ns())) is not None:
                            self._report_slowness(share)
            except Exception as error:  # noqa: BLE001 reported to every driver, as the thread must not end silently
                for observer, _ in self._host.observers.values():
                    observer.failed(error)

    def _report_slowness(self, share: float) -> None:
        speed = self._host.options.speed
        text = f"the computer is too slow for speed={speed:g}: the simulation runs at {share * speed:.2g}"
        for drone, (observer, _) in self._host.observers.items():
            observer.happened(Occurrence(OccurrenceKind.SLOW, drone, self._simulation.time_s, text))

    def _start_pipeline(self) -> Pipeline:
        from skyloop.sim.camera_pipeline import CameraPipeline

        options = self._host.options
        pipeline = CameraPipeline(self._simulation.world, self._host.drones, options.quality)
        pipeline.start()
        return pipeline
