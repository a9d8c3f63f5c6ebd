"""The local transport's sockets: which process is at the other end, and connections at the server."""

from __future__ import annotations

import array
import functools
import os
import pwd
import select
import socket
import struct
from contextlib import suppress
from typing import Final, NamedTuple

from skyloop.transport.base import MAX_PACKET, Peer
from skyloop.transport.local import packets
from skyloop.transport.priority import MOST_PACKETS, PacketBacklog

#: Size of the send buffer. It has room for the largest packet and a burst of small packets, but is small enough to
#: bound the backlog of a stalled reader (about 200 packets of 300 bytes).
SEND_BUFFER: Final = 131_072
SEND_FLAGS: Final = socket.MSG_DONTWAIT | socket.MSG_NOSIGNAL
RECEIVE_FLAGS: Final = socket.MSG_DONTWAIT  #: flags for callers that wait by other means
_SO_PEERGROUPS: Final = 59  # Linux 4.13; missing from Python's socket module
_CREDENTIALS: Final = struct.Struct("3i")
_MAX_OPTION: Final = 1024  # Python's limit for a socket option [bytes], enough for 256 groups


class Socket(socket.socket):
    """A ``SOCK_SEQPACKET`` socket that closes itself when nothing refers to it any more.

    Both ends *shut down* a connection and drop their references, but neither closes it. A descriptor's number therefore
    can't be reused while a thread is sending on it.
    """

    def __init__(self, fileno: int | None = None) -> None:
        super().__init__(socket.AF_UNIX, socket.SOCK_SEQPACKET, 0, fileno)
        self.settimeout(None)  # overrides socket.setdefaulttimeout()

    def __del__(self) -> None:
        self.close()

    def limit_backlog(self) -> None:
        """Limit the data that waits to be read at the other end to :data:`SEND_BUFFER` bytes."""
        self.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER)

    def hang_up(self, last_packet: bytes = b"") -> None:
        """End the connection in both directions. A last packet is sent first if it fits into the buffer."""
        if last_packet:
            with suppress(OSError):
                self.send(last_packet, SEND_FLAGS)
        with suppress(OSError):  # the connection had already ended
            self.shutdown(socket.SHUT_RDWR)


class Credentials(NamedTuple):
    """The process at the other end, as the kernel identified it at the time of connecting."""

    pid: int
    uid: int
    gid: int

    def __str__(self) -> str:
        return f"pid {self.pid} ({user_name(self.uid)})"


def credentials(sock: socket.socket) -> Credentials:
    """Return the connecting process or, if called by a client, the listening one."""
    return Credentials(*_CREDENTIALS.unpack(sock.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _CREDENTIALS.size)))


def peer_groups(sock: socket.socket) -> set[int]:
    """Return all groups of the connecting user; if the user has more than 256, only the primary group."""
    primary = credentials(sock).gid
    try:
        raw = sock.getsockopt(socket.SOL_SOCKET, _SO_PEERGROUPS, _MAX_OPTION)
    except OSError:
        return {primary}
    return {primary, *struct.unpack(f"{len(raw) // 4}I", raw)}


def may_connect(sock: socket.socket, gid: int | None) -> bool:
    """Return whether the process may connect: as our own user, the superuser or a group member."""
    uid = credentials(sock).uid
    return uid in (os.geteuid(), 0) or (gid is not None and gid in peer_groups(sock))


@functools.lru_cache(maxsize=64)
def user_name(uid: int) -> str:
    """Return a user's name, or ``uid 123`` if the user has no name."""
    try:
        return pwd.getpwuid(uid).pw_name
    except KeyError:
        return f"uid {uid}"


def set_timeout(sock: socket.socket, option: int, seconds: float) -> None:
    """Limit how long calls block [s] before ``EAGAIN``, with ``SO_RCVTIMEO`` or ``SO_SNDTIMEO``. 0 means no limit."""
    whole = int(seconds)
    sock.setsockopt(socket.SOL_SOCKET, option, struct.pack("@ll", whole, int((seconds - whole) * 1e6)))


class ServerConnection:
    """An application's connection. Any thread may send without waiting; everything else is for its receiving thread."""

    def __init__(self, sock: Socket, peer: Peer, who: Credentials) -> None:
        sock.limit_backlog()
        self.who = who  #: as the kernel reports it
        self._socket = sock
        self._send = sock.send
        self.receive = sock.recv
        poll = select.poll()
        poll.register(sock, select.POLLIN)
        self.poll = poll.poll  #: returns whether a packet or the end is waiting; for the receiving thread
        self.backlog = PacketBacklog()  #: packets that were taken from the socket but have not been handled yet
        self.peer = peer
        self.joined = False  #: whether the application has sent Hello, so that the handler knows about it
        self.admitted = False  #: whether the application has identified itself, so that the handler has admitted it
        self.pilot = False  #: whether the application connected as a pilot
        self.ending = False  #: whether the server is ending the connection, so that earlier packets no longer count
        self.reason = ""  #: the reason why the connection ends, once either end has given one
        self.topics: set[str] = set()

    def fileno(self) -> int:
        """Return the socket's descriptor, so that several sockets can be polled together."""
        return self._socket.fileno()

    def more(self) -> bool:
        """Return whether the socket contains a pilot's packet or the end. Other clients can't command anyway."""
        return self.pilot and bool(self.poll(0))

    def take_in(self) -> int:
        """Move waiting packets from the socket to the backlog; return how many commands were superseded."""
        superseded = 0
        backlog = self.backlog
        for _ in range(MOST_PACKETS):
            if backlog.full or not self.more():
                break
            try:
                packet = self.receive(MAX_PACKET + 1, RECEIVE_FLAGS)
            except OSError:
                break  # the next read returns the same packet again
            if packet == packets.WAKE:
                continue
            superseded += backlog.put(packet)
            if not packet:
                break  # the end
        return superseded

    def limit_silence(self, seconds: float) -> None:
        """Set how long :attr:`receive` waits [s] before it raises ``BlockingIOError``. With 0, it waits forever."""
        set_timeout(self._socket, socket.SO_RCVTIMEO, seconds)

    def transmit(self, packet: bytes) -> None:
        """Send a packet without waiting. Any thread. ``OSError``: the application has ended, or its buffer is full."""
        self._send(packet, SEND_FLAGS)

    def transmit_descriptor(self, packet: bytes, descriptor: int) -> None:
        """Send a packet with a file descriptor, like :meth:`transmit`."""
        rights = (socket.SOL_SOCKET, socket.SCM_RIGHTS, array.array("i", (descriptor,)))
        self._socket.sendmsg((packet,), (rights,), SEND_FLAGS)

    def hang_up(self, reason: str) -> None:
        """End the connection with a reason. Any thread. The receiving thread treats it like any other end."""
        if not self.ending:
            self.reason = self.reason or reason
            self.ending = True
            self._socket.hang_up(packets.bye(self.reason))
