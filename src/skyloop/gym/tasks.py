"""The environments' tasks, each run for all drones of an arena at once: reach a position, hover, follow, fly gates."""

from __future__ import annotations

import math
from typing import Any, Final

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from skyloop.errors import UnknownNameError, UsageError
from skyloop.messages import Takeoff, Velocity
from skyloop.sim import STEP_S, Simulation, VehicleParameters, Wind, World, parse_world
from skyloop.sim.vehicles import VEHICLES

CELL_M: Final = 8.0  #: side length of the square reserved for each drone
REACH_M: Final = 3.5  #: a drone further than this from its cell's centre has left it
LOWEST_M, HIGHEST_M = 0.3, 4.5  #: minimum and maximum height within the cell
_UP_S: Final = 15.0  #: time allowed for all drones to take off


class Arena:
    """A set of hovering drones. Deterministic: the same seed and actions give the same numbers."""

    def __init__(
        self, drones: int, seed: int, *, gusts_m_s: float, period_s: float, vehicle: VehicleParameters
    ) -> None:
        wind = Wind(gust_m_s=gusts_m_s) if gusts_m_s > 0.0 else None
        self.world = _hall(drones)
        self.simulation = Simulation(self.world, drones, seed=seed, wind=wind, parameters=vehicle)
        self.count = drones
        self.centres = np.array([spawn.position_m[:2] for spawn in self.world.spawns])
        self._steps = max(1, round(period_s / STEP_S))
        self._take_off()
        self._state: tuple[Floats, Floats, Floats] | None = None
        self._poses: tuple[Floats, Floats] | None = None

    def step(self, commands: Floats) -> None:
        """Advance by one period with these velocities: forward, left, up [m/s], yaw rate [rad/s]; shape (n, 4)."""
        for drone, row in enumerate(commands.tolist()):
            self.simulation.command(drone, Velocity(*row))
        self.simulation.step(self._steps)
        self._state = self._poses = None

    def put(self, drone: int, place: Floats, yaw: float) -> None:
        """Place a drone at rest within its cell; ``place`` is relative to the cell's centre on the floor [m]."""
        x, y, z = place.tolist()
        middle_x, middle_y = self.centres[drone].tolist()
        self.simulation.put(drone, (middle_x + x, middle_y + y, z), yaw)
        self._state = self._poses = None

    def state(self) -> tuple[Floats, Floats, Floats]:
        """Return the drones' positions in their cells, their velocities and their angles. Do not modify the arrays.

        Positions, (n, 3) [m], and roll, pitch and yaw, (n, 3) [rad], are true values, as motion capture would report;
        velocities in the body's levelled axes, (n, 3) [m/s], are the drones' estimates.
        """
        if self._state is None:
            self._state = self.simulation.motions()
            self._state[0][:, :2] -= self.centres
        return self._state

    def poses(self) -> tuple[Floats, Floats]:
        """Return the drones' poses in the world; see :meth:`Simulation.poses`. Do not modify the arrays."""
        if self._poses is None:
            self._poses = self.simulation.poses()
        return self._poses

    def airborne(self) -> NDArray[np.bool_]:
        """Return a mask of the drones that are flying, shape (n,)."""
        return self.simulation.airborne()

    def _take_off(self) -> None:
        for drone in range(self.count):
            self.simulation.command(drone, Takeoff())
        period = round(0.1 / STEP_S)
        for _ in range(round(_UP_S / 0.1)):
            self.simulation.step(period)
            if all(self.simulation.state(drone) == "hovering" for drone in range(self.count)):
                return
        raise RuntimeError(f"not all of {self.count} drones took off within {_UP_S:g} simulated seconds")


def outside(places: Floats) -> NDArray[np.bool_]:
    """Return a mask of the drones that have left their cell, shape (n,)."""
    wide = np.abs(places[:, :2]).max(axis=1) > REACH_M
    low_or_high = (places[:, 2] < LOWEST_M) | (places[:, 2] > HIGHEST_M)
    found: NDArray[np.bool_] = wide | low_or_high
    return found


def _hall(drones: int) -> World:
    """Return an empty hall with one cell per drone and a spawn in the middle of each."""
    side = math.ceil(math.sqrt(drones))
    half = (side - 1) * CELL_M / 2
    lines = [f'[room]\nsize = [{side * CELL_M + 2}, {side * CELL_M + 2}, 8]\nfloor = "concrete"\nwalls = "plaster"\n']
    for drone in range(drones):
        row, column = divmod(drone, side)
        lines.append(f"[[spawn]]\nposition = [{column * CELL_M - half}, {row * CELL_M - half}, 0]\n")
    return parse_world("\n".join(lines), "arena")


Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]
Observation = NDArray[np.float32]
Infos = dict[str, NDArray[Any]]

PERIOD_S: Final = 0.04  #: time between two actions
SPEED_M_S: Final = 1.0  #: velocity commanded by an action of 1
TURN_RAD_S: Final = 1.5  #: turn rate commanded by an action of 1
NEAR_M: Final = 0.2  #: a goal closer than this counts as reached
FOLLOWED_M: Final = 1.5  #: desired distance from a followed target
GATES: Final = 4  #: number of gates of a course
GATE_RADIUS_M: Final = 0.5  #: maximum distance from a gate's centre at which the gate counts as passed
_GATE_RING_M: Final = 1.8  #: radius of the circle on which the gates are placed
_FOLLOWING_M: Final = 0.3  #: maximum distance error at which a target counts as followed
_FOLLOWING_RAD: Final = 0.35  #: maximum bearing at which the target counts as followed
_SPREAD: Final = (2.0, 2.0, 0.8)  #: greatest distance of goals and starts from the middle of a cell, per axis [m]
_HEIGHT: Final = 2.0  #: height of the middle of a cell [m]
_WALK_M: Final = (1.6, 1.6, 0.4)  #: how far a target walks from the middle of its cell, per axis [m]
_WALK_RAD_S: Final = 0.18  #: angular rate of the walk, which limits its speed to 0.3 m/s
_FAILURE: Final = -5.0  #: reward for leaving the cell or crashing
_FULL: Final = np.array([SPEED_M_S, SPEED_M_S, SPEED_M_S, TURN_RAD_S])  #: commands for actions of 1
#: Bounds for the goal forward, left, up [m]; velocity forward, left, up [m/s]; roll, pitch [rad]; turn's sine, cosine
_HIGHEST: Final = np.array([10, 10, 10, 5, 5, 5, math.pi, math.pi, 1, 1], np.float32)
MOTION: Final = slice(3, 8)  #: the part of an observation that holds the drone's own motion: velocity, roll, pitch

ACTIONS: Final = spaces.Box(-1.0, 1.0, (4,), np.float32)
OBSERVATIONS: Final = spaces.Box(-_HIGHEST, _HIGHEST, dtype=np.float32)
MOTIONS: Final = spaces.Box(-_HIGHEST[MOTION], _HIGHEST[MOTION], dtype=np.float32)


class Reaching:
    """Fly to a position and stay there, facing a given heading. Base class of the other tasks."""

    def __init__(self, drones: int, seconds: float, gusts_m_s: float, vehicle: str = "quadrotor") -> None:
        if not (1.0 <= seconds <= 600.0):
            raise UsageError(f"seconds is {seconds!r} and must be from 1 to 600")
        if not (0.0 <= gusts_m_s <= 5.0):
            raise UsageError(f"gusts_m_s is {gusts_m_s!r} and must be from 0 to 5")
        if vehicle not in VEHICLES:
            raise UnknownNameError("simulated vehicle", vehicle, VEHICLES)
        self.drones = drones
        self.vehicle = vehicle
        self.steps = round(seconds / PERIOD_S)
        self.gusts_m_s = gusts_m_s
        self.goals = np.zeros((drones, 3))
        self.headings = np.zeros(drones)
        self.age = np.zeros(drones, dtype=np.int64)
        self._before = np.zeros((drones, 4))
        self._arena: Arena | None = None

    @property
    def arena(self) -> Arena:
        """The drones. Raises :class:`UsageError` if :meth:`begin` has not been called."""
        if self._arena is None:
            raise UsageError("the environment has not been reset yet: call reset() first")
        return self._arena

    @property
    def begun(self) -> bool:
        """Whether :meth:`begin` was called."""
        return self._arena is not None

    def begin(self, seed: int) -> None:
        """Create a new world from this seed, with all drones hovering."""
        self._arena = Arena(
            self.drones, seed, gusts_m_s=self.gusts_m_s, period_s=PERIOD_S, vehicle=VEHICLES[self.vehicle]
        )

    def restart(self, which: Bools, rng: np.random.Generator) -> None:
        """Choose a new start and a new goal for these drones."""
        self.age[which] = 0  # must precede the call to ``_place``, because moving goals depend on the age
        for drone in np.flatnonzero(which):
            start, heading = self._place(int(drone), rng)
            self.arena.put(int(drone), start, heading)
        self._before[which] = 0.0

    def step(self, actions: Floats) -> tuple[Floats, Bools, Bools, Infos]:
        """Apply actions for one period; return the rewards, the flags terminated and truncated, and further values."""
        bounded = np.minimum(np.maximum(np.where(np.isnan(actions), 0.0, actions), -1.0), 1.0)
        self.arena.step(bounded * _FULL)
        self.age += 1
        places, _, angles = self.arena.state()
        jerk = np.abs(bounded - self._before).sum(axis=1)
        self._before = bounded
        rewards, done, infos = self._judge(places, angles[:, 2])
        failed = outside(places) | ~self.arena.airborne()
        infos["is_success"] &= ~failed
        return rewards - 0.002 * jerk + _FAILURE * failed, failed | done, self.age >= self.steps, infos

    def infos(self) -> Infos:
        """Return the additional information on each drone, as :meth:`step` does."""
        places, _, angles = self.arena.state()
        return self._judge(places, angles[:, 2])[2]

    def observe(self) -> Observation:
        """Return the observation, shape (n, 10)."""
        places, velocities, angles = self.arena.state()
        east, north, up = (self.goals - places).T
        roll, pitch, yaw = angles.T
        sine, cosine = np.sin(yaw), np.cos(yaw)
        turn = self._wanted_heading(places) - yaw
        seen = np.empty((self.drones, len(_HIGHEST)), np.float32)
        seen[:, 0] = cosine * east + sine * north
        seen[:, 1] = cosine * north - sine * east
        seen[:, 2] = up
        seen[:, 3:6] = velocities
        seen[:, 6], seen[:, 7] = roll, pitch
        seen[:, 8], seen[:, 9] = np.sin(turn), np.cos(turn)
        np.minimum(seen, _HIGHEST, out=seen)
        return np.maximum(seen, -_HIGHEST, out=seen)

    def rings(self, drone: int) -> list[tuple[Floats, Floats | None, float]]:
        """Return the goals to draw: centre in the cell [m], normal (None: facing the camera), radius [m]."""
        return [(self.goals[drone], None, 0.2)]

    # For subclasses ---------------------------------------------------------------------------------------------

    def _place(self, drone: int, rng: np.random.Generator) -> tuple[Floats, float]:
        """Choose a goal; return the start in the cell and its heading."""
        start, goal = (rng.uniform(-1, 1, 3) * _SPREAD + [0, 0, _HEIGHT] for _ in range(2))
        heading = float(rng.uniform(-math.pi, math.pi))
        self.goals[drone], self.headings[drone] = goal, rng.uniform(-math.pi, math.pi)
        return start, heading

    def _judge(self, places: Floats, yaws: Floats) -> tuple[Floats, Bools, Infos]:  # noqa: ARG002  others use it
        """Return the rewards, which tasks are completed, and further values."""
        distances = np.linalg.norm(self.goals - places, axis=1)
        rewards = 0.1 * (np.exp(-2.0 * distances) - 0.1 * distances)
        infos: Infos = {"distance_m": distances, "is_success": distances < NEAR_M}
        return rewards, np.zeros(self.drones, dtype=np.bool_), infos

    def _wanted_heading(self, places: Floats) -> Floats:  # noqa: ARG002  others need it
        return self.headings


class Hovering(Reaching):
    """Hold the starting position and heading in gusts."""

    def _place(self, drone: int, rng: np.random.Generator) -> tuple[Floats, float]:
        start = rng.uniform(-1, 1, 3) * _SPREAD + [0, 0, _HEIGHT]
        heading = float(rng.uniform(-math.pi, math.pi))
        self.goals[drone], self.headings[drone] = start, heading
        return start, heading


class Following(Reaching):
    """Follow a walking target at a distance, keeping it in the middle of the image."""

    def __init__(self, drones: int, seconds: float, gusts_m_s: float, vehicle: str = "quadrotor") -> None:
        super().__init__(drones, seconds, gusts_m_s, vehicle)
        self._phases = np.zeros((drones, 3))
        self._rates = np.zeros((drones, 3))

    def step(self, actions: Floats) -> tuple[Floats, Bools, Bools, Infos]:
        """Move the targets, then perform the base class's step."""
        self._walk(self.age + 1)
        return super().step(actions)

    def _place(self, drone: int, rng: np.random.Generator) -> tuple[Floats, float]:
        self._phases[drone] = rng.uniform(-math.pi, math.pi, 3)
        self._rates[drone] = rng.uniform(0.5, 1.0, 3) * _WALK_RAD_S * rng.choice([-1.0, 1.0], 3)
        self._walk(self.age)
        target = self.goals[drone]
        bearing = math.atan2(-target[1], -target[0]) + float(rng.uniform(-0.8, 0.8))  # roughly to the middle
        away = float(rng.uniform(1.2, 2.2))
        start = target + np.array([away * math.cos(bearing), away * math.sin(bearing), 0.0])
        return start, bearing + math.pi + float(rng.uniform(-0.3, 0.3))

    def _walk(self, ages: NDArray[np.int64]) -> None:
        angles = self._phases + self._rates * (ages * PERIOD_S)[:, None]
        self.goals = np.sin(angles) * _WALK_M + [0.0, 0.0, _HEIGHT]

    def _judge(self, places: Floats, yaws: Floats) -> tuple[Floats, Bools, Infos]:
        ahead = self.goals - places
        distances = np.linalg.norm(ahead, axis=1)
        turn = self._wanted_heading(places) - yaws
        bearings = np.abs(np.arctan2(np.sin(turn), np.cos(turn)))
        off = np.abs(distances - FOLLOWED_M) + bearings + np.abs(ahead[:, 2])
        seen = (np.abs(distances - FOLLOWED_M) < _FOLLOWING_M) & (bearings < _FOLLOWING_RAD)
        infos: Infos = {"distance_m": distances, "bearing_rad": bearings, "is_success": seen}
        return 0.1 * (np.exp(-2.0 * off) - 0.1 * off), np.zeros(self.drones, dtype=np.bool_), infos

    def _wanted_heading(self, places: Floats) -> Floats:
        ahead = self.goals - places
        return np.arctan2(ahead[:, 1], ahead[:, 0])


class Racing(Reaching):
    """Fly in order through gates placed on a circle; the task is done after the last gate."""

    def __init__(self, drones: int, seconds: float, gusts_m_s: float, vehicle: str = "quadrotor") -> None:
        super().__init__(drones, seconds, gusts_m_s, vehicle)
        self.passed = np.zeros(drones, dtype=np.int64)
        self._gates = np.zeros((drones, GATES, 3))
        self._normals = np.zeros((drones, GATES, 3))
        self._places = np.zeros((drones, 3))

    def rings(self, drone: int) -> list[tuple[Floats, Floats | None, float]]:
        """Return the remaining gates, the next one first."""
        rest = range(int(self.passed[drone]), GATES)
        return [(self._gates[drone, gate], self._normals[drone, gate], GATE_RADIUS_M) for gate in rest]

    def _place(self, drone: int, rng: np.random.Generator) -> tuple[Floats, float]:
        first, way = float(rng.uniform(-math.pi, math.pi)), float(rng.choice([-1.0, 1.0]))
        angles = first + way * np.arange(GATES) * 2 * math.pi / GATES
        radius = _GATE_RING_M + rng.uniform(-0.2, 0.2, GATES)
        heights = _HEIGHT + rng.uniform(-0.5, 0.5, GATES)
        self._gates[drone] = np.stack([radius * np.cos(angles), radius * np.sin(angles), heights], axis=1)
        self._normals[drone] = np.stack([-way * np.sin(angles), way * np.cos(angles), np.zeros(GATES)], axis=1)
        self.passed[drone] = 0
        start: Floats = self._gates[drone, 0] - 1.2 * self._normals[drone, 0]
        self._places[drone] = start
        self._aim()
        return start, float(self.headings[drone])

    def _aim(self) -> None:
        """Set each drone's goal to the centre of its next gate, with the heading for flying through it."""
        rows, following = np.arange(self.drones), np.minimum(self.passed, GATES - 1)
        self.goals = self._gates[rows, following]
        normals = self._normals[rows, following]
        self.headings = np.arctan2(normals[:, 1], normals[:, 0])

    def step(self, actions: Floats) -> tuple[Floats, Bools, Bools, Infos]:
        """Perform the base class's step; reward each gate with 1, and also progress towards the next gate."""
        before, goals, counts = self._places, self.goals.copy(), self.passed.copy()
        rewards, done, over, infos = super().step(actions)
        nearer = np.linalg.norm(before - goals, axis=1) - np.linalg.norm(self._places - goals, axis=1)
        return rewards + nearer + 1.0 * (self.passed - counts), done, over, infos

    def restart(self, which: Bools, rng: np.random.Generator) -> None:
        """Choose a new course for these drones."""
        super().restart(which, rng)
        self._places[which] = self.arena.state()[0][which]

    def _judge(self, places: Floats, yaws: Floats) -> tuple[Floats, Bools, Infos]:  # noqa: ARG002  same signature
        rows, following = np.arange(self.drones), np.minimum(self.passed, GATES - 1)
        normals = self._normals[rows, following]
        was, now = self._places - self.goals, places - self.goals
        crossed = (np.sum(was * normals, axis=1) < 0.0) & (np.sum(now * normals, axis=1) >= 0.0)
        through = crossed & (np.linalg.norm(now, axis=1) < GATE_RADIUS_M) & (self.passed < GATES)
        self.passed = self.passed + through
        self._places = places.copy()
        self._aim()
        done = self.passed >= GATES
        distances = np.linalg.norm(self.goals - places, axis=1)
        infos: Infos = {"distance_m": distances, "gates_passed": self.passed.copy(), "is_success": done.copy()}
        return np.zeros(self.drones), done, infos
