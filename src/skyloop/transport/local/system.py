"""What the local transport needs of the operating system, and which of its two sides provides it.

The *fast* side (:mod:`skyloop.transport.local.fast`) uses Linux's ``SOCK_SEQPACKET``, ``SCM_RIGHTS`` and sealed
memory. The *portable* side (:mod:`skyloop.transport.local.portable`) uses loopback TCP and named shared memory. A
server uses the fast side where it works, unless ``SKYLOOP_TRANSPORT=portable``. A client reaches servers of both.
"""

from __future__ import annotations

import errno
import functools
import importlib
import os
import socket
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple, Protocol, cast

from skyloop.errors import LinkError, UsageError

if TYPE_CHECKING:
    from skyloop.transport.base import Pixels
    from skyloop.transport.local.frame_exchange import SlotMemory

TRANSPORT_VARIABLE: Final = "SKYLOOP_TRANSPORT"
FAST: Final = "fast"
PORTABLE: Final = "portable"
_AUTO: Final = "auto"
#: What kernels say of calls, sockets and memory that they do not have, or do not allow.
_LACKING: Final = {
    *(errno.EINVAL, errno.ENOSYS, errno.EPERM, errno.EACCES, errno.EAFNOSUPPORT, errno.EPROTONOSUPPORT),
    *(errno.EPROTOTYPE, errno.EOPNOTSUPP),
}
PROXY: Final = "proxy"
HOST: Final = "host"  #: a host for many proxies; its socket accepts requests to add and remove vehicles
CONNECT_TIMEOUT_S: Final = 1.0
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

    Sending never waits: ``BlockingIOError`` if the packet does not fit now, another ``OSError`` if the connection has
    ended. Receiving waits as long as :meth:`limit_wait` allows, or not at all with :data:`RECEIVE_FLAGS`, and then
    raises ``BlockingIOError``. The socket closes when nothing refers to it any more.
    """

    #: Flags with which ``send`` waits for no lock either, because the garbage collector may call it at any point.
    post_flags: int

    @property
    def who(self) -> Credentials: ...  # the process at the other end
    @property
    def send(self) -> Callable[..., int]: ...  # of a packet and SEND_FLAGS
    @property
    def recv(self) -> Callable[..., bytes]: ...  # of a size and flags; returns a packet cut to it, empty at the end
    def fileno(self) -> int: ...
    def close(self) -> None: ...

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
        """Limit how long receiving waits [s]. 0 means no limit."""

    def on_room(self, call: Callable[[], object]) -> None:
        """Call a function on any thread when something fits again after a packet did not. Not all sides need this."""

    def limit_backlog(self) -> None:
        """Limit the data that waits to be read at the other end."""

    def hang_up(self, last_packet: bytes = b"") -> None:
        """End the connection in both directions. A last packet is sent first if it fits into the buffer."""


class StrangerError(ConnectionError):
    """A process that wanted to connect, but did not prove that it may."""


class Listener(Protocol):
    """A server's socket. ``accept`` also raises :class:`StrangerError`; ``hang_up`` wakes the thread that is in it.

    The name is in use until ``release``, which is for after the file's removal (on Windows, for just before it).
    """

    def accept(self) -> tuple[PacketSocket, object]: ...
    def setblocking(self, flag: bool, /) -> None: ...
    def fileno(self) -> int: ...
    def hang_up(self) -> None: ...
    def release(self) -> None: ...


class Poller(Protocol):
    """Waits for descriptors to become readable. Any thread may call everything else than ``poll`` and ``drain``."""

    waker: int  #: the descriptor that ``poll`` reports after ``wake``, until ``drain``

    @property
    def poll(self) -> Callable[[float], list[tuple[int, int]]]: ...  # of a time [s]; the pairs begin with a descriptor
    def register(self, fileno: int) -> None: ...
    def unregister(self, fileno: int) -> None: ...  # ignored after ``close``
    def mute(self, fileno: int, muted: bool) -> None: ...  # ignores a descriptor for some time
    def wake(self) -> None: ...
    def drain(self) -> None: ...
    def close(self) -> None: ...


class System(Protocol):
    """One side, which is a module. Each server has one file in the directory. All calls may raise ``OSError``."""

    @property
    def SUFFIXES(self) -> dict[str, str]: ...  # noqa: N802  the files' suffixes, for PROXY and HOST
    @property
    def new_slot(self) -> Callable[[int, int, int], SlotMemory]: ...  # of a number, a generation and a capacity
    @property
    def new_poller(self) -> Callable[[], Poller]: ...

    def check_path(self, path: Path) -> None:
        """Raise ``UsageError`` if a server can't be at this path."""

    def listen(self, path: Path, gid: int | None) -> Listener:
        """Listen at a path where no file is. ``gid``: the group whose members may connect, if any."""

    def connect(self, path: Path) -> PacketSocket:
        """Connect; ``BlockingIOError`` if the server does not accept within a few seconds."""

    def may_connect(self, sock: PacketSocket, gid: int | None) -> bool:
        """Return whether the process at the other end may connect."""

    def is_live(self, path: Path) -> bool:
        """Return whether a process still serves at this path."""

    def owner_pid(self, path: Path) -> int | None:
        """Return the id of the process that serves at this path; None if it can't be determined immediately."""

    def remove(self, path: Path) -> None:
        """Remove what a process that has ended left behind, if anything."""


@functools.cache
def systems() -> dict[str, System]:
    """Return the sides that exist on this system, the preferred one first.

    Raises :class:`LinkError` if this can't be determined now, because memory or descriptors have run out. The process
    must not settle on the portable side for that: it would no longer see the proxies of the fast one.
    """
    found: dict[str, System] = {}
    for name in (FAST, PORTABLE):
        try:
            side = importlib.import_module(f"skyloop.transport.local.{name}")
            side.check_support()
        except (ImportError, AttributeError, AssertionError, OSError) as error:
            if not _is_lacking(error):
                raise LinkError(f"the local transport can't be prepared: {error}") from error
            continue
        found[name] = cast(System, side)
    return found


def _is_lacking(error: Exception) -> bool:
    """Return whether an error means that the system lacks a function, now and later."""
    if isinstance(error, OSError):
        return error.errno in _LACKING
    # Without descriptors, Python finds none of our own modules.
    return not (isinstance(error, ImportError) and (error.name or "").startswith("skyloop"))


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
