"""Parameters that describe a simulated vehicle's flight, rotors and instruments.

The defaults describe an AR.Drone 2 with its indoor hull, to the extent that public sources describe it. Values without
a source are marked as estimates.

Sources: [P] Parrot, AR.Drone 2.0 technical specifications. [E] J. Engel, J. Sturm, D. Cremers, "Camera-Based
Navigation of a Low-Cost Quadrocopter", IROS 2012, with the constants c1 … c7 identified from flights, as used in its
published program ``tum_ardrone``. [C] I. C. Cheeseman, W. E. Bennett, "The Effect of the Ground on a Helicopter Rotor
in Forward Flight", ARC R&M 3021, 1955. [S] AR.Drone SDK 2.0.1, default configuration.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, fields, replace
from typing import Any

from skyloop.errors import UsageError
from skyloop.sim.world import Vec3

#: Rotors are numbered front left, front right, rear left, rear right. Seen from above, the first and last rotors turn
#: clockwise and the other two counter-clockwise, as in the X quadrotors of Betaflight, ArduPilot and PX4. A rotor's
#: torque therefore turns the body counter-clockwise (1, yaw to the left) or clockwise (-1).
YAW_SIGNS = (1.0, -1.0, -1.0, 1.0)

Places = tuple[tuple[float, float], tuple[float, float], tuple[float, float], tuple[float, float]]


@dataclass(frozen=True, slots=True)
class InstrumentParameters:
    """Errors, rates and delays of a vehicle's instruments.

    ``noise`` is the standard deviation of a sample, and ``bias`` that of the error at the start, which then wanders
    with a time constant (the gyro has its own). See ``docs/rotors.md`` for the sources of the defaults.
    """

    gyro_noise_rad_s: float = 0.002
    gyro_bias_rad_s: float = 0.005
    accelerometer_noise_m_s2: float = 0.09
    accelerometer_bias_m_s2: float = 0.05
    magnetometer_noise_gauss: float = 0.002
    magnetometer_bias_gauss: float = 0.005
    barometer_noise_pa: float = 1.2
    barometer_bias_pa: float = 2.0
    gps_noise_m: float = 0.005
    gps_bias_m: float = 0.007
    gps_velocity_noise_m_s: float = 0.05
    range_noise_m: float = 0.01
    flow_noise_rad_s: float = 0.05
    bias_time_constant_s: float = 300.0
    gyro_time_constant_s: float = 30000.0
    magnetometer_period_s: float = 0.01
    barometer_period_s: float = 0.02
    gps_period_s: float = 0.1
    gps_delay_s: float = 0.12
    range_period_s: float = 0.02
    range_least_m: float = 0.0
    range_most_m: float = 8.0
    flow_period_s: float = 0.02
    temperature_c: float = 25.0

    def __post_init__(self) -> None:
        _check(self, positive=lambda name: name.endswith(("_period_s", "_constant_s", "_most_m")))


@dataclass(frozen=True, slots=True)
class RotorParameters:
    """Rotors, air, inertia and power train of a quadrotor.

    A rotor turning at ω produces a thrust of ``thrust_n_s2`` ω², and a torque of ``torque_m`` times the thrust. It
    follows its command with a first-order lag. A command of 0 stops the rotor; above 0, its speed rises linearly from
    ``idle_speed_rad_s`` to ``full_speed_rad_s``. Both speeds are for a full battery and decrease with the voltage.
    """

    #: positions of the rotors, forward and left of the centre of mass, in the order of :data:`YAW_SIGNS`
    places_m: Places
    inertia_kg_m2: Vec3  #: moments of inertia about the body's axes
    thrust_n_s2: float  #: thrust per speed squared
    torque_m: float  #: torque per thrust
    idle_speed_rad_s: float  #: lowest speed of a running rotor
    full_speed_rad_s: float  #: rotor speed at full command
    speed_up_s: float  #: time constant of an accelerating rotor
    speed_down_s: float  #: time constant of a decelerating rotor
    #: Force opposing the airspeed in the plane of the rotors, per airspeed and per sum of the rotors' speeds. The force
    #: is caused by blade flapping and the blades' asymmetric drag.
    rotor_drag_kg: float
    rotor_inflow_kg: float  #: the same force along the rotors' axes, where air from above reduces the thrust
    body_drag_kg_m: Vec3  #: force per airspeed squared, along the body's axes
    efficiency: float  #: power of the rotors' shafts (torque times speed) as a fraction of the battery's power
    #: inertia of a rotor about its axis; when a rotor accelerates, the body turns the other way
    rotor_inertia_kg_m2: float = 0.0
    instruments: InstrumentParameters = field(default_factory=InstrumentParameters)

    def __post_init__(self) -> None:
        may_be_zero = ("rotor_drag_kg", "rotor_inflow_kg", "rotor_inertia_kg_m2")
        _check(self, positive=lambda name: name not in may_be_zero)
        for name, count in (("places_m", 4), ("inertia_kg_m2", 3), ("body_drag_kg_m", 3)):
            values = getattr(self, name)
            if len(values) != count:
                raise UsageError(f"{name} needs {count} entries, got {values!r}")
        if not all(map(math.isfinite, (x for place in self.places_m for x in place))):
            raise UsageError(f"places_m must be finite, not {self.places_m!r}")
        if not all(math.isfinite(x) and x > 0 for x in self.inertia_kg_m2):
            raise UsageError(f"inertia_kg_m2 must be finite and greater than 0, not {self.inertia_kg_m2!r}")
        if not all(math.isfinite(x) and x >= 0 for x in self.body_drag_kg_m):
            raise UsageError(f"body_drag_kg_m must be finite and at least 0, not {self.body_drag_kg_m!r}")
        for (x, y), (ahead, left) in zip(self.places_m, ((1, 1), (1, -1), (-1, 1), (-1, -1)), strict=True):
            if x * ahead <= 0 or y * left <= 0:
                raise UsageError(
                    "places_m must be front left, front right, rear left, rear right of the centre of mass, "
                    f"as (forward, left), not {self.places_m!r}"
                )
        if self.idle_speed_rad_s >= self.full_speed_rad_s:
            raise UsageError("idle_speed_rad_s must be below full_speed_rad_s")
        if self.efficiency > 1:
            raise UsageError(f"efficiency must be greater than 0 and at most 1, not {self.efficiency!r}")

    @property
    def full_thrust_n(self) -> float:
        """Thrust of all four rotors with a full battery [N]."""
        return 4 * self.thrust_n_s2 * self.full_speed_rad_s**2


def _check(
    parameters: InstrumentParameters | RotorParameters | VehicleParameters, positive: Callable[[str], bool]
) -> None:
    for one in fields(parameters):
        value = getattr(parameters, one.name)
        if one.name == "rotors" or isinstance(value, tuple | InstrumentParameters):
            continue
        if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
            raise UsageError(f"{one.name} must be a finite number, not {value!r}")
        if value < 0 or (value == 0 and positive(one.name)):
            least = "greater than 0" if positive(one.name) else "at least 0"
            raise UsageError(f"{one.name} must be {least}, not {value!r}")


GRAVITY_M_S2 = 9.80665  # standard gravity


@dataclass(frozen=True, slots=True)
class VehicleParameters:
    """A vehicle's body, motors, loops, battery and sensors."""

    # Body
    mass_kg: float = 0.42  # includes the indoor hull [P]; matters only in collisions and for rotors
    radius_m: float = 0.26  # radius of the hull, which is 517 mm across [P]
    half_height_m: float = 0.06  # half height of the hull; estimate
    linear_drag_per_s: float = 0.45  # together with the next value, gives 0.57 1/s at 3 m/s; [E] identified c1 = 0.58
    quadratic_drag_per_m: float = 0.04
    vertical_linear_drag_per_s: float = 0.45  # estimate: same as the horizontal one
    vertical_quadratic_drag_per_m: float = 0.12  # estimate: the area seen from above is three times as large
    # This tilt raises the leading side in the airflow, as far as the attitude loops don't remove it. The tilt is this
    # angle times the square of the horizontal airspeed, up to 3 m/s; blade flapping and wind on the hull cause it.
    airspeed_tilt_rad_s2_per_m2: float = 0.0

    # Motors
    rotor_radius_m: float = 0.10  # 8 inch propellers [P]
    rotor_height_m: float = 0.05  # height of the rotors above the feet, for the ground effect; estimate
    ground_effect: float = 1.0  # fraction of the effect of one rotor with this radius [C]; 0 switches it off
    motor_time_constant_s: float = 0.06  # estimate
    most_thrust: float = 1.9  # maximum thrust as a multiple of the weight, with a full battery; estimate
    least_thrust: float = 0.3  # minimum thrust as a fraction of the weight while the motors run; estimate

    # Inner loops
    attitude_frequency_rad_s: float = 16.0  # together with the damping, gives a lag of 2ζ/ω = 0.1 s, [E] c3 = 10 1/s
    attitude_damping: float = 0.8
    most_angular_acceleration_rad_s2: float = 60.0  # estimate
    yaw_time_constant_s: float = 0.1  # [E] c5 = 10 1/s
    # When the roll and pitch set-points are close to level, the firmware may tilt to oppose the motion. This value is
    # the deceleration per unit of speed at a level set-point; it falls linearly with the tilt and is zero at full tilt.
    level_brake_per_s: float = 0.0
    climb_gain_per_s: float = 3.0  # estimate; the AR.Drone's whole response is softer, [E] c7 = 1.4 1/s
    altitude_gain_per_s: float = 1.2  # damps the altitude hold with ζ = 0.8 at the climb gain above
    velocity_gain_per_s: float = 2.0  # estimate
    velocity_integral_per_s2: float = 1.0  # estimate
    takeoff_climb_m_s: float = 0.6  # estimate
    landing_descent_m_s: float = 0.45  # estimate

    # Battery: 1000 mAh, 3 cells, 12 minutes of flight [P]
    battery_charge_c: float = 3600.0
    battery_full_v: float = 12.5
    battery_empty_v: float = 9.6
    battery_resistance_ohm: float = 0.08  # estimate
    hover_power_w: float = 50.0  # 11.1 Wh in 12 minutes, less the power of the electronics
    electronics_power_w: float = 5.0  # estimate

    # Sensors: standard deviations of the noise, and of the biases, which wander with the time constant. Estimates for
    # consumer parts.
    gyro_noise_rad_s: float = 0.01
    gyro_bias_rad_s: float = 0.005
    accelerometer_noise_m_s2: float = 0.15
    accelerometer_bias_m_s2: float = 0.08
    tilt_noise_rad: float = 0.002
    tilt_bias_rad: float = 0.006
    yaw_noise_rad: float = 0.003
    yaw_bias_rad: float = 0.03
    altitude_noise_m: float = 0.008
    altitude_bias_m: float = 0.015
    velocity_noise_m_s: float = 0.04
    velocity_bias_m_s: float = 0.015
    bias_time_constant_s: float = 40.0

    # Damage
    crash_speed_m_s: float = 3.0  # speed along a solid's normal above which an impact is a crash and stops the motors
    restitution: float = 0.35  # fraction of the normal speed after a bounce; estimate
    friction: float = 0.5  # Coulomb friction; estimate

    #: Rotors of a vehicle modelled at rotor level (``docs/rotors.md``). If None, the vehicle's response is modelled as
    #: a whole. If there are rotors, their own values replace the drag, motor time constant and hover power given above.
    rotors: RotorParameters | None = None

    def __post_init__(self) -> None:
        _check(self, positive=lambda name: name in _POSITIVE)
        if not self.least_thrust < 1 < self.most_thrust:
            raise UsageError(
                f"thrust from {self.least_thrust:g} to {self.most_thrust:g} of the weight can't fly; "
                "least_thrust must be below 1 and most_thrust above"
            )
        if self.ground_effect**0.5 * self.rotor_radius_m >= 3.6 * self.rotor_height_m:
            raise UsageError(
                "rotor_height_m is too small for this rotor_radius_m and ground_effect: thrust would diverge"
            )
        if self.restitution > 1:
            raise UsageError(f"restitution must be from 0 to 1, not {self.restitution:g}: a bounce can't add energy")
        if self.battery_empty_v >= self.battery_full_v:
            raise UsageError("battery_empty_v must be below battery_full_v")
        if self.rotors is not None and not self.most_thrust < self.rotors.full_thrust_n / (self.mass_kg * GRAVITY_M_S2):
            raise UsageError(
                f"most_thrust {self.most_thrust:g} of the weight must be below the rotors' maximum, "
                f"{self.rotors.full_thrust_n / (self.mass_kg * GRAVITY_M_S2):.2f}: attitude control needs the rest"
            )


_POSITIVE = frozenset(
    {
        "mass_kg",
        "radius_m",
        "half_height_m",
        "rotor_radius_m",
        "rotor_height_m",
        "motor_time_constant_s",
        "attitude_frequency_rad_s",
        "most_angular_acceleration_rad_s2",
        "yaw_time_constant_s",
        "climb_gain_per_s",
        "takeoff_climb_m_s",
        "landing_descent_m_s",
        "battery_charge_c",
        "battery_empty_v",
        "bias_time_constant_s",
        "crash_speed_m_s",
    }
)


def with_ideal_sensors(vehicle: VehicleParameters) -> VehicleParameters:
    """Return the same vehicle without sensor noise and biases."""
    return with_scaled_flaws(vehicle, 0.0)


def with_scaled_flaws(vehicle: VehicleParameters, factor: float) -> VehicleParameters:
    """Return the same vehicle with the noise and biases of its sensors and instruments multiplied by a factor."""
    scaled = replace(vehicle, **_scaled_flaws(vehicle, factor))
    if scaled.rotors is None:
        return scaled
    instruments = scaled.rotors.instruments
    instruments = replace(instruments, **_scaled_flaws(instruments, factor))
    return replace(scaled, rotors=replace(scaled.rotors, instruments=instruments))


def _scaled_flaws(parameters: VehicleParameters | InstrumentParameters, factor: float) -> dict[str, Any]:
    return {
        one.name: getattr(parameters, one.name) * factor
        for one in fields(parameters)
        if ("_noise_" in one.name or "_bias_" in one.name) and "time_constant" not in one.name
    }


@dataclass(frozen=True, slots=True)
class Limits:
    """Limits to which a vehicle's set-points are clamped. Defaults: AR.Drone, indoor [S]."""

    tilt_rad: float = 0.21
    climb_m_s: float = 0.7
    yaw_rate_rad_s: float = 1.75
    altitude_m: float = 3.0
    speed_m_s: float = 5.0  # horizontal speed of velocity set-points
    takeoff_altitude_m: float = 1.0

    def __post_init__(self) -> None:
        for name, (low, high) in LIMIT_RANGES.items():
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, int | float) or not low <= value <= high:
                raise UsageError(f"limit {name} must be a number from {low:g} to {high:g}, not {value!r}")


#: Minimum and maximum of each limit.
LIMIT_RANGES: dict[str, tuple[float, float]] = {
    "tilt_rad": (0.02, 0.6),
    "climb_m_s": (0.1, 3.0),
    "yaw_rate_rad_s": (0.1, 6.0),
    "altitude_m": (0.3, 100.0),
    "speed_m_s": (0.1, 15.0),
    "takeoff_altitude_m": (0.3, 10.0),
}
