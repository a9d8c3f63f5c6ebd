"""The tables and figures on the pages are those of the code."""

from __future__ import annotations

import re
import tomllib
from types import ModuleType

import pytest
from doc_tables import PAGES, made

from skyloop.cockpit.server import _LARGEST_MESSAGE
from skyloop.drivers.uri import parse_uri
from skyloop.proxy.relay import MAX_ANNOTATION
from skyloop.proxy.requests import MAX_MALFORMED, MAX_PENDING
from skyloop.sim.world_file import shipped_worlds
from skyloop.transport.base import MAX_PACKET, MAX_SUBSCRIPTIONS
from skyloop.transport.local.frame_exchange import MAX_LEASES
from skyloop.transport.local.server import MAX_CLIENTS
from skyloop.vehicles.ardrone import options as ardrone_options
from skyloop.vehicles.mavlink import options as mavlink_options
from skyloop.vehicles.msp import parameters as msp_options
from skyloop.vehicles.replay import driver as replay_options
from skyloop.vehicles.ros2 import options as ros2_options
from skyloop.vehicles.sim import options as sim_options
from skyloop.vehicles.tello import options as tello_options
from skyloop.vehicles.video import driver as video_options
from tests.support.pages import ROOT, rows, section


def names(cell: str) -> list[str]:
    return re.findall(r"`([^`]+)`", cell)


@pytest.mark.parametrize("page", list(PAGES))
def test_generated_tables_are_up_to_date(page: str) -> None:
    text, wanted = made(page)
    assert text == wanted, "run python -m scripts.doc_tables"


def test_the_extras() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    table = rows(section("docs/start/install.md", "# Installing"))
    assert [row[0] for row in table] == ["(none)", *(f"`{extra}`" for extra in project["optional-dependencies"])]
    for requirement in project["dependencies"]:
        assert re.split(r"[>=<]", requirement)[0] in table[0][1].lower()


def test_the_budgets_of_paths() -> None:
    budgets = tomllib.loads((ROOT / "scripts" / "budgets.toml").read_text())["paths"]
    table = rows(section("docs/architecture.md", "### How long the paths are"))
    assert [row[0] for row in table] == [f"`{name}`" for name in budgets]
    assert [row[2:] for row in table] == [[str(number) for number in budget.values()] for budget in budgets.values()]


ADDRESSES = [
    ("docs/drivers.md", "### `sim://`", sim_options, "sim://"),
    ("docs/drivers.md", "### `video://`", video_options, "video:///dev/zero"),  # a device that is there
    ("docs/ardrone.md", "### `ardrone://`", ardrone_options, "ardrone://192.168.1.1"),
    ("docs/tello.md", "### `tello://`", tello_options, "tello://192.168.10.1"),
    ("docs/mavlink.md", "### `mavlink://`", mavlink_options, "mavlink://udpin:127.0.0.1:14540?camera=/dev/video0"),
    ("docs/ros.md", "### `ros2://`", ros2_options, "ros2://robot"),
    ("docs/msp.md", "### `msp://`", msp_options, "msp:///dev/ttyACM0"),
    ("docs/replay.md", "## `replay://`", replay_options, "replay:///home/me/flight.mcap"),
]


@pytest.mark.parametrize(("page", "heading", "options", "address"), ADDRESSES)
def test_the_options_of_addresses(page: str, heading: str, options: ModuleType, address: str) -> None:
    table = rows(section(page, heading))
    told = [name for row in table for name in names(row[0]) if "://" not in name]
    assert sorted(told) == sorted(options.KNOWN)
    plain = options.options_of(parse_uri(address))
    held = 0
    for row in table:
        for name, default in zip(names(row[0]), row[1].split(", "), strict=False):
            if re.fullmatch(r"`[^` ]+`|[0-9.]+", default):  # the others are described in words
                uri = parse_uri(f"{address}{'&' if '?' in address else '?'}{name}={default.strip('`')}")
                assert options.options_of(uri) == plain, f"{page}: {name} is not {default} by default"
                held += 1
    assert held > 2


def test_the_worlds_that_come_with_it() -> None:
    text = section("docs/vehicles.md", "## `sim://`").partition("Worlds that come with it:")[2].partition(";")[0]
    assert sorted(names(text)) == sorted(shipped_worlds())


def test_figures_about_security() -> None:
    text = " ".join((ROOT / "docs" / "security.md").read_text().split())

    def spaced(number: int) -> str:
        return f"{number:,}".replace(",", " ")

    for words in (
        f"at most {spaced(MAX_PACKET)} bytes",
        f"more than {MAX_MALFORMED} within a second",
        f"at most {MAX_LEASES} frames",
        f"at most {MAX_CLIENTS} connections, {MAX_SUBSCRIPTIONS} subscriptions and {MAX_PENDING} waiting requests",
        f"{spaced(MAX_ANNOTATION)} bytes an annotation",
        f"at most {_LARGEST_MESSAGE} bytes a message",
    ):
        assert words in text, words
