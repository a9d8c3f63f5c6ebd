"""ArduPilot's JSON interface to simulators: motor outputs as packets, and the vehicle's state as lines of JSON. Pure.

ArduPilot sends a packet over UDP, little endian, and waits for a line that answers it:

======  =======  =============================================================
offset  type     meaning
======  =======  =============================================================
0       u16      18458: 16 outputs follow; 29569: 32 outputs
2       u16      frames a second that it would like
4       u32      frame; starts again at 0 when ArduPilot does
8       u16 []   outputs, pulse lengths [µs], 0 for one that is not driven
======  =======  =============================================================

The line is a JSON object between two line feeds. World axes are north, east, down, body axes forward, right, down.

Source: https://github.com/ArduPilot/ardupilot/blob/master/libraries/SITL/examples/JSON/readme.md
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import Final

from skyloop.errors import DecodeError

MAGIC_16: Final = 18458
MAGIC_32: Final = 29569
MAX_PACKET: Final = 72

_HEADER: Final = struct.Struct("<HHI")
_OUTPUTS: Final = {MAGIC_16: struct.Struct("<16H"), MAGIC_32: struct.Struct("<32H")}

Vector = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class ServoPacket:
    """What ArduPilot sends: its outputs as pulse lengths [µs], 16 or 32."""

    rate_hz: int
    frame: int
    pulses_us: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class SimulatedState:
    """What ArduPilot is told. World axes north, east, down; body axes forward, right, down."""

    time_s: float  #: only differences count
    gyro_rad_s: Vector
    acceleration_m_s2: Vector  #: specific force: at rest, -g along z
    position_m: Vector  #: from the home position
    quaternion: tuple[float, float, float, float]  #: w, x, y, z: world from body
    velocity_m_s: Vector  #: world axes
    range_m: float | None = None  #: of the first range finder; None: it sees nothing
    battery_v: float | None = None
    battery_a: float | None = None


def decode_servos(packet: bytes) -> ServoPacket:
    """Decode a packet of outputs.

    Raises:
        DecodeError: It is none.
    """
    if len(packet) < _HEADER.size:
        raise DecodeError(f"{len(packet)} bytes are too few for ArduPilot's outputs")
    magic, rate, frame = _HEADER.unpack_from(packet)
    outputs = _OUTPUTS.get(magic)
    if outputs is None:
        raise DecodeError(
            f"the magic number is {magic}, not {MAGIC_16} or {MAGIC_32}: no packet of ArduPilot's outputs"
        )
    if len(packet) != _HEADER.size + outputs.size:
        raise DecodeError(f"{len(packet)} bytes, where ArduPilot's outputs have {_HEADER.size + outputs.size}")
    return ServoPacket(rate, frame, outputs.unpack_from(packet, _HEADER.size))


def encode_servos(packet: ServoPacket) -> bytes:
    """Encode a packet of 16 or 32 outputs."""
    magic = MAGIC_16 if len(packet.pulses_us) == 16 else MAGIC_32
    return _HEADER.pack(magic, packet.rate_hz, packet.frame) + _OUTPUTS[magic].pack(*packet.pulses_us)


def encode_state(state: SimulatedState) -> bytes:
    """Encode a state as one line, with a line feed before and after it.

    ArduPilot's own clock is not to wait for real time then (``no_time_sync``): whoever sends states keeps the pace. It
    finds a field by its name in quotes and reads what follows at once, and vectors with a space after each comma.
    """
    fields = (
        f'"timestamp":{state.time_s:.6f},'
        f'"imu":{{"gyro":{_array(state.gyro_rad_s)},"accel_body":{_array(state.acceleration_m_s2)}}},'
        f'"position":{_array(state.position_m)},"quaternion":{_array(state.quaternion)},'
        f'"velocity":{_array(state.velocity_m_s)},"no_time_sync":1'
    )
    if state.range_m is not None:
        fields += f',"rng_1":{state.range_m:.4f}'
    if state.battery_v is not None:
        fields += f',"battery":{{"voltage":{state.battery_v:.4f},"current":{state.battery_a or 0.0:.4f}}}'
    return f"\n{{{fields}}}\n".encode()


def _array(numbers: tuple[float, ...]) -> str:
    return "[" + ", ".join([f"{number:.9g}" for number in numbers]) + "]"
