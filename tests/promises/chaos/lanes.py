"""A lane: one vehicle's proxy and pilot as processes, and the faults they can suffer."""

from __future__ import annotations

import os
import random
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Final

from skyloop.clock import monotonic_ns
from tests.promises.chaos.journal import Entry, Journal, read
from tests.promises.chaos.judge import Verdict, faults_of, judge
from tests.promises.chaos.processes import Process, Resources

RECOVERS_WITHIN_S: Final = 20.0
TIME_NAMESPACE_S: Final = 5000
TAIL_BYTES: Final = 30_000  #: of a journal: the last 15 s and more


class Lane:
    """One vehicle with its pilot. ``network``: an address at which they meet, else on this host."""

    transit_s = 0.0  #: see :func:`tests.promises.chaos.judge.judge`

    def __init__(self, name: str, folder: Path, *, network: str | None = None) -> None:
        self.name = name
        self.network = network
        self.folder = folder
        self.disk = folder / "disk"
        self.faults = Journal(folder / f"{name}.faults")
        self.complaints: list[str] = []  #: promises broken besides those visible in the journals
        self._pilots_rooms = folder / ("elsewhere" if network else "run")  # where the proxy's socket can't be found
        self.proxy = self._start_proxy()
        self.pilot = self._start_pilot()
        self.baseline: Resources | None = None

    @property
    def socket(self) -> Path:
        """The proxy's socket on this host."""
        return self.folder / "run" / f"{self.name}.sock"

    def settled(self) -> None:
        """Record the proxy's resources while nothing happens."""
        self.baseline = Resources.of(self.proxy.pid)

    def run(self, module: str, *arguments: str, prefix: Sequence[str] = (), remote: bool = False) -> Process:
        """Start a program of this package beside the lane."""
        command = (*prefix, sys.executable, "-m", f"tests.promises.chaos.{module}", *arguments)
        return Process(*command, log=self.folder / f"{self.name}.log", environment=self.environment(remote=remote))

    def environment(self, *, remote: bool = False) -> dict[str, str]:
        """The environment of its programs; ``remote``: of those that must not find the proxy's socket."""
        rooms = self._pilots_rooms if remote else self.folder / "run"
        return {"SKYLOOP_RUNTIME_DIR": str(rooms), "XDG_STATE_HOME": str(self.disk / "state")}

    def restart_proxy(self) -> None:
        """Start a new proxy once the old one is dead; returns when it serves."""
        self.proxy = self._start_proxy()
        self.proxy.until("ready")

    def restart_pilot(self) -> None:
        """Start a new pilot once the old one is dead."""
        self.pilot = self._start_pilot()

    def resume(self, ending: threading.Event) -> None:
        """Do what the pilot needs to fly on after a fault."""

    def processes(self) -> dict[str, Process]:
        """The processes that must be alive at the end."""
        return {"proxy": self.proxy, "pilot": self.pilot}

    def flown_since(self, since_ns: int) -> bool:
        """Whether the vehicle executed a set-point after this time."""
        return any(entry.what == "velocity" and entry.at_ns > since_ns for entry in tail(self._vehicle_path))

    def verdict(self) -> Verdict:
        """Judge its journals."""
        vehicle = read(self._vehicle_path)  # read first, so that each call executed by then is in the pilot's journal
        faults = faults_of(read(self.folder / f"{self.name}.faults"))
        return judge(read(self.folder / f"{self.name}.pilot"), vehicle, faults, transit_s=self.transit_s)

    def close(self) -> None:
        """End its processes."""
        for process in self.processes().values():
            process.kill()
        self.faults.close()

    @property
    def _vehicle_path(self) -> Path:
        return self.folder / f"{self.name}.vehicle"

    def _start_proxy(self) -> Process:
        return self.run("vehicle", self.name, str(self.folder), *([self.network] if self.network else []))

    def _start_pilot(self) -> Process:
        self.proxy.until("ready")  # a search for a name without a proxy fails at once
        arguments = ["--network", self.network] if self.network else []
        return self.run("pilot", self.name, str(self.folder), *arguments, remote=True)


Fault = Callable[[Lane, random.Random, threading.Event], None]


def pilot_stop(lane: Lane, source: random.Random, ending: threading.Event) -> None:
    """The pilot is stopped, and continued."""
    with _stopped(lane.pilot):
        ending.wait(source.choice((0.2, 0.7, 2.5, 7.0)))


def pilot_kill(lane: Lane, source: random.Random, ending: threading.Event) -> None:
    """The pilot dies, and another one replaces it."""
    lane.pilot.kill()
    ending.wait(source.choice((0.1, 1.0, 7.0)))
    lane.restart_pilot()


def proxy_stop(lane: Lane, source: random.Random, ending: threading.Event) -> None:
    """The proxy is stopped, and continued."""
    with _stopped(lane.proxy):
        ending.wait(source.choice((0.2, 0.7, 3.0)))


def proxy_kill(lane: Lane, source: random.Random, ending: threading.Event) -> None:
    """The proxy dies, and another one takes its name."""
    lane.proxy.kill()
    ending.wait(source.choice((0.0, 1.0, 3.0)))
    lane.restart_proxy()


def fork(lane: Lane, source: random.Random, ending: threading.Event) -> None:
    """The pilot forks inside its ``with`` block, and the child ends by ``sys.exit``."""
    children = Path(f"/proc/{lane.pilot.pid}/task/{lane.pilot.pid}/children")
    for _ in range(source.choice((1, 3))):
        lane.pilot.signal(signal.SIGUSR1)
        ending.wait(1.0)
    deadline = time.monotonic() + RECOVERS_WITHIN_S
    while left := children.read_text().strip():
        if time.monotonic() > deadline:
            lane.complaints.append(f"the pilot's children {left} did not end")
            return
        ending.wait(0.1)


def observer_stop(lane: Lane, source: random.Random, ending: threading.Event) -> None:
    """An observer of everything is stopped, and later killed."""
    remote = lane.network is not None
    where = [lane.network] if lane.network else []
    with _running(lane.run("trouble", "observe", lane.name, *where, remote=remote)) as observer, _stopped(observer):
        ending.wait(source.uniform(1.0, 5.0))


def foreign_clock(lane: Lane, source: random.Random, ending: threading.Event) -> None:
    """An observer whose clock started at another time."""
    apart = ("unshare", "--time", "--fork", "--kill-child", "--monotonic", str(TIME_NAMESPACE_S))
    remote = lane.network is not None
    where = [lane.network] if lane.network else []
    with _running(lane.run("trouble", "observe", lane.name, *where, prefix=apart, remote=remote)):
        ending.wait(source.uniform(1.0, 4.0))


def starvation(lane: Lane, source: random.Random, ending: threading.Event) -> None:
    """Compute-bound programs, enough that each core serves three."""
    with ExitStack() as stack:
        for _ in range(2 * (os.cpu_count() or 1)):
            stack.enter_context(_running(lane.run("trouble", "hog")))
        ending.wait(source.uniform(2.0, 6.0))


def silent_flood(lane: Lane, source: random.Random, ending: threading.Event) -> None:
    """Connections that never say hello."""
    with _running(lane.run("trouble", "silent", str(lane.socket))):
        ending.wait(source.uniform(2.0, 5.0))


def garbage_flood(lane: Lane, source: random.Random, ending: threading.Event) -> None:
    """Open connections that send data which is not a packet."""
    with _running(lane.run("trouble", "garbage", str(lane.socket))):
        ending.wait(source.uniform(2.0, 5.0))


def request_flood(lane: Lane, source: random.Random, ending: threading.Event) -> None:
    """Connections that request a lot and read nothing."""
    with _running(lane.run("trouble", "requests", str(lane.socket))):
        ending.wait(source.uniform(2.0, 5.0))


def network_flood(lane: Lane, source: random.Random, ending: threading.Event) -> None:
    """Observers on the network request a lot, and are stopped."""
    assert lane.network is not None
    greedy = lane.run("trouble", "network_requests", lane.name, lane.network, remote=True)
    with _running(greedy), _stopped(greedy):
        ending.wait(source.uniform(2.0, 6.0))


def disk_full(lane: Lane, source: random.Random, ending: threading.Event) -> None:
    """The disk to which the flight is recorded and audited fills up."""
    with _running(lane.run("trouble", "record", lane.name, str(lane.disk))):
        with _running(lane.run("trouble", "fill", str(lane.disk))):
            ending.wait(source.uniform(2.0, 5.0))
        (lane.disk / "ballast").unlink(missing_ok=True)


#: The first four are disruptions, as the judge calls them.
LOCAL: Final[tuple[Fault, ...]] = (
    pilot_stop,
    pilot_kill,
    proxy_stop,
    proxy_kill,
    fork,
    observer_stop,
    starvation,
    silent_flood,
    garbage_flood,
    request_flood,
    disk_full,
    foreign_clock,
)
NETWORK: Final[tuple[Fault, ...]] = (
    pilot_stop,
    pilot_kill,
    proxy_stop,
    proxy_kill,
    fork,
    observer_stop,
    network_flood,
    request_flood,
    foreign_clock,
)


def torment(
    lane: Lane,
    faults: Sequence[Fault],
    source: random.Random,
    ending: threading.Event,
    report: Callable[[str], None],
) -> None:
    """One fault after another, each kind equally often, until ``ending``; waits for recovery after each."""
    while not ending.is_set():
        for fault in source.sample(faults, len(faults)):
            if ending.is_set():
                return
            kind = fault.__name__
            lane.faults.write(f"begin:{kind}")
            report(f"{lane.name}: {kind.replace('_', ' ')}")
            try:
                fault(lane, source, ending)
            except (RuntimeError, OSError, AssertionError) as error:
                report(f"{lane.name}: {kind} could not be done: {error}")
                lane.faults.write(f"broken:{kind}")
            lane.faults.write(f"end:{kind}")
            try:
                lane.resume(ending)
            except RuntimeError as error:
                lane.complaints.append(f"not flown again after {kind}: {error}")
                report(f"{lane.name}: {error}")
            _await_flight(lane, ending)
            ending.wait(source.uniform(0.5, 2.0))


def _await_flight(lane: Lane, ending: threading.Event) -> None:
    """Wait until the vehicle is flown again; after a time limit, leave that to the judge."""
    over_ns = monotonic_ns()
    deadline = time.monotonic() + RECOVERS_WITHIN_S
    while time.monotonic() < deadline and not lane.flown_since(over_ns + 500_000_000):
        if ending.wait(0.1):
            return


def tail(path: Path) -> list[Entry]:
    """The last entries of a journal that is being written."""
    with path.open("rb") as file:
        file.seek(0, os.SEEK_END)
        file.seek(max(0, file.tell() - TAIL_BYTES))
        lines = file.read().decode().splitlines()[1:]
    whole = [line.split() for line in lines if len(line.split()) == 3]
    return [Entry(int(at_ns), what, int(number)) for at_ns, what, number in whole]


@contextmanager
def _stopped(process: Process) -> Iterator[None]:
    process.signal(signal.SIGSTOP)
    try:
        yield
    finally:
        with suppress(ProcessLookupError):
            process.signal(signal.SIGCONT)


@contextmanager
def _running(process: Process) -> Iterator[Process]:
    try:
        process.until("ready")
        yield process
    finally:
        process.kill()
