"""The AI-deck's images in CPX packets: packets in, images out, and the reverse. Pure.

The layouts come from Bitcraze's public examples for the AI-deck. ``wifi-img-streamer`` announces each image in a
separate packet, and continues with as many packets of data as it takes. ``nanocockpit`` (its messages are version 10)
sends the vehicle's state ahead of the pixels, in one buffer with an optional checksum.
"""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass
from enum import IntEnum
from typing import Final

from skyloop.vehicles.crazyflie.wire.commander import compressed, decompressed
from skyloop.vehicles.crazyflie.wire.cpx import MOST_DATA, MOST_DATA_NEWER, Function, Packet, Target

MOST_SIDE: Final = 1024  #: longest plausible side of an image [px]; the sensor has 324 × 324 pixels
MOST_BYTES: Final = 1 << 20  #: largest plausible image [bytes]

_MAGIC: Final = 0xBC
_ANNOUNCEMENT: Final = struct.Struct("<BHHBBI")  # magic, width, height, bytes per pixel, format, size

_BEGIN_COMMAND, _DATA_COMMAND = 0x10, 0x11
_BEGIN: Final = struct.Struct("<BBII2x")  # command, type, size, checksum
_DATA: Final = struct.Struct("<B3x")  # command
_IMAGE: Final = 1  # type of a buffer
VERSION: Final = 10  #: version of the newer firmware's messages
_BEFORE_STATE: Final = struct.Struct("<BHHBBBII")  # version, width, height, bytes per pixel, format, number, two times
_STATE: Final = struct.Struct("<I9hI3h")  # vehicle's time, position, velocity, acceleration, attitude, turn rates
_METADATA: Final = 148  # size of everything ahead of the pixels [bytes]
_MILLI: Final = 1000.0


class Format(IntEnum):
    """How an image is encoded."""

    RAW = 0  #: one byte per pixel: grey, or a Bayer mosaic from a colour sensor
    JPEG = 1


@dataclass(frozen=True, slots=True)
class DeckState:
    """The vehicle's state as the deck heard it before it sent an image, in world axes.

    Bitcraze's example for the Crazyflie fills in the position only; the rest is then None.
    """

    heard_us: int  #: when the deck heard it, on the deck's clock in 32 bits
    position_m: tuple[float, float, float]
    velocity_m_s: tuple[float, float, float] | None = None
    quaternion: tuple[float, float, float, float] | None = None  #: attitude as x, y, z, w


@dataclass(frozen=True, slots=True)
class Picture:
    """One image as the deck sent it."""

    width: int  #: width [px]
    height: int
    format: int  #: one of :class:`Format`, or another number
    data: bytes
    number: int  #: count of images; the newer firmware's has 8 bits
    stamp_us: int | None = None  #: end of the exposure on the deck's clock in 32 bits; None from the older firmware
    state: DeckState | None = None  #: the vehicle's state; None if the deck has not heard any
    version: int = VERSION  #: version of the message; if it is another, nothing else is known


class PictureAssembly:
    """Assembles the images of one connection from its packets. Packets with other functions are ignored.

    ``begun`` counts the images that have begun, ``broken`` those that were incomplete, damaged or announced with
    impossible numbers, and ``stray`` the bytes outside of any image.
    """

    def __init__(self) -> None:
        self.begun = 0
        self.broken = 0
        self.stray = 0
        self._announced: tuple[int, int, int] | None = None  # size of the older firmware's image, and its format
        self._data: bytearray | None = None  # the part of the current image that has arrived; None between images
        self._size = 0
        self._checksum = 0
        self._number = 0

    def feed(self, packet: Packet) -> Picture | None:
        """Return the image that this packet completes, if any. Never raises, regardless of content."""
        if packet.function == Function.APP:
            return self._feed_older(packet.data)
        if packet.function == Function.STREAMER:
            return self._feed_newer(packet.data)
        return None

    def _feed_older(self, data: bytes) -> Picture | None:
        announced = _announcement(data)
        # Eleven bytes of an image may look like an announcement only if they complete it.
        if announced is not None and not (self._data is not None and len(self._data) + len(data) == self._size):
            self.begun += 1
            self.broken += self._data is not None
            width, height, form, size = announced
            if 0 < width <= MOST_SIDE and 0 < height <= MOST_SIDE and _fits(width, height, form, size):
                self._announced = width, height, form
                self._data, self._size, self._checksum = bytearray(), size, 0
            else:
                self.broken += 1
                self._data = None
            return None
        whole = self._add(data)
        if whole is None or self._announced is None:
            return None
        self._number += 1
        return Picture(*self._announced, whole, self._number)

    def _feed_newer(self, data: bytes) -> Picture | None:
        if len(data) >= _BEGIN.size and data[0] == _BEGIN_COMMAND:
            self.begun += 1
            self.broken += self._data is not None
            _, kind, size, checksum = _BEGIN.unpack_from(data)
            if kind != _IMAGE or not _METADATA <= size <= MOST_BYTES:
                self.broken += kind == _IMAGE
                self._data = None
                return None
            self._announced, self._data, self._size, self._checksum = None, bytearray(), size, checksum
            rest = data[_BEGIN.size :]
        elif len(data) >= _DATA.size and data[0] == _DATA_COMMAND:
            rest = data[_DATA.size :]
        else:
            self.stray += len(data)
            return None
        if self._data is not None:
            rest = rest[: self._size - len(self._data)]  # the last packet is padded to a multiple of four bytes
        whole = self._add(rest)
        if whole is None:
            return None
        if self._checksum not in (0, zlib.crc32(whole) or 0xFFFFFFFF):  # 0: the deck computed none
            self.broken += 1
            return None
        picture = _picture(whole)
        self.broken += picture is None
        return picture

    def _add(self, data: bytes) -> bytes | None:
        """Add data to the current image; return the image once it is complete."""
        if self._data is None:
            self.stray += len(data)
            return None
        self._data += data
        if len(self._data) < self._size:
            return None
        whole, self._data = self._data, None
        if len(whole) > self._size:
            self.broken += 1
            return None
        return bytes(whole)


def _announcement(data: bytes) -> tuple[int, int, int, int] | None:
    """Return width, height, format and size announced by a packet; None if it is no announcement."""
    if len(data) != _ANNOUNCEMENT.size or data[0] != _MAGIC:
        return None
    _, width, height, depth, form, size = _ANNOUNCEMENT.unpack(data)
    return (width, height, form, size) if depth == 1 else None


def _fits(width: int, height: int, form: int, size: int) -> bool:
    return size == width * height if form == Format.RAW else 0 < size <= MOST_BYTES


def _picture(buffer: bytes) -> Picture | None:
    """Return the image in a buffer of the newer firmware; None if its size is wrong."""
    version, width, height, depth, form, number, stamp_us, heard_us = _BEFORE_STATE.unpack_from(buffer)
    if version != VERSION:
        return Picture(0, 0, form, b"", number, version=version)
    pixels = buffer[_METADATA:]
    if depth != 1 or not (0 < width <= MOST_SIDE and 0 < height <= MOST_SIDE) or len(pixels) != width * height:
        return None
    state = _state(_STATE.unpack_from(buffer, _BEFORE_STATE.size), heard_us) if heard_us else None
    return Picture(width, height, form, pixels, number, stamp_us, state)


def _state(fields: tuple[int, ...], heard_us: int) -> DeckState:
    x, y, z, vx, vy, vz = (value / _MILLI for value in fields[1:7])
    attitude = fields[10]
    if not attitude:  # a sender that leaves it out leaves out, or invents, everything but the position
        return DeckState(heard_us, (x, y, z))
    return DeckState(heard_us, (x, y, z), (vx, vy, vz), decompressed(attitude))


# As the deck sends them ----------------------------------------------------------------------------------------------


def older_packets(picture: Picture) -> list[Packet]:
    """Return the packets of an image as ``wifi-img-streamer`` sends them."""
    size = len(picture.data)
    header = _ANNOUNCEMENT.pack(_MAGIC, picture.width, picture.height, 1, picture.format, size)
    parts = [header, *(picture.data[at : at + MOST_DATA] for at in range(0, size, MOST_DATA))]
    if size % MOST_DATA == 0:
        parts.append(b"")
    return [Packet(Target.GAP8, Target.HOST, Function.APP, part) for part in parts]


def newer_packets(picture: Picture, *, checksum: bool = False) -> list[Packet]:
    """Return the packets of an image as ``nanocockpit`` sends them."""
    state = picture.state
    before = _BEFORE_STATE.pack(
        picture.version,
        picture.width,
        picture.height,
        1,
        picture.format,
        picture.number & 0xFF,
        picture.stamp_us or 0,
        state.heard_us if state else 0,
    )
    buffer = (before + _packed_state(state)).ljust(_METADATA, b"\0") + picture.data
    crc = (zlib.crc32(buffer) or 0xFFFFFFFF) if checksum else 0
    head = _BEGIN.pack(_BEGIN_COMMAND, _IMAGE, len(buffer), crc)
    parts: list[bytes] = []
    at = 0
    while at < len(buffer):
        part = buffer[at : at + MOST_DATA_NEWER - len(head)]
        at += len(part)
        parts.append(head + part)
        head = _DATA.pack(_DATA_COMMAND)
    parts[-1] += bytes(-(len(parts[-1])) % 4)
    return [Packet(Target.GAP8, Target.HOST, Function.STREAMER, part) for part in parts]


def _packed_state(state: DeckState | None) -> bytes:
    if state is None:
        return bytes(_STATE.size)
    vectors = *state.position_m, *(state.velocity_m_s or (0.0, 0.0, 0.0))
    numbers = [max(-32768, min(32767, round(value * _MILLI))) for value in vectors]
    attitude = compressed(state.quaternion) if state.quaternion else 0
    return _STATE.pack(state.heard_us, *numbers, 0, 0, 0, attitude, 0, 0, 0)
