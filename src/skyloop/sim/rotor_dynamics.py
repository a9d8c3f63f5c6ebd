"""Formulas of the rotor-level model, for the numbers of one drone or arrays of all drones. Pure.

Body axes: forward x, left y, up z. The formulas use only sums, products, quotients and square roots, which give
bit-identical results for numbers and arrays.

Sources: [M] R. Mahony, V. Kumar, P. Corke, "Multirotor Aerial Vehicles: Modeling, Estimation, and Control of
Quadrotor", IEEE Robotics & Automation Magazine 19(3), 2012: thrust and torque, blade flapping as a force that grows
with airspeed and rotor speed. [S] J. Svacha, K. Mohta, V. Kumar, "Improving quadrotor trajectory tracking by
compensating for aerodynamic effects", ICUAS 2017: thrust lost to inflow grows with rotor speed times axial airspeed.
[C] I. C. Cheeseman, W. E. Bennett, "The Effect of the Ground on a Helicopter Rotor in Forward Flight", ARC R&M 3021,
1955.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import astuple, dataclass
from typing import TypeAlias

import numpy as np

from skyloop.errors import UsageError
from skyloop.sim.dynamics import N, Operations
from skyloop.sim.parameters import GRAVITY_M_S2, YAW_SIGNS, RotorParameters, VehicleParameters

PLANT_STEP_S = 0.001  #: time step of the rotor-level model and its instruments

_HALF_STEP_S = PLANT_STEP_S / 2
_LEG_STIFFNESS_PER_S2, _LEG_DAMPING_PER_S = 900.0, 60.0  # critically damped, settling within a tenth of a second
_ROTOR_RESPONSE_S = 0.02  # time constant that the mixer gives slower rotors, by commanding them beyond their target
_YAW_SHARE = 0.25  # fraction of the rotors' thrust range that yaw may take from roll and pitch

Four: TypeAlias = tuple[N, N, N, N]
Three: TypeAlias = tuple[N, N, N]


@dataclass(frozen=True, slots=True)
class Constants:
    """Constants of one drone, or arrays for all drones, in SI units."""

    thrust: N
    idle_speed: N
    full_speed: N
    up_share: N
    down_share: N
    lead: N
    inflow: N
    rotor_drag: N
    drag_x: N
    drag_y: N
    drag_z: N
    per_mass: N
    rotor_offset: N
    rotor_height: N
    ground_effect: N
    x1: N
    x2: N
    x3: N
    x4: N
    y1: N
    y2: N
    y3: N
    y4: N
    roll_per_torque: N
    pitch_per_torque: N
    yaw_per_thrust: N
    yaw_per_spin: N
    gyroscopic_x: N
    gyroscopic_y: N
    gyroscopic_z: N
    leg_roll: N
    leg_pitch: N
    leg_yaw: N
    rate_gain: N
    yaw_gain: N
    most_turning: N
    collective: N
    roll1: N
    roll2: N
    roll3: N
    roll4: N
    pitch1: N
    pitch2: N
    pitch3: N
    pitch4: N
    yaw1: N
    yaw2: N
    yaw3: N
    yaw4: N
    shaft_power: N
    electronics_power: N
    full_voltage: N
    resistance: N


def rotors_of(vehicle: VehicleParameters) -> RotorParameters:
    """Return a vehicle's rotors; raise UsageError if it has none because its response is modelled as a whole."""
    if vehicle.rotors is None:
        raise UsageError("this vehicle has no rotors: it is modelled by its response as a whole; see docs/rotors.md")
    return vehicle.rotors


def constants_of(vehicle: VehicleParameters) -> Constants:
    """Return the constants of a vehicle."""
    rotors = rotors_of(vehicle)
    ix, iy, iz = rotors.inertia_kg_m2
    mass, k = vehicle.mass_kg, rotors.thrust_n_s2
    xs, ys = zip(*rotors.places_m, strict=True)
    # Each rotor's contribution to the sum of thrusts and of torques about x, y and z.
    rows = [[1.0] * 4, ys, [-x for x in xs], [rotors.torque_m * sign for sign in YAW_SIGNS]]
    _, roll, pitch, yaw = (np.linalg.inv(np.array(rows)) * (1.0, ix, iy, iz)).T.tolist()
    each = {"x": xs, "y": ys, "roll": roll, "pitch": pitch, "yaw": yaw}  # values that differ between the rotors
    return Constants(
        thrust=k,
        idle_speed=rotors.idle_speed_rad_s,
        full_speed=rotors.full_speed_rad_s,
        up_share=1.0 - math.exp(-PLANT_STEP_S / rotors.speed_up_s),
        down_share=1.0 - math.exp(-PLANT_STEP_S / rotors.speed_down_s),
        lead=max(1.0, rotors.speed_up_s / _ROTOR_RESPONSE_S),
        inflow=rotors.rotor_inflow_kg,
        rotor_drag=rotors.rotor_drag_kg,
        drag_x=rotors.body_drag_kg_m[0],
        drag_y=rotors.body_drag_kg_m[1],
        drag_z=rotors.body_drag_kg_m[2],
        per_mass=1.0 / mass,
        rotor_offset=vehicle.rotor_height_m - vehicle.half_height_m,
        rotor_height=vehicle.rotor_height_m,
        ground_effect=vehicle.ground_effect**0.5 * vehicle.rotor_radius_m / 4,
        roll_per_torque=1.0 / ix,
        pitch_per_torque=1.0 / iy,
        yaw_per_thrust=rotors.torque_m / iz,
        yaw_per_spin=rotors.rotor_inertia_kg_m2 / iz / PLANT_STEP_S,
        gyroscopic_x=(iz - iy) / ix,
        gyroscopic_y=(ix - iz) / iy,
        gyroscopic_z=(iy - ix) / iz,
        leg_roll=mass * vehicle.radius_m / ix,
        leg_pitch=mass * vehicle.radius_m / iy,
        leg_yaw=vehicle.friction * mass * vehicle.radius_m * (2 / 3) / iz,
        rate_gain=2 * vehicle.attitude_damping * vehicle.attitude_frequency_rad_s,
        yaw_gain=1.0 / vehicle.yaw_time_constant_s,
        most_turning=vehicle.most_angular_acceleration_rad_s2,
        collective=mass / 4,
        shaft_power=rotors.torque_m * k / rotors.efficiency,
        electronics_power=vehicle.electronics_power_w,
        full_voltage=vehicle.battery_full_v,
        resistance=vehicle.battery_resistance_ohm,
        **{f"{name}{number}": value for name, values in each.items() for number, value in enumerate(values, 1)},
    )


def all_constants(each: Sequence[Constants]) -> Constants:
    """Return the constants of all drones as arrays, each (n,)."""
    return Constants(*np.array([astuple(one) for one in each]).T)


def rotation(w: N, x: N, y: N, z: N) -> tuple[Three, Three, Three]:
    """Return the rows of a quaternion's world-from-body rotation."""
    xx, yy, zz, xy, xz, yz = x * x, y * y, z * z, x * y, x * z, y * z
    wx, wy, wz = w * x, w * y, w * z
    return (
        (1.0 - 2.0 * (yy + zz), 2.0 * (xy - wz), 2.0 * (xz + wy)),
        (2.0 * (xy + wz), 1.0 - 2.0 * (xx + zz), 2.0 * (yz - wx)),
        (2.0 * (xz - wy), 2.0 * (yz + wx), 1.0 - 2.0 * (xx + yy)),
    )


def spin(do: Operations, c: Constants, speeds: Four, targets: Four) -> tuple[Four, N]:
    """Move the rotors' speeds towards their target speeds for a step of :data:`PLANT_STEP_S`.

    Return the speeds and the reaction on the body, as an angular acceleration about z.
    """
    (one, two, three, four), (to_one, to_two, to_three, to_four) = speeds, targets
    up, down = c.up_share, c.down_share
    more_one = (to_one - one) * do.choose(to_one > one, up, down)
    more_two = (to_two - two) * do.choose(to_two > two, up, down)
    more_three = (to_three - three) * do.choose(to_three > three, up, down)
    more_four = (to_four - four) * do.choose(to_four > four, up, down)
    twist = (more_one - more_two - more_three + more_four) * c.yaw_per_spin
    return (one + more_one, two + more_two, three + more_three, four + more_four), twist


def advance(
    do: Operations,
    c: Constants,
    turning: Sequence[N],  # quaternion (w, x, y, z; world from body) and body rates
    speeds: Four,  # rotor speeds, constant during the step
    twist: N,  # reaction of the rotors; see :func:`spin`
    motion: Sequence[N],  # velocity of the air, then position and velocity, all in world axes
    knock: Three,  # acceleration in world axes that corresponds to the velocity change by contacts in the last step
    legs: bool,  # whether any drone may be touching something that can turn it upright
) -> tuple[tuple[N, ...], tuple[N, ...], Three, N]:
    """Advance a rigid body by a step of :data:`PLANT_STEP_S`.

    Returns:
        Quaternion and body rates; position and velocity; the specific force along the body's axes during the step; the
        rotors' thrust per mass.
    """
    w, x, y, z, p, q, r = turning
    s1, s2, s3, s4 = speeds
    air_x, air_y, air_z, px, py, pz, vx, vy, vz = motion
    knock_x, knock_y, knock_z = knock
    (r00, r01, r02), (r10, r11, r12), (r20, r21, r22) = rotation(w, x, y, z)

    # Airspeed along the body's axes and, at each rotor, along its axis: a rotor's force follows [M], less inflow [S].
    east, north, up = vx - air_x, vy - air_y, vz - air_z
    ahead = r00 * east + r10 * north + r20 * up
    aside = r01 * east + r11 * north + r21 * up
    along = r02 * east + r12 * north + r22 * up
    airspeed = do.root(east * east + north * north + up * up)
    k, inflow = c.thrust, c.inflow
    t1, t2, t3, t4 = k * s1 * s1, k * s2 * s2, k * s3 * s3, k * s4 * s4
    yaw = (t1 - t2 - t3 + t4) * c.yaw_per_thrust
    t1 = t1 - inflow * s1 * (along + p * c.y1 - q * c.x1)
    t2 = t2 - inflow * s2 * (along + p * c.y2 - q * c.x2)
    t3 = t3 - inflow * s3 * (along + p * c.y3 - q * c.x3)
    t4 = t4 - inflow * s4 * (along + p * c.y4 - q * c.x4)
    thrust = t1 + t2 + t3 + t4

    # Near the floor, thrust grows by 1 / (1 - (R / 4h)²) [C], scaled by the downward component of the rotors' axis.
    shortfall = c.ground_effect / do.most(pz + c.rotor_offset, c.rotor_height)
    lift = thrust / (1.0 - shortfall * shortfall * do.most(r22, 0.0))
    flapping = c.rotor_drag * (s1 + s2 + s3 + s4)
    fx = -ahead * (flapping + c.drag_x * airspeed) * c.per_mass
    fy = -aside * (flapping + c.drag_y * airspeed) * c.per_mass
    fz = (lift - along * c.drag_z * airspeed) * c.per_mass

    dp = (t1 * c.y1 + t2 * c.y2 + t3 * c.y3 + t4 * c.y4) * c.roll_per_torque - c.gyroscopic_x * q * r
    dq = (t1 * c.x1 + t2 * c.x2 + t3 * c.x3 + t4 * c.x4) * -c.pitch_per_torque - c.gyroscopic_y * p * r
    dr = yaw + twist - c.gyroscopic_z * p * q
    if legs:
        # The legs exert the supporting force with a lever arm no longer than the hull's radius.
        load = do.most(knock_z, 0.0)
        roll, pitch = load * c.leg_roll, load * c.leg_pitch
        dp = dp + _within(do, -_LEG_STIFFNESS_PER_S2 * r21 - _LEG_DAMPING_PER_S * p, roll)
        dq = dq + _within(do, _LEG_STIFFNESS_PER_S2 * r20 - _LEG_DAMPING_PER_S * q, pitch)
        dr = dr + _within(do, -_LEG_DAMPING_PER_S * r, load * c.leg_yaw)

    p, q, r = p + dp * PLANT_STEP_S, q + dq * PLANT_STEP_S, r + dr * PLANT_STEP_S
    new_w = w - _HALF_STEP_S * (x * p + y * q + z * r)
    new_x = x + _HALF_STEP_S * (w * p + y * r - z * q)
    new_y = y + _HALF_STEP_S * (w * q + z * p - x * r)
    new_z = z + _HALF_STEP_S * (w * r + x * q - y * p)
    size = do.root(new_w * new_w + new_x * new_x + new_y * new_y + new_z * new_z)

    ax = r00 * fx + r01 * fy + r02 * fz
    ay = r10 * fx + r11 * fy + r12 * fz
    az = r20 * fx + r21 * fy + r22 * fz - GRAVITY_M_S2
    new_vx, new_vy, new_vz = vx + ax * PLANT_STEP_S, vy + ay * PLANT_STEP_S, vz + az * PLANT_STEP_S
    px, py, pz = px + (vx + new_vx) * _HALF_STEP_S, py + (vy + new_vy) * _HALF_STEP_S, pz + (vz + new_vz) * _HALF_STEP_S
    force = (
        fx + r00 * knock_x + r10 * knock_y + r20 * knock_z,
        fy + r01 * knock_x + r11 * knock_y + r21 * knock_z,
        fz + r02 * knock_x + r12 * knock_y + r22 * knock_z,
    )
    turned = (new_w / size, new_x / size, new_y / size, new_z / size, p, q, r)
    return turned, (px, py, pz, new_vx, new_vy, new_vz), force, thrust * c.per_mass


def mix(do: Operations, c: Constants, rates: Three, speeds: Four, wanted: Three, thrust: N, sag: N) -> Four:
    """Return the rotor speeds to command for the wanted body rates and the wanted thrust per mass.

    If the rotors can't do everything, roll and pitch take precedence, then thrust; yaw gets a limited share. Without
    thrust, the rotors stop. ``sag`` is the battery's voltage as a fraction of the full voltage.
    """
    p, q, r = rates
    want_p, want_q, want_r = wanted
    most = c.most_turning
    dp = _within(do, (want_p - p) * c.rate_gain, most) + c.gyroscopic_x * q * r
    dq = _within(do, (want_q - q) * c.rate_gain, most) + c.gyroscopic_y * p * r
    dr = _within(do, (want_r - r) * c.yaw_gain, most) + c.gyroscopic_z * p * q
    k, slowest, fastest = c.thrust, c.idle_speed * sag, c.full_speed * sag
    least, range_n = k * slowest * slowest, k * (fastest * fastest - slowest * slowest)
    # All four rotors contribute the same yaw, so checking one is enough to tell whether the yaw is too large.
    yaw = _within(do, dr * c.yaw1, range_n * _YAW_SHARE) / c.yaw1
    d1 = dp * c.roll1 + dq * c.pitch1 + yaw * c.yaw1
    d2 = dp * c.roll2 + dq * c.pitch2 + yaw * c.yaw2
    d3 = dp * c.roll3 + dq * c.pitch3 + yaw * c.yaw3
    d4 = dp * c.roll4 + dq * c.pitch4 + yaw * c.yaw4
    low = do.least(do.least(d1, d2), do.least(d3, d4))
    high = do.most(do.most(d1, d2), do.most(d3, d4))
    scale = do.least(1.0, range_n / do.most(high - low, 1e-12))
    base = do.least(do.most(thrust * c.collective, least - low * scale), least + range_n - high * scale)
    runs, lead = thrust > 0.0, c.lead
    s1, s2, s3, s4 = speeds
    one = s1 + (do.root(do.most(base + d1 * scale, 0.0) / k) - s1) * lead
    two = s2 + (do.root(do.most(base + d2 * scale, 0.0) / k) - s2) * lead
    three = s3 + (do.root(do.most(base + d3 * scale, 0.0) / k) - s3) * lead
    four = s4 + (do.root(do.most(base + d4 * scale, 0.0) / k) - s4) * lead
    return (
        do.choose(runs, do.least(do.most(one, slowest), fastest), 0.0),
        do.choose(runs, do.least(do.most(two, slowest), fastest), 0.0),
        do.choose(runs, do.least(do.most(three, slowest), fastest), 0.0),
        do.choose(runs, do.least(do.most(four, slowest), fastest), 0.0),
    )


def electric_power(c: Constants, speeds: Four) -> N:
    """Return the battery power for the electronics and for the rotors at these speeds [W]."""
    s1, s2, s3, s4 = speeds
    return (s1 * s1 * s1 + s2 * s2 * s2 + s3 * s3 * s3 + s4 * s4 * s4) * c.shaft_power + c.electronics_power


def load(do: Operations, c: Constants, power: N, unloaded: N, voltage: N) -> tuple[N, N]:
    """Return a battery's voltage [V] and current [A] under a power [W], given its unloaded and previous voltages."""
    current = power / do.most(voltage, 1.0)
    # A battery delivers its maximum power at half its voltage.
    return do.most(unloaded - current * c.resistance, unloaded * 0.5), current


def _within(do: Operations, value: N, limit: N) -> N:
    return do.least(do.most(value, -limit), limit)
