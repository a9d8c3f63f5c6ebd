"""Real proxies and applications as processes, with a separate directory for their sockets."""

from __future__ import annotations

import os
import select
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import IO

import pytest

STARTS_WITHIN_S = 20.0
PILOTS = str(Path(__file__).parents[1] / "integration" / "processes" / "pilots.py")  #: applications, started by name


@pytest.fixture(autouse=True)
def sockets(monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Provide a directory for this test's sockets, with a short path, because socket paths must be short."""
    with tempfile.TemporaryDirectory(prefix="skyloop-") as folder:
        monkeypatch.setenv("SKYLOOP_RUNTIME_DIR", str(Path(folder) / "run"))
        yield Path(folder) / "run"


class Process:
    """A child process on whose output a test can wait. It is always ended, by its process id.

    ``prefix`` is put before the interpreter, for example to enter a namespace, and must exec it.
    """

    def __init__(self, *arguments: str, prefix: Sequence[str] = ()) -> None:
        self.started_s = time.monotonic()
        self._popen = subprocess.Popen(
            [*prefix, sys.executable, *arguments], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, env={**os.environ}
        )
        self.text = ""

    @property
    def pid(self) -> int:
        return self._popen.pid

    def until(self, words: str, timeout_s: float = STARTS_WITHIN_S) -> None:
        """Read until the output contains these words."""
        stream: IO[bytes] | None = self._popen.stdout
        assert stream is not None
        deadline = time.monotonic() + timeout_s
        while words not in self.text:
            ready, _, _ = select.select([stream], [], [], max(0.0, deadline - time.monotonic()))
            assert ready, f"it did not say {words!r} within {timeout_s} s but: {self.text}"
            said = os.read(stream.fileno(), 4096)
            assert said, f"it ended without saying {words!r}: {self.text}"
            self.text += said.decode()

    def signal(self, number: signal.Signals) -> None:
        os.kill(self.pid, number)

    def wait(self, timeout_s: float = 30.0) -> int:
        return self._popen.wait(timeout_s)

    def end(self) -> None:
        if self._popen.poll() is None:
            os.kill(self.pid, signal.SIGCONT)
            os.kill(self.pid, signal.SIGKILL)
            self._popen.wait(10)
        if self._popen.stdout is not None:
            self._popen.stdout.close()


def in_terminal(*words: str, columns: int) -> str:
    """Run a ``skyloop`` command successfully in a terminal of this width; return what the terminal showed."""
    leader, follower = os.openpty()
    with subprocess.Popen(
        [sys.executable, "-m", "skyloop", *words],
        stdout=follower,
        stderr=follower,
        env={**os.environ, "TERM": "xterm", "COLUMNS": str(columns)},
    ) as process:
        os.close(follower)
        text = b""
        try:
            while said := os.read(leader, 4096):
                text += said
        except OSError:  # the other end of the terminal is closed
            pass
        assert process.wait(20) == 0, text.decode()
    os.close(leader)
    return text.decode()


@pytest.fixture
def start() -> Iterator[Callable[..., Process]]:
    """Provide a function that starts Python processes, which end with the test."""
    running: list[Process] = []

    def begin(*arguments: str) -> Process:
        process = Process(*arguments)
        running.append(process)
        return process

    yield begin
    for process in reversed(running):
        process.end()


@pytest.fixture
def proxy(start: Callable[..., Process]) -> Callable[..., Process]:
    """Provide a function that starts a proxy and waits until it serves."""

    def begin(uri: str = "sim://?world=empty&cameras=none", name: str = "alpha") -> Process:
        process = start("-m", "skyloop", "proxy", uri, "--name", name)
        process.until("ready")
        return process

    return begin


def eventually(condition: Callable[[], bool], what: str, timeout_s: float = 30.0) -> float:
    """Poll for a condition that nothing signals, up to this time; return how long it took [s]."""
    begin = time.monotonic()
    while not condition():
        assert time.monotonic() - begin < timeout_s, f"not within {timeout_s} s: {what}"
        time.sleep(0.002)
    return time.monotonic() - begin


def skyloop_command(*words: str, code: int = 0) -> str:
    """Run a ``skyloop`` command, check its exit code, and return its output."""
    ended = subprocess.run(
        [sys.executable, "-m", "skyloop", *words], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, timeout=60
    )
    assert ended.returncode == code, ended.stdout.decode()
    return ended.stdout.decode()


@contextmanager
def stopped(*pids: int) -> Iterator[None]:
    for pid in pids:
        os.kill(pid, signal.SIGSTOP)
    try:
        yield
    finally:
        for pid in pids:
            os.kill(pid, signal.SIGCONT)
