"""Sealed shared memory: the server's slots that frames are copied into, and the client's read-only view of them."""

from __future__ import annotations

import errno
import fcntl
import mmap
import os
from collections.abc import Callable
from typing import Any, Final

import numpy as np

from skyloop.errors import LinkError, UnsupportedError
from skyloop.transport.base import Pixels

F_SEAL_FUTURE_WRITE: Final = 0x10  # Linux 5.1; missing from Python's fcntl module
# After mapping it the server keeps its own writeable view, and nobody can make another, nor change the size: what a
# reader has mapped cannot be cut off under its eyes, which would kill it (SIGBUS).
_SEALS: Final = fcntl.F_SEAL_SHRINK | fcntl.F_SEAL_GROW | F_SEAL_FUTURE_WRITE | fcntl.F_SEAL_SEAL
_MAX_CAPACITY: Final = 1 << 31  # what a client lets a server make it map


class SlotMemory:
    """One slot at the server: memory for a frame, and who looks at it."""

    __slots__ = ("array", "capacity", "fd", "generation", "holders", "number")

    def __init__(self, number: int, generation: int, capacity: int) -> None:
        """Raises ``OSError`` if there is no memory or descriptor left."""
        self.fd = -1
        self.number = number
        self.generation = generation
        self.capacity = capacity
        self.holders = 0  #: clients that have it, and the server while it writes or keeps it for somebody
        self.fd = os.memfd_create(f"skyloop-{number}", os.MFD_CLOEXEC | os.MFD_ALLOW_SEALING)
        os.posix_fallocate(self.fd, 0, capacity)  # fails here where memory is short, and not while copying
        view = mmap.mmap(self.fd, capacity, mmap.MAP_SHARED | mmap.MAP_POPULATE)
        self.array: Pixels = np.frombuffer(view, np.uint8)
        fcntl.fcntl(self.fd, fcntl.F_ADD_SEALS, _SEALS)

    def __del__(self) -> None:
        if self.fd >= 0:
            os.close(self.fd)


def check_support() -> None:
    """Raise :class:`UnsupportedError` where the kernel lacks sealed memory, :class:`LinkError` if none is left."""
    try:
        SlotMemory(0, 0, mmap.PAGESIZE)
    except OSError as error:
        if error.errno not in (errno.EINVAL, errno.ENOSYS, errno.EPERM):
            raise LinkError(f"cannot make shared memory for frames: {error.strerror}") from None
        raise UnsupportedError(
            f"this kernel has no sealed shared memory ({error.strerror}): the local transport needs Linux 5.1 or later"
        ) from None


class SlotView:
    """One slot at a client: mapped once, for reading only."""

    __slots__ = ("_interface", "camera", "capacity", "held", "number", "pixels")

    def __init__(self, number: int, camera: int, capacity: int, fd: int, held: set[int]) -> None:
        """``fd`` stays the caller's. Raises :class:`LinkError` for memory that could be cut off under its reader."""
        self.number = number
        self.camera = camera
        self.capacity = capacity
        self.held = held  #: numbers of all slots of this camera that the application looks at
        try:
            seals = fcntl.fcntl(fd, fcntl.F_GET_SEALS)
        except OSError:
            seals = 0
        if not seals & fcntl.F_SEAL_SHRINK:
            raise LinkError("the proxy offered shared memory that is not sealed against shrinking")
        size = os.fstat(fd).st_size
        if not 0 < capacity <= min(size, _MAX_CAPACITY):
            raise LinkError(f"the proxy offered a slot of {capacity} bytes in {size} bytes of shared memory")
        view = mmap.mmap(fd, capacity, mmap.MAP_SHARED | mmap.MAP_POPULATE, mmap.PROT_READ)
        self.pixels: Pixels = np.frombuffer(view, np.uint8)
        self._interface = self._describe(capacity)

    def interface(self, size: int) -> dict[str, Any]:
        """NumPy's description of the first bytes of the slot, made anew only when their number changes."""
        if self._interface["shape"][0] != size:
            self._interface = self._describe(size)
        return self._interface

    def _describe(self, size: int) -> dict[str, Any]:
        return {"data": (self.pixels.ctypes.data, True), "shape": (size,), "typestr": "|u1", "version": 3}


class Lease:
    """What the pixels of a frame rest on: while any array over it lives, the server does not reuse the slot."""

    __slots__ = ("__array_interface__", "_leases", "_slot")

    def __init__(self, slot: SlotView, size: int, leases: Leases) -> None:
        self._slot = slot
        self._leases = leases
        self.__array_interface__ = slot.interface(size)

    def __del__(self) -> None:
        self._leases.released(self._slot)


class Leases:
    """A client's slots. :meth:`released` is called from any thread, and at any point of one, by the collector."""

    #: Frames of one camera that an application may look at in place; of further ones it gets copies, so that one that
    #: collects frames does not run the server's limit out and starve.
    IN_PLACE: Final = 3

    def __init__(self, send_release: Callable[[int], None]) -> None:
        self._send_release = send_release
        self._slots: dict[int, SlotView] = {}
        self._held: dict[int, set[int]] = {}

    def add(self, number: int, camera: int, capacity: int, fd: int) -> None:
        """Map a slot that the server announced. Raises :class:`LinkError` or ``OSError`` if it is not usable."""
        self._slots[number] = SlotView(number, camera, capacity, fd, self._held.setdefault(camera, set()))

    def retire(self, camera: int, before: int) -> None:
        """Let go of the older slots of a camera."""
        for slot in list(self._slots.values()):
            if slot.camera == camera and slot.number < before:
                del self._slots[slot.number]

    def end(self) -> None:
        """The connection has ended: let go of all slots. Frames that the application still has stay.

        They lead here, and arrays are no part of the collector's search for cycles: a way on from here to the
        client, its handler and the frames which that keeps would keep all of them for ever.
        """
        self._slots.clear()
        self._send_release = _to_nobody

    def pixels(self, number: int, size: int) -> Pixels:
        """The frame in a slot. Raises :class:`LinkError` if the server has not announced such a slot."""
        slot = self._slots.get(number)
        if slot is None or not 0 <= size <= slot.capacity:
            raise LinkError(f"the proxy sent a frame of {size} bytes in slot {number}, which it has not announced")
        if len(slot.held) >= self.IN_PLACE:
            copy = slot.pixels[:size].copy()
            copy.flags.writeable = False
            self._send_release(number)
            return copy
        slot.held.add(number)
        return np.asarray(Lease(slot, size, self))

    def released(self, slot: SlotView) -> None:
        """The application looks at this slot no longer."""
        slot.held.discard(slot.number)
        self._send_release(slot.number)


def _to_nobody(_: int) -> None:
    """Where slots are given back to when the connection has ended."""
