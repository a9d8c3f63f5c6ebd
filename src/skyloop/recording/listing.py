"""Describe the recordings in a folder, even if the extra ``record`` is not installed."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Final

import msgspec

from skyloop.clock import NS_PER_S
from skyloop.errors import SkyloopError

ENDING: Final = ".mcap"


class Described(msgspec.Struct, frozen=True):
    """A summary of a recording."""

    started: float | None = None  #: Unix time [s], or None if unknown
    drones: tuple[str, ...] = ()
    seconds: float | None = None  #: time from the first message to the last
    problem: str = ""  #: reason why it is unreadable or incomplete; empty if it is complete


def shown_name(path: Path) -> str:
    """Return a file's name as text, with non-UTF-8 bytes shown in hexadecimal."""
    return os.fsencode(path.name).decode(errors="backslashreplace")


def describe(path: Path) -> Described:
    """Describe a file without decompressing anything. The file's content never causes an exception."""
    try:
        from skyloop.recording.reader import Recording

        recording = Recording.open(path)
        return Described(
            started=recording.start.started_unix_ns / NS_PER_S,
            drones=tuple(drone.name for drone in recording.drones),
            seconds=round(recording.seconds, 3),
            problem=recording.cut,
        )
    except SkyloopError as error:
        return Described(problem=str(error).removeprefix(f"{path} ").replace(path.name, shown_name(path)))
    except Exception as error:  # noqa: BLE001  an unexpected error in one file must not hide the others
        return Described(problem=f"{shown_name(path)} can't be read: {error!r:.300}")
