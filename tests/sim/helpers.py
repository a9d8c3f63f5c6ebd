"""Worlds and vehicles that the tests of the simulator share."""

from __future__ import annotations

from skyloop.messages import Takeoff
from skyloop.sim import STEP_S, Simulation, VehicleParameters, Wind, World, parse_world
from skyloop.sim.parameters import with_ideal_sensors

HALL = parse_world("[room]\nsize = [20, 20, 10]\n", "hall")

#: A vehicle that knows exactly where it is.
IDEAL = with_ideal_sensors(VehicleParameters())


def steps(seconds: float) -> int:
    return round(seconds / STEP_S)


def flying(
    world: World = HALL,
    drones: int = 1,
    *,
    parameters: VehicleParameters = IDEAL,
    wind: Wind | None = None,
    seed: int = 1,
    seconds: float = 5.0,
) -> Simulation:
    """A simulation whose drones have taken off and hover."""
    simulation = Simulation(world, drones, seed=seed, parameters=parameters, wind=wind)
    for drone in range(drones):
        simulation.command(drone, Takeoff())
    simulation.step(steps(seconds))
    return simulation
