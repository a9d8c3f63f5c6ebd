"""A lock that serves its waiters in the order of their arrival, commands first.

``threading.RLock`` goes to whichever thread is awake: one that acquires it again and again keeps it from all others
for as long as it likes, and a command would wait behind two hundred requests of another application.
"""

from __future__ import annotations

import threading
from collections import deque
from types import TracebackType
from typing import Final

from skyloop.messages import Command
from skyloop.messages.codec import KINDS

_COMMAND: Final = bytes([KINDS[Command]])


def is_command(packet: bytes) -> bool:
    """Return whether a packet is a command, emergency stops included: commands are handled before everything else."""
    return packet[5:6] == _COMMAND


class PriorityLock:
    """A re-entrant lock that each holder hands over to the next waiter.

    ``with lock:`` waits behind all others, ``with lock.urgent:`` only behind those that are urgent, too.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._owner = 0  # identity of the thread that has it
        self._depth = 0
        self._urgent: deque[tuple[threading.Lock, int]] = deque()  # who waits, woken by a lock of its own
        self._others: deque[tuple[threading.Lock, int]] = deque()
        self.urgent = _Urgent(self)

    def acquire(self, *, urgent: bool = False) -> None:
        """Wait for the lock and acquire it; the thread that holds it may acquire it again.

        Args:
            urgent: Whether to go before all waiters that are not urgent.
        """
        me = threading.get_ident()
        if self._owner == me:
            self._depth += 1
            return
        with self._lock:
            if not self._owner:
                self._owner, self._depth = me, 1
                return
            woken = threading.Lock()
            woken.acquire()
            (self._urgent if urgent else self._others).append((woken, me))
        woken.acquire()  # it is ours then

    def release(self) -> None:
        """Release the lock once, and hand it over when the holder's last hold is released.

        Only the thread that holds the lock may call this; that is not checked.
        """
        self._depth -= 1
        if self._depth:
            return
        with self._lock:
            waiting = self._urgent or self._others
            if not waiting:
                self._owner = 0
                return
            woken, self._owner = waiting.popleft()
            self._depth = 1
        woken.release()

    @property
    def held(self) -> bool:
        """Whether the calling thread holds the lock."""
        return self._owner == threading.get_ident()

    @property
    def waiting(self) -> int:
        """How many threads wait."""
        return len(self._urgent) + len(self._others)

    def __enter__(self) -> None:
        self.acquire()

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.release()


class _Urgent:
    """The context manager behind :attr:`PriorityLock.urgent`."""

    def __init__(self, lock: PriorityLock) -> None:
        self._lock = lock

    def __enter__(self) -> None:
        self._lock.acquire(urgent=True)

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._lock.release()
