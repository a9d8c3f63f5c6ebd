"""Commands as the Tello takes them: one text, in ASCII, in a datagram to its port 8889."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import Final

PORT: Final = 8889  #: where the Tello takes commands; it answers to where a command came from
STATE_PORT: Final = 8890  #: of the client, where state comes
VIDEO_PORT: Final = 11111  #: of the client, where video comes
HOST: Final = "192.168.10.1"  #: of a Tello that is its own access point
SILENCE_S: Final = 15.0  #: without a command for so long the Tello lands by itself

ENTER: Final = "command"  #: nothing works before it
MAX_STICK: Final = 100
#: What a stick of 100 comes to. Estimates: no guide says it, and people take ``rc`` for cm/s and degrees a second.
FULL_SPEED_M_S: Final = 1.0
FULL_CLIMB_M_S: Final = 1.0
FULL_YAW_RATE_RAD_S: Final = 1.75
LONGEST: Final = 256  #: no command and no reply of the SDK is nearly as long


class Sdk(StrEnum):
    """Versions of the protocol. Each knows what those before it know."""

    V1_3 = "1.3"
    V2_0 = "2.0"
    V3_0 = "3.0"

    def knows(self, other: Sdk) -> bool:
        """Whether it is this one or newer."""
        return self.value >= other.value


@dataclass(frozen=True, slots=True)
class Stick:
    """``rc``: each from -100 to 100. Positive is right, forward, up, and clockwise seen from above."""

    right: int = 0
    forward: int = 0
    up: int = 0
    clockwise: int = 0

    @property
    def text(self) -> str:
        return f"rc {self.right} {self.forward} {self.up} {self.clockwise}"


LEVEL: Final = Stick()


def ports(state: int, video: int) -> str:
    """SDK 3.0: where state and video are to be sent."""
    return f"port {state} {video}"


def decoded(datagram: bytes) -> str | None:
    """The text of a datagram without what surrounds it; None for what is no text of this protocol."""
    if len(datagram) > LONGEST:
        return None
    try:
        text = datagram.decode("ascii").strip("\r\n\0 ")
    except UnicodeDecodeError:
        return None
    return text if text.isprintable() else None
