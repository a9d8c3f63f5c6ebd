"""``python -m benchmarks.learning``: a short run gives every figure. How fast is not asked."""

from __future__ import annotations

from pathlib import Path

import msgspec
import pytest
from typer.testing import CliRunner

pytest.importorskip("gymnasium")

from benchmarks import learning
from benchmarks.command import build


def test_the_command_measures_all_environments(tmp_path: Path) -> None:
    ended = CliRunner().invoke(
        build("learning"), ["--seconds", "0.5", "--output", str(tmp_path)], env={"COLUMNS": "120"}
    )
    assert ended.exit_code == 0, ended.output
    results = msgspec.json.decode((tmp_path / "learning.json").read_bytes(), type=learning.Learning)
    assert [(row.drones, row.pictures) for row in results.rows] == [tuple(case) for case in learning.CASES]
    for row in results.rows:
        assert row.step_us > 0.0
        assert (row.pictures_per_s is not None) == row.pictures
        if row.pictures_per_s is not None:
            assert row.real_time == pytest.approx(row.pictures_per_s * learning.STEP_S)
    assert "84×84" in ended.output
