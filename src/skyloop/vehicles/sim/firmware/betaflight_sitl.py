"""What Betaflight's program for software in the loop exchanges with a simulator over UDP. Pure.

To port 9003 comes the state: 18 little-endian doubles, 144 bytes.

======  =====  =========================================================================================
offset  count  meaning
======  =====  =========================================================================================
0       1      time [s]. The difference to the packet before, by the time between both, is how fast Betaflight's
               clock goes until the next; 0 leaves it as it is
8       3      gyro, about forward, right, down [rad/s]
32      3      specific force along backward, right, down [m/s²]; at rest (0, 0, -g)
56      4      quaternion w, x, y, z: from body (forward, right, down) to world (north, east, down)
88      3      velocity east, north, up [m/s]
112     3      longitude, latitude [°], altitude [m]
136     1      air pressure [Pa]
======  =====  =========================================================================================

From it come the motors: to port 9002 four floats, 0 to 1, in the order of the Gazebo plug-in that they were made for:
Betaflight's motors 2, 3, 4 and 1. (Port 9001 gets them as pulse lengths.)

Sources: ``src/platform/SIMULATOR/sitl.c`` (``updateState``, ``pwmCompleteMotorUpdate``) and ``target/SITL/target.h`` of
Betaflight 4.6 describe it. The Python wrapper of the package ``betaflight`` sends position and velocity the other way
round.
"""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass
from typing import Final

from skyloop.errors import DecodeError

MOTORS_PORT: Final = 9002
STATE_PORT: Final = 9003
STICKS_PORT: Final = 9004
MSP_PORT: Final = 5761  #: TCP: its first serial port

_STATE: Final = struct.Struct("<18d")
_MOTORS: Final = struct.Struct("<4f")

Vector = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class FlightState:
    """What Betaflight is told, in the axes of the packet."""

    time_s: float
    gyro_rad_s: Vector
    acceleration_m_s2: Vector
    quaternion: tuple[float, float, float, float]
    velocity_m_s: Vector
    place: Vector  #: longitude [°], latitude [°], altitude [m]
    pressure_pa: float


def encode_state(state: FlightState) -> bytes:
    """Encode a state."""
    return _STATE.pack(
        state.time_s,
        *state.gyro_rad_s,
        *state.acceleration_m_s2,
        *state.quaternion,
        *state.velocity_m_s,
        *state.place,
        state.pressure_pa,
    )


def decode_state(packet: bytes) -> FlightState:
    """Decode a state.

    Raises:
        DecodeError: It is none.
    """
    n = _numbers(_STATE, packet, "a state")
    return FlightState(
        n[0], _vector(n, 1), _vector(n, 4), (n[7], n[8], n[9], n[10]), _vector(n, 11), _vector(n, 14), n[17]
    )


def encode_motors(motors: tuple[float, float, float, float]) -> bytes:
    """Encode the motors as in port 9002's packet."""
    return _MOTORS.pack(*motors)


def decode_motors(packet: bytes) -> tuple[float, float, float, float]:
    """Decode port 9002's packet: front right, rear left, front left, rear right.

    Raises:
        DecodeError: It is none.
    """
    front_right, rear_left, front_left, rear_right = _numbers(_MOTORS, packet, "the motors")
    return front_right, rear_left, front_left, rear_right


def _numbers(layout: struct.Struct, packet: bytes, what: str) -> tuple[float, ...]:
    if len(packet) != layout.size:
        raise DecodeError(f"{len(packet)} bytes, where {what} of Betaflight have {layout.size}")
    numbers = layout.unpack(packet)
    if not all(map(math.isfinite, numbers)):
        raise DecodeError(f"{what} of Betaflight have a number that is not finite: {numbers}")
    return numbers


def _vector(numbers: tuple[float, ...], begin: int) -> Vector:
    return numbers[begin], numbers[begin + 1], numbers[begin + 2]
