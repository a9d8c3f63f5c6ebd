"""Key files: failures name file and reason, and leave nothing behind."""

from __future__ import annotations

from pathlib import Path

import pytest

from skyloop.errors import UsageError
from skyloop.network.keys.files import make_directory, write


def test_a_directory_that_cannot_be_made(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(UsageError, match="can't be made"):
        make_directory(tmp_path / "file" / "keys")


def test_a_directory_that_is_open_to_others(tmp_path: Path) -> None:
    (tmp_path / "keys").mkdir(mode=0o755)
    with pytest.raises(UsageError, match="is open to others"):
        make_directory(tmp_path / "keys")


def test_a_file_that_cannot_be_written_leaves_nothing(tmp_path: Path) -> None:
    (tmp_path / "roster").mkdir()
    with pytest.raises(UsageError, match="can't be written"):
        write(tmp_path / "roster", b"x")
    assert [each.name for each in tmp_path.iterdir()] == ["roster"]
