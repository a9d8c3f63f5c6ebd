"""Threads that do the requests of many proxies, of each one after the other."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from typing import Final

MAX_THREADS: Final = 64  #: so many drivers may hang in a request before others have to wait
IDLE_THREADS: Final = 2  #: that stay, as requests come in bursts
_IDLE_S: Final = 5.0

Job = Callable[[], None]


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
