"""Parameters of a simulated vehicle.

The defaults are an AR.Drone 2 with its indoor hull, as far as public sources state; a value without a source is an
estimate and says so.

Sources: [P] Parrot, AR.Drone 2.0 technical specifications. [E] J. Engel, J. Sturm, D. Cremers, "Camera-Based
Navigation of a Low-Cost Quadrocopter", IROS 2012, with the constants c1 … c7 identified from flights that its published
program ``tum_ardrone`` uses. [C] I. C. Cheeseman, W. E. Bennett, "The Effect of the Ground on a Helicopter Rotor in
Forward Flight", ARC R&M 3021, 1955. [S] AR.Drone SDK 2.0.1, default configuration.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace
from typing import Any

from skyloop.errors import UsageError
from skyloop.sim.rotor_parameters import InstrumentParameters, RotorParameters

GRAVITY_M_S2 = 9.80665


@dataclass(frozen=True, slots=True)
class VehicleParameters:
    """One vehicle's body, motors, loops, battery and sensors.

    Raises:
        UsageError: A value is not finite, negative, or zero where something is divided by it.
    """

    # Body
    mass_kg: float = 0.42  # with indoor hull [P]; only collisions between drones use it: all else is per mass
    radius_m: float = 0.26  # of the hull, 517 mm across [P]
    half_height_m: float = 0.06  # of the hull, estimate
    linear_drag_per_s: float = 0.45  # with the next: 0.57 1/s at 3 m/s, where [E] c1 = 0.58 was identified
    quadratic_drag_per_m: float = 0.04
    vertical_linear_drag_per_s: float = 0.45  # estimate: as horizontally
    vertical_quadratic_drag_per_m: float = 0.12  # estimate: three times the area seen from above
    # How far the air that the vehicle flies into lifts its leading side, against attitude loops that don't take it out:
    # this angle times the square of the horizontal airspeed, up to 3 m/s. Blades flap, and hulls catch the wind.
    airspeed_tilt_rad_s2_per_m2: float = 0.0

    # Motors
    rotor_radius_m: float = 0.10  # 8 inch propellers [P]
    rotor_height_m: float = 0.05  # of the rotors above the feet, estimate: what the ground effect goes by
    ground_effect: float = 1.0  # share of the effect of one rotor of this radius [C]; 0 switches it off
    motor_time_constant_s: float = 0.06  # estimate
    most_thrust: float = 1.9  # of the weight, battery full; estimate
    least_thrust: float = 0.3  # of the weight, while the motors run; estimate

    # Inner loops
    attitude_frequency_rad_s: float = 16.0  # with the damping: a lag of 2ζ/ω = 0.1 s, [E] c3 = 10 1/s
    attitude_damping: float = 0.8
    most_angular_acceleration_rad_s2: float = 60.0  # estimate
    yaw_time_constant_s: float = 0.1  # [E] c5 = 10 1/s
    # By roll and pitch set-points near level, firmware may lean against the speed on its own: this deceleration per
    # speed when the set-point is level, less in proportion to it, and none at the full tilt.
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
    hover_power_w: float = 50.0  # 11.1 Wh in 12 minutes, less the electronics
    electronics_power_w: float = 5.0  # estimate

    # Sensors: standard deviations of noise, and of biases that wander with the time constant. Estimates of the
    # order of consumer parts.
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
    crash_speed_m_s: float = 3.0  # into something solid, along its normal: faster is a crash, and the motors stop
    restitution: float = 0.35  # share of the speed along the normal that is left after a bounce, estimate
    friction: float = 0.5  # Coulomb, estimate

    #: For a vehicle that is modelled down to its rotors (``docs/rotors.md``); None models its response as a whole. With
    #: rotors, drag, motor time constant and hover power above have no effect: the rotors' own count.
    rotors: RotorParameters | None = None

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if field.name == "rotors":
                continue
            if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value) or value < 0:
                raise UsageError(f"{field.name} must be a finite number of at least 0, not {value!r}")
            if value == 0 and field.name in _POSITIVE:
                raise UsageError(f"{field.name} must be greater than 0")
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
                f"most_thrust {self.most_thrust:g} of the weight must be below what the rotors give, "
                f"{self.rotors.full_thrust_n / (self.mass_kg * GRAVITY_M_S2):.2f}: the attitude needs the rest"
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
        field.name: getattr(parameters, field.name) * factor
        for field in fields(parameters)
        if ("_noise_" in field.name or "_bias_" in field.name) and "time_constant" not in field.name
    }


@dataclass(frozen=True, slots=True)
class Limits:
    """Limits of a vehicle's set-points, which are clamped to them. Defaults: AR.Drone, indoor [S].

    Raises:
        UsageError: A value is out of its range.
    """

    tilt_rad: float = 0.21
    climb_m_s: float = 0.7
    yaw_rate_rad_s: float = 1.75
    altitude_m: float = 3.0
    speed_m_s: float = 5.0  # horizontally, for velocity set-points
    takeoff_altitude_m: float = 1.0

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            low, high = LIMIT_RANGES[field.name]
            if isinstance(value, bool) or not isinstance(value, int | float) or not low <= value <= high:
                raise UsageError(f"limit {field.name} must be a number from {low:g} to {high:g}, not {value!r}")


#: Least and greatest value of each limit.
LIMIT_RANGES: dict[str, tuple[float, float]] = {
    "tilt_rad": (0.02, 0.6),
    "climb_m_s": (0.1, 3.0),
    "yaw_rate_rad_s": (0.1, 6.0),
    "altitude_m": (0.3, 100.0),
    "speed_m_s": (0.1, 15.0),
    "takeoff_altitude_m": (0.3, 10.0),
}
