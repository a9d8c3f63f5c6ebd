"""The broad phase misses no contact: compared with checking all pairs, and in every step."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from skyloop.messages import AnyAction, Attitude, Land, Takeoff, Velocity
from skyloop.sim import Limits, Simulation, VehicleParameters, VehicleTruth, collisions, load_world
from skyloop.sim.reports import Occurrence
from skyloop.sim.solids import Solids, overlapping
from skyloop.sim.streams import Floats
from skyloop.sim.targets import TargetTrack

boxes = st.integers(1, 25).flatmap(
    lambda n: st.tuples(
        arrays(np.float64, (3, n), elements=st.floats(-3, 3, width=16)),
        arrays(np.float64, (3, n), elements=st.floats(0, 2, width=16)),
        st.integers(0, n),
    )
)


@given(boxes)
def test_the_sweep_finds_the_same_pairs_as_comparing_all(drawn: tuple[Floats, Floats, int]) -> None:
    low, size, movable = drawn
    high = low + size
    wanted = [
        (one, other)
        for one, other in itertools.combinations(range(low.shape[1]), 2)
        if one < movable and (low[:, one] <= high[:, other]).all() and (low[:, other] <= high[:, one]).all()
    ]
    found = overlapping(low, high, movable)
    assert list(zip(*(numbers.tolist() for numbers in found), strict=True)) == wanted


@pytest.mark.parametrize("name", ["gates", "park", "platform"])
def test_solids_checked_together_match_those_checked_one_by_one(name: str) -> None:
    world = load_world(name)
    solids = Solids(world, tuple(TargetTrack(target, 1, n) for n, target in enumerate(world.targets)))
    solids.move(3.0)
    hull = np.array([0.3, 0.3, 0.1])
    size = np.array(world.room.size_m)
    points = np.random.default_rng(1).uniform([-0.45, -0.45, 0.0], [0.45, 0.45, 0.45], (4000, 3)) * size
    low, high = solids.bounds(0.0, 0.3)
    numbers = np.repeat(np.arange(len(solids)), len(points))
    places = np.tile(points.T, len(solids))
    sizes = solids.sizes(numbers, np.tile(hull[:, None], len(numbers)))
    within = solids.within(places, numbers, sizes)
    assert len(within) > 3
    hit = {(int(numbers[at]), int(at % len(points))) for at in within}
    for at in {point for _, point in hit} | set(range(200)):
        for number in range(len(solids)):
            overlap = solids.overlap(points[at].tolist(), 0.3, 0.1, [number])
            assert (overlap is not None) == ((number, at) in hit), (number, at)
            if overlap is not None:
                assert (low[:, number] - hull <= points[at]).all()
                assert (points[at] <= high[:, number] + hull).all()


set_points = st.builds(Velocity, st.floats(-5, 5), st.floats(-5, 5), st.floats(-2, 2), st.floats(-2, 2)) | st.builds(
    Attitude, st.floats(-0.5, 0.5), st.floats(-0.5, 0.5), st.floats(-2, 2), st.floats(-2, 2)
)
TOUGH = VehicleParameters(crash_speed_m_s=100.0, restitution=0.9)


def crowd(
    commands: list[AnyAction], world: str, drones: int, seed: int, phase_steps: int, few_pairs: int
) -> tuple[list[VehicleTruth], list[Occurrence]]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(collisions, "BROAD_PHASE_STEPS", phase_steps)
        patch.setattr(collisions, "BROAD_PHASE_STEPS_OF_FEW", phase_steps)
        patch.setattr(collisions, "FEW_PAIRS", few_pairs)
        limits = Limits(tilt_rad=0.6, climb_m_s=2.0, speed_m_s=6.0)
        simulation = Simulation(load_world(world, seed), drones, seed=seed, parameters=TOUGH, limits=limits)
        for drone in range(drones):
            simulation.command(drone, Takeoff())
        simulation.step(500)
        truths = []
        for turn in range(2):
            for drone in range(drones):
                simulation.command(drone, commands[(drone + turn) % len(commands)])
            simulation.step(200)
            truths += [simulation.truth(drone) for drone in range(drones)]
    return truths, simulation.take_occurrences()


@settings(max_examples=6, deadline=None)
@given(
    st.lists(set_points | st.just(Land()), min_size=3, max_size=8),
    st.sampled_from(["gates", "platform"]),
    st.sampled_from([2, 12]),
    st.integers(0, 99),
)
def test_a_crowd_flies_as_if_all_pairs_were_checked_in_every_step(
    commands: list[AnyAction], world: str, drones: int, seed: int
) -> None:
    rarely = crowd(commands, world, drones, seed, collisions.BROAD_PHASE_STEPS, collisions.FEW_PAIRS)
    assert rarely == crowd(commands, world, drones, seed, 1, 0)


def test_a_moved_drone_collides_at_its_new_position() -> None:
    simulation = Simulation(load_world("empty"), 2, seed=1, parameters=TOUGH)
    for drone in (0, 1):
        simulation.command(drone, Takeoff())
    simulation.step(1000)
    x, y, z = simulation.truth(0).position_m
    simulation.put(1, (x + 0.4, y, z))
    simulation.step()
    x, y, z = np.subtract(simulation.truth(0).position_m, simulation.truth(1).position_m)
    assert np.hypot(x, y) >= 2 * TOUGH.radius_m - 1e-9 or abs(z) >= 2 * TOUGH.half_height_m - 1e-9
