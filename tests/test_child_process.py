"""Child processes end on request, at once or after signals, and with their parent."""

from __future__ import annotations

import errno
import os
import select
import signal
import subprocess
import sys
import textwrap
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from skyloop.child_process import ChildProcess, RestartingChild, on_parent_end
from skyloop.transport.testing import wait_until
from tests.support.systems import PLATFORM, only_on

SOURCE = Path(__file__).parents[1] / "src"
KILLED = "ended with exit code 1" if PLATFORM == "win32" else "was killed by signal 9"


@contextmanager
def running(code: str, *, keep_errors: bool = True) -> Iterator[ChildProcess]:
    child = ChildProcess([sys.executable, "-c", textwrap.dedent(code)], keep_errors=keep_errors)
    try:
        yield child
    finally:
        child.close(0.0, 0.0)


@pytest.mark.process
@pytest.mark.daily
def test_a_child_ends_with_its_input_and_its_last_output_stays_available() -> None:
    with running(
        "import sys; print('ready', flush=True); sys.stdin.read(); sys.exit('x' * 3000 + 'no vehicle')"
    ) as child:
        assert child.stdout.readline() == b"ready\n"
        assert child.code is None
        assert child.wait(0.0) is None
        assert child.quoted_output == ""
        child.part()
        child.end()
        assert child.code == 1
        child.close()
        child.close()
        assert child.ending == "ended with exit code 1"
        assert child.quoted_output.startswith("; its output:\nxxx")
        assert child.stderr_tail.endswith("no vehicle")
        assert len(child.stderr_tail) <= 2000


@pytest.mark.process
def test_a_child_that_does_not_end_is_terminated_and_finally_killed() -> None:
    stubborn = """
        import signal, time
        signal.signal(signal.SIGTERM, signal.{})
        print("ready", flush=True)
        time.sleep(60)
        """
    for handler, last in (("SIG_DFL", signal.SIGTERM), ("SIG_IGN", signal.SIGKILL)):
        with running(stubborn.format(handler), keep_errors=False) as child:
            child.stdout.readline()
            child.end(0.05, 20.0 if last is signal.SIGTERM else 0.05)
            assert child.ending == (
                "ended with exit code 1" if PLATFORM == "win32" else f"was killed by signal {last.value}"
            )
            assert child.quoted_output == ""


@pytest.mark.process
def test_a_child_ends_with_its_parent() -> None:
    parent = f"""
        import sys, time
        sys.path.insert(0, {str(SOURCE)!r})
        from skyloop.child_process import ChildProcess
        child = ChildProcess([sys.executable, "-c", "import sys; print('x', flush=True); sys.stdin.read(); print('y')"])
        child.stdout.read(1)
        print(child.pid, flush=True)
        time.sleep(60)
        """
    process = subprocess.Popen([sys.executable, "-c", textwrap.dedent(parent)], stdout=subprocess.PIPE)
    assert process.stdout is not None
    with process.stdout as lines:
        descriptor = os.pidfd_open(int(lines.readline()))
    process.kill()
    process.wait()
    try:
        assert select.select([descriptor], [], [], 20.0)[0], "the child lives on"
    finally:
        os.close(descriptor)


def test_a_command_that_can_not_be_started_leaves_nothing() -> None:
    before = set(Path("/proc/self/fd").iterdir())
    with pytest.raises(FileNotFoundError):
        ChildProcess(["/nowhere/skyloop"])
    assert set(Path("/proc/self/fd").iterdir()) <= before


def test_the_end_of_the_parents_pipe_is_detected() -> None:
    reading, writing = os.pipe()
    ended = threading.Event()
    on_parent_end(ended.set, reading)
    os.write(writing, b"whatever")
    assert not ended.wait(0.05)
    os.close(writing)
    assert ended.wait(20.0)
    os.close(reading)
    never_open = threading.Event()
    on_parent_end(never_open.set, reading + 1000)
    assert never_open.wait(20.0), "a pipe that can't be read is as good as ended"


@only_on("linux", reason="makes itself take this system for Windows")
def test_terminating_on_windows_leaves_a_child_time_to_end(monkeypatch: pytest.MonkeyPatch) -> None:
    """There, ending a process kills it. A host's vehicle in a process of its own was left in the air."""
    code = (
        "import signal, sys, threading\n"
        "from skyloop.child_process import on_parent_end\n"
        "sys.platform = 'win32'\n"
        "asked = threading.Event()\n"
        "signal.signal(signal.SIGTERM, lambda *_: asked.set())\n"
        "on_parent_end(asked.set)\n"
        "print('up', flush=True)\n"
        "while not asked.wait(0.05):\n"
        "    pass\n"
        "print('lands first', flush=True)"
    )
    child = ChildProcess([sys.executable, "-c", code])
    assert child.stdout.readline() == b"up\n"
    with monkeypatch.context() as windows:
        windows.setattr(sys, "platform", "win32")
        windows.setattr(child._process, "terminate", child._process.kill)
        os.kill(child.pid, signal.SIGSTOP)  # so that it reads both requests at once
        child.terminate()
        child.terminate()
        os.kill(child.pid, signal.SIGCONT)
        assert child.stdout.readline() == b"lands first\n"
        assert child.wait(20.0) == 0
        child.terminate()
    child.close()


def test_a_fork_leaves_the_child_of_its_parent_alone() -> None:
    """A fork of this process ends its copy of the object; the child process continues."""
    code = "import sys; print('x', flush=True); sys.stdin.read(); print('y', flush=True)"
    child = ChildProcess([sys.executable, "-c", code])
    assert child.stdout.readline() == b"x\n"
    keep = os.dup(child._process.stdin.fileno())  # type: ignore[union-attr]  # the parent's end of the pipe
    child.forked()
    child.terminate()
    child.kill()
    child.end(0.0, 0.0)
    child.close(0.0, 0.0)
    assert child.code is None, "it still runs"
    os.close(keep)
    assert child.stdout.readline() == b"y\n", "no copy of the pipe is left that would keep it running"
    child._ours = True
    child.close()


def restarting(code: str, ended: Callable[[ChildProcess | None, str], float | None]) -> RestartingChild:
    return RestartingChild(
        [sys.executable, "-c", code], name="test-child", read=lambda child: child.stdout.read(), ended=ended
    )


def test_a_failed_restart_is_reported_and_retried(monkeypatch: pytest.MonkeyPatch) -> None:
    """No descriptors were left for a moment: one failed restart must not end the supervision for good."""
    endings: list[str] = []
    real = ChildProcess

    def start(command: Sequence[str], **options: Any) -> ChildProcess:
        if len(endings) == 1:
            raise OSError(errno.EMFILE, "Too many open files")
        return real(command, **options)

    monkeypatch.setattr("skyloop.child_process.ChildProcess", start)
    code = "import sys; sys.stdin.read()"
    child = restarting(code, lambda _, ending: endings.append(ending) or 0.0)  # type: ignore[func-returns-value]
    child.start()
    first = child.child
    assert first is not None
    first.kill()
    wait_until(lambda: child.child not in (None, first), "another one runs")
    assert endings[0] == KILLED
    assert "could not be started" in endings[1]
    assert "Too many open files" in endings[1]
    assert child.restarts == 2
    child.stop()
    assert child.over


def test_no_child_is_started_after_one_that_has_finished() -> None:
    child = restarting("raise SystemExit(2)", lambda *_: None)
    child.start()
    wait_until(lambda: child.over, "it is over")
    assert child.restarts == 0
    child.stop()


def test_a_child_that_can_not_be_started_at_all_raises() -> None:
    child = RestartingChild(["/nowhere/skyloop"], name="test-child", read=lambda _: None, ended=lambda *_: None)
    with pytest.raises(FileNotFoundError):
        child.start()
    child.stop()


def test_a_child_whose_output_can_not_be_read_is_replaced() -> None:
    def read(child: ChildProcess) -> None:
        child.stdout.read(1)
        raise ValueError("not what it should be")

    code = "import sys; print('x', flush=True); sys.stdin.read()"
    child = RestartingChild([sys.executable, "-c", code], name="test-child", read=read, ended=lambda *_: 0.0)
    child.start()
    wait_until(lambda: child.restarts >= 1, "it was started again")
    child.stop()


def test_a_silent_child_is_killed() -> None:
    endings: list[str] = []
    child = RestartingChild(
        [sys.executable, "-c", "import time; time.sleep(60)"],
        name="test-child",
        read=lambda child: child.stdout.read(),
        ended=lambda _, ending: endings.append(ending),
        silent=lambda: True,
    )
    child.start()
    wait_until(lambda: child.over, "it was killed")
    assert endings == [KILLED]
