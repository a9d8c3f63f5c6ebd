"""A host as a process: what ``skyloop host fleet.toml`` runs."""

from __future__ import annotations

import gc
import os
import sys
from collections.abc import Callable, Sequence
from contextlib import ExitStack, suppress
from typing import Final

from skyloop.clock import monotonic_ns
from skyloop.errors import UsageError
from skyloop.host.control import Add, AddNamed, Answer, ControlServer, Remove, Request
from skyloop.host.fleet import Defaults, Fleet, Vehicle, settings_of
from skyloop.host.host import Host, check_known
from skyloop.host.vehicle import HostedVehicle, SharedVehicle, VehicleStatus, network_of
from skyloop.messages import LinkState
from skyloop.metrics import serve_proxies
from skyloop.proxy.serve import LAND_WITHIN_S, LinkLines, Shutdown, on_signals
from skyloop.toml_file import Place

#: The interpreter's lock is handed over after so long: a hundred drivers' threads wait for it beside the one that
#: receives commands.
SWITCH_INTERVAL_S: Final = 0.001
_POLL_S: Final = 0.2


def serve(
    fleet: Fleet, *, group: str | None = None, land_within_s: float = LAND_WITHIN_S, metrics: str | None = None
) -> None:
    """Serve all vehicles of a fleet that start by themselves; blocks. On the main thread.

    Writes a line for each vehicle to standard output as ``skyloop proxy`` does, ``failed NAME: …`` for one that can't
    be served, and ``hosting …`` when all were tried. Ends on SIGINT or SIGTERM, landing all that fly first, for at
    most ``land_within_s`` [s]; a second signal waits no longer.

    Args:
        fleet: The vehicles.
        group: Of users who may add and remove vehicles as well.
        land_within_s: How long to wait for vehicles to land [s].
        metrics: ``[HOST:]PORT`` of an endpoint for Prometheus, which is announced; None: none.

    Raises:
        UsageError: ``metrics`` is no address, or can't be listened on.
        MissingExtraError: The extra ``metrics`` is needed and not installed.
        NameTakenError: A running host has the name.
        LinkError: The directory of sockets is not safe.
    """
    sys.setswitchinterval(SWITCH_INTERVAL_S)
    shutdown = Shutdown()
    with ExitStack() as stack:
        stack.enter_context(on_signals(shutdown, ignore_interrupt=False))
        host = Host(announce)
        stack.callback(lambda: host.close(shutdown.reason or "its host failed"))
        if metrics is not None:
            announce(stack.enter_context(serve_proxies(host.proxies, metrics)).announcement)
        control = ControlServer(fleet.name, Answering(host, fleet.defaults), group=group)
        control.start()
        stack.callback(control.stop)
        host.known.update((vehicle.name, vehicle) for vehicle in fleet.vehicles)
        problems = host.add_all([vehicle for vehicle in fleet.vehicles if vehicle.autostart])
        lines = _Lines()
        lines.update(list(host.vehicles.values()))
        served = sum(vehicle.runs for vehicle in host.vehicles.values())
        failed = f", {len(problems)} failed" if problems else ""
        announce(f"hosting {served} of {len(fleet.vehicles)} vehicles as {fleet.name}, process {os.getpid()}{failed}")
        polls = _key_changes(fleet)
        gc.collect()
        gc.freeze()  # what is there stays: the collector looks through what is new only, which takes no 20 ms
        # Looks up now and then: the kernel may hand a signal to any thread, and that does not wake this one.
        while not shutdown.requested.wait(_POLL_S):
            lines.update(list(host.vehicles.values()))
            for poll in polls:
                for change in poll():
                    announce(change)
                    host.publish_keys(change)
        host.close(shutdown.reason, land_within_s, shutdown.hurry.is_set)


class Answering:
    """Carries out the requests at a host's control socket.

    Args:
        host: The host.
        defaults: Of its file, for vehicles that come by their address alone.
    """

    def __init__(self, host: Host, defaults: Defaults) -> None:
        self._host = host
        self._defaults = defaults

    def __call__(self, request: Request) -> Answer:
        """Do what is asked. On the control socket's thread. Raises :class:`skyloop.errors.SkyloopError`."""
        host = self._host
        if isinstance(request, Remove):
            return Answer((host.remove(request.name, land=request.land),))
        if isinstance(request, AddNamed):
            return Answer((self._add_named(request).status(),))
        if isinstance(request, Add):
            present = {name for name, vehicle in host.vehicles.items() if vehicle.runs}
            new = [vehicle for vehicle in request.vehicles if vehicle.name not in present]
            problems = host.add_all(new)
            known = {vehicle.name for vehicle in request.vehicles}
            return Answer(tuple(row for row in host.status() if row.name in known), problems)
        return Answer(tuple(host.status()))

    def _add_named(self, request: AddNamed) -> HostedVehicle:
        if request.address is None:
            return self._host.add(check_known(self._host, request.name))
        process = {True: "own", False: "shared", None: None}[request.own_process]
        vehicle = Vehicle(name=request.name, address=request.address, process=process)  # type: ignore[arg-type]
        place = Place("skyloop host add")
        return self._host.add(settings_of(vehicle, self._defaults, place, vehicle))


class _Lines:
    """Says for each vehicle that it is ready, or what it waits for, whenever that has changed."""

    def __init__(self) -> None:
        self._lines: dict[HostedVehicle, LinkLines] = {}

    def update(self, vehicles: Sequence[HostedVehicle]) -> None:
        for vehicle in vehicles:
            status = vehicle.status()
            if not status.link:
                continue
            state, lines = LinkState(status.link), self._lines.get(vehicle)
            if lines is None:
                lines = self._lines[vehicle] = LinkLines(status.name, _where(vehicle, status), monotonic_ns())
                announce(lines.first(state))
            elif line := lines.changed(state, status.link_reason, status.link_remedy, monotonic_ns()):
                announce(line)
        for gone in [vehicle for vehicle in self._lines if vehicle not in vehicles]:
            del self._lines[gone]


def _where(vehicle: HostedVehicle, status: VehicleStatus) -> str:
    if isinstance(vehicle, SharedVehicle) and vehicle.proxy is not None:
        return f"{status.address} at {vehicle.proxy.server.address}"
    return f"{status.address} at local:{status.name}, process {status.pid}"


def _key_changes(fleet: Fleet) -> list[Callable[[], list[str]]]:
    """Return what reports on the keys of the fleet, once for each folder."""
    polls: dict[str | None, Callable[[], list[str]]] = {}
    for vehicle in fleet.vehicles:
        with suppress(UsageError, ImportError):  # of one that could not be served for it
            settings = network_of(vehicle)
            if settings is not None and settings.ring is not None:
                polls[vehicle.keys] = settings.ring.poll
    return list(polls.values())


def announce(line: str) -> None:
    """Write a line to standard output."""
    with suppress(OSError):  # nobody reads it: the host serves all the same
        print(line, flush=True)
