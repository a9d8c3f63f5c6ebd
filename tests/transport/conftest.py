"""Sockets of these tests lie in a directory of their own."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest


@pytest.fixture(autouse=True)
def runtime_dir(monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """An empty directory of sockets, with a short path."""
    with TemporaryDirectory(prefix="skyloop-") as directory:
        monkeypatch.setenv("SKYLOOP_RUNTIME_DIR", f"{directory}/run")
        monkeypatch.delenv("SKYLOOP_GROUP", raising=False)
        yield Path(directory) / "run"
