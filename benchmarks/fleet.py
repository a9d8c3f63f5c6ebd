"""Fly a hundred vehicles of one host from one process, and measure arrivals, delays and costs."""

from __future__ import annotations

import gc
import os
import sys
import threading
import time
from array import array
from collections.abc import Callable, Sequence
from contextlib import ExitStack, suppress
from itertools import cycle
from typing import Final, NamedTuple

import msgspec

from benchmarks import mavlink_fleet
from benchmarks.mavlink_fleet import MavlinkResult
from benchmarks.measuring.contract import Arrivals, Received, picture
from benchmarks.measuring.machine import cpu_time_s, memory_bytes
from benchmarks.measuring.ours import Listening
from benchmarks.measuring.pair import since
from benchmarks.measuring.schedule import (
    CHANNELS,
    COMMAND,
    FEEDBACK,
    SETTLE_S,
    VIDEO,
    WARM_UP_S,
    Turn,
    paced,
    sleep_until,
)
from benchmarks.measuring.statistics import Summary, summarize
from benchmarks.measuring.waypoints import fly
from benchmarks.measuring.workers import Pipe, Worker, Workers
from benchmarks.scale import FRAME_PERIOD_S, loopback
from skyloop.bench import CAMERA, BenchVehicle, Machine, stamped
from skyloop.client import Drone, connect
from skyloop.client.drone import Access
from skyloop.clock import SWITCH_INTERVAL_S
from skyloop.drivers.uri import VehicleUri
from skyloop.errors import SkyloopError
from skyloop.host.fleet import VehicleSettings
from skyloop.host.host import Host
from skyloop.messages import AnyAction
from skyloop.network import FabricSettings
from skyloop.transport.local.directory import DIRECTORY_VARIABLE

_AHEAD_NS: Final = 200_000_000
_ANSWERS_WITHIN_S: Final = 180.0
OBSERVERS_AT_ONCE: Final = 10  #: number of connections of one observing process

Progress = Callable[[float, str], None]


class Case(NamedTuple):
    """A combination to measure."""

    vehicles: int
    observers: int = 0  #: observers of the first vehicle's feedback and video
    network: str = ""  #: the host's address on the fabric; empty for the local transport
    busy_s: float = 0.0  #: processor time of each vehicle's driver for a command [s]

    @property
    def name(self) -> str:
        watched = f", {self.observers} observers of one" if self.observers else ""
        busy = f", {1e3 * self.busy_s:g} ms per command" if self.busy_s else ""
        return f"{self.vehicles} vehicles{watched}{busy}, {'fabric' if self.network else 'local'}"


class CaseResult(msgspec.Struct, frozen=True):
    """One case. Channels: ``command``, ``feedback``, and ``feedback, observers`` and ``video, observers``."""

    vehicles: int
    observers: int
    network: bool  #: whether over the fabric instead of the local transport
    channels: dict[str, Summary]
    shares: dict[str, float]  #: fraction of each channel's samples that arrived
    cpu: dict[str, float]  #: cores in use by host, pilot and observers
    vehicle_mb: float  #: memory of the host for each vehicle, beyond that of a host with one
    threads: dict[str, int]
    opened_s: float  #: time the pilot took to connect to all
    busy_s: float = 0.0  #: processor time of each vehicle's driver for a command [s]


class HostedFleet(msgspec.Struct, frozen=True, tag_field="what", tag="fleet"):
    """A whole run, as in ``fleet.json``."""

    machine: Machine
    seconds: float
    cases: list[CaseResult]
    mavlink: MavlinkResult | None = None


def cases_of(vehicles: int, observers: int, networked: int, busy_s: float = 0.0) -> list[Case]:
    """Return the cases to measure: the vehicles alone, with observers of one, and some over the network."""
    cases = [Case(vehicles, busy_s=busy_s)] if vehicles else []
    if vehicles and observers:
        cases.append(Case(vehicles, observers, busy_s=busy_s))
    if networked:
        cases.append(Case(networked, network=loopback(0), busy_s=busy_s))
    return cases


def measure(
    seconds: float, cases: Sequence[Case], progress: Progress = lambda _share, _what: None, *, mavlink: int = 0
) -> HostedFleet:
    """Measure each case.

    Args:
        seconds: Duration of each case [s].
        cases: The cases.
        progress: Called with the fraction done, 0 to 1, and the next step.
        mavlink: Number of emulated MAVLink vehicles in another case; 0 for none.
    """
    machine, results = Machine.here(), []
    count = len(cases) + bool(mavlink)
    for number, case in enumerate(cases):
        progress(number / count, case.name)
        with Workers() as workers:
            results.append(_play(case, workers, seconds))
    flown = None
    if mavlink:
        progress(len(cases) / count, f"{mavlink} emulated MAVLink vehicles")
        flown = mavlink_fleet.measure(mavlink, seconds)
    return HostedFleet(machine, seconds, results, flown)


def _play(case: Case, workers: Workers, seconds: float) -> CaseResult:
    turn = Turn(0, seconds, frame_period_s=FRAME_PERIOD_S)
    host = workers.start(serve, case)
    host.answer(_ANSWERS_WITHIN_S)
    pilot = workers.start(fly_all, case)
    opened_s = pilot.answer(_ANSWERS_WITHIN_S)
    firsts = range(0, case.observers, OBSERVERS_AT_ONCE)
    shares = [min(OBSERVERS_AT_ONCE, case.observers - first) for first in firsts]
    watching = [workers.start(observe, case, count) for count in shares]
    for worker in watching:
        worker.answer(_ANSWERS_WITHIN_S)
    parts = {"host": [host], "pilot": [pilot], "observers": watching}
    begin_ns = time.monotonic_ns() + round(WARM_UP_S * 1e9) + _AHEAD_NS
    for worker in (host, pilot):
        worker.pipe.send((turn, begin_ns))
    sleep_until(begin_ns)
    before_s = _used_s(parts)
    sleep_until(begin_ns + round(seconds * 1e9))
    cores = {part: (used_s - before_s[part]) / seconds for part, used_s in _used_s(parts).items()}
    in_time_s = seconds + SETTLE_S + _ANSWERS_WITHIN_S
    applied, host_threads, vehicle_mb = host.answer(in_time_s)
    received, pilot_threads = pilot.answer(in_time_s)
    delays = {
        COMMAND: since(applied, begin_ns).get(COMMAND, []),
        FEEDBACK: since(received, begin_ns).get(FEEDBACK, []),
    }
    sent = {COMMAND: case.vehicles * turn.count(COMMAND), FEEDBACK: case.vehicles * turn.count(FEEDBACK)}
    for worker in watching:
        worker.pipe.send("end")
    seen = [since(worker.answer(_ANSWERS_WITHIN_S), begin_ns) for worker in watching]
    if seen:
        for channel in (FEEDBACK, VIDEO):
            name = f"{channel}, observers"
            delays[name] = [each for found in seen for each in found.get(channel, [])]
            sent[name] = sum(shares) * turn.count(channel)
    return CaseResult(
        case.vehicles,
        case.observers,
        bool(case.network),
        {
            name: summarize(
                [arrived - sent_at for sent_at, arrived in found],
                sent=sent[name],
                period_s=turn.period_s(name.partition(",")[0]),
            )
            for name, found in delays.items()
            if found
        },
        {name: min(1.0, len(found) / sent[name]) for name, found in delays.items()},
        cores,
        vehicle_mb,
        {"host": host_threads, "pilot": pilot_threads},
        opened_s,
        case.busy_s,
    )


class _BusyVehicle(BenchVehicle):
    """A vehicle whose driver computes for some time with each command."""

    def __init__(self, received: Received, busy_s: float) -> None:
        super().__init__(received)
        self._busy_s = busy_s

    def _apply(self, action: AnyAction) -> AnyAction:
        until_s = time.thread_time() + self._busy_s
        while time.thread_time() < until_s:
            pass
        return super()._apply(action)


class _Recorder:
    """Stores arrivals as numbers, because a hundred thousand tuples keep Python's collector busy for 60 ms."""

    def __init__(self) -> None:
        self._stamps: dict[str, array[int]] = {channel: array("q") for channel in CHANNELS}

    def received(self, channel: str, sent_ns: int) -> None:
        """Record that a sample of a channel arrived now. Any thread."""
        self._stamps[channel].extend((sent_ns, time.monotonic_ns()))

    @property
    def arrivals(self) -> Arrivals:
        """The arrivals so far."""
        return {channel: list(zip(kept[::2], kept[1::2], strict=True)) for channel, kept in self._stamps.items()}


def _used_s(parts: dict[str, list[Worker]]) -> dict[str, float]:
    return {part: sum(cpu_time_s(worker.pid) for worker in workers) for part, workers in parts.items() if workers}


def serve(pipe: Pipe, case: Case) -> None:
    """Run the host's process."""
    sys.setswitchinterval(SWITCH_INTERVAL_S)
    recorder = _Recorder()
    vehicles: list[BenchVehicle] = []

    def make(_: VehicleUri) -> BenchVehicle:
        if case.busy_s:
            vehicles.append(_BusyVehicle(recorder.received, case.busy_s))
        else:
            vehicles.append(BenchVehicle(recorder.received))
        return vehicles[-1]

    host = Host(lambda _: None, make)
    plain = VehicleSettings("", VehicleUri("bench"))
    if case.network:
        plain = VehicleSettings("", VehicleUri("bench"), network="multicast", multicast=False, listen=(case.network,))
    settings = [msgspec.structs.replace(plain, name=name) for name in _names(case)]
    host.add(settings[0])
    one = memory_bytes(os.getpid())
    for each in settings[1:]:
        host.add(each)
    pipe.send("ready")
    try:
        asked = pipe.recv()
        if asked is None:
            return
        turn, begin_ns = asked
        threads = [threading.Thread(target=_publish, args=(vehicles, turn, begin_ns))]
        if case.observers:
            threads.append(threading.Thread(target=_show, args=(vehicles[0], turn, begin_ns)))
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        time.sleep(SETTLE_S)
        each_mb = (memory_bytes(os.getpid()) - one) / 1e6 / max(1, case.vehicles - 1)
        pipe.send((recorder.arrivals, threading.active_count(), each_mb))
        pipe.recv()
    finally:
        host.close()


def _publish(vehicles: Sequence[BenchVehicle], turn: Turn, begin_ns: int) -> None:
    """Make all vehicles publish feedback at its rate, spread over the period as in a fleet."""
    apart_ns = turn.period_s(FEEDBACK) * 1e9 / len(vehicles)
    moments = (
        at + round(number * apart_ns) for at in turn.deadlines_ns(FEEDBACK, begin_ns) for number in range(len(vehicles))
    )
    for _, vehicle in zip(paced(moments), cycle(vehicles), strict=False):
        vehicle.publish_feedback(time.monotonic_ns())


def _show(vehicle: BenchVehicle, turn: Turn, begin_ns: int) -> None:
    image = picture(turn.size)
    for _ in paced(turn.deadlines_ns(VIDEO, begin_ns)):
        vehicle.show(time.monotonic_ns(), image)


def fly_all(pipe: Pipe, case: Case) -> None:
    """Run the pilot's process: one program flies all, with a command for each at the same moment."""
    recorder = _Recorder()
    if case.network:  # in another directory, because proxies found on this host are not looked for on the network
        os.environ[DIRECTORY_VARIABLE] = f"/tmp/skyloop-{os.getpid()}-nobody"
    opening_s = time.monotonic()
    with ExitStack() as stack:
        drones = []
        for name in _names(case):
            drones.append(_connect(case, name, "pilot"))
            stack.callback(drones[-1].close)
            drones[-1].on_feedback(Listening(recorder.received).feedback, inline=True)
        pipe.send(time.monotonic() - opening_s)
        asked = pipe.recv()
        if asked is None:
            return
        turn, begin_ns = asked
        gc.collect()
        gc.freeze()  # otherwise the collector scans the objects of a hundred connections for 60 ms
        for _, (forward, left, yaw_rate) in zip(paced(turn.deadlines_ns(COMMAND, begin_ns)), fly(), strict=False):
            for drone in drones:
                with suppress(SkyloopError):  # not sent, so not applied: counted as lost
                    drone.velocity(forward=forward, left=left, up=stamped(time.monotonic_ns()), yaw_rate=yaw_rate)
        time.sleep(SETTLE_S)
        pipe.send((recorder.arrivals, threading.active_count()))


def observe(pipe: Pipe, case: Case, count: int) -> None:
    """Run some observers of the first vehicle's feedback and video, in one process."""
    recorder = _Recorder()
    with ExitStack() as stack:
        for _ in range(count):
            drone = stack.enter_context(_connect(case, _names(case)[0], "observe"))
            listening = Listening(recorder.received)
            drone.on_feedback(listening.feedback, inline=True)
            drone.on_frame(listening.frame, camera=CAMERA, inline=True)
        pipe.send("ready")
        pipe.recv()
        pipe.send(recorder.arrivals)


def _names(case: Case) -> list[str]:
    return [f"fleet-{number}" for number in range(case.vehicles)]


def _connect(case: Case, name: str, access: Access) -> Drone:
    network = FabricSettings(connect=(case.network,), multicast=False) if case.network else False
    return connect(name, access=access, name="bench", on_exit="hover", network=network, timeout_s=20.0)


if __name__ == "__main__":
    from benchmarks.command import main

    main("fleet")
