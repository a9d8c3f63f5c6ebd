"""Manage the server's frame slots: which are free, which clients hold them, and which viewers wait for a frame.

A frame is copied once into a free slot, and each viewer gets a small packet that names the slot. A viewer that holds
:data:`MAX_LEASES` frames, or whose socket is full, is skipped. Once it releases a frame, it gets the newest frame.
There is always a free slot, because each viewer can hold only a limited number of slots.
"""

from __future__ import annotations

import contextlib
import itertools
import threading
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Final, Protocol

import numpy as np

from skyloop.messages import FrameHeader, encode
from skyloop.transport.base import Pixels
from skyloop.transport.local import packets

MAX_LEASES: Final = 4  #: maximum number of a camera's frames that one client may hold, including frames in transit


class SlotMemory(ABC):
    """One slot at the server: memory for a frame, and the number of holders."""

    __slots__ = ("array", "capacity", "generation", "holders", "number")

    def __init__(self, number: int, generation: int, capacity: int) -> None:
        """Reserve the memory [bytes]. Raises ``OSError`` if memory or descriptors run out."""
        self.number = number
        self.generation = generation
        self.capacity = capacity
        self.holders = 0  #: number of clients that hold the slot, plus the server while it writes or keeps it
        self.array = self._reserve()

    @abstractmethod
    def _reserve(self) -> Pixels:
        """Return the memory, which the object owns from now on."""

    @abstractmethod
    def announce(self, connection: Connection, camera: int) -> None:
        """Send what a client needs to map the slot, like :meth:`Connection.transmit`."""


_Newest = tuple[SlotMemory, bytes]
_NewSlot = Callable[[int, int, int], SlotMemory]


class Connection(Protocol):
    """A viewer's connection. Both methods raise ``OSError`` if the packet can't be sent now."""

    def transmit(self, packet: bytes) -> None: ...

    def transmit_descriptor(self, packet: bytes, descriptor: int) -> None: ...


@dataclass(slots=True, eq=False)
class Viewer:
    """One client's subscription to one camera."""

    connection: Connection
    leases: dict[int, SlotMemory] = field(default_factory=dict)
    announced: set[int] = field(default_factory=set)
    retire_before: int = 0  #: slots below this number are retired, and the client must be notified; 0: no slots
    active: bool = True  #: whether the viewer gets frames; if not, it may still hold some of them
    waits: bool = False  #: whether the viewer was skipped and is waiting for a frame

    def hand(self, slot: SlotMemory, packet: bytes, camera: int) -> bool:
        """Send a frame. If the viewer holds enough frames or its socket is full, mark it as waiting instead."""
        self.waits = True
        if len(self.leases) >= MAX_LEASES:
            return False
        connection = self.connection
        try:
            if self.retire_before:
                connection.transmit(packets.retire(camera, self.retire_before))
                self.retire_before = 0
            if slot.number not in self.announced:
                slot.announce(connection, camera)
                self.announced.add(slot.number)
            connection.transmit(packet)
        except OSError:
            return False
        self.leases[slot.number] = slot
        slot.holders += 1
        self.waits = False
        return True


class Camera:
    """The slots and viewers of one camera. Not thread-safe: :class:`FrameExchange` holds a lock."""

    def __init__(self, number: int, slot_numbers: Iterator[int], new_slot: _NewSlot) -> None:
        self.number = number
        self._new_slot = new_slot
        self.viewers: dict[Connection, Viewer] = {}  # including inactive viewers, which only hold frames
        self.active: tuple[Viewer, ...] = ()  # viewers that get frames
        self._generation = 0
        self._geometry: object = None
        self._capacity = 0
        self._free: list[SlotMemory] = []
        self._count = 0  # number of slots in this generation
        self._slot_numbers = slot_numbers
        self._next_number = 0  # higher than the numbers of all earlier slots
        self._newest: _Newest | None = None

    def take(self, header: FrameHeader) -> SlotMemory:
        """Return a slot for a frame. The writer holds the slot until :meth:`offer`. ``OSError``: out of memory."""
        geometry = (header.width, header.height, header.encoding)
        if geometry != self._geometry or header.size > self._capacity:
            # The size of compressed frames varies. When one outgrows its slots, new slots get some spare room.
            grows = geometry == self._geometry
            self.retire()
            self._geometry = geometry
            self._capacity = 1 << (header.size - 1).bit_length() if grows else max(header.size, 1)
        if self._free:
            slot = self._free.pop()  # the slot freed last is probably still in the processor's cache
        else:
            slot = self._new_slot(next(self._slot_numbers), self._generation, self._capacity)
            self._next_number = slot.number + 1
            self._count += 1
        slot.holders = 1
        return slot

    def offer(self, slot: SlotMemory, packet: bytes) -> int:
        """Send a slot from :meth:`take` to all viewers; return the number of viewers that were skipped."""
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
        """Remove one hold on a slot. The slot is free again if there are no others."""
        slot.holders -= 1
        if slot.holders == 0 and slot.generation == self._generation:
            self._free.append(slot)

    def released(self, viewer: Viewer, number: int) -> bool:
        """Take a slot back from a viewer that holds it. If the viewer waits for a frame, send it the newest."""
        slot = viewer.leases.pop(number, None)
        if slot is None:
            return False
        self.drop(slot)
        self.retry(viewer)
        return True

    def retry(self, viewer: Viewer) -> None:
        """Send the newest frame to a viewer that waits for one."""
        if viewer.waits and self._newest is not None:
            viewer.hand(*self._newest, self.number)
            if not any(other.waits for other in self.viewers.values()):
                self._keep(None)

    def subscribe(self, connection: Connection) -> None:
        """Send frames to a connection from the next frame on."""
        self.viewers.setdefault(connection, Viewer(connection)).active = True
        self._count_active()

    def unsubscribe(self, viewer: Viewer) -> None:
        """Stop sending frames to a viewer. Frames that the viewer holds stay intact until it releases them."""
        viewer.active = viewer.waits = False
        viewer.announced.clear()
        with contextlib.suppress(OSError):  # if this fails, the slots stay mapped in the client until it ends
            viewer.connection.transmit(packets.retire(self.number, self._next_number))
        self._trim()

    def leave(self, connection: Connection) -> None:
        """Remove a client that has left, and free all its slots."""
        if (viewer := self.viewers.pop(connection, None)) is not None:
            for slot in viewer.leases.values():
                self.drop(slot)
            self._trim()

    def _trim(self) -> None:
        """Release memory that the remaining viewers can't need."""
        self._count_active()
        if not self.active or self._count > (MAX_LEASES * len(self.viewers)) + 2:
            self.retire()

    def _count_active(self) -> None:
        self.active = tuple(viewer for viewer in self.viewers.values() if viewer.active)

    def retire(self) -> None:
        """Free the memory of every slot: immediately if the slot is free, otherwise as soon as it is released."""
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
        """Keep a slot, or none, for waiting viewers. This object takes over the writer's hold on ``newest``."""
        before, self._newest = self._newest, newest
        if before is not None:
            self.drop(before[0])


class FrameExchange:
    """Manages all cameras of a server. Thread-safe. Frames are copied without holding the lock."""

    def __init__(self, new_slot: _NewSlot) -> None:
        self._new_slot = new_slot
        self._lock = threading.Lock()
        self._cameras: dict[str, Camera] = {}
        self._slot_numbers = itertools.count(1)
        self._camera_numbers = itertools.count(1)

    def publish(self, header: FrameHeader, pixels: Pixels) -> int:
        """Copy a frame once and send it to the camera's viewers; return how many missed it (all if memory ran out)."""
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
        """Send a camera's frames to a connection from the next frame on."""
        with self._lock:
            camera = self._cameras.get(name)
            if camera is None:
                camera = self._cameras[name] = Camera(next(self._camera_numbers), self._slot_numbers, self._new_slot)
            camera.subscribe(connection)

    def unsubscribe(self, connection: Connection, name: str) -> None:
        """Stop sending a camera's frames to a connection."""
        with self._lock:
            if (camera := self._cameras.get(name)) and (viewer := camera.viewers.get(connection)):
                camera.unsubscribe(viewer)

    def release(self, connection: Connection, slot: int) -> bool:
        """Take a slot back from a client; return False if the client did not hold the slot."""
        with self._lock:
            for camera in self._cameras.values():
                viewer = camera.viewers.get(connection)
                if viewer is not None and camera.released(viewer, slot):
                    return True
        return False

    def retry(self, connection: Connection) -> None:
        """Send the newest frames to a client whose socket was full, and which has room again."""
        with self._lock:
            for camera in self._cameras.values():
                if (viewer := camera.viewers.get(connection)) is not None:
                    camera.retry(viewer)

    def leave(self, connection: Connection) -> None:
        """Remove a client that has left from all cameras."""
        with self._lock:
            for name, camera in list(self._cameras.items()):
                camera.leave(connection)
                if not camera.viewers:  # recreated for the next viewer; otherwise unused names would accumulate
                    del self._cameras[name]
