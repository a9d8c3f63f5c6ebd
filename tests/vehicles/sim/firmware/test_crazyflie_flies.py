"""A real Crazyflie's firmware flies in the simulator, if it is installed.

``SKYLOOP_CRAZYFLIE`` is the program's path; see ``docs/autopilots.md``. It uses the computer's clock.
"""

from __future__ import annotations

import math
import os
import signal
import time
from collections.abc import Callable
from contextlib import ExitStack, suppress
from pathlib import Path

import pytest

import skyloop
from benchmarks.autopilots import compared, take_off
from skyloop.errors import RefusedError
from skyloop.messages import Failsafe, FlightState, LinkState
from skyloop.vehicles.sim.firmware.crazyflie import VARIABLE
from tests.support.processes import PILOTS, Process, eventually, proxy, sockets, start
from tests.vehicles.sim.firmware.suite import process_in

__all__ = ["proxy", "sockets", "start"]  # fixtures

pytestmark = [
    pytest.mark.process,
    pytest.mark.flight,
    pytest.mark.timeout(400),
    pytest.mark.skipif(not os.environ.get(VARIABLE), reason=f"{VARIABLE} is not set (docs/autopilots.md)"),
]

PROGRAM = str(Path(os.environ.get(VARIABLE, "")).resolve())
FLIGHT = "sim://?autopilot=crazyflie&world=empty&cameras=none&wind=0"
WORLD = str(Path(__file__).with_name("crazyflie_world.py"))
PATIENCE_S = 60.0
SIDE_M = 1.0
HEIGHT_M = 1.0
MOST_OFF_M = 0.15


@pytest.fixture(autouse=True)
def _cache(monkeypatch: pytest.MonkeyPatch, tmp_path_factory: pytest.TempPathFactory) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.getbasetemp() / "crazyflie"))


def truth(drone: skyloop.Drone) -> tuple[float, float, float]:
    native = drone.feedback().native or {}
    x, y, z = (float(str(native[f"truth.{axis}"])) for axis in "xyz")
    return x, y, z


def ready(drone: skyloop.Drone) -> None:
    eventually(lambda: drone.link.vehicle is LinkState.UP, "its link is up", PATIENCE_S)
    eventually(lambda: drone.feedback().state is FlightState.LANDED, "it is on the ground", PATIENCE_S)
    eventually(lambda: drone.feedback().position_m is not None, "its place is known", PATIENCE_S)


def go(drone: skyloop.Drone, x: float, y: float) -> None:
    """Fly there as a person would: again if a busy computer held the pilot's process up and the drone hovers."""
    for _ in range(5):
        with suppress(RefusedError):
            return drone.go_to(x=x, y=y, z=HEIGHT_M, timeout_s=PATIENCE_S)
    raise AssertionError([event.text for event in drone.recent_events()])


def heights_m(told: Path) -> list[float]:
    """Return the heights that a world has told so far."""
    return [float(line) for line in told.read_text().split("\n")[:-1]]


def test_it_flies_a_square_and_is_safe_without_link_pilot_or_firmware(
    proxy: Callable[..., Process], start: Callable[..., Process], tmp_path: Path
) -> None:
    proxy(f"{FLIGHT}&autopilot_folder={tmp_path}")
    with skyloop.connect("alpha", access="observe") as observer:
        with ExitStack() as flight:
            drone = flight.enter_context(skyloop.connect("alpha"))
            ready(drone)
            take_off(drone)
            with compared(observer) as agreement:
                off = [_corner(drone, x, y) for x, y in ((1, 0), (1, 1), (0, 1), (0, 0))]
            assert max(off) < MOST_OFF_M, off
            row = agreement.row()
            assert row.position_m is not None
            assert row.position_m.rms < MOST_OFF_M, row
            print("corners off by", [round(each, 3) for each in off], row)
            for cut_s in (1.0, 3.0):
                _hovers_without_its_link(drone, cut_s)
        _lands_without_its_pilot(observer, start)
        with skyloop.connect("alpha") as drone:
            _comes_back_after_its_death(drone, tmp_path)


def _corner(drone: skyloop.Drone, x: float, y: float) -> float:
    go(drone, x * SIDE_M, y * SIDE_M)
    time.sleep(2.0)  # it comes to rest
    return math.dist(truth(drone), (x * SIDE_M, y * SIDE_M, HEIGHT_M))


def _hovers_without_its_link(drone: skyloop.Drone, cut_s: float) -> None:
    begun_s = time.monotonic()
    while time.monotonic() < begun_s + 1.0:
        drone.velocity(forward=0.3)
        time.sleep(0.05)
    place = truth(drone)
    drone.config["sim.link"] = False
    time.sleep(cut_s)
    drone.config["sim.link"] = True
    eventually(lambda: drone.link.vehicle is LinkState.UP, "it is found again", PATIENCE_S)
    moved = math.dist(truth(drone), place)
    print(f"link cut for {cut_s} s: moved {moved:.2f} m to {truth(drone)}")
    assert drone.feedback().state.airborne
    assert moved < 1.0
    assert truth(drone)[2] > HEIGHT_M / 2
    go(drone, 0.0, 0.0)


def _lands_without_its_pilot(observer: skyloop.Drone, start: Callable[..., Process]) -> None:
    pilot = start(PILOTS, "fly", "alpha")
    pilot.until("flying", PATIENCE_S)
    observer.wait(lambda feedback: (feedback.velocity_m_s or (0.0,))[0] > 0.2, timeout_s=PATIENCE_S)
    pilot.signal(signal.SIGKILL)
    begun_s = time.monotonic()
    observer.wait(lambda feedback: feedback.failsafe is Failsafe.HOVER, timeout_s=10.0)
    hover_s = time.monotonic() - begun_s
    observer.wait(lambda feedback: feedback.failsafe is Failsafe.LAND, timeout_s=PATIENCE_S)
    land_s = time.monotonic() - begun_s
    observer.wait("landed", timeout_s=PATIENCE_S)
    print(
        f"pilot killed: hover {hover_s:.2f} s, landing {land_s:.2f} s, landed {time.monotonic() - begun_s:.2f} s later"
    )


def _comes_back_after_its_death(drone: skyloop.Drone, folder: Path) -> None:
    ready(drone)
    take_off(drone)
    first = process_in(folder, PROGRAM)
    os.kill(first, signal.SIGKILL)
    begun_s = time.monotonic()
    eventually(lambda: drone.link.vehicle is LinkState.LOST, "the loss is reported", PATIENCE_S)
    lost_s = time.monotonic() - begun_s
    ready(drone)
    print(f"firmware killed: lost {lost_s:.2f} s, ready again {time.monotonic() - begun_s:.2f} s later")
    assert process_in(folder, PROGRAM) not in (0, first)
    assert truth(drone)[2] < 0.1, "its rotors stopped"
    take_off(drone)
    drone.land(timeout_s=PATIENCE_S)


@pytest.mark.parametrize("velocity", [True, False])
def test_it_hovers_without_its_proxy_and_is_landed_by_the_next(
    velocity: bool, proxy: Callable[..., Process], start: Callable[..., Process], tmp_path: Path
) -> None:
    """Its high-level commander continues: it does not fall when its proxy dies, even while velocities are sent."""
    told = tmp_path / "heights"
    world = start(WORLD, str(told))
    world.until("flies", PATIENCE_S)
    address = world.text.partition("address ")[2].split()[0]
    first = proxy(address)
    with skyloop.connect("alpha") as drone:
        ready(drone)
        take_off(drone)
        begun_s = time.monotonic()
        while velocity and time.monotonic() < begun_s + 1.5:
            drone.velocity(forward=0.3)
            time.sleep(0.05)
        first.signal(signal.SIGKILL)
    before = len(heights_m(told))
    time.sleep(6.0)
    heights = heights_m(told)[before:]
    assert min(heights) > 0.5, heights
    print(f"proxy killed (velocity: {velocity}): height {min(heights):.2f} to {max(heights):.2f} m for 6 s")
    proxy(address)
    with skyloop.connect("alpha") as drone:
        eventually(lambda: drone.feedback().state.airborne, "it is found in the air", PATIENCE_S)
        drone.land(timeout_s=PATIENCE_S)
    eventually(lambda: heights_m(told)[-1] < 0.1, "it is on the ground", PATIENCE_S)


def test_several_fly_at_once(start: Callable[..., Process], tmp_path: Path) -> None:
    words = ("--world", "empty", "--option", "cameras=none", "--option", f"autopilot_folder={tmp_path}")
    several = start("-m", "skyloop", "sim", "--autopilot", "crazyflie", "--drones", "2", *words)
    several.until("ready sim2", PATIENCE_S)
    with skyloop.connect("sim1") as one, skyloop.connect("sim2") as two:
        for drone in (one, two):
            ready(drone)
            take_off(drone)
        places = truth(one), truth(two)
        assert math.dist(*places) > 0.5
        assert all(place[2] > 0.5 for place in places)
        for drone in (one, two):
            drone.land(timeout_s=PATIENCE_S)
    folders = [tmp_path / "drone1", tmp_path / "drone2"]
    assert all(process_in(folder, PROGRAM) for folder in folders)
    several.signal(signal.SIGKILL)
    eventually(lambda: not any(process_in(folder, PROGRAM) for folder in folders), "both end with it", PATIENCE_S)
