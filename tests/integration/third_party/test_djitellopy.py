"""djitellopy 2.5.0, an independent Python program, flies the emulated Tello.

It binds the drone's own port 8889 on its side, and 8890 and 11111, on all addresses, so each end has a separate
network. It waits 7 s for an answer, accepts any datagram as one, and repeats its command.
"""

from __future__ import annotations

import json
import os
import select
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from typing import Any

import pytest

from tests.integration.third_party.conftest import HERE, INSTALLED, absent
from tests.integration.third_party.namespaces import Cable, cable

VERSION = "2.5.0"
DRONE, PILOT = "192.168.10.1", "192.168.10.2"
STARTS_WITHIN_S = 30.0
PATIENCE_S = 150.0

pytestmark = [pytest.mark.process, pytest.mark.timeout(240)]
pytest.importorskip("av")

Fly = Callable[..., dict[str, Any]]


@pytest.fixture
def python() -> str:
    """The interpreter of the environment with djitellopy: SKYLOOP_DJITELLOPY_PYTHON, or scripts/third-party.sh's."""
    python = os.environ.get("SKYLOOP_DJITELLOPY_PYTHON", str(INSTALLED / "djitellopy" / "bin" / "python"))
    asked = [python, "-c", "import djitellopy, importlib.metadata as m; print(m.version('djitellopy'))"]
    try:
        said = subprocess.run(asked, capture_output=True, text=True, timeout=60, check=True).stdout.strip()
    except (OSError, subprocess.SubprocessError) as error:
        absent(f"djitellopy is not installed (run scripts/third-party.sh): {error}")
    assert said == VERSION
    return python


@pytest.fixture
def between() -> Iterator[Cable]:
    with cable(DRONE, PILOT) as made:
        yield made


@pytest.fixture
def fly(python: str, between: Cable) -> Iterator[Fly]:
    """Start the drone, let djitellopy fly it, and return its report."""
    running: list[subprocess.Popen[bytes]] = []

    def begin(how: str, *options: str) -> dict[str, Any]:
        command = [sys.executable, "-m", "skyloop", "sim", "--firmware", "tello", "--bind", DRONE, *options]
        drone = subprocess.Popen([*between.drone, *command], stdout=subprocess.PIPE, stderr=subprocess.STDOUT)
        running.append(drone)
        _until(drone, "commands udp")
        done = subprocess.run(
            [*between.pilot, python, str(HERE / "fly_djitellopy.py"), how, DRONE],
            capture_output=True,
            text=True,
            timeout=PATIENCE_S,
            check=False,
        )
        assert done.returncode == 0, f"{done.stdout}\n{done.stderr}"
        seen: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
        return seen

    yield begin
    for drone in running:
        drone.kill()  # the process started by "ip netns exec" has been replaced by it
        drone.wait(10)
        if drone.stdout is not None:
            drone.stdout.close()


def _until(process: subprocess.Popen[bytes], words: str) -> None:
    stream = process.stdout
    assert stream is not None
    text, end = "", time.monotonic() + STARTS_WITHIN_S
    while words not in text:
        assert select.select([stream], [], [], max(0.0, end - time.monotonic()))[0], f"it did not say {words!r}: {text}"
        said = os.read(stream.fileno(), 4096)
        assert said, f"it ended without saying {words!r}: {text}"
        text += said.decode()


def test_it_takes_off_moves_sees_and_lands(fly: Fly) -> None:
    seen = fly("steady", "--seed", "3")
    assert seen["sdk"] == "30"
    assert 50 < seen["battery"] <= 100
    assert seen["on_ground_cm"] == 10
    assert 60 <= seen["up_cm"] <= 110
    assert seen["higher_cm"] >= seen["up_cm"] + 10
    assert abs(seen["yaw_deg"] - 90) <= 10  # clockwise is positive
    assert seen["fastest_dm_s"] >= 2
    assert seen["motor_s"] >= 5
    assert seen["size"] == [720, 960, 3]
    assert seen["contrast"] > 10  # a room, not plain grey


def test_it_flies_with_a_tenth_of_the_datagrams_lost(fly: Fly) -> None:
    seen = fly("lossy", "--seed", "3", "--world", "empty", "--lose", "0.1", "--fault-seed", "5")
    assert seen["highest_cm"] > 60
    assert seen["yaw_deg"] > 20
    assert seen["end_cm"] <= 10
