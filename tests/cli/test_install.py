"""Optional parts: one command installs them in a checkout or from a wheel; all missing ones are named at once."""

from __future__ import annotations

import importlib.util
import pickle
import shutil
import subprocess
import sys
import tomllib
from types import SimpleNamespace

import pytest

from skyloop.cli import install
from skyloop.cli.app import run as run_app
from skyloop.cli.commands import COMMANDS, entry_of
from skyloop.errors import LinkError, MissingExtraError, SkyloopError, UnknownNameError, UnsupportedError
from tests.support.commands import Run
from tests.support.pages import ROOT

EXTRAS = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]


@pytest.mark.parametrize("extra", sorted(EXTRAS.keys() - {"all"}))
def test_a_part_consists_of_what_the_project_says(extra: str) -> None:
    def plain(requirement: str) -> str:
        return requirement.partition(";")[0].replace(" ", "")

    assert {plain(one) for one in install.requirements([extra])} == {plain(one) for one in EXTRAS[extra]}


def test_a_part_for_some_pythons_keeps_its_condition() -> None:
    (numba,) = (one for one in install.requirements(["fast"]) if one.startswith("numba"))
    assert "python_version <" in numba
    assert "extra" not in numba


def test_several_parts_are_installed_into_this_environment_each_requirement_once(
    run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls: list[list[str]] = []

    def called(command: list[str]) -> SimpleNamespace:
        calls.append(command)
        return SimpleNamespace(returncode=0)

    monkeypatch.setattr(subprocess, "run", called)
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: object())
    assert run("install", "sim", "vision").code == 0
    assert run("install", "--anew", "msp").code == 0
    assert calls[0][:4] == [sys.executable, "-m", "pip", "install"]
    assert sum("opencv" in word for word in calls[0]) == 1
    assert "--force-reinstall" in calls[1]


def test_the_requirements_can_be_listed_first(run: Run) -> None:
    ended = run("install", "--dry-run", "metrics", "parquet")
    assert ended.out.splitlines() == [*EXTRAS["metrics"], *EXTRAS["parquet"]]


def test_an_unknown_part_is_refused_with_those_that_exist(run: Run) -> None:
    ended = run("install", "visoin")
    assert ended.code == 2
    assert "visoin" in ended.err
    assert "vision" in ended.err
    with pytest.raises(UnknownNameError):
        install.requirements(["nothing"])


def test_failed_installations_are_reported(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(subprocess, "run", lambda command: SimpleNamespace(returncode=1))
    ended = run("install", "metrics")
    assert (ended.code, ended.err) == (1, "skyloop: metrics can't be installed: see above\n")


def test_an_environment_without_pip_takes_uv(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    monkeypatch.setattr(shutil, "which", lambda name: "/bin/uv")
    assert install._installer(False)[:3] == ["uv", "pip", "install"]
    monkeypatch.setattr(shutil, "which", lambda name: None)
    with pytest.raises(UnsupportedError, match="has no pip, and there is no uv"):
        install._installer(False)


def test_a_folder_that_was_never_installed_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    def requires(name: str) -> list[str]:
        raise ModuleNotFoundError(name)

    monkeypatch.setattr(install, "requires", requires)
    with pytest.raises(SkyloopError, match="never installed"):
        install.requirements(["sim"])


def test_all_missing_parts_are_named_at_once(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The demo named the missing parts one at a time, each after an installation."""
    monkeypatch.setattr(install, "_is_there", lambda module: module == "PIL")
    error = MissingExtraError("the simulator", "sim", cause="No module named 'cv2'")
    told: list[str] = []
    for raised in (error, LinkError(f"its proxy ended; its output:\n{error}")):

        def demo(*_: object, raised: Exception = raised, **__: object) -> None:
            raise raised

        with pytest.raises(SystemExit) as ended:
            run_app(demo, ["demo", "--seconds", "3"])  # type: ignore[arg-type]
        assert ended.value.code == 1
        told.append(capsys.readouterr().err)
    lacking = "the simulator needs an optional part that is not installed (No module named 'cv2')"
    assert told[0] == f"skyloop: {lacking}: skyloop install sim vision cockpit\n"
    assert told[1].endswith(f"\n{lacking}: skyloop install sim vision cockpit\n")
    assert install.with_all_missing(str(error), ()) == str(error)
    assert str(pickle.loads(pickle.dumps(error))) == str(error)


def test_libraries_that_no_module_imports_are_also_installed_with_a_part(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """``skyloop keys show`` ended with a traceback without cryptography."""

    def keys(*_: object, **__: object) -> None:
        raise ModuleNotFoundError("No module named 'cryptography'")

    monkeypatch.setattr(install, "_is_there", lambda module: module != "cryptography")
    with pytest.raises(SystemExit) as ended:
        run_app(keys, ["keys", "show"])  # type: ignore[arg-type]
    assert ended.value.code == 1
    assert capsys.readouterr().err == (
        "skyloop: skyloop keys needs an optional part that is not installed (No module named 'cryptography'): "
        "skyloop install network\n"
    )
    monkeypatch.setattr(install, "_is_there", lambda module: True)  # then it is our own mistake, shown in full
    with pytest.raises(ModuleNotFoundError):
        run_app(keys, ["keys", "show"])  # type: ignore[arg-type]


def test_the_parts_that_commands_need_exist() -> None:
    known = {extra for extra, _, _ in install.EXTRAS}
    for entry in COMMANDS.values():
        for each in (entry, *entry.behaviours.values()):
            assert set(each.extras) <= known


@pytest.mark.parametrize(
    ("words", "extras"),
    [
        (["fly", "follow", "--class", "car"], ("vision", "detect")),
        (["fly", "mine.py"], ("sim", "vision")),
        (["--verbose", "keys", "show"], ("network",)),
        (["nothing"], None),
        (["--help"], None),
    ],
)
def test_a_command_line_is_of_one_command(words: list[str], extras: tuple[str, ...] | None) -> None:
    entry = entry_of(words)
    assert (None if entry is None else entry.extras) == extras
