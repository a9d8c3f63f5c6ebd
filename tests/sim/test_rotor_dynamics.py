"""Formulas of the rotor-level model: laws of physics, for any state."""

from __future__ import annotations

import math
import re
from dataclasses import fields, replace
from typing import Any

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from skyloop.errors import UsageError
from skyloop.sim.dynamics import ARRAYS, NUMBERS, Operations
from skyloop.sim.parameters import GRAVITY_M_S2, InstrumentParameters, VehicleParameters, with_ideal_sensors
from skyloop.sim.rotor_dynamics import (
    PLANT_STEP_S,
    Constants,
    advance,
    all_constants,
    constants_of,
    electric_power,
    load,
    mix,
    rotation,
    spin,
)
from skyloop.sim.vehicles import CRAZYFLIE, IRIS, RACER
from tests.support.pages import rows, section

VEHICLES = [RACER, IRIS, CRAZYFLIE]
CONSTANTS = [constants_of(vehicle) for vehicle in VEHICLES]
STILL, UNTOUCHED, LEVEL = (0.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0)
HIGH = 100.0  # no ground effect

which = st.sampled_from(range(3))
rates = st.tuples(*[st.floats(-20, 20)] * 3)
velocities = st.tuples(*[st.floats(-20, 20)] * 3)


@st.composite
def quaternions(draw: st.DrawFn) -> tuple[float, float, float, float]:
    values = draw(st.tuples(*[st.floats(-1, 1)] * 4))
    size = math.sqrt(sum(value * value for value in values))
    assume(size > 0.1)
    w, x, y, z = (value / size for value in values)
    return w, x, y, z


def motion(velocity: tuple[float, ...], height: float = HIGH) -> tuple[float, ...]:
    """Return the motion in still air."""
    return (0.0, 0.0, 0.0, 0.0, 0.0, height, *velocity)


def without_air(constants: Constants) -> Constants:
    return replace(constants, drag_x=0.0, drag_y=0.0, drag_z=0.0, rotor_drag=0.0, inflow=0.0)


def energy(moved: tuple[float, ...]) -> float:
    _, _, z, vx, vy, vz = moved
    return GRAVITY_M_S2 * z + (vx * vx + vy * vy + vz * vz) / 2


@given(which, quaternions(), velocities)
def test_a_body_in_vacuum_keeps_its_energy(
    one: int, quaternion: tuple[float, ...], velocity: tuple[float, ...]
) -> None:
    turning, state = (*quaternion, 0.0, 0.0, 0.0), (0.0, 0.0, HIGH, *velocity)
    start = energy(state)
    for _ in range(50):
        turning, state, force, thrust = advance(
            NUMBERS, without_air(CONSTANTS[one]), turning, STILL, 0.0, (0.0, 0.0, 0.0, *state), UNTOUCHED, False
        )
        assert force == (0.0, 0.0, 0.0)
        assert thrust == 0.0
    assert energy(state) == pytest.approx(start, rel=1e-9)


@given(which, quaternions(), rates, velocities)
def test_air_takes_energy_from_a_body_with_stopped_rotors(
    one: int, quaternion: tuple[float, ...], turning: tuple[float, ...], velocity: tuple[float, ...]
) -> None:
    _, moved, force, _ = advance(
        NUMBERS, CONSTANTS[one], (*quaternion, *turning), STILL, 0.0, motion(velocity), UNTOUCHED, False
    )
    # To second order in the step: a force held constant for a step overshoots by this amount.
    spare = sum(f * f for f in force) * PLANT_STEP_S**2
    assert energy(moved) <= energy((0.0, 0.0, HIGH, *velocity)) + spare + 1e-9


@given(which, st.floats(-math.pi, math.pi))
def test_in_hover_thrust_balances_weight_whatever_the_heading(one: int, yaw: float) -> None:
    constants = CONSTANTS[one]
    speed = math.sqrt(GRAVITY_M_S2 * constants.collective / constants.thrust)
    turning = (math.cos(yaw / 2), 0.0, 0.0, math.sin(yaw / 2), 0.0, 0.0, 0.0)
    turned, moved, force, thrust = advance(
        NUMBERS, constants, turning, (speed,) * 4, 0.0, motion((0.0, 0.0, 0.0)), UNTOUCHED, False
    )
    assert moved == pytest.approx((0.0, 0.0, HIGH, 0.0, 0.0, 0.0), abs=1e-6)
    assert force == pytest.approx((0.0, 0.0, GRAVITY_M_S2), rel=1e-5)
    assert thrust == pytest.approx(GRAVITY_M_S2, rel=1e-9)
    assert turned[4:] == pytest.approx((0.0, 0.0, 0.0), abs=1e-3)


@given(
    st.sampled_from([0, 2]),  # the Iris is not symmetric front to rear
    st.tuples(*[st.floats(100, 2000)] * 4),
    rates,
    velocities,
)
def test_a_mirrored_vehicle_flies_a_mirrored_path(
    one: int, speeds: tuple[float, ...], turning: tuple[float, ...], velocity: tuple[float, ...]
) -> None:
    constants = CONSTANTS[one]
    (front_left, front_right, rear_left, rear_right), (p, q, r), (vx, vy, vz) = speeds, turning, velocity
    mirrored = (front_right, front_left, rear_right, rear_left)
    turned, moved, force, _ = advance(
        NUMBERS, constants, (*LEVEL, p, q, r), (front_left, front_right, rear_left, rear_right), 0.5,
        motion((vx, vy, vz)), UNTOUCHED, False,
    )  # fmt: skip
    other_turned, other_moved, other_force, _ = advance(
        NUMBERS, constants, (*LEVEL, -p, q, -r), mirrored, -0.5, motion((vx, -vy, vz)), UNTOUCHED, False
    )
    w, x, y, z, p, q, r = turned
    assert other_turned == pytest.approx((w, -x, y, -z, -p, q, -r), abs=1e-9)
    px, py, pz, vx, vy, vz = moved
    assert other_moved == pytest.approx((px, -py, pz, vx, -vy, vz), abs=1e-9)
    assert other_force == pytest.approx((force[0], -force[1], force[2]), abs=1e-9)


@given(which, quaternions(), rates, velocities, st.tuples(*[st.floats(0, 800)] * 4))
def test_a_quaternion_stays_a_rotation(
    one: int,
    quaternion: tuple[float, ...],
    turning: tuple[float, ...],
    velocity: tuple[float, ...],
    speeds: tuple[float, float, float, float],
) -> None:
    turned, *_ = advance(
        NUMBERS, CONSTANTS[one], (*quaternion, *turning), speeds, 0.0, motion(velocity, 0.1), (0.0, 0.0, 10.0), True
    )
    w, x, y, z, *_ = turned
    turn: np.typing.NDArray[np.float64] = np.array(rotation(w, x, y, z))
    assert turn @ turn.T == pytest.approx(np.eye(3), abs=1e-12)


@pytest.mark.parametrize("one", range(3))
@pytest.mark.parametrize(
    ("faster", "axis", "sign"),
    [((0, 2), 0, 1), ((1, 3), 0, -1), ((2, 3), 1, 1), ((0, 1), 1, -1), ((0, 3), 2, 1), ((1, 2), 2, -1)],
)
def test_rotors_turn_the_body_according_to_position_and_spin(
    one: int, faster: tuple[int, int], axis: int, sign: int
) -> None:
    """Faster on the left: right side down. Rear: nose down. Front left and rear right, clockwise: to the left."""
    one_s, two_s, three_s, four_s = [500.0 + 50.0 * (rotor in faster) for rotor in range(4)]
    turned, *_ = advance(
        NUMBERS,
        CONSTANTS[one],
        (*LEVEL, 0.0, 0.0, 0.0),
        (one_s, two_s, three_s, four_s),
        0.0,
        motion((0, 0, 0)),
        UNTOUCHED,
        False,
    )
    about = turned[4:]
    assert about[axis] * sign > 0
    # (The Iris's rear rotors are closer to its middle: a yaw command rolls it slightly.)
    if one != 1:
        assert about[axis] * sign == pytest.approx(max(abs(rate) for rate in about))


@given(which, st.tuples(*[st.floats(-1, 1)] * 3), st.floats(8, 11))
def test_the_mixer_produces_the_requested_torques_and_thrust(
    one: int, wanted: tuple[float, float, float], thrust: float
) -> None:
    vehicle, constants = VEHICLES[one], replace(CONSTANTS[one], lead=1.0)
    gains = (constants.rate_gain, constants.rate_gain, constants.yaw_gain)
    want_p, want_q, want_r = (rate / gain for rate, gain in zip(wanted, gains, strict=True))  # ±1 rad/s²
    speeds = mix(NUMBERS, constants, UNTOUCHED, STILL, (want_p, want_q, want_r), thrust, 1.0)
    turned, *_, lift = advance(
        NUMBERS, constants, (*LEVEL, 0.0, 0.0, 0.0), speeds, 0.0, motion((0, 0, 0)), UNTOUCHED, False
    )
    assert lift == pytest.approx(thrust, rel=1e-6)
    assert [rate / PLANT_STEP_S for rate in turned[4:]] == pytest.approx(wanted, abs=1e-6), vehicle


@given(which, rates, rates, st.floats(0, 60), st.floats(0.6, 1.0))
def test_the_mixer_stays_within_the_rotors_limits(
    one: int, now: tuple[float, float, float], wanted: tuple[float, float, float], thrust: float, sag: float
) -> None:
    constants = CONSTANTS[one]
    speeds = (constants.idle_speed,) * 4
    commanded = mix(NUMBERS, constants, now, speeds, wanted, thrust, sag)
    for speed in commanded:
        if thrust == 0.0:
            assert speed == 0.0
        else:
            assert constants.idle_speed * sag <= speed <= constants.full_speed * sag


@given(
    st.lists(
        st.tuples(quaternions(), rates, velocities, st.tuples(*[st.floats(0, 2500)] * 4), rates, st.floats(-5, 30)),
        min_size=3,
        max_size=3,
    )
)
def test_numbers_and_arrays_give_the_same_bits(drones: list[tuple[tuple[float, ...], ...]]) -> None:
    def one_step(
        do: Operations,
        constants: Constants,
        quaternion: Any,
        turning: Any,
        velocity: Any,
        speeds: Any,
        wanted: Any,
        knock: Any,
    ) -> list[Any]:
        targets = mix(do, constants, turning, speeds, wanted, abs(knock), 0.9 + 0 * knock)
        after, twist = spin(do, constants, speeds, targets)
        volts, amps = load(do, constants, electric_power(constants, after), 12.0 + 0 * knock, 11.0 + 0 * knock)
        state = advance(
            do, constants, (*quaternion, *turning), after, twist, (*wanted, *turning, *velocity),
            (knock, -knock, knock), True,
        )  # fmt: skip
        return [*after, twist, volts, amps, *state[0], *state[1], *state[2], state[3]]

    each: list[list[float]] = []
    for constants, (quaternion, turning, velocity, speeds, wanted, knock) in zip(CONSTANTS, drones, strict=True):
        each.append(one_step(NUMBERS, constants, quaternion, turning, velocity, speeds, wanted, knock))
    columns = [np.array(values).T for values in zip(*drones, strict=True)]
    arrays = [*(tuple(some) for some in columns[:-1]), columns[-1]]
    together = one_step(ARRAYS, all_constants(CONSTANTS), *arrays)
    assert np.array(each).T.tolist() == [row.tolist() for row in together]


@pytest.mark.parametrize("vehicle", VEHICLES)
def test_a_rotor_follows_its_command_with_its_lag(vehicle: VehicleParameters) -> None:
    constants, rotors = constants_of(vehicle), vehicle.rotors
    assert rotors is not None
    low, high = rotors.idle_speed_rad_s, rotors.full_speed_rad_s
    for start, end, lag_s in ((low, high, rotors.speed_up_s), (high, low, rotors.speed_down_s)):
        speeds = (start,) * 4
        for _ in range(round(lag_s / PLANT_STEP_S)):
            speeds, twist = spin(NUMBERS, constants, speeds, (end,) * 4)
            assert twist == 0.0
        done = round(lag_s / PLANT_STEP_S) * PLANT_STEP_S / lag_s
        assert (speeds[0] - start) / (end - start) == pytest.approx(1 - math.exp(-done), rel=1e-9)


def test_accelerating_rotors_turn_the_body_the_other_way() -> None:
    slow, fast = 800.0, 900.0
    _, twist = spin(NUMBERS, CONSTANTS[0], (slow,) * 4, (fast, slow, slow, fast))  # the clockwise ones
    assert twist > 0.0
    _, twist = spin(NUMBERS, CONSTANTS[0], (slow,) * 4, (slow, fast, fast, slow))
    assert twist < 0.0


def test_air_from_above_reduces_thrust_and_wind_along_the_rotors_pushes() -> None:
    speeds, turning = (1000.0,) * 4, (*LEVEL, 0.0, 0.0, 0.0)

    def force(velocity: tuple[float, float, float]) -> tuple[float, float, float]:
        return advance(NUMBERS, CONSTANTS[0], turning, speeds, 0.0, motion(velocity), UNTOUCHED, False)[2]

    assert force((0, 0, 3))[2] < force((0, 0, 0))[2] < force((0, 0, -3))[2]
    assert force((3, 0, 0))[0] < 0 < force((-3, 0, 0))[0]


def test_the_floor_lifts_a_drone_above_it_but_not_one_on_its_back() -> None:
    speeds = (1000.0,) * 4

    def lift(height: float, quaternion: tuple[float, ...]) -> float:
        turning = (*quaternion, 0.0, 0.0, 0.0)
        state = motion((0, 0, 0), height)
        return float(advance(NUMBERS, CONSTANTS[0], turning, speeds, 0.0, state, UNTOUCHED, False)[2][2])

    assert lift(0.05, LEVEL) > 1.03 * lift(5.0, LEVEL)
    assert lift(0.05, (0.0, 1.0, 0.0, 0.0)) == pytest.approx(lift(5.0, (0.0, 1.0, 0.0, 0.0)))


def test_a_batterys_power_is_limited_to_half_its_voltage() -> None:
    volts, amps = load(NUMBERS, CONSTANTS[0], 300.0, 16.8, 16.8)
    assert (volts, amps) == pytest.approx((16.8 - 300 / 16.8 * 0.02, 300 / 16.8))
    assert load(NUMBERS, CONSTANTS[0], 1e5, 16.8, 16.8)[0] == 8.4


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"thrust_n_s2": 0.0}, "greater than 0"),
        ({"torque_m": math.nan}, "finite"),
        ({"rotor_drag_kg": -1.0}, "at least 0"),
        ({"efficiency": 1.5}, "efficiency"),
        ({"idle_speed_rad_s": 3000.0}, "below full_speed"),
        ({"inertia_kg_m2": (1.0, 1.0)}, "3 entries"),
        ({"inertia_kg_m2": (1.0, 1.0, 0.0)}, "inertia"),
        ({"body_drag_kg_m": (0.0, -1.0, 0.0)}, "body_drag"),
        ({"places_m": ((0.1, math.inf), (0.1, -0.1), (-0.1, 0.1), (-0.1, -0.1))}, "places_m"),
        ({"places_m": ((0.1, -0.1), (0.1, 0.1), (-0.1, 0.1), (-0.1, -0.1))}, "front left, front right"),
    ],
)
def test_invalid_rotors_are_refused(change: dict[str, object], message: str) -> None:
    assert RACER.rotors is not None
    with pytest.raises(UsageError, match=message):
        replace(RACER.rotors, **change)  # type: ignore[arg-type]


def test_invalid_instruments_are_refused() -> None:
    with pytest.raises(UsageError, match="gps_period_s must be greater than 0"):
        InstrumentParameters(gps_period_s=0.0)
    with pytest.raises(UsageError, match="gyro_noise_rad_s must be at least 0"):
        InstrumentParameters(gyro_noise_rad_s=-1.0)


def test_thrust_must_leave_a_reserve_for_the_attitude() -> None:
    with pytest.raises(UsageError, match="most_thrust 5 of the weight must be below the rotors' maximum"):
        replace(RACER, most_thrust=5.0)
    with pytest.raises(UsageError, match="no rotors"):
        constants_of(VehicleParameters())


def test_ideal_sensors_include_ideal_instruments() -> None:
    ideal = with_ideal_sensors(IRIS).rotors
    assert ideal is not None
    assert ideal.instruments.gyro_noise_rad_s == ideal.instruments.gps_bias_m == 0.0
    assert ideal.instruments.bias_time_constant_s == InstrumentParameters().bias_time_constant_s


def test_the_page_has_the_parameters_of_the_code() -> None:
    for first, *cells in rows(section("docs/rotors.md", "## Parameters"))[:-1]:
        names = re.findall(r"`(\w+)`", first)
        for vehicle, cell in zip(VEHICLES, cells, strict=True):
            values: list[float] = []
            for name in names:
                value = vehicle.mass_kg if name == "mass_kg" else getattr(vehicle.rotors, name)
                values += value if isinstance(value, tuple) else [value]
            assert [float(number) for number in cell.split(", ")] == pytest.approx(values, rel=1e-5), first


def test_the_page_has_the_errors_of_the_instruments() -> None:
    standard = InstrumentParameters()
    table = {row[0]: row[1:3] for row in rows(section("docs/rotors.md", "## Instruments"))}
    names = ["gyro", "accelerometer", "magnetometer", "barometer", "gps", "gps_velocity", "range", "flow"]
    values = {field.name: getattr(standard, field.name) for field in fields(standard)}
    assert len(table) == len(names)
    for name, cells in zip(names, table.values(), strict=True):
        for kind, cell in zip(("noise", "bias"), cells, strict=True):
            found = [value for field, value in values.items() if field.startswith(f"{name}_{kind}_")]
            assert [float(cell.split()[0])] == found if cell else found == []
