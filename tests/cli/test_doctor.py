"""The doctor's findings, on this machine and on worse ones."""

from __future__ import annotations

import importlib
import io
import os
import sys
from collections.abc import Iterator
from types import ModuleType

import pytest

from skyloop.cli import doctor, main
from skyloop.cli.doctor import Finding, Health, as_text
from skyloop.errors import MissingExtraError
from tests.support.commands import Run
from tests.support.systems import PLATFORM


@pytest.fixture(autouse=True)
def _short(monkeypatch: pytest.MonkeyPatch) -> None:
    """Measure the import time, in two processes: once is enough."""

    def none() -> Iterator[Finding]:
        yield Finding("import skyloop", Health.GOOD, "")

    monkeypatch.setattr(doctor, "_import_time", none)


def lacking(monkeypatch: pytest.MonkeyPatch, name: str, error: ImportError) -> None:
    real = importlib.import_module

    def import_module(module: str) -> ModuleType:
        if module == name:
            raise error
        return real(module)

    monkeypatch.setattr("skyloop.cli.doctor.importlib.import_module", import_module)


def test_a_healthy_machine(run: Run) -> None:
    ended = run("doctor")
    assert ended.code == 0, ended.out
    assert "✓ Python: 3." in ended.out
    files = "sockets" if PLATFORM == "linux" else "registrations"
    assert f"{files} in {os.environ['SKYLOOP_RUNTIME_DIR']}" in ended.out
    assert "driver sim://: skyloop.vehicles.sim" in ended.out
    assert "✗" not in ended.out


@pytest.mark.parametrize("encoding", ["cp1252", "latin-1", "ascii", "utf-8"])
def test_missing_characters_of_a_terminal_are_replaced(encoding: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """It ended in UnicodeEncodeError if the terminal had no check mark."""
    findings = [Finding("part", health, "0.5 … 1 µs × Zoë at \udcff", "try → again") for health in Health]
    monkeypatch.setattr(doctor, "examine", lambda: iter(findings))
    out = io.TextIOWrapper(io.BytesIO(), encoding)
    monkeypatch.setattr(sys, "stdout", out)
    with pytest.raises(SystemExit):
        main(["doctor"])
    out.flush()
    lines = out.buffer.getvalue().decode(encoding).splitlines()
    mark = "✓" if encoding == "utf-8" else "ok"
    assert lines[0].startswith(f"{mark} part: 0.5 ")
    assert lines[0].endswith("Zoe at ?" if encoding == "ascii" else "Zoë at ?")
    assert lines[1] == ("  → try → again" if encoding == "utf-8" else "  -> try -> again")
    assert len(lines) == 6


def test_a_missing_part_is_listed_with_its_install_command(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    lacking(monkeypatch, "uvicorn", ModuleNotFoundError("No module named 'uvicorn'", name="uvicorn"))
    ended = run("doctor")
    assert ended.code == 0
    assert "– page in the browser [cockpit]: uvicorn not installed\n  → skyloop install cockpit" in ended.out


def test_several_missing_modules_are_listed_as_in_a_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor, "EXTRAS", (("record", "recordings", ("none1", "none2", "none3")),))
    (finding,) = doctor._extras()
    assert finding.detail == "none1, none2 and none3 not installed"


def test_a_check_without_its_optional_part_is_not_a_fault(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    def cameras() -> Iterator[Finding]:
        raise MissingExtraError("video://", "video", cause="No module named 'av'")
        yield

    monkeypatch.setattr(doctor, "_cameras", cameras)
    ended = run("doctor")
    assert ended.code == 0, ended.out
    assert "– cameras: video:// needs an optional part" in ended.out


def test_a_part_that_is_broken_is_a_fault(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    lacking(monkeypatch, "av", ImportError("libav.so: cannot open shared object file"))
    ended = run("doctor")
    assert ended.code == 1
    assert "✗ recorded video, H.264 [video]: av: libav.so: cannot open" in ended.out


def test_an_impossible_directory_is_a_fault(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SKYLOOP_RUNTIME_DIR", "/proc/none/run")
    ended = run("doctor")
    assert ended.code == 1
    assert "✗ local transport: /proc/none/run can't be created" in ended.out


def test_the_portable_transport_is_reported(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SKYLOOP_TRANSPORT", "portable")
    ended = run("doctor")
    assert ended.code == 0, ended.out
    assert "✓ local transport: portable: loopback TCP and named memory, registrations in" in ended.out
    monkeypatch.setenv("SKYLOOP_TRANSPORT", "fast")
    ended = run("doctor")
    assert ended.code == 1
    assert "✗ local transport: UsageError: SKYLOOP_TRANSPORT is 'fast'; it must be 'portable'" in ended.out


def test_a_driver_that_fails_to_load_is_a_separate_fault(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(scheme: str) -> type:
        raise RuntimeError(f"{scheme} is broken")

    monkeypatch.setattr("skyloop.drivers.registry.driver_class", broken)
    ended = run("doctor")
    assert ended.code == 1
    assert "✗ driver sim://: sim is broken" in ended.out
    assert "✓ recorded video" in ended.out


def test_findings_are_never_parsed_as_markup() -> None:
    assert str(as_text(Finding("a", Health.GOOD, "[bold]b[/]"))) == "✓ a: [bold]b[/]"
