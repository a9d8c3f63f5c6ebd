"""A replay in step with its application: ``skyloop.connect("replay://flight.mcap?speed=max")``.

Proxy, recording and application share this process, with a clock that stops while the application's code runs. Whenever
the application waits for a frame, for a state or in :meth:`Controller.run`, the clock advances to the next
event: a recorded sample, a repeated command, or a tick of the proxy. Each sample is therefore consumed before the next
one exists, the application sees the recording's times, and two runs of the same controller produce the same commands.
"""

from __future__ import annotations

from pathlib import Path
from typing import Final

from skyloop.clock import NS_PER_S, ManualClock
from skyloop.drivers.uri import parse_uri
from skyloop.proxy.proxy import Proxy
from skyloop.stepping.transport import StepExecutor, SteppedServer, StepScheduler
from skyloop.transport.base import Dialer
from skyloop.vehicles.replay.driver import ReplayDriver

LEAD_NS: Final = NS_PER_S  #: the clock starts this long before the recording, so that the application can connect


def connector(uri: str) -> SteppedReplay | None:
    """Return a stepped replay if the address has ``speed=max``, or None to have a private proxy serve the address.

    This is the entry point ``replay`` in the group ``skyloop.connectors``.

    Raises:
        UsageError: The address or the recording is invalid.
    """
    driver = ReplayDriver(parse_uri(uri))
    return SteppedReplay(driver) if driver.stepped else None


class SteppedReplay:
    """The proxy of a replay, and the simulated time that the proxy shares with its only application."""

    def __init__(self, driver: ReplayDriver) -> None:
        self.reach = None
        self._executor = StepExecutor("skyloop-stepping")
        try:
            source = driver.source()
            clock = ManualClock(source.begin_ns - LEAD_NS)
            driver.clock = clock
            server = SteppedServer(self._executor)
            name = Path(driver.uri.place).stem[:64] or "replay"
            self._proxy = Proxy(driver, server, name=name, clock=clock, ticker=False)
            self.scheduler = StepScheduler(clock, self._executor, self._proxy, lambda: driver.steps, source.begin_ns)
            self._proxy.start()
        except BaseException:
            self._executor.close()
            raise
        self._server = server
        self._ended = False

    def dialer(self, deadline_s: float) -> Dialer:  # noqa: ARG002
        """Return a dialer for the proxy, which is serving already."""
        return self._server.dial

    def close(self) -> None:
        """Stop the proxy and the thread. Idempotent."""
        if not self._ended:
            self._ended = True
            self._proxy.end()
            self._executor.close()
