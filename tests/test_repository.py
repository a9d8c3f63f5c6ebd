"""What holds the repository together: the floors of coverage and the locked versions."""

from __future__ import annotations

import importlib.util
import re
import tomllib
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def floor() -> ModuleType:
    """The script that holds coverage against its floors."""
    spec = importlib.util.spec_from_file_location("coverage_floor", ROOT / "scripts" / "coverage_floor.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def report(total: float, **modules: float) -> dict[str, Any]:
    """What ``coverage json`` writes, of modules whose dots stand for slashes."""
    files = {
        f"src/skyloop/{name.replace('__', '/')}.py": {"summary": {"percent_covered": percent}, "missing_lines": [3, 5]}
        for name, percent in modules.items()
    }
    return {"totals": {"percent_covered": total}, "files": files}


def test_the_package_names_no_account_that_is_not_the_projects() -> None:
    text = (ROOT / "pyproject.toml").read_text()
    assert "github" not in text.lower()
    assert "urls" not in tomllib.loads(text)["project"]
    hooks = tomllib.loads(text)["tool"]["hatch"]["metadata"]["hooks"]["fancy-pypi-readme"]
    readme = (ROOT / "README.md").read_text()
    for each in hooks["substitutions"]:
        readme = re.sub(each["pattern"], each["replacement"], readme)
    assert not re.findall(r"\]\((?!https?://|#)[^)]*\)", readme), "relative links lead nowhere on the package's page"


def test_coverage_that_keeps_its_floors(floor: ModuleType) -> None:
    assert floor.failures(report(93.0, proxy__lease=90.0, cli__bench=12.0), {}) == []


def test_a_package_below_its_floor(floor: ModuleType) -> None:
    (found,) = floor.failures(report(92.9), {})
    assert "coverage of the package is 92.9 %, and must be at least 93 %" in found


def test_a_module_of_the_core_below_its_floor(floor: ModuleType) -> None:
    (found,) = floor.failures(report(95.0, transport__local__client=89.9), {})
    assert found == "coverage of transport/local/client.py is 89.9 %, and must be at least 90 %: 3, 5"


def test_an_exception_is_let_pass_until_it_is_none(floor: ModuleType) -> None:
    exceptions = {"keys/files.py": "a reason"}
    assert floor.failures(report(95.0, keys__files=80.0), exceptions) == []
    assert floor.obsolete(report(95.0, keys__files=80.0), exceptions) == []
    assert floor.failures(report(95.0, keys__files=91.0), exceptions) == []
    assert floor.obsolete(report(95.0, keys__files=91.0), exceptions) == ["keys/files.py"]


def test_exceptions_are_modules_that_exist(floor: ModuleType) -> None:
    assert [name for name in floor.EXCEPTIONS if not (ROOT / "src" / "skyloop" / name).is_file()] == []


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


def test_the_lock_file_names_no_place() -> None:
    assert not re.search(r"(?m)^-|://|@", (ROOT / "requirements-dev.lock").read_text())
