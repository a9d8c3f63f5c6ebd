"""Recordings shared by the tests."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from skyloop.cli import main
from tests.support.commands import Ended
from tests.support.recorded_flights import Plan, write_flight


@pytest.fixture(scope="session")
def flight(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two seconds of a drone with a camera, on all channels; do not modify."""
    return write_flight(tmp_path_factory.mktemp("flights") / "flight.mcap")


@pytest.fixture(scope="session")
def other_flight(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same flight with a more timid controller."""
    return write_flight(tmp_path_factory.mktemp("flights") / "other.mcap", Plan(gain=0.5))


@pytest.fixture
def log(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> Callable[..., Ended]:
    """Runs ``skyloop log ARGUMENTS`` in this process, in a wide terminal."""
    monkeypatch.setenv("COLUMNS", "200")

    def run(*arguments: str | Path) -> Ended:
        with pytest.raises(SystemExit) as ended:
            main(["log", *map(str, arguments)])
        code = ended.value.code
        assert code is None or isinstance(code, int)
        return Ended(code or 0, *capsys.readouterr())

    return run
