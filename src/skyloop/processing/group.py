"""Several workers on this host, each in its own process; a worker that dies is restarted."""

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

_PAUSE_S: Final = 1.0  #: time before a worker that died is restarted
USAGE_ERROR: Final = 2  #: exit code of a child that can't run at all; it prints the reason


class Worker:
    """The process of one worker, restarted when it dies.

    Args:
        number: Number of the worker, from 1, for people.
        command: Its command line; it prints a :class:`Status` as a JSON line on standard output from time to time.
        report: Called on its thread with a text for people when the worker dies.
        pause_s: Time before a restart [s].
    """

    def __init__(self, number: int, command: Sequence[str], report: Callable[[str], None], pause_s: float) -> None:
        self.status: Status | None = None
        self.code: int | None = None  #: exit code, once it has exited for good or can't run at all
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


class Group:
    """Several children that run the same command. A context manager that ends them."""

    def __init__(
        self, command: Sequence[str], count: int, tell: Callable[[str], None], *, pause_s: float = _PAUSE_S
    ) -> None:
        """Start the children.

        Args:
            command: Command line of each child.
            count: Number of children.
            tell: Called on a child's thread with a text for people when that child dies.
            pause_s: Time before a dead child is restarted [s].
        """
        self._workers = [Worker(number, tuple(command), tell, pause_s) for number in range(1, count + 1)]

    @property
    def status(self) -> Status | None:
        """Combined statistics of all children; None until one has reported."""
        return together(worker.status for worker in self._workers if worker.status is not None)

    @property
    def pids(self) -> list[int]:
        """Process ids of the running children."""
        children = [worker.process.child for worker in self._workers]
        return [child.pid for child in children if child is not None and child.code is None]

    @property
    def code(self) -> int | None:
        """Exit code once all have exited, or one has reported that it can't run; None before."""
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
    """Call ``stop`` in this child process when its standard input closes, and exit if it still runs 2 s later.

    ``stop`` runs on a separate thread.
    """

    def end() -> None:
        stop()
        time.sleep(GRACE_S / 2)
        os._exit(1)  # the user's code hangs, and the parent can no longer end this process

    on_parent_end(end)


def child_command(arguments: Sequence[str]) -> list[str]:
    """Return the command line that runs this program with the given arguments."""
    return [sys.executable, "-m", "skyloop", *arguments]
