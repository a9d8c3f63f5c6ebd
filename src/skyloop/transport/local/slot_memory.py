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
# After mapping it the server keeps its own writeable view; nobody can make another, nor change the size. Were a slot to
# shrink while a reader has it mapped, reading it would kill the reader (SIGBUS).
_SEALS: Final = fcntl.F_SEAL_SHRINK | fcntl.F_SEAL_GROW | F_SEAL_FUTURE_WRITE | fcntl.F_SEAL_SEAL
_MAX_CAPACITY: Final = 1 << 31  # what a client lets a server make it map


class SlotMemory:
    """One slot at the server: memory for a frame, and how many hold it."""

    __slots__ = ("array", "capacity", "fd", "generation", "holders", "number")

    def __init__(self, number: int, generation: int, capacity: int) -> None:
        """Reserve the memory.

        Args:
            number: The slot's number on the wire.
            generation: Which set of its camera's slots it belongs to.
            capacity: Its size [bytes].

        Raises:
            OSError: No memory or descriptor is left.
        """
        self.fd = -1
        self.number = number
        self.generation = generation
        self.capacity = capacity
        self.holders = (
            0  #: clients that have it, and the server while it writes to it or keeps it for a viewer that waits
        )
        self.fd = os.memfd_create(f"skyloop-{number}", os.MFD_CLOEXEC | os.MFD_ALLOW_SEALING)
        os.posix_fallocate(self.fd, 0, capacity)  # fails here where memory is short, and not while copying
        view = mmap.mmap(self.fd, capacity, mmap.MAP_SHARED | mmap.MAP_POPULATE)
        self.array: Pixels = np.frombuffer(view, np.uint8)
        fcntl.fcntl(self.fd, fcntl.F_ADD_SEALS, _SEALS)

    def __del__(self) -> None:
        if self.fd >= 0:
            os.close(self.fd)


def check_support() -> None:
    """Check that the kernel has what the transport needs.

    Raises:
        UnsupportedError: It has no sealed shared memory.
        LinkError: No memory or descriptor is left.
    """
    try:
        SlotMemory(0, 0, mmap.PAGESIZE)
    except OSError as error:
        if error.errno not in (errno.EINVAL, errno.ENOSYS, errno.EPERM):
            raise LinkError(f"cannot make shared memory for frames: {error.strerror}") from None
        raise UnsupportedError(
            f"this kernel has no sealed shared memory ({error.strerror}): the local transport needs Linux 5.1 or later"
        ) from None


class SlotView:
    """One slot at a client, mapped once, for reading only."""

    __slots__ = ("_interface", "camera", "capacity", "held", "number", "pixels")

    def __init__(self, number: int, camera: int, capacity: int, fd: int, held: set[int]) -> None:
        """Map the memory.

        Args:
            number: The slot's number on the wire.
            camera: The camera's.
            capacity: The slot's size [bytes].
            fd: Its descriptor, which stays the caller's.
            held: The numbers of all slots of this camera that the application has; shared with the camera's other
                slots.

        Raises:
            LinkError: The memory could be cut off while it is read, or is smaller than announced.
            OSError: It can't be mapped.
        """
        self.number = number
        self.camera = camera
        self.capacity = capacity
        self.held = held  #: numbers of all slots of this camera that the application has
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
        """Return NumPy's description of the first ``size`` bytes; it is made again only when their number changes."""
        if self._interface["shape"][0] != size:
            self._interface = self._describe(size)
        return self._interface

    def _describe(self, size: int) -> dict[str, Any]:
        return {"data": (self.pixels.ctypes.data, True), "shape": (size,), "typestr": "|u1", "version": 3}


class Lease:
    """The owner of a frame's pixels: while any array over it lives, the server does not reuse the slot."""

    __slots__ = ("__array_interface__", "_leases", "_slot")

    def __init__(self, slot: SlotView, size: int, leases: Leases) -> None:
        self._slot = slot
        self._leases = leases
        self.__array_interface__ = slot.interface(size)

    def __del__(self) -> None:
        self._leases.released(self._slot)


class Leases:
    """A client's slots.

    :meth:`released` is called by the garbage collector, on any thread and at any point of it.

    Args:
        send_release: Gives a slot back to the server by its number; must not acquire a lock.
    """

    #: Frames of one camera that an application may have in place. It gets copies of further ones, so that one that
    #: collects frames does not use up the server's limit and starve.
    IN_PLACE: Final = 3

    def __init__(self, send_release: Callable[[int], None]) -> None:
        self._send_release = send_release
        self._slots: dict[int, SlotView] = {}
        self._held: dict[int, set[int]] = {}

    def add(self, number: int, camera: int, capacity: int, fd: int) -> None:
        """Map a slot that the server announced.

        Args:
            number: The slot's.
            camera: The camera's number.
            capacity: The slot's size [bytes].
            fd: Its descriptor, which stays the caller's.

        Raises:
            LinkError: The memory is not usable.
            OSError: It can't be mapped.
        """
        self._slots[number] = SlotView(number, camera, capacity, fd, self._held.setdefault(camera, set()))

    def retire(self, camera: int, before: int) -> None:
        """Forget the slots of a camera below the number ``before``."""
        for slot in list(self._slots.values()):
            if slot.camera == camera and slot.number < before:
                del self._slots[slot.number]

    def end(self) -> None:
        """Forget all slots, as the connection has ended; frames that the application still has stay valid.

        Those frames refer to this object, and the collector does not search arrays for cycles. A reference from here to
        the client, its handler and the frames that the handler keeps would keep all of them for ever.
        """
        self._slots.clear()
        self._send_release = _to_nobody

    def pixels(self, number: int, size: int) -> Pixels:
        """Return the frame in a slot: in place, or as a copy if the application has :attr:`IN_PLACE` frames already.

        Args:
            number: The slot's.
            size: The frame's size [bytes].

        Returns:
            Shape (size,), dtype uint8, not writeable.

        Raises:
            LinkError: The server has not announced such a slot.
        """
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
        """Give a slot back to the server; the application has no array over it any more."""
        slot.held.discard(slot.number)
        self._send_release(slot.number)


def _to_nobody(_: int) -> None:
    """Drop a release, as the connection has ended."""
