"""From the client's threads to the event loop, and from there to pages at a steady rate."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import Any, Final, Protocol

ROW_HZ: Final = 2.0  #: of a drone's feedback while pages show it only as a row among others
Wake = Callable[[], None]


class Cancellable(Protocol):
    """What registering a callback with a drone returns."""

    def cancel(self) -> None: ...


def call_soon(loop: asyncio.AbstractEventLoop, function: Callable[..., None], *arguments: Any) -> None:
    """Call a function on the loop, from any thread; does nothing if the loop is closed, as it has no pages left."""
    if not loop.is_closed():
        loop.call_soon_threadsafe(function, *arguments)


class PeriodicBroadcast:
    """Makes a message at a steady rate while there are subscribers, once for all of them. On the event loop."""

    def __init__(self, period_s: float, make: Callable[[], bytes], on_change: Callable[[bool], None]) -> None:
        """Prepare it; the first subscriber starts it.

        Args:
            period_s: Between two messages [s].
            make: Makes a message.
            on_change: Called with True before the first subscriber, with False after the last one.
        """
        self.message = b""  #: the newest
        self.closed = False  #: no more messages will come
        self._period_s = period_s
        self._make = make
        self._on_change = on_change
        self._wakes: set[Wake] = set()
        self._task: asyncio.Task[None] | None = None

    @property
    def wanted(self) -> bool:
        """Whether there are subscribers."""
        return bool(self._wakes)

    def subscribe(self, wake: Wake) -> None:
        """Call ``wake`` for each new message, and now: the message is fresh, unless this is closed."""
        if self.closed:
            wake()
            return
        if not self._wakes:
            self._on_change(True)
            self.message = self._make()
            self._task = asyncio.create_task(self._run())
        self._wakes.add(wake)
        wake()

    def unsubscribe(self, wake: Wake) -> None:
        """Call ``wake`` no longer; does nothing for one that has not subscribed."""
        if wake in self._wakes:
            self._wakes.discard(wake)
            if not self._wakes:
                self._stop()
                self._on_change(False)

    def close(self) -> None:
        """End it for good, and wake all subscribers."""
        self.closed = True
        self._stop()
        for wake in list(self._wakes):
            wake()

    def _stop(self) -> None:
        if self._task is not None:
            self._task.cancel()
            self._task = None

    async def _run(self) -> None:
        loop = asyncio.get_running_loop()
        due = loop.time()
        while True:
            due = max(due + self._period_s, loop.time())  # a late one is not made up for
            await asyncio.sleep(due - loop.time())
            self.message = self._make()
            for wake in list(self._wakes):
                wake()
