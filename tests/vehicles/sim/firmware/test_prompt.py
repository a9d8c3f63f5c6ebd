"""Prompt wake-ups, as far as permissions allow."""

from __future__ import annotations

import ctypes
import os
import sys
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import Mock

import pytest

from skyloop.vehicles.sim.firmware.betaflight import Betaflight
from skyloop.vehicles.sim.firmware.keeper import NICENESS, SLACK_NS, request_real_time
from tests.support.systems import only_on

pytestmark = only_on("linux", "darwin", reason="no firmware runs there")


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> list[tuple[object, ...]]:
    """Return the requests to the system, which refuses all of them."""
    asked: list[tuple[object, ...]] = []

    def refuse(*what: object) -> None:
        asked.append(what)
        raise PermissionError

    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.setattr(ctypes, "CDLL", lambda _: SimpleNamespace(prctl=lambda *what: asked.append(what)))
    monkeypatch.setattr(os, "sched_setscheduler", refuse, raising=False)
    monkeypatch.setattr(os, "setpriority", refuse, raising=False)
    return asked


def test_without_permissions_it_uses_what_needs_none(asked: list[tuple[object, ...]]) -> None:
    request_real_time()
    assert asked[0][1] == SLACK_NS
    assert asked[1][1] == os.SCHED_RR
    assert asked[2] == (os.PRIO_PROCESS, 0, NICENESS)


def test_with_permissions_it_runs_ahead_of_all_ordinary_processes(
    asked: list[tuple[object, ...]], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(os, "sched_setscheduler", lambda *what: asked.append(what))
    request_real_time()
    assert len(asked) == 2


def test_elsewhere_nothing_happens(asked: list[tuple[object, ...]], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "platform", "darwin")
    request_real_time()
    assert asked == []


def test_the_simulation_of_firmware_that_keeps_the_clock_goes_before_others(monkeypatch: pytest.MonkeyPatch) -> None:
    """Beside eight busy programs its firmware was on time and the simulation at half of it: it rose, and fell."""
    niceness = threads(monkeypatch, least=-20)
    first, second = Betaflight(print), Betaflight(print)
    first._open()
    second._open()
    assert niceness == {"11": 3 + NICENESS, "12": 5 + NICENESS}
    niceness["13"] = 3 + NICENESS  # started meanwhile
    first.close()
    assert niceness["11"] == 3 + NICENESS, "the other still flies"
    second.close()
    second.close()
    assert niceness == {"11": 3, "12": 5, "13": 5}


def test_without_rights_it_stays_as_it_is(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its closing made the whole process slower: it undid what had been refused."""
    niceness = threads(monkeypatch, least=0)
    firmware = Betaflight(print)
    firmware._open()
    firmware.close()
    assert niceness == {"11": 3, "12": 5}


def threads(monkeypatch: pytest.MonkeyPatch, *, least: int) -> dict[str, int]:
    """Return the niceness of two threads of this process, which can't be lowered below ``least``."""
    niceness = {"11": 3, "12": 5}

    def change(_: int, thread: int, value: int) -> None:
        if value < least:
            raise PermissionError
        niceness[str(thread)] = value

    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.setattr(Path, "iterdir", lambda _: iter([Path("/proc/self/task") / thread for thread in niceness]))
    monkeypatch.setattr(os, "getpriority", lambda _, thread: niceness[str(thread)])
    monkeypatch.setattr(os, "setpriority", change)
    monkeypatch.setattr("skyloop.vehicles.sim.firmware.betaflight.program_path", lambda: "betaflight")
    monkeypatch.setattr("skyloop.vehicles.sim.firmware.betaflight.reserve_instance", lambda *_: 1)
    monkeypatch.setattr("skyloop.vehicles.sim.firmware.betaflight.release_instance", lambda *_: None)
    monkeypatch.setattr("skyloop.vehicles.sim.firmware.betaflight.bound", lambda *_: Mock())
    return niceness
