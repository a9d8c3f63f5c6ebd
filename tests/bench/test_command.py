"""``skyloop bench`` on the command line: its options, and what the page says of them."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import typer
from typer.main import get_command

from skyloop.bench.schedule import MIDDLE, SMALL, Size
from skyloop.cli.app import build
from skyloop.cli.bench import What, check_options, parse_numbers, parse_sizes
from skyloop.errors import UsageError

PAGE = Path(__file__).parents[2] / "docs" / "delays.md"


def test_sizes() -> None:
    assert parse_sizes(None) == [SMALL]
    assert parse_sizes("640x480, 320×240,640x480") == [MIDDLE, SMALL]
    assert parse_sizes("16x16") == [Size(16, 16)]


@pytest.mark.parametrize("text", ["", "320", "320x", "0x240", "-1x5", "4000x3000", "axb"])
def test_sizes_that_are_none(text: str) -> None:
    with pytest.raises(UsageError, match="no size of frames"):
        parse_sizes(text)


def test_numbers_of_observers() -> None:
    assert parse_numbers(None) == [1, 8, 32]
    assert parse_numbers("0, 4") == [0, 4]
    for text in ("", "x", "1,,2", "-1", "1000"):
        with pytest.raises(UsageError, match="--observers"):
            parse_numbers(text)


def test_options_of_other_measurements_are_refused() -> None:
    check_options(What.DELAYS, {"--peers": "all", "--observers": None})
    with pytest.raises(UsageError, match="--observers is for bench load and swarm, not for bench delays"):
        check_options(What.DELAYS, {"--observers": "1"})
    with pytest.raises(UsageError, match="--sizes is for bench delays and loop, not for bench sim"):
        check_options(What.SIM, {"--sizes": "1x1"})


@pytest.mark.parametrize(
    "arguments", [["delays", "--seconds", "1", "--minutes", "1"], ["load", "--peers", "all"], ["loop", "--sizes", "x"]]
)
def test_usage_errors_come_before_anything_is_measured(arguments: list[str]) -> None:
    app = build(["bench"])
    with pytest.raises(UsageError):
        app(["bench", *arguments], standalone_mode=False)


def test_the_page_has_every_option() -> None:
    command = get_command(build()).commands["bench"]  # type: ignore[attr-defined]
    options = {
        name
        for parameter in command.params
        if isinstance(parameter, typer.core.TyperOption)
        for name in (*parameter.opts, *parameter.secondary_opts)
    }
    described = set(re.findall(r"`(--[\w-]+)`", PAGE.read_text()))
    assert options - {"-h", "--help"} == described
    for what in What:
        assert f"skyloop bench {what.value}" in PAGE.read_text()
