"""A simulated drone named ``alpha``, which the examples of the pages share."""

from __future__ import annotations

import select
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

STARTS_WITHIN_S = 20.0


@pytest.fixture(scope="package", autouse=True)
def sockets() -> Iterator[None]:
    """A directory of sockets for these tests alone."""
    with tempfile.TemporaryDirectory(prefix="skyloop-") as folder, pytest.MonkeyPatch.context() as patch:
        patch.setenv("SKYLOOP_RUNTIME_DIR", str(Path(folder) / "run"))
        yield


@pytest.fixture(scope="package")
def alpha(sockets: None) -> Iterator[str]:
    """A running proxy; ends with the tests."""
    command = [sys.executable, "-m", "skyloop", "proxy", "sim://", "--name", "alpha"]
    with subprocess.Popen(command, stdout=subprocess.PIPE) as process:
        try:
            assert process.stdout is not None
            ready, _, _ = select.select([process.stdout], [], [], STARTS_WITHIN_S)
            assert ready, "the proxy did not start"
            assert process.stdout.readline().startswith(b"ready")
            yield "alpha"
        finally:
            process.kill()
