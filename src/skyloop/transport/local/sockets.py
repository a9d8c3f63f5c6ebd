"""The sockets of the local transport, and the processes at their other ends."""

from __future__ import annotations

import functools
import os
import pwd
import socket
import struct
from typing import Final, NamedTuple

#: Enough for a packet of the largest size and a burst of small ones; little enough that what waits for a stalled
#: reader stays small (about 200 packets of 300 bytes).
SEND_BUFFER: Final = 131_072
SEND_FLAGS: Final = socket.MSG_DONTWAIT | socket.MSG_NOSIGNAL
RECEIVE_FLAGS: Final = socket.MSG_DONTWAIT  #: for who waits by other means
_SO_PEERGROUPS: Final = 59  # Linux 4.13; missing from Python's socket module
_CREDENTIALS: Final = struct.Struct("3i")
_MAX_OPTION: Final = 1024  # bytes that Python lets an option have: 256 groups


class Socket(socket.socket):
    """A ``SOCK_SEQPACKET`` socket that closes when nobody uses it any more.

    The ends *shut down* a connection and drop their references, and never close it. So the number of a descriptor that
    a thread is just sending on can't be reused for something else.

    Args:
        fileno: An open descriptor to take over; None for a new socket.
    """

    def __init__(self, fileno: int | None = None) -> None:
        super().__init__(socket.AF_UNIX, socket.SOCK_SEQPACKET, 0, fileno)
        self.settimeout(None)  # whatever socket.setdefaulttimeout() is set to

    def __del__(self) -> None:
        self.close()

    def limit_backlog(self) -> None:
        """Bound what may wait unread at the other end, to :data:`SEND_BUFFER` bytes."""
        self.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER)

    def hang_up(self, last_packet: bytes = b"") -> None:
        """End the connection in both directions, after a last packet if that one fits."""
        try:
            if last_packet:
                self.send(last_packet, SEND_FLAGS)
            self.shutdown(socket.SHUT_RDWR)
        except OSError:
            self._shut_down_quietly()

    def _shut_down_quietly(self) -> None:
        try:
            self.shutdown(socket.SHUT_RDWR)
        except OSError:
            return  # it had ended already


class Credentials(NamedTuple):
    """The process at the other end, as the kernel saw it when the connection was made."""

    pid: int
    uid: int
    gid: int

    def __str__(self) -> str:
        return f"pid {self.pid} ({user_name(self.uid)})"


def credentials(sock: socket.socket) -> Credentials:
    """Return who connected or, at a client, who listens."""
    return Credentials(*_CREDENTIALS.unpack(sock.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _CREDENTIALS.size)))


def peer_groups(sock: socket.socket) -> set[int]:
    """Return all groups of who connected; only the primary one for a user in more than 256."""
    primary = credentials(sock).gid
    try:
        raw = sock.getsockopt(socket.SOL_SOCKET, _SO_PEERGROUPS, _MAX_OPTION)
    except OSError:
        return {primary}
    return {primary, *struct.unpack(f"{len(raw) // 4}I", raw)}


def may_connect(sock: socket.socket, gid: int | None) -> bool:
    """Return whether the process that connected may.

    Args:
        sock: The accepted connection.
        gid: The group that may connect, None for none.

    Returns:
        Whether it belongs to this process's user, to the superuser, or to a member of the group.
    """
    uid = credentials(sock).uid
    return uid in (os.geteuid(), 0) or (gid is not None and gid in peer_groups(sock))


@functools.lru_cache(maxsize=64)
def user_name(uid: int) -> str:
    """Return the name of a user, or ``uid 123`` if it has none."""
    try:
        return pwd.getpwuid(uid).pw_name
    except KeyError:
        return f"uid {uid}"


def set_timeout(sock: socket.socket, option: int, seconds: float) -> None:
    """Limit how long the kernel blocks in a call, which then fails with ``EAGAIN``.

    Args:
        sock: The socket.
        option: ``SO_RCVTIMEO`` or ``SO_SNDTIMEO``.
        seconds: The limit [s]; 0 for none.
    """
    whole = int(seconds)
    sock.setsockopt(socket.SOL_SOCKET, option, struct.pack("@ll", whole, int((seconds - whole) * 1e6)))
