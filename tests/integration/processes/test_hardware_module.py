"""The tests that fly any named vehicle pass when they are given an emulated one, or real firmware in simulation."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from skyloop.vehicles.sim.firmware.crazyflie import VARIABLE
from tests.integration.processes.firmware import ADDRESS, KINDS
from tests.support.processes import Process

pytestmark = [pytest.mark.process, pytest.mark.timeout(400)]

HARDWARE = Path(__file__).parents[2] / "hardware"


def passes(address: str) -> None:
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", str(HARDWARE)]
    done = subprocess.run(
        [*command, f"--drone={address}"],
        capture_output=True,
        text=True,
        timeout=360,
        check=False,
        cwd=HARDWARE.parents[1],
    )
    assert done.returncode == 0, done.stdout[-6000:]
    assert "3 passed" in done.stdout


@pytest.mark.parametrize("kind", KINDS)
def test_it_passes(start: Callable[..., Process], kind: str) -> None:
    options = ("--port-base", "0", "--world", "empty", "--speed", "2", "--option", "wind=0")
    firmware = start("-m", "skyloop", "sim", "--firmware", kind, *options)
    firmware.until("ready")
    firmware.until("\n")
    found = ADDRESS.search(firmware.text)
    assert found is not None, firmware.text
    passes(f"{found[0]}?takeoff_altitude=3")


def test_a_crazyflie_passes(start: Callable[..., Process]) -> None:
    options = ("--port-base", "0", "--world", "empty", "--option", "wind=0")
    firmware = start("-m", "skyloop", "sim", "--firmware", "crazyflie", *options)
    firmware.until("CRTP udp")
    firmware.until("\n")
    found = re.search(r"CRTP udp (\d+)", firmware.text)
    assert found is not None, firmware.text
    passes(f"crazyflie://udp:127.0.0.1:{found[1]}")


@pytest.mark.skipif(not os.environ.get(VARIABLE), reason=f"{VARIABLE} is not set (docs/autopilots.md)")
def test_a_real_crazyflies_firmware_passes() -> None:
    passes("sim://?autopilot=crazyflie&world=empty&cameras=none&wind=0&takeoff_altitude=2")
