"""``skyloop bench sim``: a short run gives every figure, and they fit together. How fast is not asked here."""

from __future__ import annotations

from pathlib import Path

import cv2
import msgspec
import pytest
import typer
from typer.testing import CliRunner

from skyloop.bench import sim
from skyloop.bench.statistics import Spread
from skyloop.cli.bench import bench, drawing_table, physics_table
from skyloop.sim import STEP_S

SHORT_S = 0.3


@pytest.fixture(scope="module")
def measured() -> tuple[sim.SimResults, list[float]]:
    shares: list[float] = []
    return sim.measure(SHORT_S, shares.append), shares


def assert_plausible(spread: Spread) -> None:
    assert spread.samples >= sim.LEAST_ROUNDS
    assert 0 < spread.median_us <= spread.p99_us < 60e6


def test_physics_is_measured_for_each_fleet(measured: tuple[sim.SimResults, list[float]]) -> None:
    rows = measured[0].physics
    assert [(row.world, row.drones, row.model, row.firmware) for row in rows] == [
        ("empty", 1, "quadrotor", False),
        ("empty", 10, "quadrotor", False),
        ("empty", 100, "quadrotor", False),
        ("gates", 100, "quadrotor", False),
        ("empty", 1, "racer", True),
        ("street", 1, "racer", True),
        ("empty", 100, "crazyflie", False),
    ]
    assert [row.target for row in rows] == [100.0, None, 20.0, 20.0, 1000 / 60, 1000 / 60, 1.0]
    for row in rows:
        assert_plausible(row.step)
        # Half of the batches took the median or longer, so all together took at least half of that each.
        assert 0 < row.real_time <= 2.01 * STEP_S * 1e6 / row.step.median_us


def test_drawing_is_measured_for_each_camera_and_size(measured: tuple[sim.SimResults, list[float]]) -> None:
    rows = measured[0].drawing
    assert [(row.cameras, row.width, row.height, row.pictures) for row in rows] == [
        ("front", 320, 240, 1),
        ("bottom", 320, 240, 1),
        ("front and bottom", 320, 240, 2),
        ("front", 640, 480, 1),
        ("bottom", 640, 480, 1),
        ("front and bottom", 640, 480, 2),
        ("10 × front", 320, 240, 10),
    ]
    assert [row.target for row in rows if row.target is not None] == [312.0, 91.0, 250.0]
    for row in rows:
        assert_plausible(row.round)
        assert row.frames_per_s > 0
    for front, bottom, both in (rows[:3], rows[3:6]):
        # The time for both is the sum of the times for each, so two pictures take what the two rates say.
        assert 2 / both.frames_per_s == pytest.approx(1 / front.frames_per_s + 1 / bottom.frames_per_s)


def test_progress_rises_to_the_end(measured: tuple[sim.SimResults, list[float]]) -> None:
    shares = measured[1]
    assert shares == sorted(shares)
    assert 0 < shares[0] < 1
    assert shares[-1] == pytest.approx(1.0)


def test_opencv_gets_its_threads_back() -> None:
    before = cv2.getNumThreads()
    with sim._one_core():
        assert cv2.getNumThreads() == 1
    assert cv2.getNumThreads() == before


def test_tables_name_the_targets(measured: tuple[sim.SimResults, list[float]]) -> None:
    physics, drawing = physics_table(measured[0]), drawing_table(measured[0])
    assert list(physics.columns[5].cells) == [*("≥ 100 ×", "", "≥ 20 ×", "≥ 20 ×", "≥ 16.7 ×", "≥ 16.7 ×", "≥ 1 ×")]
    assert [cell for cell in drawing.columns[4].cells if cell] == ["≥ 312", "≥ 91", "≥ 250"]
    assert physics.row_count == 7
    assert drawing.row_count == 7


def test_the_command_prints_and_writes_json(
    measured: tuple[sim.SimResults, list[float]], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    asked: list[float] = []

    def known(seconds: float, progress: sim.Progress) -> sim.SimResults:
        asked.append(seconds)
        progress(1.0)
        return measured[0]

    monkeypatch.setattr(sim, "measure", known)
    app = typer.Typer()
    app.command()(bench)
    result = CliRunner().invoke(app, ["sim", "--seconds", "5", "--output", str(tmp_path)], env={"COLUMNS": "120"})
    assert result.exit_code == 0, result.output
    assert asked == [5.0]
    assert "Physics alone" in result.output
    assert "10 × front" in result.output
    assert msgspec.json.decode((tmp_path / "sim.json").read_bytes(), type=sim.SimResults) == measured[0]
