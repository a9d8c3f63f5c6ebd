"""Run the cockpit as a child process, for programs that show a page while they do their own work."""

from __future__ import annotations

import json
import secrets
import sys
import time
import urllib.request
from pathlib import Path
from typing import Any, Self
from urllib.parse import urldefrag

from skyloop.child_process import ChildProcess
from skyloop.errors import LinkError
from skyloop.platform import read_within

_ASK_S = 2.0  # time limit for the cockpit's response


class CockpitProcess:
    """Runs ``python -m skyloop.cockpit [NAME]`` as a child process.

    The child ends on :meth:`close`, or when this process ends for any reason. It ignores Ctrl-C.
    """

    def __init__(self, name: str | None = None, port: int | None = 0, recordings: Path | None = None) -> None:
        """Start the child without waiting for the page; see :meth:`address`.

        ``name``: the proxy to show; by default, all proxies are shown. ``port``: the loopback port; 0 selects a free
        port, and None the default port or the next free one. ``recordings``: the folder for recordings.
        """
        names = [] if name is None else [name]
        options = [] if recordings is None else ["--recordings", str(recordings)]
        options += [] if port is None else ["--port", str(port)]
        command = [sys.executable, "-m", "skyloop.cockpit", *names, *options]
        self._token = secrets.token_urlsafe(24)  # for systems where the cockpit can't see whose program this is
        self._process = ChildProcess([*command, "--parent-fd", "0"], handed=self._token)
        self.pid = self._process.pid  #: the child's process id
        self._address: str | None = None

    def address(self, timeout_s: float = 15.0) -> str:
        """Wait until the page is served; return its address, with a pairing code where the cockpit pairs browsers.

        Raise ``LinkError`` if the page was not served in time or the child ended; the error contains its last line of
        standard error.
        """
        deadline = time.monotonic() + timeout_s
        line = b""
        while self._address is None:
            more = read_within(self._process.stdout, max(0.0, deadline - time.monotonic()))
            if not more:
                raise LinkError(f"the cockpit did not start: {self._complaint()}")
            line += more
            if b"\n" in line:
                self._address = line.split(b"\n")[0].decode().strip()
        return self._address

    def statistics(self) -> dict[str, Any]:
        """Return the counts of messages sent to the cockpit's pages, as in ``/api/statistics``."""
        try:
            address = f"{urldefrag(self.address()).url}api/statistics"
            request = urllib.request.Request(address, headers={"Authorization": f"Bearer {self._token}"})
            with urllib.request.urlopen(request, timeout=_ASK_S) as answer:
                values: dict[str, Any] = json.load(answer)
                return values
        except (OSError, ValueError) as error:
            raise LinkError(f"the cockpit does not answer: {error}") from error

    def close(self) -> None:
        """End the child and wait until it has ended. Idempotent."""
        self._process.close()

    def _complaint(self) -> str:
        """Return the last line of the child's standard error if it has ended."""
        code = self._process.wait(0.5)
        if code is None:
            return "no answer in time"
        return self._process.stderr_tail.rpartition("\n")[2] or f"it ended with exit code {code}"

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
