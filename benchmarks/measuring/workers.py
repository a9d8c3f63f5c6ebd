"""Processes with a pipe each, optionally under another interpreter, which need not have Skyloop's dependencies."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import subprocess
import sys
from collections.abc import Callable, Sequence
from multiprocessing.connection import Connection
from pathlib import Path
from textwrap import shorten
from types import TracebackType
from typing import Any, Final, Protocol, Self

import skyloop
from skyloop.errors import LinkError, NoAnswerError

STARTS_WITHIN_S: Final = 30.0
ENDS_WITHIN_S: Final = 5.0
_WHAT_LENGTH: Final = 80
#: The folders of ``benchmarks`` and ``skyloop``.
_PACKAGES: Final = f"{Path(__file__).parents[2]}{os.pathsep}{Path(skyloop.__file__).parents[1]}"
# At the end of the path, because another interpreter's own packages, built for its version, must come before ours.
_BOOT: Final = (
    "import os, sys; sys.path += sys.argv[1].split(os.pathsep); "
    "from benchmarks.measuring.workers import child; child(sys.argv[2])"
)


class Pipe(Protocol):
    """One end of a duplex ``multiprocessing`` connection."""

    def send(self, obj: Any, /) -> None: ...
    def recv(self) -> Any: ...
    def poll(self, timeout: float | None = 0.0, /) -> bool: ...


class Worker:
    """A process that runs ``work(pipe, *arguments)``."""

    def __init__(self, command: Sequence[str], work: Callable[..., None], arguments: tuple[Any, ...]) -> None:
        """Start the process.

        Args:
            command: The command that starts the interpreter.
            work: A function of a module.
            arguments: Pickled and sent to the process.
        """
        self.pipe, theirs = multiprocessing.Pipe()
        with theirs:
            number = theirs.fileno()
            self._process = subprocess.Popen([*command, "-c", _BOOT, _PACKAGES, str(number)], pass_fds=[number])
        self.pid = self._process.pid
        self._what = shorten(" ".join([work.__name__, *map(str, arguments[:1])]), _WHAT_LENGTH, placeholder=" …")
        self.pipe.send((work.__module__, work.__qualname__, arguments))

    def answer(self, timeout_s: float) -> Any:
        """Return the next message from the process.

        Args:
            timeout_s: Maximum wait [s].

        Raises:
            NoAnswerError: No message arrived in time.
            LinkError: The process has ended.
        """
        if not self.pipe.poll(timeout_s):
            raise NoAnswerError(f"the measuring process of {self._what} did not answer for {timeout_s:g} s")
        try:
            answer = self.pipe.recv()
        except (EOFError, ConnectionResetError):
            raise LinkError(f"the measuring process of {self._what} ended; its error stands above") from None
        return answer

    def end(self) -> None:
        """Send ``None``, which ends the work."""
        with contextlib.suppress(OSError):  # it has already ended
            self.pipe.send(None)

    def wait(self) -> None:
        """Wait until the process has ended, for at most :data:`ENDS_WITHIN_S`; then kill it."""
        try:
            self._process.wait(ENDS_WITHIN_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self.pipe.close()


class Workers:
    """The processes of a measurement, which all end with the ``with`` block."""

    def __init__(self) -> None:
        self._running: list[Worker] = []

    def start(
        self, work: Callable[..., None], *arguments: Any, python: str = sys.executable, prefix: Sequence[str] = ()
    ) -> Worker:
        """Start a process that runs ``work(pipe, *arguments)``; it sends ``"ready"`` first.

        Args:
            work: A function of a module.
            *arguments: Arguments of the function.
            python: The interpreter.
            prefix: Words put before the interpreter, for example to run it on another host.
        """
        worker = Worker([*prefix, python], work, arguments)
        self._running.append(worker)
        return worker

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        for worker in self._running:
            worker.end()
        for worker in self._running:
            worker.wait()
        self._running.clear()


def child(number: str) -> None:
    """Run a worker's process; ``number`` is the descriptor of its pipe."""
    from importlib import import_module

    with Connection(int(number)) as pipe:
        module, name, arguments = pipe.recv()
        with contextlib.suppress(KeyboardInterrupt, EOFError, BrokenPipeError):  # the measuring process has ended
            getattr(import_module(module), name)(pipe, *arguments)
