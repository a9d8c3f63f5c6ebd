"""A Crazyradio (PA or 2.0) on USB, and its vehicles, which it talks to in turns.

A vehicle acknowledges each packet, and the acknowledgement may contain a packet from the vehicle. Without a packet to
send, the radio polls with null packets. With the *safe link*, two bits in the header count the packets in each
direction, so that a packet whose acknowledgement was lost is repeated and not obeyed twice.

Bitcraze describes the radio's USB requests at
https://www.bitcraze.io/documentation/repository/crazyradio-firmware/master/functional-areas/usb_radio_protocol/.
"""

from __future__ import annotations

import errno
import socket
import threading
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any, Final, Protocol

from skyloop.clock import monotonic_ns, nanoseconds, seconds
from skyloop.errors import MissingExtraError
from skyloop.vehicles.crazyflie.options import RadioAddress
from skyloop.vehicles.crazyflie.wire.commander import EmergencyStopMessage
from skyloop.vehicles.crazyflie.wire.crtp import (
    MAX_DATA,
    NEWEST_PROTOCOL,
    NULL_PACKET,
    OLDEST_PROTOCOL,
    CrtpPacket,
)

VENDOR, PRODUCT = 0x1915, 0x7777  #: USB identity of both Crazyradios
IDLE_NS: Final = nanoseconds(0.01)  #: time between polls of a vehicle that has nothing to say
ABSENT_NS: Final = nanoseconds(0.1)  #: the same for one that does not answer
STALE_NS: Final = nanoseconds(0.3)  #: age at which a packet that was not acknowledged is dropped
MOST_WAITING: Final = 64  #: packets
LONGEST_WAIT_S: Final = 0.002  #: how long a packet to be sent may wait for the thread
SAFE_LINK: Final = b"\xff\x05\x01"  #: request for the safe link, echoed by a vehicle that has it
SAFE_LINK_TRIES: Final = 10
_RATES: Final = {"250K": 0, "1M": 1, "2M": 2}
_TO_DEVICE: Final = 0x40
_CHANNEL, _ADDRESS, _RATE, _POWER, _ACK_DELAY, _RETRIES = 1, 2, 3, 4, 5, 6  # USB requests
_FULL_POWER: Final = 3
_ACK_BYTES: Final = 0x80 | 32  # wait for acknowledgements of this many bytes
_TIMEOUT_MS: Final = 100
_NULL: Final = NULL_PACKET.encode()
_STOPS: Final = frozenset(
    EmergencyStopMessage().encode(version).encode() for version in (OLDEST_PROTOCOL, NEWEST_PROTOCOL)
)


class Dongle(Protocol):
    """A Crazyradio. Raises ``OSError`` when it is gone."""

    def configure(self, address: RadioAddress) -> None:
        """Send to this vehicle from now on."""

    def exchange(self, packet: bytes) -> bytes | None:
        """Send a packet; return the acknowledgement's content, None if there is no acknowledgement."""

    def close(self) -> None: ...


def require_usb() -> None:
    """Raise :class:`MissingExtraError` unless pyusb is installed."""
    try:
        import usb.core  # noqa: F401
    except ImportError as error:
        raise MissingExtraError("a Crazyradio", "crazyflie", cause=str(error)) from error


class UsbDongle:
    """A Crazyradio opened through pyusb."""

    def __init__(self, number: int) -> None:
        """Open the Crazyradio of this number, from 0. Raises ``OSError`` if there is none or it can't be used."""
        import usb.core
        import usb.util

        try:
            found = list(usb.core.find(idVendor=VENDOR, idProduct=PRODUCT, find_all=True))
        except usb.core.NoBackendError:
            raise OSError(errno.ENOSYS, "libusb is not installed: install the system's package libusb-1.0") from None
        if number >= len(found):
            raise OSError(errno.ENODEV, f"there is no Crazyradio {number}: {len(found)} are plugged in")
        self._device: Any = found[number]
        self._usb_util = usb.util
        self._address: RadioAddress | None = None
        try:
            self._device.set_configuration()
            self._request(_POWER, _FULL_POWER)
            self._request(_RETRIES, 3)
            self._request(_ACK_DELAY, _ACK_BYTES)
        except OSError as error:
            self.close()
            if error.errno == errno.EACCES:
                raise OSError(errno.EACCES, "this user may not use the Crazyradio: add Bitcraze's udev rule") from None
            raise

    def configure(self, address: RadioAddress) -> None:
        before, self._address = self._address, address
        if before is None or before.channel != address.channel:
            self._request(_CHANNEL, address.channel)
        if before is None or before.rate != address.rate:
            self._request(_RATE, _RATES[address.rate])
        if before is None or before.address != address.address:
            self._device.ctrl_transfer(_TO_DEVICE, _ADDRESS, 0, 0, address.address, _TIMEOUT_MS)

    def exchange(self, packet: bytes) -> bytes | None:
        self._device.write(0x01, packet, _TIMEOUT_MS)
        answer = bytes(self._device.read(0x81, 64, _TIMEOUT_MS))
        return answer[1:] if answer and answer[0] & 1 else None

    def close(self) -> None:
        with suppress(OSError):
            self._usb_util.dispose_resources(self._device)

    def _request(self, request: int, value: int) -> None:
        self._device.ctrl_transfer(_TO_DEVICE, request, value, 0, b"", _TIMEOUT_MS)


@dataclass(slots=True, eq=False)
class RadioVehicle:
    """One vehicle of a radio: its packets, and the state of its safe link. For the radio's thread only."""

    address: RadioAddress
    port: socket.socket  #: connected to the vehicle's link
    waiting: deque[tuple[bytes, int]] = field(default_factory=deque)  #: packets, and when each was taken over
    safe: bool | None = None  #: whether it has the safe link; None: not known yet
    tries: int = 0
    up: int = 0  #: number of the next packet to it, 0 or 1
    down: int = 0  #: number of the next packet from it
    due_ns: int = 0

    def collect(self, now_ns: int) -> None:
        """Take over what the link has sent, and drop what could not be sent in time.

        A take-off or a set-point from before an interruption must not be obeyed after it.
        """
        with suppress(OSError):
            while len(self.waiting) < MOST_WAITING:
                packet = self.port.recv(1 + MAX_DATA)
                if packet in _STOPS:  # nothing goes first
                    self.waiting = deque(waits for waits in self.waiting if waits[0] in _STOPS)
                self.waiting.append((packet, now_ns))
        while self.waiting and now_ns - self.waiting[0][1] > STALE_NS:
            self.waiting.popleft()

    def take_turn(self, dongle: Dongle, now_ns: int) -> None:
        """Exchange one packet with the vehicle."""
        if self.waiting and self.waiting[0][0] in _STOPS and (self.safe is None or self.tries):
            self._stop(dongle, self.waiting[0][0])
        if self.safe is None:
            self._begin(dongle, now_ns)
            return
        packet = self.waiting[0][0] if self.waiting else _NULL
        if self.safe:
            packet = bytes((packet[0] & 0xF3 | self.up << 3 | self.down << 2,)) + packet[1:]
        answer = dongle.exchange(packet)
        if answer is None:
            self.tries += 1
            self.due_ns = now_ns + (ABSENT_NS if self.tries > 10 else 0)
            if self.tries > 50:  # it may have restarted, and know nothing of the safe link
                self.safe, self.tries = None, 0
            return
        self.tries = 0
        if self.waiting:
            self.waiting.popleft()
        fresh = True
        if self.safe:
            self.up ^= 1
            fresh = bool(answer) and (answer[0] >> 2 & 1) == self.down
            self.down ^= fresh
        carries = fresh and len(answer) > 0 and not CrtpPacket(answer[0] >> 4, answer[0] & 3).is_null
        if carries:
            with suppress(OSError):
                self.port.send(answer[: 1 + MAX_DATA])
        self.due_ns = now_ns if carries or self.waiting else now_ns + IDLE_NS

    def _stop(self, dongle: Dongle, packet: bytes) -> None:
        """Send an emergency stop to a vehicle that is not heard but may hear, whatever packet it expects next."""
        for self.up in (1, 0):
            dongle.exchange(bytes((packet[0] & 0xF3 | self.up << 3 | self.down << 2,)) + packet[1:])

    def _begin(self, dongle: Dongle, now_ns: int) -> None:
        answer = dongle.exchange(SAFE_LINK)
        if answer is None:
            self.due_ns = now_ns + ABSENT_NS
            return
        self.tries += 1
        if answer[: len(SAFE_LINK)] == SAFE_LINK:
            self.safe, self.up, self.down, self.tries = True, 0, 0, 0
        elif self.tries >= SAFE_LINK_TRIES:
            self.safe, self.tries = False, 0


class Radio:
    """One Crazyradio and the thread that serves its vehicles in turns, as long as there are any."""

    def __init__(self, number: int, dongle: Dongle) -> None:
        self.number = number
        self.error: OSError | None = None  #: why the radio has ended
        self._dongle = dongle
        self._vehicles: list[RadioVehicle] = []
        self._lock = threading.Lock()
        self._wake = threading.Event()
        self._thread = threading.Thread(target=self._run, name=f"skyloop-radio{number}", daemon=True)

    def add(self, vehicle: RadioVehicle) -> None:
        with self._lock:
            self._vehicles.append(vehicle)
        if not self._thread.is_alive() and self.error is None:
            self._thread.start()
        self._wake.set()

    def remove(self, vehicle: RadioVehicle) -> bool:
        """Remove a vehicle; return whether it was the last, and the radio ends."""
        with self._lock:
            self._vehicles.remove(vehicle)
            last = not self._vehicles
        self._wake.set()
        if last and self._thread is not threading.current_thread():
            self._thread.join(1.0)
        vehicle.port.close()
        return last

    def _run(self) -> None:
        try:
            while True:
                with self._lock:
                    vehicles = list(self._vehicles)
                if not vehicles:
                    break
                self._serve(vehicles)
        except OSError as error:
            self.error = error
        finally:
            self._dongle.close()

    def _serve(self, vehicles: list[RadioVehicle]) -> None:
        """Give each vehicle that is due one turn; wait if there is none."""
        now_ns = monotonic_ns()
        served = False
        for vehicle in vehicles:
            vehicle.collect(now_ns)
            if now_ns >= vehicle.due_ns or (vehicle.waiting and vehicle.safe is not None and vehicle.tries == 0):
                self._dongle.configure(vehicle.address)
                vehicle.take_turn(self._dongle, monotonic_ns())
                served = True
        if not served:
            soonest_s = seconds(min(vehicle.due_ns for vehicle in vehicles) - monotonic_ns())
            self._wake.wait(max(0.0, min(LONGEST_WAIT_S, soonest_s)))
            self._wake.clear()


_radios: dict[int, Radio] = {}
_lock = threading.Lock()


@dataclass(frozen=True, slots=True)
class RadioLease:
    """A vehicle's place at a radio, and the socket to talk to it, as over UDP."""

    radio: Radio
    vehicle: RadioVehicle
    socket: socket.socket

    def close(self) -> None:
        with _lock:
            if self.radio.remove(self.vehicle) and _radios.get(self.radio.number) is self.radio:
                del _radios[self.radio.number]


def lease(address: RadioAddress, open_dongle: Callable[[int], Dongle] | None = None) -> RadioLease:
    """Open a radio, or share an open one. Raises ``OSError`` if it can't be used.

    ``open_dongle`` opens the Crazyradio of a number; by default, through USB.
    """
    ours, theirs = _pair()
    vehicle = RadioVehicle(address, theirs)
    try:
        with _lock:
            radio = _radios.get(address.dongle)
            if radio is None or radio.error is not None:
                radio = _radios[address.dongle] = Radio(address.dongle, (open_dongle or UsbDongle)(address.dongle))
            radio.add(vehicle)
    except OSError:
        ours.close()
        theirs.close()
        raise
    return RadioLease(radio, vehicle, ours)


def _pair() -> tuple[socket.socket, socket.socket]:
    """Return two UDP sockets on this host, connected to one another."""
    ends = [socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(2)]
    for end in ends:
        end.setblocking(False)
        end.bind(("127.0.0.1", 0))
    for end, other in (ends, ends[::-1]):
        end.connect(other.getsockname())
    return ends[0], ends[1]
