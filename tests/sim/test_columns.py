"""Drones computed one by one in plain numbers fly, bit by bit, like those computed together in arrays."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from skyloop.messages import AnyAction, Attitude, EmergencyStop, Hover, Land, Takeoff, Velocity
from skyloop.sim import Limits, Simulation, VehicleParameters, VehicleTruth, Wind, dynamics, load_world
from skyloop.sim.dynamics import ARRAYS, NUMBERS, Fields, few
from skyloop.sim.reports import Occurrence, VehicleFeedback
from skyloop.sim.vehicles import AR_DRONE
from tests.sim.helpers import HALL

Flight = tuple[list[VehicleTruth], list[VehicleFeedback], list[Occurrence]]
HEAVY = replace(VehicleParameters(), mass_kg=1.2, radius_m=0.4, restitution=0.7, crash_speed_m_s=100.0)

set_points = st.builds(Velocity, st.floats(-5, 5), st.floats(-5, 5), st.floats(-2, 2), st.floats(-2, 2)) | st.builds(
    Attitude, st.floats(-0.5, 0.5), st.floats(-0.5, 0.5), st.floats(-2, 2), st.floats(-2, 2)
)
actions = set_points | st.sampled_from([Hover(), Land(), Takeoff(), EmergencyStop()])


def fly(commands: list[AnyAction], world: str, seed: int, one_by_one: bool) -> Flight:
    """Fly three different vehicles close to one another and to walls, in gusts."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(dynamics, "FEW", 3 if one_by_one else 0)
        simulation = Simulation(
            HALL if world == "hall" else load_world(world),
            3,
            seed=seed,
            parameters=[VehicleParameters(), AR_DRONE, HEAVY],
            limits=Limits(tilt_rad=0.5, climb_m_s=2.0, speed_m_s=5.0),
            wind=Wind((0.5, 0.2, 0.0), 0.4),
        )
        for drone in range(3):
            simulation.command(drone, Takeoff())
        simulation.step(700)
        truths, estimates = [], []
        for number, action in enumerate(commands):
            simulation.command(number % 3, action)
            simulation.step(150)
            truths += [simulation.truth(drone) for drone in range(3)]
            estimates += [simulation.feedback(drone) for drone in range(3)]
    return truths, estimates, simulation.take_occurrences()


@settings(max_examples=8, deadline=None)
@example([Attitude(0.3, 0.3), Velocity(-4.0), Attitude(-0.4, 0.2, -1.0), Land(), Land(), EmergencyStop()], "room", 1)
@given(st.lists(actions, min_size=3, max_size=8), st.sampled_from(["hall", "gates", "platform"]), st.integers(0, 99))
def test_numbers_and_arrays_give_the_same_bits(commands: list[AnyAction], world: str, seed: int) -> None:
    assert fly(commands, world, seed, True) == fly(commands, world, seed, False)


def test_a_few_drones_are_read_and_written_as_numbers() -> None:
    assert few(1)
    assert not few(100)
    table = dynamics.columns(5, 2)
    table[:, 1] = range(5)
    fields = Fields(table, 1, 3)
    assert fields.read[1]() == (1.0, 2.0, 3.0)
    fields.write[0](7.0, 8.0, 9.0)
    assert table[:, 0].tolist() == [0.0, 7.0, 8.0, 9.0, 0.0]
    assert table[:, 1].tolist() == [0.0, 1.0, 2.0, 3.0, 4.0]


@given(st.floats(-9, 9), st.floats(-9, 9))
def test_operations_are_the_same_for_numbers_and_arrays(one: float, other: float) -> None:
    for do in (NUMBERS, ARRAYS):
        assert do.least(one, other) == min(one, other)
        assert do.most(one, other) == max(one, other)
        assert do.root(abs(one)) == math.sqrt(abs(one))
        assert do.choose(one > other, one, other) == max(one, other)
