"""Simulated time for a client: it advances while the application waits and stops while the application's code runs."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Final, Protocol

from skyloop.client.channels import Notifier
from skyloop.client.connection import ConnectionSupervisor, ProxyConnection, Scheduler
from skyloop.clock import NS_PER_S, ManualClock, nanoseconds
from skyloop.errors import UsageError
from skyloop.messages import LinkState
from skyloop.proxy.core.autopilot import PERIOD_S
from skyloop.proxy.proxy import Proxy
from skyloop.stepping.transport import StepExecutor

AFTER_NS: Final = 60 * NS_PER_S  #: an unlimited wait gives up this long after the end of the recording
_TICK_NS: Final = nanoseconds(PERIOD_S)
_NEVER_NS: Final = 1 << 62


class StepSource(Protocol):
    """The events that drive simulated time: a recording's samples or a simulated world's steps."""

    @property
    def due_ns(self) -> int | None:
        """When the next event is due; None after the last one."""

    def step(self) -> None:
        """Publish the sample or run the step that is due now."""


class StepScheduler(Scheduler):
    """Simulated time, which advances only while the application waits."""

    in_step = True

    def __init__(
        self,
        clock: ManualClock,
        executor: StepExecutor,
        proxy: Proxy,
        source: Callable[[], StepSource | None],
        begin_ns: int,
    ) -> None:
        """Set up simulated time; ``source`` returns the source of samples or steps, None before it exists."""
        super().__init__(clock)
        self._time = clock
        self._executor = executor
        self._proxy = proxy
        self._source = source
        self._begin_ns = begin_ns
        self._supervisor: ConnectionSupervisor | None = None
        self._supervisor_due_ns = 0
        self._tick_due_ns = clock.now_ns
        self._begun = False  # whether the application is connected and the recording has started
        self._end_ns = _NEVER_NS
        self._turn = threading.Lock()  # held by the thread that is advancing time
        self._interrupted = False

    def notifier(self) -> Notifier:
        """Return a notifier whose waits advance simulated time."""
        return StepNotifier(self)

    def sample_notifier(self, connection: ProxyConnection) -> Notifier:  # noqa: ARG002
        """Return a notifier whose waits advance simulated time."""
        return StepNotifier(self)

    def begin(self, supervisor: ConnectionSupervisor) -> None:
        """Store the connection's supervisor, to be called as time advances."""
        self._supervisor = supervisor

    def opened(self) -> None:
        """Advance to the recording's start and begin to publish its samples."""
        self.wait_for(lambda: False, (self._begin_ns - self._time.now_ns) / NS_PER_S, lambda: False)
        self._begun = True

    def wait_for(self, ready: Callable[[], bool], timeout_s: float | None, sleep: Callable[[], bool]) -> bool:
        """Advance simulated time until ``ready()`` is true, evaluated after each step on the executor's thread.

        If another thread is already advancing time, this one just waits in ``sleep()``, in real time. The limit is in
        simulated time; None waits until 60 s after the recording's end. On the executor's thread, for example in an
        inline callback, this raises UsageError.
        """
        if self._executor.is_current:
            raise UsageError("a callback in step with the recording can't wait for the next sample")
        if not self._turn.acquire(blocking=False):
            return sleep()
        try:
            until_ns = _NEVER_NS if timeout_s is None else self._time.now_ns + nanoseconds(max(0.0, timeout_s))
            found: list[bool] = []
            self._interrupted = False
            self._executor.call(lambda: found.append(self._advance(ready, until_ns)), self._interrupt)
            return found[0]
        finally:
            self._turn.release()

    # On the executor's thread -------------------------------------------------------------------------------------

    def _advance(self, ready: Callable[[], bool], until_ns: int) -> bool:
        self._executor.run_pending()
        while not ready():
            if self._interrupted or not self._step(until_ns):
                return ready()
            self._executor.run_pending()
        return True

    def _step(self, until_ns: int) -> bool:
        """Process the next event; return False if there is none or it is due later than the given time."""
        supervisor, steps, time = self._supervisor, self._source(), self._time
        if supervisor is not None and (supervisor.connection.poked or self._supervisor_due_ns <= time.now_ns):
            self._attend(supervisor)
            return True
        recorded_ns = steps.due_ns if self._begun and steps is not None else None
        due_ns = min(self._tick_due_ns, self._supervisor_due_ns if supervisor is not None else _NEVER_NS)
        if recorded_ns is not None:
            due_ns = min(due_ns, recorded_ns)
        elif self._begun and self._end_ns == _NEVER_NS:
            self._end_ns = time.now_ns + AFTER_NS
        if due_ns > min(until_ns, self._end_ns):
            time.now_ns = max(time.now_ns, min(until_ns, self._end_ns))
            return False
        time.now_ns = max(time.now_ns, due_ns)
        if recorded_ns == due_ns and steps is not None:
            steps.step()
        elif self._tick_due_ns == due_ns:
            self._tick_due_ns += _TICK_NS
            self._proxy.tick(time.now_ns)
        elif supervisor is not None:
            self._attend(supervisor)
        return True

    def _attend(self, supervisor: ConnectionSupervisor) -> None:
        if supervisor.connection.state is LinkState.CLOSED:
            self._supervisor = None
            return
        pause_s = supervisor.attend()
        self._supervisor_due_ns = self._time.now_ns + max(1, nanoseconds(pause_s))

    def _interrupt(self) -> None:
        self._interrupted = True


class StepNotifier(Notifier):
    """A notifier whose waits advance simulated time."""

    __slots__ = ("_scheduler",)

    def __init__(self, scheduler: StepScheduler) -> None:
        """Store the scheduler."""
        super().__init__()
        self._scheduler = scheduler

    def wait_for(self, ready: Callable[[], bool], timeout_s: float | None = None) -> bool:
        """Wait until ``ready()`` is true, evaluated after each step; return whether it became so in time."""
        return ready() or self._scheduler.wait_for(
            ready, timeout_s, lambda: super(StepNotifier, self).wait_for(ready, timeout_s)
        )
