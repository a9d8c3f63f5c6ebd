"""``python -m benchmarks.recordings``: a short flight gives every figure. How fast is not asked."""

from __future__ import annotations

from pathlib import Path

import msgspec
from typer.testing import CliRunner

from benchmarks import recordings
from benchmarks.command import build


def test_the_command_measures_what_is_done_with_a_recording(tmp_path: Path) -> None:
    ended = CliRunner().invoke(
        build("recordings"), ["--seconds", "1", "--output", str(tmp_path)], env={"COLUMNS": "120"}
    )
    assert ended.exit_code == 0, ended.output
    results = msgspec.json.decode((tmp_path / "recordings.json").read_bytes(), type=recordings.Recordings)
    assert (results.seconds, results.frames) == (1.0, recordings.FPS)
    assert results.bytes > 10_000
    assert len(results.rows) == 7
    assert all(row.passed_s > 0.0 for row in results.rows)
    assert [row.what for row in results.rows if row.target_s is not None] == ["log export --to mp4"]
    assert "30 frames of H.264" in ended.output
