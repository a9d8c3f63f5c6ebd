"""The recorder in its own process, beside real proxies."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

import skyloop
from skyloop.errors import LinkError, UsageError
from skyloop.messages import Event, EventKind, Feedback, Severity
from skyloop.recording import Recorder, layout
from skyloop.recording.layout import META_END, ClockPair, End, FrameRecord
from skyloop.recording.options import RecorderState
from skyloop.recording.recorder import RecorderProcess
from skyloop.transport.priority import SUPERSEDED
from tests.support import recording_files as files
from tests.support.processes import Process

pytestmark = pytest.mark.process
SIM = "sim://?world=empty&cameras=front&wind=0"
Proxy = Callable[..., Process]


@pytest.fixture(autouse=True)
def sockets(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """A socket directory for this test alone, with a short path, as sockets require."""
    with tempfile.TemporaryDirectory(prefix="skyloop-") as folder:
        monkeypatch.setenv("SKYLOOP_RUNTIME_DIR", str(Path(folder) / "run"))
        yield


@pytest.fixture
def start() -> Iterator[Callable[..., Process]]:
    """Starts Python processes that end with the test."""
    running: list[Process] = []

    def begin(*arguments: str) -> Process:
        running.append(Process(*arguments))
        return running[-1]

    yield begin
    for process in reversed(running):
        process.end()


@pytest.fixture
def proxy(start: Callable[..., Process]) -> Proxy:
    """Starts a proxy and waits until it serves."""

    def begin(name: str = "alpha") -> Process:
        process = start("-m", "skyloop", "proxy", SIM, "--name", name)
        process.until("ready")
        return process

    return begin


def pid(recorder: Recorder) -> int:
    backend = recorder._backend
    assert isinstance(backend, RecorderProcess)
    return backend.pid


def count(path: Path, topic: str) -> int:
    return len(files.of(path, topic))


@pytest.mark.daily
def test_a_flight_is_recorded_and_the_file_is_complete(tmp_path: Path) -> None:
    path = tmp_path / "flight.mcap"
    with skyloop.connect(SIM, on_exit="hover") as drone, skyloop.record(drone, path, min_free_mb=0) as recorder:
        name = drone.name
        assert pid(recorder) != os.getpid()
        drone.takeoff(wait=False)
        drone.wait(lambda _: count(path, f"/{name}/frames/front") > 5)
        drone.log.number("error", 0.5)
        drone.wait(lambda _: count(path, f"/{name}/logs") > 0)
        taken_off_ns = time.monotonic_ns()
    assert recorder.state.value == "closed"
    assert recorder.files == [path]
    left_out = {channel for channels in recorder.dropped.values() for channel in channels}
    assert left_out <= {"video.front"}, "a slow disk or encoder costs frames first"
    assert files.is_complete(path)
    found = files.metadata(path)
    assert layout.from_metadata(found[META_END], End).reason == "closed"
    clock = layout.from_metadata(found["skyloop.clock"], ClockPair)
    assert clock.pid == pid(recorder)
    samples = files.of(path, f"/{name}/feedback")
    seqs = [layout.decode(one.data, Feedback).seq for one in samples]
    assert seqs == list(range(seqs[0], seqs[0] + len(seqs)))
    assert abs(clock.monotonic(samples[-1].log_ns) - taken_off_ns) < 2e9
    assert "takeoff" in [one.json["asked"]["action"] for one in files.of(path, f"/{name}/commands")]
    frames = [layout.decode(one.data, FrameRecord) for one in files.of(path, f"/{name}/frames/front")]
    assert all(0 < frame.received_ns - frame.header.captured_ns < 2e9 for frame in frames)


def test_a_killed_recorder_is_reported_and_the_flight_continues(tmp_path: Path) -> None:
    path = tmp_path / "flight.mcap"
    events: list[Event] = []
    with skyloop.connect(SIM, on_exit="hover") as drone, drone.on_event(events.append):
        recorder = skyloop.record(drone, path, min_free_mb=0)
        drone.takeoff(wait=False)
        topic = f"/{drone.name}/feedback"
        drone.wait(lambda _: count(path, topic) > 20)
        os.kill(pid(recorder), signal.SIGKILL)
        drone.wait(lambda _: recorder.state is RecorderState.FAILED)
        assert "killed by signal 9" in recorder.reason
        drone.wait(lambda _: any("killed by signal 9" in event.text for event in events))
        (told,) = [event for event in events if event.kind is EventKind.RECORDING and "by signal" in event.text]
        assert told.severity is Severity.ERROR
        assert drone.hover()
        seq = drone.feedback().seq
        drone.wait(lambda feedback: feedback.seq > seq + 5)
        recorder.close()
    assert recorder.state.value == "failed"
    assert not files.is_complete(path)
    kept = [layout.decode(one.data, Feedback).seq for one in files.of(path, topic)]
    assert kept == list(range(kept[0], kept[0] + len(kept)))
    assert len(kept) > 20
    assert seq - kept[-1] < 120, "all but the last second or two"


def test_when_the_application_is_killed_the_file_is_closed(
    proxy: Proxy, start: Callable[..., Process], tmp_path: Path
) -> None:
    proxy()
    path = tmp_path / "flight.mcap"
    code = (
        "import skyloop, sys, time\n"
        f"recorder = skyloop.record('alpha', {str(path)!r}, min_free_mb=0)\n"
        "print('recording', flush=True)\ntime.sleep(60)"
    )
    application = start("-c", code)
    application.until("recording")
    files.until(lambda: count(path, "/alpha/feedback") > 5, "something is recorded")
    application.signal(signal.SIGKILL)
    files.until(lambda: files.is_complete(path), "the file is complete")


def test_errors_of_the_child_are_raised_here(proxy: Proxy, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="no proxy named 'nobody'"):
        skyloop.record("nobody", tmp_path / "f.mcap")
    proxy()
    with pytest.raises(UsageError, match="no camera named 'back'"):
        skyloop.record("alpha", tmp_path / "f.mcap", channels=["video.back"])
    with pytest.raises(UsageError, match="MB left"):
        skyloop.record("alpha", tmp_path / "f.mcap", min_free_mb=1e9)


def test_a_child_that_ends_at_once_is_reported(proxy: Proxy, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.executable", "/bin/false")
    with pytest.raises(LinkError, match="ended with exit code 1"):
        skyloop.record("alpha", tmp_path / "f.mcap")


def test_a_terminated_recorder_closes_its_file(proxy: Proxy, tmp_path: Path) -> None:
    proxy()
    with skyloop.record("alpha", tmp_path / "f.mcap", min_free_mb=0) as recorder:
        os.kill(pid(recorder), signal.SIGTERM)
        files.until(lambda: recorder.state is RecorderState.CLOSED, "it is closed")
    assert files.is_complete(tmp_path / "f.mcap")
    assert recorder.path == tmp_path / "f.mcap"


def test_two_drones_and_a_returning_proxy(proxy: Proxy, tmp_path: Path) -> None:
    path = tmp_path / "both.mcap"
    proxy("beta")
    first = proxy("alpha")
    with skyloop.record(["alpha", "beta"], path, min_free_mb=0) as recorder:
        files.until(lambda: count(path, "/alpha/feedback") > 5, "alpha is recorded")
        first.signal(signal.SIGKILL)
        first.wait()
        proxy("alpha")
        before = count(path, "/alpha/feedback")
        files.until(lambda: count(path, "/alpha/feedback") > before + 5, "alpha is recorded again")
        assert count(path, "/beta/feedback") > 0
    assert files.is_complete(path)
    assert recorder.state.value == "closed"


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A disk of 6 MB."""
    folder = tmp_path / "disk"
    folder.mkdir()
    command = ["mount", "-t", "tmpfs", "-o", "size=6m", "tmpfs", str(folder)]
    if os.geteuid() != 0 or subprocess.run(command, capture_output=True).returncode:
        pytest.skip("mounting a small disk needs the right to")
    yield folder
    subprocess.run(["umount", "-l", str(folder)], check=True)


def fill(path: Path) -> None:
    with path.open("wb", buffering=0) as file, contextlib.suppress(OSError):
        while file.write(b"x" * 65536):
            pass


def test_a_disk_that_is_really_full(small_disk: Path) -> None:
    path = small_disk / "flight.mcap"
    with skyloop.connect(SIM, on_exit="hover") as drone, skyloop.record(drone, path, min_free_mb=0) as recorder:
        topic = f"/{drone.name}/feedback"
        drone.takeoff(wait=False)
        drone.wait(lambda _: count(path, topic) > 5)
        ballast = small_disk / "ballast"
        fill(ballast)
        drone.wait(lambda _: recorder.state is RecorderState.PAUSED)
        assert "No space left" in recorder.reason
        told = [event for event in drone.recent_events() if event.kind is EventKind.RECORDING]
        assert told[-1].severity is Severity.ERROR
        assert drone.hover()
        assert count(path, topic) > 5
        ballast.unlink()
        drone.wait(lambda _: recorder.state is RecorderState.RECORDING)
        drone.wait(lambda _: count(recorder.path, topic) > 5)
        statistics = drone._proxy_statistics()
        assert statistics is not None
        superseded = statistics.counters[SUPERSEDED]
    first, second = recorder.files
    assert not files.is_complete(first)
    assert files.is_complete(second)
    commands = [
        one.sequence for one in (*files.of(first, topic[:-8] + "commands"), *files.of(second, topic[:-8] + "commands"))
    ]
    assert sorted(set(commands)) == commands, "none appears twice"
    missing = commands[-1] - commands[0] + 1 - len(commands)
    assert missing <= superseded, "only commands never applied are missing: newer ones replaced them"
