"""A recorder that fails, or gets samples it can't write: a bad sample is skipped, and a dead writer is reported."""

from __future__ import annotations

import threading
import time
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest

import skyloop
from skyloop.cli import record as command
from skyloop.client import Drone
from skyloop.client.channels import Notifier
from skyloop.client.drone import open_drone
from skyloop.errors import SkyloopError
from skyloop.messages import Applied, Capabilities, Event, EventKind, Feedback, Idle, LogEntry, Severity
from skyloop.proxy import Proxy
from skyloop.recording.backlog import Backlog, Item, Rank
from skyloop.recording.layout import ClockPair, DroneRecord
from skyloop.recording.options import MB, Options, RecorderEvent, RecorderState, Status
from skyloop.recording.recorder import Engine, RecorderProcess
from skyloop.recording.translation import Translator
from skyloop.recording.writer import FileWriter, RecordingFile
from skyloop.transport.memory import MemoryServer
from tests.support import recording_files as files
from tests.support.fake_vehicle import FakeVehicle
from tests.support.samples import log_entry

WAIT_S = 10.0
CLOCK = ClockPair(0, 1_000_000_000_000_000_000, 1)


class Trap(Translator):
    """Raises for one sample."""

    def messages(self, item: Item) -> Any:
        if item.sample == "bad":
            raise OverflowError("nobody foresaw this")
        return super().messages(item)


def burst(*_: object) -> None:
    raise RuntimeError("nobody foresaw this")


def writer_of(path: Path, backlog: Backlog, told: list[tuple[str, Severity]]) -> FileWriter:
    return FileWriter(
        path,
        Options(min_free_mb=0.0),
        backlog,
        [DroneRecord("alpha")],
        [Trap("alpha", Capabilities("test"), CLOCK)],
        CLOCK,
        lambda text, severity: told.append((text, severity)),
    )


def applied(number: int) -> Item:
    return Item(0, "commands", Rank.KEPT, number, Applied(number, 1, 1, number, number, Idle(), Idle()), 400)


def test_a_sample_that_cannot_be_written_is_left_out_and_counted(tmp_path: Path) -> None:
    backlog, path = Backlog(MB), tmp_path / "f.mcap"
    writer = writer_of(path, backlog, [])
    writer.start()
    for item in (applied(1), Item(0, "logs", Rank.KEPT, 2, "bad", 400), applied(3)):
        backlog.put(item)
    writer.stop()
    assert writer.state is RecorderState.CLOSED
    assert [one.sequence for one in files.of(path, "/alpha/commands")] == [1, 3]
    assert backlog.dropped == {(0, "logs"): 1}
    assert (writer.unwritable, "nobody foresaw this" in writer.unwritable_why) == (1, True)


def test_a_writer_that_dies_is_reported_at_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    backlog, path = Backlog(MB), tmp_path / "f.mcap"
    told: list[tuple[str, Severity]] = []
    writer = writer_of(path, backlog, told)
    writer.start()
    backlog.put(applied(1))
    files.until(lambda: len(files.of(path, "/alpha/commands")) == 1, "the first command is written")

    monkeypatch.setattr(RecordingFile, "write", burst)
    backlog.put(applied(2))
    files.until(lambda: writer.state is RecorderState.FAILED, "the state says so")
    writer.stop()
    assert "nobody foresaw this" in writer.reason
    assert [one.sequence for one in files.of(path, "/alpha/commands")] == [1], "committed samples stay"
    text, severity = told[-1]
    assert severity is Severity.ERROR
    assert "has ended" in text
    assert str(path) in text


class Rig:
    """A proxy in this process with a drone that records it and one that listens."""

    def __init__(self, stack: Any) -> None:
        self.server = MemoryServer("alpha")
        self.proxy = stack.enter_context(Proxy(FakeVehicle(), self.server, name="alpha"))
        self.drone = self.connect(stack, "me")
        self.other = self.connect(stack, "other", access="observe")

    def connect(self, stack: Any, app: str, **options: Any) -> Drone:
        drone = open_drone(self.server.dial, app=app, **options, timeout_s=WAIT_S)
        stack.callback(drone.close)
        return drone


@pytest.fixture
def rig() -> Any:
    with ExitStack() as stack:
        yield Rig(stack)


def test_a_dead_recorder_is_reported_to_its_owner_and_to_all(
    rig: Rig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    events: list[Event] = []
    logged: list[LogEntry] = []
    rig.drone.on_event(events.append, inline=True)
    rig.other.on_log(logged.append, inline=True)
    with skyloop.record(rig.drone, tmp_path / "f.mcap", min_free_mb=0, in_process=True) as recorder:
        files.until(lambda: recorder.state is RecorderState.RECORDING and recorder.status.messages > 3, "it records")
        monkeypatch.setattr(RecordingFile, "commit", burst)
        files.until(lambda: recorder.state is RecorderState.FAILED, "the state says so")
        files.until(lambda: any("has ended" in (one.text or "") for one in logged), "everybody who listens is told")
    told = [event for event in events if event.kind is EventKind.RECORDING and event.severity is Severity.ERROR]
    assert "nobody foresaw this" in told[-1].text
    assert recorder.state is RecorderState.FAILED


def test_a_sample_that_cannot_be_recorded_is_reported_with_the_reason(rig: Rig, tmp_path: Path) -> None:
    events: list[Event] = []
    rig.drone.on_event(events.append, inline=True)
    with skyloop.record(rig.drone, tmp_path / "f.mcap", min_free_mb=0, in_process=True) as recorder:
        backend = recorder._backend
        assert isinstance(backend, Engine)
        backend._backlog.put(Item(0, "logs", Rank.KEPT, time.monotonic_ns(), object(), 400))
        files.until(lambda: any("leaves out 1 of logs: can't be written" in one.text for one in events), "it is told")
        assert recorder.state is RecorderState.RECORDING
        assert recorder.dropped == {"alpha": {"logs": 1}}


def test_the_command_ends_when_the_recording_has_failed(
    rig: Rig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    with skyloop.record(rig.drone, tmp_path / "f.mcap", min_free_mb=0, in_process=True) as recorder:
        monkeypatch.setattr(RecordingFile, "commit", burst)
        shown = threading.Thread(target=command._show, args=(recorder, 3600.0), daemon=True)
        shown.start()
        shown.join(WAIT_S)
        assert not shown.is_alive()
        with pytest.raises(SkyloopError, match="nobody foresaw this"):
            command._conclude(recorder)
    assert "failed" in capsys.readouterr().out


def test_a_librarys_output_in_the_recorders_process_does_not_end_its_reports(monkeypatch: pytest.MonkeyPatch) -> None:
    news: list[RecorderEvent] = []
    process = object.__new__(RecorderProcess)

    class Child:
        returncode = 1

        def wait(self) -> int:
            return 1

    lines = [b"a library says hello\n", b'{"event":{"text":"raises"}}\n', b'{"event":{"text":"received"}}\n']

    class Lines(list[bytes]):
        def __enter__(self) -> Any:
            return self

        def __exit__(self, *_: object) -> None: ...

    def hear(one: RecorderEvent) -> None:
        if one.text == "raises":
            raise RuntimeError("who hears may raise anything")
        news.append(one)

    child: Any = Child()
    child.stdout = Lines(lines)
    process._process = child
    process._on_event = hear
    process._notifier = Notifier()
    process._trouble = None
    process._status = Status(state=RecorderState.RECORDING, path="f.mcap")
    child.ending, child.quoted_output = "ended with exit code 1", ""
    process._listen()
    assert process.status.state is RecorderState.FAILED
    assert [one.text.split(";")[0] for one in news] == ["received", "the recorder's process ended with exit code 1"]


def test_feedback_is_recorded_beside_invalid_samples(rig: Rig, tmp_path: Path) -> None:
    """A log entry that no client would send: the proxy counts it, and the recording continues."""
    path = tmp_path / "f.mcap"
    with skyloop.record(rig.drone, path, min_free_mb=0, in_process=True) as recorder:
        for packet in (
            log_entry(values=[0.0], shape=[2**62, 3]),
            log_entry(text="late", at_ns=2**64 - 1),
            log_entry(name="mocap", values=[float("nan")] * 7, shape=[7]),
        ):
            assert rig.other._connection.transmit(packet)
        files.until(lambda: rig.proxy._counts["packets.malformed"] == 3, "all three are counted")
        assert rig.other.log.text("the last word")
        files.until(lambda: len(files.of(path, "/alpha/logs")) >= 1, "what comes after them is recorded")
        before = recorder.status.messages
        files.until(lambda: recorder.status.messages > before, "feedback too")
    assert recorder.state is RecorderState.CLOSED
    assert recorder.dropped == {}


def test_invalid_numbers_from_the_vehicle_are_unknown(rig: Rig) -> None:
    came: list[Feedback] = []
    rig.other.on_feedback(came.append, inline=True)
    events: list[Event] = []
    rig.other.on_event(events.append, inline=True)
    bad = Feedback(captured_ns=1, yaw_rad=float("nan"), altitude_m=2.0, velocity_m_s=(0.0, float("inf"), 0.0))
    rig.proxy.publisher.feedback(bad)
    files.until(lambda: any(one.captured_ns == 1 for one in came), "it came")
    (sample,) = [one for one in came if one.captured_ns == 1]
    assert (sample.yaw_rad, sample.altitude_m, sample.velocity_m_s) == (None, 2.0, None)
    files.until(lambda: any("yaw_rad, velocity_m_s were NaN" in one.text for one in events), "it is told")
