"""A directory of sockets for the tests that start processes."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest


@pytest.fixture(scope="package", autouse=True)
def sockets() -> Iterator[None]:
    with tempfile.TemporaryDirectory(prefix="skyloop-") as folder, pytest.MonkeyPatch.context() as patch:
        patch.setenv("SKYLOOP_RUNTIME_DIR", str(Path(folder) / "run"))
        yield
