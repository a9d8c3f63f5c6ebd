"""Code that somebody waits for, kept in the processor's caches: run on a dummy every few milliseconds while it matters.

A command comes every 31 ms. Meanwhile others use the caches, so that the same instructions, which take 8 µs when they
have just run, take 110 µs: most of the delay of a channel. It is run only while the computer has a processor to spare,
so that it takes nothing from work: that is decided by how long the processors were idle, from ``/proc/stat``.
``docs/delays.md`` has the measurements and the alternatives.
"""

from __future__ import annotations

import logging
import os
import sys
import threading
import time
from collections.abc import Callable, Collection, Sequence
from pathlib import Path
from typing import Final, NamedTuple

#: Run one after the other.
Pieces = Sequence[Callable[[], object]]

PERIOD_S: Final = 0.005  #: how often the code is run, unless somebody says otherwise
SHORTEST_S: Final = 0.001  #: the least that makes sense
_LATE_S: Final = 0.004  #: a thread that wakes so late found no processor free
_RAREST_S: Final = 1.0

LOOK_S: Final = 0.5  #: how often it makes sense to ask
#: Idle processors below which there is none to spare, and from which there is one again; less on a single one.
LEAST_CORES: Final = 0.8
AGAIN_CORES: Final = 1.2
_LEAST_SHARE: Final = 0.4
_AGAIN_SHARE: Final = 0.6
#: For how long there has to be none before it counts, so that a short burst does not: two looks.
_STOP_S: Final = 0.9
#: For how long there has to be one again; doubled each time that it did not last, up to the longest.
FIRST_WAIT_S: Final = 2.0
LONGEST_WAIT_S: Final = 60.0
LASTING_S: Final = 30.0
#: An average over a longer time says nothing of now.
_OLD_S: Final = 5.0
_STAT: Final = Path("/proc/stat")
_MOST_BYTES: Final = 1 << 16
_TICK_S: Final = 1.0 / os.sysconf("SC_CLK_TCK") if sys.platform == "linux" else 0.0
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


class Idleness(NamedTuple):
    """How long some processors have been idle."""

    cores: int
    idle_s: float  #: of all of them together, since the computer was started


def parse_idleness(text: bytes, usable: Collection[int]) -> Idleness | None:
    """Return how long processors have been idle or waited for a disk.

    Args:
        text: The beginning of ``/proc/stat``, at least its lines of the processors.
        usable: Numbers of the processors that count.

    Returns:
        Their idleness; None if the text has none of them.
    """
    cores = ticks = 0
    for line in text.splitlines():
        fields = line.split()
        if not line.startswith(b"cpu") or len(fields) < 6:
            break
        number = fields[0][3:]  # empty in the line of all together
        if number and int(number) in usable:
            cores += 1
            ticks += int(fields[4]) + int(fields[5])
    return Idleness(cores, ticks * _TICK_S) if cores else None


def read_idleness() -> Idleness | None:
    """Return the idleness of the processors that this process may use; None where it can't be read."""
    if sys.platform != "linux":
        return None
    try:
        with _STAT.open("rb", buffering=0) as file:
            text = file.read(_MOST_BYTES)
        return parse_idleness(text, os.sched_getaffinity(0))
    except (OSError, ValueError):
        return None


class Spare:
    """Judges whether there is a processor to spare. Nothing is read but by ``read``; the time is an argument.

    Not before it has seen that there is one. What takes more than a core away, such as many who all believe to have
    found a processor, is not tried again and again: the wait until the next time grows.

    Args:
        read: Returns the idleness now; None where it is not known, and there is a processor to spare then.
    """

    def __init__(self, read: Callable[[], Idleness | None] = read_idleness) -> None:
        self._read = read
        self._before: tuple[float, Idleness] | None = None
        self._enough = False
        self._enough_since_s = 0.0
        self._contrary_since_s: float | None = None  # since when what is seen speaks against what is believed
        self._wait_s = 0.0

    def __call__(self, now_s: float) -> bool:
        """Look, and return whether there is a processor to spare.

        Args:
            now_s: On any clock that goes on.
        """
        seen = self._read()
        if seen is None:
            return True
        before, self._before = self._before, (now_s, seen)
        if before is None:
            return self._enough
        before_s, known = before
        passed_s = now_s - before_s
        if not 0.0 < passed_s <= _OLD_S or known.cores != seen.cores:
            self._contrary_since_s = None
            return self._enough
        idle_cores = (seen.idle_s - known.idle_s) / passed_s
        if self._enough:
            contrary = idle_cores < min(LEAST_CORES, _LEAST_SHARE * seen.cores)
        else:
            contrary = idle_cores >= min(AGAIN_CORES, _AGAIN_SHARE * seen.cores)
        if not contrary:
            self._contrary_since_s = None
            return self._enough
        if self._contrary_since_s is None:
            self._contrary_since_s = before_s
        if now_s - self._contrary_since_s >= (_STOP_S if self._enough else self._wait_s):
            self._change(now_s)
        return self._enough

    def _change(self, now_s: float) -> None:
        self._contrary_since_s = None
        self._enough = not self._enough
        if self._enough:
            self._enough_since_s = now_s
        elif now_s - self._enough_since_s >= LASTING_S:
            self._wait_s = FIRST_WAIT_S
        else:
            self._wait_s = min(max(2.0 * self._wait_s, FIRST_WAIT_S), LONGEST_WAIT_S)
