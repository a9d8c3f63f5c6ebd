"""Ten simulated drones, each flown by its own controller, all from this process."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

from benchmarks.swarm_flight import fly, missed
from tests.support.processes import Process

DRONES = 10


@pytest.fixture
def drones(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Ten of them in one world, with small pictures."""
    options = ("cameras=front", "width=64", "fps=5", "truth=0")
    arguments = [word for option in options for word in ("--option", option)]
    with tempfile.TemporaryDirectory(prefix="skyloop-") as folder:
        monkeypatch.setenv("SKYLOOP_RUNTIME_DIR", str(Path(folder) / "run"))
        process = Process(
            "-m", "skyloop", "sim", "--drones", str(DRONES), "--name", "drone", "--world", "empty", *arguments
        )
        try:
            process.until(f"ready drone{DRONES}", 60.0)
            yield
        finally:
            process.end()


@pytest.mark.process
def test_ten_drones_with_a_controller_each_from_one_process(drones: None) -> None:
    flights = fly("drone*", seconds=3.0, land_after_s=1.0)
    assert {flight.name for flight in flights} == {f"drone{number}" for number in range(1, DRONES + 1)}
    for flight in flights:
        assert flight.commands > 0
        assert flight.command is not None
        assert 0.0 < flight.command.median <= flight.command.maximum
        assert flight.feedback is not None
        assert flight.frames > 0
    assert missed(flights) == []
