"""The recorder as a separate process, so that recording does not slow down the flight: child and parent."""

from __future__ import annotations

import contextlib
import logging
import os
import signal
import sys
import threading
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import Final

import msgspec

from skyloop.child_process import ChildProcess, on_parent_end
from skyloop.client import connect
from skyloop.client.mailbox import Notifier
from skyloop.errors import LinkError, MissingExtraError, NoAnswerError, SkyloopError, UsageError
from skyloop.messages import Severity
from skyloop.recording.engine import Engine
from skyloop.recording.options import Options
from skyloop.recording.status import RecorderEvent, RecorderState, Status

START_S: Final = 20.0
_END_S: Final = 15.0  # to write what was received, before the child is terminated
_HARDER_S: Final = 3.0
_TELL_S: Final = 0.25
_NICE: Final = 5  # the flight comes first
_log = logging.getLogger(__name__)


class Order(msgspec.Struct, frozen=True):
    """What a child is to record."""

    targets: tuple[str, ...]  #: the address or name by which each drone is connected
    path: str
    options: Options


class Line(msgspec.Struct, frozen=True, omit_defaults=True):
    """A child's message to its parent: one JSON object per line."""

    status: Status | None = None
    event: RecorderEvent | None = None
    trouble: str = ""  #: why it could not start
    usage: bool = False  #: whether that was a UsageError


# The child -----------------------------------------------------------------------------------------------------


def run_child(order: Order) -> int:
    """Record until standard input ends or SIGTERM arrives.

    Args:
        order: What to record.

    Returns:
        The exit code: 0, or 2 if the recording could not start.
    """
    stop = threading.Event()
    signal.signal(signal.SIGTERM, lambda *_: stop.set())
    on_parent_end(stop.set)
    if hasattr(os, "nice"):
        os.nice(_NICE)
    # Sent by this thread, so that a parent that does not read never blocks the writing.
    events: deque[RecorderEvent] = deque()
    with contextlib.ExitStack() as stack:
        try:
            drones = [stack.enter_context(connect(t, access="observe", name="recorder")) for t in order.targets]
            engine = Engine(drones, Path(order.path), order.options, events.append)
            engine.start()
        except SkyloopError as error:
            _print(Line(trouble=str(error), usage=isinstance(error, UsageError)))
            return 2
        stack.callback(engine.stop)
        while not stop.is_set():
            _report(engine, events)
            stop.wait(_TELL_S)
        engine.stop()
        _report(engine, events)
    return 0


def _report(engine: Engine, events: deque[RecorderEvent]) -> None:
    while events:
        _print(Line(event=events.popleft()))
    _print(Line(status=engine.status))


def _print(line: Line) -> None:
    with contextlib.suppress(OSError):  # the parent is gone
        sys.stdout.buffer.write(msgspec.json.encode(line) + b"\n")
        sys.stdout.buffer.flush()


# The parent ----------------------------------------------------------------------------------------------------


class RecorderProcess:
    """A child process that records; it ends with :meth:`stop`, and with this process, however that ends."""

    def __init__(self, order: Order, on_event: Callable[[RecorderEvent], None] = lambda _: None) -> None:
        """Start the child, and wait until it records.

        Args:
            order: What to record.
            on_event: Called with the child's events, on a thread that reads them.

        Raises:
            UsageError: The child can't record because of a wrong argument.
            LinkError: The child can't record for another reason, or has ended.
            NoAnswerError: The child does not start in time.
        """
        self._on_event = on_event
        self._status = Status(path=order.path)
        self._trouble: Line | None = None
        self._bell = Notifier()
        self._ended = False
        self._process = ChildProcess([sys.executable, "-m", "skyloop.recording", msgspec.json.encode(order).decode()])
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

    def start(self) -> None:
        """Do nothing: the child was started by the constructor."""

    def stop(self) -> None:
        """Let the child write what was received and close its file, and wait for its end. Idempotent.

        A child that does not end in time is terminated, then killed.
        """
        self._process.end(_END_S, _HARDER_S)
        self._thread.join()
        self._process.close()

    def _wait_for_start(self) -> None:
        def decided() -> bool:
            return self._ended or self._status.state is not RecorderState.STARTING

        if not self._bell.wait_for(decided, START_S):
            raise NoAnswerError(f"the recorder's process did not start within {START_S:g} s")
        if self._trouble is not None:
            raise (UsageError if self._trouble.usage else LinkError)(self._trouble.trouble)
        if self._ended:
            raise LinkError(f"the recorder's process {self._how_it_ended()}")

    def _listen(self) -> None:
        for text in self._process.stdout:
            try:
                self._take(msgspec.json.decode(text, type=Line))
            except Exception as error:  # noqa: BLE001  (a library may print anything, a callback raise anything)
                _log.warning("the recorder's process: %r: %r", text[:200], error)
            self._bell.notify()
        self._process.wait()
        self._ended = True
        if self._trouble is None and self._status.state not in (RecorderState.CLOSED, RecorderState.FAILED):
            reason = f"the recorder's process {self._how_it_ended()}"
            self._status = msgspec.structs.replace(self._status, state=RecorderState.FAILED, reason=reason)
            with contextlib.suppress(Exception):
                self._on_event(RecorderEvent(f"{reason}; what it wrote is in {self._status.path}", Severity.ERROR))
        self._bell.notify()

    def _take(self, line: Line) -> None:
        if line.status is not None:
            self._status = line.status
        if line.event is not None:
            self._on_event(line.event)
        if line.trouble:
            self._trouble = line

    def _how_it_ended(self) -> str:
        return f"{self._process.ending}{self._process.quoted_output}"


def check_installed() -> None:
    """Check that the extra is installed, so that the error is raised here and not in a child.

    Raises:
        MissingExtraError: The extra ``[record]`` is not installed.
    """
    from importlib.util import find_spec

    missing = [name for name in ("mcap", "foxglove_schemas_protobuf", "cv2") if find_spec(name) is None]
    if missing:
        raise MissingExtraError("recording", "record", cause=f"no {', '.join(missing)}")
