"""One thread that updates all proxies of a process 50 times a second: authority, failsafes, software autopilots.

What is not the flight's, and everything of a vehicle that nobody flies, has its turn only in each fifth round.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Iterable
from typing import Final

from skyloop.clock import nanoseconds
from skyloop.proxy import Proxy
from skyloop.proxy.core.autopilot import PERIOD_S

#: Ticks in a row that raise, half a second of them, until a proxy counts as failed: it has no failsafe any more.
MAX_FAILURES: Final = 25
#: Rounds from one to the next in which a proxy does everything: ten times a second.
WHOLE_ROUNDS: Final = 5
_log = logging.getLogger(__name__)

#: Called with a proxy whose ticks raise, and the last error, on the ticker's thread; must return at once.
OnFailing = Callable[[Proxy, BaseException], None]


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
        period_ns = nanoseconds(PERIOD_S)
        due_ns = time.monotonic_ns() + period_ns
        rounds = 0
        while not self._closing.wait(max(0, due_ns - time.monotonic_ns()) / 1e9):
            with self._lock:
                proxies = list(self._failures)
            for place, proxy in enumerate(proxies, rounds):  # each round a fifth of them, so that all are alike long
                failures = self._failures.get(proxy)
                if failures is not None:  # it is not another ticker's meanwhile
                    self._tick(proxy, whole=failures > 0 or place % WHOLE_ROUNDS == 0)
            self.inside = None
            rounds += 1
            due_ns = max(due_ns + period_ns, time.monotonic_ns())  # late ones are not made up for

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
