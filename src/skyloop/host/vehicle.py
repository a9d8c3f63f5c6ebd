"""One vehicle on a host: its proxy runs on this process's shared threads, or in a separate process."""

from __future__ import annotations

import logging
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from enum import StrEnum
from functools import partial
from typing import TYPE_CHECKING, Final

import msgspec

from skyloop.drivers.base import Driver, ServedLink
from skyloop.drivers.registry import make_driver
from skyloop.drivers.uri import VehicleUri
from skyloop.errors import DriverError, SkyloopError
from skyloop.files import expand
from skyloop.host.fleet import VehicleSettings
from skyloop.messages import EventKind, Severity
from skyloop.proxy import Proxy
from skyloop.proxy.records import FlightRecord, record_path
from skyloop.proxy.requests import JobQueue
from skyloop.proxy.serve import keep_trail
from skyloop.proxy.topics import OverviewRegistry
from skyloop.transport.base import TransportServer
from skyloop.transport.local.reactor import Reactor, SharedLocalServer

if TYPE_CHECKING:
    from skyloop.network import FabricSettings

OPEN_S: Final = 10.0  #: time for a driver to open or close before its vehicle is given up
_log = logging.getLogger(__name__)


class Condition(StrEnum):
    """The state of a vehicle's proxy."""

    STOPPED = "stopped"  #: not started yet, or removed
    STARTING = "starting"
    RUNNING = "running"
    RESTARTING = "restarting"  #: its own process died and will be restarted after a pause
    FAILED = "failed"


class VehicleStatus(msgspec.Struct, frozen=True):
    """One row in the output of ``skyloop host status``."""

    name: str
    address: str
    condition: Condition
    state: str = ""  #: flight state
    link: str = ""  #: state of the vehicle link
    link_reason: str = ""
    link_remedy: str = ""
    pilot: str | None = None
    battery: float | None = None
    uptime_s: float = 0.0
    failed: str = ""  #: why it failed, or why its process last ended
    process: str = "shared"  #: ``shared`` or ``own``
    pid: int | None = None
    restarts: int = 0
    airborne: bool = False


class HostedVehicle(ABC):
    """A vehicle on a host. Methods may be called from any thread."""

    def __init__(self, settings: VehicleSettings) -> None:
        self.settings = settings
        self.condition = Condition.STOPPED
        self.failed = ""  #: why it has failed; empty if it has not
        self.started_s = time.monotonic()
        self.proxy: Proxy | None = None  #: set while the vehicle is served in this process

    @abstractmethod
    def start(self) -> None:
        """Serve the vehicle. Raises :class:`skyloop.errors.SkyloopError` if that is not possible."""

    @abstractmethod
    def status(self) -> VehicleStatus:
        """Return the vehicle's row."""

    @abstractmethod
    def end(
        self, within_s: float, reason: str, hurry: Callable[[], bool] = lambda: False, *, unless_flying: bool = False
    ) -> bool:
        """End the vehicle's flight and its proxy, like :meth:`skyloop.proxy.Proxy.end`. Idempotent.

        Returns whether the proxy has ended. With ``unless_flying``, it only ends if the vehicle landed in time.
        """

    @property
    def runs(self) -> bool:
        """Whether the vehicle has a proxy or is about to get one."""
        return self.condition in (Condition.STARTING, Condition.RUNNING, Condition.RESTARTING)

    def row(self) -> VehicleStatus:
        """Return the row without the proxy's state."""
        settings = self.settings
        up_s = time.monotonic() - self.started_s if self.condition is Condition.RUNNING else 0.0
        process = "own" if settings.own_process else "shared"
        return VehicleStatus(
            settings.name, str(settings.address), self.condition, uptime_s=up_s, failed=self.failed, process=process
        )


class SharedVehicle(HostedVehicle):
    """A vehicle whose proxy uses the shared threads of this process.

    ``reactor`` receives the proxy's local packets, ``jobs`` serves its slow requests, and ``network`` is None if it
    serves this host only. ``overview`` holds the rows of all vehicles in this process; if None, only this vehicle's row
    is shown. ``serve_link`` moves a driver's link to a shared thread; if None, the link keeps its own thread.
    """

    def __init__(
        self,
        settings: VehicleSettings,
        reactor: Reactor,
        jobs: JobQueue,
        network: FabricSettings | None,
        make: Callable[[VehicleUri], Driver] = make_driver,
        overview: OverviewRegistry | None = None,
        serve_link: Callable[[SharedVehicle, ServedLink], None] | None = None,
    ) -> None:
        super().__init__(settings)
        self._serve_link = serve_link
        self._overview = overview
        self._make = make
        self.server = SharedLocalServer(settings.name, reactor, group=settings.group)
        self._jobs = jobs
        self._network = network
        self._life = threading.Lock()  # guards starting, failing and stopping
        self._settled = threading.Event()  # set when the vehicle is running or has failed to start

    def start(self) -> None:
        try:
            self._start()
        finally:
            self._settled.set()

    def _start(self) -> None:
        settings = self.settings
        self.condition = Condition.STARTING
        driver = self._make(settings.address)
        if self._serve_link is not None:
            driver.serve_link = partial(self._serve_link, self)
        proxy = Proxy(driver, self._end(str(driver.uri)), name=settings.name, ticker=False, jobs=self._jobs)
        proxy.parameters.preset(settings.presets)
        if self._overview is not None:
            proxy.overview.share(self._overview)
        keep_trail(proxy, None)
        proxy.keep_record(FlightRecord(record_path(settings.name), str(driver.uri)))
        self.proxy = proxy
        try:
            hung = not within(proxy.start, OPEN_S)
        except BaseException:
            self.proxy = None
            raise
        if hung:
            proxy.end(reason=f"its driver did not open within {OPEN_S:g} s", hangs=True)
            raise DriverError(f"the driver of {settings.address} did not open within {OPEN_S:g} s: it hangs")
        self.started_s = time.monotonic()
        self.condition = Condition.RUNNING

    def _end(self, address: str) -> TransportServer:
        if self._network is None:
            return self.server
        from skyloop.network.server import beside

        return beside(self.server, self.settings.name, self._network, address)

    def status(self) -> VehicleStatus:
        proxy, row = self.proxy, self.row()
        if proxy is None or self.condition is not Condition.RUNNING:
            return row
        return msgspec.structs.replace(row, **row_of(proxy))

    def report_stall(self, seconds: float) -> None:
        """Publish that the driver blocks, and that the vehicle no longer shares its threads."""
        proxy = self.proxy
        if proxy is not None:
            text = f"the driver has been blocking for {seconds:g} s: its vehicle no longer shares its threads"
            proxy.publisher.event(EventKind.DRIVER_ERROR, text, Severity.ERROR, where="host")

    def fail(self, reason: str) -> bool:
        """End a vehicle whose driver hangs or fails, and publish an event. Return False if it was not running."""
        with self._life:
            proxy = self.proxy
            if proxy is None or self.condition is not Condition.RUNNING:
                return False
            self.condition, self.failed = Condition.FAILED, reason
        proxy.end(reason=reason, hangs=True)
        return True

    def end(
        self, within_s: float, reason: str, hurry: Callable[[], bool] = lambda: False, *, unless_flying: bool = False
    ) -> bool:
        if self.condition is not Condition.STOPPED:
            self._settled.wait(OPEN_S + 1.0)  # otherwise it might start serving after its removal
        proxy = self.proxy
        if proxy is not None and self.condition is Condition.RUNNING:
            patience_s = OPEN_S + (within_s if proxy.handler.airborne else 0.0)
            call = partial(proxy.end, within_s, reason=reason, hurry=hurry, unless_flying=unless_flying)
            if not within(call, patience_s):
                _log.error("the driver of %s does not close: abandoning it", self.settings.name)
            if unless_flying and not proxy.ended:
                return False
        with self._life:
            self.proxy = None
            if self.condition is not Condition.FAILED:
                self.condition = Condition.STOPPED
        return True


def row_of(proxy: Proxy) -> dict[str, object]:
    """Return the part of a row that a running proxy provides."""
    vehicle = proxy.publisher
    feedback = vehicle.feedback_now
    return {
        "state": feedback.state.value if feedback is not None else "",
        "battery": feedback.battery if feedback is not None else None,
        "pilot": feedback.owner if feedback is not None else None,
        "link": vehicle.link_state.value,
        "link_reason": vehicle.link_reason,
        "link_remedy": vehicle.link_remedy,
        "airborne": proxy.handler.airborne,
    }


def network_of(settings: VehicleSettings) -> FabricSettings | None:
    """Return how a vehicle's proxy joins the network; None if it serves this host only."""
    if settings.network is None:
        return None
    from skyloop.network.config import serving

    keys = expand(settings.keys) if settings.keys is not None else None
    return serving(settings.network, listen=settings.listen, multicast=settings.multicast, keys=keys)


def within(call: Callable[[], object], seconds: float) -> bool:
    """Run a function that may hang on a separate thread, and raise its exceptions on this one.

    Returns whether the function returned in time. Otherwise, the daemon thread continues to run.
    """
    raised: list[BaseException] = []

    def run() -> None:
        try:
            call()
        except BaseException as error:  # noqa: BLE001  raised again in the waiting thread
            raised.append(error)

    thread = threading.Thread(target=run, name="skyloop-host-call", daemon=True)
    thread.start()
    thread.join(seconds)
    if raised:
        raise raised[0]
    return not thread.is_alive()


def reason_of(error: BaseException) -> str:
    """Return an error's text for users."""
    return str(error) if isinstance(error, SkyloopError) else repr(error)
