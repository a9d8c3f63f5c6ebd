"""The driver's page matches the code."""

from __future__ import annotations

import math
import re

from skyloop.messages import Attitude, Velocity
from skyloop.vehicles.tello.parameters import SETTINGS, flip_parameter, scale_parameters
from skyloop.vehicles.tello.protocol import ALIVE_NS, DEGRADED_NS, ENTER_NS, LOST_NS
from skyloop.vehicles.tello.setpoints import Scale, sticks_of
from tests.support.pages import rows, section


def names(cell: str) -> list[str]:
    return re.findall(r"`([^`]+)`", cell)


def test_parameters() -> None:
    told = {name for row in rows(section("docs/tello.md", "### Parameters")) for name in names(row[0])}
    known = {parameter.name for parameter in (*scale_parameters(Scale(), Scale()), flip_parameter("none"))}
    assert told == known | set(SETTINGS) | {"tello.sdk", "tello.serial"}


def test_times() -> None:
    text = section("docs/tello.md", "### Link and events")
    for words in (
        f"no state for {DEGRADED_NS / 1e9:g} s",
        f"no state for {LOST_NS / 1e9:g} s",
        f"{ENTER_NS / 1e9:g} s",
    ):
        assert words in text
    assert f"`wifi?` every {ALIVE_NS / 1e9:g} s" in section("docs/tello.md", "### Commands sent to the drone")


def test_the_effect_of_a_full_stick() -> None:
    full = Scale()
    assert (full.speed, full.climb, full.yaw_rate) == (1.0, 1.0, 1.75)
    assert "assumed to mean 1 m/s, 1 m/s of climb and 1.75 rad/s" in section("docs/tello.md", "## The driver")


def test_nan_is_not_a_full_stick() -> None:
    for action in (Attitude, Velocity):
        assert sticks_of(action(*[math.nan] * 4), Scale(), Scale()) == sticks_of(action(), Scale(), Scale())
