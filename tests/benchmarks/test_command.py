"""The benchmarks' command lines, and what the page says of them and of ``skyloop bench``."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest
import typer
from typer.main import get_command

from benchmarks.command import BENCHMARKS, build, parse_numbers
from skyloop.cli.app import build as build_skyloop
from skyloop.errors import UsageError

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs" / "delays.md"


def test_numbers_of_observers() -> None:
    assert parse_numbers(None) == [1, 8, 32]
    assert parse_numbers("0, 4") == [0, 4]
    for text in ("", "x", "1,,2", "-1", "1000"):
        with pytest.raises(UsageError, match="--observers"):
            parse_numbers(text)


@pytest.mark.parametrize("name", list(BENCHMARKS))
def test_usage_errors_come_before_anything_is_measured(name: str) -> None:
    with pytest.raises(UsageError, match="give one of them"):
        build(name)(["--seconds", "1", "--minutes", "1"], standalone_mode=False)


@pytest.mark.process
def test_a_module_is_its_command_line() -> None:
    command = [sys.executable, "-m", "benchmarks.swarm", "--users", "2", "--drones", "1"]
    ended = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, timeout=60, check=False)
    assert ended.returncode == 2
    assert ended.stderr == "benchmarks.swarm: --users is 2, and there are only 1 drones to share\n"


def test_the_page_has_every_option() -> None:
    commands = [
        get_command(build_skyloop()).commands["bench"],  # type: ignore[attr-defined]
        *(get_command(build(name)) for name in BENCHMARKS),
    ]
    options = {
        name
        for command in commands
        for parameter in command.params
        if isinstance(parameter, typer.core.TyperOption)
        for name in (*parameter.opts, *parameter.secondary_opts)
    }
    described = set(re.findall(r"`(--[\w-]+)`", PAGE.read_text()))
    assert options - {"-h", "--help"} == described
    for name in BENCHMARKS:
        assert f"python -m benchmarks.{name}" in PAGE.read_text()
