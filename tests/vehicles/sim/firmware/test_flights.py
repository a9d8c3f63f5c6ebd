"""Real ArduCopter and PX4 fly in the simulator, if installed; Betaflight has separate tests.

``SKYLOOP_ARDUCOPTER`` and ``SKYLOOP_PX4`` are the paths of the programs; ``docs/autopilots.md`` lists their sources. A
flight takes two minutes in real time.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import pytest

import skyloop
from benchmarks.autopilots import address, compared, fly_square, follow, take_off, wait_ready
from skyloop.messages import FlightState
from skyloop.vehicles.sim.firmware import ardupilot, px4

pytestmark = [pytest.mark.process, pytest.mark.slow, pytest.mark.timeout(400)]

VARIABLES = {"ardupilot": ardupilot.VARIABLE, "px4": px4.VARIABLE}
MOST_RMS_DEG = 2.0
MOST_RMS_M = 0.5
IN_VIEW = 0.9
CORNERS = 12  # a minute's worth in real time


@pytest.fixture(params=sorted(VARIABLES))
def drone(request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[skyloop.Drone]:
    """A drone in the demo's room, in the air."""
    kind = request.param
    if not os.environ.get(VARIABLES[kind]):
        pytest.skip(f"{kind}'s program is not here: {VARIABLES[kind]} must be its path (docs/autopilots.md)")
    monkeypatch.setenv("SKYLOOP_RUNTIME_DIR", str(tmp_path))
    tmp_path.chmod(0o700)
    with skyloop.connect(address(kind, cameras="front"), timeout_s=30.0) as drone:
        wait_ready(drone)
        take_off(drone)
        yield drone


def test_it_flies_a_square_and_follows_the_marker(drone: skyloop.Drone) -> None:
    with compared(drone) as agreement:
        fly_square(drone, 60.0, least_corners=CORNERS)  # however slow the computer is
    row = agreement.row()
    assert row.samples > 500
    for angle in (row.roll_deg, row.pitch_deg, row.yaw_deg):
        assert angle.rms < MOST_RMS_DEG, row
    assert row.position_m is not None
    assert row.position_m.rms < MOST_RMS_M, row
    score = follow(drone, 30.0).score
    assert (score.share_in_view or 0.0) >= IN_VIEW, score
    drone.land(timeout_s=60.0)
    assert drone.wait(FlightState.LANDED, 10.0).state is FlightState.LANDED
