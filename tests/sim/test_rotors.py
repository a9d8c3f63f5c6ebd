"""Drones modelled down to their rotors, flown by the built-in autopilot like all others."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from skyloop.drivers.uri import parse_uri
from skyloop.errors import UsageError
from skyloop.messages import (
    AnyAction,
    Attitude,
    EmergencyStop,
    FlightState,
    Hover,
    Land,
    ResetEmergency,
    Takeoff,
    Velocity,
)
from skyloop.sim import Limits, Simulation, VehicleParameters, VehicleTruth, Wind, dynamics, load_world, parse_world
from skyloop.sim.parameters import GRAVITY_M_S2, with_ideal_sensors
from skyloop.sim.reports import Occurrence, OccurrenceKind, VehicleFeedback
from skyloop.sim.vehicles import CRAZYFLIE, IRIS, RACER
from skyloop.vehicles.sim.options import options_of
from tests.sim.helpers import HALL, flying, steps

VEHICLES = [RACER, IRIS, CRAZYFLIE]
NAMES = ["racer", "iris", "crazyflie"]

each = pytest.mark.parametrize("vehicle", VEHICLES, ids=NAMES)
set_points = st.builds(Velocity, st.floats(-5, 5), st.floats(-5, 5), st.floats(-2, 2), st.floats(-2, 2)) | st.builds(
    Attitude, st.floats(-0.5, 0.5), st.floats(-0.5, 0.5), st.floats(-2, 2), st.floats(-2, 2)
)
actions = set_points | st.sampled_from([Hover(), Land(), Takeoff(), EmergencyStop()])


class Held:
    """Firmware with constant commands."""

    def __init__(self, *commands: float) -> None:
        self.commands = commands

    def exchange(self, readings: object) -> tuple[float, ...]:
        del readings
        return self.commands


@each
def test_it_takes_off_hovers_flies_and_lands(vehicle: VehicleParameters) -> None:
    simulation = flying(parameters=with_ideal_sensors(vehicle))
    truth = simulation.truth(0)
    assert truth.state is FlightState.HOVERING
    assert truth.position_m[2] - vehicle.half_height_m == pytest.approx(1.0, abs=0.03)
    assert truth.thrust == pytest.approx(1.0, abs=0.02)
    simulation.command(0, Velocity(forward=1.0, left=0.5, yaw_rate=0.0))
    simulation.step(steps(4))
    assert simulation.feedback(0).velocity_m_s == pytest.approx((1.0, 0.5, 0.0), abs=0.06)
    simulation.command(0, Hover())
    simulation.step(steps(4))
    assert simulation.truth(0).velocity_m_s == pytest.approx((0.0, 0.0, 0.0), abs=0.06)
    simulation.command(0, Land())
    simulation.step(steps(5))
    truth = simulation.truth(0)
    assert truth.state is FlightState.LANDED
    assert (truth.roll_rad, truth.pitch_rad, truth.thrust) == pytest.approx((0.0, 0.0, 0.0), abs=1e-3)
    assert not [o for o in simulation.take_occurrences() if o.kind is OccurrenceKind.EMERGENCY]


@each
def test_it_follows_attitude_and_yaw_rate(vehicle: VehicleParameters) -> None:
    simulation = flying(parameters=with_ideal_sensors(vehicle))
    simulation.command(0, Attitude(roll=0.2, pitch=-0.1, yaw_rate=0.8))
    simulation.step(steps(0.8))
    truth = simulation.truth(0)
    assert (truth.roll_rad, truth.pitch_rad) == pytest.approx((0.2, -0.1), abs=0.02)
    assert simulation.feedback(0).angular_velocity_rad_s[2] == pytest.approx(0.8, abs=0.1)
    x, y, z, w = truth.quaternion
    assert math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)) == pytest.approx(truth.yaw_rad)


@each
def test_at_rest_its_accelerometer_reads_gravity(vehicle: VehicleParameters) -> None:
    simulation = Simulation(HALL, parameters=with_ideal_sensors(vehicle))
    simulation.step(10)
    assert simulation.feedback(0).acceleration_m_s2 == pytest.approx((0, 0, GRAVITY_M_S2))
    assert simulation.truth(0).position_m == pytest.approx((0, 0, vehicle.half_height_m), abs=1e-6)


def test_stopped_in_the_air_it_falls_and_rights_itself() -> None:
    vehicle = RACER
    simulation = flying(parameters=with_ideal_sensors(vehicle))
    simulation.command(0, Attitude(roll=0.2))
    simulation.step(steps(0.3))
    simulation.command(0, EmergencyStop())
    simulation.step(steps(0.3))
    assert simulation.truth(0).velocity_m_s[2] < -1.5
    simulation.step(steps(3))
    truth = simulation.truth(0)
    assert truth.state is FlightState.EMERGENCY
    assert truth.position_m[2] == pytest.approx(vehicle.half_height_m, abs=1e-3)
    assert (truth.roll_rad, truth.pitch_rad) == pytest.approx((0, 0), abs=1e-3)
    assert simulation.command(0, ResetEmergency()) == ResetEmergency()
    assert simulation.command(0, Takeoff()) == Takeoff()
    simulation.step(steps(4))
    assert simulation.truth(0).state is FlightState.HOVERING


def test_it_lands_on_a_box_and_takes_off_from_it() -> None:
    world = parse_world(
        "[room]\nsize = [20, 20, 10]\n[[box]]\nname = 'table'\nposition = [0, 0, 0.4]\nsize = [2, 2, 0.8]\n"
        "[[spawn]]\nposition = [2.0, 0, 0]\nyaw_deg = 180\n"
    )
    simulation = flying(world, parameters=with_ideal_sensors(IRIS))
    simulation.command(0, Velocity(forward=0.8))
    while simulation.truth(0).position_m[0] > 0.2:
        simulation.step(10)
    simulation.command(0, Land())
    simulation.step(steps(5))
    truth = simulation.truth(0)
    assert truth.state is FlightState.LANDED
    assert truth.position_m[2] == pytest.approx(0.8 + IRIS.half_height_m, abs=1e-3)
    simulation.command(0, Takeoff())
    simulation.step(steps(4))
    assert simulation.truth(0).position_m[2] == pytest.approx(1.8 + IRIS.half_height_m, abs=0.05)


def test_a_wall_stops_it_and_a_hard_hit_is_a_crash() -> None:
    simulation = flying(parameters=replace(with_ideal_sensors(RACER), crash_speed_m_s=2.0))
    simulation.set_limits(0, Limits(tilt_rad=0.5))
    simulation.command(0, Velocity(forward=5.0))
    simulation.step(steps(5))
    kinds = [occurrence.kind for occurrence in simulation.take_occurrences()]
    assert kinds[:2] == [OccurrenceKind.COLLISION, OccurrenceKind.EMERGENCY]
    truth = simulation.truth(0)
    assert truth.state is FlightState.EMERGENCY
    assert truth.position_m[0] <= 10 - RACER.radius_m + 1e-9


def test_two_of_them_collide_and_separate() -> None:
    world = parse_world(
        "[room]\nsize = [8, 5, 3]\n[[spawn]]\nposition = [-1, 0, 0]\n[[spawn]]\nposition = [1, 0, 0]\nyaw_deg = 180\n"
    )
    simulation = flying(world, 2, parameters=with_ideal_sensors(CRAZYFLIE))
    for drone in range(2):
        simulation.command(drone, Velocity(forward=0.6))
    simulation.step(steps(4))
    hits = [o for o in simulation.take_occurrences() if o.kind is OccurrenceKind.COLLISION]
    assert {hit.drone for hit in hits} == {0, 1}
    assert {hit.text.split(" at ")[0] for hit in hits} == {"hit another drone"}
    apart = math.dist(simulation.truth(0).position_m, simulation.truth(1).position_m)
    assert apart >= 2 * CRAZYFLIE.radius_m - 1e-9


def test_a_turning_platform_takes_it_along() -> None:
    simulation = Simulation(HALL, parameters=with_ideal_sensors(IRIS))
    simulation.step(5)
    simulation._bodies.turn(0, 0.5)
    simulation.step(1)
    assert 0 < simulation.feedback(0).angular_velocity_rad_s[2] < 0.5  # the surface slows it down again


def test_it_can_be_moved() -> None:
    simulation = flying(parameters=with_ideal_sensors(RACER))
    simulation.put(0, (3.0, -2.0, 1.5), 1.0)
    truth = simulation.truth(0)
    assert truth.position_m == (3.0, -2.0, 1.5)
    assert (truth.yaw_rad, truth.thrust) == pytest.approx((1.0, 1.0))
    simulation.step(steps(2))
    assert simulation.truth(0).position_m == pytest.approx((3.0, -2.0, 1.5), abs=0.05)


def test_its_battery_sags_under_load_and_recovers() -> None:
    simulation = flying(parameters=with_ideal_sensors(RACER))
    hovering = simulation.feedback(0).battery_v
    simulation.command(0, Land())
    simulation.step(steps(4))
    assert hovering < simulation.feedback(0).battery_v - 0.1
    assert simulation.truth(0).battery < 1.0


def test_with_an_empty_battery_the_rotors_stop() -> None:
    simulation = flying(parameters=with_ideal_sensors(CRAZYFLIE))
    simulation.set_charge(0, 0.0)
    simulation.step(steps(3))
    truth = simulation.truth(0)
    assert truth.state is FlightState.EMERGENCY
    assert truth.position_m[2] == pytest.approx(CRAZYFLIE.half_height_m, abs=1e-3)


def test_wind_pushes_it_and_the_autopilot_compensates() -> None:
    simulation = flying(parameters=with_ideal_sensors(IRIS), wind=Wind((3.0, 0.0, 0.0)), seconds=12.0)
    truth = simulation.truth(0)
    assert truth.velocity_m_s == pytest.approx((0, 0, 0), abs=0.05)
    assert truth.pitch_rad < -0.02  # leans into it, and it faces east


def test_upside_down_its_angles_and_sensors_are_right_and_it_rights_itself() -> None:
    simulation = flying(parameters=with_ideal_sensors(RACER), seconds=8.0)
    bodies = simulation._rotors
    assert bodies is not None
    simulation.put(0, (0.0, 0.0, 6.0))
    for quaternion in ((0.0, 1.0, 0.0, 0.0), (math.sqrt(0.5), 0.0, math.sqrt(0.5), 0.0)):
        bodies.quaternion[:, 0] = quaternion  # on its back; nose down
        bodies._derive()
        truth = simulation.truth(0)
        rotation = simulation.poses()[1][0]
        assert np.isfinite([truth.roll_rad, truth.pitch_rad, truth.yaw_rad]).all()
        assert rotation @ rotation.T == pytest.approx(np.eye(3))
        assert abs(rotation[2, 2] + (quaternion[0] == 0.0)) < 1e-9
    bodies.quaternion[:, 0] = (math.cos(1.5), math.sin(1.5), 0.0, 0.0)  # 172° of roll
    bodies._derive()
    assert simulation.truth(0).roll_rad == pytest.approx(3.0)
    simulation.step(steps(2))
    truth = simulation.truth(0)
    assert (truth.roll_rad, truth.pitch_rad) == pytest.approx((0, 0), abs=0.1)
    assert truth.position_m[2] > 1.0


# Both ways of computing ----------------------------------------------------------------------------------------------

Flight = tuple[list[VehicleTruth], list[VehicleFeedback], list[Occurrence]]


def fly(commands: list[AnyAction], world: str, seed: int, one_by_one: bool) -> Flight:
    """Fly three different vehicles close to one another and to walls, in gusts; a fourth is flown by firmware."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(dynamics, "FEW", 3 if one_by_one else 0)
        simulation = Simulation(
            HALL if world == "hall" else load_world(world),
            3,
            seed=seed,
            parameters=VEHICLES,
            limits=Limits(tilt_rad=0.5, climb_m_s=2.0, speed_m_s=5.0),
            wind=Wind((0.5, 0.2, 0.0), 0.4),
        )
        simulation.fly_by(1, Held(0.9, 0.9, 0.9, 0.9005))
        for drone in (0, 2):
            simulation.command(drone, Takeoff())
        simulation.step(300)
        truths, estimates = [], []
        for number, action in enumerate(commands):
            simulation.command(number % 2 * 2, action)
            simulation.step(60)
            truths += [simulation.truth(drone) for drone in range(3)]
            estimates += [simulation.feedback(drone) for drone in range(3)]
    return truths, estimates, simulation.take_occurrences()


@settings(max_examples=1, deadline=None)
@example([Attitude(0.3, 0.3), Velocity(-4.0), Attitude(-0.4, 0.2, -1.0), Land(), Land(), EmergencyStop()], "room", 1)
@given(st.lists(actions, min_size=3, max_size=5), st.sampled_from(["hall", "gates", "platform"]), st.integers(0, 99))
def test_numbers_and_arrays_give_the_same_bits(commands: list[AnyAction], world: str, seed: int) -> None:
    assert fly(commands, world, seed, True) == fly(commands, world, seed, False)


def test_only_the_same_seed_gives_the_same_flight() -> None:
    commands: list[AnyAction] = [Velocity(1.0, 0.5, 0.2, 0.3), Attitude(0.2, 0.1)]
    assert fly(commands, "hall", 3, True) == fly(commands, "hall", 3, True)
    assert fly(commands, "hall", 3, True) != fly(commands, "hall", 4, True)


# Options -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("name", "vehicle"), list(zip(NAMES, VEHICLES, strict=True)))
def test_an_address_names_the_vehicle(name: str, vehicle: VehicleParameters) -> None:
    options = options_of(parse_uri(f"sim://?vehicle={name}&noise=0.5"))
    assert options.parameters is vehicle
    noisy = options.vehicle()
    assert noisy.gyro_noise_rad_s == vehicle.gyro_noise_rad_s / 2
    assert noisy.rotors is not None
    assert vehicle.rotors is not None
    assert noisy.rotors.instruments.gyro_noise_rad_s == vehicle.rotors.instruments.gyro_noise_rad_s / 2


def test_vehicles_with_and_without_rotors_do_not_mix() -> None:
    with pytest.raises(UsageError, match="need separate simulations"):
        Simulation(HALL, 2, parameters=[RACER, VehicleParameters()])
