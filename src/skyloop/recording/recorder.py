"""Implement ``skyloop.record``: record drones, connected or given by name, in this process or a separate one."""

from __future__ import annotations

import contextlib
import logging
import signal
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any, Final, Self

import msgspec

from skyloop.child_process import ChildProcess, leave_to_parent, on_parent_end
from skyloop.client import Drone, connect
from skyloop.client.channels import Notifier
from skyloop.errors import LinkError, MissingExtraError, NoAnswerError, SkyloopError, UsageError
from skyloop.extend import Known
from skyloop.messages import EventKind, Severity
from skyloop.recording.backlog import Backlog
from skyloop.recording.layout import ClockPair, DroneRecord, to_plain
from skyloop.recording.options import (
    MB,
    Options,
    RecorderEvent,
    RecorderState,
    Status,
    VideoEncoding,
    channels_of,
    first_path,
)
from skyloop.recording.taps import Tap, check_names, give_way
from skyloop.recording.translation import Translator
from skyloop.recording.writer import FileWriter

_TOO_SLOW: Final = "the disk or the encoder is too slow"


class Engine:
    """Records drones between :meth:`start` and :meth:`stop`."""

    def __init__(
        self,
        drones: Sequence[Drone],
        path: Path,
        options: Options,
        on_event: Callable[[RecorderEvent], None] = lambda _: None,
        **writing: Any,
    ) -> None:
        """Initialise the recorder without opening a file. ``on_event`` is called on the writing thread.

        Raise ``UsageError`` if two drones have the same name, and ``UnknownNameError`` if no drone has a camera named
        in the options.
        """
        check_names(drones, "recording")
        options.check_cameras(camera.name for drone in drones for camera in drone.capabilities.cameras)
        self._on_event = on_event
        self._backlog = Backlog(round(options.buffer_mb * MB))
        self._taps = [Tap(number, drone, options, self._backlog) for number, drone in enumerate(drones)]
        clock = ClockPair.now()
        self._started_ns = clock.monotonic_ns
        self._ended_ns: int | None = None
        records = [
            DroneRecord(drone.name, drone.uri, to_plain(drone.capabilities), drone.clock_offset_ns) for drone in drones
        ]
        translators = [
            Translator(drone.name, drone.capabilities, clock, lambda drone=drone: drone.clock_offset_ns)  # type: ignore[misc]
            for drone in drones
        ]
        self._writer = FileWriter(path, options, self._backlog, records, translators, clock, self._publish, **writing)
        self._writer.dropped = lambda: self._counts(Tap.dropped)
        self._writer.missed = lambda: self._counts(Tap.missed)
        self._writer.each_second = self._report_drops
        self._reported_unwritable = 0
        self._reported: dict[Tap, tuple[dict[str, int], dict[str, int]]] = {tap: ({}, {}) for tap in self._taps}

    def start(self) -> None:
        """Open the file and start recording.

        Raise ``UsageError`` if the file can't be written, and ``SkyloopError`` if subscribing to a drone failed; the
        file is closed by then.
        """
        self._writer.start()
        try:
            for tap in self._taps:
                tap.start()
        except BaseException:
            self.stop()
            raise
        leave_to_parent(self)

    def forked(self) -> None:
        """Leave the file to the parent process. Called in a child created by ``os.fork``."""
        self._ended_ns = time.monotonic_ns()  # so that stop() does nothing

    def stop(self, timeout_s: float = 10.0) -> None:
        """Write all received samples and close the file. Idempotent."""
        if self._ended_ns is not None:
            return
        self._ended_ns = time.monotonic_ns()
        for tap in self._taps:
            tap.stop()
        self._writer.stop(timeout_s)

    @property
    def status(self) -> Status:
        """The current status. Safe to read from any thread."""
        writer = self._writer
        return Status(
            writer.state,
            writer.shown_reason,
            str(writer.path),
            tuple(map(str, writer.files)),
            ((self._ended_ns or time.monotonic_ns()) - self._started_ns) / 1e9,
            writer.bytes,
            writer.messages,
            self._backlog.size,
            self._counts(Tap.dropped),
            self._counts(Tap.missed),
        )

    def _counts(self, of: Callable[[Tap], dict[str, int]]) -> dict[str, dict[str, int]]:
        return {tap.drone.name: counts for tap in self._taps if (counts := of(tap))}

    # On the writing thread -------------------------------------------------------------------------------------

    def _publish(self, text: str, severity: Severity) -> None:
        for tap in self._taps:
            self._publish_to(tap, text, severity)
        self._on_event(RecorderEvent(text, severity))

    def _publish_to(self, tap: Tap, text: str, severity: Severity) -> None:
        """Write an event to the file and log the event on the drone."""
        tap.put_event(text, severity, {"state": self._writer.state.value, "path": str(self._writer.path)})
        tap.drone.log.text(text, name="recording", severity=severity)

    def _report_drops(self) -> None:
        writer = self._writer
        unwritable = writer.unwritable > self._reported_unwritable
        self._reported_unwritable = writer.unwritable
        for tap in self._taps:
            tap.check_streams()
            now = (tap.dropped(), tap.missed())
            before, self._reported[tap] = self._reported[tap], now
            if now == before:
                continue
            tap.put_drops(*now)
            if now[0] != before[0]:
                more = {channel: count - before[0].get(channel, 0) for channel, count in now[0].items()}
                words = ", ".join(f"{count} of {channel}" for channel, count in more.items() if count)
                why = f"can't be written ({writer.unwritable_why})" if unwritable else _TOO_SLOW
                text = f"{tap.drone.name}: the recording leaves out {words}: {why}"
                self._publish_to(tap, text, Severity.WARNING)
                self._on_event(RecorderEvent(text, Severity.WARNING))


class Recorder:
    """A recording that runs until :meth:`close` is called or its ``with`` block ends. Safe to use from any thread."""

    def __init__(self, drones: Sequence[Drone | str], path: Path, options: Options, in_process: bool) -> None:
        """Start the recording. Applications call :func:`record` instead.

        Raises:
            UsageError: Two drones have the same name, or the file can't be written.
            LinkError: Connecting to a drone failed, or the recorder's process ended.
            NoAnswerError: The recorder's process does not start.
        """
        self._listening = [drone for drone in drones if isinstance(drone, Drone)]
        self._own: list[Drone] = []  # drones connected by this recorder
        self._backend: Engine | RecorderProcess
        if in_process:
            self._backend = self._start_engine(drones, path, options)
        else:
            targets = tuple(drone if isinstance(drone, str) else str(Known(drone).reach) for drone in drones)
            self._backend = RecorderProcess(ChildArguments(targets, str(path.absolute()), options), self._on_event)

    def _start_engine(self, drones: Sequence[Drone | str], path: Path, options: Options) -> Engine:
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
        """The current status; some of its fields are also available as properties."""
        return self._backend.status

    @property
    def state(self) -> RecorderState:
        """The current state."""
        return self.status.state

    @property
    def reason(self) -> str:
        """The reason why recording is paused, has failed or is leaving out frames."""
        return self.status.reason

    @property
    def path(self) -> Path:
        """The current file or, if there is none, the previous one."""
        return Path(self.status.path)

    @property
    def files(self) -> list[Path]:
        """All files of this recording, from oldest to newest."""
        return [Path(file) for file in self.status.files]

    @property
    def seconds(self) -> float:
        """Time since recording started."""
        return self.status.seconds

    @property
    def bytes(self) -> int:
        """Bytes written so far to all files."""
        return self.status.bytes

    @property
    def dropped(self) -> dict[str, dict[str, int]]:
        """Number of samples received but dropped, by drone and channel."""
        return self.status.dropped

    @property
    def missed(self) -> dict[str, dict[str, int]]:
        """Number of samples that never reached the recorder, by drone and channel."""
        return self.status.missed

    def close(self) -> None:
        """Write all received samples and close the file. Idempotent."""
        self._backend.stop()
        self._close_own()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
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
    """Record one or more drones to an MCAP file; return once the recording is running. Use as a context manager.

    Args:
        drones: Connected drones, or names of running proxies.
        path: A file, or a folder in which to create a file with a generated name.
        channels: Any of ``commands``, ``feedback``, ``events``, ``parameters``, ``annotations``, ``logs``, ``results``,
            ``video`` and ``video.CAMERA``; None to record everything.
        encoding: Encoding of raw frames: ``"jpeg"``, or lossless ``"png"``; frames that arrive as JPEG stay JPEG.
            ``"auto"`` keeps the vehicle's H.264 if it sends H.264, and otherwise encodes frames as JPEG.
        quality: JPEG quality, 1 to 100 (best).
        rotate_mb: Start a new file (``flight-0001.mcap``, …) after this many megabytes; with H.264, at the next key
            frame. Each file is self-contained. None means never.
        rotate_s: Start a new file after this many seconds; None means never.
        min_free_mb: Free space to leave on the disk. Below this, no frames are recorded; below a quarter, nothing.
        buffer_mb: Amount of data held for a slow disk before frames are dropped.
        overwrite: Whether to replace an existing file.
        in_process: Whether to record on threads of this process instead of in a separate process. If None, threads are
            used only if a drone can't be reached from another process.

    Raises:
        UsageError: An argument is invalid, or the file already exists or can't be written.
        UnknownNameError: A channel or camera does not exist.
        LinkError: Connecting to a drone failed, or the recorder's process can't record.
        NoAnswerError: The recorder's process does not start.
        MissingExtraError: The extra ``[record]`` is not installed.
    """
    several = [drones] if not isinstance(drones, Iterable) or isinstance(drones, str) else list(drones)
    if not several or not all(isinstance(drone, Drone | str) for drone in several):
        raise UsageError(f"drones must be a drone, a proxy's name, or several of them, got {drones!r:.80}")
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


# In a separate process --------------------------------------------------------------------------------------------


START_S: Final = 20.0  #: time allowed for the child to start recording
_END_S: Final = 15.0  # time allowed to write received samples before the child is terminated
_KILL_AFTER_S: Final = 3.0  # time from terminating the child to killing it
_REPORT_S: Final = 0.25  # interval between the child's status reports
_log = logging.getLogger(__name__)


class ChildArguments(msgspec.Struct, frozen=True):
    """The arguments of a recording child."""

    targets: tuple[str, ...]  #: address or name of each drone
    path: str
    options: Options


class Line(msgspec.Struct, frozen=True, omit_defaults=True):
    """A message from a child to its parent: one JSON object per line."""

    status: Status | None = None
    event: RecorderEvent | None = None
    trouble: str = ""  #: reason why the child could not start
    usage: bool = False  #: whether the cause was a UsageError


# The child -----------------------------------------------------------------------------------------------------


def run_child(arguments: ChildArguments) -> int:
    """Record until standard input ends or SIGTERM arrives; return the exit code: 2 if it could not start, else 0."""
    stop = threading.Event()
    signal.signal(signal.SIGTERM, lambda *_: stop.set())
    on_parent_end(stop.set)
    give_way()
    # Events are sent on this thread, so that a parent that does not read never blocks the writing thread.
    events: deque[RecorderEvent] = deque()
    with contextlib.ExitStack() as stack:
        try:
            drones = [stack.enter_context(connect(t, access="observe", name="recorder")) for t in arguments.targets]
            engine = Engine(drones, Path(arguments.path), arguments.options, events.append)
            engine.start()
        except SkyloopError as error:
            _print(Line(trouble=str(error), usage=isinstance(error, UsageError)))
            return 2
        stack.callback(engine.stop)
        while not stop.is_set():
            _report(engine, events)
            stop.wait(_REPORT_S)
        engine.stop()
        _report(engine, events)
    return 0


def _report(engine: Engine, events: deque[RecorderEvent]) -> None:
    while events:
        _print(Line(event=events.popleft()))
    _print(Line(status=engine.status))


def _print(line: Line) -> None:
    with contextlib.suppress(OSError):  # the parent process has exited
        sys.stdout.buffer.write(msgspec.json.encode(line) + b"\n")
        sys.stdout.buffer.flush()


# The parent ----------------------------------------------------------------------------------------------------


class RecorderProcess:
    """A child process that records. It ends on :meth:`stop`, or when this process ends for any reason."""

    def __init__(self, arguments: ChildArguments, on_event: Callable[[RecorderEvent], None] = lambda _: None) -> None:
        """Start the child and wait until it is recording. ``on_event`` is called on the thread that reads its events.

        Raise ``UsageError`` if the child can't record because an argument is invalid, ``LinkError`` if the child can't
        record for another reason or has ended, and ``NoAnswerError`` if the child does not start in time.
        """
        self._on_event = on_event
        self._status = Status(path=arguments.path)
        self._trouble: Line | None = None
        self._notifier = Notifier()
        self._ended = False
        self._process = ChildProcess([sys.executable, "-m", __name__, msgspec.json.encode(arguments).decode()])
        self._thread = threading.Thread(target=self._listen, name="skyloop-recorder", daemon=True)
        self._thread.start()
        try:
            self._wait_for_start()
        except BaseException:
            self.stop()
            raise

    @property
    def pid(self) -> int:
        """Process id of the child."""
        return self._process.pid

    @property
    def status(self) -> Status:
        """The newest status that the child reported."""
        return self._status

    def stop(self) -> None:
        """Have the child write all received samples and close its file, and wait for its end. Idempotent.

        If the child does not end in time, it is terminated, then killed.
        """
        self._process.end(_END_S, _KILL_AFTER_S)
        self._thread.join()
        self._process.close()

    def _wait_for_start(self) -> None:
        def decided() -> bool:
            return self._ended or self._status.state is not RecorderState.STARTING

        if not self._notifier.wait_for(decided, START_S):
            raise NoAnswerError(f"the recorder's process did not start within {START_S:g} s")
        if self._trouble is not None:
            raise (UsageError if self._trouble.usage else LinkError)(self._trouble.trouble)
        if self._ended:
            raise LinkError(f"the recorder's process {self._how_it_ended()}")

    def _listen(self) -> None:
        for text in self._process.stdout:
            try:
                self._handle(msgspec.json.decode(text, type=Line))
            except Exception as error:  # noqa: BLE001 (a library may print anything, and a callback may raise anything)
                _log.warning("the recorder's process: %r: %r", text[:200], error)
            self._notifier.notify()
        self._process.wait()
        self._ended = True
        if self._trouble is None and self._status.state not in (RecorderState.CLOSED, RecorderState.FAILED):
            reason = f"the recorder's process {self._how_it_ended()}"
            self._status = msgspec.structs.replace(self._status, state=RecorderState.FAILED, reason=reason)
            with contextlib.suppress(Exception):
                self._on_event(RecorderEvent(f"{reason}; its data is in {self._status.path}", Severity.ERROR))
        self._notifier.notify()

    def _handle(self, line: Line) -> None:
        if line.status is not None:
            self._status = line.status
        if line.event is not None:
            self._on_event(line.event)
        if line.trouble:
            self._trouble = line

    def _how_it_ended(self) -> str:
        return f"{self._process.ending}{self._process.quoted_output}"


def check_installed() -> None:
    """Check that the extra is installed, so that the error is raised here rather than in a child."""
    from importlib.util import find_spec

    missing = [name for name in ("mcap", "foxglove_schemas_protobuf", "cv2") if find_spec(name) is None]
    if missing:
        raise MissingExtraError("recording", "record", cause=f"no {', '.join(missing)}")


if __name__ == "__main__":
    sys.exit(run_child(msgspec.json.decode(sys.argv[1], type=ChildArguments)))
