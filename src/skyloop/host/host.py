"""The host. It runs any number of vehicles in one process. Each can fail, join or leave without affecting others."""

from __future__ import annotations

import logging
import sys
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import TYPE_CHECKING, Any, Final

import msgspec

from skyloop.child_process import interrupt_deferred
from skyloop.drivers.base import Driver, ServedLink
from skyloop.drivers.registry import make_driver
from skyloop.drivers.uri import VehicleUri
from skyloop.errors import NameTakenError, RefusedError, SkyloopError, UnknownNameError, UsageError
from skyloop.host.fleet import VehicleSettings
from skyloop.host.own_process import OwnProcessVehicle
from skyloop.host.threads import (
    CHECK_S,
    HANG_CHECKS,
    STALL_CHECKS,
    LinkThread,
    RequestWorkers,
    SharedLoop,
    Ticker,
    Watchdog,
)
from skyloop.host.vehicle import Condition, HostedVehicle, SharedVehicle, VehicleStatus, network_of, reason_of, row_of
from skyloop.messages import EventKind, Severity
from skyloop.proxy import Proxy
from skyloop.proxy.serve import at_once
from skyloop.proxy.topics import OverviewRegistry
from skyloop.transport.local.reactor import Reactor, SharedLocalServer

if TYPE_CHECKING:
    from skyloop.network import FabricSettings

LAND_WITHIN_S: Final = 20.0  #: default time limit for a landing
_AT_ONCE: Final = 8  # number of vehicles that start concurrently
_STALL_S: Final = STALL_CHECKS * CHECK_S
_HANG_S: Final = HANG_CHECKS * CHECK_S
_log = logging.getLogger(__name__)

#: Shows a line to the host's operator.
Announce = Callable[[str], None]


class Host:
    """Serves vehicles on shared threads, from construction to :meth:`close`. Thread-safe.

    ``announce`` is called with a line of text for users when a vehicle joins, fails or leaves. ``make`` creates the
    driver for the address of a vehicle in this process.
    """

    def __init__(self, announce: Announce = _log.info, make: Callable[[VehicleUri], Driver] = make_driver) -> None:
        self.announce = announce
        self._make_driver = make
        self._overview = OverviewRegistry()
        self.vehicles: dict[str, HostedVehicle] = {}  #: by name, in the order in which they joined
        self.known: dict[str, VehicleSettings] = {}  #: vehicles that can be started by name alone
        self._lock = threading.Lock()  # guards the vehicles and the loops
        self._reactor = Reactor()  # the reactor for vehicles that are added later
        self._ticker = Ticker(self._on_failing)
        self._links = LinkThread()
        self._loops: list[SharedLoop] = [self._reactor, self._ticker, self._links]
        self._workers = RequestWorkers()
        self._watchdog = Watchdog(lambda: self._loops, self._on_stall, self._on_hang)
        self._watchdog.start()
        self._closing = False

    def proxies(self) -> list[Proxy]:
        """Return the proxies that this process is currently serving. Any thread."""
        return [proxy for vehicle in list(self.vehicles.values()) if (proxy := vehicle.proxy) is not None]

    # Joining and leaving -----------------------------------------------------------------------------------------

    def add(self, settings: VehicleSettings) -> HostedVehicle:
        """Serve another vehicle. If that is not possible, raise the error, and list the vehicle as failed."""
        network = network_of(settings)
        with self._lock:
            if self._closing:
                raise RefusedError("this host is shutting down", code="busy")
            present = self.vehicles.get(settings.name)
            if present is not None and present.runs:
                raise NameTakenError(
                    f"this host already has a vehicle named {settings.name!r}, {present.settings.address}: choose "
                    f"another name, or remove it first: skyloop host remove {settings.name}"
                )
            vehicle = self._make(settings, network)
            vehicle.condition = Condition.STARTING
            self.vehicles[settings.name] = vehicle
            self.known[settings.name] = settings
        try:
            vehicle.start()
        except Exception as error:
            vehicle.condition, vehicle.failed = Condition.FAILED, reason_of(error)
            self.announce(f"failed {settings.name}: {vehicle.failed}")
            if isinstance(error, SkyloopError):
                raise
            raise RefusedError(f"{settings.name} can't be served: {error!r}", code="driver_failed") from error
        with self._lock:
            # The vehicle may already have been removed again. ``_forget`` stops the ticks of a proxy that has ended.
            if (proxy := vehicle.proxy) is not None and vehicle.runs:
                self._ticker.add(proxy)
        return vehicle

    def _make(self, settings: VehicleSettings, network: FabricSettings | None) -> HostedVehicle:
        if settings.own_process:
            return OwnProcessVehicle(settings, self.announce)
        jobs = self._workers.queue()
        return SharedVehicle(
            settings,
            self._reactor,
            jobs,
            network,
            self._make_driver,
            self._overview,
            self._serve_link if sys.platform != "win32" else None,  # whose selectors can't be waited for together
        )

    def _serve_link(self, vehicle: SharedVehicle, link: ServedLink) -> None:
        with self._lock:
            self._links.add(link, vehicle)

    def add_all(self, several: Sequence[VehicleSettings]) -> dict[str, str]:
        """Serve several vehicles, some of them at the same time. Return the reasons why vehicles failed, by name."""
        problems: dict[str, str] = {}

        def add(settings: VehicleSettings) -> None:
            try:
                self.add(settings)
            except SkyloopError as error:
                problems[settings.name] = str(error)

        with ThreadPoolExecutor(_AT_ONCE, thread_name_prefix="skyloop-host-start") as pool:
            list(pool.map(add, several))
        return problems

    def remove(self, name: str, *, land: bool = False, timeout_s: float = LAND_WITHIN_S) -> VehicleStatus:
        """Land a vehicle, end its proxy and remove it; return its last status.

        Raises :class:`RefusedError`, without removing the vehicle, if the vehicle flies under a lease (code ``flown``)
        and ``land`` is not set, or if it has not landed within ``timeout_s`` [s] (``flying``).
        """
        vehicle = self.vehicles.get(name)
        if vehicle is None:
            raise UnknownNameError("vehicle of this host", name, self.vehicles)
        status = vehicle.status()
        if status.airborne and status.pilot is not None and not land:
            raise RefusedError(
                f"{name} is flying, and {status.pilot} has the authority: let {status.pilot} land it, or land and "
                f"remove it anyway: skyloop host remove {name} --land",
                code="flown",
            )
        proxy = vehicle.proxy
        if not self._end(vehicle, timeout_s, "it was removed from its host", unless_flying=True):
            raise RefusedError(
                f"{name} has not landed within {timeout_s:g} s and is not removed: it keeps landing and accepts no "
                "more set-points; try again",
                code="flying",
            )
        with self._lock:
            if self.vehicles.get(name) is vehicle:
                del self.vehicles[name]
        self.announce(f"removed {name}")
        return status if proxy is None else msgspec.structs.replace(status, **row_of(proxy))

    def _end(
        self,
        vehicle: HostedVehicle,
        within_s: float,
        reason: str,
        hurry: Callable[[], bool] = lambda: False,
        *,
        unless_flying: bool = False,
    ) -> bool:
        proxy = vehicle.proxy
        ended = vehicle.end(within_s, reason, hurry, unless_flying=unless_flying)
        if ended and proxy is not None:
            self._forget(proxy)
        return ended

    def _forget(self, proxy: Proxy) -> None:
        """Stop ticking a proxy that has ended, and close the loops that only this proxy used."""
        with self._lock:
            for loop in self._loops:
                if isinstance(loop, Ticker):
                    loop.remove(proxy)
            over = [loop for loop in self._loops if loop.empty and not self._is_shared(loop)]
            self._loops = [loop for loop in self._loops if loop not in over]
        for loop in over:
            loop.close()

    def _is_shared(self, loop: SharedLoop) -> bool:
        """Return whether new vehicles may join this loop. If not, it belongs to a vehicle whose driver blocks it."""
        return loop in (self._reactor, self._ticker, self._links)

    def status(self) -> list[VehicleStatus]:
        """Return a row for each vehicle, including vehicles from the file that have not been started."""
        with self._lock:
            vehicles = dict(self.vehicles)
            known = dict(self.known)
        rows = [vehicle.status() for vehicle in vehicles.values()]
        waiting = [settings for name, settings in known.items() if name not in vehicles]
        process = {True: "own", False: "shared"}
        rows += [
            VehicleStatus(s.name, str(s.address), Condition.STOPPED, process=process[s.own_process]) for s in waiting
        ]
        return rows

    def publish_keys(self, change: str) -> None:
        """Publish an update about the network's keys to all clients."""
        for proxy in self.proxies():
            proxy.events.publish(EventKind.KEYS, change, Severity.WARNING)

    def close(
        self, reason: str = "the host was stopped", within_s: float = 0.0, hurry: Callable[[], bool] = lambda: False
    ) -> None:
        """End all flights (landing for up to ``within_s`` [s]), proxies, and threads that are not stuck. Idempotent.

        ``reason`` is shown to users. ``hurry`` is polled several times a second; True ends the wait for landings.
        Ctrl-C does the same if nothing else handles it. ``KeyboardInterrupt`` is then raised at the end.
        """
        with self._lock:
            self._closing = True
            vehicles = list(self.vehicles.values())
        with interrupt_deferred() as interrupted:

            def end(vehicle: HostedVehicle) -> None:
                self._end(vehicle, within_s, reason, lambda: hurry() or interrupted.is_set())

            def order_landing(vehicle: HostedVehicle) -> None:
                if (proxy := vehicle.proxy) is not None and within_s > 0.0:
                    proxy.handler.order_landing(proxy.clock())

            # Use one thread per vehicle, because a driver that hangs must not keep another vehicle in the air.
            at_once(
                {vehicle: partial(end, vehicle) for vehicle in vehicles},
                prepare=order_landing,
                over=lambda vehicle: vehicle.condition is Condition.FAILED,
                daemon=True,
            )
            self._watchdog.close()
            for loop in self._loops:
                loop.close()
            self._workers.close()

    # Drivers that hang or fail -----------------------------------------------------------------------------------

    def _of(self, member: Any) -> SharedVehicle | None:
        """Return the given vehicle, or the vehicle that the given transport server or proxy belongs to."""
        for vehicle in list(self.vehicles.values()):
            if isinstance(vehicle, SharedVehicle) and member in (vehicle, vehicle.server, vehicle.proxy):
                return vehicle
        return None

    def _on_stall(self, loop: SharedLoop, member: Any) -> None:
        """Move all other vehicles from a stalled loop to a new loop."""
        with self._lock:
            new: SharedLoop
            if not self._is_shared(loop):
                return  # after an earlier stall, the loop was left to this vehicle
            if isinstance(loop, Reactor) and isinstance(member, SharedLocalServer):
                new = self._reactor = loop.split(member)
            elif isinstance(loop, Ticker) and isinstance(member, Proxy):
                new = self._ticker = loop.split(member)
            elif isinstance(loop, LinkThread):
                new = self._links = loop.split(member)
            else:
                return
            self._loops.append(new)
        if (vehicle := self._of(member)) is not None:
            self.announce(f"vehicle of {vehicle.settings.name}: its driver has been blocking for {_STALL_S:g} s")
            vehicle.report_stall(_STALL_S)

    def _on_hang(self, loop: SharedLoop, member: Any) -> None:
        with self._lock:
            self._loops.remove(loop)
        loop.close()  # in case the thread ever returns
        if (vehicle := self._of(member)) is not None:
            self._give_up(vehicle, f"its driver hangs: a call has not returned for {_HANG_S:g} s")

    def _on_failing(self, proxy: Proxy, error: BaseException) -> None:
        if (vehicle := self._of(proxy)) is not None:
            self._give_up(vehicle, f"its driver fails at every tick, so that no failsafe runs: {error!r}")

    def _give_up(self, vehicle: SharedVehicle, reason: str) -> None:
        """End a vehicle whose driver does not work. This runs on a separate thread."""

        def end() -> None:
            proxy = vehicle.proxy
            if vehicle.fail(reason):
                self.announce(f"failed {vehicle.settings.name}: {reason}")
            if proxy is not None:
                self._forget(proxy)

        threading.Thread(target=end, name="skyloop-host-fail", daemon=True).start()


def check_known(host: Host, name: str) -> VehicleSettings:
    """Return the settings of a vehicle in the host's file that is not running."""
    settings = host.known.get(name)
    if settings is None:
        raise UnknownNameError("vehicle of this host's file", name, host.known)
    present = host.vehicles.get(name)
    if present is not None and present.runs:
        raise UsageError(f"{name} is already running, see skyloop host status")
    return settings
