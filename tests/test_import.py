"""``import skyloop`` is quick, and provides its documented names."""

from __future__ import annotations

import ast
import importlib
import statistics
import subprocess
import sys
from pathlib import Path

import pytest

import skyloop

MEASURE = "import time; t = time.perf_counter(); import skyloop; print(time.perf_counter() - t)"
LIMIT_S = 0.3
NAMES: list[str] = vars(skyloop)["__all__"]  # type checkers read the stub, which needs none


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


@pytest.mark.parametrize("name", NAMES)
def test_every_name_is_there(name: str) -> None:
    assert getattr(skyloop, name) is not None
    assert name in dir(skyloop)


def test_names_match_their_home_modules() -> None:
    homes = {name: home for name, home in _stub_names() if home != "skyloop"}
    assert {*homes, "aio", "__version__"} == set(NAMES)
    for name, home in homes.items():
        assert getattr(skyloop, name) is getattr(importlib.import_module(home), name)


def _stub_names() -> list[tuple[str, str]]:
    """(name, module) of every import of the stub, read as Python reads it."""
    stub = Path(skyloop.__file__).with_suffix(".pyi")
    imports = [one for one in ast.parse(stub.read_text()).body if isinstance(one, ast.ImportFrom)]
    return [(alias.asname or alias.name, one.module or "") for one in imports for alias in one.names]


def test_there_are_few_names() -> None:
    assert len(NAMES) <= 36


@pytest.mark.parametrize("name", ["fly", "Fly", "_fly", "__wrapped__"])
def test_an_unknown_name(name: str) -> None:
    with pytest.raises(AttributeError, match=f"no attribute '{name}'$"):
        getattr(skyloop, name)


@pytest.mark.parametrize(
    ("name", "home"),
    [
        ("ParameterError", "errors"),
        ("Hover", "messages"),
        ("AuthorityStatus", "client"),
        ("RunSummary", "control"),
        ("Recorder", "recording"),
        ("MotionCapture", "motion_capture"),
    ],
)
def test_a_name_that_is_elsewhere_says_where(name: str, home: str) -> None:
    with pytest.raises(AttributeError, match=rf"from skyloop\.{home} import {name}"):
        getattr(skyloop, name)


def test_version() -> None:
    assert skyloop.__version__[0].isdigit()


@pytest.mark.parametrize("name", ["layout", "pictures", "reader"])
def test_recordings_can_be_read_by_the_former_import_path_too(name: str) -> None:
    former = importlib.import_module(f"skyloop.logfile.{name}")
    assert former is importlib.import_module(f"skyloop.recording.{name}")
