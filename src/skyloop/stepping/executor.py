"""The one thread of a flight in simulated time."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from queue import Empty, SimpleQueue

Job = Callable[[], None]
_log = logging.getLogger("skyloop")


class StepExecutor:
    """One thread that runs everything but the application's own code, in the order in which it was posted."""

    def __init__(self, name: str) -> None:
        """Start the thread.

        Args:
            name: Of the thread.
        """
        self._jobs: SimpleQueue[Job | None] = SimpleQueue()
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    @property
    def is_current(self) -> bool:
        """Whether the calling thread is the executor's."""
        return threading.current_thread() is self._thread

    def post(self, job: Job) -> None:
        """Run a job after what was posted before.

        Args:
            job: An exception that it raises is logged.
        """
        self._jobs.put(job)

    def call(self, job: Job, interrupt: Job) -> None:
        """Run a job after what was posted before, and wait until it has returned.

        Args:
            job: What to run; what it raises is raised here.
            interrupt: Called on the calling thread after Ctrl-C, to make ``job`` return.
        """
        done = threading.Lock()
        done.acquire()
        raised: list[BaseException] = []

        def run() -> None:
            try:
                job()
            except BaseException as error:  # noqa: BLE001  (raised again on the calling thread)
                raised.append(error)
            finally:
                done.release()

        self.post(run)
        try:
            done.acquire()
        except BaseException:  # Ctrl-C
            interrupt()
            done.acquire()
            raise
        if raised:
            raise raised[0]

    def run_pending(self) -> None:
        """Run all posted jobs, and those that they post. To be called on the executor's thread only."""
        while True:
            try:
                job = self._jobs.get_nowait()
            except Empty:
                return
            if job is None:
                self._jobs.put(None)
                return
            _run_logged(job)

    def close(self) -> None:
        """End the thread after what was posted before. Idempotent."""
        self._jobs.put(None)
        if not self.is_current:
            self._thread.join()

    def _run(self) -> None:
        while (job := self._jobs.get()) is not None:
            _run_logged(job)


def _run_logged(job: Job) -> None:
    try:
        job()
    except Exception:  # noqa: BLE001  (the next step may work)
        _log.exception("a step of a replay failed")
