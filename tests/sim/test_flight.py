from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from skyloop.errors import UsageError
from skyloop.messages import (
    AnyAction,
    Attitude,
    EmergencyStop,
    FlightState,
    Hover,
    Idle,
    Land,
    ResetEmergency,
    Takeoff,
    Velocity,
)
from skyloop.sim import STEP_S, Limits, OccurrenceKind, Simulation, VehicleParameters, Wind, load_world
from skyloop.sim.autopilot import TRANSITIONS, Happening, next_state
from skyloop.sim.parameters import GRAVITY_M_S2
from tests.sim.helpers import HALL, IDEAL, flying, steps

S, H = FlightState, Happening

TABLE = [
    (S.LANDED, H.TAKEOFF, S.TAKING_OFF),
    (S.LANDED, H.SET_POINT, None),
    (S.LANDED, H.LAND, None),
    (S.LANDED, H.HOVER, None),
    (S.LANDED, H.STOP, S.EMERGENCY),
    (S.LANDED, H.CRASHED, None),
    (S.TAKING_OFF, H.SET_POINT, None),
    (S.TAKING_OFF, H.HOVER, None),
    (S.TAKING_OFF, H.TOUCHED_GROUND, None),
    (S.TAKING_OFF, H.HEIGHT_REACHED, S.HOVERING),
    (S.TAKING_OFF, H.LAND, S.LANDING),
    (S.HOVERING, H.SET_POINT, S.FLYING),
    (S.HOVERING, H.TAKEOFF, None),
    (S.HOVERING, H.TOUCHED_GROUND, None),
    (S.FLYING, H.HOVER, S.HOVERING),
    (S.FLYING, H.LAND, S.LANDING),
    (S.FLYING, H.CRASHED, S.EMERGENCY),
    (S.FLYING, H.BATTERY_LOW, S.LANDING),
    (S.FLYING, H.BATTERY_EMPTY, S.EMERGENCY),
    (S.LANDING, H.SET_POINT, None),
    (S.LANDING, H.HOVER, S.HOVERING),
    (S.LANDING, H.TAKEOFF, S.TAKING_OFF),
    (S.LANDING, H.TOUCHED_GROUND, S.LANDED),
    (S.EMERGENCY, H.TAKEOFF, None),
    (S.EMERGENCY, H.LAND, None),
    (S.EMERGENCY, H.STOP, None),
    (S.EMERGENCY, H.RESET, S.LANDED),
]


@pytest.mark.parametrize(("state", "happening", "after"), TABLE)
def test_flight_states(state: FlightState, happening: Happening, after: FlightState | None) -> None:
    assert next_state(state, happening) is after


def test_every_state_can_be_stopped_and_only_a_reset_leaves_emergency() -> None:
    for state in TRANSITIONS:
        if state is not S.EMERGENCY:
            assert next_state(state, H.STOP) is S.EMERGENCY
    assert list(TRANSITIONS[S.EMERGENCY]) == [H.RESET]


def test_takeoff_climbs_to_a_metre_and_hovers() -> None:
    simulation = Simulation(HALL, parameters=IDEAL)
    assert simulation.command(0, Takeoff()) == Takeoff()
    assert simulation.state(0) is S.TAKING_OFF
    simulation.step(steps(3.0))
    assert simulation.state(0) is S.HOVERING
    highest = 0.0
    for _ in range(100):
        simulation.step(10)
        highest = max(highest, simulation.feedback(0).altitude_m)
    assert highest < 1.15
    assert simulation.feedback(0).altitude_m == pytest.approx(1.0, abs=0.02)


def test_hover_holds_its_position_in_still_air() -> None:
    simulation = flying()
    before = np.array(simulation.truth(0).position_m)
    simulation.step(steps(10))
    after = simulation.truth(0)
    assert np.linalg.norm(np.array(after.position_m) - before) < 0.03
    assert after.thrust == pytest.approx(1.0, abs=0.01)


@pytest.mark.parametrize("seed", range(3))
def test_hover_drifts_little_in_gusts_with_real_sensors(seed: int) -> None:
    wind = Wind((1.0, 0.5, 0.0), 0.4, 1.5)
    simulation = flying(parameters=VehicleParameters(), wind=wind, seed=seed, seconds=10)
    before = np.array(simulation.truth(0).position_m)
    simulation.step(steps(10))
    assert np.linalg.norm(np.array(simulation.truth(0).position_m) - before) < 1.0
    assert simulation.truth(0).position_m[2] == pytest.approx(1.0, abs=0.25)


def test_landing_ends_on_the_ground_with_the_motors_off() -> None:
    simulation = flying()
    simulation.command(0, Velocity(forward=0.5))
    simulation.step(steps(1))
    assert simulation.command(0, Land()) == Land()
    simulation.step(steps(6))
    truth = simulation.truth(0)
    assert truth.state is S.LANDED
    assert truth.thrust == pytest.approx(0.0, abs=1e-6)
    assert truth.position_m[2] == pytest.approx(IDEAL.half_height_m, abs=1e-3)
    assert np.linalg.norm(truth.velocity_m_s) < 0.01
    assert simulation.take_occurrences() == []
    assert simulation.command(0, Takeoff()) == Takeoff()
    simulation.step(steps(4))
    assert simulation.state(0) is S.HOVERING


@pytest.mark.parametrize("action", [Velocity(0.5), Attitude(pitch=0.1), Hover(), Land(), Idle(), ResetEmergency()])
def test_unsuitable_actions_on_the_ground_are_ignored(action: AnyAction) -> None:
    simulation = Simulation(HALL)
    assert simulation.command(0, action) == Idle()
    simulation.step(100)
    assert simulation.state(0) is S.LANDED


def test_an_emergency_stop_drops_the_drone_until_it_is_reset_on_the_ground() -> None:
    simulation = flying()
    simulation.command(0, EmergencyStop())
    assert simulation.command(0, ResetEmergency()) == Idle()  # still in the air
    assert simulation.command(0, Velocity(1.0)) == Idle()
    simulation.step(steps(2))
    truth, feedback = simulation.truth(0), simulation.feedback(0)
    assert truth.state is S.EMERGENCY
    assert feedback.emergency_reason == "stopped by command"
    assert truth.position_m[2] == pytest.approx(IDEAL.half_height_m, abs=1e-3)
    assert simulation.command(0, Takeoff()) == Idle()
    assert simulation.command(0, ResetEmergency()) == ResetEmergency()
    assert simulation.feedback(0).emergency_reason == ""
    simulation.command(0, Takeoff())
    simulation.step(steps(4))
    assert simulation.state(0) is S.HOVERING
    kinds = [occurrence.kind for occurrence in simulation.take_occurrences()]
    assert kinds[0] is OccurrenceKind.EMERGENCY


@pytest.mark.parametrize(
    ("action", "axis", "sign"),
    [
        (Velocity(forward=0.5), 0, 1),
        (Velocity(left=0.5), 1, 1),
        (Velocity(up=0.3), 2, 1),
        (Attitude(pitch=0.1), 0, 1),  # nose down: forward
        (Attitude(roll=0.1), 1, -1),  # right side down: right
        (Attitude(climb=-0.3), 2, -1),
    ],
)
def test_set_points_move_the_drone_the_right_way(action: AnyAction, axis: int, sign: int) -> None:
    simulation = flying()
    before = np.array(simulation.truth(0).position_m)
    assert simulation.command(0, action) == action
    assert simulation.state(0) is S.FLYING
    simulation.step(steps(2))
    moved = np.array(simulation.truth(0).position_m) - before
    assert sign * moved[axis] > 0.3
    assert np.abs(np.delete(moved, axis)).max() < 0.1


def test_velocity_is_in_body_axes_and_yaw_is_counter_clockwise() -> None:
    simulation = flying()
    simulation.command(0, Velocity(yaw_rate=0.5))
    simulation.step(steps(math.pi))  # a quarter turn: the drone now faces north
    assert simulation.truth(0).yaw_rad == pytest.approx(math.pi / 2, abs=0.06)
    simulation.command(0, Velocity(forward=0.5))
    simulation.step(steps(3))
    velocity = simulation.truth(0).velocity_m_s
    assert velocity[1] == pytest.approx(0.5, abs=0.05)
    assert abs(velocity[0]) < 0.1


def test_velocity_set_points_are_reached() -> None:
    simulation = flying()
    simulation.command(0, Velocity(forward=0.6, left=-0.3, up=0.2, yaw_rate=0.0))
    simulation.step(steps(6))
    assert simulation.truth(0).velocity_m_s == pytest.approx((0.6, -0.3, 0.2), abs=0.04)


def test_hover_brakes_and_stays() -> None:
    simulation = flying()
    simulation.command(0, Attitude(pitch=0.15))
    simulation.step(steps(2))
    assert simulation.truth(0).velocity_m_s[0] > 1.5
    simulation.command(0, Hover())
    simulation.step(steps(4))
    assert simulation.state(0) is S.HOVERING
    assert np.linalg.norm(simulation.truth(0).velocity_m_s) < 0.15
    simulation.step(steps(6))
    assert np.linalg.norm(simulation.truth(0).velocity_m_s) < 0.02


def test_an_attitude_step_is_a_second_order_response() -> None:
    parameters = replace(IDEAL, attitude_frequency_rad_s=10.0, attitude_damping=0.5)
    simulation = flying(parameters=parameters)
    simulation.command(0, Attitude(roll=0.1))
    # Commands reach the loops at their next period: start counting there.
    while round(simulation.time_s / STEP_S) % 4:
        simulation.step()
    rolls = []
    for _ in range(steps(2)):
        simulation.step()
        rolls.append(simulation.truth(0).roll_rad)
    peak = max(rolls)
    # Overshoot exp(-π ζ / √(1 - ζ²)) at π / (ω √(1 - ζ²)): any book on linear control.
    root = math.sqrt(1 - 0.5**2)
    assert peak / 0.1 - 1 == pytest.approx(math.exp(-math.pi * 0.5 / root), abs=0.02)
    assert (rolls.index(peak) + 1) * STEP_S == pytest.approx(math.pi / (10 * root), abs=0.02)
    assert rolls[-1] == pytest.approx(0.1, abs=1e-3)


@pytest.mark.parametrize("tilt", [0.1, 0.3])
def test_drag_balances_thrust_under_a_steady_tilt(tilt: float) -> None:
    world = replace(HALL, room=replace(HALL.room, size_m=(300.0, 20.0, 10.0)))
    simulation = Simulation(world, parameters=IDEAL, limits=Limits(tilt_rad=0.5))
    simulation.command(0, Takeoff())
    simulation.step(steps(5))
    simulation.command(0, Attitude(pitch=tilt))
    simulation.step(steps(15))
    speed = simulation.truth(0).velocity_m_s[0]
    drag = IDEAL.linear_drag_per_s * speed + IDEAL.quadratic_drag_per_m * speed**2
    assert drag == pytest.approx(GRAVITY_M_S2 * math.tan(tilt), rel=0.02)


def test_a_fall_approaches_terminal_speed() -> None:
    world = replace(HALL, room=replace(HALL.room, size_m=(20.0, 20.0, 200.0)))
    simulation = Simulation(world, parameters=IDEAL, limits=Limits(altitude_m=100.0, climb_m_s=3.0))
    simulation.command(0, Takeoff())
    simulation.step(steps(3))
    simulation.command(0, Velocity(up=3.0))
    simulation.step(steps(32))
    simulation.command(0, EmergencyStop())
    simulation.step(steps(4))
    falling = -simulation.truth(0).velocity_m_s[2]
    drag = IDEAL.vertical_linear_drag_per_s * falling + IDEAL.vertical_quadratic_drag_per_m * falling**2
    assert drag == pytest.approx(GRAVITY_M_S2, rel=0.03)


def test_the_ground_effect_saves_thrust_near_the_floor() -> None:
    limits = Limits(takeoff_altitude_m=0.3)
    thrusts = []
    for effect in (0.0, 1.0):
        parameters = replace(IDEAL, ground_effect=effect, rotor_radius_m=0.1)
        simulation = Simulation(HALL, parameters=parameters, limits=limits)
        simulation.command(0, Takeoff())
        simulation.step(steps(8))
        truth = simulation.truth(0)
        height = truth.position_m[2] - parameters.half_height_m + parameters.rotor_height_m
        assert truth.thrust == pytest.approx(1 - effect * (0.1 / (4 * height)) ** 2, abs=2e-3)
        thrusts.append(truth.thrust)
    assert thrusts[1] < thrusts[0]


def test_limits_clamp_and_the_applied_set_point_is_returned() -> None:
    simulation = flying()
    limits = Limits(tilt_rad=0.1, climb_m_s=0.5, yaw_rate_rad_s=1.0, altitude_m=1.5, speed_m_s=1.0)
    simulation.set_limits(0, limits)
    assert simulation.limits(0) is limits
    assert simulation.command(0, Attitude(1.0, -1.0, 9.0, -9.0)) == Attitude(0.1, -0.1, 0.5, -1.0)
    applied = simulation.command(0, Velocity(3.0, 4.0, -9.0, 9.0))
    assert isinstance(applied, Velocity)
    assert (applied.forward, applied.left, applied.up, applied.yaw_rate) == pytest.approx((0.6, 0.8, -0.5, 1.0))
    simulation.command(0, Velocity(up=0.5))
    simulation.step(steps(6))
    assert simulation.feedback(0).altitude_m == pytest.approx(1.5, abs=0.03)


def test_a_set_point_stays_in_force() -> None:
    simulation = flying()
    simulation.command(0, Velocity(yaw_rate=0.3))
    simulation.step(steps(20))
    assert simulation.state(0) is S.FLYING
    assert simulation.truth(0).angular_velocity_rad_s[2] == pytest.approx(0.3, abs=0.01)


@pytest.mark.parametrize("action", [Velocity(math.nan), Attitude(climb=math.inf)])
def test_numbers_that_are_not_finite_are_refused(action: AnyAction) -> None:
    with pytest.raises(UsageError, match="finite"):
        flying(seconds=0.1).command(0, action)


def test_wrong_arguments_are_refused() -> None:
    with pytest.raises(UsageError, match="from 1 to 1000"):
        Simulation(HALL, 0)
    with pytest.raises(UsageError, match="charge"):
        Simulation(HALL, charge=0.0)
    with pytest.raises(UsageError, match="1 given for 2"):
        Simulation(HALL, 2, limits=[Limits()])
    with pytest.raises(UsageError, match="no drone 1"):
        Simulation(HALL).feedback(1)
    with pytest.raises(UsageError, match=r"skyloop\.messages"):
        Simulation(HALL).command(0, "takeoff")  # type: ignore[arg-type]
    with pytest.raises(UsageError, match=r"room for only \d+ drones"):
        Simulation(load_world("room"), 200)
    with pytest.raises(UsageError, match="tilt_rad must be a number from"):
        Limits(tilt_rad=math.nan)
    with pytest.raises(UsageError, match="mass_kg must be greater than 0"):
        replace(IDEAL, mass_kg=0.0)
    with pytest.raises(UsageError, match="can't fly"):
        replace(IDEAL, most_thrust=0.9)
    with pytest.raises(UsageError, match="restitution"):
        replace(IDEAL, restitution=1.2)


def fly_about(drones: int, seed: int, wind: Wind | None = None, world: str = "room") -> Simulation:
    simulation = Simulation(load_world(world, seed=4), drones, seed=seed, wind=wind)
    commands: list[AnyAction] = [Velocity(0.4, 0.1, 0.1, 0.5), Attitude(0.1, -0.05, 0.0, -0.4), Hover()]
    for drone in range(drones):
        simulation.command(drone, Takeoff())
    simulation.step(800)
    for number in range(6):
        for drone in range(drones):
            simulation.command(drone, commands[(number + drone) % 3])
        simulation.step(97)
    return simulation


def test_the_same_seed_and_commands_give_the_same_bits() -> None:
    one, other = fly_about(3, seed=5), fly_about(3, seed=5)
    for drone in range(3):
        assert one.truth(drone) == other.truth(drone)
        assert one.feedback(drone) == other.feedback(drone)
    assert one.target_states() == other.target_states()
    assert fly_about(3, seed=6).truth(0) != one.truth(0)


def test_queries_change_nothing() -> None:
    watched, alone = flying(parameters=VehicleParameters()), flying(parameters=VehicleParameters())
    for _ in range(50):
        watched.step(7)
        first, again = watched.feedback(0), watched.feedback(0)
        assert first == again
        watched.poses()
    alone.step(350)
    assert watched.truth(0) == alone.truth(0)


def test_many_steps_at_once_equal_single_steps() -> None:
    one, many = flying(), flying()
    one.step(200)
    for _ in range(200):
        many.step()
    assert one.truth(0) == many.truth(0)


def test_a_drone_among_others_flies_as_if_alone() -> None:
    wind = Wind((0.5, 0.0, 0.0), 0.3, 1.0)
    alone, among = (fly_about(n, seed=2, wind=wind, world="empty") for n in (1, 12))
    assert among.take_occurrences() == []
    assert among.truth(0).position_m == pytest.approx(alone.truth(0).position_m, abs=1e-9)
    assert among.feedback(0).velocity_m_s == pytest.approx(alone.feedback(0).velocity_m_s, abs=1e-9)
    assert among.feedback(0).acceleration_m_s2 == pytest.approx(alone.feedback(0).acceleration_m_s2, abs=1e-9)


def test_poses_match_the_truth() -> None:
    simulation = fly_about(3, seed=1)
    positions, rotations = simulation.poses()
    assert positions.shape == (3, 3)
    assert rotations.shape == (3, 3, 3)
    for drone in range(3):
        truth = simulation.truth(drone)
        x, y, z, w = truth.quaternion
        assert positions[drone] == pytest.approx(truth.position_m)
        assert rotations[drone].T @ rotations[drone] == pytest.approx(np.eye(3))
        assert rotations[drone][2, 2] == pytest.approx(1 - 2 * (x * x + y * y))
        assert rotations[drone][1, 0] == pytest.approx(2 * (x * y + w * z))
        assert Rotation.from_quat(truth.quaternion).as_matrix() == pytest.approx(rotations[drone])


@pytest.mark.parametrize("drones", [2, 6])
def test_motions_match_truth_and_feedback(drones: int) -> None:
    simulation = Simulation(HALL, drones, seed=1)
    simulation.command(1, Takeoff())
    simulation.step(steps(4))
    simulation.command(1, Velocity(0.5, 0.2, 0.0, 1.7))
    simulation.step(steps(3))
    positions, velocities, angles = simulation.motions()
    for drone in range(drones):
        truth = simulation.truth(drone)
        assert positions[drone].tolist() == list(truth.position_m)
        assert velocities[drone].tolist() == list(simulation.feedback(drone).velocity_m_s)
        assert angles[drone].tolist() == [truth.roll_rad, truth.pitch_rad, truth.yaw_rad]
    assert simulation.airborne().tolist() == [drone == 1 for drone in range(drones)]
    positions[:] = 0.0
    assert simulation.motions()[0].any(), "they are copies"


def test_a_flying_drone_can_be_moved_and_holds_its_new_position() -> None:
    simulation = Simulation(load_world("empty"), 2, seed=1)
    with pytest.raises(UsageError, match="only a flying drone"):
        simulation.put(0, (1.0, 2.0, 2.0))
    for drone in (0, 1):
        simulation.command(drone, Takeoff())
    simulation.step(2000)
    other = simulation.truth(1).position_m
    simulation.put(0, (3.0, -2.0, 2.5), 1.0, charge=0.5)
    put = simulation.truth(0)
    assert put.position_m == (3.0, -2.0, 2.5)
    assert put.velocity_m_s == (0.0, 0.0, 0.0)
    assert put.battery == 0.5
    simulation.step(1000)
    after = simulation.truth(0)
    assert math.dist(after.position_m, (3.0, -2.0, 2.5)) < 0.3
    assert after.yaw_rad == pytest.approx(1.0, abs=0.05)
    assert math.dist(simulation.truth(1).position_m, other) < 0.5, "the other one keeps its position"
    for wrong in ((math.nan, 0.0, 1.0), (0.0, 1.0)):
        with pytest.raises(UsageError, match="three finite coordinates"):
            simulation.put(0, wrong)  # type: ignore[arg-type]
