from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest

from tests.host.fleet import Hosting


@pytest.fixture(autouse=True)
def runtime_dir(monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Use separate directories for sockets and state, with short paths."""
    with TemporaryDirectory(prefix="skyloop-") as directory:
        monkeypatch.setenv("SKYLOOP_RUNTIME_DIR", f"{directory}/run")
        monkeypatch.setenv("XDG_STATE_HOME", f"{directory}/state")
        monkeypatch.delenv("SKYLOOP_GROUP", raising=False)
        yield Path(directory) / "run"


@pytest.fixture
def hosting(runtime_dir: Path) -> Iterator[Hosting]:
    with Hosting() as hosting:
        yield hosting
