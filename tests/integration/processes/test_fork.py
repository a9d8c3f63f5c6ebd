"""A program that forks in flight: the child leaves drone, proxy, recording and child processes to its parent."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = [
    pytest.mark.process,
    pytest.mark.skipif(not hasattr(os, "fork"), reason="this system has no fork"),
]

PROGRAM = """
import os, sys, warnings
import skyloop

warnings.simplefilter("ignore", DeprecationWarning)  # of fork beside threads, from Python 3.12 on
with skyloop.connect("sim://?world=empty&cameras=front") as drone, skyloop.record(drone, sys.argv[1]) as recorder:
    drone.takeoff()
    child = os.fork()
    if child == 0:
        try:
            drone.velocity(forward=1.0)
        except skyloop.ClosedError as error:
            print("child:", error, flush=True)
        sys.exit(7)  # through the ends of both blocks
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 7
    landings = [event for event in drone.recent_events() if event.data.get("state") == "landing"]
    drone.hover()
    drone.wait("hovering", 5)
    assert drone.link.application.value == "up", drone.link
    assert drone.authority.state == "held"
    print("parent:", drone.feedback().state.value, len(landings), recorder.state.value, flush=True)
print("ended", flush=True)
"""


@pytest.mark.timeout(60)
def test_the_child_of_a_fork_neither_lands_nor_ends_what_its_parent_flies(tmp_path: Path) -> None:
    recording = tmp_path / "flight.mcap"
    program = subprocess.run(
        [sys.executable, "-c", PROGRAM, str(recording)], capture_output=True, text=True, timeout=50, check=False
    )
    assert program.returncode == 0, program.stderr
    child, parent, ended = program.stdout.splitlines()
    assert "belongs to process" in child
    assert "connect again here" in child
    assert parent == "parent: hovering 0 recording"
    assert ended == "ended"
    assert recording.stat().st_size > 0
