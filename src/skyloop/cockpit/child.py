"""The cockpit as a child process, for a program that shows a page beside its own work."""

from __future__ import annotations

import json
import os
import select
import subprocess
import sys
import tempfile
import time
import urllib.request
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from skyloop.errors import LinkError

_END_S = 4.0  # to end by itself, before it is told to
_ASK_S = 2.0


class CockpitProcess:
    """Runs ``python -m skyloop.cockpit [NAME]`` as a child process.

    The child ends with :meth:`close`, and with this process however that ends. It has a session of its own: Ctrl-C in
    the terminal is for the parent.
    """

    def __init__(self, name: str | None = None, port: int = 0, recordings: Path | None = None) -> None:
        """Start the child; returns at once, see :meth:`address`.

        Args:
            name: The proxy to show (default: all).
            port: The port on loopback; 0 takes a free one.
            recordings: The folder for recordings.
        """
        self._said = tempfile.TemporaryFile()  # noqa: SIM115  (closed by close())
        reading, self._alive = os.pipe()
        names = [] if name is None else [name]
        folder = [] if recordings is None else ["--recordings", str(recordings)]
        try:
            self._process = subprocess.Popen(
                [
                    *(sys.executable, "-m", "skyloop.cockpit", *names, *folder),
                    *("--port", str(port), "--parent-fd", str(reading)),
                ],
                pass_fds=(reading,),
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=self._said,
                start_new_session=True,
            )
        except BaseException:
            os.close(self._alive)
            self._said.close()
            raise
        finally:
            os.close(reading)
        self._address: str | None = None

    @property
    def pid(self) -> int:
        """The child's process id."""
        return self._process.pid

    def address(self, timeout_s: float = 15.0) -> str:
        """Wait until the page is served.

        Args:
            timeout_s: How long to wait [s].

        Returns:
            The page's address.

        Raises:
            LinkError: It was not served in time, or the child ended; with the last line of its errors.
        """
        assert self._process.stdout is not None
        deadline = time.monotonic() + timeout_s
        line = b""
        while self._address is None:
            ready, _, _ = select.select([self._process.stdout], [], [], max(0.0, deadline - time.monotonic()))
            more = os.read(self._process.stdout.fileno(), 4096) if ready else b""
            if not more:
                raise LinkError(f"the cockpit did not start: {self._complaint()}")
            line += more
            if b"\n" in line:
                self._address = line.split(b"\n")[0].decode().strip()
        return self._address

    def statistics(self) -> dict[str, Any]:
        """Return what its pages were sent: see ``/api/statistics``.

        Raises:
            LinkError: It does not answer.
        """
        try:
            with urllib.request.urlopen(f"{self.address()}api/statistics", timeout=_ASK_S) as answer:
                values: dict[str, Any] = json.load(answer)
                return values
        except (OSError, ValueError) as error:
            raise LinkError(f"the cockpit does not answer: {error}") from error

    def close(self) -> None:
        """End the child and wait for it. Idempotent."""
        if self._alive < 0:
            return
        os.close(self._alive)
        self._alive = -1
        for harder in (self._process.terminate, self._process.kill):
            try:
                self._process.wait(_END_S)
            except subprocess.TimeoutExpired:
                harder()
        self._process.wait()
        if self._process.stdout is not None:
            self._process.stdout.close()
        self._said.close()

    def _complaint(self) -> str:
        """Return the last line that the child wrote to its standard error, if it has ended."""
        try:
            code = self._process.wait(0.5)
        except subprocess.TimeoutExpired:
            return "no answer in time"
        self._said.seek(0)
        lines = self._said.read().decode(errors="replace").strip().splitlines()
        return lines[-1] if lines else f"it ended with exit code {code}"

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()
