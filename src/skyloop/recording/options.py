"""Recording options, validated before anything is opened; the name of the next file; the status of a recorder."""

from __future__ import annotations

import math
import re
import time
from collections.abc import Iterable
from enum import StrEnum
from pathlib import Path
from typing import Final, Literal

import msgspec

from skyloop.errors import UnknownNameError, UsageError
from skyloop.messages import CameraInfo, Severity
from skyloop.messages.frame import H264
from skyloop.recording.layout import Channel

VideoEncoding = Literal["auto", "jpeg", "png"]

_FORBIDDEN: Final = re.compile(r'[<>:"/\\|?*]')  # in the names of files; Windows has the longest list
MB: Final = 1_000_000  #: [bytes]
VIDEO: Final = "video"
#: Channels to choose from; ``video.CAMERA`` selects one camera.
CHOICES: Final = (*(one.value for one in Channel if one not in (Channel.FRAMES, Channel.DROPS)), VIDEO)


class Options(msgspec.Struct, frozen=True):
    """Recording options; :func:`skyloop.record` describes each. Raise ``UsageError`` if a value is out of range."""

    channels: tuple[str, ...] = CHOICES
    encoding: VideoEncoding = "auto"
    quality: int = 90
    rotate_mb: float | None = None
    rotate_s: float | None = None
    min_free_mb: float = 256.0
    buffer_mb: float = 64.0
    overwrite: bool = False

    def __post_init__(self) -> None:
        if self.encoding not in ("auto", "jpeg", "png"):
            known = '"auto", "jpeg" or, lossless, "png"'
            raise UsageError(f"encoding is {self.encoding!r} and must be {known}")
        if not isinstance(self.quality, int) or not 1 <= self.quality <= 100:
            raise UsageError(f"quality is {self.quality!r} and must be a whole number from 1 to 100 (best)")
        for name, least in (("rotate_mb", 1.0), ("rotate_s", 1.0), ("min_free_mb", 0.0), ("buffer_mb", 1.0)):
            value = getattr(self, name)
            if value is None and name.startswith("rotate"):
                continue
            if not isinstance(value, int | float) or not least <= value < math.inf:
                raise UsageError(f"{name} is {value!r} and must be a number of at least {least:g}")

    @property
    def rotates(self) -> bool:
        """Whether the recording is split into several files."""
        return self.rotate_mb is not None or self.rotate_s is not None

    def wants(self, channel: Channel) -> bool:
        """Return whether to record a channel that does not belong to a camera."""
        return channel.value in self.channels

    def wants_camera(self, camera: str) -> bool:
        """Return whether a camera's frames are recorded."""
        return VIDEO in self.channels or f"{VIDEO}.{camera}" in self.channels

    def keeps_stream(self, camera: CameraInfo) -> bool:
        """Return whether a camera's frames are recorded in the vehicle's own encoding."""
        return self.encoding == "auto" and camera.stream == H264

    def check_cameras(self, known: Iterable[str]) -> None:
        """Check that the chosen cameras exist. Raise ``UnknownNameError`` if no drone has a camera with that name."""
        cameras = set(known)
        for name in self.channels:
            kind, dot, camera = name.partition(".")
            if kind == VIDEO and dot and camera not in cameras:
                raise UnknownNameError("camera", camera, cameras)


def channels_of(names: Iterable[str] | None) -> tuple[str, ...]:
    """Convert the caller's choice of channels to names from :data:`CHOICES`.

    ``names``: one name or several; ``command`` means ``commands``. None selects all channels. Raise
    ``UnknownNameError`` if a channel does not exist, and ``UsageError`` if no channel was given.
    """
    if names is None:
        return CHOICES
    if isinstance(names, str):
        names = (names,)
    found = []
    for name in names:
        plural = f"{name}s"
        if name in CHOICES or (name.startswith(f"{VIDEO}.") and len(name) > len(VIDEO) + 1):
            found.append(name)
        elif plural in CHOICES:
            found.append(plural)
        else:
            raise UnknownNameError("channel to record", str(name), (*CHOICES, f"{VIDEO}.CAMERA"))
    if not found:
        raise UsageError(f"no channel to record: choose from {', '.join(CHOICES)}")
    return tuple(found)


def numbered(path: Path, number: int) -> Path:
    """Return the path of the recording's file with this number, such as ``flight-0002.mcap``."""
    return path.with_name(f"{path.stem}-{number:04d}{path.suffix}")


def first_path(path: Path, drones: list[str], options: Options) -> Path:
    """Return the path to record to: the file (``.mcap`` by default) or, in a folder, one named after drones and time.

    Raise ``UsageError`` if the file already exists or its folder does not.
    """
    if path.is_dir():
        path = path / f"{_FORBIDDEN.sub('_', '-'.join(drones)[:64])}-{time.strftime('%Y%m%d-%H%M%S')}.mcap"
    if not path.suffix:
        path = path.with_suffix(".mcap")
    if not path.parent.is_dir():
        raise UsageError(f"{path.parent} is not a folder: create it first")
    first = numbered(path, 1) if options.rotates else path
    if first.exists() and not options.overwrite:
        raise UsageError(f"{first} already exists: choose another name, or overwrite=True (--overwrite)")
    return path


# Status ---------------------------------------------------------------------------------------------------------


class RecorderState(StrEnum):
    """The state of a recorder."""

    STARTING = "starting"
    RECORDING = "recording"
    PAUSED = "paused"  #: the disk can't be written to; essential samples wait, and the write is retried every second
    CLOSED = "closed"  #: closed intentionally; the file is complete
    #: its process was killed, an error ended its thread, or it was closed while paused; data already written remains
    FAILED = "failed"


class Status(msgspec.Struct, frozen=True):
    """The status of a recording at one moment."""

    state: RecorderState = RecorderState.STARTING
    reason: str = ""  #: reason why it is paused, has failed or is leaving frames out
    path: str = ""  #: the current file or, if there is none, the previous one
    files: tuple[str, ...] = ()  #: all files, oldest first
    seconds: float = 0.0  #: time since recording started
    bytes: int = 0  #: total size of all files
    messages: int = 0
    waiting: int = 0  #: number of bytes that have been received but not written yet
    dropped: dict[str, dict[str, int]] = {}  #: samples received but dropped, by drone and channel
    missed: dict[str, dict[str, int]] = {}  #: samples that were never received, by drone and channel


class RecorderEvent(msgspec.Struct, frozen=True):
    """An event of a recording, for users and applications."""

    text: str
    severity: Severity = Severity.INFO


class DiskRoom(StrEnum):
    """The samples that are still written when the disk is nearly full."""

    ALL = "all"
    NO_FRAMES = "no frames"
    NOTHING = "nothing"


_MARGIN: Final = 1.25  #: free space required before writing resumes, as a multiple of the limit


def judge_room(free: int, floor: int, before: DiskRoom) -> DiskRoom:
    """Decide what to write: everything above the floor, no frames below it, nothing below a quarter of it.

    To write more than ``before``, the free space must exceed the limit by an extra margin.
    """
    margin = _MARGIN if before is not DiskRoom.ALL else 1.0
    if free >= floor * margin:
        return DiskRoom.ALL
    margin = _MARGIN if before is DiskRoom.NOTHING else 1.0
    return DiskRoom.NO_FRAMES if free >= floor / 4 * margin else DiskRoom.NOTHING
