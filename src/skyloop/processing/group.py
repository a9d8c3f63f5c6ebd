"""Several workers on this host, each in its own process. A worker that dies is restarted."""

from __future__ import annotations

import contextlib
import os
import sys
import time
from collections.abc import Callable, Sequence
from types import TracebackType
from typing import Final, Self

import msgspec

from skyloop.child_process import GRACE_S, ChildProcess, RestartingChild, on_parent_end
from skyloop.processing.worker import Status, together

_PAUSE_S: Final = 1.0  #: delay before restarting a worker that died
USAGE_ERROR: Final = 2  #: exit code of a child that can't run at all and has printed the reason


class WorkerProcess:
    """A worker's process, which is restarted ``pause_s`` [s] after it dies.

    ``command`` must regularly print a :class:`Status` as a JSON line on standard output. ``report`` is called on the
    monitoring thread with text for users when the process dies; ``number``, from 1, is the worker's number there.
    """

    def __init__(self, number: int, command: Sequence[str], report: Callable[[str], None], pause_s: float) -> None:
        self.status: Status | None = None
        self.code: int | None = None  #: exit code; set once the worker has exited for good or can't run at all
        self._number = number
        self._report = report
        self._pause_s = pause_s
        self.process = RestartingChild(command, name=f"skyloop-worker-{number}", read=self._read, ended=self._ended)
        self.process.start()

    def _read(self, child: ChildProcess) -> None:
        for text in child.stdout:
            with contextlib.suppress(msgspec.DecodeError):  # the user's code may also print to standard output
                self.status = msgspec.json.decode(text, type=Status)

    def _ended(self, child: ChildProcess | None, ending: str) -> float | None:
        code = None if child is None else child.code
        if code in (0, USAGE_ERROR):
            self.code = code
            return None
        self.status = None
        if not self.process.stopping:
            self._report(f"worker {self._number} {ending}: the others process its share until it restarts")
        return self._pause_s


class ProcessGroup:
    """Several children running the same command. Leaving its ``with`` block ends them."""

    def __init__(
        self, command: Sequence[str], count: int, report: Callable[[str], None], *, pause_s: float = _PAUSE_S
    ) -> None:
        """Start ``count`` children; when one dies, ``report`` is called with a message on its monitoring thread."""
        self._workers = [WorkerProcess(number, tuple(command), report, pause_s) for number in range(1, count + 1)]

    @property
    def status(self) -> Status | None:
        """Combined statistics of all children; None until one of them has reported."""
        return together(worker.status for worker in self._workers if worker.status is not None)

    @property
    def pids(self) -> list[int]:
        """Process ids of the running children."""
        children = [worker.process.child for worker in self._workers]
        return [child.pid for child in children if child is not None and child.code is None]

    @property
    def code(self) -> int | None:
        """Exit code once all children have exited or one has reported that it can't run; None before that."""
        codes = [worker.code for worker in self._workers]
        if USAGE_ERROR in codes:
            return USAGE_ERROR
        return 0 if all(code == 0 for code in codes) else None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        for worker in self._workers:
            child = worker.process.request_stop()
            if child is not None:
                child.part()
        for worker in self._workers:
            worker.process.stop(GRACE_S, GRACE_S)


def end_with_parent(stop: Callable[[], None]) -> None:
    """Call ``stop`` in this child process when its standard input closes; exit if it is still running 2 s later.

    ``stop`` runs on a separate thread.
    """

    def end() -> None:
        stop()
        time.sleep(GRACE_S / 2)
        os._exit(1)  # the user's code is hanging, and the parent can no longer end this process

    on_parent_end(end)


def child_command(arguments: Sequence[str]) -> list[str]:
    """Return the command line that runs this program with the given arguments."""
    return [sys.executable, "-m", "skyloop", *arguments]
