"""Child processes that end with their parent, and what a fork of this process leaves to it.

A child's standard input is a pipe into which nothing is written. When the parent closes its end or is gone, however it
ended, the child reads the end of file (:func:`on_parent_end`) and ends too.

A child made by ``os.fork`` is another matter: it has copies of its parent's objects, but none of its threads, and their
ends would end what the parent still uses (:func:`leave_to_parent`).
"""

from __future__ import annotations

import os
import subprocess
import tempfile
import threading
import weakref
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import IO, Final, Protocol

GRACE_S: Final = 4.0  #: for a child to end by itself, and again to end when it is terminated
_TAIL: Final = 2000  # bytes of a child's standard error that an error shows


class LeftToParent(Protocol):
    """What belongs to the process that made it."""

    def forked(self) -> None:
        """In a child made by ``os.fork``: let nothing that is called from now on reach what the parent uses.

        Other threads are gone, and their locks may be held for ever: take none.
        """


_left: Final[weakref.WeakSet[LeftToParent]] = weakref.WeakSet()
_left_lock: Final = threading.RLock()


def leave_to_parent(owner: LeftToParent) -> None:
    """Have ``owner.forked()`` called in each child made by ``os.fork``, for as long as ``owner`` is in use."""
    with _left_lock:
        _left.add(owner)


def _leave_all() -> None:
    _left_lock.release()
    for owner in list(_left):
        owner.forked()
    _left.clear()


if hasattr(os, "register_at_fork"):  # where there is no fork nothing is inherited
    os.register_at_fork(before=_left_lock.acquire, after_in_parent=_left_lock.release, after_in_child=_leave_all)


class ChildProcess:
    """A child in a session of its own, so that Ctrl-C in the terminal reaches only the parent. Any thread.

    Attributes:
        pid: Its process id.
        stdout: What it writes to standard output; open until :meth:`close`.
    """

    def __init__(self, command: Sequence[str], *, keep_errors: bool = True, inherited: Sequence[int] = ()) -> None:
        """Start the child.

        Args:
            command: Its command line.
            keep_errors: Keep what it writes to standard error, for :attr:`last_words`; if False, that goes where this
                process writes its own.
            inherited: Numbers of descriptors that the child has too.
        """
        self._errors: IO[bytes] | None = tempfile.TemporaryFile() if keep_errors else None  # noqa: SIM115
        self._last_words = ""
        try:
            self._process = subprocess.Popen(
                command,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=self._errors,
                start_new_session=True,
                pass_fds=inherited,
            )
        except BaseException:
            if self._errors is not None:
                self._errors.close()
            raise
        assert self._process.stdout is not None
        self.pid = self._process.pid
        self.stdout: IO[bytes] = self._process.stdout
        self._ours = True
        leave_to_parent(self)

    def forked(self) -> None:
        """Leave the child to the process that started it, without a copy of the pipe that keeps it running."""
        self.part()
        self._ours = False

    @property
    def code(self) -> int | None:
        """Exit code, negative for a signal; None while it runs."""
        return self._process.poll()

    @property
    def last_words(self) -> str:
        """The end of what it has written to standard error."""
        if self._errors is None or self._errors.closed:
            return self._last_words
        number = self._errors.fileno()  # read without seeking: the child writes where this file stands
        size = os.fstat(number).st_size
        return os.pread(number, _TAIL, max(0, size - _TAIL)).decode(errors="replace").strip()

    @property
    def ending(self) -> str:
        """How it ended, for people: follows its name."""
        code = self.code
        return f"was killed by signal {-code}" if code is not None and code < 0 else f"ended with exit code {code}"

    @property
    def quoted_output(self) -> str:
        """Its last words as the end of a message; empty for none."""
        text = self.last_words
        return f"; its output:\n{text}" if text else ""

    def part(self) -> None:
        """Ask it to end, by closing its standard input. Does not wait. Idempotent."""
        assert self._process.stdin is not None
        with suppress(OSError):
            self._process.stdin.close()

    def terminate(self) -> None:
        """Send it SIGTERM. Does not wait. Idempotent."""
        if self._ours:
            self._process.terminate()

    def kill(self) -> None:
        """Kill it. Does not wait. Idempotent."""
        if self._ours:
            self._process.kill()

    def wait(self, timeout_s: float | None = None) -> int | None:
        """Wait until it has ended; return its exit code, None if it still runs after ``timeout_s`` [s]."""
        with suppress(subprocess.TimeoutExpired):
            return self._process.wait(timeout_s)
        return None

    def end(self, grace_s: float = GRACE_S, harder_s: float = GRACE_S) -> None:
        """Ask it to end and wait; then terminate it, at last kill it. Idempotent.

        Args:
            grace_s: Time to end by itself [s].
            harder_s: Time to end when it was terminated [s].
        """
        if not self._ours:
            return
        self.part()
        if self.wait(grace_s) is None:
            self._process.terminate()
            if self.wait(harder_s) is None:
                self._process.kill()
                self._process.wait()

    def close(self, grace_s: float = GRACE_S, harder_s: float = GRACE_S) -> None:
        """End it as :meth:`end` does, and close its output, which nobody may be reading then. Idempotent."""
        if not self._ours:
            return  # and its output may be locked for ever by a thread that the fork left behind
        self.end(grace_s, harder_s)
        self.stdout.close()
        if self._errors is not None:
            self._last_words = self.last_words
            self._errors.close()


def on_parent_end(stop: Callable[[], object], descriptor: int = 0) -> None:
    """In a child: call ``stop`` when a pipe whose other end the parent holds has ended, on a thread of its own.

    Args:
        stop: What then ends the child.
        descriptor: The pipe's reading end; standard input as :class:`ChildProcess` has it.
    """

    def watch() -> None:
        with suppress(OSError):  # it can't be read: as good as gone
            while os.read(descriptor, 64):
                pass
        stop()

    threading.Thread(target=watch, name="skyloop-parent", daemon=True).start()
