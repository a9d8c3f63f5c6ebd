"""The fast side of the local transport: Unix ``SOCK_SEQPACKET`` sockets, sealed memory, and epoll. Linux 5.1 or later.

The file of a killed proxy's socket remains. A connection attempt with the *wrong* type of socket reveals whether a
process is still listening. The kernel answers at once, without the owner noticing: ``EPROTOTYPE`` for a live socket and
``ECONNREFUSED`` for a dead one.
"""

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

from skyloop.errors import LinkError, UsageError
from skyloop.transport.base import Pixels
from skyloop.transport.local import packets
from skyloop.transport.local.directory import DIRECTORY_VARIABLE
from skyloop.transport.local.frame_exchange import Connection, SlotMemory
from skyloop.transport.local.system import CONNECT_TIMEOUT_S, HOST, PROXY, SEND_FLAGS, Credentials

assert sys.platform == "linux"  # on other systems, type checkers skip this module

SUFFIXES: Final = {PROXY: ".sock", HOST: ".host"}
#: Size of the send buffer. It has room for the largest packet and a burst of small packets, but is small enough to
#: bound the backlog of a stalled reader (about 200 packets of 300 bytes).
SEND_BUFFER: Final = 131_072
MAX_PATH: Final = 107  #: Linux's limit for a socket's path [bytes]
F_SEAL_FUTURE_WRITE: Final = 0x10  # Linux 5.1; missing from Python's fcntl module
# Once the server has mapped the memory, it keeps that writeable view. No other writeable view can be created, and the
# size can't be changed. If a slot could shrink while mapped by a reader, reading it would kill the reader (SIGBUS).
_SEALS: Final = fcntl.F_SEAL_SHRINK | fcntl.F_SEAL_GROW | F_SEAL_FUTURE_WRITE | fcntl.F_SEAL_SEAL
_SO_PEERGROUPS: Final = 59  # Linux 4.13; missing from Python's socket module
_ANCILLARY: Final = socket.CMSG_SPACE(4 * array.array("i").itemsize)
_CREDENTIALS: Final = struct.Struct("3i")
_MAX_OPTION: Final = 1024  # Python's limit for a socket option [bytes], enough for 256 groups


class Socket(socket.socket):
    """A ``SOCK_SEQPACKET`` socket that closes itself when nothing refers to it any more.

    Both ends *shut down* a connection and drop their references, but neither closes it. A descriptor's number therefore
    can't be reused while a thread is sending on it.
    """

    post_flags = SEND_FLAGS

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

    def on_room(self, call: Callable[[], object]) -> None:
        """Do nothing. When a client releases a frame, it has read that packet, so the next one fits."""

    def limit_backlog(self) -> None:
        self.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER)

    def hang_up(self, last_packet: bytes = b"") -> None:
        if last_packet:
            with suppress(OSError):
                self.send(last_packet, SEND_FLAGS)
        with suppress(OSError):  # the connection had already ended
            self.shutdown(socket.SHUT_RDWR)

    def release(self) -> None:
        """Do nothing: the name is free as soon as the listener hangs up. The open socket keeps its file's inode."""


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


def check_support() -> None:
    """Raise ``OSError`` or ``AttributeError`` if a required function is missing here."""
    _ = socket.SCM_RIGHTS, select.epoll, os.eventfd
    for end in socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET):
        end.close()
    SealedSlot(0, 0, mmap.PAGESIZE)


class SealedSlot(SlotMemory):
    """A slot without a name, whose descriptor the clients receive."""

    __slots__ = ("fd",)

    def __init__(self, number: int, generation: int, capacity: int) -> None:
        self.fd = -1
        super().__init__(number, generation, capacity)

    def _reserve(self) -> Pixels:
        self.fd = os.memfd_create(f"skyloop-{self.number}", os.MFD_CLOEXEC | os.MFD_ALLOW_SEALING)
        os.posix_fallocate(self.fd, 0, self.capacity)  # if memory is short, fail here rather than during a copy
        view = mmap.mmap(self.fd, self.capacity, mmap.MAP_SHARED | mmap.MAP_POPULATE)
        array: Pixels = np.frombuffer(view, np.uint8)
        fcntl.fcntl(self.fd, fcntl.F_ADD_SEALS, _SEALS)
        return array

    def announce(self, connection: Connection, camera: int) -> None:
        connection.transmit_descriptor(packets.slot(self.number, camera, self.capacity), self.fd)

    def __del__(self) -> None:
        if self.fd >= 0:
            os.close(self.fd)


class EpollPoller:
    """Waits with epoll."""

    def __init__(self) -> None:
        self._epoll = select.epoll()
        self.poll = self._epoll.poll
        self.waker = os.eventfd(0, os.EFD_CLOEXEC | os.EFD_NONBLOCK)
        self.register(self.waker)

    def register(self, fileno: int) -> None:
        self._epoll.register(fileno, select.EPOLLIN)

    def unregister(self, fileno: int) -> None:
        if not self._epoll.closed:
            self._epoll.unregister(fileno)

    def mute(self, fileno: int, muted: bool) -> None:
        self._epoll.modify(fileno, 0 if muted else select.EPOLLIN)

    def wake(self) -> None:
        with suppress(OSError):
            os.eventfd_write(self.waker, 1)

    def drain(self) -> None:
        os.eventfd_read(self.waker)

    def close(self) -> None:
        os.close(self.waker)
        self._epoll.close()


new_slot = SealedSlot
new_poller = EpollPoller


def check_path(path: Path) -> None:
    if len(os.fsencode(path)) > MAX_PATH:
        raise UsageError(
            f"the socket's path {path} has {len(os.fsencode(path))} bytes, over the limit of {MAX_PATH}: "
            f"set {DIRECTORY_VARIABLE} to a shorter directory"
        )


def listen(path: Path, gid: int | None) -> Socket:
    listener = Socket()
    listener.bind(os.fspath(path))
    if gid is not None:
        os.chown(path, -1, gid)
    path.chmod(0o600 if gid is None else 0o660)
    listener.listen(128)
    return listener


def remove(path: Path) -> None:
    path.unlink(missing_ok=True)
