"""The tables of docs/mavlink.md are those of the code."""

from __future__ import annotations

import re

import pytest

from skyloop.vehicles.mavlink import options
from skyloop.vehicles.mavlink.options import OWN_LIMITS
from skyloop.vehicles.mavlink.protocol import DEGRADED_NS, FIRST_WORD_NS, LOST_NS, PARAMETERS_NS
from tests.support.pages import rows, section

PAGE = "docs/mavlink.md"


def names(cell: str) -> list[str]:
    return re.findall(r"`([^`]+)`", cell)


def test_the_kinds_of_connections() -> None:
    told = [name for row in rows(section(PAGE, "### `mavlink://`")) for name in names(row[0])]
    kinds = {name.removeprefix("mavlink://").partition(":")[0] for name in told if ":" in name}
    assert kinds == {kind.value for kind in options.ConnectionKind}


def test_the_drivers_own_limits() -> None:
    told = {names(row[0])[0]: (names(row[1])[0], float(row[2])) for row in rows(section(PAGE, "### Parameters"))}
    assert told == {limit.name: (limit.option, limit.usual) for limit in OWN_LIMITS}


@pytest.mark.parametrize("ns", [DEGRADED_NS, LOST_NS, FIRST_WORD_NS, PARAMETERS_NS])
def test_the_times_of_the_link(ns: int) -> None:
    assert f"{ns / 1e9:g} s" in section(PAGE, "### Link and events")
