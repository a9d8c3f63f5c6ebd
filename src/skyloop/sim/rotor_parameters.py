"""Parameters of a vehicle's rotors and instruments: what the rotor-level model needs beside the vehicle's others."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, fields

from skyloop.errors import UsageError
from skyloop.sim.world import Vec3

#: Rotors are numbered front left, front right, rear left, rear right. Seen from above the first and the last turn
#: clockwise, the others counter-clockwise, as in the X quadrotors of Betaflight, ArduPilot and PX4; so a rotor's torque
#: turns the body counter-clockwise (1, yaw to the left) or clockwise (-1).
YAW_SIGNS = (1.0, -1.0, -1.0, 1.0)

Places = tuple[tuple[float, float], tuple[float, float], tuple[float, float], tuple[float, float]]


@dataclass(frozen=True, slots=True)
class InstrumentParameters:
    """Errors, rates and delays of a vehicle's instruments.

    ``noise`` is the standard deviation of a sample, ``bias`` that of an error that a flight starts with and that
    wanders with the time constant, the gyro's with its own. ``docs/rotors.md`` says where the defaults come from.

    Raises:
        UsageError: A value is not finite or negative, or zero where it has to be more.
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

    A rotor that turns at ω gives the thrust ``thrust_n_s2`` ω², and ``torque_m`` times that as torque. It follows its
    command with a first-order lag. A command of 0 stops it; above, its speed is between ``idle_speed_rad_s`` and
    ``full_speed_rad_s`` in proportion, both with a full battery: speed falls with the voltage.

    Attributes:
        places_m: Of the rotors, forward and left of the centre of mass, in the order of :data:`YAW_SIGNS`.
        inertia_kg_m2: About the body's axes.
        thrust_n_s2: Thrust per square of the speed.
        torque_m: Torque per thrust.
        idle_speed_rad_s: Of a rotor that just turns.
        full_speed_rad_s: Of a rotor at full command.
        speed_up_s: Time constant of a rotor that gets faster.
        speed_down_s: And of one that gets slower.
        rotor_drag_kg: Force against the airspeed in the plane of the rotors, per airspeed and per sum of the
            rotors' speeds: blades flap, and their own drag is lopsided.
        rotor_inflow_kg: The same along the rotors' axes: air from above takes thrust away.
        body_drag_kg_m: Force per square of the airspeed, along the body's axes.
        rotor_inertia_kg_m2: Of one rotor about its axis: a rotor that gets faster turns the body the other way.
        efficiency: Share of the battery's power that the rotors' shafts give to the air as torque times speed.
        instruments: Errors of the instruments.

    Raises:
        UsageError: A value is not finite or out of its range, or the rotors do not surround the centre of mass.
    """

    places_m: Places
    inertia_kg_m2: Vec3
    thrust_n_s2: float
    torque_m: float
    idle_speed_rad_s: float
    full_speed_rad_s: float
    speed_up_s: float
    speed_down_s: float
    rotor_drag_kg: float
    rotor_inflow_kg: float
    body_drag_kg_m: Vec3
    efficiency: float
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


def _check(parameters: InstrumentParameters | RotorParameters, positive: Callable[[str], bool]) -> None:
    for one in fields(parameters):
        value = getattr(parameters, one.name)
        if isinstance(value, tuple | InstrumentParameters):
            continue
        if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
            raise UsageError(f"{one.name} must be a finite number, not {value!r}")
        if value < 0 or (value == 0 and positive(one.name)):
            least = "greater than 0" if positive(one.name) else "at least 0"
            raise UsageError(f"{one.name} must be {least}, not {value!r}")
