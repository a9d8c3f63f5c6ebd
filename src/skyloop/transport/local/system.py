"""What the local transport needs of the operating system, and which of its two sides provides it.

The *fast* side (:mod:`skyloop.transport.local.fast`) uses Linux's ``SOCK_SEQPACKET``, ``SCM_RIGHTS`` and sealed
memory. The *portable* side (:mod:`skyloop.transport.local.portable`) uses loopback TCP and named shared memory. A
server uses the fast side where it works, unless ``SKYLOOP_TRANSPORT=portable``. A client reaches servers of both.
"""

from __future__ import annotations

import functools
import importlib
import os
import socket
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple, Protocol, cast

from skyloop.errors import UsageError

if TYPE_CHECKING:
    from skyloop.transport.base import Pixels
    from skyloop.transport.local.frame_exchange import SlotMemory

TRANSPORT_VARIABLE: Final = "SKYLOOP_TRANSPORT"
FAST: Final = "fast"
PORTABLE: Final = "portable"
_AUTO: Final = "auto"
PROXY: Final = "proxy"
HOST: Final = "host"  #: a host for many proxies; its socket accepts requests to add and remove vehicles
CONNECT_TIMEOUT_S: Final = 1.0
#: Size of the send buffer. It has room for the largest packet and a burst of small packets, but is small enough to
#: bound the backlog of a stalled reader (about 200 packets of 300 bytes).
SEND_BUFFER: Final = 131_072
RECEIVE_FLAGS: Final[int] = getattr(socket, "MSG_DONTWAIT", 1)  #: flags for callers that wait by other means
SEND_FLAGS: Final[int] = RECEIVE_FLAGS | getattr(socket, "MSG_NOSIGNAL", 0)


class Credentials(NamedTuple):
    """The process at the other end: as the kernel identified it when it connected, or as it introduced itself."""

    pid: int
    uid: int
    gid: int

    def __str__(self) -> str:
        return f"pid {self.pid} ({user_name(self.uid)})"


class PacketSocket(Protocol):
    """One end of a connection that carries whole packets. Any thread may send; one thread at a time may receive.

    ``send`` and ``post`` never wait: ``BlockingIOError`` if the packet does not fit now, another ``OSError`` if the
    connection has ended. The socket closes when nothing refers to it any more.
    """

    @property
    def who(self) -> Credentials:
        """The process at the other end."""

    @property
    def recv(self) -> Callable[..., bytes]:
        """Function of a size and flags that returns the next packet, cut to that size; empty at the end.

        With :data:`RECEIVE_FLAGS` it does not wait; without flags, it waits as long as :meth:`limit_wait` allows.
        ``BlockingIOError``: nothing arrived.
        """

    @property
    def send(self) -> Callable[..., int]:
        """Function of a packet and :data:`SEND_FLAGS`."""

    def post(self, packet: bytes) -> None:
        """Send a packet without waiting for any lock, because the garbage collector may call this at any point."""

    def send_descriptor(self, packet: bytes, descriptor: int) -> None:
        """Send a packet with a file descriptor."""

    def send_within(self, packet: bytes, seconds: float) -> None:
        """Send a packet, and wait up to ``seconds`` [s] until it fits."""

    def receiver(self, size: int) -> Callable[[], tuple[bytes, Sequence[Any], int, Any]]:
        """Return a function for a client that returns the next packet, and descriptors that came with it."""

    def descriptors(self, ancillary: Sequence[Any]) -> list[int]:
        """Return the descriptors that came with a packet; the caller closes them."""

    def map_sealed(self, descriptor: int, capacity: int) -> Pixels:
        """Map the memory behind a descriptor for reading, unless it could shrink while it is read (``LinkError``)."""

    def poller(self) -> Callable[[int], object]:
        """Return a function that waits for some time [ms], and returns whether a packet or the end is waiting."""

    def limit_wait(self, seconds: float) -> None:
        """Limit how long receiving waits [s] before it raises ``BlockingIOError``. 0 means no limit."""

    def limit_backlog(self) -> None:
        """Limit the data that waits to be read at the other end."""

    def hang_up(self, last_packet: bytes = b"") -> None:
        """End the connection in both directions. A last packet is sent first if it fits into the buffer."""

    def fileno(self) -> int: ...

    def close(self) -> None: ...


class StrangerError(ConnectionError):
    """A process that wanted to connect, but did not prove that it may."""


class Listener(Protocol):
    """A server's socket, which accepts connections."""

    def accept(self) -> tuple[PacketSocket, object]:
        """Return a new connection. Raises ``OSError``, or :class:`StrangerError` for one that was turned away."""

    def setblocking(self, flag: bool, /) -> None: ...

    def fileno(self) -> int: ...

    def hang_up(self) -> None:
        """Stop listening, and wake the accepting thread."""


class Poller(Protocol):
    """Waits for many descriptors to become readable. Any thread may call all methods except :attr:`poll`."""

    waker: int  #: the descriptor that :attr:`poll` reports after :meth:`wake`

    @property
    def poll(self) -> Callable[[float], list[tuple[int, int]]]:
        """Function that waits for some time [s] and returns pairs, each of a descriptor and something else."""

    def register(self, fileno: int) -> None: ...

    def unregister(self, fileno: int) -> None:
        """Forget a descriptor. Ignored after :meth:`close`."""

    def mute(self, fileno: int, muted: bool) -> None:
        """Ignore a registered descriptor for some time."""

    def wake(self) -> None: ...

    def drain(self) -> None:
        """Make the waker unreadable again."""

    def close(self) -> None: ...


class System(Protocol):
    """One side, which is a module. Each proxy has one file in the directory, at ``path``; the calls raise OSError."""

    @property
    def SUFFIXES(self) -> dict[str, str]:  # noqa: N802
        """The files' suffixes, for :data:`PROXY` and :data:`HOST`."""

    @property
    def new_slot(self) -> Callable[[int, int, int], SlotMemory]:
        """Function of a number, a generation and a capacity that reserves memory for frames."""

    @property
    def new_poller(self) -> Callable[[], Poller]: ...

    def check_path(self, path: Path) -> None:
        """Raise ``UsageError`` if a server can't be at this path."""

    def listen(self, path: Path, gid: int | None) -> Listener:
        """Listen at a path where no file is. ``gid``: the group whose members may connect, if any."""

    def connect(self, path: Path) -> PacketSocket:
        """Connect within :data:`CONNECT_TIMEOUT_S`; ``BlockingIOError``: the server does not accept."""

    def is_live(self, path: Path) -> bool:
        """Return whether a process still serves at this path."""

    def owner_pid(self, path: Path) -> int | None:
        """Return the id of the process that serves at this path; None if it can't be determined immediately."""

    def remove(self, path: Path) -> None:
        """Remove what a process that has ended left behind, if anything."""

    def may_connect(self, sock: PacketSocket, gid: int | None) -> bool:
        """Return whether the process at the other end may connect."""


@functools.cache
def systems() -> dict[str, System]:
    """Return the sides that exist on this system, the preferred one first."""
    found: dict[str, System] = {}
    for name in (FAST, PORTABLE):
        try:
            side = importlib.import_module(f"skyloop.transport.local.{name}")
            side.check_support()
        except (ImportError, AttributeError, AssertionError, OSError):
            continue  # a function that this side needs does not exist
        found[name] = cast(System, side)
    return found


def serving_side() -> str:
    """Return which side a new server uses. Raises ``UsageError`` if ``SKYLOOP_TRANSPORT`` has an unknown value."""
    wanted = os.environ.get(TRANSPORT_VARIABLE) or _AUTO
    if wanted not in (_AUTO, PORTABLE):
        raise UsageError(
            f"{TRANSPORT_VARIABLE} is {wanted!r}; it must be {PORTABLE!r}, or {_AUTO!r} for the fastest that works here"
        )
    return next(iter(systems())) if wanted == _AUTO else PORTABLE


@functools.lru_cache(maxsize=64)
def user_name(uid: int) -> str:
    """Return a user's name, or ``uid 123`` if the user has no name."""
    if sys.platform != "win32":
        import pwd

        try:
            return pwd.getpwuid(uid).pw_name
        except KeyError:
            return f"uid {uid}"
    return os.environ.get("USERNAME") or f"uid {uid}"


def own_uid() -> int:
    """Return this process's effective user; 0 on Windows, which has no such numbers."""
    return os.geteuid() if sys.platform != "win32" else 0


def try_lock(descriptor: int, *, shared: bool = False) -> bool:
    """Lock an open file until it is closed or the process ends; return False if another one holds it.

    On Windows all locks are exclusive. There, the lock covers a byte behind the content, which stays readable.
    """
    if sys.platform != "win32":
        import fcntl

        try:
            fcntl.flock(descriptor, (fcntl.LOCK_SH if shared else fcntl.LOCK_EX) | fcntl.LOCK_NB)
        except BlockingIOError:
            return False
        return True
    import msvcrt

    os.lseek(descriptor, 1 << 30, os.SEEK_SET)
    try:
        msvcrt.locking(descriptor, msvcrt.LK_NBLCK, 1)
    except PermissionError:
        return False
    return True
