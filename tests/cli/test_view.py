"""``skyloop view``."""

from __future__ import annotations

import signal
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

import skyloop
from skyloop.recording.foxglove_server import ParameterAccess
from tests.support import fake_rerun
from tests.support.commands import Run
from tests.support.processes import Process

pytestmark = pytest.mark.process


@pytest.fixture(autouse=True)
def priority(monkeypatch: pytest.MonkeyPatch) -> None:
    """Keep the priority of the tests' own process."""
    monkeypatch.setattr("skyloop.recording.taps.give_way", lambda: None)


def test_foxglove_until_it_is_interrupted(start: Callable[..., Process], alpha: Process) -> None:
    pytest.importorskip("foxglove")
    process = start("view", "alpha", "--foxglove", "--port", "0")
    process.until("Foxglove WebSocket, ws://127.0.0.1:")
    process.signal(signal.SIGINT)
    assert process.wait() == 0
    assert "Traceback" not in process.text


def test_a_file_of_rerun_for_a_time(run: Run, alpha: Process, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    streams = fake_rerun.install(monkeypatch)
    path = tmp_path / "flight.rrd"
    ended = run("view", "--drone", "alpha", "--rerun", "--save", str(path), "--seconds", "1")
    assert (ended.code, ended.err) == (0, "")
    assert ended.out.splitlines() == [f"Rerun: {path}", "alpha: annotations, commands, events, feedback, logs"]
    assert streams[0].closed
    assert streams[0].of("world/drones/alpha", "Transform3D")


def test_parameters_are_written_under_a_briefly_held_lease(alpha: Process) -> None:
    with skyloop.connect("alpha", access="observe") as observer:
        desk = ParameterAccess([observer], 31)
        try:
            before = observer.config["limits.tilt"]
            written = desk.write("alpha/limits.tilt", 0.1)
            assert (written.value, written.refused) == (0.1, "")
            assert observer.wait(lambda feedback: feedback.owner is None, timeout_s=10.0)
            with skyloop.connect("alpha", name="pilot", on_exit="hover"):
                refused = desk.write("alpha/limits.tilt", before)
            assert refused.value == 0.1
            assert "alpha/limits.tilt was not written: " in refused.refused
            assert "pilot" in refused.refused
        finally:
            desk.write("alpha/limits.tilt", before)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("alpha",), "give either --foxglove or --rerun"),
        (("alpha", "--foxglove", "--rerun"), "give either --foxglove or --rerun"),
        (("alpha", "--foxglove", "--save", "x.rrd"), "--connect and --save are for --rerun"),
        (("alpha", "--rerun", "--write"), "--write is for --foxglove"),
        (("alpha", "--rerun", "--connect", "rerun+http://a:1/proxy", "--save", "x.rrd"), "leave out --save and --port"),
        (("--foxglove",), "no drone given"),
        (("alhpa", "--foxglove"), "did you mean 'alpha'"),
    ],
)
def test_wrong_words(run: Run, alpha: Process, words: tuple[str, ...], said: str) -> None:
    ended = run("view", *words)
    assert ended.code == 2
    assert said in ended.err


def test_without_the_extra_the_error_names_it(run: Run, alpha: Process, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "rerun", None)
    ended = run("view", "alpha", "--rerun", "--save", "x.rrd")
    assert ended.code == 1
    assert "skyloop install rerun" in ended.err
