"""``skyloop preflight``: the checklist of a drone, for people and for programs."""

from __future__ import annotations

import json
from collections.abc import Callable

from tests.support.commands import Run
from tests.support.processes import Process


def test_the_checklist_for_people_and_programs(run: Run, start: Callable[..., Process]) -> None:
    start("proxy", "sim://?world=empty&battery=0.05", "--name", "empty").until("ready")
    ended = run("preflight", "empty")
    assert ended.code == 1, "its battery is empty"
    assert "✗ battery: 5% left, below 10% (battery.land)" in ended.out
    assert "→ charge or change it" in ended.out
    found = {finding["check"]: finding for finding in json.loads(run("preflight", "empty", "--json").out)}
    assert found["battery"]["level"] == "fail"
    assert found["link"]["level"] == "ok"
    assert set(found["zones"]) == {"check", "level", "detail", "why", "remedy"}
