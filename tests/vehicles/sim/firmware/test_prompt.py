"""Prompt wake-ups, as far as permissions allow."""

from __future__ import annotations

import ctypes
import os
import sys
from types import SimpleNamespace

import pytest

from skyloop.vehicles.sim.firmware.keeper import NICENESS, SLACK_NS, become_prompt


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
