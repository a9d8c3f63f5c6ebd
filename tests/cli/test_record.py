"""``skyloop record``."""

from __future__ import annotations

import re
import signal
from collections.abc import Callable
from pathlib import Path

import pytest

from skyloop.cli import record as module
from skyloop.recording.options import RecorderState, Status
from tests.support import recording_files as files
from tests.support.commands import Run
from tests.support.processes import Process

pytestmark = pytest.mark.process


def test_for_a_time(run: Run, alpha: Process, tmp_path: Path) -> None:
    path = tmp_path / "flight.mcap"
    ended = run("record", "alpha", "-o", str(path), "--seconds", "1.2", "--min-free-mb", "0")
    assert (ended.code, ended.err) == (0, "")
    progress, *_, last = ended.out.splitlines()
    assert "recording" in progress
    assert "messages/s" in progress
    assert re.match(rf"{re.escape(str(path))}: \d s", last)
    assert last.endswith("dropped none, missed none")
    assert files.is_complete(path)
    assert len(files.of(path, "/alpha/feedback")) > 5


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_until_it_is_interrupted(
    start: Callable[..., Process], alpha: Process, tmp_path: Path, number: signal.Signals
) -> None:
    path = tmp_path / "flight.mcap"
    process = start("record", "alpha", "-o", str(path), "--channels", "feedback,event", "--min-free-mb", "0")
    process.until("messages/s")
    process.signal(number)
    process.until("dropped none, missed none")
    assert process.wait() == 0
    assert files.is_complete(path)
    assert not files.of(path, "/alpha/commands")


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("record", "alhpa"), "did you mean 'alpha'"),
        (("record", "alpha", "-o", "/nowhere/f.mcap"), "/nowhere is not a folder"),
        (("record", "alpha", "--channels", "vidio"), "did you mean 'video'"),
        (("record", "alpha", "--encoding", "gif"), "jpeg"),
    ],
)
def test_wrong_words(run: Run, alpha: Process, words: tuple[str, ...], said: str, tmp_path: Path) -> None:
    ended = run(*words)
    assert ended.code == 2
    assert said in ended.err


def test_progress_in_one_line() -> None:
    before = Status(RecorderState.RECORDING, seconds=60.0, bytes=1_000_000, messages=100)
    now = Status(
        RecorderState.PAUSED,
        "No space left",
        seconds=62.0,
        bytes=3_000_000,
        messages=300,
        dropped={"alpha": {"video.front": 12}},
    )
    assert module.progress(now, before) == (
        "1:02  paused (No space left)  3.0 MB  1.00 MB/s  100 messages/s  dropped alpha video.front 12"
    )


def test_a_recording_that_is_not_complete_fails(
    run: Run, alpha: Process, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    failed = Status(RecorderState.FAILED, "No space left", "f.mcap", ("f.mcap",))
    monkeypatch.setattr("skyloop.recording.recorder.Engine.status", property(lambda engine: failed))
    ended = run("record", "alpha", "-o", str(tmp_path), "--seconds", "0.1", "--min-free-mb", "0")
    assert ended.code == 1
    assert "incomplete: No space left" in ended.err
