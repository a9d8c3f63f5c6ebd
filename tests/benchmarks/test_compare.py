"""``python -m benchmarks.compare``: figures of two runs side by side, as multiples of the floor."""

from __future__ import annotations

from pathlib import Path

import msgspec
import pytest
from typer.testing import CliRunner

from benchmarks import compare
from benchmarks.measuring import delays
from benchmarks.pages.delays import MEASURED
from skyloop.errors import FileFormatError, UsageError


def slower(folder: Path, factor: float, contender: str, share: float = 1.0) -> Path:
    """A run as the one on the page, with some of its figures multiplied."""

    def changed(cell: delays.Cell) -> delays.Cell:
        by = share * (factor if cell.contender == contender else 1.0)
        summary = msgspec.structs.replace(
            cell.summary, median_us=cell.summary.median_us * by, p99_us=cell.summary.p99_us * by
        )
        return msgspec.structs.replace(cell, summary=summary)

    results = delays.load(MEASURED / "delays.json")
    cells = [changed(cell) for cell in results.cells]
    (folder / "delays.json").write_bytes(msgspec.json.encode(msgspec.structs.replace(results, cells=cells)))
    return folder


def test_a_machine_that_is_slower_in_all_changes_nothing(tmp_path: Path) -> None:
    changes = compare.compare(slower(tmp_path, 1.0, "skyloop", share=3.0), MEASURED)
    assert len(changes) >= 12
    assert all(change.ratio == pytest.approx(1.0) for change in changes)
    assert not any(change.worse for change in changes)


def test_a_loss_shows(tmp_path: Path) -> None:
    changes = compare.compare(slower(tmp_path, 1.3, "skyloop"), MEASURED)
    medians = [change for change in changes if change.what.endswith("median")]
    assert medians
    assert all(change.worse and change.ratio == pytest.approx(1.3) for change in medians)
    assert not any(change.worse for change in changes if "99th" in change.what)


def test_the_command_prints_a_table_and_fails_for_a_loss(tmp_path: Path) -> None:
    app = compare.build()
    found = CliRunner().invoke(app, [str(slower(tmp_path, 1.3, "skyloop"))])
    assert found.exit_code == 1
    assert "slower" in found.output
    same = CliRunner().invoke(app, [str(MEASURED)])
    assert same.exit_code == 0
    assert "slower" not in same.output


def test_folders_with_nothing_in_common_and_damaged_files_are_errors(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="nothing to compare"):
        compare.compare(tmp_path, MEASURED)
    (tmp_path / "delays.json").write_text("{}")
    with pytest.raises(FileFormatError):
        compare.compare(tmp_path, MEASURED)
