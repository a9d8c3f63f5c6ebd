"""Commands first: the order in which packets, and the threads that carry them, reach the proxy.

A command is the full desired state, and the library repeats it 32 times a second. When a proxy is late, it spends time
on outdated set-points, only to refuse them as stale, and gets even later. Therefore in a :class:`PacketBacklog`, a
newer set-point replaces an older one. One-off requests (take-off, landing, hover, emergency stop) are kept; only
repeats of the same request are merged.

Several threads share a :class:`PriorityLock` in order of arrival, commands first. A ``threading.RLock`` goes to any
thread that is awake. A thread that re-acquires the lock in a loop can starve all others, and a command would wait
behind two hundred requests from another application.
"""

from __future__ import annotations

import threading
from collections import deque
from enum import IntEnum
from typing import Final

from skyloop.errors import DecodeError
from skyloop.messages import Command, Idle, decode
from skyloop.messages.codec import KINDS
from skyloop.messages.command import SET_POINTS

SUPERSEDED: Final = "commands.superseded"  #: number of commands that newer ones replaced
MOST_PACKETS: Final = 256  #: maximum number of packets taken out of a socket before the first of them is handled
MOST_BYTES: Final = 131_072  #: maximum total size of the packets taken out
_NOTHING: Final[tuple[bytes, Command | None]] = (b"", None)
_COMMAND: Final = bytes([KINDS[Command]])


def is_command(packet: bytes) -> bool:
    """Return whether a packet is a command or an emergency stop. Both are handled before all other packets."""
    return packet[5:6] == _COMMAND


class Lane(IntEnum):
    """The class of the leading packets in a backlog, most urgent first."""

    URGENT = 0  #: commands that include at least one that is not a set-point, such as a landing or an emergency stop
    STEERING = 1  #: set-points, or the keep-alives that are sent instead
    OTHERS = 2  #: anything else


class PacketBacklog:
    """Holds up to ``most`` waiting packets from one connection. Not thread-safe."""

    __slots__ = ("_bytes", "_idle", "_last", "_most", "_number", "_set_point", "_waiting")

    def __init__(self, most: int = MOST_PACKETS) -> None:
        self._most = most
        self._bytes = 0
        self._number = 0
        self._waiting: dict[int, tuple[bytes, Command | None]] = {}  # in order
        self._set_point = self._idle = self._last = 0  # numbers of the newest slots, which may have been removed

    def __len__(self) -> int:
        return len(self._waiting)

    @property
    def full(self) -> bool:
        """Whether the backlog currently can't take any more packets."""
        return len(self._waiting) >= self._most or self._bytes >= MOST_BYTES

    @property
    def lane(self) -> Lane | None:
        """Lane of the leading commands, or OTHERS if the first packet isn't a command; None if the backlog is empty."""
        found = None
        for _, command in self._waiting.values():
            if command is None:
                return Lane.OTHERS if found is None else found
            if not (type(command.action) is Idle or isinstance(command.action, SET_POINTS)):
                return Lane.URGENT
            found = Lane.STEERING
        return found

    def put(self, packet: bytes) -> int:
        """Add a packet; return how many commands it replaced."""
        command = _command(packet)
        superseded = 0 if command is None else self._supersede(command)
        self._number += 1
        self._waiting[self._number] = packet, command
        self._bytes += len(packet)
        if command is not None:
            self._last = self._number
            if type(command.action) is Idle:
                self._idle = self._number
            elif isinstance(command.action, SET_POINTS):
                self._set_point = self._number
        return superseded

    def get(self) -> bytes:
        """Remove and return the first packet. The backlog must not be empty."""
        return self._take(next(iter(self._waiting)))

    def _take(self, number: int) -> bytes:
        packet, _ = self._waiting.pop(number)
        self._bytes -= len(packet)
        return packet

    def _supersede(self, command: Command) -> int:
        if type(command.action) is Idle:
            return self._drop(self._idle, command)
        if isinstance(command.action, SET_POINTS):
            return self._drop(self._set_point, command) + self._drop(self._idle, command)
        _, before = self._waiting.get(self._last, _NOTHING)
        if before is None or (before.intent, before.action) != (command.intent, command.action):
            return 0
        return self._drop(self._last, command)

    def _drop(self, number: int, newer: Command) -> int:
        """Drop an older command if it is still waiting; return how many were dropped."""
        _, older = self._waiting.get(number, _NOTHING)
        if older is None or older.seq >= newer.seq:  # a network may have changed their order
            return 0
        self._take(number)
        return 1


def _command(packet: bytes) -> Command | None:
    """Return the command in a packet; None if it contains anything else, including a damaged command."""
    if not is_command(packet):
        return None
    try:
        command = decode(packet)
    except DecodeError:
        return None
    return command if isinstance(command, Command) else None


class PriorityLock:
    """A re-entrant lock. Each holder hands the lock to the thread that waits next.

    ``with lock`` waits behind all other threads; ``lock.acquire(urgent=True)`` waits only behind other urgent ones.
    """

    def __init__(self) -> None:
        self._taken = threading.Lock()  # locked while a thread owns this lock, and during a hand-over
        self._owner = 0  # identity of the thread that owns the lock
        self._depth = 0  # additional acquisitions of the lock by its owner
        self._queues = threading.Lock()  # guards the queues
        self._urgent: deque[tuple[threading.Lock, int]] = deque()  # waiting threads, each with a lock that wakes it
        self._others: deque[tuple[threading.Lock, int]] = deque()

    def acquire(self, urgent: bool = False) -> None:
        """Wait for the lock, ahead of all non-urgent threads if ``urgent``. The owner may acquire the lock again."""
        me = threading.get_ident()
        if self._taken.acquire(False):  # the most frequent case, handled in as few steps as possible
            self._owner = me
            return
        if self._owner == me:  # only this thread can have stored its identity, so no lock is needed to check
            self._depth += 1
            return
        woken = threading.Lock()
        woken.acquire()
        with self._queues:
            (self._urgent if urgent else self._others).append((woken, me))
        self._hand_over()  # the lock may have been released after the first attempt
        woken.acquire()  # the releasing thread has made this thread the owner

    def release(self, *_: object) -> None:
        """Release the lock once. The caller must own it (this is not checked). The last release hands the lock over."""
        if self._depth:
            self._depth -= 1
            return
        self._owner = 0
        self._taken.release()
        if self._urgent or self._others:
            self._hand_over()

    def _hand_over(self) -> None:
        """Give the lock to the first waiting thread, if the lock is free."""
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
        return len(self._urgent) + len(self._others)

    __enter__ = acquire
    __exit__ = release
