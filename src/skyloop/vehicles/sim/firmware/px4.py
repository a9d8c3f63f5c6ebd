"""PX4 in the simulated world, connected through MAVLink's hardware-in-the-loop messages and running in step with it.

PX4 connects to a TCP server on port 4560, or one higher for each further vehicle. ``HIL_SENSOR`` is PX4's clock: PX4
replies to each with ``HIL_ACTUATOR_CONTROLS`` once its startup has reached the point where it drives motors.
https://docs.px4.io/main/en/simulation/#px4-mavlink-api
"""

from __future__ import annotations

import math
import os
import socket
import struct
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, ClassVar, Final

from skyloop.errors import UsageError
from skyloop.messages.geometry import in_16_bits
from skyloop.platform import wait_readable
from skyloop.sim.instruments import ALTITUDE_M, LATITUDE_DEG, LONGITUDE_DEG, GpsFix, Readings, geodetic
from skyloop.sim.parameters import InstrumentParameters
from skyloop.vehicles.mavlink.wire.axes import flip, swap, turned_axes
from skyloop.vehicles.mavlink.wire.codec import MavlinkCodec, dialect
from skyloop.vehicles.sim.firmware.ports import LOOPBACK, bound, release_instance, reserve_instance
from skyloop.vehicles.sim.firmware.program import Commands, CoupledFirmware, FirmwareEvent, Launch, find_program

VARIABLE: Final = "SKYLOOP_PX4"
WHERE: Final = (
    "How to get it: https://docs.px4.io/main/en/dev_setup/building_px4.html (px4_sitl); it is bin/px4 of the build"
)
MODEL: Final = "none_iris"  #: PX4's quadrotor for an external simulator
AIRFRAME: Final = "10016"  #: its number
# Ports in PX4's startup scripts, to which the instance number is added: of the simulator and the receiver of telemetry,
# then PX4's own for a companion computer and a ground station.
SIMULATOR_PORT, TELEMETRY_PORT, COMPANION_PORT, STATION_PORT = 4560, 14540, 14580, 18570
MOST_INSTANCES: Final = 10  #: maximum number of instances: PX4 would use the same port for all further vehicles
STEPS: Final = 4  #: simulation steps per step of PX4: 250 Hz, as its startup script for such simulators expects
STEP_US: Final = 4000  #: duration of a step of PX4
TRUTH_EVERY: Final = 5  #: number of PX4 steps between truth messages
RANGE_EVERY: Final = 10  #: number of PX4 steps between readings of the range finder
PROBE_EVERY: Final = 25  #: number of PX4 steps between probes while PX4 is silent
LOCK_FILE = "/tmp/px4_lock"  # followed by a hyphen and the instance number
MAX_BACKLOG: Final = 4096  #: number of unsent bytes at which PX4 is assumed to have stopped reading
MAX_READ: Final = 65536  #: bytes per read
#: Parameters for this vehicle. Without a remote control, PX4 must hold position when set-points stop.
PARAMETERS: Final = {
    "MPC_THR_HOVER": "0.7",
    "THR_MDL_FAC": "0.78",  # thrust is the square of rotor speed, which starts at an eighth of full speed
    "COM_OBL_RC_ACT": "5",
}
#: Names of the parameter for the GPS delay [ms] before and since early 2026; each version ignores the other name. PX4's
#: startup script for simulators sets it to 10. Because each fix has an outdated velocity, an underestimated delay turns
#: PX4's heading while it flies circles in one direction.
GPS_DELAYS: Final = ("EKF2_GPS_DELAY", "SENS_GPS0_DELAY")
_EVERYTHING: Final = 0b1_1011_1111_1111  #: flags marking all readings except the differential pressure as new
_NO_LOGS: Final = {"SDLOG_MODE": "-1"}
_SYSTEM, _COMPONENT = 1, 200  # the simulator's ids; MAV_COMP_ID_IMU
_DOWN: Final = 25  # MAV_SENSOR_ROTATION_PITCH_270
_FIX_3D: Final = 3  # GPS_FIX_TYPE_3D_FIX
_UNKNOWN_COURSE: Final = 65535  # HIL_GPS.cog


class Px4(CoupledFirmware):
    """PX4 flying a simulated drone."""

    NAME: ClassVar[str] = "PX4"

    def __init__(
        self,
        on_event: Callable[[FirmwareEvent], None],
        *,
        folder: Path | None = None,
        instruments: InstrumentParameters = InstrumentParameters(),  # noqa: B008  immutable
    ) -> None:
        super().__init__(on_event, folder=folder)
        self._gps_delay_ms = round(instruments.gps_delay_s * 1000.0)
        self._codec = MavlinkCodec(_SYSTEM, _COMPONENT)
        self._program = ""
        self._instance: int | None = None
        self._server: socket.socket | None = None
        self._link: socket.socket | None = None
        self._backlog = b""
        self._step = 0
        self._sent = 0  # number of states sent
        self._inertial: list[tuple[float, ...]] = []  # gyro and accelerometer readings since the last state
        self._fix: GpsFix | None = None
        self._own_us = STEP_US  # PX4's own time, which pauses while it is not replying
        self._wanted_us = 0  # commands older than this are replies to an earlier state

    @property
    def address(self) -> str:
        """Its MAVLink address. A ground station that listens on this computer's UDP port 14550 finds it as well."""
        i = self._instance
        assert i is not None, "not started"
        peer = f"peer={LOOPBACK}:{COMPANION_PORT + i}"
        origin = f"origin={LATITUDE_DEG},{LONGITUDE_DEG},{ALTITUDE_M}"
        return f"mavlink://udpin:{LOOPBACK}:{TELEMETRY_PORT + i}?sysid={i + 1}&{peer}&{origin}"

    def _open(self) -> None:
        self._program = find_program(VARIABLE, ("px4",), self.NAME, WHERE)
        if not self._files().is_dir():
            raise UsageError(f"{self._program} has no {self._files()}: {VARIABLE} must be bin/px4 of a complete build")
        self._instance = reserve_instance(self.NAME, MOST_INSTANCES, _ports, _runs)
        self._server = bound(socket.SOCK_STREAM, SIMULATOR_PORT + self._instance)
        self._server.listen(1)
        self._server.setblocking(False)

    def _files(self) -> Path:
        """Return the folder with PX4's startup scripts, which is next to the program's folder."""
        return Path(self._program).resolve().parent.parent / "etc"

    def _close(self) -> None:
        self._hang_up()
        if self._server is not None:
            self._server.close()
            self._server = None
        if self._instance is not None:
            release_instance(self.NAME, self._instance)
            self._instance = None

    def _prepare(self, folder: Path) -> Launch:  # noqa: ARG002  its parameters are kept in its working folder
        environment = {"PX4_SIM_MODEL": MODEL, "PX4_SYS_AUTOSTART": AIRFRAME, "PX4_SIM_HOSTNAME": LOOPBACK}
        parameters = {**PARAMETERS, **dict.fromkeys(GPS_DELAYS, str(self._gps_delay_ms))}
        if not self.keeps_folder:
            parameters |= _NO_LOGS
        environment.update({f"PX4_PARAM_{name}": value for name, value in parameters.items()})
        command = (self._program, "-i", str(self._instance), "-d", str(self._files()))
        return Launch(command, environment)

    def _begin(self) -> None:
        self._hang_up()
        self._codec = MavlinkCodec(_SYSTEM, _COMPONENT)
        self._backlog, self._step, self._sent, self._fix = b"", 0, 0, None
        self._own_us, self._wanted_us = STEP_US, 0
        self._inertial.clear()

    # Receiving ---------------------------------------------------------------------------------------------------

    def _receive(self, wait_s: float) -> Commands | None:
        if self._link is None and not self._accept():
            return None
        commands: Commands | None = None
        while (link := self._link) is not None:
            if wait_s > 0.0 and commands is None and not wait_readable(link, wait_s):
                break
            data = self._read(link)
            if not data:
                break
            for message in self._codec.decode(data):
                if message.get_type() == "HIL_ACTUATOR_CONTROLS" and message.time_usec >= self._wanted_us:
                    commands = _commands(message.controls)
            if wait_s > 0.0 and commands is not None:
                break
        return commands

    def _accept(self) -> bool:
        if self._server is None:
            return False
        try:
            link, _ = self._server.accept()
        except OSError:
            return False
        link.setblocking(False)
        link.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._link = link
        return True

    def _read(self, link: socket.socket) -> bytes:
        try:
            data = link.recv(MAX_READ)
        except BlockingIOError:
            return b""
        except OSError:
            data = b""
        if not data:
            self._hang_up()
        return data

    def _hang_up(self) -> None:
        if self._link is not None:
            self._link.close()
            self._link = None

    # Sending -----------------------------------------------------------------------------------------------------

    def _send(self, readings: Readings) -> None:
        self._inertial.append((*readings.gyro_rad_s, *readings.acceleration_m_s2))
        self._fix = readings.gps or self._fix
        self._step += 1
        if self._step % STEPS:
            return
        inertial = [sum(column) / len(self._inertial) for column in zip(*self._inertial, strict=True)]
        self._inertial.clear()
        if self._link is None:
            return
        if self._owed and not self._patient and self._answered_s is not None and self._step % (STEPS * PROBE_EVERY):
            return  # PX4 hangs: data sent now would be outdated by the time it reads again
        messages = [*self._due(readings), self._sensor(readings, inertial)]
        self._transmit(b"".join(self._codec.encode(message) for message in messages))
        self._wanted_us = self._own_us if self._patient else 0
        self._sent += 1
        self._own_us += STEP_US
        self._owed = True

    def _due(self, readings: Readings) -> list[Any]:
        """Return the messages due at lower rates, to be sent before the message that advances PX4's clock."""
        due = []
        if self._fix is not None:
            due.append(self._gps(self._fix))
            self._fix = None
        if self._sent % TRUTH_EVERY == 0:
            due.append(self._truth(readings))
        if self._sent % RANGE_EVERY == 0 and readings.range_m is not None:
            due.append(self._range(readings.range_m))
        return due

    def _transmit(self, data: bytes) -> None:
        link = self._link
        if link is None or len(self._backlog) > MAX_BACKLOG:
            return
        self._backlog += data
        try:
            sent = link.send(self._backlog)
        except BlockingIOError:
            return
        except OSError:
            self._hang_up()
            return
        self._backlog = self._backlog[sent:]

    def _sensor(self, readings: Readings, inertial: list[float]) -> Any:
        gyro, acceleration = flip(*inertial[:3]), flip(*inertial[3:])
        return dialect.MAVLink_hil_sensor_message(
            self._own_us,
            *acceleration,
            *gyro,
            *flip(*readings.magnetic_gauss),
            abs_pressure=readings.pressure_pa / 100.0,
            diff_pressure=0.0,
            pressure_alt=ALTITUDE_M + readings.position_m[2],
            temperature=readings.temperature_c,
            fields_updated=_EVERYTHING,
        )

    def _gps(self, fix: GpsFix) -> Any:
        east, north, up = fix.velocity_m_s
        speed = math.hypot(east, north)
        course = (
            round(math.degrees(math.atan2(east, north)) % 360.0 * 100.0) % 36000 if speed > 0.1 else _UNKNOWN_COURSE
        )
        return dialect.MAVLink_hil_gps_message(
            self._own_us,
            _FIX_3D,
            round(fix.latitude_deg * 1e7),
            round(fix.longitude_deg * 1e7),
            round(fix.altitude_m * 1000.0),
            round(fix.horizontal_error_m * 100.0),
            round(fix.vertical_error_m * 100.0),
            round(speed * 100.0),
            round(north * 100.0),
            round(east * 100.0),
            round(-up * 100.0),
            course,
            fix.satellites,
        )

    def _truth(self, readings: Readings) -> Any:
        latitude, longitude, altitude = geodetic(readings.position_m)
        north, east, down = swap(*readings.velocity_m_s)
        speed_cm_s = min(65535, round(math.hypot(north, east, down) * 100.0))
        return dialect.MAVLink_hil_state_quaternion_message(
            self._own_us,
            turned_axes(readings.quaternion),
            *flip(*readings.rates_rad_s),
            round(latitude * 1e7),
            round(longitude * 1e7),
            round(altitude * 1000.0),
            *(in_16_bits(v * 100.0) for v in (north, east, down)),
            speed_cm_s,
            speed_cm_s,
            *(in_16_bits(a / 9.80665 * 1000.0) for a in flip(*readings.acceleration_m_s2)),
        )

    def _range(self, range_m: float) -> Any:
        return dialect.MAVLink_distance_sensor_message(
            self._own_us // 1000 & 0xFFFFFFFF, 5, 1000, round(range_m * 100.0), 0, 0, _DOWN, 0
        )


def _commands(controls: list[float]) -> Commands | None:
    """Return rotor commands in the simulation's order; None if there are none. PX4's X uses ArduCopter's order."""
    motors = controls[:4]
    if not all(map(math.isfinite, motors)):
        return None
    front_right, rear_left, front_left, rear_right = (max(0.0, motor) for motor in motors)
    return front_left, front_right, rear_left, rear_right


def _runs(instance: int) -> bool:
    """Return whether a PX4 process holds this instance's lock, in which case another process would exit at once."""
    if sys.platform != "linux":
        return False
    import fcntl

    asked = struct.pack("hhqqi", fcntl.F_WRLCK, os.SEEK_SET, 0, 0, 0)  # struct flock for the whole file
    try:
        with Path(f"{LOCK_FILE}-{instance}").open("rb") as file:
            answer = fcntl.fcntl(file, fcntl.F_GETLK, asked)
    except OSError:
        return False  # there is no lock file
    return int(struct.unpack("hhqqi", answer)[0]) != fcntl.F_UNLCK


def _ports(instance: int) -> list[tuple[socket.SocketKind, int]]:
    """Return an instance's ports: the simulator's, PX4's own, and the port to which it sends telemetry."""
    return [
        (socket.SOCK_STREAM, SIMULATOR_PORT + instance),
        (socket.SOCK_DGRAM, COMPANION_PORT + instance),
        (socket.SOCK_DGRAM, TELEMETRY_PORT + instance),
        (socket.SOCK_DGRAM, STATION_PORT + instance),
    ]
