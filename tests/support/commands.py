"""Commands of ``skyloop``, and how they end."""

from __future__ import annotations

import os
import re
import select
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from typing import NamedTuple, Self

FAST_SIM = "sim://?world=empty&cameras=none&speed=6&wind=0"


class Ended(NamedTuple):
    """How a command ended."""

    code: int
    out: str
    err: str


Run = Callable[..., Ended]


DEMO = [sys.executable, "-m", "skyloop", "demo"]


class Running:
    """A demo as a child process, read as it prints."""

    def __init__(self, *options: str, command: Sequence[str] = DEMO) -> None:
        self.process = subprocess.Popen([*command, *options], stdout=subprocess.PIPE, stderr=subprocess.STDOUT)
        self.text = ""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.process.kill()
        self.process.wait()
        assert self.process.stdout is not None
        self.process.stdout.close()

    def until(self, pattern: str, timeout_s: float) -> re.Match[str]:
        """Read until it printed this; never waits longer than asked."""
        assert self.process.stdout is not None
        deadline = time.monotonic() + timeout_s
        while (found := re.search(pattern, self.text)) is None:
            left = deadline - time.monotonic()
            assert left > 0, f"no {pattern!r} in time; it said: {self.text}"
            if select.select([self.process.stdout], [], [], left)[0]:
                more = os.read(self.process.stdout.fileno(), 4096).decode()
                assert more, f"it ended without {pattern!r}; it said: {self.text}"
                self.text += more
        return found
