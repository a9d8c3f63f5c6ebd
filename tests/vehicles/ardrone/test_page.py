"""The driver's page matches the code."""

from __future__ import annotations

import re

from skyloop.drivers.uri import parse_uri
from skyloop.vehicles.ardrone.emulator.video import BOTTOM_2_SENT, FRONT_2
from skyloop.vehicles.ardrone.parameters import PREFIX, Commands, entries_of
from skyloop.vehicles.ardrone.setpoints import ArdroneSetpoints
from skyloop.vehicles.ardrone.telemetry import _REASONS
from skyloop.vehicles.ardrone.video import cameras_of
from skyloop.vehicles.ardrone.wire.configuration import format_value, keys_of
from tests.support.pages import rows, section

DRIVER = section("docs/ardrone.md", "## The driver")


def names(cell: str) -> list[str]:
    return re.findall(r"`([^`]+)`", cell)


def test_common_parameters() -> None:
    told = {name for row in rows(section("docs/ardrone.md", "### Parameters")) for name in names(row[0])}
    dump = {name: format_value(key.default) for name, key in keys_of(2).items()}
    known = {name for name in entries_of(dump, 2) if not name.startswith(PREFIX)}
    commands = {p.name for p in Commands(ArdroneSetpoints(), lambda message, times: None).parameters(2)}
    assert told == known | {name for name in commands if not name.startswith(PREFIX)}
    assert all(f"`{name}`" in DRIVER for name in commands)


def test_reasons() -> None:
    assert all(f"`{name}`" in DRIVER for _, name in _REASONS)


def test_the_emulated_cameras_match_the_drivers() -> None:
    front, bottom = cameras_of(parse_uri("ardrone://d"), 2)
    for info, model in ((front, FRONT_2), (bottom, BOTTOM_2_SENT)):
        assert info.intrinsics is not None
        assert (info.width, info.height) == (model.width, model.height)
        announced = info.intrinsics
        assert (announced.fx, announced.fy, announced.cx, announced.cy) == (model.fx, model.fy, model.cx, model.cy)
        assert announced.distortion in ((), model.distortion)
        assert info.rotation == model.rotation
