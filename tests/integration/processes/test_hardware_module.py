"""The tests that fly any named vehicle pass when they are given an emulated one."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.integration.processes.firmware import ADDRESS, KINDS
from tests.support.processes import Process

pytestmark = [pytest.mark.process, pytest.mark.timeout(400)]

HARDWARE = Path(__file__).parents[2] / "hardware"


@pytest.mark.parametrize("kind", KINDS)
def test_it_passes(start: Callable[..., Process], kind: str) -> None:
    options = ("--port-base", "0", "--world", "empty", "--speed", "2", "--option", "wind=0")
    firmware = start("-m", "skyloop", "sim", "--firmware", kind, *options)
    firmware.until("ready")
    firmware.until("\n")
    found = ADDRESS.search(firmware.text)
    assert found is not None, firmware.text
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", str(HARDWARE)]
    done = subprocess.run(
        [*command, f"--drone={found[0]}?takeoff_altitude=3"],
        capture_output=True,
        text=True,
        timeout=360,
        check=False,
        cwd=HARDWARE.parents[1],
    )
    assert done.returncode == 0, done.stdout[-6000:]
    assert "3 passed" in done.stdout
