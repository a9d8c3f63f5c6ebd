"""``skyloop bench`` on the command line: its options, and what the page says of them."""

from __future__ import annotations

from pathlib import Path

import pytest

from skyloop.bench.schedule import MIDDLE, SMALL, Size
from skyloop.cli.app import build
from skyloop.cli.bench import What, check_options, parse_sizes
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


def test_options_of_other_measurements_are_refused() -> None:
    check_options(What.DELAYS, {"--sizes": "1x1"})
    check_options(What.SIM, {"--sizes": None})
    with pytest.raises(UsageError, match="--sizes is for bench delays and loop, not for bench sim"):
        check_options(What.SIM, {"--sizes": "1x1"})


@pytest.mark.parametrize(
    "arguments",
    [["delays", "--seconds", "1", "--minutes", "1"], ["network", "--sizes", "1x1"], ["loop", "--sizes", "x"]],
)
def test_usage_errors_come_before_anything_is_measured(arguments: list[str]) -> None:
    app = build(["bench"])
    with pytest.raises(UsageError):
        app(["bench", *arguments], standalone_mode=False)


def test_the_page_shows_what_is_measured() -> None:
    for what in What:
        assert f"skyloop bench {what.value}" in PAGE.read_text()
