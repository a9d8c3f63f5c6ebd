"""Each example runs by itself: it starts what it needs, or says in one line what to start."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

FOLDER = Path(__file__).parents[2] / "examples"
#: Those that join drones which others share, and what they say to start.
JOINING = {
    "shared_drone": "start the drone first: skyloop sim --name alpha",
    "swarm_formation": "start three drones first: skyloop sim --drones 3 --name drone --option cameras=none",
    "three_routes": "start three drones first: skyloop sim --drones 3 --name drone --option cameras=none",
    "detector_on_another_host": "start the drone and the detector first, as the first lines of this file say: "
    "skyloop proxy sim:// …",
}


@pytest.mark.parametrize("name", JOINING)
def test_one_that_joins_drones_says_in_one_line_what_to_start(name: str, tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, str(FOLDER / f"{name}.py")],
        env={**os.environ, "SKYLOOP_RUNTIME_DIR": str(tmp_path / "none"), "PYTHONIOENCODING": "utf-8"},
        capture_output=True,
        text=True,
        encoding="utf-8",
        timeout=60,
        check=False,
    )
    assert (done.returncode, done.stdout, done.stderr) == (1, "", f"{JOINING[name]}\n")


def test_every_other_one_flies_a_drone_of_its_own() -> None:
    """They are flown without arguments by the other tests of this folder; that of learning by ``tests/gym``."""
    for path in FOLDER.glob("*.py"):
        text = path.read_text()
        if path.stem not in JOINING:
            assert 'target: str = "sim://' in text or "sim://?" in text or "VectorEnv" in text, path.name
