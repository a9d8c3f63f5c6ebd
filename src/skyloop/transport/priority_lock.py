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
        self._taken = threading.Lock()  # taken while a thread has it; handed over as it is
        self._owner = 0  # identity of the thread that has it
        self._depth = 0  # how often the owner acquired it besides
        self._queues = threading.Lock()  # guards the queues
        self._urgent: deque[tuple[threading.Lock, int]] = deque()  # who waits, woken by a lock of its own
        self._others: deque[tuple[threading.Lock, int]] = deque()
        self.urgent = _Urgent(self)

    def acquire(self, urgent: bool = False) -> None:
        """Wait for the lock and acquire it; the thread that holds it may acquire it again.

        Args:
            urgent: Whether to go before all waiters that are not urgent.
        """
        me = threading.get_ident()
        if self._taken.acquire(False):  # the usual case, with as few lines as possible
            self._owner = me
            return
        if self._owner == me:
            self._depth += 1
            return
        woken = threading.Lock()
        woken.acquire()
        with self._queues:
            (self._urgent if urgent else self._others).append((woken, me))
        self._hand_over()  # should it have been released just now
        woken.acquire()  # it is ours then

    def release(self) -> None:
        """Release the lock once, and hand it over when the holder's last hold is released.

        Only the thread that holds the lock may call this; that is not checked.
        """
        if self._depth:
            self._depth -= 1
            return
        self._owner = 0
        self._taken.release()
        if self._urgent or self._others:
            self._hand_over()

    def _hand_over(self) -> None:
        """Give the lock to who waits first, if it is free."""
        with self._queues:
            waiting = self._urgent or self._others
            if waiting and self._taken.acquire(False):
                woken, self._owner = waiting.popleft()
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
