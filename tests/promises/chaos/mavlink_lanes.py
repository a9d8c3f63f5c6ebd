"""Lanes whose vehicle is an emulated ArduCopter, hosted by ``skyloop host``, and the faults they can suffer.

A program flies one of them. A person flies the other: the cockpit page's own logic, with a gamepad, over a serial port.
"""

from __future__ import annotations

import random
import shutil
import socket
import subprocess
import sys
import threading
import time
from functools import partial
from pathlib import Path
from typing import Final

from skyloop.clock import monotonic_ns
from tests.promises.chaos.judge import SLACK_S
from tests.promises.chaos.lanes import Fault, Lane, fork, pilot_stop, proxy_kill, tail
from tests.promises.chaos.processes import Process

PAGE: Final = Path(__file__).resolve().parents[3] / "cockpit-page"
ESBUILD: Final = PAGE / "node_modules" / ".bin" / "esbuild"
REST_S: Final = 4.0  #: The pause between a landing and the next take-off: any flight during it is unrequested.
COMES_WITHIN_S: Final = 40.0
ATTEMPTS: Final = 6


class MavlinkLane(Lane):
    """``place``: UDP port of the proxy, or the path of its serial port; None: a free port."""

    def __init__(self, name: str, folder: Path, place: str | None = None) -> None:
        self.place = place or str(_free_udp_port())
        self.folder, self.disk = folder, folder / "disk"
        self.name, self._pilots_rooms = name, folder / "run"
        self.vehicle = self.run("autopilot", name, str(folder), self.place)
        self.vehicle.until("ready")
        super().__init__(name, folder)

    def processes(self) -> dict[str, Process]:
        """Also the vehicle, which no fault kills."""
        return {**super().processes(), "vehicle": self.vehicle}

    def until(self, what: str, since_ns: int, ending: threading.Event) -> bool:
        """Wait until the vehicle journals this. False if all faults ended first."""
        deadline = time.monotonic() + COMES_WITHIN_S
        while not any(entry.what == what and entry.at_ns > since_ns for entry in tail(self._vehicle_path)):
            if ending.wait(0.1):
                return False
            if time.monotonic() > deadline:
                raise RuntimeError(f"{what} did not come within {COMES_WITHIN_S:g} s")
        return True

    @property
    def state(self) -> str:
        """The last state in the vehicle's journal."""
        return self._vehicle_path.read_text().rpartition(" state:")[2].split()[0]

    def _start_proxy(self) -> Process:
        place = f"udpin:127.0.0.1:{self.place}" if self.place.isdecimal() else f"serial:{self.place}:921600"
        return self.run("fleet", self.name, str(self.folder), f"mavlink://{place}?parameters=no")

    def _start_pilot(self) -> Process:
        self.proxy.until("ready")
        return self.run("pilot", self.name, str(self.folder), "--rest", str(REST_S))


class PageLane(MavlinkLane):
    """Flown by the page's own logic under node, through a cockpit, over a serial port (a pty)."""

    transit_s = SLACK_S  # nothing shows when bytes have left the port

    def __init__(self, name: str, folder: Path) -> None:
        self.cockpit: Process | None = None
        super().__init__(name, folder, str(folder / f"{name}.tty"))

    @staticmethod
    def missing() -> str:
        """The requirement that this machine lacks; empty if there is none."""
        if shutil.which("node") is None:
            return "node"
        return "" if ESBUILD.exists() else "npm ci in cockpit-page"

    def processes(self) -> dict[str, Process]:
        """Also the cockpit."""
        cockpit = {} if self.cockpit is None else {"cockpit": self.cockpit}
        return {**super().processes(), **cockpit}

    def resume(self, ending: threading.Event) -> None:
        """Centre the sticks, take off if it stands, and push them again. A press that arrives too late is repeated."""
        self.pilot.order("centre")
        ending.wait(0.5)
        since_ns = monotonic_ns()
        if self.state in ("landing", "emergency") and not self.until("state:landed", since_ns, ending):
            return
        if self.state == "landed":
            if (self.folder / f"{self.name}.pilot").exists():  # it flew before
                ending.wait(REST_S)
            for attempt in range(ATTEMPTS):
                if attempt:
                    self.pilot.order("reset")
                    ending.wait(1.0)
                self.pilot.order("takeoff")
                ending.wait(2.0)
                if ending.is_set() or self.state != "landed":
                    break
            else:
                raise RuntimeError(f"it did not take off in {ATTEMPTS} attempts")
        self.pilot.order("push")

    def _start_pilot(self) -> Process:
        program = self.folder / f"{self.name}.mjs"
        bundle = ("--bundle", "--platform=node", "--format=esm", "--log-level=error", f"--outfile={program}")
        subprocess.run([ESBUILD, "tests/chaos.ts", *bundle], cwd=PAGE, check=True)
        launch = partial(Process, log=self.folder / f"{self.name}.log", environment=self.environment())
        self.proxy.until("ready")
        self.cockpit = launch(sys.executable, "-m", "skyloop.cockpit", self.name, "--port", "0")
        address = self.cockpit.until("/\n").strip()
        journal = str(self.folder / f"{self.name}.pilot")
        node = ("node", "--no-warnings", "--experimental-websocket")
        return launch(*node, str(program), address, self.name, journal)


def second_battery(lane: Lane, source: random.Random, ending: threading.Event) -> None:
    """The vehicle reports two batteries in turn, and the second is nearly empty."""
    assert isinstance(lane, MavlinkLane)
    lane.vehicle.order("battery 1")
    ending.wait(source.uniform(4.0, 8.0))
    lane.vehicle.order("battery 0")


def late_packet(lane: Lane, source: random.Random, ending: threading.Event) -> None:
    """An ATTITUDE arrives more than a second late."""
    assert isinstance(lane, MavlinkLane)
    for _ in range(source.choice((1, 3))):
        lane.vehicle.order(f"late {source.uniform(1.05, 2.5):.3f}")
        ending.wait(3.0)


def port_change(lane: Lane, source: random.Random, ending: threading.Event) -> None:
    """The vehicle switches to another UDP port in flight."""
    assert isinstance(lane, MavlinkLane)
    for _ in range(source.choice((1, 2))):
        lane.vehicle.order("port")
        ending.wait(source.uniform(1.0, 3.0))


def removal_while_starting(lane: Lane, source: random.Random, ending: threading.Event) -> None:
    """Other vehicles are removed from the same host while they start."""
    troublemaker = lane.run("trouble", "remove_starting", lane.name, str(source.randrange(1 << 30)))
    try:
        troublemaker.until("ready")
    except RuntimeError as error:
        lane.complaints.append(f"removal while starting: {error}; its reason is in the lane's log")
    finally:
        troublemaker.kill()


def landed_in_its_takeoff(lane: Lane, source: random.Random, ending: threading.Event) -> None:
    """Another station lands the vehicle during a ``takeoff(wait=False)``."""
    assert isinstance(lane, MavlinkLane)
    begin_ns = monotonic_ns()
    lane.vehicle.order("land")
    if lane.until("state:landed", begin_ns, ending):
        down_ns = monotonic_ns()
        lane.vehicle.order(f"land_at {source.uniform(0.2, 1.2):.2f}")
        lane.until("other:land", down_ns, ending) and lane.until("state:landed", down_ns, ending)


def tip_over(lane: Lane, source: random.Random, ending: threading.Event) -> None:
    """The vehicle is disarmed during its take-off, as when it tips over."""
    assert isinstance(lane, MavlinkLane)
    begin_ns = monotonic_ns()
    lane.vehicle.order("land")
    if lane.until("state:landed", begin_ns, ending):
        lane.vehicle.order(f"tip {source.choice((0.0, 0.05, 0.3, 0.8))}")
        lane.until("other:tip", begin_ns, ending)
        ending.wait(1.0)


def full_serial_port(lane: Lane, source: random.Random, ending: threading.Event) -> None:
    """The serial port's output buffer stays full for seconds."""
    _fill_up(lane, ending, source.choice((1.0, 2.0, 5.0)))


def busy_serial_port(lane: Lane, source: random.Random, ending: threading.Event) -> None:
    """The serial port's output buffer is full for a moment."""
    _fill_up(lane, ending, source.uniform(0.1, 0.3))


def _fill_up(lane: Lane, ending: threading.Event, seconds: float) -> None:
    assert isinstance(lane, MavlinkLane)
    lane.vehicle.order(f"full {seconds:.3f}")
    ending.wait(seconds + 2.0)


def lost_stop(lane: Lane, source: random.Random, ending: threading.Event) -> None:
    """The first packets of an emergency stop are lost while its pilot holds the sticks, until after the reset."""
    assert isinstance(lane, PageLane)
    lane.vehicle.order(f"lose_stops {source.choice((1, 1, 3))}")
    begin_ns = monotonic_ns()
    lane.pilot.order("stop")
    lane.until("disarmed", begin_ns, ending)
    ending.wait(3.0)
    lane.pilot.order("reset")
    ending.wait(1.5)


def gamepad_swap(lane: Lane, source: random.Random, ending: threading.Event) -> None:
    """The gamepad is unplugged, and another one with deflected sticks is plugged in."""
    assert isinstance(lane, PageLane)
    lane.pilot.order("swap")
    ending.wait(source.uniform(1.0, 3.0))
    lane.pilot.order("back")


#: Faults of the other lanes are repeated here where a host, or a vehicle that outlives it, may behave differently.
MAVLINK: Final[tuple[Fault, ...]] = (
    second_battery,
    late_packet,
    port_change,
    removal_while_starting,
    landed_in_its_takeoff,
    tip_over,
    fork,
    pilot_stop,
    proxy_kill,
)
HANDS: Final[tuple[Fault, ...]] = (full_serial_port, busy_serial_port, lost_stop, gamepad_swap)


def _free_udp_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])
