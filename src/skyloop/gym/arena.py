"""Simulated drones side by side, each in a cell of its own, stepped as fast as the machine can."""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from skyloop.messages import Takeoff, Velocity
from skyloop.sim import STEP_S, Simulation, VehicleParameters, Wind, World, parse_world

Floats = NDArray[np.float64]

CELL_M: Final = 8.0  #: edge of the square that each drone has for itself
REACH_M: Final = 3.5  #: a drone further from its cell's centre than this has left it
LOWEST_M: Final = 0.3
HIGHEST_M: Final = 4.5
_UP_S: Final = 15.0  #: within which every drone has taken off


class Arena:
    """``drones`` of them, hovering. Deterministic: the same seed and actions give the same numbers."""

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
        """Go on by one period with these velocities: forward, left, up [m/s], yaw rate [rad/s]; shape (n, 4)."""
        for drone, row in enumerate(commands.tolist()):
            self.simulation.command(drone, Velocity(*row))
        self.simulation.step(self._steps)
        self._state = self._poses = None

    def put(self, drone: int, place: Floats, yaw: float) -> None:
        """Put a drone somewhere in its cell, at rest; ``place`` relative to the cell's centre on the floor [m]."""
        x, y, z = place.tolist()
        middle_x, middle_y = self.centres[drone].tolist()
        self.simulation.put(drone, (middle_x + x, middle_y + y, z), yaw)
        self._state = self._poses = None

    def state(self) -> tuple[Floats, Floats, Floats]:
        """Return where the drones are in their cells, how fast and at which angles; not to be changed.

        Returns:
            Positions, shape (n, 3) [m]; velocities in the body's levelled axes, shape (n, 3) [m/s]; roll, pitch and
            yaw, shape (n, 3) [rad]. Positions and angles are the true ones, as motion capture would measure them;
            velocities are what the drones estimate.
        """
        if self._state is None:
            self._state = self.simulation.motions()
            self._state[0][:, :2] -= self.centres
        return self._state

    def poses(self) -> tuple[Floats, Floats]:
        """Return the drones' poses in the world; see :meth:`Simulation.poses`. Not to be changed."""
        if self._poses is None:
            self._poses = self.simulation.poses()
        return self._poses

    def airborne(self) -> NDArray[np.bool_]:
        """Which drones fly, shape (n,)."""
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
    """Which drones have left their cell, shape (n,)."""
    wide = np.abs(places[:, :2]).max(axis=1) > REACH_M
    low_or_high = (places[:, 2] < LOWEST_M) | (places[:, 2] > HIGHEST_M)
    found: NDArray[np.bool_] = wide | low_or_high
    return found


def _hall(drones: int) -> World:
    """An empty hall with a cell for each drone, and a standing place in the middle of each."""
    side = math.ceil(math.sqrt(drones))
    half = (side - 1) * CELL_M / 2
    lines = [f'[room]\nsize = [{side * CELL_M + 2}, {side * CELL_M + 2}, 8]\nfloor = "concrete"\nwalls = "plaster"\n']
    for drone in range(drones):
        row, column = divmod(drone, side)
        lines.append(f"[[spawn]]\nposition = [{column * CELL_M - half}, {row * CELL_M - half}, 0]\n")
    return parse_world("\n".join(lines), "arena")
