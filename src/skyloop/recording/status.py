"""The status of a recorder, and its decisions when the disk fills up. Pure."""

from __future__ import annotations

from enum import StrEnum
from typing import Final

import msgspec

from skyloop.messages import Severity


class RecorderState(StrEnum):
    """Whether a recorder records."""

    STARTING = "starting"
    RECORDING = "recording"
    PAUSED = "paused"  #: the disk can't be written; what must not be lost waits, and writing is retried each second
    CLOSED = "closed"  #: closed on purpose; the file is complete
    FAILED = "failed"  #: its process was killed, or its thread ended by an error; what was written is in the file


class Status(msgspec.Struct, frozen=True):
    """The status of a recording at one time."""

    state: RecorderState = RecorderState.STARTING
    reason: str = ""  #: why it is paused or has failed
    path: str = ""  #: the file that is written, or that was written last
    files: tuple[str, ...] = ()  #: all of them, oldest first
    seconds: float = 0.0  #: since it started
    bytes: int = 0  #: in all files
    messages: int = 0
    waiting: int = 0  #: bytes received and not written yet
    dropped: dict[str, dict[str, int]] = {}  #: by drone and channel: received, and left out
    missed: dict[str, dict[str, int]] = {}  #: by drone and channel: never received


class RecorderEvent(msgspec.Struct, frozen=True):
    """Something that happened to a recording, for people and applications."""

    text: str
    severity: Severity = Severity.INFO


class Room(StrEnum):
    """What is still written when the disk fills up."""

    ALL = "all"
    NO_FRAMES = "no frames"
    NOTHING = "nothing"


_MARGIN: Final = 1.25  #: factor of a limit that must be free again before more is written


def judge_room(free: int, floor: int, before: Room) -> Room:
    """Decide what is written: all above the floor, no frames below it, nothing below a quarter of it.

    Args:
        free: Bytes that are free on the disk.
        floor: Bytes that are to stay free.
        before: The decision before; to write more again, a margin above the limit must be free.
    """
    margin = _MARGIN if before is not Room.ALL else 1.0
    if free >= floor * margin:
        return Room.ALL
    margin = _MARGIN if before is Room.NOTHING else 1.0
    return Room.NO_FRAMES if free >= floor / 4 * margin else Room.NOTHING
