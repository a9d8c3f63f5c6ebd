"""pyardrone 0.6.1, an independent Python program, flies the emulated AR.Drone 2.

Its quirks: it accepts navdata only from the address and port of its request, repeats REF only as often as its user
does, ends its navdata thread on an option 27 of any size but 12 bytes (so it flies in demo mode, which has none), and
strips 64 bytes of a PaVE header whatever size the header states.
"""

from __future__ import annotations

import os
import subprocess
from pathlib import Path

import pytest

from tests.integration.third_party.conftest import HERE, INSTALLED, Emulated, absent

VERSION = "0.6.1"

pytestmark = pytest.mark.process


@pytest.fixture
def python() -> str:
    """Of the environment that has pyardrone and OpenCV: SKYLOOP_PYARDRONE_PYTHON, or where scripts/third-party.sh puts
    it."""
    python = Path(os.environ.get("SKYLOOP_PYARDRONE_PYTHON", INSTALLED / "pyardrone" / "bin" / "python"))
    asked = [str(python), "-c", "import cv2, pyardrone; print(pyardrone.__version__)"]
    try:
        said = subprocess.run(asked, capture_output=True, text=True, timeout=60, check=True).stdout.strip()
    except (OSError, subprocess.SubprocessError) as error:
        absent(f"pyardrone is not installed (run scripts/third-party.sh): {error}")
    assert said == VERSION
    return str(python)


def test_it_takes_off_moves_sees_and_lands(python: str, drone: Emulated) -> None:
    seen, moved_m = drone.flown([python, str(HERE / "fly_pyardrone.py")])
    assert seen["flew"]
    assert seen["navdata"] > 30
    assert 50 < seen["battery"] <= 100
    assert seen["fastest_mm_s"] > 200
    assert seen["pictures"] >= 10
    assert seen["sizes"] == [[360, 640, 3]]
    assert seen["contrast"] > 10  # a room, not the grey of a decoder without parameter sets
    assert moved_m > 0.5
