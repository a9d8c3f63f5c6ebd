"""Run proxies as a process, as ``skyloop proxy`` does."""

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

from skyloop.child_process import SignalEvent, interrupt_deferred, on_parent_end
from skyloop.clock import SWITCH_INTERVAL_S, monotonic_ns, nanoseconds
from skyloop.drivers.registry import make_driver
from skyloop.drivers.uri import VehicleUri
from skyloop.errors import UsageError
from skyloop.messages import EventKind, LinkState, Severity
from skyloop.platform import on_console_close, wait_precisely
from skyloop.proxy.proxy import Proxy
from skyloop.proxy.records import AuditTrail, FlightRecord, audit_path, record_path
from skyloop.proxy.topics import OverviewRegistry
from skyloop.transport.base import TransportServer

LAND_WITHIN_S: Final = 20.0  #: maximum time that a proxy waits for its vehicle to land after a signal
ORPHAN_LANDS_WITHIN_S: Final = 180.0  #: time that a private proxy waits for the landing after its program has gone
_POLL_S: Final = 0.2  # interval at which signals, key updates and the vehicle link are checked
GRACE_NS: Final = nanoseconds(1.0)  #: most vehicles answer within this time; a waiting message is printed only later
_THERE: Final = (LinkState.UP, LinkState.DEGRADED)
_log = logging.getLogger(__name__)
K = TypeVar("K")

#: Returns updates about the network's keys, one sentence each.
Poll = Callable[[], Sequence[str]]
#: Runs an additional service, such as an endpoint for metrics, alongside the proxies of a process.
Beside = Callable[[Sequence[Proxy]], AbstractContextManager[object]]


class LinkLines:
    """Composes the terminal output about a proxy's vehicle link: one line per change of the link or its reason."""

    def __init__(self, name: str, where: str, now_ns: int) -> None:
        """Initialise; ``where`` names the vehicle and the address that serves it."""
        self._name = name
        self._where = where
        self._began_ns = now_ns
        self._written: tuple[LinkState, str, str] | None = None
        self._was_there = False

    def first(self, state: LinkState) -> str:
        """Return the first line once applications can connect. It is ``ready`` only if the vehicle answers, too."""
        self._was_there = state in _THERE
        if self._was_there:
            self._written = state, "", ""
        return f"{'ready' if self._was_there else 'serving'} {self._name}: {self._where}"

    def changed(self, state: LinkState, reason: str, remedy: str, now_ns: int) -> str:
        """Return the line for a change; empty if nothing changed."""
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
    """A request to end a process that runs proxies, and how urgent the request is."""

    def __init__(self) -> None:
        self.requested = SignalEvent()
        self.hurry = SignalEvent()  #: set if the process must end without landing first
        self.reason = ""
        self._asked = False  # by a person or a program that may ask again

    def request(self, reason: str, *, hurry: bool, once: bool = False) -> None:
        """Request that the process end. Thread-safe, even for signal handlers.

        A second request ends the process immediately. ``once``: whether the system makes it, as when a terminal
        is closed; it then counts neither as the first nor as the second.
        """
        if hurry or (self._asked and not once):
            self.hurry.set()
        self._asked |= not once
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
    poll: Poll | None = None,
    audit: Path | None = None,
    beside: Beside | None = None,
) -> None:
    """Serve a vehicle to this host's applications under a name. Blocks, and must be called on the main thread.

    ``make_end`` creates the transport server, given the name and the vehicle's address; by default, for this host only.

    Writes a line starting with ``ready`` to standard output once applications can connect and the vehicle answers.
    Until then it writes ``serving`` and, after each change, its reason for waiting, the last failure and a remedy (not
    with ``parent_fd``). Ends on SIGINT, SIGTERM or SIGHUP, after landing a flying vehicle within at most
    ``land_within_s`` [s]. A second signal other than SIGHUP ends the wait. With ``parent_fd``, the reading end of a
    pipe, it lands and ends at end of file, which occurs when the parent dies. It leaves SIGINT to the parent, because a
    terminal sends it to both. ``poll`` is called several times a second. The updates about keys that it returns are
    logged and published as events.

    Raises :class:`UsageError` (also for an invalid name or address, or a taken name) and
    :class:`skyloop.errors.DriverError`.
    """
    from skyloop.transport.local import LocalServer

    if parent_fd is not None:
        try:
            os.fstat(parent_fd)
        except OSError:
            raise UsageError(f"file descriptor {parent_fd} is not open: give the reading end of a pipe") from None
    driver = make_driver(uri)
    end = LocalServer(name, group=group) if make_end is None else make_end(name, str(driver.uri))
    run(
        [Proxy(driver, end, name=name)],
        parent_fd=parent_fd,
        land_within_s=land_within_s,
        poll=poll,
        audit=audit,
        beside=beside,
    )


def run(
    proxies: Sequence[Proxy],
    *,
    parent_fd: int | None = None,
    land_within_s: float = LAND_WITHIN_S,
    poll: Poll | None = None,
    audit: Path | None = None,
    records: bool | None = None,
    beside: Beside | None = None,
) -> None:
    """Serve several vehicles from one process, such as the drones of one simulated world; see :func:`serve`.

    Starts the proxies, and stops them at the end. Writes lines for each, as :func:`serve` does. ``audit``: file for the
    audit trail. By default, each proxy has a file in the user's state directory, except private proxies (those with
    ``parent_fd``). ``records``: whether to write an audit trail, and a note about the flight for the next run. By
    default, private proxies write neither, because they are never restarted under their name. ``beside``: a context
    that is entered while the proxies run.
    """
    sys.setswitchinterval(SWITCH_INTERVAL_S)
    wait_precisely()
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
    within_s = land_within_s  # a vehicle may turn out to be in flight as soon as its proxy starts
    with on_signals(shutdown, ignore_interrupt=parent_fd is not None), ExitStack() as around:
        if beside is not None:
            around.enter_context(beside(proxies))
        around.callback(
            lambda: end_all(proxies, within_s, reason=shutdown.reason or "it failed", hurry=shutdown.hurry.is_set)
        )
        for proxy in proxies:
            proxy.start()
        if parent_fd is not None:
            # A private proxy is never restarted, so no one could fly a vehicle that it leaves in the air.
            on_parent_end(partial(shutdown.request, "its parent process ended", hurry=records), parent_fd)
            if not records:
                within_s = max(within_s, ORPHAN_LANDS_WITHIN_S)
        lines = [_announced(proxy) for proxy in proxies]
        # Wake up periodically, because a signal delivered to another thread does not wake this one.
        while not shutdown.requested.wait(_POLL_S):
            for change in poll() if poll is not None else ():
                _log.warning("%s", change)
                for proxy in proxies:
                    proxy.events.publish(EventKind.KEYS, change, Severity.WARNING)
            if parent_fd is None:  # a parent process gets the proxy's events, and may not read this output
                for proxy, link in zip(proxies, lines, strict=True):
                    vehicle = proxy.publisher
                    state, reason, remedy = vehicle.link_state, vehicle.link_reason, vehicle.link_remedy
                    if line := link.changed(state, reason, remedy, monotonic_ns()):
                        announce(line)


def keep_trail(proxy: Proxy, path: Path | None) -> None:
    """Give a proxy its audit trail. Raises :class:`UsageError` if a ``path`` is given that can't be written to."""
    chosen = path or audit_path(proxy.name)
    try:
        proxy.keep_trail(AuditTrail(chosen, proxy.name, f"{proxy.run_id:016x}"))
    except OSError as error:
        if path is not None:
            raise UsageError(f"the audit trail {path} can't be written: {error.strerror}") from None
        _log.warning("there is no audit trail, because %s can't be written: %s", chosen, error)


def end_all(proxies: Sequence[Proxy], within_s: float, *, reason: str, hurry: Callable[[], bool]) -> None:
    """End several proxies at the same time with :meth:`Proxy.end`. Then raise the first of their errors.

    Ctrl-C ends the wait for landings unless it is handled elsewhere, and is raised again when all have ended.
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
            prepare=lambda proxy: within_s > 0.0 and proxy.handler.order_landing(proxy.clock()),
        )
    if raised:
        raise raised[0]


def at_once(
    ends: Mapping[K, Callable[[], object]],
    *,
    prepare: Callable[[K], object],
    over: Callable[[K], bool] = lambda _: False,
    daemon: bool = False,
) -> None:
    """End several flights at the same time, each in its own thread, and wait for all. The ``ends`` must not raise.

    ``prepare``: called with the key of each end that gets no thread, before these ends run one after another. ``over``:
    returns whether to stop waiting for the end with this key. ``daemon``: whether the program may exit before they end.
    """
    threads: dict[K, threading.Thread] = {}
    for one, end in ends.items():
        thread = threading.Thread(target=end, name="skyloop-end", daemon=daemon)
        with suppress(RuntimeError):  # no thread is available, so the job runs below
            thread.start()
            threads[one] = thread
    left = [one for one in ends if one not in threads]
    for one in left:
        try:
            prepare(one)
        except Exception:  # noqa: BLE001 the ends are called regardless
            _log.exception("the end of a flight, which has to wait for others, could not be prepared")
    for one in left:
        ends[one]()
    for one, thread in threads.items():
        while thread.is_alive() and not over(one):  # wake up periodically to handle signals
            thread.join(_POLL_S)


@contextmanager
def on_signals(shutdown: Shutdown, *, ignore_interrupt: bool) -> Iterator[None]:
    """Make SIGTERM, SIGHUP, and unless the parent handles them SIGINT and SIGBREAK, request the end. Main thread only.

    ``nohup`` still works: an ignored SIGHUP stays ignored.
    """

    def asked(number: int, _: FrameType | None) -> None:
        # A terminal that is closed sends SIGHUP, its shell sends another one, and a session that ends SIGTERM as well.
        hung_up = number == getattr(signal, "SIGHUP", None)
        shutdown.request(f"{signal.Signals(number).name} received", hurry=False, once=hung_up)

    interrupts = {signal.SIGINT, getattr(signal, "SIGBREAK", signal.SIGINT)}
    before = {one: signal.signal(one, signal.SIG_IGN if ignore_interrupt else asked) for one in interrupts}
    before[signal.SIGTERM] = signal.signal(signal.SIGTERM, asked)
    if sys.platform != "win32" and signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN:
        before[signal.SIGHUP] = signal.signal(signal.SIGHUP, asked)
    try:
        with on_console_close(lambda: shutdown.request("its console was closed", hurry=False, once=True)):
            yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _announced(proxy: Proxy) -> LinkLines:
    where = f"{proxy.driver.uri} at {proxy.server.address}, process {os.getpid()}"
    lines = LinkLines(proxy.name, where, monotonic_ns())
    announce(lines.first(proxy.publisher.link_state))
    return lines


def announce(line: str) -> None:
    with suppress(OSError):  # no one reads standard output: continue serving
        print(line, flush=True)
