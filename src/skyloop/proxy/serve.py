"""A proxy as a process: what ``skyloop proxy`` runs."""

from __future__ import annotations

import logging
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager, suppress
from functools import partial
from pathlib import Path
from types import FrameType
from typing import Final, TypeVar

from skyloop.child_process import interrupt_deferred, on_parent_end
from skyloop.clock import SWITCH_INTERVAL_S, monotonic_ns, nanoseconds
from skyloop.drivers.registry import make_driver
from skyloop.drivers.uri import VehicleUri
from skyloop.errors import UsageError
from skyloop.messages import EventKind, LinkState, Severity
from skyloop.proxy.proxy import Proxy
from skyloop.proxy.records import AuditTrail, FlightRecord, audit_path, record_path
from skyloop.proxy.topics import OverviewRegistry
from skyloop.transport.base import TransportServer

LAND_WITHIN_S: Final = 20.0  #: how long a signalled proxy waits for its vehicle to land
ORPHAN_LANDS_WITHIN_S: Final = 180.0  #: how long a private proxy does whose program is gone
_POLL_S: Final = 0.2
GRACE_NS: Final = nanoseconds(1.0)  #: most vehicles answer within this; until then nothing is printed about waiting
_THERE: Final = (LinkState.UP, LinkState.DEGRADED)
_log = logging.getLogger(__name__)
K = TypeVar("K")

#: Says what is new about the keys of the network, a sentence each.
Look = Callable[[], Sequence[str]]
#: What runs beside the proxies of a process, such as an endpoint for metrics.
Beside = Callable[[Sequence[Proxy]], AbstractContextManager[object]]


class LinkLines:
    """Lines about one proxy's vehicle link for the terminal: one when the link, or the reason, has changed."""

    def __init__(self, name: str, where: str, now_ns: int) -> None:
        """``where``: what is served and at which address."""
        self._name = name
        self._where = where
        self._began_ns = now_ns
        self._written: tuple[LinkState, str, str] | None = None
        self._was_there = False

    def first(self, state: LinkState) -> str:
        """Return the first line, that applications can connect: ``ready`` only if there is a vehicle as well."""
        self._was_there = state in _THERE
        if self._was_there:
            self._written = state, "", ""
        return f"{'ready' if self._was_there else 'serving'} {self._name}: {self._where}"

    def changed(self, state: LinkState, reason: str, remedy: str, now_ns: int) -> str:
        """Return what is new; empty if nothing is."""
        now = state, reason, remedy
        if now == self._written or (state is LinkState.CONNECTING and now_ns - self._began_ns < GRACE_NS):
            return ""
        self._written = now
        if state in _THERE and not self._was_there:
            self._was_there = True
            return f"ready {self._name}: {self._where}"
        why = f": {reason}" if reason else ""
        what = f"\n  → {remedy}" if remedy else ""
        return f"vehicle of {self._name}: {state.value}{why}{what}"


class Shutdown:
    """Why a process with proxies must end, and how fast."""

    def __init__(self) -> None:
        self.requested = threading.Event()
        self.hurry = threading.Event()  #: do not land first
        self.reason = ""

    def request(self, reason: str, *, hurry: bool) -> None:
        """Ask for the end. Any thread, and signal handlers."""
        if hurry or self.requested.is_set():  # a second signal means now
            self.hurry.set()
        self.reason = self.reason or reason
        self.requested.set()


def serve(
    uri: str | VehicleUri,
    name: str,
    *,
    group: str | None = None,
    make_end: Callable[[str, str], TransportServer] | None = None,
    parent_fd: int | None = None,
    land_within_s: float = LAND_WITHIN_S,
    look: Look | None = None,
    audit: Path | None = None,
    beside: Beside | None = None,
) -> None:
    """Serve a vehicle to this host's applications under a name; blocks. On the main thread.

    ``make_end`` makes another transport server, of the name and the vehicle's address: one of the network, or several.

    Writes to standard output a line that begins with ``ready`` when applications can connect and the vehicle is there;
    ``serving`` while it is not, and then, whenever that changes, what is waited for, why it failed last and what to do
    (not with ``parent_fd``). Ends on SIGINT or
    SIGTERM, landing first for at most ``land_within_s`` [s] if the vehicle flies; a second signal waits no longer. With
    ``parent_fd``, the reading end of a pipe: lands and ends when that reads end of file, which the death of the parent
    causes, and leaves SIGINT to the parent, as a terminal sends it to both. ``look`` is called some times a second:
    what it returns about the keys is logged, and published as an event.

    Raises :class:`UsageError` (also for a name or address that makes no sense, or a name that is taken) and
    :class:`skyloop.errors.DriverError`.
    """
    from skyloop.transport.local import LocalServer

    if parent_fd is not None:
        _check_descriptor(parent_fd)
    driver = make_driver(uri)
    end = LocalServer(name, group=group) if make_end is None else make_end(name, str(driver.uri))
    run(
        [Proxy(driver, end, name=name)],
        parent_fd=parent_fd,
        land_within_s=land_within_s,
        look=look,
        audit=audit,
        beside=beside,
    )


def run(
    proxies: Sequence[Proxy],
    *,
    parent_fd: int | None = None,
    land_within_s: float = LAND_WITHIN_S,
    look: Look | None = None,
    audit: Path | None = None,
    records: bool | None = None,
    beside: Beside | None = None,
) -> None:
    """Serve several vehicles from one process, as :func:`serve` does one: several drones of one simulated world.

    The proxies are started here and stopped at the end; lines are written of each, as :func:`serve` does. ``audit``:
    the file of the audit trail; by default each proxy has one in the user's directory of state, and a private one (with
    ``parent_fd``) none. ``records``: whether there is an audit trail, and a note of a flight for the next run; by
    default not for private ones, which are not started again under their name. ``beside``: entered with the proxies
    before they start, and left when they have ended.
    """
    sys.setswitchinterval(SWITCH_INTERVAL_S)
    shutdown = Shutdown()
    records = parent_fd is None if records is None else records
    if audit is not None or records:
        for proxy in proxies:
            keep_trail(proxy, audit)
    if records:
        for proxy in proxies:
            proxy.keep_record(FlightRecord(record_path(proxy.name), str(proxy.driver.uri)))
    overview = OverviewRegistry()
    for proxy in proxies:
        proxy.overview.share(overview)
    within_s = 0.0
    with on_signals(shutdown, ignore_interrupt=parent_fd is not None), ExitStack() as around:
        if beside is not None:
            around.enter_context(beside(proxies))
        around.callback(
            lambda: end_all(proxies, within_s, reason=shutdown.reason or "it failed", hurry=shutdown.hurry.is_set)
        )
        for proxy in proxies:
            proxy.start()
        if parent_fd is not None:
            # Nobody starts a private one again, or can fly what it leaves in the air.
            on_parent_end(partial(shutdown.request, "its parent process ended", hurry=records), parent_fd)
            if not records:
                land_within_s = max(land_within_s, ORPHAN_LANDS_WITHIN_S)
        within_s = land_within_s  # from here on something may fly
        lines = [_announced(proxy) for proxy in proxies]
        # Looks up now and then: the kernel may hand a signal to any thread, and that does not wake this one.
        while not shutdown.requested.wait(_POLL_S):
            for change in look() if look is not None else ():
                _publish_keys(proxies, change)
            if parent_fd is None:  # a parent gets the proxy's events, and may not read what is written here
                for proxy, link in zip(proxies, lines, strict=True):
                    _announce_link(proxy, link)


def _publish_keys(proxies: Sequence[Proxy], change: str) -> None:
    _log.warning("%s", change)
    for proxy in proxies:
        proxy.events.publish(EventKind.KEYS, change, Severity.WARNING)


def keep_trail(proxy: Proxy, path: Path | None) -> None:
    """Give a proxy its audit trail.

    Raises :class:`UsageError` where the file that was asked for can't be written; the usual one may be missing.
    """
    chosen = path or audit_path(proxy.name)
    try:
        proxy.keep_trail(AuditTrail(chosen, proxy.name, f"{proxy.run_id:016x}"))
    except OSError as error:
        if path is not None:
            raise UsageError(f"the audit trail {path} can't be written: {error.strerror}") from None
        _log.warning("there is no audit trail, because %s can't be written: %s", chosen, error)


def end_all(proxies: Sequence[Proxy], within_s: float, *, reason: str, hurry: Callable[[], bool]) -> None:
    """End several proxies at the same time, as :meth:`Proxy.end` does each. Raises what one of them does, then.

    Ctrl-C, where nothing else handles it, waits no longer for those that land, and is raised when all have ended.
    """
    raised: list[Exception] = []
    with interrupt_deferred() as interrupted:

        def end(proxy: Proxy) -> None:
            try:
                proxy.end(within_s, reason=reason, hurry=lambda: hurry() or interrupted.is_set())
            except Exception as error:  # noqa: BLE001  it is raised when all have ended
                raised.append(error)

        at_once(
            {proxy: partial(end, proxy) for proxy in proxies},
            tell=lambda proxy: within_s > 0.0 and proxy.handler.order_landing(proxy.clock()),
        )
    if raised:
        raise raised[0]


def at_once(
    ends: Mapping[K, Callable[[], object]],
    *,
    tell: Callable[[K], object],
    over: Callable[[K], bool] = lambda _: False,
    daemon: bool = False,
) -> None:
    """Call at the same time what ends each of several flights, and wait for all.

    Args:
        ends: What ends each, on a thread of its own; must not raise.
        tell: Told of those for which there is no thread, before the first of them ends: they do so in turn.
        over: Whether one is not waited for any more.
        daemon: Whether the program may end before them.
    """
    threads: dict[K, threading.Thread] = {}
    for one, end in ends.items():
        thread = threading.Thread(target=end, name="skyloop-end", daemon=daemon)
        with suppress(RuntimeError):  # there is none to be had: it ends all the same
            thread.start()
            threads[one] = thread
    left = [one for one in ends if one not in threads]
    for one in left:
        try:
            tell(one)
        except Exception:  # noqa: BLE001  it is ended all the same
            _log.exception("one of several that end together could not be told so")
    for one in left:
        ends[one]()
    for one, thread in threads.items():
        while thread.is_alive() and not over(one):  # looks up now and then, for signals
            thread.join(_POLL_S)


@contextmanager
def on_signals(shutdown: Shutdown, *, ignore_interrupt: bool) -> Iterator[None]:
    """Let SIGINT (unless it is the parent's to handle) and SIGTERM ask for the end. On the main thread."""

    def asked(number: int, _: FrameType | None) -> None:
        shutdown.request(f"{signal.Signals(number).name} received", hurry=False)

    before = {
        signal.SIGINT: signal.signal(signal.SIGINT, signal.SIG_IGN if ignore_interrupt else asked),
        signal.SIGTERM: signal.signal(signal.SIGTERM, asked),
    }
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _check_descriptor(descriptor: int) -> None:
    try:
        os.fstat(descriptor)
    except OSError:
        raise UsageError(f"file descriptor {descriptor} is not open: give the reading end of a pipe") from None


def _announced(proxy: Proxy) -> LinkLines:
    where = f"{proxy.driver.uri} at {proxy.server.address}, process {os.getpid()}"
    lines = LinkLines(proxy.name, where, monotonic_ns())
    _announce(lines.first(proxy.publisher.link_state))
    return lines


def _announce_link(proxy: Proxy, lines: LinkLines) -> None:
    vehicle = proxy.publisher
    line = lines.changed(vehicle.link_state, vehicle.link_reason, vehicle.link_remedy, monotonic_ns())
    if line:
        _announce(line)


def _announce(line: str) -> None:
    with suppress(OSError):  # nobody reads standard output: the proxy serves all the same
        print(line, flush=True)
