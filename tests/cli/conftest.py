"""The command line in this process or a separate one, beside real proxies in a separate directory of sockets."""

from __future__ import annotations

import os
import signal
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from skyloop.cli import main
from tests.support.commands import FAST_SIM, Ended, Run
from tests.support.processes import Process


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> Iterator[Run]:
    """Runs a command in this process, as ``skyloop ARGUMENTS`` would."""
    for variable in ("SKYLOOP_NETWORK", "SKYLOOP_KEYS"):  # --network and --keys set them for the whole process
        monkeypatch.setenv(variable, os.environ.get(variable, ""))
    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    path = list(sys.path)

    def runner(*arguments: str) -> Ended:
        with pytest.raises(SystemExit) as ended:
            main(list(arguments))
        code = ended.value.code
        assert code is None or isinstance(code, int)
        out, err = capsys.readouterr()
        return Ended(code or 0, out, err)

    yield runner
    sys.path[:] = path
    for number, handler in handlers.items():
        signal.signal(number, handler)


@pytest.fixture(scope="module", autouse=True)
def sockets() -> Iterator[Path]:
    """A separate directory of sockets for this module, with a short path, as sockets require."""
    with tempfile.TemporaryDirectory(prefix="skyloop-") as folder, pytest.MonkeyPatch.context() as patch:
        patch.setenv("SKYLOOP_RUNTIME_DIR", str(Path(folder) / "run"))
        patch.setattr("skyloop.transport.local.names_of_others", dict)  # ignore other users of this machine
        yield Path(folder) / "run"


@pytest.fixture
def start() -> Iterator[Callable[..., Process]]:
    """Starts ``skyloop ARGUMENTS`` in a separate process, which ends with the test."""
    running: list[Process] = []

    def begin(*arguments: str) -> Process:
        running.append(Process("-m", "skyloop", *arguments))
        return running[-1]

    yield begin
    for process in reversed(running):
        process.end()


@pytest.fixture(scope="module")
def alpha(sockets: Path) -> Iterator[Process]:
    """Start a proxy of that name, with a simulated drone at high speed."""
    process = Process("-m", "skyloop", "proxy", FAST_SIM, "--name", "alpha")
    try:
        process.until("ready")
        yield process
    finally:
        process.end()
