"""A firmware's process: found, started, watched, restarted, ended."""

from __future__ import annotations

import os
import queue
import signal
import sys
import time
from pathlib import Path

import pytest

from skyloop.errors import UsageError
from skyloop.vehicles.sim.firmware.program import (
    AT_ONCE,
    FirmwareEvent,
    FirmwareEventKind,
    Launch,
    Program,
    UnresponsiveError,
    find_program,
)

pytestmark = pytest.mark.process

SLEEPS = (sys.executable, "-S", "-c", "import time; print('awake', flush=True); time.sleep(60)")
FAILS = (sys.executable, "-S", "-c", "print('first line'); raise SystemExit('no sensors found')")
LONG_S = 60.0


class Watched:
    """A program whose events are recorded."""

    def __init__(self, command: tuple[str, ...], **options: object) -> None:
        self.events: queue.Queue[FirmwareEvent] = queue.Queue()
        self.program = Program("Testware", lambda _: Launch(command), self.events.put, restart_s=0.05, **options)  # type: ignore[arg-type]

    def __enter__(self) -> Watched:
        self.program.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.program.close()

    def next(self, kind: FirmwareEventKind) -> str:
        event = self.events.get(timeout=LONG_S)
        assert event.kind is kind, event
        return event.text


def gone(pid: int) -> bool:
    end_s = time.monotonic() + LONG_S
    while time.monotonic() < end_s:
        try:
            os.kill(pid, 0)
        except ProcessLookupError:
            return True
        time.sleep(0.01)
    return False


def test_a_failed_start_is_retried() -> None:
    starts = [0]

    def verify() -> None:
        starts[0] += 1
        if starts[0] == 1:
            raise ConnectionError("it does not listen")

    with Watched(SLEEPS, verify=verify) as watched:
        assert "it does not listen" in watched.next(FirmwareEventKind.FAILED)
        watched.next(FirmwareEventKind.STARTED)
    assert starts == [2]


def test_it_runs_until_closed_and_leaves_nothing_behind() -> None:
    with Watched(SLEEPS) as watched:
        text = watched.next(FirmwareEventKind.STARTED)
        pid = watched.program.pid
        assert str(pid) in text
        assert watched.program.running
        assert watched.program.starts == 1
        folder = Path(f"/proc/{pid}/cwd").resolve()
        assert folder.is_dir()
    assert gone(pid)
    assert not folder.exists()
    assert watched.events.empty()
    watched.program.close()  # a second close does no harm


def test_a_killed_process_is_restarted() -> None:
    with Watched(SLEEPS) as watched:
        watched.next(FirmwareEventKind.STARTED)
        os.kill(watched.program.pid, signal.SIGKILL)
        assert watched.next(FirmwareEventKind.DIED).startswith("Testware was killed by SIGKILL")
        watched.next(FirmwareEventKind.STARTED)
        assert watched.program.starts == 2


def test_its_last_output_is_in_the_event_and_the_folder_stays(tmp_path: Path) -> None:
    with Watched(FAILS, folder=tmp_path / "kept") as watched:
        watched.next(FirmwareEventKind.STARTED)
        text = watched.next(FirmwareEventKind.DIED)
        assert text.startswith("Testware ended with exit code 1; its output ends with:")
        assert text.endswith("first line\nno sensors found")
    assert "no sensors found" in (tmp_path / "kept" / "firmware.log").read_text()


@pytest.mark.parametrize("code", [129, 255])
def test_an_exit_code_is_not_a_signal_unless_one_has_its_number(code: int) -> None:
    told = {129: "Testware was killed by SIGHUP", 255: "Testware ended with exit code 255"}
    with Watched((sys.executable, "-S", "-c", f"import os; os._exit({code})")) as watched:
        watched.next(FirmwareEventKind.STARTED)
        assert watched.next(FirmwareEventKind.DIED) == told[code]


def test_one_that_does_not_answer_is_restarted_at_once_but_not_forever() -> None:
    def verify() -> None:
        raise UnresponsiveError("it does not listen")

    with Watched(SLEEPS, verify=verify) as watched:
        for _ in range(AT_ONCE + 2):
            assert watched.next(FirmwareEventKind.DEAF) == "Testware is started again: it does not listen"


def test_it_ends_with_its_keeper() -> None:
    with Watched(SLEEPS) as watched:
        watched.next(FirmwareEventKind.STARTED)
        pid = watched.program.pid
        child = watched.program._child
        assert child is not None
        child.kill()
        assert gone(pid)
        watched.next(FirmwareEventKind.DIED)


def test_a_stopped_process_can_be_ended() -> None:
    with Watched(SLEEPS) as watched:
        watched.next(FirmwareEventKind.STARTED)
        pid = watched.program.pid
        os.kill(pid, signal.SIGSTOP)
    assert gone(pid)


def test_one_that_cannot_be_started_is_retried() -> None:
    with Watched(("/nowhere/at/all",)) as watched:
        assert "No such file" in watched.next(FirmwareEventKind.FAILED)
        watched.next(FirmwareEventKind.FAILED)


def test_programs_are_found_by_variable_or_on_the_path(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    program = tmp_path / "testware"
    program.write_text("")
    monkeypatch.setenv("SKYLOOP_TESTWARE", str(program))
    with pytest.raises(UsageError, match=r"SKYLOOP_TESTWARE is '.*', which is not a program"):
        find_program("SKYLOOP_TESTWARE", ("testware",), "Testware", "It is here.")
    program.chmod(0o755)
    assert find_program("SKYLOOP_TESTWARE", ("testware",), "Testware", "It is here.") == str(program)
    monkeypatch.delenv("SKYLOOP_TESTWARE")
    with pytest.raises(UsageError, match=r"set SKYLOOP_TESTWARE to its path\. It is here\."):
        find_program("SKYLOOP_TESTWARE", ("testware",), "Testware", "It is here.")
    monkeypatch.setenv("PATH", str(tmp_path))
    assert find_program("SKYLOOP_TESTWARE", ("testware",), "Testware", "It is here.") == str(program)
