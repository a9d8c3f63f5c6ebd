"""The measured tables of the pages are those of the results beside them, and the pages name every option."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from pathlib import Path

import msgspec
import pytest
import typer
from typer.main import get_command

from benchmarks.command import BENCHMARKS, build
from benchmarks.pages import delays, network, paper, tracking
from benchmarks.pages.fill import fill
from benchmarks.paper.evaluation import load as load_paper
from benchmarks.tracking import TrackingResults
from skyloop.cli.app import build as build_skyloop
from skyloop.errors import UsageError

PAGES: Mapping[str, tuple[Path, Callable[[], Mapping[str, str]]]] = {
    "delays": (delays.PAGE, lambda: delays.blocks(delays.MEASURED)),
    "network": (network.LOSS_PAGE, lambda: network.loss_blocks(network.MEASURED)),
    "network, scale": (network.SCALE_PAGE, lambda: network.scale_blocks(network.MEASURED)),
    "paper": (paper.PAGE, lambda: paper.blocks(load_paper(paper.MEASURED))),
    "tracking": (
        tracking.PAGE,
        lambda: tracking.blocks(msgspec.json.decode(tracking.MEASURED.read_bytes(), type=TrackingResults)),
    ),
}


@pytest.mark.parametrize("name", list(PAGES))
def test_the_tables_of_a_page_are_those_of_its_results(name: str) -> None:
    page, blocks = PAGES[name]
    text = page.read_text()
    assert fill(text, blocks()) == text, f"run python -m benchmarks.pages.{name.partition(',')[0]}"


def test_a_page_is_filled_and_can_be_filled_again() -> None:
    page = "# A\n<!-- measured: x -->\n<!-- end -->\ntext\n<!-- measured: y -->\nold\n<!-- end -->\n"
    filled = fill(page, {"x": "new\n", "y": "newer"})
    assert filled == "# A\n<!-- measured: x -->\nnew\n<!-- end -->\ntext\n<!-- measured: y -->\nnewer\n<!-- end -->\n"
    assert fill(filled, {"x": "other"}).count("newer") == 1
    with pytest.raises(UsageError, match="measured: z"):
        fill(page, {"z": ""})


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
    text = Path(delays.PAGE).read_text()
    assert options - {"-h", "--help"} == set(re.findall(r"`(--[\w-]+)`", text))
    for name in BENCHMARKS:
        assert f"python -m benchmarks.{name}" in text
