"""What waits of one connection until the proxy gets to it: all in order, but of the set-points only the newest.

A command is the full desired state, and the library sends it again 32 times a second. Where a proxy is late, each
set-point that waits behind a newer one costs time and is refused for its age in the end, which makes the proxy later
still. So a newer one takes its place. What asks for something once (take-off, landing, hover, emergency stop) is kept,
and only repeats of it are joined.
"""

from __future__ import annotations

from enum import IntEnum
from typing import Final

from skyloop.errors import DecodeError
from skyloop.messages import Command, Idle, decode
from skyloop.messages.command import SET_POINTS
from skyloop.transport.priority_lock import is_command

SUPERSEDED: Final = "commands.superseded"  #: the counter of the commands that newer ones took the place of
MOST_PACKETS: Final = 256  #: that are taken out of a socket before the first of them is handled
MOST_BYTES: Final = 131_072  #: of them
_NOTHING: Final[tuple[bytes, Command | None]] = (b"", None)


class Lane(IntEnum):
    """What waits first in a backlog, the most urgent first."""

    URGENT = 0  #: commands, and one of them is no set-point: a landing, an emergency stop
    STEERING = 1  #: set-points, and the keep-alive in place of one
    OTHERS = 2  #: anything else


class Backlog:
    """The packets of one connection that wait. Not thread-safe.

    Args:
        most: How many may wait.
    """

    __slots__ = ("_bytes", "_idle", "_last", "_most", "_number", "_set_point", "_waiting")

    def __init__(self, most: int = MOST_PACKETS) -> None:
        self._most = most
        self._bytes = 0
        self._number = 0
        self._waiting: dict[int, tuple[bytes, Command | None]] = {}  # in order
        self._set_point = self._idle = self._last = 0  # the newest of the commands; they may not wait any more

    def __len__(self) -> int:
        return len(self._waiting)

    @property
    def full(self) -> bool:
        """Whether no more should be put in for now."""
        return len(self._waiting) >= self._most or self._bytes >= MOST_BYTES

    @property
    def lane(self) -> Lane | None:
        """What waits first, up to the first packet that is no command; None: nothing does."""
        found = None
        for _, command in self._waiting.values():
            if command is None:
                return Lane.OTHERS if found is None else found
            if not (type(command.action) is Idle or isinstance(command.action, SET_POINTS)):
                return Lane.URGENT
            found = Lane.STEERING
        return found

    def put(self, packet: bytes) -> int:
        """Add a packet; return how many commands it took the place of."""
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
        """Take the packet that waits first. There must be one."""
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
        """Drop an older command if it still waits; return how many were dropped."""
        _, older = self._waiting.get(number, _NOTHING)
        if older is None or older.seq >= newer.seq:  # packets of a network may come in another order
            return 0
        self._take(number)
        return 1


def _command(packet: bytes) -> Command | None:
    """Return the command in a packet; None for anything else, damaged ones included."""
    if not is_command(packet):
        return None
    try:
        command = decode(packet)
    except DecodeError:
        return None
    return command if isinstance(command, Command) else None
