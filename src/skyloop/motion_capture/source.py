"""Frames of a motion capture system from a child process, which is restarted when it dies."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Callable
from typing import BinaryIO, Final, cast

import msgspec

from skyloop.child_process import ChildProcess
from skyloop.errors import LinkError, MissingExtraError
from skyloop.motion_capture.address import System
from skyloop.motion_capture.worker import MISSING, RawFrame, read

#: Not ``-m``: the package imports the worker's module, of which Python would warn in each child.
WORKER: Final = (
    sys.executable,
    "-c",
    "import sys; from skyloop.motion_capture.worker import main; sys.exit(main(*sys.argv[1:]))",
)
AGAIN_S: Final = 0.5  #: pause before a child that ended is restarted
SILENT_S: Final = 3.0  #: a child that sends nothing for so long is killed: its system may have been restarted
FIRST_S: Final = 10.0  #: the same before its first frame


class ChildSource:
    """Runs :mod:`skyloop.motion_capture.worker` for a system and passes each frame on, on its own thread.

    A child that ends or falls silent is replaced until :meth:`close`.
    """

    def __init__(
        self,
        system: System,
        take: Callable[[RawFrame], None],
        trouble: Callable[[str], None],
        *,
        command: tuple[str, ...] = WORKER,
    ) -> None:
        """Initialise without starting the child.

        Args:
            system: The system to connect to.
            take: Called with each frame, on the reading thread.
            trouble: Called with a description when the child fails, on the reading thread.
            command: The child's command line, before kind and settings.
        """
        self._system = system
        self._take = take
        self._trouble = trouble
        self._command = command
        self._child: ChildProcess | None = None
        self._received_s = 0.0
        self._ended = threading.Event()
        self._first = threading.Event()
        self._failed: Exception | None = None
        self._last_words = ""  # the end of the last child's standard error
        self._reader = threading.Thread(target=self._run, name="skyloop-mocap", daemon=True)
        self._guard = threading.Thread(target=self._watch, name="skyloop-mocap-guard", daemon=True)

    @property
    def pid(self) -> int | None:
        """Process id of the child; None before the first."""
        return None if self._child is None else self._child.pid

    def start(self, timeout_s: float) -> None:
        """Start the child, and wait for the first frame.

        Args:
            timeout_s: How long to wait.

        Raises:
            LinkError: No frame came within that time.
            MissingExtraError: The ``motioncapture`` package is not installed.
        """
        self._reader.start()
        self._guard.start()
        if not self._first.wait(timeout_s) or self._failed is not None:
            failed, last_words = self._failed, self._last_words
            self.close()
            raise failed or LinkError(f"{self._system.address} sent no frame within {timeout_s:g} s{last_words}")

    def close(self) -> None:
        """End the child. Idempotent."""
        self._ended.set()
        self._kill()
        for thread in (self._reader, self._guard):
            if thread.ident is not None and thread is not threading.current_thread():
                thread.join()

    # --- threads ---

    def _run(self) -> None:
        while not self._ended.is_set():
            code = self._listen()
            if code == MISSING:
                cause = self._last_words.removeprefix(": ")
                self._failed = MissingExtraError(f"{self._system.kind} motion capture", "mocap", cause=cause)
                self._first.set()
                return
            if not self._ended.is_set():
                self._trouble(f"no data from {self._system.address}{self._last_words}; trying again")
            self._ended.wait(AGAIN_S)

    def _listen(self) -> int | None:
        """Run one child from its start to its end; return its exit code."""
        settings = msgspec.json.encode(self._system.configuration).decode()
        self._received_s = time.monotonic() + FIRST_S - SILENT_S
        child = self._child = ChildProcess([*self._command, self._system.kind, settings])
        if self._ended.is_set():  # closed between two children
            child.kill()
        try:
            while (frame := read(cast(BinaryIO, child.stdout))) is not None:
                self._received_s = time.monotonic()
                self._first.set()
                self._take(frame)
        except msgspec.DecodeError as error:
            self._trouble(f"{self._system.address}: {error}")
        finally:
            child.kill()
            child.close()
            self._last_words = f": {child.last_words}" if child.last_words else ""
        return child.code

    def _watch(self) -> None:
        """Kill a child that has fallen silent: the native code would wait for ever."""
        while not self._ended.wait(AGAIN_S):
            if time.monotonic() - self._received_s > SILENT_S:
                self._kill()

    def _kill(self) -> None:
        if self._child is not None:
            self._child.kill()
