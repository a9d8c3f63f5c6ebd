"""The AR.Drone's navdata (UDP port 5554): encode and decode datagrams of a header, options and a checksum. Pure.

Little-endian: ``u32 0x55667788, u32 state, u32 sequence, u32 vision defined``, then options, each with ``u16 tag,
u16 size`` (which includes these four bytes) and data. The last option is the checksum, the sum of all bytes before it.
Source: ``navdata_common.h`` in the AR.Drone SDK 2.0.1; sizes were checked against a datagram from a real AR.Drone 2.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable
from dataclasses import dataclass
from enum import IntEnum, IntFlag
from typing import Any, Final, TypeVar, cast

from skyloop.errors import DecodeError
from skyloop.vehicles.ardrone.wire import at, configuration
from skyloop.vehicles.ardrone.wire.options import BY_TAG_AND_SIZE, LAYOUTS, Option

PORT: Final = 5554
SIGNATURE: Final = 0x55667788
MAX_DATAGRAM: Final = 4096
FIRST_SEQUENCE: Final = 1

_HEADER: Final = struct.Struct("<4I")
_OPTION: Final = struct.Struct("<HH")
_CHECKSUM: Final = struct.Struct("<HHI")
_CHECKSUM_TAG: Final = 0xFFFF
_Kind = TypeVar("_Kind", bound=tuple[Any, ...])


class State(IntFlag):
    """The drone's state bits, which are part of every datagram."""

    FLYING = 1 << 0
    VIDEO = 1 << 1
    VISION = 1 << 2
    ANGULAR_SPEED_CONTROL = 1 << 3
    ALTITUDE_CONTROL = 1 << 4
    START_BUTTON = 1 << 5
    COMMAND_ACK = 1 << 6
    CAMERA_READY = 1 << 7
    TRAVELLING = 1 << 8
    USB_KEY = 1 << 9
    DEMO = 1 << 10  #: sends only the demo mode's options, 15 times per second
    BOOTSTRAP = 1 << 11  #: sends no options until the mode is configured
    MOTORS_PROBLEM = 1 << 12
    COMMUNICATION_LOST = 1 << 13
    SOFTWARE_FAULT = 1 << 14
    BATTERY_LOW = 1 << 15
    USER_EMERGENCY = 1 << 16
    TIMER_ELAPSED = 1 << 17
    MAGNETOMETER_UNCALIBRATED = 1 << 18
    ANGLES_OUT_OF_RANGE = 1 << 19
    WIND = 1 << 20
    ULTRASOUND_DEAF = 1 << 21
    CUTOUT = 1 << 22
    PIC_VERSION_OK = 1 << 23
    AT_THREAD = 1 << 24
    NAVDATA_THREAD = 1 << 25
    VIDEO_THREAD = 1 << 26
    ACQUISITION_THREAD = 1 << 27
    CONTROL_WATCHDOG = 1 << 28
    ADC_WATCHDOG = 1 << 29
    COMMUNICATION_WATCHDOG = 1 << 30
    EMERGENCY = 1 << 31


class ControlState(IntEnum):
    """Values of the upper half of :attr:`Demo.ctrl_state`."""

    DEFAULT = 0
    INIT = 1
    LANDED = 2
    FLYING = 3
    HOVERING = 4
    TEST = 5
    TAKING_OFF = 6
    GOING_TO_FIX = 7
    LANDING = 8
    LOOPING = 9


@dataclass(frozen=True, slots=True)
class Navdata:
    """One datagram."""

    state: State
    sequence: int
    vision_defined: int
    options: dict[type[Option], Option]  #: options by type
    unknown: tuple[tuple[int, int], ...]  #: tag and size of unknown options

    def get(self, kind: type[_Kind]) -> _Kind | None:
        """Return the option of this type; None if the datagram has none."""
        return cast("_Kind | None", cast("dict[Any, Any]", self.options).get(kind))


def decode(datagram: bytes | memoryview) -> Navdata:
    """Decode a datagram; raise :class:`DecodeError` if it is damaged. Unknown options are listed but not decoded."""
    end = len(datagram) - _CHECKSUM.size
    if not _HEADER.size <= end <= MAX_DATAGRAM - _CHECKSUM.size:
        raise DecodeError(f"{len(datagram)} bytes are not navdata")
    signature, state, sequence, vision_defined = _HEADER.unpack_from(datagram)
    if signature != SIGNATURE:
        raise DecodeError(f"navdata begins with {SIGNATURE:#x}, not with {signature:#x}")
    tag, size, checksum = _CHECKSUM.unpack_from(datagram, end)
    if tag != _CHECKSUM_TAG or size != _CHECKSUM.size:
        raise DecodeError("navdata that does not end with a checksum")
    if checksum != sum(datagram[:end]):
        raise DecodeError(f"navdata {sequence} is damaged: its checksum is wrong")
    options, unknown = _decode_options(datagram, end)
    return Navdata(State(state), sequence, vision_defined, options, tuple(unknown))


def encode(state: int, sequence: int, options: Iterable[Option] = (), vision_defined: int = 0) -> bytes:
    """Return a datagram with these options in this order; raise :class:`struct.error` if a number is out of range."""
    parts = [_HEADER.pack(SIGNATURE, state, sequence, vision_defined)]
    for option in options:
        layout = LAYOUTS[type(option)]
        parts += (_OPTION.pack(layout.tag, layout.size + _OPTION.size), layout.pack(option))
    body = b"".join(parts)
    return body + _CHECKSUM.pack(_CHECKSUM_TAG, _CHECKSUM.size, sum(body) & 0xFFFFFFFF)


def _decode_options(datagram: bytes | memoryview, end: int) -> tuple[dict[type[Option], Option], list[tuple[int, int]]]:
    options: dict[type[Option], Option] = {}
    unknown: list[tuple[int, int]] = []
    at = _HEADER.size
    while at < end:
        if at + _OPTION.size > end:
            raise DecodeError("navdata with bytes that belong to no option")
        tag, size = _OPTION.unpack_from(datagram, at)
        if size < _OPTION.size or at + size > end:
            raise DecodeError(f"navdata option {tag} of {size} bytes does not fit in its datagram")
        layout = BY_TAG_AND_SIZE.get((tag, size - _OPTION.size))
        if layout is None:
            unknown.append((tag, size))
        else:
            options[layout.kind] = layout.unpack(datagram, at + _OPTION.size)
        at += size
    return options, unknown


VIDEO: Final = 5555


@dataclass(frozen=True, slots=True)
class Ports:
    """The drone's ports; where a port can be chosen, 0 means any free one."""

    navdata: int = PORT  #: UDP
    video: int = VIDEO  #: UDP on an AR.Drone 1, TCP on an AR.Drone 2
    at: int = at.PORT  #: UDP
    control: int = configuration.PORT  #: TCP

    @classmethod
    def free(cls) -> Ports:
        """Return ports that are all 0, for any free ones."""
        return cls(0, 0, 0, 0)


STANDARD: Final = Ports()
