"""MAVSDK 4.1.0 and MAVProxy 1.8.75, which we did not write, fly both emulated autopilots, and dronekit2 3.0.0 the
ArduCopter."""

from __future__ import annotations

import json
import math
import os
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from skyloop.sim.host import SimHost
from skyloop.sim.options import SimOptions
from skyloop.vehicles.mavlink.emulator import Kind, MavlinkFirmware, Ports, with_multirotors
from tests.integration.third_party.conftest import HERE, INSTALLED, PATIENCE_S, absent

pytestmark = [pytest.mark.process, pytest.mark.timeout(180)]


@pytest.fixture(params=list(Kind))
def firmware(request: pytest.FixtureRequest) -> Iterator[MavlinkFirmware]:
    kind: Kind = request.param
    host = SimHost(with_multirotors(SimOptions(world="empty", seed=1, wind=0.0)))
    with MavlinkFirmware(host, kind=kind, ports=Ports.free(kind)) as running:
        yield running


def python_of(name: str, version: str) -> str:
    """The interpreter of the environment with this program: SKYLOOP_<NAME>_PYTHON, or scripts/third-party.sh's."""
    python = os.environ.get(f"SKYLOOP_{name.upper()}_PYTHON", str(INSTALLED / name / "bin" / "python"))
    asked = [python, "-c", f"from importlib.metadata import version; print(version({name!r}))"]
    try:
        said = subprocess.run(asked, capture_output=True, text=True, timeout=60, check=True).stdout.strip()
    except (OSError, subprocess.SubprocessError) as error:
        absent(f"{name} is not installed (run scripts/third-party.sh): {error}")
    assert said == version
    return python


def flown(firmware: MavlinkFirmware, folder: Path, *command: str) -> dict[str, Any]:
    """Let a program fly; returns its report. The vehicle flew about three metres, stands and is disarmed."""
    done = subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE_S + 60, cwd=folder, check=False)
    assert done.returncode == 0, f"{done.stdout[-3000:]}\n{done.stderr[-3000:]}"
    east, north, up = firmware.host.simulation.truth(0).position_m
    assert 1.5 < math.hypot(east, north) < 6.0
    assert up < 0.2
    assert not firmware.autopilot.armed
    assert firmware.autopilot.set_points > 10
    seen: dict[str, Any] = json.loads([line for line in done.stdout.splitlines() if line.startswith("{")][-1])
    return seen


def test_mavsdk_takes_off_flies_by_velocity_and_lands(firmware: MavlinkFirmware, tmp_path: Path) -> None:
    python = python_of("mavsdk", "4.1.0")
    url = f"udpin://127.0.0.1:{firmware.settings.ports.remote}"
    seen = flown(firmware, tmp_path, python, str(HERE / "fly_mavsdk.py"), url)
    assert seen["high_m"] > 1.9
    assert 0.7 < seen["fastest_m_s"] < 1.5


def test_mavproxy_takes_off_flies_by_velocity_and_lands(firmware: MavlinkFirmware, tmp_path: Path) -> None:
    python = python_of("mavproxy", "1.8.75")
    kind, master = firmware.settings.kind.value, f"udpin:127.0.0.1:{firmware.settings.ports.remote}"
    seen = flown(firmware, tmp_path, python, str(HERE / "fly_mavproxy.py"), kind, master)
    assert "Detected vehicle 1:1" in seen["said"]


@pytest.mark.parametrize("firmware", [Kind.ARDUCOPTER], indirect=True)
def test_dronekit_waits_until_it_is_armable_takes_off_flies_somewhere_and_returns(
    firmware: MavlinkFirmware, tmp_path: Path
) -> None:
    python, tcp = python_of("dronekit2", "3.0.0"), firmware.settings.ports.tcp
    command = [python, str(HERE / "fly_dronekit.py"), f"tcp:127.0.0.1:{tcp}"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=150, cwd=tmp_path, check=False)
    assert done.returncode == 0, f"{done.stdout[-3000:]}\n{done.stderr[-3000:]}"
    seen: dict[str, Any] = json.loads([line for line in done.stdout.splitlines() if line.startswith("{")][-1])
    assert seen["high_m"] > 2.3
    assert seen["there_m"] < 0.6
    assert seen["fastest_m_s"] < 1.8, "its own command slows it down"
    assert seen["highest_m"] == pytest.approx(5.0, abs=0.5), "RTL_ALT"
    assert seen["home_m"] < 0.1
    assert not firmware.autopilot.armed
    east, north, up = firmware.host.simulation.truth(0).position_m
    assert math.hypot(east, north) < 0.7
    assert up < 0.2
