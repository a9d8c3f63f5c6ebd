"""ArduCopter in the simulated world, connected through its JSON interface and running in step with it.

ArduCopter receives the true state and derives the barometer, compass and GPS readings itself, with the errors that its
``SIM_`` parameters define; gyro, accelerometer, range finder and battery are simulated here.

ArduPilot's JSON interface for simulators sends the motor outputs as a little-endian packet over UDP and waits for the
vehicle's state, a line of JSON, in reply. The packet:

======  =======  =============================================================
offset  type     meaning
======  =======  =============================================================
0       u16      18458: 16 outputs follow; 29569: 32 outputs
2       u16      preferred frames per second
4       u32      frame; restarts at 0 with ArduPilot
8       u16 []   outputs, pulse lengths [µs], 0 for an unused one
======  =======  =============================================================

The line is between two line feeds. World axes are north, east, down; body axes are forward, right, down.

Source: https://github.com/ArduPilot/ardupilot/blob/master/libraries/SITL/examples/JSON/readme.md
"""

from __future__ import annotations

import socket
import struct
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, Final

from skyloop.errors import DecodeError
from skyloop.platform import wait_readable
from skyloop.sim.instruments import ALTITUDE_M, LATITUDE_DEG, LONGITUDE_DEG, Readings
from skyloop.vehicles.mavlink.wire.axes import flip, swap, turned_axes
from skyloop.vehicles.sim.firmware.ports import LOOPBACK, bound, free_udp_port, release_instance, reserve_instance
from skyloop.vehicles.sim.firmware.program import Commands, CoupledFirmware, FirmwareEvent, Launch, find_program

MAGIC_16, MAGIC_32 = 18458, 29569
MAX_PACKET: Final = 72  #: bytes of a packet with 32 outputs

_HEADER: Final = struct.Struct("<HHI")
_OUTPUTS: Final = {MAGIC_16: struct.Struct("<16H"), MAGIC_32: struct.Struct("<32H")}

Vector = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class ServoPacket:
    """ArduPilot's 16 or 32 outputs as pulse lengths [µs]."""

    rate_hz: int
    frame: int
    pulses_us: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class SimulatedState:
    """The state sent to ArduPilot. World axes are north, east, down; body axes are forward, right, down."""

    time_s: float  #: time; only differences between times matter
    gyro_rad_s: Vector
    acceleration_m_s2: Vector  #: specific force, which at rest is -g along z
    position_m: Vector  #: position relative to home
    quaternion: tuple[float, float, float, float]  #: w, x, y, z; rotates body axes to world axes
    velocity_m_s: Vector  #: in world axes
    range_m: float | None = None  #: reading of the first range finder; None if out of range
    battery_v: float | None = None
    battery_a: float | None = None


def decode_servos(packet: bytes) -> ServoPacket:
    """Decode a packet with outputs. Raises :class:`DecodeError`."""
    if len(packet) < _HEADER.size:
        raise DecodeError(f"{len(packet)} bytes are too few for ArduPilot's outputs")
    magic, rate, frame = _HEADER.unpack_from(packet)
    outputs = _OUTPUTS.get(magic)
    if outputs is None:
        raise DecodeError(
            f"the magic number is {magic}, not {MAGIC_16} or {MAGIC_32}: not a packet of ArduPilot's outputs"
        )
    if len(packet) != _HEADER.size + outputs.size:
        raise DecodeError(f"{len(packet)} bytes; ArduPilot's outputs have {_HEADER.size + outputs.size} bytes")
    return ServoPacket(rate, frame, outputs.unpack_from(packet, _HEADER.size))


def encode_servos(packet: ServoPacket) -> bytes:
    """Encode a packet of 16 or 32 outputs."""
    magic = MAGIC_16 if len(packet.pulses_us) == 16 else MAGIC_32
    return _HEADER.pack(magic, packet.rate_hz, packet.frame) + _OUTPUTS[magic].pack(*packet.pulses_us)


def encode_state(state: SimulatedState) -> bytes:
    """Encode a state as one line, with a line feed before and after it.

    The line tells ArduPilot not to wait for real time (``no_time_sync``), so that the sender of states sets the pace.
    ArduPilot finds a field by its quoted name and reads the value that follows; vectors need a space after each comma.
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


VARIABLE: Final = "SKYLOOP_ARDUCOPTER"
WHERE: Final = "How to get it: https://ardupilot.org/dev/docs/building-setup-linux.html (board sitl, vehicle copter)"
MOST_INSTANCES: Final = 25  #: maximum number of instances, each of which is a separate system to ground stations
STEP_S: Final = 0.001  #: time between two states, a step of the rotor-level model
LEAST_US, SPAN_US = 1000.0, 1000.0  #: pulse length of a stopped motor, and what full power adds to it
_BURST: Final = 64  # maximum number of packets read in one step

#: Parameters for this vehicle and for ArduCopter's simulated sensors. ArduCopter ignores names that its version does
#: not have.
PARAMETERS: Final[dict[str, float]] = {
    "FRAME_CLASS": 1,  # a quadrotor
    "FRAME_TYPE": 1,  # X configuration
    "MOT_PWM_MIN": LEAST_US,
    "MOT_PWM_MAX": LEAST_US + SPAN_US,
    "MOT_SPIN_ARM": 0.02,
    "MOT_SPIN_MIN": 0.03,
    "MOT_SPIN_MAX": 1.0,
    "MOT_THST_EXPO": 0.78,  # thrust is the square of rotor speed, which starts at an eighth of full speed
    "MOT_THST_HOVER": 0.6,
    "ATC_ACCEL_Y_MAX": 4000,  # [0.01°/s²]; an Iris yaws slowly, and more would cost lift
    # Rate gains with which an Iris responds within 50 ms, derived from its thrust, arms and inertia; the defaults suit
    # shorter, lighter arms.
    "ATC_RAT_RLL_P": 0.2,
    "ATC_RAT_RLL_I": 0.2,
    "ATC_RAT_RLL_D": 0.005,
    "ATC_RAT_PIT_P": 0.42,
    "ATC_RAT_PIT_I": 0.42,
    "ATC_RAT_PIT_D": 0.01,
    "ATC_RAT_YAW_P": 1.2,
    "ATC_RAT_YAW_I": 0.12,
    "FS_THR_ENABLE": 0,  # no remote control
    "RC1_MIN": 1000,  # differs from the default, so that the remote control counts as calibrated
    "RC1_MAX": 2000,
    "RC2_MIN": 1000,
    "RC2_MAX": 2000,
    "RC3_MIN": 1000,
    "RC3_MAX": 2000,
    "RC4_MIN": 1000,
    "RC4_MAX": 2000,
    **{
        f"COMPASS_OFS{n}_{axis}": offset
        for n in ("", "2", "3")
        for axis, offset in zip("XYZ", (5, 13, -18), strict=True)
    },
    **{f"INS_ACC{n}OFFS_{axis}": 0.001 for n in ("", "2") for axis in "XYZ"},
    **{f"INS_ACC{n}SCAL_{axis}": 1.001 for n in ("", "2") for axis in "XYZ"},
    "INS_GYR_CAL": 1,  # measure the gyros' bias at startup, as on a real vehicle
    "SIM_BARO_RND": 0.05,
    "BATT_MONITOR": 4,
    "RNGFND1_TYPE": 100,  # the simulator's range finder
    "RNGFND1_ORIENT": 25,  # down
    "RNGFND1_MIN_CM": 5,
    "RNGFND1_MAX_CM": 1000,
}
_NO_LOGS: Final = {"LOG_BACKEND_TYPE": 0}


class ArduCopter(CoupledFirmware):
    """ArduCopter flying a simulated drone."""

    NAME: ClassVar[str] = "ArduCopter"

    def __init__(self, on_event: Callable[[FirmwareEvent], None], *, folder: Path | None = None) -> None:
        super().__init__(on_event, folder=folder)
        self._program = ""
        self._socket: socket.socket | None = None
        self._instance: int | None = None
        self._mavlink_port = 0
        self._peer: tuple[str, int] | None = None
        self._own_s = 0.0  # ArduCopter's own time, which pauses while it is not replying
        self._asked = False  # whether ArduCopter is waiting for a state

    @property
    def address(self) -> str:
        """Its MAVLink address. A ground station can use TCP port 5762 or 5763, plus 10 for each further vehicle."""
        assert self._instance is not None, "not started"
        place = f"{LOOPBACK}:{self._mavlink_port}"
        origin = f"world_origin={LATITUDE_DEG},{LONGITUDE_DEG},{ALTITUDE_M}"  # the default is the first fix
        return f"mavlink://udpin:{place}?sysid={self._instance + 1}&{origin}"

    def _open(self) -> None:
        self._program = find_program(VARIABLE, ("arducopter",), self.NAME, WHERE)
        self._instance = reserve_instance(self.NAME, MOST_INSTANCES, _ports)
        self._socket = bound(socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        self._mavlink_port = free_udp_port()

    def _close(self) -> None:
        if self._socket is not None:
            self._socket.close()
            self._socket = None
        if self._instance is not None:
            release_instance(self.NAME, self._instance)
            self._instance = None

    def _prepare(self, folder: Path) -> Launch:
        assert self._socket is not None
        assert self._instance is not None
        parameters = PARAMETERS if self.keeps_folder else {**PARAMETERS, **_NO_LOGS}
        lines = [f"{name} {value:g}\n" for name, value in parameters.items()]
        (folder / "skyloop.parm").write_text("".join(lines), encoding="ascii")
        return Launch(
            (
                self._program,
                *("--model", f"JSON:{LOOPBACK}"),
                *("--instance", str(self._instance)),
                *("--sim-port-out", str(self._socket.getsockname()[1])),
                *("--serial0", f"udpclient:{LOOPBACK}:{self._mavlink_port}"),
                *("--sysid", str(self._instance + 1)),
                *("--home", f"{LATITUDE_DEG},{LONGITUDE_DEG},{ALTITUDE_M},0"),
                *("--defaults", "skyloop.parm"),
            )
        )

    def _begin(self) -> None:
        self._peer, self._asked, self._owed = None, False, True  # ArduCopter sends first

    def _receive(self, wait_s: float) -> Commands | None:
        until_s = time.monotonic() + wait_s
        while (commands := self._read()) is None and self._socket is not None:
            left_s = until_s - time.monotonic()
            if wait_s <= 0.0 or left_s <= 0.0 or not wait_readable(self._socket, left_s):
                break
        return commands

    def _read(self) -> Commands | None:
        commands: Commands | None = None
        for _ in range(_BURST if self._socket is not None else 0):
            assert self._socket is not None
            try:
                data, peer = self._socket.recvfrom(MAX_PACKET + 1)
                packet = decode_servos(data)
            except BlockingIOError:
                break
            except (OSError, DecodeError):
                continue  # ArduPilot's port is closed, or the packet is from another sender
            self._peer, self._asked = peer, True
            commands = _commands(packet.pulses_us)
        return commands

    def _send(self, readings: Readings) -> None:
        link = self._socket
        if not self._asked or self._peer is None or link is None:
            return
        self._own_s += STEP_S
        state = SimulatedState(
            time_s=self._own_s,
            gyro_rad_s=flip(*readings.gyro_rad_s),
            acceleration_m_s2=flip(*readings.acceleration_m_s2),
            position_m=swap(*readings.position_m),
            quaternion=turned_axes(readings.quaternion),
            velocity_m_s=swap(*readings.velocity_m_s),
            range_m=readings.range_m,
            battery_v=readings.battery_v,
            battery_a=readings.battery_a,
        )
        try:
            link.sendto(encode_state(state), self._peer)
        except OSError:  # ArduPilot has just ended
            return
        self._asked, self._owed = False, True


def _commands(pulses_us: tuple[int, ...]) -> Commands:
    """Return rotor commands in the simulation's order; ArduCopter's begins with front right and rear left."""
    front_right, rear_left, front_left, rear_right = (max(0.0, (pulse - LEAST_US) / SPAN_US) for pulse in pulses_us[:4])
    return front_left, front_right, rear_left, rear_right


def _ports(instance: int) -> list[tuple[socket.SocketKind, int]]:
    """Return the ports that ArduCopter opens for two ground stations and a remote control."""
    ten = 10 * instance
    return [(socket.SOCK_STREAM, 5762 + ten), (socket.SOCK_STREAM, 5763 + ten), (socket.SOCK_DGRAM, 5501 + ten)]
