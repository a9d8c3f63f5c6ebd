"""Routes from the command line: checked, and flown to their end or an interrupt."""

from __future__ import annotations

import json
import signal
from collections.abc import Callable
from pathlib import Path

import pytest

from skyloop.control import Photo, Route, RouteWaypoint, save_route
from tests.support.commands import FAST_SIM, Run
from tests.support.processes import Process

TOUR = Route(
    waypoints=(RouteWaypoint(1, 0, 1), RouteWaypoint(1, 1, 1.3, actions=(Photo(),)), RouteWaypoint(0, 0, 1)),
    name="tour",
    speed=1.0,
)


@pytest.fixture
def tour(tmp_path: Path) -> Path:
    save_route(TOUR, path := tmp_path / "tour.route.json")
    return path


def test_a_route_is_checked(run: Run, tour: Path, tmp_path: Path) -> None:
    good = run("route", "check", str(tour), "--drone", FAST_SIM)
    assert good.code == 0
    assert "tour: 3 waypoints" in good.out
    save_route(Route(waypoints=(*TOUR.waypoints, RouteWaypoint(50, 0, -3))), far := tmp_path / "far.route.json")
    bad = run("route", "check", str(far), "--drone", FAST_SIM)
    assert bad.code == 1
    assert "error: waypoint 4: the place is outside the room" in bad.out
    listed = json.loads(run("route", "check", str(far), "--drone", FAST_SIM, "--json").out)
    assert [one["waypoint"] for one in listed["findings"] if one["severity"] == "error"] == [4]
    refused = run("route", "fly", str(far), "--drone", FAST_SIM)
    assert refused.code != 0
    assert "taking off" not in refused.err
    (tmp_path / "none.route.json").write_text('{"waypoints": [{"x": 1}]}')
    broken = run("route", "check", str(tmp_path / "none.route.json"))
    assert broken.code != 0
    assert "missing required field `y` - at `$.waypoints[0]`" in broken.err


def test_a_route_is_flown_with_its_photo(run: Run, tour: Path, tmp_path: Path) -> None:
    sim = FAST_SIM.replace("cameras=none", "cameras=front&width=64&fps=30")
    flown = run("route", "fly", str(tour), "--drone", sim, "--photos", str(tmp_path / "photos"))
    assert flown.code == 0, flown.err
    for line in ("taking off", "1/3 waypoint reached", "2/3 photo: saved", "3/3 done", "landing"):
        assert line in flown.err
    assert len(list((tmp_path / "photos").glob("*-waypoint2-front.jpg"))) == 1


@pytest.mark.daily
def test_ctrl_c_lands(start: Callable[..., Process], tour: Path) -> None:
    slow = FAST_SIM.replace("speed=6", "speed=2")
    process = start("route", "fly", str(tour), "--drone", slow)
    process.until("1/3 waypoint reached", 60.0)
    process.signal(signal.SIGINT)
    process.until("stopped by Ctrl-C", 30.0)
    process.until("landing", 30.0)
    assert process.wait(30.0) == 1
