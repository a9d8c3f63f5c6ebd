"""``skyloop.record``: a recorder for connected drones, or for drones given by their names."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from types import TracebackType
from typing import Protocol, Self

from skyloop.client import Drone, connect
from skyloop.errors import UsageError
from skyloop.extend import Known
from skyloop.messages import EventKind
from skyloop.recording.child import Order, RecorderProcess, check_installed
from skyloop.recording.engine import Engine
from skyloop.recording.options import Options, VideoEncoding, channels_of, first_path
from skyloop.recording.status import RecorderEvent, RecorderState, Status


class Backend(Protocol):
    """What records: a process, or threads of this one."""

    @property
    def status(self) -> Status: ...
    def start(self) -> None: ...
    def stop(self) -> None: ...


class Recorder:
    """A recording that runs until :meth:`close`, or to the end of its ``with`` block. May be used from any thread."""

    def __init__(self, drones: Sequence[Drone | str], path: Path, options: Options, in_process: bool) -> None:
        """Start the recording; applications call :func:`record`.

        Args:
            drones: Connected ones, or names of proxies.
            path: The first file.
            options: What to record and how.
            in_process: Whether to record on threads of this process.

        Raises:
            UsageError: The drones have the same name, or the file can't be written.
            LinkError: A drone can't be connected to, or the recorder's process ended.
            NoAnswerError: The recorder's process does not start.
        """
        self._listening = [drone for drone in drones if isinstance(drone, Drone)]
        self._own: list[Drone] = []  # connected by this recorder
        self._backend: Backend
        if in_process:
            self._backend = self._within(drones, path, options)
        else:
            targets = tuple(drone if isinstance(drone, str) else str(Known(drone).reach) for drone in drones)
            self._backend = RecorderProcess(Order(targets, str(path.absolute()), options), self._on_event)

    def _within(self, drones: Sequence[Drone | str], path: Path, options: Options) -> Engine:
        try:
            known = []
            for drone in drones:
                if isinstance(drone, str):
                    drone = connect(drone, access="observe", name="recorder")
                    self._own.append(drone)
                known.append(drone)
            engine = Engine(known, path, options, self._on_event)
            engine.start()
        except BaseException:
            self._close_own()
            raise
        return engine

    @property
    def status(self) -> Status:
        """The present status; some of its parts have properties of their own."""
        return self._backend.status

    @property
    def state(self) -> RecorderState:
        """Whether it records now."""
        return self.status.state

    @property
    def reason(self) -> str:
        """Why it is paused or has failed."""
        return self.status.reason

    @property
    def path(self) -> Path:
        """The file that is written, or that was written last."""
        return Path(self.status.path)

    @property
    def files(self) -> list[Path]:
        """All files of this recording, oldest first."""
        return [Path(file) for file in self.status.files]

    @property
    def seconds(self) -> float:
        """Time since the start."""
        return self.status.seconds

    @property
    def bytes(self) -> int:
        """Bytes written so far, in all files."""
        return self.status.bytes

    @property
    def dropped(self) -> dict[str, dict[str, int]]:
        """By drone and channel: how many samples were received and left out."""
        return self.status.dropped

    @property
    def missed(self) -> dict[str, dict[str, int]]:
        """By drone and channel: how many samples never reached the recorder."""
        return self.status.missed

    def close(self) -> None:
        """Write what was received, and close the file. Idempotent."""
        self._backend.stop()
        self._close_own()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()

    def __repr__(self) -> str:
        return f"<Recorder {self.path} ({self.state.value}, {self.seconds:.0f} s, {self.bytes / 1e6:.1f} MB)>"

    def _on_event(self, event: RecorderEvent) -> None:
        for drone in self._listening:
            drone.emit(EventKind.RECORDING, event.text, event.severity)

    def _close_own(self) -> None:
        for drone in self._own:
            drone.close()


def record(
    drones: Drone | str | Iterable[Drone | str],
    path: str | Path,
    *,
    channels: Iterable[str] | None = None,
    encoding: VideoEncoding = "auto",
    quality: int = 90,
    rotate_mb: float | None = None,
    rotate_s: float | None = None,
    min_free_mb: float = 256.0,
    buffer_mb: float = 64.0,
    overwrite: bool = False,
    in_process: bool | None = None,
) -> Recorder:
    """Record one or several drones to an MCAP file; return once the recording runs. Use it as a context manager.

    Args:
        drones: Connected ones, or names of running proxies.
        path: A file, or a folder in which a name is chosen.
        channels: Of ``commands``, ``feedback``, ``events``, ``parameters``, ``annotations``, ``logs``, ``results``,
            ``video`` and ``video.CAMERA``; None records all.
        encoding: Of raw frames: ``"jpeg"``, or lossless ``"png"``; frames that arrive as JPEG are kept as such.
            ``"auto"`` keeps the vehicle's H.264 where it sends that, and else encodes as JPEG.
        quality: Of JPEG, 1 to 100 (best).
        rotate_mb: Start a new file after so many megabytes (``flight-0001.mcap``, …), each complete in itself, H.264 at
            a key frame; None does not.
        rotate_s: The same after so many seconds.
        min_free_mb: Space to leave on the disk: below it frames are not recorded, below a quarter of it nothing.
        buffer_mb: How much may wait for a slow disk before frames are dropped.
        overwrite: Whether an existing file is replaced.
        in_process: Whether to record on threads of this process, and not in a separate one; None does so only if a
            drone can't be reached from another process.

    Raises:
        UsageError: An argument is wrong, or the file exists or can't be written.
        UnknownNameError: There is no such channel or camera.
        LinkError: A drone can't be connected to, or the recorder's process can't record.
        NoAnswerError: The recorder's process does not start.
        MissingExtraError: The extra ``[record]`` is not installed.
    """
    several = [drones] if not isinstance(drones, Iterable) or isinstance(drones, str) else list(drones)
    if not several or not all(isinstance(drone, Drone | str) for drone in several):
        raise UsageError(f"drones is {drones!r:.80} and must be a drone, a proxy's name, or several of them")
    check_installed()
    options = Options(
        channels=channels_of(channels),
        encoding=encoding,
        quality=quality,
        rotate_mb=rotate_mb,
        rotate_s=rotate_s,
        min_free_mb=min_free_mb,
        buffer_mb=buffer_mb,
        overwrite=overwrite,
    )
    names = [drone if isinstance(drone, str) else drone.name for drone in several]
    alone = [drone.name for drone in several if isinstance(drone, Drone) and Known(drone).reach is None]
    if in_process is False and alone:
        raise UsageError(f"{alone[0]} can't be reached from another process: record it in this one")
    where = first_path(Path(path), names, options)
    return Recorder(several, where, options, bool(alone) if in_process is None else in_process)
