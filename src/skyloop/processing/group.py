"""Several workers on this host, each a process of its own; one that dies is restarted."""

from __future__ import annotations

import contextlib
import os
import sys
import threading
import time
from collections.abc import Callable, Sequence
from types import TracebackType
from typing import Final, Self

import msgspec

from skyloop.child_process import GRACE_S, ChildProcess, on_parent_end
from skyloop.processing.status import Status, together

_PAUSE_S: Final = 1.0  #: time before a worker that died is restarted
USAGE_ERROR: Final = 2  #: exit code of a child that can't work at all; it prints why


class Child:
    """The process of one worker. It ends when its standard input does, and so never outlives this process."""

    def __init__(self, command: Sequence[str]) -> None:
        """Start the process.

        Args:
            command: Its command line; it prints a :class:`Status` as JSON on a line of standard output now and then.
        """
        self.status: Status | None = None
        self._process = ChildProcess(command, keep_errors=False)
        self.pid = self._process.pid  #: process id
        self._thread = threading.Thread(target=self._listen, name="skyloop-worker", daemon=True)
        self._thread.start()

    @property
    def code(self) -> int | None:
        """Exit code, negative for a signal; None while it runs."""
        return self._process.code

    @property
    def ending(self) -> str:
        """How it ended, for people."""
        return self._process.ending

    def part(self) -> None:
        """Ask it to end, by closing its standard input. Does not wait."""
        self._process.part()

    def end(self) -> None:
        """End it and wait; after 4 s it is terminated, after another 4 s killed."""
        self._process.end(GRACE_S, GRACE_S)
        self._thread.join()
        self._process.close()

    def _listen(self) -> None:
        for text in self._process.stdout:
            with contextlib.suppress(msgspec.DecodeError):  # the user's code may print there too
                self.status = msgspec.json.decode(text, type=Status)


class Group:
    """Several children that run the same command. A context manager that ends them."""

    def __init__(
        self, command: Sequence[str], count: int, tell: Callable[[str], None], *, pause_s: float = _PAUSE_S
    ) -> None:
        """Start the children.

        Args:
            command: Command line of each.
            count: How many.
            tell: Called with a text for people when a child dies, on the thread that calls :meth:`look`.
            pause_s: Time before a child that died is restarted [s].
        """
        self._command = tuple(command)
        self._report = tell
        self._pause_s = pause_s
        self._children: list[Child | None] = [Child(self._command) for _ in range(count)]
        self._due_s = [0.0] * count

    @property
    def status(self) -> Status | None:
        """Statistics of all children together; None until one has reported."""
        return together(child.status for child in self._children if child is not None and child.status is not None)

    @property
    def pids(self) -> list[int]:
        """Process ids of the children that run."""
        return [child.pid for child in self._children if child is not None]

    def look(self) -> int | None:
        """Restart children that died. To be called again and again.

        Returns:
            The exit code once all have ended by themselves, or one has reported that it can't work; None before.
        """
        for number, child in enumerate(self._children):
            if child is None:
                self._restart(number)
            elif child.code not in (None, 0, USAGE_ERROR):
                self._bury(number, child)
        codes = [None if child is None else child.code for child in self._children]
        if USAGE_ERROR in codes:
            return USAGE_ERROR
        return 0 if all(code == 0 for code in codes) else None

    def _bury(self, number: int, child: Child) -> None:
        self._report(f"worker {number + 1} {child.ending}: the others have its share until it is restarted")
        child.end()
        self._children[number] = None
        self._due_s[number] = time.monotonic() + self._pause_s

    def _restart(self, number: int) -> None:
        if time.monotonic() >= self._due_s[number]:
            self._children[number] = Child(self._command)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        children = [child for child in self._children if child is not None]
        for child in children:
            child.part()
        for child in children:
            child.end()


def end_with_parent(stop: Callable[[], None]) -> None:
    """Call ``stop`` in this child process when its standard input ends, and exit if it is still running 2 s later.

    ``stop`` runs on a thread of its own.
    """

    def end() -> None:
        stop()
        time.sleep(GRACE_S / 2)
        os._exit(1)  # the user's code hangs, and the parent can't end this process any more

    on_parent_end(end)


def child_command(arguments: Sequence[str]) -> list[str]:
    """Return the command line that runs this program with these arguments."""
    return [sys.executable, "-m", "skyloop", *arguments]
