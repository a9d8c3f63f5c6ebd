"""``skyloop audit``, and the proxies that write its trail."""

from __future__ import annotations

import json
import signal
from collections.abc import Callable
from pathlib import Path

import pytest

import skyloop
from tests.support.commands import FAST_SIM, Run
from tests.support.processes import Process

Start = Callable[..., Process]


@pytest.fixture(autouse=True)
def state(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))


def flown(start: Start, *arguments: str) -> None:
    """Start a proxy, fly it, and end it."""
    proxy = start("proxy", FAST_SIM, "--name", "alpha", *arguments)
    proxy.until("ready")
    with skyloop.connect("alpha", name="alice", authority=skyloop.Authority(priority=7)) as drone:
        drone.takeoff()
    proxy.signal(signal.SIGINT)
    proxy.wait()


def test_the_audit_trail_is_empty_at_first(run: Run) -> None:
    assert run("audit").out.startswith("The audit trail has no flights yet")
    ended = run("audit", "alpha")
    assert ended.code == 2
    assert "no named proxy of this user has run yet" in ended.err
    assert "skyloop audit --file ./mine.jsonl" in run("audit", "./mine.jsonl").err


@pytest.mark.process
def test_who_flew_when(start: Start, run: Run) -> None:
    flown(start)
    for arguments in ((), ("alpha",), ("alpha", "--last", "1")):
        head, line = run("audit", *arguments).out.splitlines()
        assert head.split() == ["DRONE", "WHO", "IDENTITY", "PRIORITY", "FROM", "TO", "TAKE-OFFS", "HOW", "IT", "ENDED"]
        assert line.startswith("alpha  alice  ")
        assert line.endswith("released")
    [row] = json.loads(run("audit", "--json").out)
    assert (row["who"], row["priority"], row["takeoffs"], row["how"]) == ("alice", 7, 1, "released")
    assert "process" in row["identity"] or "pid" in row["identity"]
    assert row["begin"] < row["end"]
    ended = run("audit", "alpah")
    assert ended.code == 2
    assert "did you mean 'alpha'" in ended.err


@pytest.mark.process
def test_a_custom_audit_file(start: Start, run: Run, tmp_path: Path) -> None:
    path = tmp_path / "mine.jsonl"
    flown(start, "--audit", str(path))
    with path.open("a") as file:
        file.write('{"torn')
    ended = run("audit", "--file", str(path))
    assert "alice" in ended.out
    assert "Skipped 1 line that can't be parsed" in ended.err
    assert run("audit", "bravo", "--file", str(path)).out.startswith("The audit trail has no flights yet")
    assert run("audit").out.startswith("The audit trail has no flights yet")


def test_an_unusable_file_is_refused(run: Run, tmp_path: Path) -> None:
    assert "can't be read" in run("audit", "--file", str(tmp_path / "none")).err
    ended = run("proxy", FAST_SIM, "--audit", str(tmp_path))
    assert ended.code == 2
    assert "can't be written: Is a directory" in ended.err
