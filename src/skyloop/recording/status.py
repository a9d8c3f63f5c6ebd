"""What a recorder tells of itself, and how it judges the room that is left. Pure."""

from __future__ import annotations

from enum import StrEnum
from typing import Final

import msgspec

from skyloop.messages import Severity


class RecorderState(StrEnum):
    STARTING = "starting"
    RECORDING = "recording"
    PAUSED = "paused"  #: it can't write now, keeps what must not be lost, and tries again each second
    CLOSED = "closed"  #: ended on purpose, the file is complete
    FAILED = "failed"  #: its process was killed; what it had written is in the file


class Status(msgspec.Struct, frozen=True):
    """A recording at one time."""

    state: RecorderState = RecorderState.STARTING
    reason: str = ""  #: why it is paused or has failed
    path: str = ""  #: the file being written, or written last
    files: tuple[str, ...] = ()  #: all of them, oldest first
    seconds: float = 0.0  #: since it started
    bytes: int = 0  #: in all files
    messages: int = 0
    waiting: int = 0  #: bytes received and not written yet
    dropped: dict[str, dict[str, int]] = {}  #: by drone and channel: received, and left out
    missed: dict[str, dict[str, int]] = {}  #: by drone and channel: never received


class News(msgspec.Struct, frozen=True):
    """Something that people and applications should know of a recording."""

    text: str
    severity: Severity = Severity.INFO


class Room(StrEnum):
    """What is still written when the disk fills up."""

    ALL = "all"
    NO_FRAMES = "no frames"
    NOTHING = "nothing"


_MARGIN: Final = 1.25  #: of the floor must be free again before more is written


def judge_room(free: int, floor: int, before: Room) -> Room:
    """All above the floor, no frames below it, nothing below a quarter of it; in bytes."""
    margin = _MARGIN if before is not Room.ALL else 1.0
    if free >= floor * margin:
        return Room.ALL
    margin = _MARGIN if before is Room.NOTHING else 1.0
    return Room.NO_FRAMES if free >= floor / 4 * margin else Room.NOTHING
