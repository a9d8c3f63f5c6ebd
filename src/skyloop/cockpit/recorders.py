"""How recordings and replays are started: the recorder is a child process, a replay a private proxy."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Protocol
from urllib.parse import quote

from skyloop.errors import NoAnswerError

if TYPE_CHECKING:
    from skyloop.client import Drone
    from skyloop.recording import Status

REPLAY_S: Final = 60.0  #: for the proxy of a replay to answer: on a busy computer it takes long, and the page says so


class Recorder(Protocol):
    """What records; :class:`skyloop.recording.Recorder` is one."""

    @property
    def status(self) -> Status: ...
    def close(self) -> None: ...


@dataclass(frozen=True, slots=True)
class Running:
    """A recording that goes on."""

    drones: tuple[str, ...]
    recorder: Recorder


def start_recorder(drones: Sequence[str], folder: Path) -> Recorder:
    """Record proxies to a new file of a folder.

    Raises:
        SkyloopError: It can't start.
    """
    from skyloop.recording import record

    return record(drones, folder)


def start_replay(path: Path, drone: str | None = None) -> Drone:
    """Start a private proxy that plays a file, and connect to it.

    Args:
        path: The file.
        drone: Which of the recorded ones; None for the first.

    Raises:
        SkyloopError: It can't start.
    """
    from skyloop.client import connect

    which = "" if drone is None else f"?drone={quote(drone)}"
    try:
        return connect(f"replay://{quote(str(path))}{which}", access="observe", name="cockpit", timeout_s=REPLAY_S)
    except NoAnswerError as error:
        raise NoAnswerError(
            f"the replay of {path.name} has not started within {REPLAY_S:g} s: this computer is too busy. "
            "End other replays and programs, and try again"
        ) from error


@dataclass(frozen=True, slots=True)
class Replay:
    """A recording that is played again."""

    drone: Drone  #: the observer that keeps its proxy running
    path: Path
    recorded: str | None  #: the drone's name in the recording; None: the first


def progress(status: Status) -> dict[str, Any]:
    """Return how far a recording is, as JSON values."""
    return {
        "path": status.path,
        "state": str(status.state),
        "reason": status.reason,
        "seconds": round(status.seconds, 3),
        "bytes": status.bytes,
        "dropped": status.dropped,
        "missed": status.missed,
    }
