"""Worlds and vehicles shared by the simulator's tests."""

from __future__ import annotations

from skyloop.messages import Takeoff, Velocity
from skyloop.sim import STEP_S, Simulation, VehicleParameters, Wind, World, parse_world
from skyloop.sim.parameters import with_ideal_sensors

HALL = parse_world("[room]\nsize = [20, 20, 10]\n", "hall")

#: A vehicle with perfect sensors.
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
    """Return a simulation whose drones have taken off and hover."""
    simulation = Simulation(world, drones, seed=seed, parameters=parameters, wind=wind)
    for drone in range(drones):
        simulation.command(drone, Takeoff())
    simulation.step(steps(seconds))
    return simulation


def above_another(parameters: VehicleParameters) -> Simulation:
    """Return a simulation with drone 1 in the air above drone 0, which is on the ground."""
    world = parse_world(
        "[room]\nsize = [5, 5, 3]\n[[spawn]]\nposition = [0, 0, 0]\n[[spawn]]\nposition = [1.5, 0, 0]\nyaw_deg = 180\n"
    )
    simulation = Simulation(world, 2, parameters=parameters)
    simulation.command(1, Takeoff())
    simulation.step(steps(4))
    while simulation.truth(1).position_m[0] > 0.05:
        simulation.command(1, Velocity(forward=0.5))
        simulation.step(5)
    return simulation
