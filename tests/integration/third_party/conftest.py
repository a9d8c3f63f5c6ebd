"""An emulated AR.Drone 2 on the drone's own ports, for programs whose ports can't be chosen."""

from __future__ import annotations

import json
import math
import os
import shutil
import subprocess
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

import pytest

from skyloop.errors import LinkError
from skyloop.sim.host import SimHost
from skyloop.sim.options import SimOptions
from skyloop.vehicles.ardrone.emulator import ArdroneFirmware, with_ardrones

HERE = Path(__file__).parent
INSTALLED = HERE.parents[2] / ".third-party"
PATIENCE_S = 90.0


@dataclass
class Emulated:
    """The drone, its addresses, and its true position."""

    host: SimHost
    address: str

    def position_m(self) -> tuple[float, float, float]:
        x, y, z = self.host.simulation.truth(0).position_m
        return float(x), float(y), float(z)

    def flown(self, command: list[str], **environment: str) -> tuple[dict[str, Any], float]:
        """Let a program fly. Returns its report, and the drone's true distance from its start after landing [m]."""
        start = self.position_m()
        done = subprocess.run(
            [*command, self.address],
            capture_output=True,
            text=True,
            timeout=PATIENCE_S,
            env={**os.environ, **environment},
            check=False,
        )
        assert done.returncode == 0, f"{done.stdout}\n{done.stderr}"
        seen: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
        end = self.position_m()
        assert end[2] == pytest.approx(start[2], abs=0.1)
        return seen, math.dist(start[:2], end[:2])


def absent(reason: str) -> NoReturn:
    """Skip the test, or fail it where the environment promises that everything is installed."""
    if os.environ.get("SKYLOOP_THIRD_PARTY") == "required":
        pytest.fail(reason)
    pytest.skip(reason)


def node_modules(package: str, version: str) -> Path:
    """The folder of npm's packages: SKYLOOP_NODE_MODULES, or where scripts/third-party.sh installs them."""
    modules = Path(os.environ.get("SKYLOOP_NODE_MODULES", INSTALLED / "node_modules"))
    described = modules / package / "package.json"
    if shutil.which("node") is None or not described.exists():
        absent(f"node or its package {package} is not installed (run scripts/third-party.sh)")
    assert json.loads(described.read_text())["version"] == version
    return modules


def private_address() -> str:
    """An address in 127.0.0.0/8 that no other test run uses."""
    pid = os.getpid()
    return f"127.77.{pid >> 8 & 0xFF}.{pid & 0xFF}"


@pytest.fixture
def drone() -> Iterator[Emulated]:
    address = private_address()
    host = SimHost(with_ardrones(SimOptions(world="room", seed=3)))
    firmware = ArdroneFirmware(host, version=2, bind=address)
    try:
        firmware.start()
    except LinkError as error:
        absent(f"the drone's ports can't be had on {address}: {error}")
    try:
        yield Emulated(host, address)
    finally:
        firmware.stop()
