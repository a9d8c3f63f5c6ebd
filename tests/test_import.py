"""``import skyloop`` is quick, and offers what it says."""

from __future__ import annotations

import importlib
import statistics
import subprocess
import sys

import pytest

import skyloop

MEASURE = "import time; t = time.perf_counter(); import skyloop; print(time.perf_counter() - t)"
LIMIT_S = 0.3


def run(code: str) -> str:
    return subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True, timeout=60).stdout


@pytest.mark.process
def test_import_is_quick() -> None:
    times = [float(run(MEASURE)) for _ in range(3)]
    assert statistics.median(times) <= LIMIT_S


@pytest.mark.process
def test_nothing_heavy_is_imported_before_it_is_used() -> None:
    code = (
        "import sys, skyloop; skyloop.connect; skyloop.Controller; "
        "heavy = {'cv2', 'av', 'typer', 'rich', 'skyloop.proxy', 'skyloop.drivers', 'skyloop.sim'}; "
        "print(sorted(heavy & set(sys.modules)))"
    )
    assert run(code).strip() == "[]"


@pytest.mark.parametrize("name", skyloop.__all__)
def test_every_name_is_there(name: str) -> None:
    assert getattr(skyloop, name) is not None
    assert name in dir(skyloop)


def test_names_are_those_of_their_homes() -> None:
    for home, names in skyloop._HOMES.items():
        for name in names:
            assert getattr(skyloop, name) is getattr(importlib.import_module(home), name)
            assert name in skyloop.__all__


def test_an_unknown_name() -> None:
    with pytest.raises(AttributeError, match="no attribute 'fly'"):
        _ = skyloop.fly


def test_version() -> None:
    assert skyloop.__version__[0].isdigit()
