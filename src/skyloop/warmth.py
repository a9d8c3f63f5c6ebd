"""Code that somebody waits for, kept in the processor's caches: run on a dummy every few milliseconds while it matters.

A command comes every 31 ms. Meanwhile others use the caches, so that the same instructions, which take 8 µs when they
have just run, take 110 µs: most of the delay of a channel. ``docs/delays.md`` has the measurements.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Sequence
from typing import Final

from skyloop.spare import LOOK_S, Spare

#: Run one after the other.
Pieces = Sequence[Callable[[], object]]

PERIOD_S: Final = 0.005  #: how often the code is run, unless somebody says otherwise
SHORTEST_S: Final = 0.001  #: the least that makes sense
_LATE_S: Final = 0.004  #: a thread that wakes so late found no processor free
_RAREST_S: Final = 1.0
_log = logging.getLogger(__name__)


class Warmer:
    """Runs one piece of code again and again, on one thread of the process, while anybody wants it.

    It pauses while the computer has no processor to spare. Code that has failed is never run again.

    Args:
        make: Returns the pieces of code, in their order; called on the thread when it is wanted for the first time.
        name: For the thread and for messages.
        sleep: Waits for some seconds.
        clock: Returns the time [s].
        spare: Returns whether the computer has a processor to spare at a time on the clock [s].
    """

    def __init__(
        self,
        make: Callable[[], Pieces],
        name: str,
        *,
        sleep: Callable[[float], object] = time.sleep,
        clock: Callable[[], float] = time.monotonic,
        spare: Callable[[float], bool] | None = None,
    ) -> None:
        self._make = make
        self._name = name
        self._sleep = sleep
        self._clock = clock
        self._spare = Spare() if spare is None else spare
        self._failed = False
        self._wanted: dict[object, float] = {}  # by who wants it: how often [s]
        self._period_s = 0.0  # the shortest of them; 0: nobody
        self._pieces: Pieces | None = None
        self._thread: threading.Thread | None = None
        self._lock = threading.Lock()

    def keep(self, who: object, period_s: float) -> None:
        """Keep the code warm for somebody, or no longer. Quick where nothing changes. Any thread.

        Args:
            who: Whoever wants it.
            period_s: How often the code is run [s]; 0: ``who`` does not want it any more.
        """
        if self._wanted.get(who, 0.0) == period_s:
            return
        with self._lock:
            if self._failed:
                return
            if period_s > 0.0:
                self._wanted[who] = period_s
            else:
                self._wanted.pop(who, None)
            self._period_s = min(self._wanted.values(), default=0.0)
            if self._wanted and self._thread is None:
                self._thread = threading.Thread(target=self._work, name=f"skyloop-warm-{self._name}", daemon=True)
                self._thread.start()

    @property
    def active(self) -> bool:
        """Whether anybody wants the code to be run now."""
        return self._period_s > 0.0

    def _work(self) -> None:
        pause_s = look_s = 0.0
        spare = False
        while True:
            with self._lock:
                period_s = self._period_s
                if not period_s:
                    self._thread = None  # another one is started when it is wanted again
                    return
            now_s = self._clock()
            if now_s >= look_s:
                spare, look_s = self._spare(now_s), now_s + LOOK_S
            if not spare:
                self._sleep(LOOK_S)
                continue
            if not self._run():
                return
            # Who wakes late has no processor to spare: rarer then, by and by, so that it takes none from others.
            pause_s = min(max(pause_s, period_s), max(period_s, _RAREST_S))
            due_s = self._clock() + pause_s
            self._sleep(pause_s)
            if self._clock() > due_s + _LATE_S:
                pause_s *= 2.0
            else:
                pause_s = pause_s / 2.0 if pause_s > 2.0 * period_s else 0.0

    def _run(self) -> bool:
        """Run the code once; return False if it failed."""
        try:
            if self._pieces is None:
                self._pieces = self._make()
            for piece in self._pieces:
                piece()
                self._sleep(0.0)  # who waits for the interpreter meanwhile waits for one piece and not for all
        except Exception:  # noqa: BLE001  everything works without this, only slower
            _log.exception("keeping the %s warm failed, and is given up", self._name)
            with self._lock:
                self._failed = True
                self._wanted.clear()
                self._period_s, self._thread, self._pieces = 0.0, None, None
            return False
        return True
