"""The fast side of the local transport: Unix ``SOCK_SEQPACKET`` sockets, sealed memory, and epoll. Linux 5.1 or later.

The file of a killed proxy's socket remains. A connection attempt with the *wrong* type of socket reveals whether a
process is still listening. The kernel answers at once, without the owner noticing: ``EPROTOTYPE`` for a live socket and
``ECONNREFUSED`` for a dead one.
"""

from __future__ import annotations

import errno
import fcntl
import mmap
import os
import select
import socket
import sys
from contextlib import suppress
from pathlib import Path
from typing import Final

import numpy as np

from skyloop.errors import UsageError
from skyloop.transport.base import Pixels
from skyloop.transport.local import packets
from skyloop.transport.local.directory import DIRECTORY_VARIABLE
from skyloop.transport.local.frame_exchange import Connection, SlotMemory
from skyloop.transport.local.sockets import Socket, connect, is_live, may_connect, owner_pid
from skyloop.transport.local.system import HOST, PROXY

assert sys.platform == "linux"  # on other systems, type checkers skip this module

__all__ = ["SUFFIXES", "connect", "is_live", "may_connect", "new_poller", "new_slot", "owner_pid"]

SUFFIXES: Final = {PROXY: ".sock", HOST: ".host"}
MAX_PATH: Final = 107  #: Linux's limit for a socket's path [bytes]
F_SEAL_FUTURE_WRITE: Final = 0x10  # Linux 5.1; missing from Python's fcntl module
# Once the server has mapped the memory, it keeps that writeable view. No other writeable view can be created, and the
# size can't be changed. If a slot could shrink while mapped by a reader, reading it would kill the reader (SIGBUS).
_SEALS: Final = fcntl.F_SEAL_SHRINK | fcntl.F_SEAL_GROW | F_SEAL_FUTURE_WRITE | fcntl.F_SEAL_SEAL


def check_support() -> None:
    """Raise ``OSError`` or ``AttributeError`` if a required function is missing here."""
    for end in socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET):
        end.close()
    _ = socket.SCM_RIGHTS, select.epoll, os.eventfd
    try:
        SealedSlot(0, 0, mmap.PAGESIZE)
    except OSError as error:
        if error.errno in (errno.EINVAL, errno.ENOSYS, errno.EPERM):
            raise  # this kernel has no sealed shared memory; otherwise, memory or descriptors have run out for now


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
