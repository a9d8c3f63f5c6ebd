"""One vehicle of a host: its proxy on the shared threads of this process, or in a process of its own."""

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

OPEN_S: Final = 10.0  #: how long a driver may take to open or to close before its vehicle is given up
_log = logging.getLogger(__name__)


class Condition(StrEnum):
    """What has become of a vehicle's proxy."""

    STOPPED = "stopped"  #: not started yet, or removed
    STARTING = "starting"
    RUNNING = "running"
    RESTARTING = "restarting"  #: its own process died, and is started again after a pause
    FAILED = "failed"


class VehicleStatus(msgspec.Struct, frozen=True):
    """One row of ``skyloop host status``."""

    name: str
    address: str
    condition: Condition
    state: str = ""  #: flight state
    link: str = ""  #: of the vehicle
    link_reason: str = ""
    link_remedy: str = ""
    pilot: str | None = None
    battery: float | None = None
    uptime_s: float = 0.0
    failed: str = ""  #: why it failed, or its process ended last
    process: str = "shared"  #: or ``own``
    pid: int | None = None
    restarts: int = 0
    airborne: bool = False


class HostedVehicle(ABC):
    """A vehicle of a host. Methods may be called from any thread."""

    def __init__(self, settings: VehicleSettings) -> None:
        self.settings = settings
        self.condition = Condition.STOPPED
        self.failed = ""  #: why, once it has
        self.started_s = time.monotonic()

    @abstractmethod
    def start(self) -> None:
        """Serve the vehicle. Raises what speaks against it, as :class:`skyloop.errors.SkyloopError`."""

    @abstractmethod
    def status(self) -> VehicleStatus:
        """Return its row."""

    @abstractmethod
    def end(
        self,
        within_s: float,
        reason: str,
        hurry: Callable[[], bool] = lambda: False,
        *,
        unless_flying: bool = False,
    ) -> bool:
        """End its flight and its proxy, as :meth:`skyloop.proxy.Proxy.end` does. Idempotent.

        Returns:
            Whether its proxy has ended; with ``unless_flying`` that is only where it has landed in time.
        """

    @property
    def runs(self) -> bool:
        """Whether it has a proxy, or is about to have one."""
        return self.condition in (Condition.STARTING, Condition.RUNNING, Condition.RESTARTING)

    def row(self) -> VehicleStatus:
        """Return what is known without its proxy."""
        settings = self.settings
        up_s = time.monotonic() - self.started_s if self.condition is Condition.RUNNING else 0.0
        process = "own" if settings.own_process else "shared"
        return VehicleStatus(
            settings.name, str(settings.address), self.condition, uptime_s=up_s, failed=self.failed, process=process
        )


class SharedVehicle(HostedVehicle):
    """A vehicle whose proxy uses the shared threads of this process.

    Args:
        settings: Its settings.
        reactor: Receives for it on this host.
        jobs: Answers its requests that may wait.
        network: How its proxy joins the network; None for this host only.
        make: Makes the driver of an address.
        overview: The rows of all vehicles of this process; None: each shows its own alone.
        serve_link: Takes a link of its driver to a thread that serves those of several; None: it has its own thread.
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
        self.proxy: Proxy | None = None
        self._jobs = jobs
        self._network = network
        self._life = threading.Lock()  # guards starting, failing and stopping
        self._settled = threading.Event()  # it runs, or has failed to start

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
        return msgspec.structs.replace(row, **of_proxy(proxy))

    def report_stall(self, seconds: float) -> None:
        """Publish that its driver blocks, and that its threads are its own from here on."""
        proxy = self.proxy
        if proxy is not None:
            text = (
                f"the driver has blocked for {seconds:g} s: its vehicle gets threads of its own, apart from the others"
            )
            proxy.publisher.event(EventKind.DRIVER_ERROR, text, Severity.ERROR, where="host")

    def fail(self, reason: str) -> bool:
        """Give the vehicle up because its driver hangs or fails, with an event; return False if it was not running."""
        with self._life:
            proxy = self.proxy
            if proxy is None or self.condition is not Condition.RUNNING:
                return False
            self.condition, self.failed = Condition.FAILED, reason
        proxy.end(reason=reason, hangs=True)
        return True

    def end(
        self,
        within_s: float,
        reason: str,
        hurry: Callable[[], bool] = lambda: False,
        *,
        unless_flying: bool = False,
    ) -> bool:
        if self.condition is not Condition.STOPPED:
            self._settled.wait(OPEN_S + 1.0)  # else it would go on to serve, with nobody who knows of it
        proxy = self.proxy
        if proxy is not None and self.condition is Condition.RUNNING:
            patience_s = OPEN_S + (within_s if proxy.handler.airborne else 0.0)
            call = partial(proxy.end, within_s, reason=reason, hurry=hurry, unless_flying=unless_flying)
            if not within(call, patience_s):
                _log.error("the driver of %s does not close: it is left alone", self.settings.name)
            if unless_flying and not proxy.ended:
                return False
        with self._life:
            self.proxy = None
            if self.condition is not Condition.FAILED:
                self.condition = Condition.STOPPED
        return True


def of_proxy(proxy: Proxy) -> dict[str, object]:
    """Return what a row shows of a running proxy."""
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
    """Return how a vehicle's proxy joins the network; None for this host only.

    Raises:
        UsageError: An address or the folder of keys is not valid.
        MissingExtraError: The extra ``network`` is not installed.
    """
    if settings.network is None:
        return None
    from skyloop.network.config import serving

    keys = expand(settings.keys) if settings.keys is not None else None
    return serving(settings.network, listen=settings.listen, multicast=settings.multicast, keys=keys)


def within(call: Callable[[], object], seconds: float) -> bool:
    """Call something that may hang, on a thread of its own, and raise what it raises.

    Returns:
        Whether it returned in time; if not, it is left to its daemon thread.
    """
    raised: list[BaseException] = []

    def run() -> None:
        try:
            call()
        except BaseException as error:  # noqa: BLE001  it is raised again where it was waited for
            raised.append(error)

    thread = threading.Thread(target=run, name="skyloop-host-call", daemon=True)
    thread.start()
    thread.join(seconds)
    if raised:
        raise raised[0]
    return not thread.is_alive()


def reason_of(error: BaseException) -> str:
    """Return the text of an error, for people."""
    return str(error) if isinstance(error, SkyloopError) else repr(error)
