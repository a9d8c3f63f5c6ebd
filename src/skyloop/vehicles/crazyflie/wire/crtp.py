"""CRTP packets: a header byte with port and channel, then up to 31 bytes of data. Pure.

Bitcraze describes the protocol at https://www.bitcraze.io/documentation/repository/crazyflie-firmware/master/functional-areas/crtp/.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from typing import Final

from skyloop.errors import DecodeError

UDP_PORT: Final = 19850  #: of the first simulated vehicle, real firmware or emulated; programs look for them there
ESP_PORT: Final = 2390  #: UDP port of ESP-Drone and LiteWing
MAX_DATA: Final = 31  #: largest number of bytes after the header
#: Largest number of bytes in a packet of ours: older firmware has room for no more.
MAX_SENT_DATA: Final = 30
_LINK_BITS: Final = 0x0C  # reserved for the link, and set by everybody; a radio's safe link counts packets with them

OLDEST_PROTOCOL: Final = 7  #: protocol version of the oldest firmware that the driver was tried on
NEWEST_PROTOCOL: Final = 12  #: newest known protocol version


class CrtpPort(IntEnum):
    """The part of the firmware that a packet is for, or from."""

    CONSOLE = 0
    PARAMETERS = 2
    COMMANDER = 3
    MEMORY = 4
    LOG = 5
    LOCALISATION = 6
    SETPOINT = 7
    HIGH_LEVEL = 8
    SUPERVISOR = 9  #: since protocol 12
    PLATFORM = 13
    LINK = 15


# Channels of a port.
CONTENTS, READ, WRITE, MISCELLANEOUS = 0, 1, 2, 3  #: of PARAMETERS; CONTENTS is LOG's too
CONTROL, DATA = 1, 2  #: of LOG
MEMORY_INFO, MEMORY_READ, MEMORY_WRITE = 0, 1, 2  #: of MEMORY
POSITION, GENERIC = 0, 1  #: of LOCALISATION
SET, META = 0, 1  #: of SETPOINT
INFO, COMMAND = 0, 1  #: of SUPERVISOR
PLATFORM_COMMAND, VERSION, APP = 0, 1, 2  #: of PLATFORM
ECHO, SOURCE, SINK, NULL = 0, 1, 2, 3  #: of LINK

SOURCE_TEXT: Final = b"Bitcraze Crazyflie"  #: start of the answer on LINK's channel SOURCE


@dataclass(frozen=True, slots=True)
class CrtpPacket:
    """One packet. ``channel`` is 0 to 3."""

    port: int
    channel: int
    data: bytes = b""

    @property
    def is_null(self) -> bool:
        """Whether the packet carries nothing: radios poll with it, and it opens and closes a UDP connection."""
        return self.port == CrtpPort.LINK and self.channel == NULL

    def encode(self) -> bytes:
        """Return the packet as bytes. Raises ``ValueError`` if it is too long."""
        if len(self.data) > MAX_DATA:
            raise ValueError(f"a CRTP packet holds {MAX_DATA} bytes, not {len(self.data)}")
        return bytes((self.port << 4 | _LINK_BITS | self.channel,)) + self.data

    @classmethod
    def decode(cls, packet: bytes) -> CrtpPacket:
        """Read a packet. Raises :class:`DecodeError` if it is empty or too long."""
        if not 1 <= len(packet) <= 1 + MAX_DATA:
            raise DecodeError(f"a CRTP packet has 1 to {1 + MAX_DATA} bytes, not {len(packet)}")
        return cls(packet[0] >> 4, packet[0] & 3, packet[1:])


#: What the firmware for simulation sends to whoever it listens to, and expects before anything else.
HELLO: Final = b"\xf3"
NULL_PACKET: Final = CrtpPacket(CrtpPort.LINK, NULL)
#: For a vehicle's radio, which switches the rest of the vehicle off and on.
POWER_OFF: Final = CrtpPacket(CrtpPort.LINK, NULL, b"\xfe\x02")
POWER_ON: Final = CrtpPacket(CrtpPort.LINK, NULL, b"\xfe\x03")


def with_checksum(packet: bytes) -> bytes:
    """Append the byte that ESP-Drone and LiteWing expect after a packet: the sum of the others."""
    return packet + bytes((sum(packet) & 0xFF,))


def without_checksum(packet: bytes) -> bytes:
    """Check and remove the last byte. Raises :class:`DecodeError` if it isn't the sum of the others."""
    if len(packet) < 2 or sum(packet[:-1]) & 0xFF != packet[-1]:
        raise DecodeError("the packet's checksum is wrong")
    return packet[:-1]
