"""Fly half of one host's emulated MAVLink vehicles in formation from one program."""

from __future__ import annotations

import gc
import math
import os
import sys
import time
from array import array
from collections.abc import Mapping, Sequence
from contextlib import ExitStack, suppress
from typing import Final, NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from benchmarks.measuring.machine import cpu_time_s
from benchmarks.measuring.schedule import sleep_until
from benchmarks.measuring.workers import Pipe, Worker, Workers
from skyloop.client import Drone, connect
from skyloop.client.drone import Access
from skyloop.client.swarm import Swarm
from skyloop.clock import SWITCH_INTERVAL_S
from skyloop.drivers.uri import parse_uri
from skyloop.errors import SkyloopError
from skyloop.host.fleet import VehicleSettings
from skyloop.host.host import Host
from skyloop.host.vehicle import SharedVehicle
from skyloop.messages import Feedback, LinkState, Position
from skyloop.sim.host import SimHost
from skyloop.sim.options import SimOptions
from skyloop.vehicles.emulation.emulator import Loop
from skyloop.vehicles.mavlink.emulator import Kind, MavlinkFirmware, Ports, with_multirotors

RATE_HZ: Final = 10.0  #: rate of the vehicles' feedback, and of repeated commands
EMULATED_HZ: Final = 20.0  #: rate of an emulated autopilot
WORLD: Final = 200  #: vehicles of one emulating process, which share a world
LEG_M: Final = 1.0  #: distance of the formation to each side of its start
PERIOD_S: Final = 12.0  #: duration of a flight there and back
TICKS_HZ: Final = 10.0  #: rate of the formation's set-points
_TAKE_OFF_S: Final = 40.0
_ANSWERS_WITHIN_S: Final = 180.0
_UP_WITHIN_S: Final = 60.0
_LOOK_S: Final = 0.2


class MavlinkResult(msgspec.Struct, frozen=True):
    """The result. A vehicle's link counts as lost if it broke during the measurement or was down at its end."""

    vehicles: int
    flown: int  #: vehicles flying in formation at the start
    up: int  #: links up at the start
    lost: int  #: links lost, of these
    share: float  #: fraction of the states reported, :data:`RATE_HZ` a second per vehicle, that the program received
    age_median_ms: float  #: from a state's capture to its arrival in the program
    age_p99_ms: float
    error_p99_m: float | None  #: distance of a vehicle from its place in the formation, at each tick; None if none flew
    error_most_m: float | None
    failed: dict[str, str]  #: vehicles that left their formation, and why
    cpu: dict[str, float]  #: cores in use by host, pilot and emulators


class Flown(NamedTuple):
    """The pilot's report."""

    states: int
    ages_ns: Sequence[int]
    errors_m: Sequence[float]  #: error of each vehicle at each tick
    failed: Mapping[str, str]


def measure(vehicles: int, seconds: float) -> MavlinkResult:
    """Measure.

    Args:
        vehicles: Number of vehicles; every second one flies.
        seconds: Duration [s].

    Raises:
        NoAnswerError: A process did not start, or ended.
    """
    with Workers() as workers:
        ports = Ports.several(Kind.ARDUCOPTER, 0, vehicles)  # at once: separate processes would get the same ports
        emulators = [workers.start(emulate, ports[first : first + WORLD]) for first in range(0, vehicles, WORLD)]
        addresses = [emulator.answer(_ANSWERS_WITHIN_S) for emulator in emulators]
        host = workers.start(serve, [address for each in addresses for address in each])
        up = host.answer(_ANSWERS_WITHIN_S)
        pilot = workers.start(fly, vehicles, seconds)
        flown = pilot.answer(_ANSWERS_WITHIN_S)
        parts = {"host": [host], "pilot": [pilot], "emulators": emulators}
        begin_ns = time.monotonic_ns() + 1_000_000_000
        host.pipe.send((begin_ns, seconds))
        pilot.pipe.send(begin_ns)
        sleep_until(begin_ns)
        before_s = _used_s(parts)
        sleep_until(begin_ns + round(seconds * 1e9))
        cores = {part: (used_s - before_s[part]) / seconds for part, used_s in _used_s(parts).items()}
        lost = host.answer(seconds + _ANSWERS_WITHIN_S)
        seen: Flown = pilot.answer(seconds + _ANSWERS_WITHIN_S)
    ages = np.percentile(seen.ages_ns, (50, 99)) / 1e6 if seen.ages_ns else np.full(2, np.nan)
    return MavlinkResult(
        vehicles,
        flown,
        up,
        lost,
        seen.states / (vehicles * RATE_HZ * seconds),
        float(ages[0]),
        float(ages[1]),
        float(np.percentile(seen.errors_m, 99)) if seen.errors_m else None,
        max(seen.errors_m, default=None),
        dict(seen.failed),
        cores,
    )


def _used_s(parts: Mapping[str, Sequence[Worker]]) -> dict[str, float]:
    return {part: sum(cpu_time_s(worker.pid) for worker in workers) for part, workers in parts.items()}


def emulate(pipe: Pipe, ports: Sequence[Ports]) -> None:
    """Run an emulated ArduCopter on each of these ports, all in one world."""
    world = SimHost(with_multirotors(SimOptions(world="empty"), rate_hz=EMULATED_HZ), len(ports))
    loop = Loop("emulators")
    with ExitStack() as stack:
        made = [
            MavlinkFirmware(world, drone, kind=Kind.ARDUCOPTER, ports=each, loop=loop)
            for drone, each in enumerate(ports)
        ]
        for firmware in made:
            stack.enter_context(firmware)
        gc.collect()
        gc.freeze()  # real vehicles have no common collector that pauses them
        loop.start()
        stack.callback(loop.stop)
        pipe.send([firmware.address for firmware in made])
        pipe.recv()


def serve(pipe: Pipe, addresses: Sequence[str]) -> None:
    """Run the host's process."""
    sys.setswitchinterval(SWITCH_INTERVAL_S)
    host = Host(lambda _: None)
    try:
        host.add_all(
            [
                VehicleSettings(_name(number), parse_uri(f"{each}?rate={RATE_HZ:g}"))
                for number, each in enumerate(addresses)
            ]
        )
        by_s = time.monotonic() + _UP_WITHIN_S
        while len(_up(host)) < len(addresses) and time.monotonic() < by_s:
            time.sleep(_LOOK_S)
        gc.collect()
        gc.freeze()
        pipe.send(len(_up(host)))
        asked = pipe.recv()
        if asked is None:
            return
        begin_ns, seconds = asked
        sleep_until(begin_ns)
        before = {vehicle: vehicle.proxy.publisher.link_breaks for vehicle in _up(host) if vehicle.proxy is not None}
        sleep_until(begin_ns + round(seconds * 1e9))
        up = _up(host)
        kept = [v for v, breaks in before.items() if v in up and v.proxy and v.proxy.publisher.link_breaks == breaks]
        pipe.send(len(before) - len(kept))
        pipe.recv()
    finally:
        host.close()


def _up(host: Host) -> list[SharedVehicle]:
    vehicles = [vehicle for vehicle in host.vehicles.values() if isinstance(vehicle, SharedVehicle)]
    return [v for v in vehicles if v.proxy is not None and v.proxy.publisher.link_state is LinkState.UP]


class _Ages:
    """Records the age of each new state of one vehicle on arrival."""

    def __init__(self) -> None:
        self.stamps: array[int] = array("q")  # captured, arrived
        self._newest_ns = 0

    def received(self, feedback: Feedback) -> None:
        """Add a sample; a silent vehicle's repeated state does not count."""
        if feedback.captured_ns > self._newest_ns:
            self._newest_ns = feedback.captured_ns
            self.stamps.extend((feedback.captured_ns, time.monotonic_ns()))

    def within(self, begin_ns: int, end_ns: int) -> list[int]:
        """Return the ages [ns] of arrivals within a time."""
        pairs = zip(self.stamps[::2], self.stamps[1::2], strict=True)
        return [arrived - captured for captured, arrived in pairs if begin_ns <= arrived < end_ns]


class _Formation:
    """Every second vehicle, all in one formation that moves from one side to the other and back.

    Each vehicle's place is where it hovered after take-off, moved with the formation, because each has its own world
    axes, which begin at its start, and vehicles of different worlds know nothing about each other.
    """

    def __init__(self, drones: Swarm) -> None:
        self.drones = drones
        self.errors_m: list[float] = []  #: error of each vehicle at each tick

    def take_off(self) -> None:
        """Take off, and wait until all hover; set aside those that don't."""
        with suppress(SkyloopError):  # no drone is left; each reports why
            self.drones.takeoff(timeout_s=_TAKE_OFF_S)

    def fly(self, seconds: float) -> None:
        """Fly for some seconds."""
        places = self._places()
        if not places:
            time.sleep(seconds)
            return
        with suppress(SkyloopError):  # no drone is left; each reports why
            self._fly(places, seconds)

    def _fly(self, places: Mapping[str, NDArray[np.float64]], seconds: float) -> None:
        for tick in self.drones.ticks(TICKS_HZ, seconds):
            moved = np.array((LEG_M * math.sin(math.tau * tick.elapsed_s / PERIOD_S), 0.0, 0.0))
            goals = {name: place + moved for name, place in places.items() if name in self.drones.active}
            self.drones.send({name: Position(*map(float, goal)) for name, goal in goals.items()})
            self._note(places)
        self.drones.hover()

    def _places(self) -> dict[str, NDArray[np.float64]]:
        samples = self.drones.feedback().items() if self.drones.active else ()
        return {name: np.array(sample.position_m) for name, sample in samples if sample.position_m is not None}

    def _note(self, places: Mapping[str, NDArray[np.float64]]) -> None:
        now = self._places()
        if not now:
            return
        moved = np.array([now[name] - places[name] for name in now if name in places])
        self.errors_m += np.linalg.norm(moved - moved.mean(axis=0), axis=1).tolist()


def fly(pipe: Pipe, count: int, seconds: float) -> None:
    """Run the pilot's process: it listens to all vehicles, and flies every second one."""
    listening: list[_Ages] = []
    with ExitStack() as stack:
        drones: dict[str, Drone] = {}
        for number in range(count):
            access: Access = "observe" if number % 2 else "pilot"
            drone = connect(_name(number), access=access, name="bench", network=False, timeout_s=20.0, rate_hz=RATE_HZ)
            listening.append(_Ages())
            drone.on_feedback(listening[-1].received, inline=True)
            if access == "pilot":
                drones[drone.name] = drone
            else:
                stack.callback(drone.close)
        stack.enter_context(suppress(SkyloopError))  # the swarm reports its failed drones again at the end
        formation = _Formation(stack.enter_context(Swarm(drones)))
        gc.collect()
        gc.freeze()  # once connected, as docs/host.md advises
        formation.take_off()
        pipe.send(len(formation.drones.active))
        begin_ns = pipe.recv()
        if begin_ns is None:
            return
        sleep_until(begin_ns)
        formation.fly(seconds)
        ages = [age for each in listening for age in each.within(begin_ns, begin_ns + round(seconds * 1e9))]
        failed = {name: str(error) for name, error in formation.drones.errors.items()}
        pipe.send(Flown(len(ages), ages, formation.errors_m, failed))


def _name(number: int) -> str:
    return f"mavlink-{os.getppid()}-{number}"
