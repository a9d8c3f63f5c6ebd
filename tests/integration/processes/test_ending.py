"""A process with several vehicles is asked to end while one of them flies and another stands on the ground."""

from __future__ import annotations

import signal
import time
from collections.abc import Callable
from pathlib import Path

import pytest

import skyloop
from skyloop.errors import SkyloopError
from skyloop.messages import EventKind
from tests.support.processes import Process

pytestmark = pytest.mark.process

FLEET = "".join(f'[[vehicle]]\nname = "{name}"\naddress = "sim://?world=empty&cameras=none"\n' for name in ("a", "b"))


@pytest.mark.parametrize("command", ["sim", "host"])
def test_a_vehicle_on_the_ground_stays_there_while_another_one_lands(
    start: Callable[..., Process], tmp_path: Path, command: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """If it took off then, it would be left in the air without a proxy when the process ends."""
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    if command == "sim":
        process = start("-m", "skyloop", "sim", "--drones", "2", "--world", "empty", "--option", "cameras=none")
        names = ("sim1", "sim2")
        process.until(f"ready {names[1]}", 40.0)
    else:
        (tmp_path / "fleet.toml").write_text(FLEET)
        process = start("-m", "skyloop", "host", str(tmp_path / "fleet.toml"))
        names = ("a", "b")
        process.until("hosting 2", 40.0)
    with skyloop.connect(names[0], on_exit="hover") as flying, skyloop.connect(names[1], on_exit="hover") as standing:
        flying.takeoff()
        climbing = time.monotonic() + 2.0
        while time.monotonic() < climbing:  # so that its landing takes some seconds
            flying.velocity(up=0.8)
            time.sleep(0.05)
        process.signal(signal.SIGTERM)
        flying.wait("landing", timeout_s=5.0)
        with pytest.raises(SkyloopError):
            standing.takeoff(timeout_s=8.0)
        assert process.wait(30.0) == 0
        assert [event for event in standing.recent_events() if event.kind is EventKind.STATE_CHANGED] == []
        assert standing.feedback(max_age_s=None).state == "landed"
        assert flying.feedback(max_age_s=None).state == "landed"
