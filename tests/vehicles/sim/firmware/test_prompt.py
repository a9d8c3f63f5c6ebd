"""Prompt wake-ups, as far as permissions allow."""

from __future__ import annotations

import ctypes
import os
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

from skyloop.vehicles.sim.firmware.betaflight import Betaflight
from skyloop.vehicles.sim.firmware.keeper import NICENESS, SLACK_NS, become_prompt, hasten


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
    become_prompt()
    assert asked[0][1] == SLACK_NS
    assert asked[1][1] == os.SCHED_RR
    assert asked[2] == (os.PRIO_PROCESS, 0, NICENESS)


def test_with_permissions_it_runs_ahead_of_all_ordinary_processes(
    asked: list[tuple[object, ...]], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(os, "sched_setscheduler", lambda *what: asked.append(what))
    become_prompt()
    assert len(asked) == 2


def test_elsewhere_nothing_happens(asked: list[tuple[object, ...]], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "platform", "darwin")
    become_prompt()
    assert asked == []


def test_the_simulation_of_firmware_that_keeps_the_clock_goes_before_others(monkeypatch: pytest.MonkeyPatch) -> None:
    """Beside eight busy programs its firmware was on time and the simulation at half of it: it rose, and fell."""
    niceness = dict.fromkeys((str(thread) for thread in (11, 12)), 3)
    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.setattr(Path, "iterdir", lambda _: iter([Path("/proc/self/task/11"), Path("/proc/self/task/12")]))
    monkeypatch.setattr(os, "getpriority", lambda _, thread: niceness[str(thread)])
    monkeypatch.setattr(os, "setpriority", lambda _, thread, value: niceness.update({str(thread): value}))
    firmware = Betaflight(print)
    monkeypatch.setattr("skyloop.vehicles.sim.firmware.betaflight.program_path", lambda: "betaflight")
    firmware._open()
    assert set(niceness.values()) == {3 + NICENESS}
    firmware.close()
    firmware.close()
    assert set(niceness.values()) == {3}


def test_without_rights_it_stays_as_it_is(asked: list[tuple[object, ...]]) -> None:
    hasten(NICENESS)
    assert asked
