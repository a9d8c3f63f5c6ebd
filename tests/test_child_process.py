"""Child processes: they end when they are told to, at once or after signals, and with their parent."""

from __future__ import annotations

import os
import select
import signal
import subprocess
import sys
import textwrap
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from skyloop.child_process import ChildProcess, on_parent_end

SOURCE = Path(__file__).parents[1] / "src"


@contextmanager
def running(code: str, *, keep_errors: bool = True) -> Iterator[ChildProcess]:
    child = ChildProcess([sys.executable, "-c", textwrap.dedent(code)], keep_errors=keep_errors)
    try:
        yield child
    finally:
        child.close(0.0, 0.0)


@pytest.mark.process
@pytest.mark.daily
def test_a_child_ends_when_its_input_does_and_its_last_words_stay_known() -> None:
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
        assert child.last_words.endswith("no vehicle")
        assert len(child.last_words) <= 2000


@pytest.mark.process
def test_one_that_does_not_end_is_terminated_and_at_last_killed() -> None:
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
            assert child.ending == f"was killed by signal {last.value}"
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


def test_the_end_of_the_parents_pipe_is_heard() -> None:
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


def test_a_fork_leaves_the_child_of_its_parent_alone() -> None:
    """What a fork of this process does to its copy of the object; the process itself goes on."""
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
