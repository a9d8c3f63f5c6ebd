"""Worlds and vehicles that the tests of the simulator share."""

from __future__ import annotations

from dataclasses import fields, replace

from skyloop.messages import Takeoff
from skyloop.sim import STEP_S, Simulation, VehicleParameters, Wind, World, parse_world

HALL = parse_world("[room]\nsize = [20, 20, 10]\n", "hall")

_FLAWS = [field.name for field in fields(VehicleParameters) if "_noise_" in field.name or "_bias_" in field.name]

#: A vehicle that knows exactly where it is.
IDEAL = replace(VehicleParameters(), **dict.fromkeys(_FLAWS, 0.0))


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
