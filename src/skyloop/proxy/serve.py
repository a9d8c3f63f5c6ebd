"""A proxy as a process: what ``skyloop proxy`` runs."""

from __future__ import annotations

import logging
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from functools import partial
from pathlib import Path
from types import FrameType
from typing import Final

from skyloop.drivers.registry import make_driver
from skyloop.errors import UsageError
from skyloop.messages import EventKind, Severity
from skyloop.proxy.audit import AuditTrail, audit_path
from skyloop.proxy.proxy import Proxy
from skyloop.transport.base import ServerEnd

LAND_WITHIN_S: Final = 20.0  #: how long a signalled proxy waits for its vehicle to land
_POLL_S: Final = 0.2
_log = logging.getLogger(__name__)

#: Says what is new about the keys of the network, a sentence each.
Look = Callable[[], Sequence[str]]


class _End:
    """Why the process is to end, and how fast."""

    def __init__(self) -> None:
        self.asked = threading.Event()
        self.hurry = threading.Event()  #: do not land first
        self.reason = ""

    def ask(self, reason: str, *, hurry: bool) -> None:
        if hurry or self.asked.is_set():  # a second signal means now
            self.hurry.set()
        self.reason = self.reason or reason
        self.asked.set()


def serve(
    uri: str,
    name: str,
    *,
    group: str | None = None,
    make_end: Callable[[str, str], ServerEnd] | None = None,
    parent_fd: int | None = None,
    land_within_s: float = LAND_WITHIN_S,
    look: Look | None = None,
    audit: Path | None = None,
) -> None:
    """Serve a vehicle to this host's applications under a name; blocks. On the main thread.

    ``make_end`` makes another server end, of the name and the vehicle's address: one of the network, or several.

    Writes one line that begins with ``ready`` to standard output when applications can connect. Ends on SIGINT or
    SIGTERM, landing first for at most ``land_within_s`` [s] if the vehicle flies; a second signal ends at once. With
    ``parent_fd``, the reading end of a pipe: ends at once when that reads end of file, which the death of the parent
    causes, and leaves SIGINT to the parent, as a terminal sends it to both. ``look`` is called some times a second:
    what it says of the keys is logged, and told to all as an event.

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
    )


def run(
    proxies: Sequence[Proxy],
    *,
    parent_fd: int | None = None,
    land_within_s: float = LAND_WITHIN_S,
    look: Look | None = None,
    audit: Path | None = None,
) -> None:
    """Serve several vehicles from one process, as :func:`serve` does one: several drones of one simulated world.

    The proxies are started here and stopped at the end; one line that begins with ``ready`` is written for each when
    all of them serve. ``audit``: the file of the audit trail; by default each proxy has one in the user's directory of
    state, and a private one (with ``parent_fd``) none.
    """
    end = _End()
    if audit is not None or parent_fd is None:
        for proxy in proxies:
            _keep_trail(proxy, audit)
    with _signals(end, ignore_interrupt=parent_fd is not None), ExitStack() as started:
        for proxy in proxies:
            started.push(partial(_stop, proxy, end))
        for proxy in proxies:
            proxy.start()
        if parent_fd is not None:
            threading.Thread(target=_await_parent, args=(parent_fd, end), name="skyloop-parent", daemon=True).start()
        for proxy in proxies:
            _announce(f"ready {proxy.name}: {proxy.driver.uri} at {proxy.server.address}, process {os.getpid()}")
        # Looks up now and then: the kernel may hand a signal to any thread, and that does not wake this one.
        while not end.asked.wait(_POLL_S):
            for news in look() if look is not None else ():
                _tell_keys(proxies, news)
        _land(proxies, end, land_within_s)


def _tell_keys(proxies: Sequence[Proxy], news: str) -> None:
    _log.warning("%s", news)
    for proxy in proxies:
        proxy.events.tell(EventKind.KEYS, news, Severity.WARNING)


def _keep_trail(proxy: Proxy, path: Path | None) -> None:
    """Raises :class:`UsageError` where the file that was asked for can't be written; the usual one may be missing."""
    chosen = path or audit_path(proxy.name)
    try:
        proxy.keep_trail(AuditTrail(chosen, proxy.name, f"{proxy.run_id:016x}"))
    except OSError as error:
        if path is not None:
            raise UsageError(f"the audit trail {path} can't be written: {error.strerror}") from None
        _log.warning("there is no audit trail, because %s can't be written: %s", chosen, error)


def _stop(proxy: Proxy, end: _End, *_: object) -> None:
    proxy.stop(reason=end.reason or "it failed")


def _land(proxies: Sequence[Proxy], end: _End, within_s: float) -> None:
    deadline = time.monotonic() + within_s
    flying = list(proxies)
    while flying and not end.hurry.is_set() and time.monotonic() < deadline:
        flying = [proxy for proxy in flying if not proxy.land(_POLL_S)]


@contextmanager
def _signals(end: _End, *, ignore_interrupt: bool) -> Iterator[None]:
    def asked(number: int, _: FrameType | None) -> None:
        end.ask(f"{signal.Signals(number).name} received", hurry=False)

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


def _await_parent(descriptor: int, end: _End) -> None:
    try:
        while os.read(descriptor, 64):
            pass
    except OSError:  # closed under us: as good as gone
        pass
    end.ask("its parent process ended", hurry=True)


def _announce(line: str) -> None:
    with suppress(OSError):  # nobody reads standard output: the proxy serves all the same
        print(line, flush=True)
