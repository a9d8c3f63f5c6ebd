from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from skyloop.errors import UsageError
from skyloop.messages import Attitude, FlightState, Idle, Land, Takeoff
from skyloop.sim import Limits, OccurrenceKind, Simulation, VehicleParameters, Wind
from skyloop.sim.dynamics import STEP_S, WindField
from skyloop.sim.parameters import GRAVITY_M_S2
from skyloop.sim.streams import NormalBlocks, Purpose, stream
from tests.sim.helpers import HALL, IDEAL, flying, steps


def test_hovering_takes_the_power_of_the_parameters() -> None:
    simulation = flying()
    before = simulation.truth(0).battery
    simulation.step(steps(20))
    used_c = (before - simulation.truth(0).battery) * IDEAL.battery_charge_c
    volts = simulation.feedback(0).battery_v
    assert used_c * volts / 20 == pytest.approx(IDEAL.hover_power_w + IDEAL.electronics_power_w, rel=0.03)


def test_the_battery_drains_slowly_on_the_ground_and_sags_in_flight() -> None:
    landed, hovering = Simulation(HALL, parameters=IDEAL), flying()
    landed.step(steps(5))
    assert landed.truth(0).battery > hovering.truth(0).battery
    assert landed.feedback(0).battery_v > hovering.feedback(0).battery_v + 0.2


def test_a_low_battery_lands_the_drone_and_refuses_takeoff() -> None:
    simulation = Simulation(HALL, parameters=IDEAL, charge=0.04)
    simulation.command(0, Takeoff())
    simulation.step(steps(5))
    assert simulation.state(0) is FlightState.HOVERING
    simulation.step(steps(12))
    assert simulation.state(0) is FlightState.LANDED
    (occurrence,) = simulation.take_occurrences()
    assert occurrence.kind is OccurrenceKind.BATTERY_LOW
    assert simulation.command(0, Takeoff()) == Idle()


def test_an_empty_battery_stops_the_motors() -> None:
    # The battery is so small and the drone so high that the landing on the last 3 % can't be finished.
    limits = Limits(takeoff_altitude_m=8.0, altitude_m=9.0)
    parameters = replace(IDEAL, battery_charge_c=1500.0)
    simulation = Simulation(HALL, parameters=parameters, charge=0.1, limits=limits)
    simulation.command(0, Takeoff())
    while simulation.state(0) is not FlightState.EMERGENCY and simulation.time_s < 60:
        simulation.step(25)
    assert simulation.feedback(0).emergency_reason == "battery empty"
    assert simulation.feedback(0).altitude_m > 0.5
    simulation.step(steps(4))
    assert simulation.feedback(0).altitude_m == pytest.approx(0.0, abs=1e-3)


def test_a_fresh_battery_lets_a_drone_fly_again_with_a_new_warning() -> None:
    simulation = Simulation(HALL, parameters=IDEAL)
    for _ in range(2):
        simulation.set_charge(0, 0.02)
        simulation.step(50)
        assert [occurrence.kind for occurrence in simulation.take_occurrences()] == [OccurrenceKind.BATTERY_LOW]
        assert simulation.command(0, Takeoff()) == Idle()
        simulation.set_charge(0, 1.0)
        simulation.step(50)
    assert simulation.command(0, Takeoff()) == Takeoff()
    with pytest.raises(UsageError, match="charge must be from 0 to 1"):
        simulation.set_charge(0, 1.5)


def test_the_wind_can_be_changed_in_flight() -> None:
    simulation = flying()
    simulation.set_wind(Wind((0.0, 1.0, 0.0)))
    simulation.step(10)
    assert simulation.truth(0).wind_m_s == (0.0, 1.0, 0.0)


def test_wind_has_the_requested_mean_deviation_and_memory() -> None:
    period, time_constant, gust = 0.016, 0.5, 0.8
    field = WindField(Wind((1.0, -0.5, 0.2), gust, time_constant), seed=3, drones=20, period_s=period)
    air = np.zeros((3, 20))
    samples = np.empty((6000, 3, 20))
    for k in range(len(samples)):
        field.blow(air)
        samples[k] = air
    assert samples.mean(axis=(0, 2)) == pytest.approx((1.0, -0.5, 0.2), abs=0.05)
    assert samples.std(axis=(0, 2)) == pytest.approx((gust, gust, gust / 2), rel=0.06)
    away = samples - samples.mean(axis=0)
    lag = round(time_constant / period)
    memory = (away[:-lag] * away[lag:]).mean() / (away**2).mean()
    assert memory == pytest.approx(np.exp(-lag * period / time_constant), abs=0.06)
    between = np.corrcoef(away[:, 0, :2].T)[0, 1]
    assert abs(between) < 0.25


def test_wind_pushes_a_drone_that_holds_its_attitude() -> None:
    simulation = flying(wind=Wind((2.0, 0.0, 0.0)))
    simulation.command(0, Attitude())
    simulation.step(steps(4))
    assert simulation.truth(0).velocity_m_s[0] > 1.0
    assert simulation.truth(0).wind_m_s == (2.0, 0.0, 0.0)


def test_sensors_have_the_noise_of_the_parameters() -> None:
    simulation = flying(parameters=VehicleParameters())
    parameters = simulation.parameters[0]
    errors = []
    for _ in range(1500):
        simulation.step(4)
        feedback, truth = simulation.feedback(0), simulation.truth(0)
        errors.append(
            [
                feedback.roll_rad - truth.roll_rad,
                feedback.yaw_rad - truth.yaw_rad,
                feedback.angular_velocity_rad_s[1] - truth.angular_velocity_rad_s[1],
            ]
        )
    noise = np.std(np.diff(errors, axis=0), axis=0) / np.sqrt(2)  # differences remove the slow bias
    wanted = (parameters.tilt_noise_rad, parameters.yaw_noise_rad, parameters.gyro_noise_rad_s)
    assert noise == pytest.approx(wanted, rel=0.1)
    bias = np.abs(np.mean(errors, axis=0))
    assert np.all(bias < 4 * np.array([parameters.tilt_bias_rad, parameters.yaw_bias_rad, parameters.gyro_bias_rad_s]))


def test_ideal_sensors_tell_the_truth() -> None:
    simulation = flying()
    feedback, truth = simulation.feedback(0), simulation.truth(0)
    assert feedback.yaw_rad == pytest.approx(truth.yaw_rad)
    assert feedback.altitude_m == pytest.approx(truth.position_m[2] - IDEAL.half_height_m, abs=5e-3)
    assert feedback.angular_velocity_rad_s == pytest.approx(truth.angular_velocity_rad_s)


@pytest.mark.parametrize("hovers", [True, False])
def test_an_accelerometer_at_rest_reads_gravity_upwards(hovers: bool) -> None:
    simulation = flying()
    simulation.step(steps(5))
    if not hovers:
        simulation.command(0, Land())
        simulation.step(steps(6))
    assert simulation.feedback(0).acceleration_m_s2 == pytest.approx((0, 0, GRAVITY_M_S2), abs=0.05)


def test_streams_are_independent_and_repeatable() -> None:
    assert stream(1, Purpose.WIND, 0).random() == stream(1, Purpose.WIND, 0).random()
    numbers = {stream(s, p, i).random() for s in (1, 2) for p in Purpose for i in (0, 1)}
    assert len(numbers) == 4 * len(Purpose)


def test_a_drones_random_numbers_do_not_depend_on_other_drones() -> None:
    few, many = (NormalBlocks(1, Purpose.WIND, 3, n, ahead=4) for n in (1, 5))
    for _ in range(10):
        assert np.array_equal(few.take()[:, 0], many.take()[:, 0])


def test_gusts_leave_sensor_noise_unchanged() -> None:
    calm, gusty = (Simulation(HALL, seed=1, wind=Wind(gust_m_s=g)) for g in (0.0, 1.0))
    for simulation in (calm, gusty):
        simulation.step(round(1 / STEP_S))
    # Drones on the ground are not moved by gusts.
    assert calm.feedback(0) == gusty.feedback(0)
