"""The fast side's sockets: how they connect, and which process is at the other end."""

from __future__ import annotations

import array
import errno
import fcntl
import functools
import mmap
import os
import select
import socket
import struct
import sys
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, Final

import numpy as np

from skyloop.errors import LinkError
from skyloop.transport.base import Pixels
from skyloop.transport.local.system import CONNECT_TIMEOUT_S, SEND_BUFFER, SEND_FLAGS, Credentials

assert sys.platform == "linux"  # on other systems, type checkers skip this module

_SO_PEERGROUPS: Final = 59  # Linux 4.13; missing from Python's socket module
_ANCILLARY: Final = socket.CMSG_SPACE(4 * array.array("i").itemsize)
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

    @property
    def who(self) -> Credentials:
        return credentials(self)

    def accept(self) -> tuple[Socket, object]:
        accepted, address = super().accept()
        return Socket(accepted.detach()), address

    def post(self, packet: bytes) -> None:
        self.send(packet, SEND_FLAGS)

    def send_descriptor(self, packet: bytes, descriptor: int) -> None:
        rights = (socket.SOL_SOCKET, socket.SCM_RIGHTS, array.array("i", (descriptor,)))
        self.sendmsg((packet,), (rights,), SEND_FLAGS)

    def send_within(self, packet: bytes, seconds: float) -> None:
        set_timeout(self, socket.SO_SNDTIMEO, seconds)
        self.send(packet, socket.MSG_NOSIGNAL)

    def receiver(self, size: int) -> Callable[[], tuple[bytes, Sequence[Any], int, Any]]:
        return functools.partial(self.recvmsg, size, _ANCILLARY, socket.MSG_CMSG_CLOEXEC)

    def descriptors(self, ancillary: Sequence[Any]) -> list[int]:
        descriptors = array.array("i")
        for level, kind, data in ancillary:
            if level == socket.SOL_SOCKET and kind == socket.SCM_RIGHTS:
                descriptors.frombytes(data[: len(data) - len(data) % descriptors.itemsize])
        return descriptors.tolist()

    def map_sealed(self, descriptor: int, capacity: int) -> Pixels:
        try:
            seals = fcntl.fcntl(descriptor, fcntl.F_GET_SEALS)
        except OSError:
            seals = 0
        if not seals & fcntl.F_SEAL_SHRINK:
            raise LinkError("the proxy offered shared memory that is not sealed against shrinking")
        size = os.fstat(descriptor).st_size
        if not 0 < capacity <= size:
            raise LinkError(f"the proxy offered a slot of {capacity} bytes, but only {size} bytes of shared memory")
        view = mmap.mmap(descriptor, capacity, mmap.MAP_SHARED | mmap.MAP_POPULATE, mmap.PROT_READ)
        return np.frombuffer(view, np.uint8)

    def poller(self) -> Callable[[int], object]:
        poll = select.poll()
        poll.register(self, select.POLLIN)
        return poll.poll

    def limit_wait(self, seconds: float) -> None:
        set_timeout(self, socket.SO_RCVTIMEO, seconds)

    def limit_backlog(self) -> None:
        self.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER)

    def hang_up(self, last_packet: bytes = b"") -> None:
        if last_packet:
            with suppress(OSError):
                self.send(last_packet, SEND_FLAGS)
        with suppress(OSError):  # the connection had already ended
            self.shutdown(socket.SHUT_RDWR)


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


def set_timeout(sock: socket.socket, option: int, seconds: float) -> None:
    """Limit how long calls block [s] before ``EAGAIN``, with ``SO_RCVTIMEO`` or ``SO_SNDTIMEO``. 0 means no limit."""
    whole = int(seconds)
    sock.setsockopt(socket.SOL_SOCKET, option, struct.pack("@ll", whole, int((seconds - whole) * 1e6)))


def is_live(path: Path) -> bool:
    """Return whether a process still holds the socket at this path."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as probe:
        code = probe.connect_ex(os.fspath(path))
    return code not in (errno.ECONNREFUSED, errno.ENOENT)


def owner_pid(path: Path) -> int | None:
    """Return the id of the process that listens at this path; None if it can't be determined immediately."""
    probe = Socket()
    probe.setblocking(False)
    try:
        probe.connect(os.fspath(path))
        return credentials(probe).pid
    except OSError:
        return None


def connect(path: Path) -> Socket:
    """Connect to the socket at this path; ``OSError`` if no process accepts within :data:`CONNECT_TIMEOUT_S`."""
    sock = Socket()
    # Without a time-out, connecting to a stopped process with a full queue would block forever.
    set_timeout(sock, socket.SO_SNDTIMEO, CONNECT_TIMEOUT_S)
    sock.connect(os.fspath(path))
    return sock
