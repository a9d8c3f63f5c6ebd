"""A vehicle in a separate process, whose code the tests choose."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Sequence
from pathlib import Path

import pytest

from skyloop.child_process import ChildProcess, RestartingChild
from skyloop.drivers.uri import parse_uri
from skyloop.errors import RefusedError
from skyloop.host import own_process
from skyloop.host.fleet import VehicleSettings
from skyloop.host.own_process import OwnProcessVehicle
from skyloop.transport.testing import wait_until

pytestmark = [pytest.mark.process, pytest.mark.skipif(sys.platform != "linux", reason="the local transport is Linux's")]

SAY = """
import json, os, sys, time
def say(**more):
    row = {"name": "a", "address": "sim://", "condition": "running", "process": "own", "pid": os.getpid(), **more}
    print(json.dumps(row), flush=True)
"""


def vehicle(code: str, lines: list[str]) -> OwnProcessVehicle:
    """Return a vehicle whose process runs this code."""
    settings = VehicleSettings("a", parse_uri("sim://"), own_process=True)
    return OwnProcessVehicle(settings, lines.append, (sys.executable, "-c", SAY + code))


def test_a_process_that_cannot_serve_says_why() -> None:
    for code, words in (
        ("say(condition='failed', failed='no such thing'); sys.exit(1)", "no such thing"),
        ("print('words of a driver'); sys.exit(3)", "exit code 3"),
    ):
        with pytest.raises(RefusedError, match=words):
            vehicle(code, []).start()


def test_a_process_that_keeps_dying_restarts_after_longer_pauses(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    pauses: list[int] = []
    monkeypatch.setattr(own_process, "pause_s", lambda deaths: pauses.append(deaths) or 0.01)  # type: ignore[func-returns-value]
    lines: list[str] = []
    dying = vehicle("say(state='landed', airborne=False); time.sleep(0.05); sys.exit(7)", lines)
    dying.start()
    wait_until(lambda: len(pauses) >= 3, "it died three times")
    assert pauses[:3] == [1, 2, 3]
    assert "ended with exit code 7" in lines[0]
    assert dying.status().restarts >= 1
    assert "exit code 7" in dying.status().failed
    dying.end(0.0, "it is enough")
    assert dying.status().condition == "stopped"
    count = len(pauses)
    time.sleep(0.05)
    assert len(pauses) == count


def test_a_process_that_stops_reporting_is_killed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(own_process, "SILENT_CHECKS", 2)
    monkeypatch.setattr("skyloop.child_process._CHECK_S", 0.05)
    lines: list[str] = []
    hung = vehicle("say(); time.sleep(60)", lines)
    hung.start()
    wait_until(lambda: any("was killed by signal 9" in line for line in lines), "it was killed")
    hung.end(0.0, "it is enough")


def test_it_lands_at_sigterm_and_is_not_restarted(tmp_path: Path) -> None:
    lines: list[str] = []
    landing = vehicle(
        f"""
import signal
def land(*_):
    open({str(tmp_path / "landed")!r}, "w").close()
    sys.exit(0)
signal.signal(signal.SIGTERM, land)
say(airborne=True, pilot="jane")
time.sleep(60)
""",
        lines,
    )
    landing.start()
    assert landing.status().pilot == "jane"
    assert landing.runs
    assert landing.end(10.0, "it was removed", unless_flying=True)
    assert (tmp_path / "landed").exists()
    landing.end(0.0, "it was removed")
    assert lines == []
    assert landing.end(0.0, "it was removed", unless_flying=True)


def test_a_process_that_is_still_landing_is_not_killed_in_a_hurry(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A vehicle that can't hover alone must still land: killed after 8 s, its process let it fall."""
    stop = RestartingChild.stop
    monkeypatch.setattr(RestartingChild, "stop", lambda runner: stop(runner, 0.05, 0.05))
    landing = vehicle(
        f"""
import signal
signal.signal(signal.SIGTERM, lambda *_: None)
say(airborne=True)
sys.stdin.read()  # its host is in a hurry
time.sleep(0.5)
open({str(tmp_path / "landed")!r}, "w").close()
""",
        [],
    )
    landing.start()
    assert landing.end(10.0, "its host ends", lambda: True)
    assert (tmp_path / "landed").exists()


def test_a_process_that_does_not_land_is_ended(tmp_path: Path) -> None:
    stubborn = vehicle("import signal; signal.signal(signal.SIGTERM, lambda *_: None); say(); sys.stdin.read()", [])
    stubborn.start()
    assert not stubborn.end(0.05, "it was removed", unless_flying=True)
    stubborn.end(0.0, "it was removed")
    assert stubborn.status().condition == "stopped"


def test_a_grandchild_that_keeps_the_pipe_open_delays_neither_restart_nor_end() -> None:
    lines: list[str] = []
    code = """
import signal, subprocess
subprocess.Popen([sys.executable, "-c", "import time; time.sleep(20)"])
say()
os.kill(os.getpid(), signal.SIGKILL)
"""
    dying = vehicle(code, lines)
    began_s = time.monotonic()
    dying.start()
    wait_until(lambda: dying.status().restarts >= 1, "it was restarted")
    dying.end(0.0, "it is enough")
    assert time.monotonic() - began_s < 15.0


def test_no_process_is_left_if_it_ends_during_a_restart(monkeypatch: pytest.MonkeyPatch) -> None:
    """The process died, and the vehicle is removed at the moment when the next one starts."""
    monkeypatch.setattr(own_process, "pause_s", lambda _: 0.0)
    begun: list[ChildProcess] = []
    dying = vehicle("say(); sys.stdin.read(1)", [])
    real, stopping = ChildProcess, threading.Event()

    def slow(command: Sequence[str], *, keep_errors: bool, handed: str | None) -> ChildProcess:
        if begun:  # the second one
            stopping.set()
            time.sleep(0.2)
        begun.append(real(command, keep_errors=keep_errors, handed=handed))
        return begun[-1]

    monkeypatch.setattr("skyloop.child_process.ChildProcess", slow)
    dying.start()
    begun[0].kill()
    assert stopping.wait(10.0)
    dying.end(0.0, "it was removed")
    assert all(child.code is not None for child in begun)
    assert dying.status().condition == "stopped"


def test_a_process_that_lands_after_its_removal_timed_out_is_shown_as_stopped() -> None:
    landing = vehicle(
        """
import signal, threading
asked = threading.Event()
signal.signal(signal.SIGTERM, lambda *_: asked.set())
say(airborne=True, pilot="jane", state="flying")
asked.wait()
sys.stdin.read(1)
""",
        [],
    )
    landing.start()
    assert not landing.end(0.05, "it is removed", unless_flying=True), "it takes its time"
    child = landing._runner.child
    assert child is not None
    child.part()  # landed: it ends
    wait_until(lambda: landing.status().condition == "stopped", "it is shown as ended")
    row = landing.status()
    assert (row.airborne, row.pilot, row.state) == (False, None, "")
    assert not landing.runs, "its name is free"
    landing.end(0.0, "it was removed")
