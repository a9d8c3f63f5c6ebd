"""Drones that land while pressed against something, or on one another."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from skyloop.messages import Attitude, FlightState, Land, Takeoff, Velocity
from skyloop.sim import Limits, Simulation, VehicleParameters, World, parse_world
from skyloop.sim.parameters import LIMIT_RANGES
from tests.sim.helpers import IDEAL, above_another, flying, steps

TOUGH = replace(VehicleParameters(), crash_speed_m_s=100.0)
CORNERS = "[room]\nsize = [5, 5, 3]\n"
#: Two slabs with a narrowing gap: pushing a drone out of one of them leads into the other.
FUNNEL = (
    "[room]\nsize = [8, 8, 3]\n[[spawn]]\nposition = [-2, 0, 0]\n"
    "[[box]]\nposition = [1, 0.7, 1.5]\nsize = [3, 0.4, 3]\nyaw_deg = {left}\n"
    "[[box]]\nposition = [1, -0.7, 1.5]\nsize = [3, 0.4, 3]\nyaw_deg = {right}\n"
)


def seconds_to_land(simulation: Simulation, patience_s: float = 20.0) -> float:
    """Land all drones and return the time until they have landed; fail if one takes too long in simulation time."""
    begun_s = simulation.time_s
    for drone in range(simulation.drones):
        simulation.command(drone, Land())
    while any(simulation.state(drone) is not FlightState.LANDED for drone in range(simulation.drones)):
        assert simulation.time_s < begun_s + patience_s, [simulation.truth(n) for n in range(simulation.drones)]
        simulation.step(10)
    return simulation.time_s - begun_s


def pressed(world: World, action: Velocity | Attitude, limits: Limits, seed: int = 1) -> Simulation:
    """Return a simulation whose drone followed a set-point until something held it and its loops had adapted."""
    simulation = Simulation(world, parameters=TOUGH, limits=limits, seed=seed)
    simulation.command(0, Takeoff())
    simulation.step(steps(4))
    simulation.command(0, action)
    simulation.step(steps(12))
    return simulation


@pytest.mark.slow
@pytest.mark.parametrize("climb_m_s", [0.1, 0.3, 0.7])
@pytest.mark.parametrize("tilt_rad", [0.21, 0.6])
@pytest.mark.parametrize("action", [Velocity(1.0), Velocity(1.0, 1.0), Velocity(0.2, 0.2), Attitude(0.2, 0.2)])
def test_a_drone_in_a_corner_lands(action: Velocity | Attitude, tilt_rad: float, climb_m_s: float) -> None:
    simulation = pressed(parse_world(CORNERS), action, Limits(tilt_rad=tilt_rad, climb_m_s=climb_m_s))
    assert seconds_to_land(simulation) < 4.0 + 2.0 / climb_m_s
    assert math.hypot(*simulation.truth(0).velocity_m_s) < 1.0


@pytest.mark.slow
@settings(max_examples=12, deadline=None)
@given(
    st.floats(-25.0, -2.0),
    st.floats(2.0, 25.0),
    st.sampled_from([Velocity(0.3), Velocity(1.5), Velocity(1.0, 0.4), Attitude(pitch=0.2)]),
    st.integers(0, 1000),
)
def test_a_drone_in_a_funnel_lands(left: float, right: float, action: Velocity | Attitude, seed: int) -> None:
    world = parse_world(FUNNEL.format(left=left, right=right))
    simulation = pressed(world, action, Limits(tilt_rad=LIMIT_RANGES["tilt_rad"][1]), seed)
    seconds_to_land(simulation)


def test_an_unhindered_landing_is_unchanged() -> None:
    simulation = flying()
    assert seconds_to_land(simulation) == pytest.approx(2.0, abs=0.5)


def test_a_drone_on_another_one_has_landed() -> None:
    simulation = above_another(replace(IDEAL, restitution=0.0))
    seconds_to_land(simulation)
    assert simulation.truth(1).position_m[2] == pytest.approx(3 * IDEAL.half_height_m, abs=1e-3)
    simulation.command(1, Takeoff())
    simulation.step(steps(4))
    assert simulation.state(1) is FlightState.HOVERING
