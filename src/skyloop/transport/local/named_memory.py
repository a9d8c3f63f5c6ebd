"""Frame slots in named shared memory, which clients map by name.

Windows frees such memory with its last user. On other systems, the name stays until it is removed. The server that made
it does so or, if the server is killed, its *keeper*, a small process that waits for the server's end. If both are
killed, the next process that lists or starts a proxy removes the names, which are in the server's registration
(:func:`remove_names`).

With ``multiprocessing.shared_memory``, clients could write to the frames. Before Python 3.13, they would also remove
the memory when they end (https://github.com/python/cpython/issues/82300).
"""

from __future__ import annotations

import errno
import logging
import mmap
import os
import struct
import sys
import threading
from collections import deque
from contextlib import suppress
from typing import Final

import numpy as np

from skyloop.child_process import ChildProcess
from skyloop.errors import LinkError
from skyloop.transport.base import Pixels
from skyloop.transport.local import packets
from skyloop.transport.local.frame_exchange import Connection, SlotMemory

MOST: Final = 4096  #: maximum number of slots that a process has at the same time
_MAGIC: Final = b"SkySlot1"
_HEADER: Final = struct.Struct("<8sIIQ")  # the magic, the slot's number, zero, its capacity
_OFFSET: Final = 64  # of the pixels [bytes]
_KEEPER: Final = (
    "import signal, sys\n"
    "from _posixshmem import shm_unlink\n"
    "for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):\n"
    "    signal.signal(number, signal.SIG_IGN)\n"
    "sys.stdin.buffer.read()\n"
    "for number in range(int(sys.argv[2])):\n"
    "    try:\n"
    "        shm_unlink(f'/{sys.argv[1]}-{number:x}')\n"
    "    except OSError:\n"
    "        pass\n"
)
_log = logging.getLogger(__name__)


class _Process:
    """The names of this process's slots, and its keeper."""

    def __init__(self) -> None:
        self.pid = os.getpid()
        self.prefix = f"sky-{os.urandom(6).hex()}"
        self.free = deque(range(MOST))  # first in, first out: the names of freed slots rest longest
        self._lock = threading.Lock()
        self._keeper: ChildProcess | None = None

    def keep(self) -> None:
        """Start the keeper unless it runs. Without one, a killed process leaves its names until the next listing."""
        if sys.platform == "win32" or (self._keeper is not None and self._keeper.code is None):
            return
        with self._lock:
            if self._keeper is None or self._keeper.code is not None:
                command = [sys.executable, "-I", "-S", "-c", _KEEPER, self.prefix, str(MOST)]
                try:
                    self._keeper = ChildProcess(command)
                except OSError as error:
                    _log.warning("the process that removes shared memory could not be started: %s", error)


_process = _Process()


def prefix() -> str:
    """Return the beginning of the names of this process's slots."""
    global _process  # noqa: PLW0603
    if _process.pid != os.getpid():  # a fork
        _process = _Process()
    return _process.prefix


class NamedSlot(SlotMemory):
    """A slot at the server that has a name."""

    __slots__ = ("_index", "_name", "_owner")

    def __init__(self, number: int, generation: int, capacity: int) -> None:
        self._index = -1
        super().__init__(number, generation, capacity)

    def _reserve(self) -> Pixels:
        begin = prefix()
        self._owner = _process
        self._owner.keep()
        view = None
        with suppress(IndexError):  # other threads took the last names
            for _ in range(len(self._owner.free)):
                self._index = self._owner.free.popleft()
                self._name = f"{begin}-{self._index:x}"
                try:
                    view = _create(self._name, _OFFSET + self.capacity)
                    break
                except FileExistsError:  # on Windows, a client still has the memory that had this name
                    self._owner.free.append(self._index)
                    self._index = -1
        if view is None:
            raise OSError(errno.ENOSPC, f"this process has {MOST} slots")
        view[: _HEADER.size] = _HEADER.pack(_MAGIC, self.number, 0, self.capacity)
        return np.frombuffer(view, np.uint8, self.capacity, _OFFSET)

    def announce(self, connection: Connection, camera: int) -> None:
        connection.transmit(packets.named_slot(self.number, camera, self.capacity, self._name))

    def __del__(self) -> None:
        if self._index >= 0 and self._owner.pid == os.getpid():  # otherwise, a fork's copy
            _unlink(self._name)
            self._owner.free.append(self._index)


def remove_names(begin: str) -> None:
    """Remove the slots of a process that has ended. ``begin``: its :func:`prefix`."""
    for index in range(MOST if sys.platform != "win32" and packets.MEMORY_NAME.fullmatch(begin) else 0):
        _unlink(f"{begin}-{index:x}")


def map_named(name: str, number: int, capacity: int) -> Pixels:
    """Map a slot for reading. Raises :class:`LinkError` if it is not the announced one."""
    try:
        view = _open(name, _OFFSET + capacity)
    except (OSError, ValueError) as error:
        raise LinkError(f"the proxy's shared memory {name} can't be mapped: {error}") from None
    if _HEADER.unpack_from(view) != (_MAGIC, number, 0, capacity):
        raise LinkError(f"the shared memory {name} is not the proxy's slot {number} of {capacity} bytes")
    return np.frombuffer(view, np.uint8, capacity, _OFFSET)


if sys.platform == "win32":

    def _create(name: str, size: int) -> mmap.mmap:
        import _winapi

        # If the name is in use, CreateFileMapping and ``mmap`` return that memory, of its size and with its content
        # (learn.microsoft.com/windows/win32/api/winbase/nf-winbase-createfilemappinga). The handle keeps it for ours.
        none, most = (_winapi.INVALID_HANDLE_VALUE, _winapi.NULL), (size >> 32, size & 0xFFFFFFFF)
        handle = _winapi.CreateFileMapping(*none, _winapi.PAGE_READWRITE, *most, name)
        try:
            if _winapi.GetLastError() == _winapi.ERROR_ALREADY_EXISTS:
                raise FileExistsError(errno.EEXIST, "the name is in use", name)
            return mmap.mmap(-1, size, tagname=name)
        finally:
            _winapi.CloseHandle(handle)

    def _open(name: str, size: int) -> mmap.mmap:
        import _winapi

        # Without this handle, an unknown name would give new memory, which the server could not use under that name.
        handle = _winapi.OpenFileMapping(_winapi.FILE_MAP_READ, False, name)
        try:
            return mmap.mmap(-1, size, tagname=name, access=mmap.ACCESS_READ)
        finally:
            _winapi.CloseHandle(handle)

    def _unlink(name: str) -> None:
        """Do nothing: the last user's end frees the memory."""

else:

    def _create(name: str, size: int) -> mmap.mmap:
        from _posixshmem import shm_open

        descriptor = shm_open(f"/{name}", os.O_CREAT | os.O_EXCL | os.O_RDWR, mode=0o600)
        try:
            os.ftruncate(descriptor, size)
            if hasattr(os, "posix_fallocate"):
                os.posix_fallocate(descriptor, 0, size)  # if memory is short, fail here rather than during a copy
            return mmap.mmap(descriptor, size, mmap.MAP_SHARED | getattr(mmap, "MAP_POPULATE", 0))
        finally:
            os.close(descriptor)

    def _open(name: str, size: int) -> mmap.mmap:
        from _posixshmem import shm_open

        descriptor = shm_open(f"/{name}", os.O_RDONLY, mode=0)
        try:
            return mmap.mmap(descriptor, size, mmap.MAP_SHARED | getattr(mmap, "MAP_POPULATE", 0), mmap.PROT_READ)
        finally:
            os.close(descriptor)

    def _unlink(name: str) -> None:
        from _posixshmem import shm_unlink

        with suppress(OSError):
            shm_unlink(f"/{name}")
