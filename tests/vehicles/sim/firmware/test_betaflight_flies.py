"""Real Betaflight flies in the simulator, if it is installed (see ``docs/autopilots.md``).

It uses the computer's clock, and takes seconds before it can be armed, so each test does as much as fits in a flight.
"""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, suppress
from pathlib import Path

import pytest

import skyloop
from benchmarks.autopilots import compared, follow
from skyloop.control import FIVE_GATES, FlyThroughGates
from skyloop.errors import NoAnswerError, RefusedError
from skyloop.messages import Failsafe, FlightState, LinkState
from skyloop.vehicles.sim.firmware import ports
from skyloop.vehicles.sim.firmware.betaflight import program_path
from tests.support.processes import PILOTS, Process, eventually, proxy, sockets, start
from tests.vehicles.sim.firmware.real_betaflight import real_betaflight
from tests.vehicles.sim.firmware.suite import process_in

__all__ = ["proxy", "sockets", "start"]  # fixtures

pytestmark = [pytest.mark.process, pytest.mark.flight, pytest.mark.timeout(400)]

FLIGHT = "sim://?autopilot=betaflight&cameras=front"
PATIENCE_S = 60.0
TAKEOFF_S = 20.0
IN_VIEW = 0.9
MOST_RMS_DEG = 2.0
MOST_RMS_M = 0.5
CUT_S = 2.0
GATES = 3


@pytest.fixture(autouse=True)
def _real() -> Iterator[None]:
    with real_betaflight():
        yield


def flags(drone: skyloop.Drone) -> str:
    return str((drone.feedback().native or {}).get("arming.flags", "none known"))


def is_paralyzed(drone: skyloop.Drone) -> bool:
    """Switch PARALYZE off and on, which Betaflight accepts only once it was off 5 s or more after its start."""
    for width_us in (1000, 2000):
        drone.config["msp.aux3"] = width_us
        time.sleep(0.3)
    return flags(drone) == "PARALYZE"


def height_m(drone: skyloop.Drone) -> float:
    return float(str((drone.feedback().native or {})["truth.z"]))


def take_off(drone: skyloop.Drone) -> None:
    """Take off as a person would: again if a stall of the pilot's process ended its commands."""
    for _ in range(3):
        with suppress(NoAnswerError, RefusedError):
            return drone.takeoff(timeout_s=TAKEOFF_S)
    raise AssertionError([event.text for event in drone.recent_events()])


def climb_to(drone: skyloop.Drone, height: float) -> None:
    position = drone.feedback().position_m
    assert position is not None
    drone.go_to(x=position[0], y=position[1], z=height, timeout_s=PATIENCE_S)


def ready(drone: skyloop.Drone) -> None:
    """Wait until it would let itself be armed."""
    eventually(lambda: drone.link.vehicle is LinkState.UP and flags(drone) == "", "arming is possible", PATIENCE_S)


@pytest.mark.alone
def test_it_follows_the_marker_and_is_safe_without_link_pilot_or_firmware(
    proxy: Callable[..., Process], start: Callable[..., Process], tmp_path: Path
) -> None:
    proxy(f"{FLIGHT}&autopilot_folder={tmp_path}")
    with skyloop.connect("alpha", access="observe") as observer:
        with ExitStack() as flight:
            drone = flight.enter_context(skyloop.connect("alpha"))
            ready(drone)
            _is_refused_by_name(drone)
            _comes_back_after_its_death(drone, tmp_path)
            with compared(observer) as agreement:
                for _ in range(3):  # again if a stall of the pilot's process made the drone land
                    take_off(drone)
                    score = follow(drone, 30.0).score
                    if score.frames:
                        break
                assert (score.share_in_view or 0.0) >= IN_VIEW, score
                _survives_a_cut(drone)
                flight.close()  # another one keeps flying
                _lands_without_its_pilot(observer, start)
        row = agreement.row()
        for angle in (row.roll_deg, row.pitch_deg, row.yaw_deg):
            assert angle.rms < MOST_RMS_DEG, row
        assert row.position_m is not None
        assert row.position_m.rms < MOST_RMS_M, row
        print(f"in view {score.share_in_view:.1%}", row)


def _is_refused_by_name(drone: skyloop.Drone) -> None:
    eventually(lambda: is_paralyzed(drone), "it has its reason, until its restart", PATIENCE_S)
    with pytest.raises(RefusedError, match="the flight controller refuses to arm: PARALYZE"):
        drone.takeoff(timeout_s=PATIENCE_S)
    assert drone.feedback().state is FlightState.LANDED


def _comes_back_after_its_death(drone: skyloop.Drone, folder: Path) -> None:
    first = process_in(folder, program_path())
    os.kill(first, signal.SIGKILL)

    def told(reason: str) -> bool:
        return any(event.data.get("reason") == reason for event in drone.recent_events())

    eventually(lambda: told("firmware_died") and told("firmware_started"), "both are reported", PATIENCE_S)
    eventually(lambda: flags(drone) == "", "the next one can be armed", PATIENCE_S)
    assert process_in(folder, program_path()) not in (0, first)


def _survives_a_cut(drone: skyloop.Drone) -> None:
    """It continues level, sinking slightly, and is then flown further, as set up by ``SETTINGS`` in its coupling."""
    climb_to(drone, 2.2)
    drone.hover()
    drone.config["sim.link"] = False
    eventually(lambda: drone.link.vehicle is LinkState.LOST, "the loss is reported")
    time.sleep(CUT_S)
    drone.config["sim.link"] = True
    eventually(lambda: drone.link.vehicle is LinkState.UP, "it is found again")
    eventually(lambda: drone.feedback().position_m is not None, "its position is known")
    assert drone.feedback().state.airborne
    assert (drone.feedback().native or {})["armed"] is True
    climb_to(drone, 1.2)
    assert 0.8 < height_m(drone) < 1.6


def _lands_without_its_pilot(observer: skyloop.Drone, start: Callable[..., Process]) -> None:
    pilot = start(PILOTS, "fly", "alpha")
    pilot.until("flying", PATIENCE_S)
    observer.wait(lambda feedback: (feedback.velocity_m_s or (0.0,))[0] > 0.2, timeout_s=PATIENCE_S)
    pilot.signal(signal.SIGKILL)
    observer.wait(lambda feedback: feedback.failsafe is Failsafe.HOVER, timeout_s=10.0)
    observer.wait(lambda feedback: feedback.failsafe is Failsafe.LAND, timeout_s=PATIENCE_S)
    observer.wait("landed", timeout_s=PATIENCE_S)
    eventually(lambda: (observer.feedback().native or {}).get("armed") is False, "it is disarmed", PATIENCE_S)


def test_another_flies_in_a_separate_network(start: Callable[..., Process], tmp_path: Path) -> None:
    if not ports.is_possible():
        pytest.skip("no network of one's own can be had here: it takes root or user namespaces")
    words = ("--world", "empty", "--option", "cameras=none", "--option", f"autopilot_folder={tmp_path}")
    several = start("-m", "skyloop", "sim", "--autopilot", "betaflight", "--drones", "2", *words)
    several.until("ready sim2", PATIENCE_S)
    folders = [tmp_path / "drone1", tmp_path / "drone2"]
    with skyloop.connect("sim1") as one, skyloop.connect("sim2") as two:
        for drone in (one, two):
            ready(drone)
        places: list[tuple[float, float, float] | None] = [None]

        def placed() -> bool:  # both at once: on a busy machine one may briefly lack a position
            places[:] = [drone.feedback().position_m for drone in (one, two)]
            return None not in places

        eventually(placed, "each knows its position", PATIENCE_S)
        assert places[0] is not None
        assert places[1] is not None
        assert abs(places[0][0] - places[1][0]) > 0.5, "each gets its own position"
        eventually(lambda: is_paralyzed(one), "one has its reason", PATIENCE_S)
        assert flags(two) == "", "the other has none"
    assert all(process_in(folder, program_path()) for folder in folders)
    several.signal(signal.SIGKILL)
    eventually(
        lambda: not any(process_in(folder, program_path()) for folder in folders), "both end with it", PATIENCE_S
    )


@pytest.mark.alone
def test_it_flies_a_course_of_gates(proxy: Callable[..., Process]) -> None:
    proxy(f"{FLIGHT}&world=gates")
    with skyloop.connect("alpha") as drone:
        ready(drone)
        passed = 0
        for _ in range(3):  # again if a stall of the pilot's process made the drone land
            take_off(drone)
            course = FlyThroughGates(drone, FIVE_GATES[passed:GATES])
            course.run(seconds=60.0)
            passed += course.passed
            if passed == GATES:
                return
        raise AssertionError((passed, [event.text for event in drone.recent_events()]))
