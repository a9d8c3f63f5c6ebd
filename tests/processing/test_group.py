"""Several children: together, restarted, ended."""

from __future__ import annotations

import os
import signal
import sys
from pathlib import Path

import msgspec
import pytest

from skyloop.processing.group import USAGE_ERROR, ProcessGroup
from skyloop.processing.worker import Status
from skyloop.transport.testing import wait_until

pytestmark = pytest.mark.process

LINE = msgspec.json.encode(Status(processor="d", camera="front", parts=2, results=3)).decode()
#: Reports its status once, prints other text, and ends with its standard input.
WORKS = f"import sys\nprint('hello', flush=True)\nprint({LINE!r}, flush=True)\nsys.stdin.read()\n"


def command(code: str) -> list[str]:
    return [sys.executable, "-c", code]


def total(group: ProcessGroup) -> int:
    status = group.status
    return 0 if status is None else status.results


def gone(pid: int) -> bool:
    return not Path(f"/proc/{pid}").exists()


def test_children_are_summed_restarted_and_ended() -> None:
    told: list[str] = []
    with ProcessGroup(command(WORKS), 2, told.append, pause_s=0.01) as group:
        wait_until(lambda: total(group) == 6, "both have told how they do")
        before = group.pids
        os.kill(before[0], signal.SIGKILL)
        wait_until(lambda: total(group) == 6 and group.pids[0] != before[0], "another one took its place")
        assert told == ["worker 1 was killed by signal 9: the others process its share until it restarts"]
        pids = group.pids
    assert all(gone(pid) for pid in pids)


def test_an_exit_code_is_reported() -> None:
    told: list[str] = []
    with ProcessGroup(command("raise SystemExit(3)"), 1, told.append, pause_s=0.01) as group:
        wait_until(lambda: group.code is None and len(told) >= 2, "it failed again and again")
    assert "ended with exit code 3" in told[0]


@pytest.mark.parametrize(("codes", "end"), [((0, 0), 0), ((0, USAGE_ERROR), USAGE_ERROR)])
def test_it_ends_when_all_have_ended_or_one_can_never_work(tmp_path: Path, codes: tuple[int, int], end: int) -> None:
    for number, code in enumerate(codes):
        (tmp_path / f"{number}-{code}").touch()
    takes_one = (
        "import os, pathlib, sys\n"
        f"for path in sorted(pathlib.Path({str(tmp_path)!r}).iterdir()):\n"
        "    try:\n        path.unlink()\n"
        "    except FileNotFoundError:\n        continue\n"
        "    sys.exit(int(path.name[2:]))\n"
    )
    with ProcessGroup(command(takes_one), 2, print) as group:
        wait_until(lambda: group.code is not None, "they ended")
        assert group.code == end


def test_a_child_that_does_not_end_is_killed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("skyloop.processing.group.GRACE_S", 0.05)
    deaf = "import signal, time\nsignal.signal(signal.SIGTERM, signal.SIG_IGN)\n"
    stubborn = f"{deaf}print({LINE!r}, flush=True)\ntime.sleep(60)"
    with ProcessGroup(command(stubborn), 1, print) as group:
        wait_until(lambda: total(group) == 3, "it runs")
        [pid] = group.pids
    assert gone(pid)
