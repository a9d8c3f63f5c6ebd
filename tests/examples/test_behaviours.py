"""The examples of behaviours, each run completely in simulated time."""

from __future__ import annotations

import importlib.util
import re
import sys
from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path

import pytest

import skyloop
from skyloop.client import Drone
from skyloop.stepping.rehearsal import rehearse

FOLDER = Path(__file__).parents[2] / "examples"
Run = Callable[[str], str]


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Run:
    """Runs an example unchanged, except for simulated time; returns its output."""

    def connect(target: str) -> AbstractContextManager[Drone]:
        return rehearse(target)

    def begin(name: str) -> str:
        spec = importlib.util.spec_from_file_location(Path(name).stem, FOLDER / f"{name}.py")
        assert spec is not None
        assert spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        monkeypatch.setitem(sys.modules, module.__name__, module)  # dataclasses look it up there
        spec.loader.exec_module(module)
        monkeypatch.setattr(skyloop, "connect", connect)
        module.main()
        return capsys.readouterr().out

    return begin


@pytest.mark.parametrize("name", ["fly_gates", "land_on_platform", "orbit_and_map", "approach", "follow_anything"])
def test_an_example_is_short_and_says_how_to_run_it(name: str) -> None:
    text = (FOLDER / f"{name}.py").read_text()
    assert len(text.splitlines()) < 60
    assert f"python examples/{name}.py" in text.split('"""')[1]


def test_gates(run: Run) -> None:
    printed = run("fly_gates")
    assert "through gate 1, next is gate 2" in printed
    assert printed.splitlines()[-1] == "passed 5 of 5 gates"


def test_landing(run: Run) -> None:
    printed = run("land_on_platform")
    assert "landed on the platform" in printed
    off = re.search(r"([\d.]+) m from the marker's centre", printed)
    assert off is not None
    assert float(off[1]) < 0.2


def test_map(run: Run) -> None:
    printed = run("orbit_and_map")
    places = {
        int(number): (float(x), float(y), float(z))
        for number, x, y, z in re.findall(r"marker (\d+): (-?[\d.]+) (-?[\d.]+) (-?[\d.]+), seen", printed)
    }
    walls = {10: (-1.2, 3.0, 1.5), 11: (4.0, 1.2, 1.5), 12: (0.2, -3.0, 1.5), 13: (-4.0, 1.9, 1.5)}
    assert len(places.keys() & walls.keys()) >= 3
    for number in places.keys() & walls.keys():
        assert places[number] == pytest.approx(walls[number], abs=0.3)


def test_approach(run: Run) -> None:
    printed = run("approach")
    assert "1.20 m before marker 12" in printed
    assert "swung to both sides" in printed.splitlines()


def test_see_and_avoid(run: Run) -> None:
    printed = run("behaviours/see_and_avoid")
    assert "and arrived" in printed
    assert "hit" not in printed


@pytest.mark.slow
def test_follow_anything(run: Run) -> None:
    printed = run("follow_anything")
    away = {mode: float(m) for mode, m in re.findall(r"(\w+): in view, ([\d.]+) m away", printed)}
    assert set(away) == {"follow", "orbit", "look"}
    assert away["follow"] == pytest.approx(4.0, abs=0.7)
    assert away["orbit"] == pytest.approx(4.0, abs=0.7)
    assert "lost" not in printed
