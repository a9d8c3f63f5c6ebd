"""Threads that many proxies share: one updates them, some do their requests, and one notices when their loop hangs."""

from __future__ import annotations

import logging
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable
from typing import Any, Final, Protocol

from skyloop.clock import beats
from skyloop.proxy import Proxy
from skyloop.proxy.core.autopilot import PERIOD_S

#: Ticks in a row that raise, half a second of them, until a proxy counts as failed: it has no failsafe any more.
MAX_FAILURES: Final = 25
#: Rounds from one to the next in which a proxy does everything: ten times a second.
WHOLE_ROUNDS: Final = 5
_log = logging.getLogger(__name__)

#: Called with a proxy whose ticks raise, and the last error, on the ticker's thread; must return at once.
OnFailing = Callable[[Proxy, BaseException], None]
MAX_THREADS: Final = 64  #: so many drivers may hang in a request before others have to wait
IDLE_THREADS: Final = 2  #: that stay, as requests come in bursts
_IDLE_S: Final = 5.0

Job = Callable[[], None]
LOOK_S: Final = 0.05
STALL_LOOKS: Final = 5  #: 0.25 s: the other vehicles get another thread, before their pilots' silence makes them hover
HANG_LOOKS: Final = 40  #: 2 s: the vehicle is given up


class Ticker:
    """Ticks proxies on one thread, from its construction to :meth:`close`. A tick that raises harms no other proxy.

    Like a :class:`skyloop.transport.local.reactor.Reactor` it shows whose code it is in, and can be split.

    Args:
        on_failing: What to do about a proxy of which :data:`MAX_FAILURES` ticks in a row have raised.
        proxies: Which it ticks from the beginning.
    """

    def __init__(self, on_failing: OnFailing, proxies: Iterable[Proxy] = ()) -> None:
        self.inside: Proxy | None = None  #: which is being ticked
        self.entries = 0  #: how often :attr:`inside` was set
        self._on_failing = on_failing
        self._failures = dict.fromkeys(proxies, 0)  # in a row, of each proxy
        self._lock = threading.Lock()  # guards who is in there
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name="skyloop-ticker", daemon=True)
        self._thread.start()

    def add(self, proxy: Proxy) -> None:
        """Tick a proxy from now on. Any thread."""
        with self._lock:
            self._failures[proxy] = 0

    def remove(self, proxy: Proxy) -> bool:
        """Tick a proxy no more; return whether it was ticked here. Any thread. A tick in progress goes on."""
        with self._lock:
            return self._failures.pop(proxy, None) is not None

    @property
    def empty(self) -> bool:
        """Whether it ticks no proxy."""
        return not self._failures

    def split(self, stuck: Proxy) -> Ticker:
        """Leave this ticker to one proxy, and return a new one that ticks all others. Any thread."""
        with self._lock:
            others = [proxy for proxy in self._failures if proxy is not stuck]
            for proxy in others:
                del self._failures[proxy]
        return Ticker(self._on_failing, others)

    def close(self) -> None:
        """End the thread, unless it is stuck. Idempotent."""
        self._closing.set()
        if threading.current_thread() is not self._thread and self.inside is None:
            self._thread.join()

    def _run(self) -> None:
        for rounds, _ in enumerate(beats(PERIOD_S, self._closing)):
            with self._lock:
                proxies = list(self._failures)
            for place, proxy in enumerate(proxies, rounds):  # each round a fifth of them, so that all are alike long
                failures = self._failures.get(proxy)
                if failures is not None:  # it is not another ticker's meanwhile
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
        except Exception as error:  # noqa: BLE001  whatever is wrong with one vehicle, the others need their failsafes
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
    """A pool of daemon threads, as many as there are requests at the same time, for the lanes of proxies.

    A job that hangs holds up its own lane only.
    """

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._ready: deque[RequestLane] = deque()  # have a job that nobody does yet
        self._idle = 0
        self._threads = 0
        self._closed = False

    def lane(self) -> RequestLane:
        """Return a lane for one proxy."""
        return RequestLane(self)

    def close(self) -> None:
        """Let the threads end that do nothing."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()

    def schedule(self, lane: RequestLane) -> None:
        """Let a thread do the next job of a lane. For lanes."""
        with self._changed:
            self._ready.append(lane)
            if self._idle >= len(self._ready):
                self._changed.notify()
            elif self._threads < MAX_THREADS:
                self._threads += 1
                threading.Thread(target=self._run, name="skyloop-requests", daemon=True).start()

    def _run(self) -> None:
        while (lane := self._next()) is not None:
            lane.do_one()

    def _next(self) -> RequestLane | None:
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


class RequestLane:
    """The jobs of one proxy: a :class:`skyloop.proxy.requests.JobQueue` on the threads of a pool."""

    def __init__(self, workers: RequestWorkers) -> None:
        self._workers = workers
        self._changed = threading.Condition()
        self._jobs: deque[Job] = deque()
        self._busy = False
        self._stopped = False

    def start(self) -> None:
        """There is nothing to start: the pool has threads."""

    def put(self, job: Job) -> None:
        """Do this after what waits already. Any thread."""
        with self._changed:
            if self._stopped:
                return
            self._jobs.append(job)
            if self._busy:
                return
            self._busy = True
        self._workers.schedule(self)

    def stop(self, timeout_s: float) -> None:
        """Wait for the job in progress, for at most so long [s]; drop the others."""
        with self._changed:
            self._stopped = True
            self._jobs.clear()
            self._changed.wait_for(lambda: not self._busy, timeout_s)

    def do_one(self) -> None:
        """Do the next job. For the pool's threads."""
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
    """A thread that runs the code of many vehicles: a ``Reactor`` or a ``Ticker``."""

    @property
    def inside(self) -> Any:
        """Whose code it is in now; None for nobody's."""

    @property
    def entries(self) -> int:
        """How often that was set."""

    @property
    def empty(self) -> bool:
        """Whether it serves nobody."""

    def close(self) -> None:
        """End the thread, unless it is stuck."""


class Watchdog:
    """Looks at shared loops 20 times a second, on a thread of its own, from :meth:`start` to :meth:`close`.

    It counts its own looks rather than the time: on a machine that stood still, or had no processor to spare, nobody
    hangs only because much time has gone by.

    Args:
        loops: Returns the loops.
        on_stall: Called with a loop and whose code it is stuck in, once per call that does not return.
        on_hang: Called with the same when it still has not.
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
        self._seen: dict[SharedLoop, tuple[int, int]] = {}  # entries, and looks at which they were the same
        self._looked_s = 0.0
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name="skyloop-watchdog", daemon=True)

    def start(self) -> None:
        """Begin to look."""
        self._thread.start()

    def close(self) -> None:
        """Look no more. Idempotent."""
        self._closing.set()
        if self._thread.is_alive() and threading.current_thread() is not self._thread:
            self._thread.join()

    def look(self, now_s: float) -> None:
        """Look once."""
        punctual = now_s - self._looked_s < 2 * LOOK_S
        self._looked_s = now_s
        seen: dict[SharedLoop, tuple[int, int]] = {}
        for loop in list(self._loops()):
            entries, inside = loop.entries, loop.inside
            if inside is None:
                continue
            before, looks = self._seen.get(loop, (-1, 0))
            looks = looks + punctual if before == entries else 0
            seen[loop] = entries, looks
            if punctual and before == entries and looks in (STALL_LOOKS, HANG_LOOKS):
                act = self._on_stall if looks == STALL_LOOKS else self._on_hang
                try:
                    act(loop, inside)
                except Exception:  # noqa: BLE001  it must go on to look
                    _log.exception("what was to be done about a vehicle that hangs failed")
        self._seen = seen

    def _run(self) -> None:
        while not self._closing.wait(LOOK_S):
            self.look(time.monotonic())
