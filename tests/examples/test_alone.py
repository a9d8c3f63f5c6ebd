"""Each example runs alone: it starts what it needs, or says in one line what to start."""

from __future__ import annotations

import runpy
import sys
from pathlib import Path
from typing import Any, NoReturn

import pytest

import skyloop

EXAMPLES = sorted((Path(__file__).parents[2] / "examples").glob("*.py"))
#: Examples that join shared drones, and the commands that they ask the user to run.
JOINING = {
    "shared_drone": "start the drone first: skyloop sim --name alpha",
    "swarm_formation": "start three drones first: skyloop sim --drones 3 --name drone --option cameras=none",
    "three_routes": "start three drones first: skyloop sim --drones 3 --name drone --option cameras=none",
    "detector_on_another_host": "start the drone and the detector first, as the first lines of this file say: "
    "skyloop proxy sim:// …",
}


class Starts(Exception):  # noqa: N818  the end of a test, not an error
    """The example starts its own simulation; other tests of this folder, and of ``tests/gym``, fly it."""


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_alone_it_starts_its_own_simulation_or_says_what_to_start(
    path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    join = skyloop.connect

    def connect(target: str, **options: Any) -> skyloop.Drone:
        return starts() if target.startswith("sim://") else join(target, **options)

    def starts(*_: object, **__: object) -> NoReturn:
        raise Starts

    monkeypatch.setattr("skyloop.connect", connect)
    monkeypatch.setattr("skyloop.control.rehearsal.rehearse", starts)
    monkeypatch.setattr("skyloop.gym.ReachVectorEnv", starts)
    monkeypatch.setenv("SKYLOOP_RUNTIME_DIR", str(tmp_path / "nothing runs"))
    monkeypatch.delenv("SKYLOOP_NETWORK", raising=False)
    monkeypatch.setattr(sys, "argv", [str(path)])
    with pytest.raises((Starts, SystemExit)) as ended:
        runpy.run_path(str(path), run_name="__main__")
    said = str(ended.value)  # an exit with a text prints only that, on standard error, with exit code 1
    assert said == JOINING.get(path.stem, "")
    assert "\n" not in said
