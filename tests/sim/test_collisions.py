from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from skyloop.errors import UsageError
from skyloop.messages import Attitude, EmergencyStop, FlightState, Land, Takeoff, Velocity
from skyloop.sim import Limits, OccurrenceKind, Simulation, World, load_world, parse_world
from skyloop.sim.parameters import GRAVITY_M_S2
from tests.sim.helpers import HALL, IDEAL, above_another, flying, steps

FAST = Limits(tilt_rad=0.5, climb_m_s=3.0, altitude_m=20.0, speed_m_s=10.0)
TOUGH = replace(IDEAL, crash_speed_m_s=100.0)


def depth_in_solids(world: World, position: tuple[float, float, float]) -> float:
    """Return how far the hull of a drone at ``position`` overlaps a box or a wall, computed independently."""
    x, y, z = position
    radius, half = IDEAL.radius_m, IDEAL.half_height_m
    size_x, size_y, height = world.room.size_m
    worst = max(abs(x) + radius - size_x / 2, abs(y) + radius - size_y / 2, half - z, z + half - height)
    for box in world.solids():
        dx, dy, dz = (a - b for a, b in zip(position, box.position_m, strict=True))
        c, s = math.cos(box.yaw_rad), math.sin(box.yaw_rad)
        along, across = c * dx + s * dy, c * dy - s * dx
        worst = max(
            worst,
            min(
                box.size_m[0] / 2 + radius - abs(along),
                box.size_m[1] / 2 + radius - abs(across),
                box.size_m[2] / 2 + half - abs(dz),
            ),
        )
    return worst


set_points = st.builds(
    Velocity,
    forward=st.floats(-8, 8),
    left=st.floats(-8, 8),
    up=st.floats(-3, 3),
    yaw_rate=st.floats(-3, 3),
) | st.builds(Attitude, roll=st.floats(-0.5, 0.5), pitch=st.floats(-0.5, 0.5), climb=st.floats(-3, 3))


@pytest.mark.slow
@settings(max_examples=25, deadline=None)
@example("gates", [Attitude(pitch=-0.5), Velocity(up=-1.0), Velocity(up=-2.0)], 0)  # one came down on the other
@given(st.sampled_from(["room", "gates"]), st.lists(set_points, min_size=1, max_size=6), st.integers(0, 1000))
def test_no_drone_ends_inside_a_solid_or_outside_the_room(
    name: str, actions: list[Velocity | Attitude], seed: int
) -> None:
    world = load_world(name, seed)
    simulation = Simulation(world, 2, parameters=TOUGH, limits=FAST)
    for drone in (0, 1):
        simulation.command(drone, Takeoff())
    simulation.step(500)
    for number, action in enumerate(actions):
        simulation.command(number % 2, action)
        for _ in range(25):
            simulation.step(10)
            for drone in (0, 1):
                assert depth_in_solids(world, simulation.truth(drone).position_m) < 1e-6


@pytest.mark.parametrize("action", [Velocity(forward=2.0), Velocity(left=2.0), Velocity(up=1.0), Velocity(-2, 1, 1)])
def test_walls_and_ceiling_stop_a_drone(action: Velocity) -> None:
    simulation = flying(parse_world("[room]\nsize = [5, 4, 2]\n"), parameters=TOUGH)
    simulation.command(0, action)
    simulation.step(steps(6))
    assert depth_in_solids(simulation.world, simulation.truth(0).position_m) < 1e-6
    assert simulation.state(0) is FlightState.FLYING


def test_a_hard_hit_stops_the_motors() -> None:
    simulation = Simulation(HALL, parameters=replace(IDEAL, crash_speed_m_s=2.0), limits=FAST)
    simulation.command(0, Takeoff())
    simulation.step(steps(4))
    simulation.command(0, Velocity(forward=6.0))
    simulation.step(steps(8))
    assert simulation.state(0) is FlightState.EMERGENCY
    assert simulation.feedback(0).emergency_reason.startswith("hit something solid at")
    kinds = [occurrence.kind for occurrence in simulation.take_occurrences()]
    assert kinds[:2] == [OccurrenceKind.COLLISION, OccurrenceKind.EMERGENCY]
    assert simulation.take_occurrences() == []


def test_bounces_never_gain_energy() -> None:
    simulation = flying(parameters=replace(TOUGH, restitution=1.0, friction=0.0))
    simulation.command(0, Velocity(up=0.7))
    simulation.step(steps(2))
    simulation.command(0, EmergencyStop())
    simulation.step(100)  # until the motors are still
    before = math.inf
    for _ in range(300):
        simulation.step(5)
        truth = simulation.truth(0)
        energy = GRAVITY_M_S2 * truth.position_m[2] + float(np.dot(truth.velocity_m_s, truth.velocity_m_s)) / 2
        assert energy <= before + 2e-2  # the fixed step itself adds some g·v·Δt
        before = min(before, energy)
    assert before < GRAVITY_M_S2 * 2


def test_a_drone_lands_on_a_crate_and_takes_off_from_it() -> None:
    world = parse_world("[room]\nsize = [10, 10, 5]\n[[box]]\nstands_at = [2, 0]\nsize = [2, 2, 0.6]\nyaw_deg = 30\n")
    simulation = flying(world)
    simulation.command(0, Velocity(forward=0.5))
    while simulation.truth(0).position_m[0] < 1.9:
        simulation.step(10)
    simulation.command(0, Land())
    simulation.step(steps(5))
    assert simulation.state(0) is FlightState.LANDED
    assert simulation.truth(0).position_m[2] == pytest.approx(0.6 + IDEAL.half_height_m, abs=1e-3)
    simulation.command(0, Takeoff())
    simulation.step(steps(4))
    assert simulation.state(0) is FlightState.HOVERING
    assert simulation.feedback(0).altitude_m == pytest.approx(1.6, abs=0.1)


def test_a_drone_rides_on_a_moving_platform() -> None:
    world = parse_world(
        """
        [room]
        size = [10, 10, 5]
        [[spawn]]
        position = [0, 0, 0.4]
        [[target]]
        name = "platform"
        kind = "platform"
        id = 1
        marker_size = 0.3
        size = [1.2, 1.2, 0.2]
        path = { kind = "waypoints", points = [[0, 0, 0.4], [3, 0, 0.4]], speed = 0.3, closed = false }
        """
    )
    simulation = Simulation(world, parameters=IDEAL)
    simulation.step(steps(8))
    truth, (platform,) = simulation.truth(0), simulation.target_states()
    assert truth.state is FlightState.LANDED
    assert truth.position_m[0] == pytest.approx(platform.position_m[0], abs=0.1)
    assert truth.position_m[2] == pytest.approx(0.4 + IDEAL.half_height_m, abs=5e-3)
    assert truth.velocity_m_s[0] == pytest.approx(0.3, abs=0.02)


@pytest.mark.parametrize(("speed", "radius"), [(2.0, 4.0), (3.0, 8.0)])
def test_a_fast_platform_that_turns_takes_a_drone_along(speed: float, radius: float) -> None:
    world = parse_world(
        f"""
        [room]
        size = [40, 40, 5]
        [[spawn]]
        position = [{radius + 0.1}, 0.15, 0.2]
        yaw_deg = 90
        [[target]]
        kind = "platform"
        id = 1
        marker_size = 0.2
        size = [4, 4, 0.2]
        path = {{ kind = "circle", centre = [0, 0, 0.2], radius = {radius}, speed = {speed} }}
        yaw = {{ mode = "along", turn_rate_deg_s = 90 }}
        """
    )
    simulation = Simulation(world, parameters=IDEAL)
    places = []
    for wait in (1.0, 8.0):  # the platform is already moving, so the drone slides at first
        simulation.step(steps(wait))
        truth, (platform,) = simulation.truth(0), simulation.target_states()
        east, north = truth.position_m[0] - platform.position_m[0], truth.position_m[1] - platform.position_m[1]
        c, s = math.cos(platform.yaw_rad), math.sin(platform.yaw_rad)
        turned = (truth.yaw_rad - platform.yaw_rad) % (2 * math.pi)
        places.append((c * east + s * north, c * north - s * east, turned))
    assert truth.state is FlightState.LANDED
    assert truth.position_m[2] == pytest.approx(0.2 + IDEAL.half_height_m, abs=5e-3)
    assert places[1] == pytest.approx(places[0], abs=0.03), "its position and heading on the platform"


def test_a_gate_lets_a_drone_through_its_opening_and_stops_it_at_its_frame() -> None:
    text = "[room]\nsize = [10, 10, 5]\n[[gate]]\nposition = [2, {y}, 1.1]\ninner_size = [1, 1]\n"
    through, against = (flying(parse_world(text.format(y=y)), parameters=TOUGH) for y in (0.0, 0.6))
    for simulation in (through, against):
        simulation.command(0, Velocity(forward=1.0))
        simulation.step(steps(4))
    assert through.truth(0).position_m[0] > 2.5
    assert through.take_occurrences() == []
    assert against.truth(0).position_m[0] < 2.0
    assert against.take_occurrences()[0].kind is OccurrenceKind.COLLISION


def test_drones_do_not_pass_through_one_another() -> None:
    world = parse_world(
        "[room]\nsize = [12, 8, 5]\n[[spawn]]\nposition = [-2, 0, 0]\n"
        "[[spawn]]\nposition = [2, 0.1, 0]\nyaw_deg = 180\n"
    )
    simulation = flying(world, 2, parameters=TOUGH)
    for drone in (0, 1):
        simulation.command(drone, Velocity(forward=1.0))
    closest = math.inf
    for _ in range(steps(5)):
        simulation.step()
        (x0, y0, z0), (x1, y1, z1) = (simulation.truth(drone).position_m for drone in (0, 1))
        if abs(z0 - z1) < 2 * IDEAL.half_height_m:
            closest = min(closest, math.hypot(x0 - x1, y0 - y1))
    assert closest > 2 * IDEAL.radius_m - 1e-6
    occurrences = simulation.take_occurrences()
    assert {occurrence.drone for occurrence in occurrences} == {0, 1}
    assert "another drone" in occurrences[0].text


def test_a_drone_landing_on_another_does_not_push_it_into_the_floor() -> None:
    simulation = above_another(replace(TOUGH, restitution=0.0))
    simulation.command(1, Velocity(up=-2.0))
    for _ in range(steps(4)):
        simulation.step()
        assert min(simulation.truth(drone).position_m[2] for drone in (0, 1)) > IDEAL.half_height_m - 1e-6


def test_a_spawn_inside_a_box_is_refused() -> None:
    world = parse_world(
        "[room]\nsize = [5, 5, 3]\n[[box]]\nstands_at = [0, 0]\nsize = [1, 1, 1]\n[[spawn]]\nposition = [0.4, 0, 0]\n"
    )
    with pytest.raises(UsageError, match="leaves no room"):
        Simulation(world)


def test_drones_without_a_spawn_are_placed_apart() -> None:
    positions, _ = Simulation(load_world("empty"), 100).poses()
    apart = np.linalg.norm(positions[:, None] - positions[None], axis=2) + 9 * np.eye(100)
    assert apart.min() > 2 * IDEAL.radius_m
