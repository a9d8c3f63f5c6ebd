"""These tests use their own directory of sockets."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest


@pytest.fixture(autouse=True)
def runtime_dir(monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Create an empty directory of sockets, with a short path."""
    with TemporaryDirectory(prefix="skyloop-") as directory:
        monkeypatch.setenv("SKYLOOP_RUNTIME_DIR", f"{directory}/run")
        monkeypatch.delenv("SKYLOOP_GROUP", raising=False)
        yield Path(directory) / "run"
