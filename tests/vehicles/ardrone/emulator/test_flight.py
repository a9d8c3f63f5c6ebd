"""The emulated drone's flight logic, on a vehicle that obeys at once."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from skyloop.messages import (
    AnyAction,
    Attitude,
    EmergencyStop,
    FlightState,
    Hover,
    Land,
    ResetEmergency,
    Takeoff,
)
from skyloop.sim.reports import VehicleFeedback
from skyloop.vehicles.ardrone.emulator.configuration import Configuration
from skyloop.vehicles.ardrone.emulator.flight import CALIBRATION_RATE_RAD_S, ProgressCommand, limits_of, set_point
from skyloop.vehicles.ardrone.wire.at import Pcmd, Ref
from skyloop.vehicles.ardrone.wire.navdata import State
from tests.vehicles.ardrone.emulator.rig import RESTING, Bench

S = FlightState
TAKE_OFF, LAND, EMERGENCY = int(Ref.TAKEOFF), 0, int(Ref.EMERGENCY)

TILT, CLIMB, YAW = math.radians(12), 0.7, math.radians(100)  # the factory's limits


def close(action: AnyAction, *values: float) -> bool:
    assert isinstance(action, Attitude)
    return (action.roll, action.pitch, action.climb, action.yaw_rate) == pytest.approx(values, abs=1e-6)


# REF -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("fixed", [0, int(Ref.FIXED)])
@pytest.mark.parametrize(
    ("state", "bits", "told"),
    [
        (S.LANDED, TAKE_OFF, [Takeoff()]),
        (S.LANDED, LAND, []),
        (S.TAKING_OFF, TAKE_OFF, []),
        (S.TAKING_OFF, LAND, [Land()]),
        (S.HOVERING, TAKE_OFF, []),
        (S.HOVERING, LAND, [Land()]),
        (S.FLYING, LAND, [Land()]),
        (S.LANDING, LAND, []),
        (S.LANDING, TAKE_OFF, [Takeoff()]),
        (S.EMERGENCY, TAKE_OFF, []),
        (S.EMERGENCY, LAND, []),
        (S.FLYING, EMERGENCY | TAKE_OFF, [EmergencyStop()]),
        (S.LANDED, EMERGENCY, [EmergencyStop()]),
        (S.EMERGENCY, EMERGENCY, [ResetEmergency()]),
    ],
)
def test_ref(state: FlightState, bits: int, told: list[AnyAction], fixed: int) -> None:
    bench = Bench(state=state)
    bench.say("REF", bits | fixed)
    assert bench.vehicle.told == told


def test_the_emergency_bit_toggles_only_when_it_was_0_before() -> None:
    bench = Bench(state=S.FLYING)
    for _ in range(3):
        bench.say("REF", EMERGENCY)
    assert bench.vehicle.take_commands() == [EmergencyStop()]
    bench.say("REF", 0)
    for _ in range(3):
        bench.say("REF", EMERGENCY)
    assert bench.vehicle.take_commands() == [ResetEmergency()]
    assert bench.vehicle.state is S.LANDED


def test_an_emergency_is_reset_once_the_drone_lies_on_the_ground() -> None:
    bench = Bench(state=S.EMERGENCY)
    bench.vehicle.lying = False
    bench.say("REF", EMERGENCY)
    assert bench.state & State.EMERGENCY
    bench.vehicle.lying = True
    bench.say("REF", EMERGENCY)
    assert bench.vehicle.state is S.LANDED


def test_the_reason_for_an_emergency_is_reported() -> None:
    bench = Bench(state=S.FLYING)
    assert not bench.state & State.EMERGENCY
    bench.say("REF", EMERGENCY)
    bench.wait(0.01)
    assert bench.state & (State.EMERGENCY | State.USER_EMERGENCY) == State.EMERGENCY | State.USER_EMERGENCY
    bench.say("REF", 0)
    bench.say("REF", EMERGENCY)
    bench.wait(0.01)
    assert not bench.state & (State.EMERGENCY | State.USER_EMERGENCY)
    bench.vehicle.state = S.EMERGENCY  # it hit something
    assert bench.state & (State.EMERGENCY | State.USER_EMERGENCY | State.CUTOUT) == State.EMERGENCY | State.CUTOUT


@pytest.mark.parametrize("tilted", [replace(RESTING, roll_rad=1.1), replace(RESTING, pitch_rad=-1.1)])
def test_excessive_angles_cut_the_motors(tilted: VehicleFeedback) -> None:
    bench = Bench(state=S.FLYING)
    bench.wait(0.01, tilted)
    assert bench.vehicle.told == [EmergencyStop()]
    assert bench.state & State.ANGLES_OUT_OF_RANGE
    assert bench.state & State.EMERGENCY
    assert not bench.state & State.FLYING


def test_steep_angles_on_the_ground_are_ignored() -> None:
    bench = Bench()
    bench.wait(0.01, replace(RESTING, roll_rad=1.5))
    assert bench.vehicle.told == []


# Battery -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("low", [replace(RESTING, battery=0.02), replace(RESTING, battery_v=8.9)])
def test_a_low_battery_lands_the_drone_and_keeps_it_there(low: VehicleFeedback) -> None:
    bench = Bench(state=S.HOVERING)
    bench.say("REF", TAKE_OFF)
    bench.wait(0.01, low)
    assert bench.vehicle.take_commands() == [Land()]
    assert bench.state & State.BATTERY_LOW
    bench.vehicle.state = S.LANDED
    bench.say("REF", TAKE_OFF)
    assert bench.vehicle.take_commands() == []


def test_the_low_voltage_is_configurable_with_hysteresis() -> None:
    bench = Bench()
    bench.configure("general:vbat_min", "11000")
    low = []
    for voltage in (11.5, 11.1, 10.9, 11.4, 11.6):
        bench.wait(0.01, replace(RESTING, battery_v=voltage))
        low.append(bench.logic.flight.battery_low)
    assert low == [False, False, True, True, False]


# PCMD ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("values", "expected"),
    [
        ((0.5, 0.0, 0.0, 0.0), (0.5 * TILT, 0.0, 0.0, 0.0)),  # to the right: right side down
        ((0.0, -1.0, 0.0, 0.0), (0.0, TILT, 0.0, 0.0)),  # forward: nose down
        ((0.0, 0.0, 1.0, 0.0), (0.0, 0.0, CLIMB, 0.0)),
        ((0.0, 0.0, 0.0, 0.25), (0.0, 0.0, 0.0, -0.25 * YAW)),  # clockwise
        ((-7.0, 0.0, 0.0, 0.0), (-TILT, 0.0, 0.0, 0.0)),
    ],
)
def test_pcmd_is_scaled_by_the_limits(values: tuple[float, ...], expected: tuple[float, ...]) -> None:
    bench = Bench(state=S.HOVERING)
    bench.say("PCMD", 1, *values)
    assert close(bench.vehicle.told[0], *expected)


def test_configured_limits_apply_at_once() -> None:
    bench = Bench(state=S.HOVERING)
    for key, text in (
        ("control:euler_angle_max", "0.3"),
        ("control:control_vz_max", "1500"),
        ("control:control_yaw", "3.0"),
        ("control:altitude_max", "2000"),
    ):
        bench.configure(key, text)
    bench.say("PCMD", 1, 1.0, 1.0, 1.0, 1.0)
    assert close(bench.vehicle.told[0], 0.3, -0.3, 1.5, -3.0)
    limits = bench.vehicle.limits
    assert (limits.tilt_rad, limits.climb_m_s, limits.yaw_rate_rad_s, limits.altitude_m) == (0.3, 1.5, 3.0, 2.0)
    bench.configure("control:altitude_max", "100000")
    bench.configure("control:euler_angle_max", "0")
    assert bench.vehicle.limits.altitude_m == 100.0
    assert bench.vehicle.limits.tilt_rad == 0.02, "the simulated vehicle's minimum"


def test_without_the_flag_it_hovers() -> None:
    bench = Bench(state=S.FLYING)
    bench.say("PCMD", 0, 1.0, 1.0, 1.0, 1.0)
    assert bench.vehicle.told == [Hover()]


@pytest.mark.parametrize("state", [S.LANDED, S.TAKING_OFF, S.LANDING, S.EMERGENCY])
def test_pcmd_needs_a_flying_drone(state: FlightState) -> None:
    bench = Bench(state=state)
    bench.say("PCMD", 1, 0.1, 0.0, 0.0, 0.0)
    assert bench.vehicle.told == []


def test_numbers_that_are_not_finite_are_ignored() -> None:
    bench = Bench(state=S.HOVERING)
    nan, infinite = 0x7FC00000, 0x7F800000
    bench.say("PCMD", 1, nan, 0, 0, 0)
    bench.say("PCMD", 1, 0, 0, 0, infinite)
    assert bench.vehicle.told == []


@pytest.mark.parametrize(("level", "turns"), [("0", False), ("2", True), ("3", True)])
def test_combined_yaw_turns_with_the_roll_where_it_is_configured(level: str, turns: bool) -> None:
    bench = Bench(state=S.HOVERING)
    bench.configure("control:control_level", level)
    bench.wait(0.01, replace(RESTING, velocity_m_s=(2.0, 0.0, 0.0)))
    bench.say("PCMD", int(Pcmd.PROGRESSIVE | Pcmd.COMBINED_YAW), 0.5, 0.0, 0.0, 0.0)
    action = bench.vehicle.told[0]
    assert isinstance(action, Attitude)
    assert action.yaw_rate == pytest.approx(-9.80665 * math.tan(0.5 * TILT) / 2.0 if turns else 0.0)


@pytest.mark.parametrize(
    ("heading", "yaw_deg", "expected"),
    [
        (0.0, 90.0, (0.0, TILT)),  # both face north: ahead is ahead
        (0.5, 90.0, (TILT, 0.0)),  # the pilot faces east, the drone north: the pilot's ahead is the drone's right
        (0.0, 0.0, (-TILT, 0.0)),  # the drone faces east: north is to its left
        (1.0, 90.0, (0.0, -TILT)),
    ],
)
def test_absolute_control_is_by_the_pilots_heading(heading: float, yaw_deg: float, expected: tuple[float, ...]) -> None:
    bench = Bench(state=S.HOVERING)
    bench.wait(0.01, replace(RESTING, yaw_rad=math.radians(yaw_deg)))
    bench.say("PCMD_MAG", int(Pcmd.PROGRESSIVE | Pcmd.ABSOLUTE), 0.0, -1.0, 0.0, 0.0, heading, 0.1)
    assert close(bench.vehicle.told[0], *expected, 0.0, 0.0)


def test_an_ar_drone_1_has_no_magnetometer() -> None:
    bench = Bench(version=1, state=S.HOVERING)
    bench.say("PCMD_MAG", 1, 0.0, -1.0, 0.0, 0.0, 0.0, 0.0)
    bench.say("CALIB", 0)
    assert bench.vehicle.told == []


@given(
    st.integers(0, 7),
    st.tuples(*[st.floats(width=32)] * 4),
    st.floats(width=32) | st.none(),
    st.floats(-4, 4),
    st.floats(-10, 10),
)
def test_set_points_are_finite(
    flags: int, values: tuple[float, float, float, float], heading: float | None, yaw: float, speed: float
) -> None:
    configuration = Configuration(2)
    configuration.write("control:control_level", "2")
    progress = ProgressCommand(flags, *values, heading)
    if progress.makes_sense:
        assert set_point(progress, configuration, yaw_rad=yaw, forward_m_s=speed).finite


@given(st.floats(0, 1), st.floats(0, 5000), st.floats(0, 10), st.integers(0, 200_000))
def test_any_configuration_gives_possible_limits(tilt: float, climb: float, yaw: float, ceiling: int) -> None:
    configuration = Configuration(2)
    for key, value in (
        ("euler_angle_max", tilt),
        ("control_vz_max", climb),
        ("control_yaw", yaw),
        ("altitude_max", ceiling),
    ):
        assert configuration.write(f"control:{key}", str(value))
    limits_of(configuration)  # would raise


# Trim, calibration, animations ---------------------------------------------------------------------------------


@pytest.mark.parametrize(("state", "trimmed"), [(S.LANDED, True), (S.HOVERING, False), (S.EMERGENCY, False)])
def test_the_flat_trim_needs_a_landed_drone(state: FlightState, trimmed: bool) -> None:
    bench = Bench(state=state)
    bench.wait(0.01, replace(RESTING, roll_rad=0.02, pitch_rad=-0.01))
    bench.say("FTRIM")
    assert bench.logic.flight.trim_rad == ((0.02, -0.01) if trimmed else (0.0, 0.0))


def test_the_magnetometer_is_calibrated_by_a_turn_in_flight() -> None:
    bench = Bench(state=S.LANDED)
    bench.say("CALIB", 0)
    assert bench.vehicle.told == []
    bench.vehicle.state = S.HOVERING
    bench.say("CALIB", 0)
    bench.say("PCMD", 1, 1.0, 0.0, 0.0, 0.0)
    bench.say("CALIB", 0)
    assert bench.vehicle.take_commands() == [Attitude(0.0, 0.0, 0.0, -CALIBRATION_RATE_RAD_S)]
    for _ in range(50):
        bench.say("COMWDG")
        bench.wait(0.1)
    assert bench.vehicle.take_commands() == [Hover()]
    bench.say("PCMD", 1, 1.0, 0.0, 0.0, 0.0)
    assert close(bench.vehicle.told[0], TILT, 0.0, 0.0, 0.0)


@pytest.mark.parametrize("by_key", [False, True])
def test_a_flip_in_flight_is_recorded_only(by_key: bool) -> None:
    bench = Bench()
    for state in (S.LANDED, S.HOVERING):
        bench.vehicle.state = state
        if by_key:
            bench.configure("control:flight_anim", "18,15")
        else:
            bench.say("ANIM", 18, 15)
    flight = bench.logic.flight
    assert flight.animation is not None
    assert flight.animation[0] == 18
    assert flight.flipping(bench.clock())
    assert not flight.flipping(bench.clock.advance(0.015))
    assert bench.vehicle.told == []


# Silence -------------------------------------------------------------------------------------------------------


def test_a_silent_pilot_makes_it_hover_and_then_land() -> None:
    bench = Bench(state=S.HOVERING)
    bench.say("REF", TAKE_OFF)
    bench.say("PCMD", 1, 0.0, -0.5, 0.0, 0.0)
    bench.vehicle.take_commands()
    bench.wait(0.24)
    assert bench.vehicle.told == []
    bench.wait(0.02)
    assert bench.vehicle.take_commands() == [Hover()]
    bench.wait(1.7)
    assert bench.vehicle.told == []
    bench.wait(0.1)
    assert bench.vehicle.take_commands() == [Land()]


def test_the_time_before_the_landing_is_configurable() -> None:
    bench = Bench(state=S.HOVERING)
    bench.configure("general:com_watchdog", "10")
    bench.wait(9.9)
    assert bench.vehicle.told == []
    bench.wait(0.2)
    assert bench.vehicle.told == [Land()]
