"""The Crazyflie's firmware in the simulated world. It uses the computer's clock, so it can fly only in real time.

The firmware, built for simulation, exchanges CRTP packets with its simulator over UDP, one in each datagram: a header
(port, channel) and at most 31 bytes. The firmware begins with the packet f3 and continues once it has received the same
packet. Port 9 is the simulator's, and all numbers are little-endian:

=========================  =============================================================================================
to the firmware
90 00, i16 [6]             accelerometer [32/65536 g], then gyro [4000/65536 °/s], about forward, left, up
90 01, i16 [3]             magnetometer [1/666.7 gauss]
90 02, f32 [3]             air pressure [hPa], temperature [°C], altitude above mean sea level [m]
61 08, f32 [7]             position [m] and quaternion x, y, z, w, as a motion capture system would send them
from the firmware
90, u16 [4]                power of motors 1 to 4: front right, rear right, rear left, front left
=========================  =============================================================================================

All other packets are those of the user's client: they are exchanged between the firmware and the client that last sent
to :attr:`Crazyflie.address`. A vehicle's radio handles two packets itself, as does this coupling: the lone ff, which is
acknowledged, and ff fe 02, which switches the firmware off. It is then started again.

This build of the firmware has no decks: it can't be given a flow sensor's or a range finder's readings. Its position is
the true one, unless ``position=none``.

Sources: https://www.bitcraze.io/documentation/repository/crazyflie-firmware/master/functional-areas/crtp/ and the
packets of https://github.com/llanesc/crazyflie-firmware (branch ``sitl-release``).
"""

from __future__ import annotations

import math
import socket
import struct
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import ClassVar, Final

from skyloop.errors import DecodeError
from skyloop.sim.instruments import ALTITUDE_M, Readings
from skyloop.sim.parameters import GRAVITY_M_S2
from skyloop.vehicles.crazyflie.wire.crtp import HELLO, MAX_DATA, NULL_PACKET, POWER_OFF, UDP_PORT
from skyloop.vehicles.sim.firmware.ports import LOOPBACK, bound, release_instance, reserve_instance
from skyloop.vehicles.sim.firmware.program import (
    Commands,
    CoupledFirmware,
    FirmwareEvent,
    Launch,
    Pace,
    UnresponsiveError,
    find_program,
)

VARIABLE: Final = "SKYLOOP_CRAZYFLIE"
WHERE: Final = (
    "How to get it: https://github.com/llanesc/crazyflie-firmware (branch sitl-release); it is sitl_make/build/cf2"
)
CLIENT_PORT = UDP_PORT  #: for the first vehicle's client; the instance number is added
MOST_INSTANCES: Final = 10
SLOW_EVERY: Final = 20  #: number of steps between readings of the magnetometer, and of the barometer
POSE_EVERY: Final = 10  #: number of steps between positions
BURST_S: Final = 0.003  #: time on which late steps catch up at once
#: The firmware keeps five unread packets and loses more. With more than this number of packets sent since its last
#: answer, it gets no other one until it answers, or until this time has passed.
MOST_UNREAD: Final = 2
RETRY_S: Final = 0.005
#: Time allowed for the first reply after startup, which normally takes 0.2 s, and its limit: it grows by half with each
#: failed start in case the computer is busy.
ANSWER_S: Final = 1.0
LONGEST_ANSWER_S: Final = 6.0
_PAUSE_S: Final = 0.05  # time between requests
MAX_PACKET: Final = 1 + MAX_DATA  #: bytes
EMPTY: Final = NULL_PACKET.encode()
SWITCH_OFF: Final = POWER_OFF.encode()
VERSION: Final = b"\xd1\x00"  #: request for the protocol's version, from port 13
SIMULATOR: Final = 0x90  #: header of port 9, channel 0

_INERTIAL: Final = struct.Struct("<BB6h")
_MAGNETIC: Final = struct.Struct("<BB3h")
_AIR: Final = struct.Struct("<BB3f")
_POSE: Final = struct.Struct("<BB7f")
_MOTORS: Final = struct.Struct("<B4H")
_PER_M_S2: Final = 65536 / 32 / GRAVITY_M_S2
_PER_RAD_S: Final = math.degrees(65536 / 4000)
_PER_GAUSS: Final = 666.7
_LOCALISATION: Final = 0x61  # header of port 6, channel 1
_EXTERNAL_POSE: Final = 8  # its first byte
_FULL: Final = 65535.0

Peer = tuple[str, int]


def encode_inertial(readings: Readings) -> bytes:
    """Encode the readings of accelerometer and gyro, limited to their ranges."""
    acceleration, gyro = readings.acceleration_m_s2, readings.gyro_rad_s
    numbers = [*(_raw(a * _PER_M_S2) for a in acceleration), *(_raw(rate * _PER_RAD_S) for rate in gyro)]
    return _INERTIAL.pack(SIMULATOR, 0, *numbers)


def encode_magnetic(readings: Readings) -> bytes:
    """Encode the reading of the magnetometer."""
    return _MAGNETIC.pack(SIMULATOR, 1, *(_raw(field * _PER_GAUSS) for field in readings.magnetic_gauss))


def encode_air(readings: Readings) -> bytes:
    """Encode the reading of the barometer."""
    altitude_m = ALTITUDE_M + readings.position_m[2]
    return _AIR.pack(SIMULATOR, 2, readings.pressure_pa / 100.0, readings.temperature_c, altitude_m)


def encode_pose(readings: Readings) -> bytes:
    """Encode the true position and attitude."""
    w, x, y, z = readings.quaternion
    return _POSE.pack(_LOCALISATION, _EXTERNAL_POSE, *readings.position_m, x, y, z, w)


def encode_motors(motors: tuple[int, int, int, int]) -> bytes:
    """Encode the motors as the firmware sends them."""
    return _MOTORS.pack(SIMULATOR, *motors)


def decode_motors(packet: bytes) -> Commands:
    """Return the rotor commands in the simulation's order. Raises :class:`DecodeError`."""
    if len(packet) != _MOTORS.size:
        raise DecodeError(f"a Crazyflie's motor packet has {_MOTORS.size} bytes, got {len(packet)}")
    _, front_right, rear_right, rear_left, front_left = _MOTORS.unpack(packet)
    return front_left / _FULL, front_right / _FULL, rear_left / _FULL, rear_right / _FULL


def _raw(value: float) -> int:
    return max(-32768, min(32767, round(value)))


class Crazyflie(CoupledFirmware):
    """A Crazyflie's firmware flying a simulated drone.

    :meth:`exchange` waits until the step's time on the computer's clock, because the firmware needs evenly spaced
    readings, and passes packets between the firmware and its client.
    """

    NAME: ClassVar[str] = "Crazyflie"

    def __init__(
        self, on_event: Callable[[FirmwareEvent], None], *, folder: Path | None = None, position: bool = True
    ) -> None:
        """Prepare to run the firmware; ``position`` is whether it gets its true position, as from motion capture."""
        super().__init__(on_event, folder=folder)
        self._position = position
        self._program = ""
        self._instance: int | None = None
        self._radio: socket.socket | None = None  # to its client
        self._client: Peer | None = None
        self._starting: socket.socket | None = None  # to a process that has not answered yet
        self._link: tuple[socket.socket, Peer] | None = None  # to the one that has
        self._patience_s = ANSWER_S
        self._pace = Pace(BURST_S)
        self._unread = 0  # number of packets sent since its last answer
        self._sent_s = 0.0
        self._step = 0

    @property
    def address(self) -> str:
        """Its address over UDP, which other clients such as Bitcraze's can use as well."""
        assert self._instance is not None, "not started"
        return f"crazyflie://udp:{LOOPBACK}:{CLIENT_PORT + self._instance}"

    def _open(self) -> None:
        self._program = find_program(VARIABLE, ("cf2",), self.NAME, WHERE)
        self._instance = reserve_instance(self.NAME, MOST_INSTANCES, _ports)
        self._radio = bound(socket.SOCK_DGRAM, CLIENT_PORT + self._instance)
        self._radio.setblocking(False)
        self._pace.open()

    def _close(self) -> None:
        self._pace.close()
        link, self._link = self._link, None
        for each in (self._radio, self._starting, None if link is None else link[0]):
            if each is not None:
                each.close()
        self._radio = self._starting = None
        if self._instance is not None:
            release_instance(self.NAME, self._instance)
            self._instance = None

    def _prepare(self, folder: Path) -> Launch:  # noqa: ARG002  it writes no files
        if self._starting is not None:
            self._starting.close()
        self._starting = bound(socket.SOCK_DGRAM)
        return Launch((self._program, str(self._starting.getsockname()[1]), LOOPBACK))

    def _verify(self) -> None:
        """Say hello and wait until it answers: one start out of two never does, by a race in its own start."""
        starting, self._starting = self._starting, None
        assert starting is not None
        firmware = _greeted(starting, self._patience_s)
        if firmware is None:
            starting.close()
            waited_s, self._patience_s = self._patience_s, min(1.5 * self._patience_s, LONGEST_ANSWER_S)
            raise UnresponsiveError(f"it did not answer within {waited_s:g} s of its start")
        self._patience_s = ANSWER_S
        starting.setblocking(False)
        before, self._link = self._link, (starting, firmware)  # in one step, because the simulation's thread uses it
        if before is not None:
            before[0].close()

    def _begin(self) -> None:
        self._step = self._unread = 0  # the client stays, and notices a vehicle that restarts

    def _receive(self, wait_s: float) -> Commands | None:  # noqa: ARG002  no reply is owed: it runs in real time
        commands: Commands | None = None
        while self._link is not None:
            try:
                packet, sender = self._link[0].recvfrom(MAX_PACKET)
            except OSError:
                break  # there is none
            if sender != self._link[1] or not packet:
                continue
            if packet[0] == SIMULATOR and len(packet) == _MOTORS.size:
                commands = decode_motors(packet)
            elif packet[0] >> 4 != SIMULATOR >> 4:
                self._answer(packet)
        if commands is not None:
            self._unread = 0
        return commands

    def _send(self, readings: Readings) -> None:
        self._pace.keep()
        if self._answered_s is None:
            self._discard()
        if self._link is None or (self._unread > MOST_UNREAD and time.monotonic() < self._sent_s + RETRY_S):
            return  # it does not keep up: what it can't keep is lost
        if self._unread == 0:
            step, self._step = self._step % SLOW_EVERY, self._step + 1
            if step == 0:
                self._tell(encode_magnetic(readings))
            elif step == SLOW_EVERY // 2:
                self._tell(encode_air(readings))
            elif step % POSE_EVERY == 1 and self._position:
                self._tell(encode_pose(readings))
            elif self._answered_s is not None:
                self._relay()
        self._tell(encode_inertial(readings))

    def _discard(self) -> None:
        """Lose what the client sends to a vehicle that is switched off: it must not take off by it later."""
        with suppress(OSError):
            while self._radio is not None:
                self._radio.recvfrom(MAX_PACKET)

    def _relay(self) -> None:
        """Pass on one packet of the client."""
        if self._radio is None:
            return
        try:
            packet, self._client = self._radio.recvfrom(MAX_PACKET)
        except OSError:
            return  # there is none
        if packet == EMPTY:
            self._answer(EMPTY)
        elif packet == SWITCH_OFF:
            self.program.restart()
        elif packet and packet[0] >> 4 != SIMULATOR >> 4:
            self._tell(packet)

    def _tell(self, packet: bytes) -> None:
        self._unread += 1
        self._sent_s = time.monotonic()
        self._send_to_firmware(packet)

    def _send_to_firmware(self, packet: bytes) -> None:
        link = self._link
        if link is not None:
            with suppress(OSError):  # the firmware has just ended
                link[0].sendto(packet, link[1])

    def _answer(self, packet: bytes) -> None:
        if self._radio is not None and self._client is not None:
            with suppress(OSError):
                self._radio.sendto(packet, self._client)


def _greeted(link: socket.socket, within_s: float) -> Peer | None:
    """Return the address of the firmware once it has answered; None if it doesn't within a time."""
    firmware: Peer | None = None
    link.settimeout(_PAUSE_S)
    end_s = time.monotonic() + within_s
    while time.monotonic() < end_s:
        try:
            packet, sender = link.recvfrom(MAX_PACKET)
        except OSError:
            if firmware is not None:
                link.sendto(VERSION, firmware)
            continue
        if packet == HELLO:
            firmware = sender
            link.sendto(HELLO, firmware)
        elif packet[:1] == VERSION[:1] and sender == firmware:
            return firmware
    return None


def _ports(instance: int) -> list[tuple[socket.SocketKind, int]]:
    return [(socket.SOCK_DGRAM, CLIENT_PORT + instance)]
