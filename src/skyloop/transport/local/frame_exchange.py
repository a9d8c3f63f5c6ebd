"""The server's frame slots: which one is free, who has which, and who waits for the newest frame.

A frame is copied once, into a slot that nobody has, and each viewer is sent a small packet that names the slot. A
viewer that has :data:`MAX_LEASES` frames, or whose socket is full, is passed over; as soon as it releases one it is
sent the newest frame. There are always slots enough, as each viewer can hold only so many.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import itertools
import mmap
import os
import threading
from collections.abc import Iterator
from typing import Final, Protocol

import numpy as np

from skyloop.errors import LinkError, UnsupportedError
from skyloop.messages import FrameHeader, encode
from skyloop.transport.base import Pixels
from skyloop.transport.local import packets

MAX_LEASES: Final = 4  #: frames of one camera that one client may have: on the way, or in use
F_SEAL_FUTURE_WRITE: Final = 0x10  # Linux 5.1; missing from Python's fcntl module
# After mapping it the server keeps its own writeable view; nobody can make another, nor change the size. Were a slot to
# shrink while a reader has it mapped, reading it would kill the reader (SIGBUS).
_SEALS: Final = fcntl.F_SEAL_SHRINK | fcntl.F_SEAL_GROW | F_SEAL_FUTURE_WRITE | fcntl.F_SEAL_SEAL


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


_Newest = tuple[SlotMemory, bytes]


class Connection(Protocol):
    """What a viewer needs of its connection; both methods raise ``OSError`` when the packet can't be sent now."""

    def transmit(self, packet: bytes) -> None: ...

    def transmit_descriptor(self, packet: bytes, descriptor: int) -> None: ...


class Viewer:
    """One client's subscription to one camera."""

    __slots__ = ("active", "announced", "connection", "leases", "retire_before", "waits")

    def __init__(self, connection: Connection) -> None:
        self.connection = connection
        self.leases: dict[int, SlotMemory] = {}
        self.announced: set[int] = set()
        self.retire_before = 0  #: slots below this number were retired, and the client is to be notified; 0: no
        self.active = True  #: frames are sent to it; if not, it may still hold some
        self.waits = False  #: it was passed over

    def hand(self, slot: SlotMemory, packet: bytes, camera: int) -> bool:
        """Send a frame, unless the viewer has enough frames or its socket is full.

        Args:
            slot: Where the frame is.
            packet: Announces it.
            camera: The camera's number.

        Returns:
            Whether it was sent; if not, the viewer is marked as waiting.
        """
        self.waits = True
        if len(self.leases) >= MAX_LEASES:
            return False
        connection = self.connection
        try:
            if self.retire_before:
                connection.transmit(packets.retire(camera, self.retire_before))
                self.retire_before = 0
            if slot.number not in self.announced:
                connection.transmit_descriptor(packets.slot(slot.number, camera, slot.capacity), slot.fd)
                self.announced.add(slot.number)
            connection.transmit(packet)
        except OSError:
            return False
        self.leases[slot.number] = slot
        slot.holders += 1
        self.waits = False
        return True


class Camera:
    """The slots and viewers of one camera. Not thread-safe: :class:`FrameExchange` holds a lock.

    Args:
        number: The camera's number on the wire.
        slot_numbers: Gives numbers to new slots, unique over all cameras.
    """

    def __init__(self, number: int, slot_numbers: Iterator[int]) -> None:
        self.number = number
        self.viewers: dict[Connection, Viewer] = {}  # inactive ones only hold some frames still
        self.active: tuple[Viewer, ...] = ()  # those that frames are sent to
        self._generation = 0
        self._geometry: object = None
        self._capacity = 0
        self._free: list[SlotMemory] = []
        self._count = 0  # slots of this generation
        self._slot_numbers = slot_numbers
        self._next_number = 0  # no slot so far has this number or a higher one
        self._newest: _Newest | None = None

    def take(self, header: FrameHeader) -> SlotMemory:
        """Return a slot to write a frame to; the writer holds it until :meth:`offer`.

        Raises:
            OSError: No memory or descriptor is left.
        """
        geometry = (header.width, header.height, header.encoding)
        if geometry != self._geometry or header.size > self._capacity:
            # Compressed frames vary in size: when one outgrows its slots, the next ones get room to spare.
            grows = geometry == self._geometry
            self.retire()
            self._geometry = geometry
            self._capacity = 1 << (header.size - 1).bit_length() if grows else max(header.size, 1)
        if self._free:
            slot = self._free.pop()  # the one freed last: it is in the processor's cache
        else:
            slot = SlotMemory(next(self._slot_numbers), self._generation, self._capacity)
            self._next_number = slot.number + 1
            self._count += 1
        slot.holders = 1
        return slot

    def offer(self, slot: SlotMemory, packet: bytes) -> int:
        """Send a written slot to all viewers.

        Args:
            slot: From :meth:`take`.
            packet: Announces the frame.

        Returns:
            How many viewers were passed over.
        """
        missed = 0
        for viewer in self.active:
            if not viewer.hand(slot, packet, self.number):
                missed += 1
        if missed or self._newest is not None:
            self._keep((slot, packet) if missed else None)
        if not missed:
            self.drop(slot)
        return missed

    def drop(self, slot: SlotMemory) -> None:
        """Remove one hold on a slot; without any it is free again."""
        slot.holders -= 1
        if slot.holders == 0 and slot.generation == self._generation:
            self._free.append(slot)

    def released(self, viewer: Viewer, number: int) -> bool:
        """Take a slot back from a viewer, and send it the newest frame if it waits for one.

        Returns:
            False if the viewer did not have the slot.
        """
        slot = viewer.leases.pop(number, None)
        if slot is None:
            return False
        self.drop(slot)
        if viewer.waits and self._newest is not None:
            viewer.hand(*self._newest, self.number)
            if not any(other.waits for other in self.viewers.values()):
                self._keep(None)
        return True

    def subscribe(self, connection: Connection) -> None:
        """Send frames to a connection from the next one on."""
        self.viewers.setdefault(connection, Viewer(connection)).active = True
        self._count_active()

    def unsubscribe(self, viewer: Viewer) -> None:
        """Send a viewer no more frames; those it has stay as they are until it releases them."""
        viewer.active = viewer.waits = False
        viewer.announced.clear()
        with contextlib.suppress(OSError):  # then it keeps the slots mapped until it ends
            viewer.connection.transmit(packets.retire(self.number, self._next_number))
        self._trim()

    def leave(self, connection: Connection) -> None:
        """Remove a client that is gone, and free all slots that it had."""
        viewer = self.viewers.pop(connection, None)
        if viewer is not None:
            for slot in viewer.leases.values():
                self.drop(slot)
            self._trim()

    def _trim(self) -> None:
        """Give memory back that the remaining viewers cannot need."""
        self._count_active()
        if not self.active or self._count > (MAX_LEASES * len(self.viewers)) + 2:
            self.retire()

    def _count_active(self) -> None:
        self.active = tuple(viewer for viewer in self.viewers.values() if viewer.active)

    def retire(self) -> None:
        """Give the memory of all slots back; that of slots in use when they are released."""
        self._keep(None)
        self._generation += 1
        self._geometry = None
        self._capacity = 0
        self._free.clear()
        self._count = 0
        for viewer in self.viewers.values():
            viewer.announced.clear()
            viewer.retire_before = self._next_number

    def _keep(self, newest: _Newest | None) -> None:
        """Keep a slot for viewers that wait, or none; the hold on ``newest`` passes on from its writer."""
        before, self._newest = self._newest, newest
        if before is not None:
            self.drop(before[0])


class FrameExchange:
    """All cameras of a server. Thread-safe; nothing is copied under its lock."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._cameras: dict[str, Camera] = {}
        self._slot_numbers = itertools.count(1)
        self._camera_numbers = itertools.count(1)

    def publish(self, header: FrameHeader, pixels: Pixels) -> int:
        """Copy a frame once and send it to the camera's viewers.

        Args:
            header: The frame's header.
            pixels: ``header.size`` bytes, dtype uint8, in any shape.

        Returns:
            To how many viewers it could not be sent; all of them if no memory is left.
        """
        camera = self._cameras.get(header.camera)
        if camera is None or not camera.active:
            return 0
        description = encode(header)
        with self._lock:
            try:
                slot = camera.take(header)
            except OSError:
                return len(camera.active)
        np.copyto(slot.array[: header.size], pixels.reshape(-1))
        packet = packets.frame(slot.number, description)
        with self._lock:
            return camera.offer(slot, packet)

    def subscribe(self, connection: Connection, name: str) -> None:
        """Send a camera's frames to a connection, from the next one on."""
        with self._lock:
            camera = self._cameras.get(name)
            if camera is None:
                camera = self._cameras[name] = Camera(next(self._camera_numbers), self._slot_numbers)
            camera.subscribe(connection)

    def unsubscribe(self, connection: Connection, name: str) -> None:
        """Send a camera's frames to a connection no longer."""
        with self._lock:
            camera = self._cameras.get(name)
            viewer = camera.viewers.get(connection) if camera is not None else None
            if camera is not None and viewer is not None:
                camera.unsubscribe(viewer)

    def release(self, connection: Connection, slot: int) -> bool:
        """Take a slot back from a client; return False if it did not have it."""
        with self._lock:
            for camera in self._cameras.values():
                viewer = camera.viewers.get(connection)
                if viewer is not None and camera.released(viewer, slot):
                    return True
        return False

    def leave(self, connection: Connection) -> None:
        """Remove a client that is gone from all cameras."""
        with self._lock:
            for name, camera in list(self._cameras.items()):
                camera.leave(connection)
                if not camera.viewers:  # it is made again for the next one: no name is kept for nobody
                    del self._cameras[name]
