"""Drones flown by firmware, and the instruments that it reads."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import pytest

from skyloop.errors import UsageError
from skyloop.messages import EmergencyStop, FlightState, Hover, Takeoff
from skyloop.sim import Simulation, VehicleParameters, World, load_world, parse_world
from skyloop.sim.instruments import MAGNETIC_FIELD_GAUSS, Firmware, Instruments, Readings, geodetic, local, pressure_pa
from skyloop.sim.parameters import GRAVITY_M_S2, InstrumentParameters, with_ideal_sensors
from skyloop.sim.reports import OccurrenceKind
from skyloop.sim.solids import Solids
from skyloop.sim.targets import TargetTrack
from skyloop.sim.vehicles import CRAZYFLIE, IRIS, RACER
from skyloop.sim.world import Vec3
from tests.sim.helpers import HALL, flying, steps

VEHICLES = pytest.mark.parametrize("vehicle", [RACER, IRIS, CRAZYFLIE], ids=["racer", "iris", "crazyflie"])
IDEAL = {vehicle.mass_kg: with_ideal_sensors(vehicle) for vehicle in (RACER, IRIS, CRAZYFLIE)}
STILL = (0.0, 0.0, 0.0)


class Scripted:
    """Firmware that records its readings and takes its commands from a function."""

    def __init__(self, fly: Callable[[Readings], Sequence[float] | None]) -> None:
        self.fly = fly
        self.readings: list[Readings] = []

    def exchange(self, readings: Readings) -> Sequence[float] | None:
        self.readings.append(readings)
        return self.fly(readings)

    @property
    def last(self) -> Readings:
        return self.readings[-1]


class Hovering:
    """A very simple flight controller that uses only its instruments.

    Attitude: gyro, slowly corrected towards the accelerometer's down. Height: barometer. Horizontal motion: flow
    sensor.
    """

    def __init__(self, vehicle: VehicleParameters, height_m: float) -> None:
        rotors = vehicle.rotors
        assert rotors is not None
        self.height_m = height_m
        self.hover = (math.sqrt(vehicle.mass_kg * GRAVITY_M_S2 / 4 / rotors.thrust_n_s2) - rotors.idle_speed_rad_s) / (
            rotors.full_speed_rad_s - rotors.idle_speed_rad_s
        )
        ix, iy, iz = rotors.inertia_kg_m2
        (x, y), *_ = rotors.places_m
        # Commands per rad/s²: change of one rotor's thrust with its command.
        hover = self.hover * (rotors.full_speed_rad_s - rotors.idle_speed_rad_s) + rotors.idle_speed_rad_s
        slope = 2 * rotors.thrust_n_s2 * hover * (rotors.full_speed_rad_s - rotors.idle_speed_rad_s)
        self.gains = ix / (4 * y * slope), iy / (4 * x * slope), iz / (4 * rotors.torque_m * slope)
        self.roll = self.pitch = self.climb = self.forward = self.left = 0.0
        self.height = 0.0
        self.ground_pa: float | None = None

    def exchange(self, readings: Readings) -> tuple[float, ...]:
        p, q, r = readings.gyro_rad_s
        fx, fy, fz = readings.acceleration_m_s2
        self.roll += p * 0.001 + 0.0003 * (math.atan2(fy, fz) - self.roll)
        self.pitch += q * 0.001 + 0.0003 * (math.atan2(-fx, fz) - self.pitch)
        if self.ground_pa is None:
            self.ground_pa = readings.pressure_pa
        measured = (self.ground_pa - readings.pressure_pa) / 11.3  # Pa per metre there
        self.climb += (fz * math.cos(self.roll) * math.cos(self.pitch) - GRAVITY_M_S2) * 0.001
        self.height += self.climb * 0.001
        self.height += 0.003 * (measured - self.height)
        self.climb += 0.004 * (measured - self.height)
        flow = readings.flow
        if flow is not None and flow.quality > 0 and readings.range_m is not None:
            scale = readings.range_m / flow.interval_s
            self.forward = (flow.gyro_left_rad - flow.about_left_rad) * scale
            self.left = (flow.about_forward_rad - flow.gyro_forward_rad) * scale
        roll = min(max(0.15 * self.left, -0.2), 0.2)  # roll right side down accelerates to the right
        pitch = min(max(-0.15 * self.forward, -0.2), 0.2)
        collective = self.hover + 0.06 * (self.height_m - self.height) - 0.08 * self.climb
        gain_p, gain_q, gain_r = self.gains
        roll_by = gain_p * (40 * (roll - self.roll) - 12 * p)
        pitch_by = gain_q * (40 * (pitch - self.pitch) - 12 * q)
        yaw_by = gain_r * -3 * r
        return (
            collective + roll_by - pitch_by + yaw_by,
            collective - roll_by - pitch_by - yaw_by,
            collective + roll_by + pitch_by - yaw_by,
            collective - roll_by + pitch_by + yaw_by,
        )


def ideal(vehicle: VehicleParameters) -> VehicleParameters:
    return IDEAL[vehicle.mass_kg]


def standing(firmware: Firmware, vehicle: VehicleParameters = IRIS, world: World = HALL, seed: int = 1) -> Simulation:
    """Return a simulation with a drone on the ground, flown by firmware."""
    simulation = Simulation(world, seed=seed, parameters=vehicle)
    simulation.fly_by(0, firmware)
    return simulation


def idle(_: Readings) -> tuple[float, ...]:
    return (0.0, 0.0, 0.0, 0.0)


@VEHICLES
def test_a_simple_controller_hovers_with_its_instruments(vehicle: VehicleParameters) -> None:
    simulation = standing(Hovering(vehicle, 1.5), vehicle)
    simulation.step(steps(6))
    for _ in range(20):
        simulation.step(steps(0.2))
        truth = simulation.truth(0)
        assert simulation.state(0) is FlightState.FLYING
        assert truth.position_m[2] == pytest.approx(1.5, abs=1.0)  # its barometer drifts
        assert math.hypot(truth.roll_rad, truth.pitch_rad) < math.radians(8)
        assert math.hypot(*truth.velocity_m_s) < 0.6
    assert simulation.take_occurrences() == []


def test_it_is_called_each_millisecond_with_readings_and_truth() -> None:
    firmware = Scripted(idle)
    simulation = Simulation(HALL, parameters=ideal(IRIS))
    simulation.step(3)
    simulation.fly_by(0, firmware)
    simulation.step(4)
    assert [round(reading.time_s * 1000) for reading in firmware.readings] == list(range(12, 28))
    last = firmware.last
    assert last.position_m == pytest.approx((0, 0, IRIS.half_height_m), abs=1e-3)
    assert last.velocity_m_s == last.rates_rad_s == last.gyro_rad_s == STILL
    assert last.quaternion == (1.0, 0.0, 0.0, 0.0)
    assert last.acceleration_m_s2 == pytest.approx((0, 0, GRAVITY_M_S2))
    assert last.battery_v == pytest.approx(12.6, abs=0.01)


def test_commands_are_clamped_and_stay_in_force_until_new_ones_arrive() -> None:
    asked = {0.0: (2.0, 2.0, 2.0, 2.0), 0.5: (-1.0, -1.0, -1.0, -1.0)}
    firmware = Scripted(lambda readings: asked.get(readings.time_s))
    simulation = standing(firmware, ideal(RACER))
    simulation.step(steps(0.12))
    assert simulation.truth(0).thrust > 3.0  # full, less the battery's sag and the effect of the climb
    simulation.step(steps(1.0))
    assert simulation.truth(0).thrust == pytest.approx(0.0, abs=0.01)


@pytest.mark.parametrize("commands", [(0.5, 0.5, 0.5), (0.5, 0.5, 0.5, math.nan)])
def test_invalid_commands_end_the_step_with_an_error(commands: tuple[float, ...]) -> None:
    simulation = standing(Scripted(lambda _: commands))
    with pytest.raises(UsageError, match="4 finite rotor commands, front left first"):
        simulation.step()


def test_the_built_in_autopilot_leaves_it_alone() -> None:
    simulation = standing(Scripted(idle), ideal(IRIS))
    assert simulation.flown_by_firmware(0)
    for command in (lambda: simulation.command(0, Takeoff()), lambda: simulation.put(0, (0.0, 0.0, 1.0))):
        with pytest.raises(UsageError, match="firmware flies drone 0"):
            command()
    with pytest.raises(UsageError, match="firmware flies drone 0"):
        simulation.fly_by(0, Scripted(idle))
    simulation.set_charge(0, 0.01)
    simulation.step(100)
    assert simulation.state(0) is FlightState.LANDED
    assert [o.kind for o in simulation.take_occurrences()] == [OccurrenceKind.BATTERY_LOW]


def test_drones_that_firmware_cannot_fly_are_refused_with_the_reason() -> None:
    with pytest.raises(UsageError, match="RACER, IRIS and CRAZYFLIE"):
        Simulation(HALL).fly_by(0, Scripted(idle))
    simulation = flying(parameters=ideal(IRIS))
    with pytest.raises(UsageError, match=r"in the air \(hovering\): firmware can take over only on the ground"):
        simulation.fly_by(0, Scripted(idle))
    with pytest.raises(UsageError, match="no firmware flies drone 0"):
        simulation.release(0)
    with pytest.raises(UsageError, match="no drone 1"):
        simulation.fly_by(1, Scripted(idle))


def test_its_state_is_landed_while_idle_on_the_ground_and_flying_otherwise() -> None:
    firmware = Scripted(idle)
    simulation = standing(firmware, ideal(IRIS))
    simulation.step()
    assert simulation.state(0) is FlightState.LANDED
    firmware.fly = lambda _: (0.1, 0.1, 0.1, 0.1)  # armed, and idle
    simulation.step(steps(0.5))
    assert simulation.state(0) is FlightState.LANDED
    firmware.fly = lambda _: (0.3, 0.3, 0.3, 0.3)  # the rotors turn, and it is still on the ground
    simulation.step(steps(0.5))
    assert simulation.state(0) is FlightState.FLYING
    assert simulation.truth(0).position_m[2] == pytest.approx(IRIS.half_height_m, abs=1e-3)
    firmware.fly = lambda _: (1.0, 1.0, 1.0, 1.0)
    simulation.step(steps(1))
    assert bool(simulation.airborne()[0])
    firmware.fly = idle
    simulation.step(steps(0.1))
    assert simulation.state(0) is FlightState.FLYING  # it falls
    simulation.step(steps(3))
    assert simulation.state(0) is FlightState.LANDED


def test_collisions_are_reported_and_stop_no_rotor() -> None:
    world = parse_world("[room]\nsize = [6, 6, 3]\n")
    simulation = standing(Scripted(lambda _: (0.6, 0.6, 0.6, 0.6)), replace(ideal(RACER), crash_speed_m_s=0.5), world)
    simulation.step(steps(1.5))  # up to the ceiling
    assert [o.kind for o in simulation.take_occurrences()][:1] == [OccurrenceKind.COLLISION]
    assert simulation.state(0) is FlightState.FLYING
    assert simulation.truth(0).thrust > 0.5


def test_the_autopilot_takes_over_a_drone_released_on_the_ground() -> None:
    simulation = standing(Scripted(idle), ideal(IRIS))
    simulation.step()
    simulation.release(0)
    assert not simulation.flown_by_firmware(0)
    assert simulation.command(0, Takeoff()) == Takeoff()
    simulation.step(steps(4))
    assert simulation.state(0) is FlightState.HOVERING


def test_a_drone_released_in_the_air_falls_in_an_emergency_and_firmware_may_take_it_again() -> None:
    simulation = standing(Scripted(lambda _: (0.95, 0.95, 0.95, 0.95)), ideal(IRIS))
    simulation.step(steps(1.5))
    simulation.release(0)
    assert simulation.state(0) is FlightState.EMERGENCY
    assert simulation.feedback(0).emergency_reason == "taken from its firmware in the air"
    with pytest.raises(UsageError, match="emergency"):
        simulation.fly_by(0, Scripted(idle))  # it falls
    simulation.step(steps(3))
    assert simulation.truth(0).position_m[2] == pytest.approx(IRIS.half_height_m, abs=1e-3)
    simulation.fly_by(0, Scripted(idle))
    assert simulation.state(0) is FlightState.LANDED


def test_with_an_empty_battery_the_rotors_stop() -> None:
    simulation = standing(Scripted(lambda _: (0.9, 0.9, 0.9, 0.9)), ideal(RACER))
    simulation.step(steps(0.5))
    simulation.set_charge(0, 0.0)
    simulation.step(steps(0.5))
    assert simulation.truth(0).thrust < 0.01
    assert simulation.feedback(0).battery_v == 0.0


def test_another_drone_is_flown_as_usual() -> None:
    simulation = Simulation(HALL, 2, parameters=ideal(CRAZYFLIE))
    simulation.fly_by(1, Scripted(idle))
    simulation.command(0, Takeoff())
    simulation.step(steps(4))
    assert (simulation.state(0), simulation.state(1)) == (FlightState.HOVERING, FlightState.LANDED)
    simulation.command(0, Hover())
    simulation.command(0, EmergencyStop())
    assert simulation.state(0) is FlightState.EMERGENCY


def test_a_racer_flips() -> None:
    """Left rotors faster than right ones for a moment, then the reverse: one turn about the forward axis."""

    def flip(readings: Readings) -> tuple[float, ...]:
        t = readings.time_s
        if t < 0.8:
            return (0.8,) * 4
        rate = 12.0 if t < 1.3 else 0.0
        more = 0.02 * (rate - readings.rates_rad_s[0])
        return (0.4 + more, 0.4 - more, 0.4 + more, 0.4 - more)

    firmware = Scripted(flip)
    simulation = standing(firmware, ideal(RACER), parse_world("[room]\nsize = [60, 60, 60]\n"))
    simulation.step(steps(1.6))
    up = [1 - 2 * (r.quaternion[1] ** 2 + r.quaternion[2] ** 2) for r in firmware.readings]
    assert min(up) < -0.99
    assert sum(r.rates_rad_s[0] for r in firmware.readings) * 0.001 > 1.5 * math.pi


def test_the_same_seed_gives_the_same_readings() -> None:
    flights = []
    for seed in (5, 5, 6):
        firmware = Scripted(lambda _: (0.9, 0.9, 0.9, 0.9))
        standing(firmware, IRIS, seed=seed).step(200)
        flights.append(firmware.readings)
    assert flights[0] == flights[1]
    assert flights[0] != flights[2]


# Instruments ---------------------------------------------------------------------------------------------------------


def instruments(vehicle: VehicleParameters, below_m: float = math.inf, **changes: float) -> Instruments:
    assert vehicle.rotors is not None
    rotors = replace(vehicle.rotors, instruments=replace(vehicle.rotors.instruments, **changes))
    return Instruments(replace(vehicle, rotors=rotors), 0, 7, lambda _point, _direction: below_m)


def read(
    one: Instruments,
    count: int,
    position: Vec3 = (0.0, 0.0, 1.0),
    velocity: Vec3 = STILL,
    quaternion: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0),
    rates: Vec3 = STILL,
) -> list[Readings]:
    force = (0.0, 0.0, GRAVITY_M_S2)
    return [one.read(step, position, velocity, quaternion, rates, force, 12.0, 1.0) for step in range(count)]


def test_noise_and_bias_match_the_parameters() -> None:
    readings = read(instruments(IRIS), 20_000)
    errors = InstrumentParameters()
    gyro = np.array([reading.gyro_rad_s for reading in readings])
    force = np.array([reading.acceleration_m_s2 for reading in readings])
    field = np.array([reading.magnetic_gauss for reading in readings[::10]])
    pressure = np.array([[reading.pressure_pa] for reading in readings[::20]])

    def noise(samples: np.typing.NDArray[np.float64]) -> list[float]:
        """Return the deviation between successive samples, which the wandering bias hardly affects."""
        return (np.diff(samples, axis=0).std(axis=0) / math.sqrt(2)).tolist()  # type: ignore[no-any-return]

    assert noise(gyro) == pytest.approx([errors.gyro_noise_rad_s] * 3, rel=0.05)
    assert noise(force) == pytest.approx([errors.accelerometer_noise_m_s2] * 3, rel=0.05)
    assert noise(field) == pytest.approx([errors.magnetometer_noise_gauss] * 3, rel=0.1)
    assert noise(pressure) == pytest.approx([errors.barometer_noise_pa], rel=0.1)
    assert (np.abs(gyro.mean(axis=0)) < 4 * errors.gyro_bias_rad_s).all()
    assert (np.abs(gyro.mean(axis=0)) > 1e-5).all()
    assert pressure.mean() == pytest.approx(pressure_pa(1.0), abs=4 * errors.barometer_bias_pa)


def test_gyro_biases_last_and_accelerometer_biases_wander() -> None:
    one = instruments(IRIS, gyro_noise_rad_s=0.0, accelerometer_noise_m_s2=0.0)
    first, *_, last = read(one, 30_000)
    errors = InstrumentParameters()
    moved = np.abs(np.subtract(last.gyro_rad_s, first.gyro_rad_s))
    assert 0.0 < moved.max() < 0.15 * errors.gyro_bias_rad_s  # 0.045 of it, 1 σ: the heading drifts slowly
    moved = np.abs(np.subtract(last.acceleration_m_s2, first.acceleration_m_s2))
    assert moved.max() > 0.15 * errors.accelerometer_bias_m_s2


def test_gps_arrives_at_its_rate_with_its_delay() -> None:
    errors = InstrumentParameters()
    fixes = [(reading.time_s, reading.gps) for reading in read(instruments(IRIS), 2000) if reading.gps is not None]
    assert [round(time * 1000) for time, _ in fixes] == list(range(120, 2000, 100))
    for time, fix in fixes:
        assert time - fix.time_s == pytest.approx(errors.gps_delay_s)
        east, north, up = local(fix.latitude_deg, fix.longitude_deg, fix.altitude_m)
        assert math.hypot(east, north) < 4 * fix.horizontal_error_m
        assert abs(up - 1.0) < 4 * fix.vertical_error_m
    assert len({fix.latitude_deg for _, fix in fixes}) == len(fixes)


def test_the_field_of_the_earth_turns_with_the_body() -> None:
    east, north, up = MAGNETIC_FIELD_GAUSS
    half = math.sqrt(0.5)
    one = ideal(IRIS)
    assert read(instruments(one), 1)[0].magnetic_gauss == pytest.approx((east, north, up))
    north_wards = read(instruments(one), 1, quaternion=(half, 0.0, 0.0, half))[0]
    assert north_wards.magnetic_gauss == pytest.approx((north, -east, up))
    on_its_side = read(instruments(one), 1, quaternion=(half, half, 0.0, 0.0))[0]  # right side down
    assert on_its_side.magnetic_gauss == pytest.approx((east, up, -north))


def test_flow_is_the_motion_seen_by_a_camera() -> None:
    one = ideal(IRIS)
    still = read(instruments(one, 2.0), 40, rates=(0.3, -0.2, 0.0))
    moving = read(instruments(one, 2.0), 40, velocity=(1.0, 0.5, 0.0))
    samples = [[r.flow for r in readings if r.flow is not None] for readings in (still, moving)]
    assert [len(some) for some in samples] == [2, 2]
    turned, moved = samples[0][1], samples[1][1]
    assert (turned.interval_s, turned.quality) == (0.02, 1.0)
    assert (turned.about_forward_rad, turned.about_left_rad) == pytest.approx((0.006, -0.004))
    assert (turned.gyro_forward_rad, turned.gyro_left_rad) == pytest.approx((0.006, -0.004))
    assert (moved.about_forward_rad, moved.about_left_rad) == pytest.approx((0.005, -0.01))
    assert (moved.gyro_forward_rad, moved.gyro_left_rad) == (0.0, 0.0)


@pytest.mark.parametrize(("below_m", "range_m", "quality"), [(3.0, 3.0, 1.0), (0.05, 0.05, 0.0), (9.0, None, 0.0)])
def test_out_of_range_there_is_neither_range_nor_flow(below_m: float, range_m: float | None, quality: float) -> None:
    readings = read(instruments(ideal(IRIS), below_m), 20, velocity=(1.0, 0.0, 0.0))
    assert readings[-1].range_m == range_m
    flow = readings[-1].flow
    assert flow is not None
    assert flow.quality == quality
    assert (flow.about_left_rad == 0.0) is (quality == 0.0)


def test_the_range_finder_sees_boxes_platforms_and_the_floor() -> None:
    world = parse_world(
        "[room]\nsize = [20, 20, 5]\n"
        "[[box]]\nname = 'table'\nposition = [2, 0, 0.4]\nsize = [2, 1, 0.8]\nyaw_deg = 30\n"
    )
    solids = Solids(world, ())
    down, slanting = (0.0, 0.0, -1.0), (math.sin(0.4), 0.0, -math.cos(0.4))
    assert solids.distance_along((0.0, 0.0, 2.0), down, 0.0) == pytest.approx(2.0)
    assert solids.distance_along((2.0, 0.0, 2.0), down, 0.0) == pytest.approx(1.2)
    assert solids.distance_along((0.0, 0.0, 2.0), slanting, 0.0) == pytest.approx(2.0 / math.cos(0.4))
    assert solids.distance_along((1.0, 0.0, 2.0), slanting, 0.0) == pytest.approx(1.2 / math.cos(0.4))
    assert solids.distance_along((0.0, 0.0, 2.0), (0.0, 0.0, 1.0), 0.0) == pytest.approx(3.0)  # the ceiling
    assert solids.distance_along((0.0, 0.0, 2.0), (0.0, -1.0, 0.0), 0.0) == pytest.approx(10.0)  # a wall
    assert solids.distance_along((2.0, 0.0, 0.4), down, 0.0) == 0.0  # inside
    outdoors = Solids(parse_world("[room]\nsize = [20, 20, 5]\nenclosed = false\n"), ())
    assert math.isinf(outdoors.distance_along((0.0, 0.0, 2.0), (0.0, 0.0, 1.0), 0.0))


def test_the_range_finder_follows_a_platform() -> None:
    world = load_world("platform")
    tracks = tuple(TargetTrack(target, world.seed, n) for n, target in enumerate(world.targets))
    solids = Solids(world, tracks)
    state = tracks[0].at(5.0)
    x, y, top = state.position_m
    assert solids.distance_along((x, y, top + 1.0), (0.0, 0.0, -1.0), 5.0) == pytest.approx(1.0)


def test_positions_on_earth_and_back() -> None:
    for place in ((0.0, 0.0, 0.0), (120.0, -45.0, 30.0)):
        assert local(*geodetic(place)) == pytest.approx(place, abs=1e-6)
    latitude, longitude, altitude = geodetic((0.0, 1852.0, 0.0))
    assert latitude - geodetic(STILL)[0] == pytest.approx(1 / 60, rel=2e-3)  # a nautical mile
    assert (longitude, altitude) == (geodetic(STILL)[1], 488.0)


def test_the_standard_atmosphere() -> None:
    assert pressure_pa(-488.0) == pytest.approx(101325.0)
    assert pressure_pa(512.0) == pytest.approx(89874.6, abs=1.0)  # at 1000 m, ISO 2533
