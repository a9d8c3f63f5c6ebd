"""``make test`` gives the same answer each time, and ``make explore`` looks for another one."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from hypothesis import settings

from tests.conftest import EXPLORE_S

SEES = """
from hypothesis import given, settings, strategies as st
seen = []
@settings(max_examples=20)
@given(st.integers())
def test_property(number):
    seen.append(number)
def test_other(): pass
def teardown_module(): print("seen", seen)
"""


def test_properties_are_tested_with_the_same_examples() -> None:
    assert settings().derandomize == (not EXPLORE_S)


@pytest.mark.process
def test_exploring_looks_for_others(tmp_path: Path) -> None:
    """With the tests' own settings, in a separate folder."""
    (tmp_path / "conftest.py").write_bytes((Path(__file__).parents[1] / "conftest.py").read_bytes())
    (tmp_path / "test_it.py").write_text(SEES)

    def run(seconds: str) -> str:
        done = subprocess.run(
            [
                sys.executable,
                "-m",
                "pytest",
                "-q",
                "-s",
                "-p",
                "no:cacheprovider",
                f"--rootdir={tmp_path}",
                str(tmp_path),
            ],
            capture_output=True,
            text=True,
            cwd=tmp_path,
            env={**os.environ, "SKYLOOP_EXPLORE": seconds},
        )
        assert done.returncode == 0, done.stdout
        return next(line for line in done.stdout.splitlines() if "seen" in line)

    assert run("0") == run("0")
    assert run("60") != run("60")
