"""Several real ArduCopters and PX4s in one world, at other speeds, and the effects of one that dies or hangs.

``SKYLOOP_ARDUCOPTER`` and ``SKYLOOP_PX4`` are the paths of the programs; see ``test_flights.py``.
"""

from __future__ import annotations

import os
import signal
import time
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, suppress
from pathlib import Path

import pytest

import skyloop
from benchmarks.autopilots import AgreementRow, compared, take_off, wait_ready
from skyloop.errors import RefusedError
from skyloop.messages import Event, FlightState, LinkState
from skyloop.vehicles.sim.firmware import ardupilot, px4
from tests.support.processes import Process, eventually, sockets, start

__all__ = ["sockets", "start"]  # fixtures

pytestmark = [pytest.mark.process, pytest.mark.slow, pytest.mark.flight, pytest.mark.timeout(600)]

VARIABLES = {"ardupilot": ardupilot.VARIABLE, "px4": px4.VARIABLE}
PROGRAMS = {"ardupilot": "arducopter", "px4": "px4"}
PATIENCE_S = 120.0
SIDE_M = 0.8
HEIGHT_M = 1.5
MOST_WANDER_M = 0.5
#: Of its position, including its mean error: PX4's GPS is wrong by 0.4 m horizontally and 0.7 m in height.
MOST_OFF_M = {"ardupilot": 0.5, "px4": 2.5}
STOPPED_S = 3.0


class Fleet:
    """Drones of one ``skyloop sim``, each flown by its own firmware."""

    def __init__(self, kinds: tuple[str, ...], process: Process, folder: Path, stack: ExitStack) -> None:
        self.kinds = kinds
        self.process = process
        self._folder = folder
        names = [f"sim{n + 1}" for n in range(len(kinds))]
        self.drones = [stack.enter_context(skyloop.connect(name, timeout_s=PATIENCE_S)) for name in names]
        self._events: list[list[Event]] = [[] for _ in kinds]
        self._waited: Counter[tuple[int, str]] = Counter()
        for drone, events in zip(self.drones, self._events, strict=True):
            drone.on_event(events.append)
        for drone in self.drones:
            ready(drone)

    def pid(self, n: int) -> int:
        """Return the process id of a drone's firmware, or 0."""
        folder, name = self._folder / f"drone{n + 1}", PROGRAMS[self.kinds[n]]
        for process in Path("/proc").glob("[0-9]*"):
            with suppress(OSError):
                if (process / "cwd").readlink() == folder and (process / "exe").readlink().name == name:
                    return int(process.name)
        return 0

    def said(self, n: int, reason: str) -> int:
        """Return how often a drone's event happened; ``lost``: the loss of its link."""
        return sum(_is(event, reason) for event in list(self._events[n]))

    def wait_for(self, n: int, reason: str) -> None:
        """Wait for the next event of a drone with this reason."""
        self._waited[n, reason] += 1
        eventually(lambda: self.said(n, reason) >= self._waited[n, reason], reason, PATIENCE_S)

    def signal(self, n: int, number: signal.Signals) -> None:
        pid = self.pid(n)
        assert pid
        os.kill(pid, number)


@pytest.fixture
def fleet(start: Callable[..., Process], tmp_path: Path) -> Iterator[Callable[..., Fleet]]:
    """Start drones of the given kinds in one world; each is ready to take off."""
    with ExitStack() as stack:

        def begin(*kinds: str, speed: float = 1.0) -> Fleet:
            for kind in kinds:
                if not os.environ.get(VARIABLES[kind]):
                    pytest.skip(
                        f"{kind}'s program is not here: {VARIABLES[kind]} must be its path (docs/autopilots.md)"
                    )
            words = [word for kind in kinds for word in ("--autopilot", kind)]
            folder = f"autopilot_folder={tmp_path / 'kept'}"
            process = start(
                *("-m", "skyloop", "sim", *words, "--drones", str(len(kinds)), "--world", "empty"),
                *("--speed", str(speed), "--option", "cameras=none", "--option", folder),
            )
            process.until(f"ready sim{len(kinds)}", PATIENCE_S)
            return Fleet(kinds, process, tmp_path / "kept", stack)

        yield begin


def _is(event: Event, reason: str) -> bool:
    return event.data.get("reason") == reason or (reason == "lost" and event.data.get("state") == "lost")


def ready(drone: skyloop.Drone) -> None:
    """Wait until it can take off."""
    eventually(lambda: drone.link.vehicle is LinkState.UP, "its link is up", PATIENCE_S)
    wait_ready(drone, PATIENCE_S)


def truth(drone: skyloop.Drone) -> tuple[float, float, float]:
    native = drone.feedback().native or {}
    x, y, z = (float(str(native[f"truth.{axis}"])) for axis in "xyz")
    return x, y, z


def go(drone: skyloop.Drone, x: float, y: float) -> None:
    """Fly there as a person would: again if a busy computer held the pilot's process up and the drone hovers."""
    for _ in range(5):
        try:
            drone.go_to(x=x, y=y, z=HEIGHT_M, speed=0.8, timeout_s=PATIENCE_S, tolerance_m=0.3)
        except RefusedError:
            time.sleep(0.5)
        else:
            return
    raise AssertionError([event.text for event in drone.recent_events()])


def fly_square(drone: skyloop.Drone) -> AgreementRow:
    """Take off, fly a square among the others, and land; return how well its state agreed with the truth."""
    take_off(drone)
    x, y, _ = truth(drone)
    with compared(drone) as agreement:
        for east, north in ((SIDE_M, 0.0), (SIDE_M, SIDE_M), (0.0, SIDE_M), (0.0, 0.0)):
            go(drone, x + east, y + north)
    drone.land(timeout_s=PATIENCE_S)
    assert drone.wait(FlightState.LANDED, 10.0).state is FlightState.LANDED
    return agreement.row()


@pytest.mark.parametrize("kinds", [("px4", "px4"), ("ardupilot", "ardupilot"), ("px4", "ardupilot")])
def test_several_fly_in_one_world_and_end_with_it(fleet: Callable[..., Fleet], kinds: tuple[str, ...]) -> None:
    several = fleet(*kinds)
    pids = [several.pid(n) for n in range(len(kinds))]
    assert len(set(pids)) == len(kinds)
    with ThreadPoolExecutor() as threads:
        rows = list(threads.map(fly_square, several.drones))
    for kind, row in zip(kinds, rows, strict=True):
        assert row.position_m is not None
        assert row.position_wander_m is not None
        assert row.position_m.rms < MOST_OFF_M[kind], (kind, row)
        assert row.position_wander_m.rms < MOST_WANDER_M, (kind, row)
        print(kind, row)
    several.process.signal(signal.SIGKILL)
    eventually(lambda: not any(several.pid(n) for n in range(len(kinds))), "all firmware ends with it", PATIENCE_S)


@pytest.mark.parametrize("kind", sorted(VARIABLES))
def test_one_that_dies_or_hangs_is_reported_and_flies_again(fleet: Callable[..., Fleet], kind: str) -> None:
    several = fleet("px4", kind)
    other, drone = several.drones
    take_off(other)
    place = truth(other)
    _dies(several)
    take_off(drone)
    drone.config["sim.link"] = False
    eventually(lambda: drone.link.vehicle is LinkState.LOST, "the loss is reported")
    drone.config["sim.link"] = True
    ready(drone)
    assert drone.feedback().state.airborne
    assert truth(drone)[2] > 0.3
    _dies(several)
    _hangs(several, in_the_air=False)
    take_off(drone)
    _hangs(several, in_the_air=True)
    assert other.feedback().state.airborne
    assert sum((a - b) ** 2 for a, b in zip(truth(other), place, strict=True)) < 1.0, "no other drone is affected"
    other.land(timeout_s=PATIENCE_S)


def _dies(several: Fleet) -> None:
    drone, first = several.drones[1], several.pid(1)
    several.signal(1, signal.SIGKILL)
    several.wait_for(1, "firmware_died")
    several.wait_for(1, "firmware_started")
    several.wait_for(1, "firmware_answers")
    assert several.pid(1) not in (0, first)
    several.wait_for(1, "lost")
    ready(drone)
    assert drone.feedback().state is FlightState.LANDED
    assert truth(drone)[2] < 0.3, "its rotors stopped"


def _hangs(several: Fleet, *, in_the_air: bool) -> None:
    drone = several.drones[1]
    several.signal(1, signal.SIGSTOP)
    several.wait_for(1, "firmware_silent")
    time.sleep(STOPPED_S)
    several.signal(1, signal.SIGCONT)
    several.wait_for(1, "firmware_answers")
    ready(drone)
    if in_the_air:  # it believes that it is flying
        drone.land(timeout_s=PATIENCE_S)
    assert truth(drone)[2] < 0.3


@pytest.mark.parametrize("speed", [0.5, 2.0])
@pytest.mark.parametrize("kind", sorted(VARIABLES))
def test_it_flies_slower_and_faster_than_real_time(fleet: Callable[..., Fleet], kind: str, speed: float) -> None:
    several = fleet(kind, kind, speed=speed)
    drone = several.drones[0]

    def now() -> tuple[float, float]:
        return time.monotonic(), float(str((drone.feedback().native or {})["sim.time_s"]))

    (begun_s, simulated_s), row = now(), fly_square(drone)
    ended_s, ended_simulated_s = now()
    rate = (ended_simulated_s - simulated_s) / (ended_s - begun_s)
    assert 0.1 * speed < rate < 1.05 * speed  # a busy computer is slower, but flies
    assert row.position_wander_m is not None
    assert row.position_wander_m.rms < MOST_WANDER_M, row
    print(kind, speed, rate, row)
