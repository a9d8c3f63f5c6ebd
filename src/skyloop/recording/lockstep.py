"""A replay in step with its application: ``skyloop.connect("replay://flight.mcap?speed=max")``.

Proxy, recording and application share this process, and a clock that stands still while the application's code runs.
Whenever the application waits, for the next frame, for a state, in :meth:`Controller.run`, the clock goes on to what
comes next: a sample of the recording, a repeat of a command, a tick of the proxy. So each sample is consumed before the
next one exists, the application sees the recording's times, and two runs of one controller give the same commands.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from pathlib import Path
from typing import Final, Protocol

from skyloop.client.link import Link
from skyloop.client.pace import Pace
from skyloop.client.slots import Bell
from skyloop.clock import NS_PER_S, ManualClock, nanoseconds
from skyloop.drivers.replay import ReplayDriver
from skyloop.drivers.uri import parse_uri
from skyloop.errors import UsageError
from skyloop.messages import LinkState
from skyloop.proxy.autopilot import PERIOD_S
from skyloop.proxy.proxy import Proxy
from skyloop.recording.in_step import InStepServer, World
from skyloop.transport.base import Dialer

LEAD_NS: Final = NS_PER_S  #: before the recording begins: for connecting, which takes a few ticks
AFTER_NS: Final = 60 * NS_PER_S  #: after its end the time goes on at most so long for who waits without a limit
_TICK_NS: Final = nanoseconds(PERIOD_S)
_NEVER_NS: Final = 1 << 62


def connector(uri: str) -> Lockstep | None:
    """The way to a replay with ``speed=max``; None for any other, which a private proxy serves.

    Raises :class:`UsageError` for an address or a recording that makes no sense.
    """
    driver = ReplayDriver(parse_uri(uri))
    return Lockstep(driver) if driver.stepped else None


class Lockstep:
    """A proxy of a replay, and the time that it shares with its one application."""

    def __init__(self, driver: ReplayDriver) -> None:
        self.reach = None
        self._world = World("skyloop-lockstep")
        try:
            tape = driver.tape()
            clock = ManualClock(tape.begin_ns - LEAD_NS)
            driver.clock = clock
            server = InStepServer(self._world)
            name = Path(driver.uri.place).stem[:64] or "replay"
            self._proxy = Proxy(driver, server, name=name, clock=clock, ticker=False)
            self.pace = StepPace(clock, self._world, self._proxy, lambda: driver.steps, tape.begin_ns)
            self._proxy.start()
        except BaseException:
            self._world.end()
            raise
        self._server = server
        self._ended = False

    def dialer(self, deadline_s: float) -> Dialer:  # noqa: ARG002  (it serves already)
        return self._server.dial

    def close(self) -> None:
        if not self._ended:
            self._ended = True
            self._proxy.stop()
            self._world.end()


class Moments(Protocol):
    """What the time goes on to: the samples of a recording, or the steps of a simulated world."""

    @property
    def due_ns(self) -> int | None:
        """When the next one is; None after the last."""

    def step(self) -> None:
        """Let it happen: its time is now."""


class StepPace(Pace):
    """The time of the recording. Waiting is what makes it go on."""

    in_step = True

    def __init__(
        self,
        clock: ManualClock,
        world: World,
        proxy: Proxy,
        moments: Callable[[], Moments | None],
        begin_ns: int,
    ) -> None:
        super().__init__(clock)
        self._time = clock
        self._world = world
        self._proxy = proxy
        self._moments = moments
        self._begin_ns = begin_ns
        self._link: Link | None = None
        self._link_due_ns = 0
        self._tick_due_ns = clock.now_ns
        self._begun = False  # the recording moves: the application is connected
        self._end_ns = _NEVER_NS
        self._turn = threading.Lock()  # held by the one thread for which the time goes on
        self._interrupted = False

    def bell(self) -> Bell:
        return StepBell(self)

    def begin(self, link: Link) -> None:
        self._link = link

    def opened(self) -> None:
        """From here on, and from the recording's begin on, its samples come."""
        self.wait_for(lambda: False, (self._begin_ns - self._time.now_ns) / NS_PER_S, lambda: False)
        self._begun = True

    def wait_for(self, ready: Callable[[], bool], timeout_s: float | None, sleep: Callable[[], bool]) -> bool:
        """Let the time go on until it is ready, for at most so long of the recording's time.

        Where another thread waits already, the time goes on for that one, and ``sleep()`` waits as ever.
        """
        if self._world.here:
            raise UsageError("this is called for a sample in step with the recording, and can't wait for the next one")
        if not self._turn.acquire(blocking=False):
            return sleep()
        try:
            until_ns = _NEVER_NS if timeout_s is None else self._time.now_ns + nanoseconds(max(0.0, timeout_s))
            found: list[bool] = []
            self._interrupted = False
            self._world.call(lambda: found.append(self._go_on(ready, until_ns)), self._interrupt)
            return found[0]
        finally:
            self._turn.release()

    # On the world's thread -------------------------------------------------------------------------------------

    def _go_on(self, ready: Callable[[], bool], until_ns: int) -> bool:
        self._world.settle()
        while not ready():
            if self._interrupted or not self._step(until_ns):
                return ready()
            self._world.settle()
        return True

    def _step(self, until_ns: int) -> bool:
        """Do what comes next; False if that is later than the time given, or if nothing comes any more."""
        link, steps, time = self._link, self._moments(), self._time
        if link is not None and (link.poked or self._link_due_ns <= time.now_ns):
            self._attend(link)
            return True
        recorded_ns = steps.due_ns if self._begun and steps is not None else None
        due_ns = min(self._tick_due_ns, self._link_due_ns if link is not None else _NEVER_NS)
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
        elif link is not None:
            self._attend(link)
        return True

    def _attend(self, link: Link) -> None:
        if link.state is LinkState.CLOSED:
            self._link = None
            return
        pause_s = link.attend()
        self._link_due_ns = self._time.now_ns + max(1, nanoseconds(pause_s))

    def _interrupt(self) -> None:
        self._interrupted = True


class StepBell(Bell):
    """A bell at which waiting makes the time go on."""

    __slots__ = ("_pace",)

    def __init__(self, pace: StepPace) -> None:
        super().__init__()
        self._pace = pace

    def wait_for(self, ready: Callable[[], bool], timeout_s: float | None = None) -> bool:
        """Wait until ``ready()`` is true, looked at after each step; False if it is not within the recording's time."""
        return ready() or self._pace.wait_for(
            ready, timeout_s, lambda: super(StepBell, self).wait_for(ready, timeout_s)
        )
