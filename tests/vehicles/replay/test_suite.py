"""The drivers' contract, checked with replays of a drone that flew and of a camera."""

from __future__ import annotations

import unittest
from pathlib import Path

import msgspec
import pytest

from skyloop.drivers.base import Driver
from skyloop.drivers.suite import DriverSuite
from skyloop.drivers.uri import VehicleUri
from tests.support.recorded_flights import CAPABILITIES, Plan, write_flight

PLANS = {
    "flown": Plan(),
    "watched": Plan(
        capabilities=msgspec.structs.replace(CAPABILITIES, actions=frozenset(), why_not="it is a picture only"),
        png=True,
    ),
}
FOLDER: dict[str, Path] = {}


@pytest.fixture(autouse=True, scope="module")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> None:
    """Write them once for all tests."""
    folder = FOLDER["recordings"] = tmp_path_factory.mktemp("suite")
    for name, plan in PLANS.items():
        write_flight(folder / f"{name}.mcap", plan)


class ReplaySuite(DriverSuite):
    uri = "replay://flown.mcap?loop=1&speed=2"

    def make(self, uri: VehicleUri) -> Driver:
        return super().make(VehicleUri(uri.scheme, str(FOLDER["recordings"] / uri.place), uri.options))

    def test_flight(self) -> None:
        raise unittest.SkipTest("a replay ignores commands")

    def test_a_landing_withdraws_a_takeoff(self) -> None:
        raise unittest.SkipTest("a replay ignores commands")

    def test_emergency_stop_and_reset(self) -> None:
        raise unittest.SkipTest("a replay ignores commands")


class TestReplay(ReplaySuite):
    pass


class TestReplayOfWhatCannotFly(ReplaySuite):
    uri = "replay://watched.mcap?loop=1&speed=2"
