"""CPX, the Crazyflie Packet eXchange, on a TCP connection: bytes in, packets out, and the reverse. Pure.

The AI-deck's Wi-Fi chip listens on TCP port 5000 and routes packets between the host and the vehicle's processors. A
packet is a length (16 bits, little-endian), the route, the function, and data. Layout and numbers come from Bitcraze's
page "CPX - Crazyflie Packet eXchange" and its public examples for the AI-deck, which disagree about the length: the
older firmware (``wifi-img-streamer``) counts route and function, the newer one (``nanocockpit``) counts only the data.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from enum import IntEnum
from typing import Final

from skyloop.errors import DecodeError, UsageError

PORT: Final = 5000  #: TCP port of the AI-deck
MOST_DATA: Final = 1020  #: largest amount of data in a packet from the older firmware [bytes]
MOST_DATA_NEWER: Final = 4088  #: largest amount of data in a packet from the newer firmware [bytes]
_HEADER: Final = struct.Struct("<HBB")  # length; route; function and version
_LAST: Final = 1 << 6
_THREE_BITS: Final = 0b111
_FUNCTION_BITS: Final = 6


class Target(IntEnum):
    """A processor that packets come from or go to."""

    STM32 = 1  #: the flight controller
    ESP32 = 2  #: the deck's Wi-Fi chip
    HOST = 3  #: this computer
    GAP8 = 4  #: the deck's camera processor


class Function(IntEnum):
    """The purpose of a packet. Applications may use other numbers below 64."""

    SYSTEM = 1
    CONSOLE = 2
    CRTP = 3
    WIFI_CONTROL = 4
    APP = 5  #: images from the older firmware
    STREAMER = 6  #: images from the newer firmware
    TEST = 14
    BOOTLOADER = 15


class Counting(IntEnum):
    """What the length of a packet counts; the value is the number of header bytes in it."""

    DATA = 0  #: only the data
    ROUTE_AND_DATA = 2  #: route, function and data


@dataclass(frozen=True, slots=True)
class Packet:
    """One packet."""

    source: Target
    destination: Target
    function: int  #: one of :class:`Function`, or another number
    data: bytes
    last: bool = True  #: False if the packet is continued by the next one


def encode(packet: Packet, counting: Counting = Counting.ROUTE_AND_DATA) -> bytes:
    """Return a packet as sent. Raises :class:`UsageError` if a number or the amount of data is out of range."""
    if not 0 <= packet.function < 1 << _FUNCTION_BITS:
        raise UsageError(f"function is {packet.function} and must be from 0 to {(1 << _FUNCTION_BITS) - 1}")
    if len(packet.data) > MOST_DATA_NEWER:
        raise UsageError(f"a CPX packet holds at most {MOST_DATA_NEWER} bytes, got {len(packet.data)}")
    route = packet.destination | packet.source << 3 | (_LAST if packet.last else 0)
    return _HEADER.pack(len(packet.data) + counting, route, packet.function) + packet.data


class PacketParser:
    """Splits the bytes of one connection into packets. It keeps at most one incomplete packet.

    ``counting`` says what lengths count. If it is None, the first packet decides: only the newer firmware has the
    function ``STREAMER``.
    """

    def __init__(self, counting: Counting | None = None) -> None:
        self.counting = counting
        self._buffer = bytearray()

    def feed(self, data: bytes) -> list[Packet]:
        """Return the packets that these bytes complete.

        Raises :class:`DecodeError` for an impossible length or route. As the start of the next packet is then unknown,
        the connection is of no further use.
        """
        buffer = self._buffer
        buffer += data
        packets: list[Packet] = []
        start = 0
        while len(buffer) - start >= _HEADER.size:
            length, route, function = _HEADER.unpack_from(buffer, start)
            if self.counting is None:
                newer = function == Function.STREAMER
                self.counting = Counting.DATA if newer else Counting.ROUTE_AND_DATA
            size = length - self.counting
            begin = start + _HEADER.size
            source, destination = _endpoints(route, function)
            if not 0 <= size <= MOST_DATA_NEWER:
                raise DecodeError(f"a CPX packet announces a length of {length} bytes")
            if len(buffer) < begin + size:
                break
            start = begin + size
            packets.append(Packet(source, destination, function, bytes(buffer[begin:start]), bool(route & _LAST)))
        del buffer[:start]
        return packets


def _endpoints(route: int, function: int) -> tuple[Target, Target]:
    try:
        source, destination = Target(route >> 3 & _THREE_BITS), Target(route & _THREE_BITS)
    except ValueError:
        raise DecodeError(f"a CPX packet has the unknown route 0x{route:02x}") from None
    if function >> _FUNCTION_BITS:
        raise DecodeError(f"a CPX packet has version {function >> _FUNCTION_BITS}; only version 0 is known")
    return source, destination


# Requests to the deck ------------------------------------------------------------------------------------------------

_RESET_GAP8: Final = 0x10
_START_GAP8: Final = 0x06


def restart_camera() -> tuple[Packet, Packet]:
    """Return the packets that reset the camera processor and make its bootloader start its program again."""
    return (
        Packet(Target.HOST, Target.ESP32, Function.SYSTEM, bytes([_RESET_GAP8])),
        Packet(Target.HOST, Target.GAP8, Function.BOOTLOADER, bytes([_START_GAP8])),
    )
