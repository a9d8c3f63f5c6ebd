"""A simulation's reports on its drones: their own estimates, the true state, and occurrences."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

from skyloop.messages import FlightState
from skyloop.sim.world import Vec3


@dataclass(frozen=True, slots=True)
class VehicleFeedback:
    """A drone's estimates, including its sensors' noise and biases.

    Angles are roll (right side down), pitch (nose down) and yaw (counter-clockwise from east), within ±π.
    """

    time_s: float  #: simulation time
    state: FlightState
    emergency_reason: str  #: reason why the motors were cut; empty in all other states
    battery: float  #: remaining charge, 0 to 1
    battery_v: float
    roll_rad: float
    pitch_rad: float
    yaw_rad: float
    altitude_m: float  #: height of the feet above the floor
    velocity_m_s: Vec3  #: velocity forward, left, up, in levelled axes
    angular_velocity_rad_s: Vec3  #: angular velocity about the body's axes
    acceleration_m_s2: Vec3  #: specific force along the body's axes: +g along z at rest


@dataclass(frozen=True, slots=True)
class VehicleTruth:
    """A drone's true state. World axes are east, north, up."""

    time_s: float
    state: FlightState
    position_m: Vec3  #: position of the centre of the body
    velocity_m_s: Vec3
    roll_rad: float
    pitch_rad: float
    yaw_rad: float
    quaternion: tuple[float, float, float, float]  #: rotation, world from body: x, y, z, w
    angular_velocity_rad_s: Vec3  #: angular velocity about the body's axes
    thrust: float  #: thrust as a fraction of the weight, before ground effect
    wind_m_s: Vec3
    battery: float  #: remaining charge, 0 to 1


class OccurrenceKind(StrEnum):
    """Types of occurrences."""

    COLLISION = "collision"
    EMERGENCY = "emergency"
    BATTERY_LOW = "battery_low"
    SLOW = "slow"  #: applies to all drones: this computer is too slow for the requested speed


@dataclass(frozen=True, slots=True)
class Occurrence:
    """Something that happened to a drone. ``speed_m_s`` is the speed along the normal for collisions, else 0."""

    kind: OccurrenceKind
    drone: int
    time_s: float
    text: str
    speed_m_s: float = 0.0
