"""``skyloop bench sim``: the simulator on this machine, its physics alone and the drawing of its cameras."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import msgspec
import numpy as np

from skyloop.bench.contract import Image
from skyloop.bench.machine import Machine
from skyloop.bench.statistics import Spread, spread
from skyloop.clock import monotonic_ns, nanoseconds
from skyloop.messages import Takeoff, Velocity
from skyloop.sim import STEP_S, Simulation, load_world
from skyloop.sim.camera import BOTTOM_CAMERA, FRONT_CAMERA, CameraModel
from skyloop.sim.firmware import Readings
from skyloop.sim.render import PlanarRenderer, Scene, SceneState, SensorEffects, use_one_core
from skyloop.sim.render.compiled import COMPILER
from skyloop.sim.render.opencv import cv2
from skyloop.sim.vehicles import VEHICLES

DRAWING_WORLD = "room"  #: furnished, with markers and a moving board


@dataclass(frozen=True, slots=True)
class Fleet:
    """Drones in a world: their model, and whether firmware flies them, which gets all instruments' readings."""

    world: str
    drones: int
    model: str = "quadrotor"
    firmware: bool = False
    target: float | None = None  #: simulated seconds a second, which this project holds itself to


#: Free flight in an open hall, and a hundred crowded among gates, some of which they touch; then drones that are
#: modelled down to their rotors in steps of a millisecond, one of them with all its instruments, in 60 µs at most each.
FLEETS = (
    Fleet("empty", 1, target=100.0),
    Fleet("empty", 10),
    Fleet("empty", 100, target=20.0),
    Fleet("gates", 100, target=20.0),
    Fleet("empty", 1, "racer", firmware=True, target=1000 / 60),
    Fleet("street", 1, "racer", firmware=True, target=1000 / 60),
    Fleet("empty", 100, "crazyflie", target=1.0),
)
SIZES = (1.0, 2.0)  #: pictures as wide as the cameras' own, and twice as wide
CAMERAS_AT_ONCE = 10
FRAMES_PER_S = 30.0  #: of each camera, by which the drones fly on between pictures
#: Whole cycles of everything that is done every so many steps, so that every batch does the same work.
BATCH_STEPS = 100
LEAST_ROUNDS = 3  #: however short the time

#: What this project holds itself to: pictures a second on one core with the extra ``fast``, front and bottom in turn,
#: by the width of the picture, …
FRAMES_TARGETS = {320: 312.0, 640: 91.0}
#: … and of the cameras at once, 25 a second of each.
MANY_FRAMES_TARGET = 25.0 * CAMERAS_AT_ONCE

_TAKE_OFF_S = 5.0
#: Circles of half a metre, so fast that the pictures of the front camera are smeared by the turning.
_CIRCLING = Velocity(forward=0.5, yaw_rate=1.0)

Progress = Callable[[float], None]


class PhysicsRow(msgspec.Struct, frozen=True):
    """Drones that fly circles, or that firmware flies straight up and down, with nothing drawn.

    ``step`` is the time of a step, taken from batches of :data:`BATCH_STEPS`.
    """

    world: str
    drones: int
    step: Spread
    real_time: float  #: simulated seconds a second
    target: float | None
    model: str = "quadrotor"
    firmware: bool = False


class DrawingRow(msgspec.Struct, frozen=True):
    """Pictures with the flaws of the sensor. ``round``: the time that ``pictures`` of them take."""

    cameras: str
    width: int
    height: int
    pictures: int
    round: Spread
    frames_per_s: float
    target: float | None


class SimResults(msgspec.Struct, frozen=True):
    """A whole run."""

    machine: Machine
    physics: list[PhysicsRow]
    drawing: list[DrawingRow]


def measure(seconds: float, progress: Progress = lambda _: None) -> SimResults:
    """Measure physics and drawing in the calling thread, to which OpenCV is kept meanwhile.

    Where Numba is installed, pictures are drawn by compiled code from the first on.

    Args:
        seconds: About how long, beside the time for making the scenes [s].
        progress: Called with the share that is done, 0 to 1.
    """
    parts = len(FLEETS) + len(SIZES) + 1
    share_s = seconds / parts
    physics: list[PhysicsRow] = []
    drawing: list[DrawingRow] = []

    def part(number: int) -> Progress:
        return lambda share: progress((number + share) / parts)

    COMPILER.start().join()
    with _one_core():
        for number, fleet in enumerate(FLEETS):
            physics.append(measure_physics(fleet, share_s, part(number)))
        for number, factor in enumerate(SIZES, len(FLEETS)):
            drawing += measure_pair(factor, share_s, part(number))
        drawing.append(measure_many(share_s, part(parts - 1)))
    return SimResults(Machine.here(), physics, drawing)


def measure_physics(fleet: Fleet, seconds: float, progress: Progress) -> PhysicsRow:
    """Step a world full of flying drones.

    Args:
        fleet: The drones.
        seconds: How long [s].
        progress: Called with the share that is done, 0 to 1.
    """
    simulation = _flown_by_firmware(fleet) if fleet.firmware else _circling(fleet.world, fleet.drones, fleet.model)
    batches: list[int] = []
    for _ in rounds(seconds, progress):
        begin = monotonic_ns()
        simulation.step(BATCH_STEPS)
        batches.append(monotonic_ns() - begin)
    step = spread([ns / BATCH_STEPS for ns in batches])
    simulated_s = len(batches) * BATCH_STEPS * STEP_S
    real_time = simulated_s / (sum(batches) * 1e-9)
    return PhysicsRow(fleet.world, fleet.drones, step, real_time, fleet.target, fleet.model, fleet.firmware)


def measure_pair(factor: float, seconds: float, progress: Progress) -> list[DrawingRow]:
    """Draw the two cameras of one drone in turn.

    Args:
        factor: How many times as wide as usual the pictures are.
        seconds: How long [s].
        progress: Called with the share that is done, 0 to 1.
    """
    models = [FRONT_CAMERA.scaled(factor), BOTTOM_CAMERA.scaled(factor)]
    flight = Flight(1, [(0, model) for model in models])
    front: list[int] = []
    bottom: list[int] = []
    for _ in rounds(seconds, progress):
        front.append(flight.draw(0))
        bottom.append(flight.draw(1))
    together = [a + b for a, b in zip(front, bottom, strict=True)]
    target = FRAMES_TARGETS.get(models[0].width)
    return [
        _drawing_row("front", models[0], 1, front),
        _drawing_row("bottom", models[1], 1, bottom),
        _drawing_row("front and bottom", models[0], 2, together, target),
    ]


def measure_many(seconds: float, progress: Progress) -> DrawingRow:
    """Draw the front cameras of ten drones that see one another.

    Args:
        seconds: How long [s].
        progress: Called with the share that is done, 0 to 1.
    """
    flight = Flight(CAMERAS_AT_ONCE, [(drone, FRONT_CAMERA) for drone in range(CAMERAS_AT_ONCE)])
    times = [sum(flight.draw(n) for n in range(CAMERAS_AT_ONCE)) for _ in rounds(seconds, progress)]
    return _drawing_row(f"{CAMERAS_AT_ONCE} × front", FRONT_CAMERA, CAMERAS_AT_ONCE, times, MANY_FRAMES_TARGET)


@dataclass(frozen=True, slots=True)
class _Camera:
    drone: int
    model: CameraModel
    effects: SensorEffects


class Flight:
    """Drones that circle in the furnished room, and their cameras, which expose one after the other.

    Args:
        drones: How many.
        cameras: The drone and the model of each.
    """

    def __init__(self, drones: int, cameras: list[tuple[int, CameraModel]]) -> None:
        self._simulation = _circling(DRAWING_WORLD, drones)
        self._renderer = PlanarRenderer(Scene(self._simulation.world, drones))
        self._cameras = [_Camera(drone, model, SensorEffects(model, n)) for n, (drone, model) in enumerate(cameras)]
        self._steps = max(1, math.floor(1.0 / (FRAMES_PER_S * STEP_S * len(cameras))))
        self._number = 0
        self.picture: Image = np.empty(0, np.uint8)  #: drawn last, BGR, shape (height, width, 3)
        for at in range(len(cameras)):
            self.draw(at)  # the first picture of a lens makes its tables

    def draw(self, at: int) -> int:
        """Fly on, then draw what a camera sees with the flaws of its sensor.

        Args:
            at: The camera's index.

        Returns:
            The time of the drawing [ns].
        """
        simulation, camera = self._simulation, self._cameras[at]
        simulation.step(self._steps)
        positions, rotations = simulation.poses()
        rates = np.array(simulation.truth(camera.drone).angular_velocity_rad_s)
        targets = simulation.target_states()
        self._number += 1
        begin = monotonic_ns()
        state = SceneState(positions, rotations, targets)
        pose = camera.model.pose(positions[camera.drone], rotations[camera.drone], camera.drone)
        self.picture = camera.effects.apply(self._renderer.render(state, pose, camera.model), self._number, rates)
        return monotonic_ns() - begin


class _Hops:
    """Firmware that lets a drone jump: it reads all, and computes nothing."""

    def exchange(self, readings: Readings) -> tuple[float, ...]:
        """Return full thrust near the ground, and none above."""
        thrust = 0.6 if (readings.range_m or 0.0) < 0.5 else 0.2
        return (thrust,) * 4


def _flown_by_firmware(fleet: Fleet) -> Simulation:
    simulation = Simulation(load_world(fleet.world), fleet.drones, seed=1, parameters=VEHICLES[fleet.model])
    for drone in range(fleet.drones):
        simulation.fly_by(drone, _Hops())
    return simulation


def _circling(world: str, drones: int, model: str = "quadrotor") -> Simulation:
    """Return a world whose drones have taken off and fly circles."""
    simulation = Simulation(load_world(world), drones, seed=1, parameters=VEHICLES[model])
    for action in (Takeoff(), _CIRCLING):
        for drone in range(drones):
            simulation.command(drone, action)
        simulation.step(round(_TAKE_OFF_S / STEP_S))
    return simulation


def rounds(seconds: float, progress: Progress) -> Iterator[None]:
    """Yield until the time is up, and at least :data:`LEAST_ROUNDS` times."""
    begin, limit = monotonic_ns(), nanoseconds(seconds)
    done = 0
    while done < LEAST_ROUNDS or monotonic_ns() - begin < limit:
        yield
        done += 1
        progress(min(1.0, (monotonic_ns() - begin) / max(1, limit)))


def _drawing_row(
    cameras: str, model: CameraModel, pictures: int, times: list[int], target: float | None = None
) -> DrawingRow:
    rate = pictures * len(times) / (sum(times) * 1e-9)
    return DrawingRow(cameras, model.width, model.height, pictures, spread(times), rate, target)


@contextmanager
def _one_core() -> Iterator[None]:
    """Keep OpenCV to the calling thread; afterwards it may use as many threads as before."""
    before = cv2.getNumThreads()
    use_one_core()
    try:
        yield
    finally:
        cv2.setNumThreads(before)
