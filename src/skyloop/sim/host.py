"""A world with its drones that keeps time and is drawn, for those who ride on the drones."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, Protocol

import numpy as np

from skyloop.clock import nanoseconds
from skyloop.errors import UsageError
from skyloop.sim.options import SimOptions
from skyloop.sim.pacing import Pacer
from skyloop.sim.reports import Occurrence, VehicleFeedback, VehicleTruth
from skyloop.sim.simulation import Simulation
from skyloop.sim.world import TargetState, Wind

if TYPE_CHECKING:
    from skyloop.sim.camera import CameraModel
    from skyloop.sim.studio import Camera, Exposing, Screen

TICK_S: Final = 0.008  #: of the clock: steps are done in bunches of so much


@dataclass(frozen=True, slots=True)
class Report:
    """A drone at one instant."""

    believed: VehicleFeedback
    truth: VehicleTruth
    targets: tuple[TargetState, ...]
    captured_ns: int


class Passenger(Protocol):
    """What a host calls, on the thread that steps the world. Must return quickly and never raise."""

    def report(self, report: Report) -> None: ...

    def happened(self, occurrence: Occurrence) -> None: ...

    def wants(self, camera: str) -> bool: ...

    def failed(self, error: Exception) -> None:
        """The simulation broke: nothing more will come."""


class SimHost:
    """Several drones in one world, numbered from 0, each for one :class:`Passenger`: a driver, or emulated firmware.

    The world is stepped while at least one of them is aboard. Raises :class:`UsageError` for a world that does
    not exist, can't be read, or has no place for so many drones.
    """

    def __init__(self, options: SimOptions | None = None, drones: int = 1) -> None:
        self.options = options or SimOptions()
        world = self.options.load_world()
        self.wind = self.options.blowing(world.wind)  #: what blows at present
        self.simulation = Simulation(
            world,
            drones,
            seed=self.options.seed,
            parameters=self.options.vehicle(),
            charge=self.options.battery,
            wind=self.wind,
        )
        self._lock = threading.Lock()
        self._passengers: dict[int, tuple[Passenger, tuple[Camera, ...]]] = {}  # replaced as a whole, never changed
        self._runner: Runner | None = None

    @property
    def drones(self) -> int:
        """How many there are."""
        return self.simulation.drones

    def set_wind(self, wind: Wind) -> None:
        """Another wind from now on, for all drones."""
        self.wind = wind
        self.simulation.set_wind(wind)

    def board(self, drone: int, passenger: Passenger, screen: Screen, models: list[CameraModel]) -> tuple[Camera, ...]:
        """Begin to tell a passenger about a drone and to draw its cameras; the first one starts the world.

        Raises :class:`UsageError` if there is no such drone or somebody else has it,
        :class:`skyloop.errors.MissingExtraError` or :class:`skyloop.errors.UnsupportedError` if cameras are wanted and
        what draws is not installed.
        """
        if not 0 <= drone < self.drones:
            raise UsageError(f"no drone {drone}: they are numbered from 0 to {self.drones - 1}")
        with self._lock:
            if drone in self._passengers:
                raise UsageError(f"drone {drone} of this world is taken already")
            cameras = self._cameras(drone, screen, models)
            self._passengers = {**self._passengers, drone: (passenger, cameras)}
            if self._runner is None:
                self._runner = self._make_runner()
            return cameras

    def leave(self, drone: int, passenger: Passenger) -> None:
        """Nothing more is told to this passenger when this returns; the last one to leave stops the world."""
        with self._lock:
            entry = self._passengers.get(drone)
            runner = self._runner
            if entry is None or entry[0] is not passenger or runner is None:
                return
            self._passengers = {n: other for n, other in self._passengers.items() if n != drone}
            last = not self._passengers
            if last:
                self._runner = None
        if last:
            runner.stop()
        else:
            runner.forget(entry[1])

    @property
    def passengers(self) -> dict[int, tuple[Passenger, tuple[Camera, ...]]]:
        """Who is told about which drone, and its cameras."""
        return self._passengers

    def _make_runner(self) -> Runner:
        return _Threads(self)

    def _cameras(self, drone: int, screen: Screen, models: list[CameraModel]) -> tuple[Camera, ...]:
        if not models:
            return ()
        from skyloop.sim.studio import Camera, Shutter, require_renderer

        require_renderer(self.options.renderer)
        cameras = []
        for n, model in enumerate(models):
            place = drone * len(models) + n
            offset_s = self.simulation.time_s + place / (self.drones * len(models)) / model.fps
            seed = self.options.seed * 1000 + place
            cameras.append(Camera(model, drone, screen, seed, Shutter(offset_s)))
        return tuple(cameras)


class Runner(Protocol):
    """What moves a host's world while somebody is aboard."""

    def stop(self) -> None: ...

    def forget(self, cameras: tuple[Camera, ...]) -> None:
        """When this returns the round of telling that was under way is over, and no picture of these cameras comes."""


class Teller:
    """What the passengers of a host are told, and which pictures are taken, after each bunch of steps."""

    def __init__(self, host: SimHost, make_studio: Callable[[], Exposing]) -> None:
        self.studio: Exposing | None = None  #: made when the first picture is wanted
        self._host = host
        self._make_studio = make_studio
        self._period_ns = nanoseconds(1.0 / host.options.rate_hz)
        self._report_ns = 0

    def tell(self, captured_ns: int) -> None:
        """``captured_ns``: what it is on the passengers' clock."""
        simulation, passengers = self._host.simulation, self._host.passengers
        for occurrence in simulation.take_occurrences():
            if occurrence.drone in passengers:
                passengers[occurrence.drone][0].happened(occurrence)
        if captured_ns >= self._report_ns:
            self._report_ns = max(self._report_ns + self._period_ns, captured_ns)
            targets = simulation.target_states()
            for drone, (passenger, _) in passengers.items():
                report = Report(simulation.feedback(drone), simulation.truth(drone), targets, captured_ns)
                passenger.report(report)
        self._expose(simulation.time_s, captured_ns)

    def _expose(self, now_s: float, captured_ns: int) -> None:
        due = [
            camera
            for passenger, cameras in self._host.passengers.values()
            for camera in cameras
            if camera.shutter.due(now_s, camera.model.fps) and passenger.wants(camera.model.name)
        ]
        if not due:
            return
        from skyloop.sim.render import SceneState
        from skyloop.sim.studio import expose

        if self.studio is None:
            self.studio = self._make_studio()
        simulation = self._host.simulation
        positions, rotations = simulation.poses()
        state = SceneState(positions, rotations, simulation.target_states())
        rates = {camera.drone: np.array(simulation.truth(camera.drone).angular_velocity_rad_s) for camera in due}
        speed = self._host.options.speed
        self.studio.expose([expose(camera, state, rates[camera.drone], captured_ns, speed) for camera in due])


class _Threads:
    """A world in real time: one thread steps it and tells, one draws."""

    def __init__(self, host: SimHost) -> None:
        self._host = host
        self._simulation = host.simulation
        self._pacer = Pacer(self._simulation.step, speed=host.options.speed)
        self._begun_s = self._simulation.time_s
        self._teller = Teller(host, self._start_studio)
        self._stop = threading.Event()
        self._telling = threading.Lock()
        self._thread = threading.Thread(target=self._run, name="skyloop-sim", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        self._stop.set()
        if self._thread is not threading.current_thread():
            self._thread.join()
        if self._teller.studio is not None:
            self._teller.studio.stop()

    def forget(self, cameras: tuple[Camera, ...]) -> None:
        if self._thread is not threading.current_thread():
            with self._telling:
                pass
        if self._teller.studio is not None:
            self._teller.studio.forget(cameras)

    def _run(self) -> None:
        try:
            while not self._stop.wait(max(self._pacer.run_due(), TICK_S)):
                with self._telling:
                    self._teller.tell(self._pacer.clock_ns(self._simulation.time_s - self._begun_s))
        except Exception as error:  # noqa: BLE001  told to every driver; a thread that dies in silence helps nobody
            for passenger, _ in self._host.passengers.values():
                passenger.failed(error)

    def _start_studio(self) -> Exposing:
        from skyloop.sim.studio import Studio

        options = self._host.options
        studio = Studio(self._simulation.world, self._host.drones, options.renderer, options.quality)
        studio.start()
        return studio
