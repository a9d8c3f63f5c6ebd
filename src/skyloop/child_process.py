"""Run child processes that end with their parent, and protect objects after a fork.

A child's standard input is a pipe to which nothing is written, except on Windows. When the parent closes its end, or
dies for any reason, the child reads the end of file (:func:`on_parent_end`) and exits, too.

A child made by ``os.fork`` is different: it has copies of its parent's objects but not its threads, and destroying the
copies would destroy resources that the parent still uses (:func:`leave_to_parent`).
"""

from __future__ import annotations

import logging
import os
import signal
import subprocess
import sys
import tempfile
import threading
import weakref
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from typing import IO, Final, Protocol

from skyloop.platform import own_session, read_tail

GRACE_S: Final = 4.0  #: time limit for a child to exit on request, and again after it is terminated
_TAIL: Final = 2000  # bytes of a child's standard error that an error message shows
_CHECK_S: Final = 0.25  # how often to check a child that may hang silently
#: Time limit for reading a dead child's output, because a grandchild may keep the pipe open.
_DRAIN_S: Final = 1.0
#: Variable that passes data to a child. Only its user can read its environment, but all users can read command lines.
_HANDED: Final = "SKYLOOP_HANDED_OVER"
_TERMINATE: Final = b"terminate\n"  # on a child's standard input, on Windows
_log = logging.getLogger(__name__)


class LeftToParent(Protocol):
    """An object that belongs to the process that created it."""

    def forked(self) -> None:
        """In a child created by ``os.fork``: keep all later calls from touching the parent's resources.

        The child has no other threads, and locks that they held may never be released. Therefore acquire no locks.
        """


_left: Final[weakref.WeakSet[LeftToParent]] = weakref.WeakSet()
_left_lock: Final = threading.RLock()


def leave_to_parent(owner: LeftToParent) -> None:
    """Call ``owner.forked()`` in each child created by ``os.fork``, as long as ``owner`` is in use."""
    with _left_lock:
        _left.add(owner)


def _leave_all() -> None:
    _left_lock.release()
    for owner in list(_left):
        owner.forked()
    _left.clear()


if hasattr(os, "register_at_fork"):  # without fork, a child inherits nothing
    os.register_at_fork(before=_left_lock.acquire, after_in_parent=_left_lock.release, after_in_child=_leave_all)


class ChildProcess:
    """A child process in its own session: Ctrl-C in the terminal reaches only the parent. Thread-safe."""

    def __init__(
        self,
        command: Sequence[str],
        *,
        keep_errors: bool = True,
        inherited: Sequence[int] = (),
        handed: str | None = None,
    ) -> None:
        """Start the child.

        ``keep_errors``: whether to keep the child's standard error for :attr:`stderr_tail`; if False, it goes to the
        parent's standard error. ``inherited``: file descriptors that the child inherits. ``handed``: data for
        :func:`handed_over` that must not be on a command line, which all users can read.
        """
        self._errors: IO[bytes] | None = tempfile.TemporaryFile() if keep_errors else None  # noqa: SIM115
        self._stderr_tail = ""
        try:
            self._process = subprocess.Popen(
                command,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=self._errors,
                env=None if handed is None else {**os.environ, _HANDED: handed},
                **own_session(inherited),
            )
        except BaseException:
            if self._errors is not None:
                self._errors.close()
            raise
        assert self._process.stdout is not None
        self.pid = self._process.pid
        self.stdout: IO[bytes] = self._process.stdout  #: open until :meth:`close`
        self._ours = True
        leave_to_parent(self)

    def forked(self) -> None:
        """Leave the child to the process that started it; close our copy of the pipe that keeps it running."""
        self.part()
        self._ours = False

    @property
    def code(self) -> int | None:
        """Exit code, negative for a signal; None while the child runs."""
        return self._process.poll()

    @property
    def stderr_tail(self) -> str:
        """The end of the child's standard error."""
        if self._errors is None or self._errors.closed:
            return self._stderr_tail
        return read_tail(self._errors.fileno(), _TAIL).decode(errors="replace").strip()

    @property
    def ending(self) -> str:
        """How the child ended, phrased to follow its name."""
        code = self.code
        return f"was killed by signal {-code}" if code is not None and code < 0 else f"ended with exit code {code}"

    @property
    def quoted_output(self) -> str:
        """The end of the child's standard error, formatted to follow a message; empty if there is none."""
        text = self.stderr_tail
        return f"; its output:\n{text}" if text else ""

    def part(self) -> None:
        """Ask the child to exit, by closing its standard input. Does not wait. Idempotent."""
        assert self._process.stdin is not None
        with suppress(OSError):
            self._process.stdin.close()

    def terminate(self) -> None:
        """Send SIGTERM to the child; on Windows, make :func:`on_parent_end` raise it. Does not wait. Idempotent."""
        if self._ours and sys.platform == "win32":  # TerminateProcess would kill it, and its vehicle could not land
            assert self._process.stdin is not None
            with suppress(OSError, ValueError):  # it has ended, or was already asked to exit
                os.write(self._process.stdin.fileno(), _TERMINATE)
        elif self._ours:
            self._process.terminate()

    def kill(self) -> None:
        """Kill the child. Does not wait. Idempotent."""
        if self._ours:
            self._process.kill()

    def wait(self, timeout_s: float | None = None) -> int | None:
        """Wait until the child has ended; return its exit code, or None if it still runs after ``timeout_s`` [s]."""
        with suppress(subprocess.TimeoutExpired):
            return self._process.wait(timeout_s)
        return None

    def end(self, grace_s: float = GRACE_S, harder_s: float = GRACE_S) -> None:
        """Ask the child to exit and wait [s]; if necessary, terminate it and wait; finally, kill it. Idempotent."""
        if not self._ours:
            return
        self.part()
        if self.wait(grace_s) is None:
            self._process.terminate()
            if self.wait(harder_s) is None:
                self._process.kill()
                self._process.wait()

    def close(self, grace_s: float = GRACE_S, harder_s: float = GRACE_S) -> None:
        """End the child as :meth:`end` does, then close its output; no thread may still be reading it. Idempotent."""
        if not self._ours:
            return  # a thread that no longer exists after the fork may have locked its output
        self.end(grace_s, harder_s)
        self.stdout.close()
        self.close_errors()

    def close_errors(self) -> None:
        """Keep only the end of the child's standard error. Idempotent."""
        if self._errors is not None and not self._errors.closed:
            self._stderr_tail = self.stderr_tail
            self._errors.close()


class SignalEvent(threading.Event):
    """An event that a signal handler may set, even while the interrupted code waits for it or sets it."""

    def __init__(self) -> None:
        super().__init__()
        self._cond = threading.Condition(threading.RLock())  # with Event's own lock, the main thread would stop here


@contextmanager
def interrupt_deferred() -> Iterator[threading.Event]:
    """Make Ctrl-C set an event during the block, and raise :class:`KeyboardInterrupt` only at the end of the block.

    Used to end several flights: an exception after one of them would skip the rest. Does nothing outside the main
    thread, or if the program handles Ctrl-C itself.
    """
    noted = SignalEvent()
    on_main = threading.current_thread() is threading.main_thread()
    if not on_main or signal.getsignal(signal.SIGINT) is not signal.default_int_handler:
        yield noted
        return
    signal.signal(signal.SIGINT, lambda *_: noted.set())
    try:
        yield noted
    finally:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    if noted.is_set():
        raise KeyboardInterrupt


def handed_over() -> str | None:
    """Return the data that the parent passed outside the command line; None if there is none, or on later calls."""
    return os.environ.pop(_HANDED, None)


class RestartingChild:
    """Keeps one child running until :meth:`stop`, restarting it whenever it ends. Thread-safe.

    All decisions are made under one lock: no child starts after :meth:`request_stop`, and every child is ended.
    """

    def __init__(
        self,
        command: Sequence[str],
        *,
        name: str,
        read: Callable[[ChildProcess], object],
        ended: Callable[[ChildProcess | None, str], float | None],
        started: Callable[[ChildProcess], object] = lambda _: None,
        silent: Callable[[], bool] | None = None,
        keep_errors: bool = False,
        handed: str | None = None,
    ) -> None:
        """Prepare to run children; :meth:`start` starts the first one.

        Args:
            command: Command line of each child.
            name: Name of the threads.
            read: Reads a child's ``stdout`` to its end, on a separate thread per child.
            ended: Called with a readable description when a child has ended, or with None if a child could not be
                started. Returns the pause before the next start [s], or None to start no other child.
            started: Called with each child under the lock, before its output is read; must return quickly.
            silent: Returns whether the current child hangs and must be killed; called four times a second.
            keep_errors: See :class:`ChildProcess`.
            handed: See :class:`ChildProcess`.
        """
        self._command = command
        self._read = read
        self._ended = ended
        self._started = started
        self._silent = silent
        self._keep_errors = keep_errors
        self._handed = handed
        self._changed = threading.Condition(threading.RLock())
        self._stopping = False
        self._reader: threading.Thread | None = None
        self._name = name
        self._keeper = threading.Thread(target=self._keep, name=name, daemon=True)
        self.child: ChildProcess | None = None  #: the current or last child; None before the first one
        self.restarts = 0

    @property
    def stopping(self) -> bool:
        """Whether no more children will be started."""
        return self._stopping

    @property
    def over(self) -> bool:
        """Whether the last child has ended and no more children will be started."""
        return not self._keeper.is_alive()

    def start(self) -> None:
        """Start the first child; later calls do nothing. Raises ``OSError`` if it can't be started."""
        self._begin()
        self._keeper.start()

    def request_stop(self) -> ChildProcess | None:
        """Don't start any more children. Returns the current child, which keeps running. Does not wait. Idempotent."""
        with self._changed:
            self._stopping = True
            self._changed.notify_all()
            return self.child

    def stop(self, grace_s: float = GRACE_S, harder_s: float = GRACE_S) -> None:
        """End the current child as :meth:`ChildProcess.end` does, and start no more children. Idempotent."""
        child = self.request_stop()
        if child is not None:
            child.end(grace_s, harder_s)
        for thread in (self._keeper, self._reader):
            if thread is not None and thread.ident is not None and thread is not threading.current_thread():
                thread.join(_DRAIN_S if thread is self._reader else None)

    def _begin(self) -> ChildProcess | None:
        with self._changed:
            if self._stopping:
                return None
            child = self.child = ChildProcess(self._command, keep_errors=self._keep_errors, handed=self._handed)
            self._started(child)
        self._reader = threading.Thread(target=self._listen, args=(child,), name=f"{self._name}-output", daemon=True)
        self._reader.start()
        return child

    def _listen(self, child: ChildProcess) -> None:
        try:
            self._read(child)
        except Exception:  # noqa: BLE001  the child is replaced anyway
            _log.exception("killing a child process whose output can't be read")
            child.kill()
        finally:
            child.stdout.close()  # close it only here: closing a stream that another thread reads would block

    def _keep(self) -> None:
        child, ending = self.child, ""
        while True:
            if child is not None:
                ending = self._wait(child)
            pause_s = self._ended(child, ending)
            with self._changed:
                if pause_s is None or self._stopping or self._changed.wait_for(lambda: self._stopping, pause_s):
                    self._stopping = True
                    return
                self.restarts += 1
            try:
                child = self._begin()
            except OSError as error:  # memory or descriptors are exhausted for now
                child, ending = None, f"could not be started: {error}"
                continue
            if child is None:
                return

    def _wait(self, child: ChildProcess) -> str:
        """Wait until a child has ended and its output has been read; return how it ended, as readable text."""
        while child.wait(None if self._silent is None else _CHECK_S) is None:
            if self._silent is not None and self._silent():
                child.kill()
        reader = self._reader
        assert reader is not None
        reader.join(_DRAIN_S)
        child.part()
        child.close_errors()
        return child.ending


def on_parent_end(stop: Callable[[], object], descriptor: int = 0) -> None:
    """In a child: call ``stop`` on a separate thread when the parent's end of a pipe closes.

    On Windows, a line in the pipe raises SIGTERM (:meth:`ChildProcess.terminate`).

    ``descriptor`` is the reading end of the pipe; the default is standard input, as in a :class:`ChildProcess`.
    """

    def watch() -> None:
        with suppress(OSError):  # if the pipe can't be read, treat it as closed
            while data := os.read(descriptor, 64):
                if sys.platform == "win32" and _TERMINATE in data:  # perhaps several at once
                    signal.raise_signal(signal.SIGTERM)
        stop()

    threading.Thread(target=watch, name="skyloop-parent", daemon=True).start()
