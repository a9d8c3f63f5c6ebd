"""These tests use their own directory of sockets. Those with the fixture ``side`` run for both of its sides."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest

from skyloop.transport.local.system import FAST, PORTABLE, TRANSPORT_VARIABLE, systems

BOTH = (FAST, PORTABLE)


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    if "side" in metafunc.fixturenames:
        only = metafunc.definition.get_closest_marker("side")
        lacking = pytest.mark.skipif(FAST not in systems(), reason="this system lacks the fast side")
        sides = [pytest.param(side, marks=[lacking] if side == FAST else []) for side in (only.args if only else BOTH)]
        metafunc.parametrize("side", sides, indirect=True)


@pytest.fixture
def side(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    """Choose the side of servers."""
    chosen: str = request.param
    monkeypatch.setenv(TRANSPORT_VARIABLE, "auto" if chosen == FAST else chosen)
    return chosen


@pytest.fixture(autouse=True)
def runtime_dir(monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Create an empty directory of sockets, with a short path."""
    with TemporaryDirectory(prefix="skyloop-") as directory:
        monkeypatch.setenv("SKYLOOP_RUNTIME_DIR", f"{directory}/run")
        monkeypatch.delenv("SKYLOOP_GROUP", raising=False)
        yield Path(directory) / "run"
