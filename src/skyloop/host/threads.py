"""Threads shared by many vehicles (for ticks, links and requests), and a watchdog that detects loops that hang."""

from __future__ import annotations

import logging
import selectors
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from heapq import heapify, heappop, heappush
from itertools import count
from typing import Any, Final, Protocol

from skyloop.clock import beats, nanoseconds, seconds
from skyloop.drivers.base import ServedLink
from skyloop.drivers.vehicle_link import PAUSE_S
from skyloop.platform import socket_pair
from skyloop.proxy import Proxy
from skyloop.proxy.core.autopilot import PERIOD_S

#: Number of failed ticks in a row (half a second) after which a proxy has failed: its failsafe no longer runs.
MAX_FAILURES: Final = 25
WHOLE_ROUNDS: Final = 5  #: a proxy does what is not urgent only every this many rounds, ten times a second
_log = logging.getLogger(__name__)

#: Called on the ticker's thread with the last error and the proxy whose ticks keep failing. It must return immediately.
OnFailing = Callable[[Proxy, BaseException], None]
MAX_THREADS: Final = 64  #: number of drivers that may hang in a request before other drivers have to wait
IDLE_THREADS: Final = 2  #: number of threads kept ready for bursts of requests
_IDLE_S: Final = 5.0  #: a spare thread ends after this time without a job

Job = Callable[[], None]
_LONGEST_WAIT_NS: Final = 1_000_000_000  #: maximum time to wait in the selector
_MOST_STALE: Final = 4  #: maximum number of queue entries per link; beyond it, stale entries are removed
CHECK_S: Final = 0.05  #: interval between checks
STALL_CHECKS: Final = 5  #: 0.25 s: gives other vehicles a new thread before their pilots' silence makes them hover
HANG_CHECKS: Final = 40  #: 2 s: the host gives up the vehicle


class Ticker:
    """Ticks proxies on one thread, from construction until :meth:`close`. A failed tick does not affect other proxies.

    Like a :class:`skyloop.transport.local.reactor.Reactor`, it records whose code is running and can be split.
    ``on_failing``: called for a proxy after :data:`MAX_FAILURES` failed ticks in a row.
    """

    def __init__(self, on_failing: OnFailing, proxies: Iterable[Proxy] = ()) -> None:
        self.inside: Proxy | None = None  #: the proxy currently being ticked
        self.entries = 0  #: number of times :attr:`inside` was set
        self._on_failing = on_failing
        self._failures = dict.fromkeys(proxies, 0)  # number of failures in a row, by proxy
        self._lock = threading.Lock()  # guards changes to the failures, and so to the proxies that are ticked
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name="skyloop-ticker", daemon=True)
        self._thread.start()

    def add(self, proxy: Proxy) -> None:
        """Start ticking a proxy. Any thread."""
        with self._lock:
            self._failures[proxy] = 0

    def remove(self, proxy: Proxy) -> bool:
        """Stop ticking a proxy; return whether this ticker was ticking it. A tick in progress continues. Any thread."""
        with self._lock:
            return self._failures.pop(proxy, None) is not None

    @property
    def empty(self) -> bool:
        return not self._failures

    def split(self, stuck: Proxy) -> Ticker:
        """Leave this ticker to one proxy; return a new one for all other proxies. Any thread."""
        with self._lock:
            others = [proxy for proxy in self._failures if proxy is not stuck]
            for proxy in others:
                del self._failures[proxy]
        return Ticker(self._on_failing, others)

    def close(self) -> None:
        """End the thread unless it is stuck. Idempotent."""
        self._closing.set()
        if threading.current_thread() is not self._thread and self.inside is None:
            self._thread.join()

    def _run(self) -> None:
        for rounds, _ in enumerate(beats(PERIOD_S, self._closing)):
            with self._lock:
                proxies = list(self._failures)
            for place, proxy in enumerate(proxies, rounds):  # a fifth of the proxies per round, to spread the work
                failures = self._failures.get(proxy)
                if failures is not None:  # no other ticker has taken over
                    self._tick(proxy, whole=failures > 0 or place % WHOLE_ROUNDS == 0)
            self.inside = None

    def _tick(self, proxy: Proxy, *, whole: bool) -> None:
        self.inside = proxy
        self.entries += 1
        try:
            if whole:
                proxy.tick(proxy.clock())
            elif proxy.at_rest:
                return
            else:
                proxy.tick_flight(proxy.clock())
        except Exception as error:  # noqa: BLE001  one vehicle's error must not stop the others' failsafes
            self._failed(proxy, error)
        else:
            if self._failures.get(proxy):
                self._failures[proxy] = 0

    def _failed(self, proxy: Proxy, error: Exception) -> None:
        with self._lock:
            failures = self._failures.get(proxy)
            if failures is None:
                return
            failures = self._failures[proxy] = failures + 1
        if failures == 1:
            _log.exception("a tick of %s failed", proxy.name)
            proxy.publisher.driver_failed("tick", error)
        elif failures == MAX_FAILURES:
            self._on_failing(proxy, error)


class RequestWorkers:
    """A pool of daemon threads for the proxies' job queues. A job that hangs delays only its own queue."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._ready: deque[PooledJobQueue] = deque()  # queues that contain a job that has not been started
        self._idle = 0
        self._threads = 0
        self._closed = False

    def queue(self) -> PooledJobQueue:
        return PooledJobQueue(self)

    def close(self) -> None:
        """End the idle threads."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()

    def schedule(self, jobs: PooledJobQueue) -> None:
        """Have a thread do the next job in a queue. Called by job queues."""
        with self._changed:
            self._ready.append(jobs)
            if self._idle >= len(self._ready):
                self._changed.notify()
            elif self._threads < MAX_THREADS:
                self._threads += 1
                threading.Thread(target=self._run, name="skyloop-requests", daemon=True).start()

    def _run(self) -> None:
        while (jobs := self._next()) is not None:
            jobs.do_one()

    def _next(self) -> PooledJobQueue | None:
        with self._changed:
            self._idle += 1
            try:
                while not self._ready:
                    waited = self._changed.wait(_IDLE_S)
                    if self._closed or not (waited or self._ready or self._idle <= IDLE_THREADS):
                        self._threads -= 1
                        return None
                return self._ready.popleft()
            finally:
                self._idle -= 1


class PooledJobQueue:
    """One proxy's jobs: a :class:`skyloop.proxy.requests.JobQueue` that runs on a pool's threads."""

    def __init__(self, workers: RequestWorkers) -> None:
        self._workers = workers
        self._changed = threading.Condition()
        self._jobs: deque[Job] = deque()
        self._busy = False
        self._stopped = False

    def start(self) -> None:
        """Do nothing, because the pool has its own threads."""

    def put(self, job: Job) -> None:
        """Queue a job. Any thread."""
        with self._changed:
            if self._stopped:
                return
            self._jobs.append(job)
            if self._busy:
                return
            self._busy = True
        self._workers.schedule(self)

    def stop(self, timeout_s: float) -> None:
        """Wait up to this long [s] for the job in progress. Drop all other jobs."""
        with self._changed:
            self._stopped = True
            self._jobs.clear()
            self._changed.wait_for(lambda: not self._busy, timeout_s)

    def do_one(self) -> None:
        """Do the next job. Called by the pool's threads."""
        with self._changed:
            job = self._jobs.popleft() if self._jobs else None
        if job is not None:
            job()
        with self._changed:
            self._busy = bool(self._jobs)
            again = self._busy
            if not again:
                self._changed.notify_all()
        if again:
            self._workers.schedule(self)


class SharedLoop(Protocol):
    """A thread that runs the code of many vehicles: a ``Reactor``, a ``Ticker`` or a ``LinkThread``."""

    @property
    def inside(self) -> Any:
        """The object whose code is currently running; None if no code is."""

    @property
    def entries(self) -> int:
        """The number of times :attr:`inside` was set."""

    @property
    def empty(self) -> bool:
        """Whether there is no vehicle to serve."""

    def close(self) -> None:
        """End the thread unless it is stuck."""


class Watchdog:
    """Checks shared loops 20 times a second on a separate thread, from :meth:`start` to :meth:`close`.

    The watchdog counts its own checks rather than time. A loop on a suspended or overloaded machine is therefore not
    considered hung merely because time has passed. ``on_stall`` is called with a loop and its stuck member, once for
    each call that does not return. ``on_hang`` is called if that call still does not return.
    """

    def __init__(
        self,
        loops: Callable[[], Iterable[SharedLoop]],
        on_stall: Callable[[SharedLoop, Any], None],
        on_hang: Callable[[SharedLoop, Any], None],
    ) -> None:
        self._loops = loops
        self._on_stall = on_stall
        self._on_hang = on_hang
        self._seen: dict[SharedLoop, tuple[int, int]] = {}  # number of entries, and number of checks without a change
        self._checked_s = 0.0
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name="skyloop-watchdog", daemon=True)

    def start(self) -> None:
        self._thread.start()

    def close(self) -> None:
        """Stop checking. Idempotent."""
        self._closing.set()
        if self._thread.is_alive() and threading.current_thread() is not self._thread:
            self._thread.join()

    def check(self, now_s: float) -> None:
        punctual = now_s - self._checked_s < 2 * CHECK_S
        self._checked_s = now_s
        seen: dict[SharedLoop, tuple[int, int]] = {}
        for loop in list(self._loops()):
            entries, inside = loop.entries, loop.inside
            if inside is None:
                continue
            before, checks = self._seen.get(loop, (-1, 0))
            checks = checks + punctual if before == entries else 0
            seen[loop] = entries, checks
            if punctual and before == entries and checks in (STALL_CHECKS, HANG_CHECKS):
                act = self._on_stall if checks == STALL_CHECKS else self._on_hang
                try:
                    act(loop, inside)
                except Exception:  # noqa: BLE001 the checks must continue
                    _log.exception("handling a vehicle that hangs failed")
        self._seen = seen

    def _run(self) -> None:
        while not self._closing.wait(CHECK_S):
            self.check(time.monotonic())


class LinkThread:
    """Serves links on one thread when they are readable or due, from construction until :meth:`close`.

    One thread for all links: with one thread each, most of the time would be spent switching threads. Commands bypass
    it: they are sent on the thread that receives them. Like a :class:`skyloop.transport.local.reactor.Reactor`, it
    records whose code is running and can be split. ``links``: the initial links, each with the vehicle it belongs to.
    """

    def __init__(self, links: Mapping[ServedLink, Any] | None = None) -> None:
        self.inside: Any = None  #: the vehicle whose link is currently being polled
        self.entries = 0  #: number of times :attr:`inside` was set
        self._selector = selectors.DefaultSelector()
        self._waker, self._awake = socket_pair()
        self._waker.setblocking(False)
        self._awake.setblocking(False)
        self._lock = threading.Lock()  # guards what is known about the links
        self._members: dict[ServedLink, Any] = {}
        self._due_ns: dict[ServedLink, int] = {}
        self._queue: list[tuple[int, int, ServedLink]] = []  # a heap by due time; entries with outdated times are stale
        self._order = count()  # breaks ties between due times
        self._paused: set[ServedLink] = set()  # links that are not polled because of an error
        self._closing = False
        self._selector.register(self._awake, selectors.EVENT_READ)
        for link, vehicle in (links or {}).items():
            self.add(link, vehicle)
        self._thread = threading.Thread(target=self._run, name="skyloop-links", daemon=True)
        self._thread.start()

    def add(self, link: ServedLink, vehicle: Any) -> None:
        """Serve a link from now on until it ends. Any thread."""
        with self._lock:
            self._members[link] = vehicle
            self._plan(link, 0)
            self._selector.register(link, selectors.EVENT_READ, link)
        self._wake()

    @property
    def empty(self) -> bool:
        return not self._members

    def split(self, stuck: Any) -> LinkThread:
        """Leave this thread to one vehicle's links, and return a new thread for all other links. Any thread."""
        with self._lock:
            others = {link: vehicle for link, vehicle in self._members.items() if vehicle is not stuck}
            for link in others:
                self._forget(link)
        return LinkThread(others)

    def close(self) -> None:
        """End the thread unless it is stuck, and end the links that remain. Idempotent."""
        self._closing = True
        self._wake()
        if threading.current_thread() is not self._thread and self.inside is None:
            self._thread.join()

    def _forget(self, link: ServedLink) -> None:
        del self._members[link]
        self._due_ns.pop(link, None)
        self._paused.discard(link)
        self._unwatch(link)

    def _unwatch(self, link: ServedLink) -> None:
        with suppress(KeyError, ValueError, OSError):
            self._selector.unregister(link)

    def _plan(self, link: ServedLink, due_ns: int) -> None:
        """Schedule a link to be served by the given time. The caller holds the lock."""
        if self._due_ns.get(link) == due_ns:
            return
        self._due_ns[link] = due_ns
        heappush(self._queue, (due_ns, next(self._order), link))
        if len(self._queue) > _MOST_STALE * len(self._due_ns):
            self._queue = [entry for entry in self._queue if self._due_ns.get(entry[2]) == entry[0]]
            heapify(self._queue)

    def _next_ns(self) -> int | None:
        """Return the time when the next link is due; None if no link is. The caller holds the lock."""
        queue = self._queue
        while queue and self._due_ns.get(queue[0][2]) != queue[0][0]:
            heappop(queue)
        return queue[0][0] if queue else None

    def _due(self, now_ns: int) -> set[ServedLink]:
        """Return the links that are due for polling. The caller holds the lock."""
        due: set[ServedLink] = set()
        while (next_ns := self._next_ns()) is not None and next_ns <= now_ns:
            link = heappop(self._queue)[2]
            del self._due_ns[link]  # absent until its link has been served
            due.add(link)
        return due

    def _run(self) -> None:
        while not self._closing:
            with self._lock:
                next_ns = self._next_ns()
            if next_ns is None:
                next_ns = time.monotonic_ns() + _LONGEST_WAIT_NS
            wait_s = seconds(max(0, min(next_ns - time.monotonic_ns(), _LONGEST_WAIT_NS)))
            ready = {key.data for key, _ in self._selector.select(wait_s)}
            if None in ready:
                ready.remove(None)
                with suppress(OSError):
                    self._awake.recv(4096)
            now_ns = time.monotonic_ns()
            with self._lock:
                turns = ready | self._due(now_ns)
            for link in turns:
                self._serve(link, readable=link in ready)
            self.inside = None
        with self._lock:
            left = list(self._members)
        for link in left:  # the links of a vehicle that was dropped
            link.end()
        self._selector.close()
        self._awake.close()
        self._waker.close()

    def _serve(self, link: ServedLink, *, readable: bool) -> None:
        with self._lock:
            vehicle = self._members.get(link)
            if vehicle is None:
                return  # another thread has taken over the link
            if link in self._paused:
                self._paused.remove(link)
                readable = True  # it may be readable, because it was not polled
                self._selector.register(link, selectors.EVENT_READ, link)
        self.inside = vehicle
        self.entries += 1
        failed = False
        due_ns: int | None
        try:
            due_ns = link.serve(readable=readable)
        except Exception:  # noqa: BLE001  the link has reported it; all others continue
            failed, due_ns = True, time.monotonic_ns() + nanoseconds(PAUSE_S)
        with self._lock:
            if due_ns is not None:
                if link in self._members:
                    self._plan(link, due_ns)
                    if failed:
                        self._unwatch(link)
                        self._paused.add(link)
                return
            if link in self._members:
                self._forget(link)
        link.end()

    def _wake(self) -> None:
        with suppress(OSError):  # the thread is awake, or has ended
            self._waker.send(b"\0")
