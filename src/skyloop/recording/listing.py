"""The recordings of a folder, one row each: what is wrong with a file is reported in its own row."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Final

import msgspec

from skyloop.clock import NS_PER_S
from skyloop.errors import SkyloopError

ENDING: Final = ".mcap"


class Described(msgspec.Struct, frozen=True):
    """What is in a recording."""

    started: float | None = None  #: Unix time [s]; None if it is not known
    drones: tuple[str, ...] = ()
    seconds: float | None = None  #: from the first message to the last
    problem: str = ""  #: why it can't be read, or why it is incomplete; empty for a complete file


def shown_name(path: Path) -> str:
    """Return a file's name as a text, with bytes that are not UTF-8 in hexadecimal."""
    return os.fsencode(path.name).decode(errors="backslashreplace")


def describe(path: Path) -> Described:
    """Describe a file without unpacking anything. Never raises because of what is in it."""
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
        return Described(problem=str(error).replace(path.name, shown_name(path)))
    except Exception as error:  # noqa: BLE001  one file's surprise must not hide the others
        return Described(problem=f"{shown_name(path)} can't be read: {error!r:.300}")
