"""ar-drone 0.3.3 from npm, an independent program, flies the emulated AR.Drone 2.

Its quirks: its first line is CTRL with the sequence number 0, its REF lacks the five bits that should always be set (it
is 512 for take-off), and it silently drops each datagram of full navdata whose option 27 does not have 216 bytes.
"""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.integration.third_party.conftest import HERE, Emulated, node_modules

VERSION = "0.3.3"
OPTIONS_OF_FULL_NAVDATA = {"rawMeasures", "physMeasures", "pwm", "altitude", "magneto", "windSpeed", "wifi", "gps"}

pytestmark = pytest.mark.process


@pytest.fixture
def modules() -> Path:
    return node_modules("ar-drone", VERSION)


def test_it_takes_off_moves_sees_configures_and_lands(modules: Path, drone: Emulated) -> None:
    seen, moved_m = drone.flown(["node", str(HERE / "fly_ar_drone.js")], NODE_PATH=str(modules))
    assert seen["errors"] == []
    assert seen["config"] == [["control:altitude_max", "acknowledged"], ["general:navdata_demo", "acknowledged"]]
    states = [state.removeprefix("CTRL_") for state in seen["states"]]
    assert states[:3] == ["LANDED", "TRANS_TAKEOFF", "HOVERING"]
    assert states[-2:] == ["TRANS_LANDING", "LANDED"]
    assert seen["navdata"] > 100
    assert set(seen["options"]) >= {"demo", "visionDetect"} | OPTIONS_OF_FULL_NAVDATA
    assert 50 < seen["battery"] <= 100
    assert 0.5 < seen["highest"] < 2.0
    assert seen["fastest"] > 200
    assert seen["frames"] >= 30
    assert seen["keyFrames"] >= 2
    assert seen["sizes"] == ["640x360"]
    assert moved_m > 0.5
