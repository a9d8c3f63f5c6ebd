"""Checks of the repository: coverage floors, budgets of rooms and paths, and locked versions."""

from __future__ import annotations

import importlib.util
import json
import re
import subprocess
import sys
import tomllib
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).parents[1]


def script(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(name, ROOT / "scripts" / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = sys.modules[name] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def floor() -> ModuleType:
    """The script that holds coverage against its floors."""
    return script("coverage_floor")


@pytest.fixture(scope="module")
def gauge() -> ModuleType:
    """The script that measures rooms."""
    return script("house")


@pytest.fixture(scope="module")
def tracer() -> ModuleType:
    """The script that traces paths."""
    return script("paths")


def report(**modules: float) -> dict[str, Any]:
    """Return a report as written by ``coverage json``; dots in the names of modules replace slashes."""
    files = {
        f"src/skyloop/{name.replace('__', '/')}.py": {"summary": {"percent_covered": percent}, "missing_lines": [3, 5]}
        for name, percent in modules.items()
    }
    return {"files": files}


def test_the_package_names_no_foreign_accounts() -> None:
    text = (ROOT / "pyproject.toml").read_text()
    assert "github" not in text.lower()
    assert "urls" not in tomllib.loads(text)["project"]
    hooks = tomllib.loads(text)["tool"]["hatch"]["metadata"]["hooks"]["fancy-pypi-readme"]
    readme = (ROOT / "README.md").read_text()
    for each in hooks["substitutions"]:
        readme = re.sub(each["pattern"], each["replacement"], readme)
    assert not re.findall(r"\]\((?!https?://|#)[^)]*\)", readme), "relative links lead nowhere on the package's page"


def test_coverage_that_keeps_its_floors(floor: ModuleType) -> None:
    assert floor.failures(report(proxy__lease=90.0, cli__bench=12.0), {}) == []


def test_every_module_with_a_floor_is_measured_and_reported(floor: ModuleType) -> None:
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["coverage"]
    rooms = {pattern.split("/")[2] for pattern in settings["report"]["include"]}
    assert rooms == set(floor.CORE)
    for pattern in settings["run"]["omit"]:
        parts = set(pattern.strip("*/").split("/"))
        assert parts & floor.NO_CORE or not parts & set(floor.CORE), pattern


def test_a_module_of_the_core_below_its_floor(floor: ModuleType) -> None:
    (found,) = floor.failures(report(transport__local__client=89.9), {})
    assert found == "coverage of transport/local/client.py is 89.9 %, and must be at least 90 %: 3, 5"


def test_an_exception_may_miss_the_floor_until_it_reaches_it(floor: ModuleType) -> None:
    exceptions = {"network/keys/files.py": "a reason"}
    assert floor.failures(report(network__keys__files=80.0), exceptions) == []
    assert floor.obsolete(report(network__keys__files=80.0), exceptions) == []
    assert floor.failures(report(network__keys__files=91.0), exceptions) == []
    assert floor.obsolete(report(network__keys__files=91.0), exceptions) == ["network/keys/files.py"]


def test_exceptions_are_modules_that_exist(floor: ModuleType) -> None:
    assert [name for name in floor.EXCEPTIONS if not (ROOT / "src" / "skyloop" / name).is_file()] == []


MODULE = '''"""Documented
over two lines."""

from typing import TYPE_CHECKING

import p.a
from p import b, name  # of p/__init__.py

if TYPE_CHECKING:
    from p.c import C


@decorated
class Small:
    """One."""

    def method(self) -> int:
        from p.d import D

        # a comment
        return self._core + (
            1
        )
'''


def test_the_figures_of_a_module(gauge: ModuleType) -> None:
    known = {"p", "p.a", "p.b", "p.c", "p.d", "p.e"}
    found = gauge.measure_file("p.e", MODULE, "control", known)
    assert (found.lines, found.code, found.import_lines, found.core_uses) == (23, 12, 5, 1)
    assert (found.functions, found.classes) == ([7], [10])
    assert found.imports == {"p", "p.a", "p.b", "p.c", "p.d"}
    assert found.chained == {"p", "p.a", "p.b"}
    assert gauge.measure_file("p.e", MODULE, "client", known).core_uses == 0
    assert gauge.measure_file("skyloop.extend", MODULE, "(top)", known).core_uses == 0


@pytest.mark.parametrize(
    ("path", "room"),
    [
        ("errors.py", "(top)"),
        ("proxy/core/flight.py", "proxy"),
        ("drivers/base.py", "drivers"),
        ("vehicles/msp/driver.py", "vehicles/msp"),
        ("vehicles/msp/wire/frames.py", "vehicles/msp"),
        ("transport/local/client.py", "transport"),
        ("network/keys/lab.py", "network"),
    ],
)
def test_rooms(gauge: ModuleType, path: str, room: str) -> None:
    assert gauge.room_of(Path(path)) == room


def test_the_figures_of_rooms(gauge: ModuleType) -> None:
    names = {"p", "p.x", "p.y"}
    texts = {"p": ("(top)", ""), "p.x": ("client", "import p.y\n"), "p.y": ("sim", "import p\n\n\n")}
    rows = gauge.house({name: gauge.measure_file(name, text, room, names) for name, (room, text) in texts.items()})
    assert list(rows) == ["(top)", "client", "sim", "core", "house"]
    assert [rows[room]["chain"] for room in rows] == [1, 3, 2, 3, 3]
    assert [rows["house"][key] for key in ("files", "lines", "imports", "share", "one importer")] == [3, 4, 2, 0.5, 2]
    assert rows["core"]["files"] == 1


def test_a_room_over_its_budget(gauge: ModuleType) -> None:
    rows = {"sim": {"files": 3, "lines": 10}, "new": {"files": 1}}
    budgets = {"sim": {"files": 3, "lines": 9}, "gone": {"files": 1}}
    assert gauge.over(rows, budgets) == [
        "new has no budget",
        "gone is gone: remove its budget",
        "sim: lines is 10, the budget is 9",
    ]


def test_the_figures_of_a_path(tracer: ModuleType) -> None:
    path = [tracer.Call("", file, "f") for file in ("a", "a", "b", "a", "c", "b", "b")]
    assert tracer.figures(path) == {"files": 3, "calls": 7, "returns": 2}
    measured = {name: tracer.figures(path) for name in tracer.THREADS if name != "frame"}
    assert tracer.over(measured, {"death": {"files": 3, "returns": 1}}) == [
        "frame was not complete in any run",
        "death: returns are 2, the budget is 1",
    ]


@pytest.mark.process
def test_each_path_is_seen_to_its_end() -> None:
    command = [sys.executable, str(ROOT / "scripts" / "paths.py"), "--json"]
    paths = json.loads(subprocess.run(command, check=True, capture_output=True, text=True, timeout=100).stdout)
    assert {name: {file.split("/")[0] for _, file, _ in each["path"]} for name, each in paths.items()} == {
        "velocity": {"client", "clock.py", "drivers", "messages", "proxy", "sim", "transport", "vehicles", "zones.py"},
        "frame": {"client", "messages", "proxy", "sim", "transport", "vehicles"},
        "parameter": {"client", "clock.py", "drivers", "messages", "proxy", "sim", "transport", "vehicles"},
        "death": {"drivers", "messages", "proxy", "sim", "transport", "vehicles"},
    }


def locked() -> dict[str, set[str]]:
    lines = (ROOT / "requirements-dev.lock").read_text().splitlines()
    found: dict[str, set[str]] = {}
    for line in lines:
        if line and not line.startswith("#"):
            requirement = Requirement(line)
            (pinned,) = requirement.specifier
            assert pinned.operator == "==", line
            found.setdefault(canonicalize_name(requirement.name), set()).add(pinned.version)
    return found


def test_the_lock_file_has_a_version_that_fits_for_each_requirement() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    all_of = Requirement(project["optional-dependencies"]["all"][0]).extras
    wanted = [*project["dependencies"], *(ROOT / "requirements-dev.txt").read_text().splitlines()]
    wanted += [each for extra in all_of for each in project["optional-dependencies"][extra]]
    versions = locked()
    for requirement in map(Requirement, wanted):
        fits = versions.get(canonicalize_name(requirement.name), set())
        assert fits, f"{requirement} is not locked: make lock"
        assert all(requirement.specifier.contains(version) for version in fits), f"{requirement}, {fits}: make lock"


def test_the_lock_file_names_no_index_or_path() -> None:
    assert not re.search(r"(?m)^-|://|@", (ROOT / "requirements-dev.lock").read_text())
