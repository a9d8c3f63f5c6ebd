"""``dev.py``, which sets up a checkout where there is no make as well."""

from __future__ import annotations

import os
import runpy
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


def dev(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, ROOT / "dev.py", *arguments], capture_output=True, text=True, check=False)


@pytest.mark.parametrize(("arguments", "code"), [(["--help"], 0), ([], 0), (["fly"], 2), (["install", "all"], 2)])
def test_help_shows_each_command_with_an_example(arguments: list[str], code: int) -> None:
    answer = dev(*arguments)
    assert answer.returncode == code
    for example in ("dev.py demo --seconds 30", "dev.py test -k authority", "dev.py install dev"):
        assert example in answer.stdout


def test_it_says_which_python_it_needs() -> None:
    old = "import runpy, sys; sys.version_info = (3, 10, 1); runpy.run_path('dev.py', run_name='__main__')"
    answer = subprocess.run([sys.executable, "-c", old], cwd=ROOT, capture_output=True, text=True, check=False)
    assert answer.returncode == 1
    assert "needs Python 3.11 or newer" in answer.stderr


def test_a_stamp_is_old_if_what_it_depends_on_is_newer(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    names = runpy.run_path(str(ROOT / "dev.py"))
    is_old, demo, dev_stamp = names["is_old"], names["DEMO"], names["DEV"]
    demo.parent.mkdir()
    for name in ("pyproject.toml", "requirements-dev.txt", names["LOCK"]):
        (tmp_path / name).touch()
    assert is_old(demo)
    demo.touch()
    assert not is_old(demo)
    assert is_old(dev_stamp)
    dev_stamp.touch()
    assert not is_old(dev_stamp)
    os.utime("requirements-dev.txt", (2**31, 2**31))
    assert is_old(dev_stamp)
    assert not is_old(demo)
