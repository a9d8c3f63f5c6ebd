"""Children that are ended by their own process id, and the resources they hold."""

from __future__ import annotations

import os
import select
import signal
import subprocess
import time
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Final

STARTS_WITHIN_S: Final = 60.0


class Process:
    """A child that is ended by its own process id."""

    def __init__(self, *command: str, log: Path, environment: dict[str, str]) -> None:
        self._said, self._log = "", log
        with log.open("ab") as errors:
            self._popen = subprocess.Popen(
                command,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=errors,
                env={**os.environ, **environment},
                start_new_session=True,
            )

    @property
    def pid(self) -> int:
        """Its process id."""
        return self._popen.pid

    @property
    def alive(self) -> bool:
        """Whether it runs, or is stopped."""
        return self._popen.poll() is None

    def until(self, word: str) -> str:
        """Wait for a word at its standard output; return all its output. ``RuntimeError`` if it does not appear."""
        stream = self._popen.stdout
        assert stream is not None
        deadline = time.monotonic() + STARTS_WITHIN_S
        while word not in self._said:
            ready, _, _ = select.select([stream], [], [], max(0.0, deadline - time.monotonic()))
            more = os.read(stream.fileno(), 4096) if ready else b""
            if not more:
                why = self._log.read_text(errors="replace")[-2000:]
                raise RuntimeError(f"{self._popen.args!r} did not say {word!r} but {self._said!r}; its log: {why}")
            self._said += more.decode()
        return self._said

    def order(self, line: str) -> None:
        """Write a line to its standard input."""
        assert self._popen.stdin is not None
        self._popen.stdin.write(f"{line}\n".encode())
        self._popen.stdin.flush()

    def signal(self, number: signal.Signals) -> None:
        """Send it a signal."""
        os.kill(self.pid, number)

    def kill(self) -> None:
        """Kill it and its children, and wait."""
        with suppress(ProcessLookupError):
            os.killpg(self.pid, signal.SIGKILL)
        self._popen.wait(10)
        for stream in (self._popen.stdin, self._popen.stdout):
            if stream is not None:
                stream.close()


@dataclass(frozen=True, slots=True)
class Resources:
    """The resources of a proxy."""

    descriptors: int
    threads: int
    memory_mb: float

    @classmethod
    def of(cls, pid: int) -> Resources:
        """Count them from the kernel's figures."""
        status = dict(line.split(":", 1) for line in Path(f"/proc/{pid}/status").read_text().splitlines())
        descriptors = len(list(Path(f"/proc/{pid}/fd").iterdir()))
        return cls(descriptors, int(status["Threads"]), int(status["VmRSS"].split()[0]) / 1024)
