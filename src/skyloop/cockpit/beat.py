"""A steady beat that many pages share: what they are all told is made once."""

from __future__ import annotations

import asyncio
from collections.abc import Callable

Wake = Callable[[], None]


class Beat:
    """Makes something at a steady rate while anybody wants it, and tells all who do. On the event loop."""

    def __init__(self, period_s: float, make: Callable[[], bytes], on_change: Callable[[bool], None]) -> None:
        """``on_change`` is called with True before the first, with False after the last one who wants it."""
        self.made = b""  #: what was made last
        self.ended = False  #: nothing more will come
        self._period_s = period_s
        self._make = make
        self._on_change = on_change
        self._wakes: set[Wake] = set()
        self._task: asyncio.Task[None] | None = None

    @property
    def wanted(self) -> bool:
        return bool(self._wakes)

    def join(self, wake: Wake) -> None:
        """``wake`` is called after each time that it was made; what is there now is fresh, unless it has ended."""
        if self.ended:
            wake()
            return
        if not self._wakes:
            self._on_change(True)
            self.made = self._make()
            self._task = asyncio.create_task(self._run())
        self._wakes.add(wake)
        wake()

    def leave(self, wake: Wake) -> None:
        """Does nothing for who has not joined."""
        if wake in self._wakes:
            self._wakes.discard(wake)
            if not self._wakes:
                self._rest()
                self._on_change(False)

    def end(self) -> None:
        """For good; all who want it are told."""
        self.ended = True
        self._rest()
        for wake in list(self._wakes):
            wake()

    def _rest(self) -> None:
        if self._task is not None:
            self._task.cancel()
            self._task = None

    async def _run(self) -> None:
        loop = asyncio.get_running_loop()
        due = loop.time()
        while True:
            due = max(due + self._period_s, loop.time())  # a late beat is not made up for
            await asyncio.sleep(due - loop.time())
            self.made = self._make()
            for wake in list(self._wakes):
                wake()
